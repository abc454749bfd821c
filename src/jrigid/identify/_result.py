"""FitResult: the estimates of a fit, their errors, and what the record leaves open."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from jaxtyping import ArrayLike as _ArrayLike

from jrigid._checks import Enumeration, demand, float_arrays, is_concrete, kind_of
from jrigid._core.compile import small_jit
from jrigid._core.third_party import with_codes
from jrigid._numerics import product
from jrigid._spectral import eigh
from jrigid._types import AnyArray, Matrix, Real, Scalar, Vector
from jrigid.dynamics import State
from jrigid.identify._diagnostics import Diagnostics
from jrigid.identify._intervals import interval
from jrigid.identify._problem import Problem, as_read, shown_by
from jrigid.identify._records import Samples
from jrigid.identify._unknowns import AbstractSought, Unknowns
from jrigid.mass import MassProperties
from jrigid.systems import RigidBody


@with_codes
class Status(Enumeration):
    """Status of a fit; `int` gives the code of one, `numpy.asarray` those of many."""

    OK = "The fit describes the record, and the record determines the inertia."
    UNIDENTIFIABLE = (
        "The fit describes the record, but the record does not determine the inertia: "
        "see `null_directions`."
    )
    MISFIT = (
        "The fit follows the record, but its residuals are not the stated noise: a "
        "torque that the model has not, or a sensor's error (see `unmodelled`, "
        "`free`), or the noise is not as stated. Errors are enlarged by larger "
        "residuals."
    )
    WRONG_BASIN = (
        "The fit does not describe the record: it ended in a wrong minimum, or the "
        "model is wrong. With `throw=False` it can be looked at."
    )
    AT_BOUNDARY = (
        "The fit has run into the boundary of real bodies: all mass in a plane or on a "
        "line. The record asks for a tensor that no body has, or hardly tells it."
    )
    NOT_CONVERGED = (
        "The fit has not converged in the steps allowed. With `throw=False` it can be "
        "looked at."
    )
    BAD_INPUT = "The observations, or another argument, are not usable."


_ANOTHER_TENSOR = 1.0  # a change of a number beyond which the tensor is another one
# In natural units: a direction with a larger error is not determined.
LARGEST_ERROR = 0.3


def errors_of(covariance: Any) -> Any:
    """Standard errors."""
    xp = covariance.__array_namespace__()
    return xp.sqrt(xp.maximum(xp.diagonal(covariance, axis1=-2, axis2=-1), 0.0))


def result_of(fields: dict[str, Any]) -> "FitResult":
    """A result from its fields, those of its diagnostics among them."""
    inner = {x.name for x in dataclasses.fields(Diagnostics)}
    arrays = jax.device_put(fields)
    diagnostics = Diagnostics(**{name: arrays[name] for name in inner})
    rest = {name: x for name, x in arrays.items() if name not in inner}
    return FitResult(**rest, diagnostics=diagnostics)


def arrays_of(fields: dict[str, Any]) -> list[Any]:
    """The arrays of a result, in the order of its leaves."""
    inner = [fields[x.name] for x in dataclasses.fields(Diagnostics)]
    of_result = [x.name for x in dataclasses.fields(FitResult)]
    return jtu.tree_leaves(
        [inner if x == "diagnostics" else fields[x] for x in of_result]
    )


class Observations(NamedTuple):
    """Values observed in one record, with an axis of trials in front.

    Attributes:
        times: [s]
        values: What was read; NaN where nothing was.
        kept: Whether the sample took part in the fit.
        residuals: Predicted less observed over the noise; NaN where there is none. A
            noise that was not stated is that of the residuals.
    """

    times: Float[Array, "trials n"]
    values: Float[Array, "trials n k"]
    kept: Bool[Array, "trials n"]
    residuals: Float[Array, "trials n degrees"]


class FitResult(eqx.Module):
    """Inertia, state and what else was sought, with errors.

    `fit_each` returns one with an axis of fits in front, of which
    `jax.tree.map(lambda x: x[0], result)` is the first. `print` shows it in words.
    Errors are standard errors. If no noise was stated, or the residuals exceed it,
    their level is that of the residuals.

    Attributes:
        status: A `jrigid.identify.Status`.
        inertia: The tensor, body axes [kg m^2]; with `scale="trace"` of the trace of
            the system's.
        inertia_covariance: Of its elements, row by row.
        moments: Principal moments, ascending.
        axes: Principal axes, columns, body from principal.
        ratios: I2/I1 and I3/I1.
        shares: Moments over their sum, each at most 1/2, where I1 is too small to
            divide by.
        moments_covariance: Of the moments.
        ratios_covariance: Of the ratios.
        shares_covariance: Of the shares; singular, as their sum is 1.
        axes_errors: Errors of the turn about each principal axis [rad].
        numbers: The numbers sought for all trials: see `names`.
        own_numbers: Those sought in each trial (trials, own).
        numbers_covariance: Of `numbers`.
        state: State at `t0`, not at time 0, with an axis of trials in front: see
            `start`.
        t0: Time of each trial's state [s]: that of its first sample, in a fit.
        chi_square: Sum of the squares of whitened residuals; if no noise was stated, in
            units of 2 % of the rms of what was observed.
        degrees_of_freedom: Residuals less what was sought.
        level: Of the unmodelled torque about each body axis [N m sqrt(s)]: the root of
            its spectral density at low frequencies.
        level_errors: Of the level, by the relative error that its logarithm has; of one
            that was not sought, or not found, what the record could tell.
        correlation_time: Of the unmodelled torque about each body axis [s]; 0 where it
            is white.
        correlation_time_errors: Of that.
        level_by_trial: Of each trial, in units of `level`.
        kept: Which samples took part, records side by side.
        diagnostics: Residuals, what determined the numbers, and how the fit got there.
        problem: The record as it was fitted, and how.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> record = jr.datasets.gyro_example()
    >>> readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
    >>> found = jr.identify.fit(jr.RigidBody(jnp.ones(3)), readings)
    >>> print(found.shares.round(3), found.shares_errors.round(4))
    [0.223 0.333 0.444] [0.0004 0.0004 0.0004]
    >>> print(found.status == jr.identify.Status.OK)
    True
    """

    status: Any
    inertia: Matrix
    inertia_covariance: Float[Array, "9 9"]
    moments: Vector
    axes: Matrix
    ratios: Float[Array, "2"]
    shares: Vector
    moments_covariance: Matrix
    ratios_covariance: Float[Array, "2 2"]
    shares_covariance: Matrix
    axes_errors: Vector
    numbers: Float[Array, " numbers"]
    own_numbers: Float[Array, "trials own"]
    numbers_covariance: Float[Array, "numbers numbers"]
    state: State
    t0: Float[Array, " trials"]
    chi_square: Scalar
    degrees_of_freedom: Int[Array, ""]
    level: Vector
    level_errors: Vector
    correlation_time: Vector
    correlation_time_errors: Vector
    level_by_trial: Float[Array, " trials"]
    kept: Bool[Array, "trials samples"]
    diagnostics: Diagnostics
    problem: Problem

    @property
    def moments_errors(self) -> Float[Array, "*fits 3"]:
        """Standard errors of `moments`."""
        return errors_of(self.moments_covariance)

    @property
    def ratios_errors(self) -> Float[Array, "*fits 2"]:
        """Standard errors of `ratios`."""
        return errors_of(self.ratios_covariance)

    @property
    def shares_errors(self) -> Float[Array, "*fits 3"]:
        """Standard errors of `shares`."""
        return errors_of(self.shares_covariance)

    @property
    def errors(self) -> Float[Array, "*fits numbers"]:
        """Standard errors of `numbers`."""
        return errors_of(self.numbers_covariance)

    @property
    def reduced_chi_square(self) -> Float[Array, "*fits"]:
        """Chi-square for each degree of freedom."""
        freedom = jnp.maximum(self.degrees_of_freedom, 1)
        return self.chi_square / freedom.astype(self.chi_square.dtype)

    @property
    def unknowns(self) -> Unknowns:
        """Meaning of the numbers: `unknowns.inertia(numbers)` is the tensor."""
        return self.problem.unknowns

    @property
    def rejected_trials(self) -> Bool[Array, "*fits trials"]:
        """Trials that were left out: by a robust fit, or as trials of another body."""
        return jnp.any(self.problem.samples.seen, axis=-1) & ~jnp.any(
            self.kept, axis=-1
        )

    @property
    def names(self) -> tuple[str, ...]:
        """Name of each of `numbers`."""
        # The names follow from the shapes of the arrays in a single fit.
        first = (0,) * (self.numbers.ndim - 1)
        unknowns = jtu.tree_map(lambda x: x[first], self.unknowns)
        return unknowns.names()

    def spread(self, function: Callable[[Array], Array]) -> Array:
        """Covariance of a function of the tensor, to a vector; of a single fit.

        By its values one standard error away along each axis of the numbers'
        covariance, times the root of their count: right where the function is linear,
        and where it has kinks, as sorted moments have where two are equal, it follows
        them.

        Args:
            function: Of the tensor.
        """
        demand_single(self)
        check_rank(function, self.inertia, 1)
        return _spread(self.unknowns, self.numbers, self.numbers_covariance, function)

    def interval(
        self, function: Callable[[Array], Array], level: float = 0.95
    ) -> Array:
        """Lower and upper limit of a scalar function of the tensor; of a single fit.

        They hold where errors by derivatives do not: where sorted moments nearly
        coincide, whose estimates repel each other, and at bounds, such as the 1 of
        ratios and a flat body, which belong to the interval where the record does not
        tell from them; at a bound more than `level` of the intervals hold the truth.
        They ask for small errors: within a few of them the elements of the tensor
        follow the numbers linearly, their covariance is that at the estimate, and the
        smallest moment is positive. Of a pure spin no ratio is known, and both limits
        are NaN.

        Args:
            function: Of the tensor. Compiled once for each function, not for each
                lambda that is made anew.
            level: Of confidence.

        Gradients: none.
        Source: C.-S. Chuang, T. L. Lai, "Hybrid resampling methods for confidence
        intervals", Statistica Sinica 10 (2000) 1.

        >>> import jax.numpy as jnp, jrigid as jr
        >>> record = jr.datasets.gyro_example()
        >>> readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
        >>> found = jr.identify.fit(jr.RigidBody(jnp.ones(3)), readings)
        >>> share = lambda tensor: tensor[2, 2] / jnp.trace(tensor)
        >>> print(found.interval(share).round(2))
        [0.44 0.44]
        """
        demand_single(self)
        check_rank(function, self.inertia, 0)
        demand(
            not is_concrete(level) or 0 < level < 1,
            f"Argument `level` must be above 0 and below 1, but it is {level}.",
        )
        # As an array: a Python number would be static, and each level would compile
        # anew.
        level_ = jnp.asarray(level, self.numbers.dtype)
        limits = interval(function, self.inertia, self.inertia_covariance, level_)
        # Then the estimate follows the noise, and what surrounds it says nothing.
        return jnp.where(self.diagnostics.pure_spin, jnp.nan, limits)

    @property
    def ratios_intervals(self) -> Float[Array, "2 2"]:
        """Limits of I2/I1 and I3/I1 at 95 % in columns, lower first; see `interval`."""
        # The index is an array of a pytree, so that both ratios share one compiled
        # program.
        ratios = [jtu.Partial(_one_of_moments, jnp.asarray(i)) for i in (3, 4)]
        limits = jnp.stack([self.interval(x) for x in ratios], axis=1)
        # A straight line in the numbers may lead below what sorted moments can have.
        return jnp.maximum(limits, 1.0)

    @property
    def covariance(self) -> Float[Array, "*fits all all"]:
        """Covariance of `numbers`, then of each trial's state and own numbers."""
        numbers = self.numbers_covariance
        diagnostics = self.diagnostics
        *lanes, trials, local, size = diagnostics.sensitivity.shape
        sensitivity = diagnostics.sensitivity.reshape(*lanes, trials * local, size)
        # An error of the numbers moves the states by the sensitivity. The states of
        # given numbers scatter independently.
        across = product("...ag,...gh->...ah", sensitivity, numbers)
        eye = jnp.eye(trials, dtype=numbers.dtype)
        blocks = product("ts,...tlm->...tlsm", eye, diagnostics.local_covariance)
        blocks = blocks.reshape(*lanes, trials * local, trials * local)
        blocks = blocks + product("...ah,...bh->...ab", across, sensitivity)
        return jnp.block([[numbers, jnp.swapaxes(across, -2, -1)], [across, blocks]])

    @property
    def system(self) -> RigidBody:
        """The body that was found, that of the first trial; of a single fit."""
        return self.fitted()[0]

    def fitted(self, index: Int[_ArrayLike, ""] = 0) -> tuple[Any, ...]:
        """System and sensors of a trial, as they were found; of a single fit.

        Args:
            index: Which trial.
        """
        demand_single(self)
        _check_index("index", index, self.own_numbers.shape[0])
        leaves = self.unknowns.leaves_of(index)
        return self.unknowns.parts(self.numbers, self.own_numbers[index], leaves)

    def initial_state(
        self, index: Int[_ArrayLike, ""] = 0
    ) -> tuple[State, Float[Array, "*fits"]]:
        """The state of a trial and its time [s], which whoever moves the state needs.

        Args:
            index: Which trial.

        >>> import jax.numpy as jnp, jrigid as jr
        >>> record = jr.datasets.gyro_example()
        >>> readings = jr.identify.Rates(record.times + 50, record.omegas, record.sigma)
        >>> found = jr.identify.fit(jr.RigidBody(jnp.ones(3)), readings)
        >>> state0, t0 = found.initial_state()
        >>> later = jr.simulate(found.system, state0, jnp.array([100.0]), t0=t0)
        >>> print(t0)
        50.0
        """
        _check_index("index", index, self.t0.shape[-1])
        attitude = self.state.attitude[..., index, :]
        omega = self.state.omega[..., index, :]
        return State(attitude, omega), self.t0[..., index]

    def predict(
        self, ts: Real[_ArrayLike, "*times"], record: int = 0, trial: int = 0
    ) -> Float[Array, "*times k"]:
        """Predict the readings of a sensor in a trial, of a single fit.

        The motion goes on from the trial's `state` at `t0`, without an unmodelled
        torque. The sensor has the errors that were estimated, its delay, its filter and
        its limit.

        Args:
            ts: Times [s] on the clock of the record, of any shape; under a torque,
                whose motion is followed forward only, not before `t0`.
            record: Which record's sensor.
            trial: Which trial.

        Raises:
            ValueError: No such record or trial, or times before `t0` under a torque.

        Gradients: in forward mode.

        >>> import jax.numpy as jnp, jrigid as jr
        >>> record = jr.datasets.gyro_example()
        >>> readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
        >>> found = jr.identify.fit(jr.RigidBody(jnp.ones(3)), readings)
        >>> print(found.predict(100.0).round(1))  # 80 s after the record has ended
        [ 1.6 -2.4  1.2]
        """
        self._check_place(record, trial)
        times = float_arrays(ts)[0].astype(self.numbers.dtype)
        after = jnp.all(times >= self.t0[trial])
        options = self.problem.options
        # The exact flow takes times before `t0`, and so may a motion of the user's own.
        backward = options.free_motion or options.motion is not None
        demand(
            backward or not is_concrete(after) or bool(after),
            "Argument `ts` must not be before the trial's `t0` where there is a "
            "torque, but it is.",
        )
        readings = _predicted(self, times.reshape(-1), record, jnp.asarray(trial))
        return readings.reshape(*times.shape, -1)

    @property
    def body(self) -> MassProperties:
        """The body that was found, about its fixed point, by a `LogCholesky`.

        Raises:
            ValueError: The inertia model of the fit was another one.
        """
        numbers = self.numbers[..., self.unknowns.slices["inertia"]]
        body = self.unknowns.inertia_model.body(numbers)
        if body is None:
            raise ValueError(
                "Argument `inertia_model` of the fit must be a LogCholesky for a mass "
                "and a centre of mass to follow, but it was not."
            )
        return body

    def _check_place(self, record: int, trial: int = 0) -> None:
        """Raise ValueError unless this is a single fit with such a record and trial."""
        demand_single(self)
        _check_index("record", record, len(self.problem.samples.values))
        _check_index("trial", trial, self.t0.shape[0])

    def linearization(
        self, record: int = 0, trial: int = 0
    ) -> tuple[Float[Array, "n degrees unknowns"], Float[Array, "n degrees"]]:
        """Derivatives and whitened residuals of a record in a trial, of a single fit.

        Args:
            record: Which record.
            trial: Which trial.
        """
        self._check_place(record, trial)
        part = self.problem.samples.parts[record]
        jacobian = self.diagnostics.jacobian[trial, part]
        return jacobian, self.diagnostics.residuals[trial, part]

    def residuals(self, record: int = 0) -> Float[Array, "trials n degrees"]:
        """Residuals of a record, predicted less observed, in its own units.

        Of a single fit.
        NaN where nothing was seen, and of samples that are saturated or were left out.

        Args:
            record: Which record.
        """
        self._check_place(record)
        samples = self.problem.samples
        used = self.kept[..., None] & (samples.weight > 0) & (samples.sign == 0)
        white = samples.whitener[:, samples.parts[record]]
        eye = jnp.eye(white.shape[-1], dtype=white.dtype)
        # Rows that fill a narrower record up are zero, and have no inverse.
        white = jnp.where(jnp.any(white != 0, axis=-1, keepdims=True), white, eye)
        rows = self.diagnostics.residuals[:, samples.parts[record], :, None]
        residuals = jnp.linalg.solve(white, rows)[..., 0]
        return jnp.where(used[:, samples.parts[record]], residuals, jnp.nan)

    @property
    def has_unmodelled_torque(self) -> bool:
        """Whether the fit allows for one: `predict` then does not follow the record."""
        return self.problem.options.dense

    def observations(self, record: int = 0) -> Observations:
        """Values that were read in a record, with their residuals; of a single fit.

        Args:
            record: Which record.
        """
        self._check_place(record)
        samples = self.problem.samples
        part = samples.parts[record]
        values = samples.values[record]
        sensor = self.fitted()[1 + record]
        width = sensor.degrees or values.shape[-1]
        seen = samples.weight[:, part] > 0
        if sensor.degrees is None:
            # A number may be missing without the others of its sample.
            seen = seen[..., :width]
        else:
            seen = jnp.any(seen, axis=-1, keepdims=True)
        # A noise that was not stated is that of the residuals.
        known = self.problem.options.noise_known
        size = 1.0 if known else jnp.sqrt(self.reduced_chi_square)
        # A residual of exactly zero is one of a number that was not seen.
        residuals = self.diagnostics.residuals[:, part, :width] / size
        return Observations(
            times=samples.ts[:, part],
            values=jnp.where(seen, values, jnp.nan),
            kept=self.kept[:, part],
            residuals=jnp.where(residuals == 0, jnp.nan, residuals),
        )

    @property
    def estimates(self) -> dict[str, tuple[Array, Array]]:
        """Value and error of each array that `free` picked, by name; of a single fit.

        An array that is sought anew in each trial has an axis of trials in front. One
        that may not be negative and ended at zero has the error that it would have if
        it might: the record bounds it from above.
        """
        demand_single(self)
        estimates = {}
        for x in self.unknowns.sought:
            numbers, covariance = self._of_sought(x)
            function = jax.vmap(x.with_errors) if x.own else x.with_errors
            estimates[x.name] = function(numbers, covariance)
        return estimates

    def _of_sought(self, x: AbstractSought) -> tuple[Array, Array]:
        """Numbers and covariance of an array that is sought, of each trial if own."""
        numbers = self.numbers_covariance
        if not x.own:
            part = self.unknowns.slices[x.name]
            return self.numbers[part], numbers[part, part]
        part = next(s for y, s in self.unknowns.own_slices if y is x)
        # Own numbers come after the numbers of a state.
        first = self.diagnostics.sensitivity.shape[1] - self.own_numbers.shape[1]
        local = slice(first + part.start, first + part.stop)
        sensitivity = self.diagnostics.sensitivity[:, local]
        # Errors of the numbers of all trials move those of each trial, too.
        shared = product("tlg,gh,tmh->tlm", sensitivity, numbers, sensitivity)
        alone = self.diagnostics.local_covariance[:, local, local]
        return self.own_numbers[:, part], shared + alone

    @property
    def determined(self) -> dict[str, bool]:
        """Whether the record determines the inertia and each array of `free`, by name.

        An array is determined where its errors are below 0.3 of its size, or of its
        natural unit if that is larger; one that is sought anew in each trial, where it
        is in every trial that took part. The inertia, where `status` does not say
        otherwise. Where the inertia is not determined, errors of arrays are those near
        the estimate, and bodies far from it may have other values. A fit that ended
        neither OK nor MISFIT nor UNIDENTIFIABLE determines nothing. Of a single fit.

        >>> import jax.numpy as jnp, jrigid as jr
        >>> record = jr.datasets.gyro_example()
        >>> readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
        >>> found = jr.identify.fit(
        ...     jr.RigidBody(jnp.ones(3)), readings, free=lambda body, gyro: gyro.bias)
        >>> print(found.determined)
        {'inertia': True, 'gyro.bias': True}
        """
        demand_single(self)
        described = bool((self.status == Status.OK) | (self.status == Status.MISFIT))
        has_errors = described or bool(self.status == Status.UNIDENTIFIABLE)
        verdicts = {"inertia": described}
        for x in self.unknowns.sought:
            numbers, covariance = self._of_sought(x)
            units_of = jax.vmap(x.natural_units) if x.own else x.natural_units
            errors = errors_of(covariance) / units_of(numbers)
            if x.own:
                took_part = jnp.any(self.kept, axis=-1)
                errors = errors[took_part]
            verdicts[x.name] = has_errors and bool(jnp.all(errors <= LARGEST_ERROR))
        return verdicts

    @property
    def mirror_moments(self) -> Float[Array, "*fits 3"]:
        """Moments of the body that fits the mirrored readings of a gyro.

        They are about the same axes, in the same order.
        With all axes of the gyro reversed, or one that is a principal axis, the rates
        obey Euler's equations of another body, whose (I2 - I3)/I1 and cyclic ones have
        the opposite sign: a gyro of unknown handedness cannot tell the two apart.
        """
        first, second, third = jnp.moveaxis(self.moments, -1, 0)
        a = (second - third) / first
        b = (third - first) / second
        # With I1 = 1 the mirrored moments obey I2 - I3 = -a and I3 - I1 = -b I2.
        other = (1 - a) / (1 + b)
        mirrored = jnp.stack([jnp.ones_like(a), other, other + a], axis=-1)
        total = jnp.sum(mirrored, axis=-1, keepdims=True)
        return mirrored * jnp.sum(self.moments, axis=-1, keepdims=True) / total

    @property
    def null_directions(self) -> tuple[str, ...]:
        """Undetermined quantities, in words; of a single fit, outside of jit."""
        demand_single(self)
        # `_words` imports this module.
        from jrigid.identify._words import null_directions

        return null_directions(self)

    def __str__(self) -> str:
        """The fit in words; of many fits, how they ended."""
        from jrigid.identify._words import report

        return report(self)


def demand_single(result: FitResult) -> None:
    """Raise ValueError for the result of `fit_each`, which holds many fits."""
    shape = result.numbers.shape[:-1]
    demand(
        not shape,
        f"A result must be that of a single fit here, but it holds {shape} fits: take "
        "one by `jax.tree.map(lambda x: x[0], result)`.",
    )


def _check_index(name: str, value: Int[_ArrayLike, ""], count: int) -> None:
    """Raise ValueError unless there is such a record or trial, if that is known."""
    demand(
        not is_concrete(value) or 0 <= int(np.asarray(value)) < count,
        f"Argument `{name}` must be at least 0 and below {count}, but it is {value}.",
    )


def check_rank(function: Callable[[Array], Any], tensor: Array, rank: int) -> None:
    """Raise ValueError unless a function of the tensor returns an array of a rank."""
    value = jax.eval_shape(function, tensor)
    shape = getattr(value, "shape", None)
    demand(
        shape is not None and len(shape) == rank,
        f"Argument `function` must return an array of {rank} axes, but it returns "
        f"{kind_of(value) if shape is None else f'one of shape {shape}'}.",
    )


@small_jit
def _predicted(result: FitResult, ts: Array, record: int, trial: Array) -> Array:
    """Readings of a sensor in a trial (n, k), with its limit."""
    system, *sensors = result.fitted(trial)
    sensor = sensors[record]
    none = jnp.zeros((ts.size, 0), ts.dtype)
    # A prediction needs the times and their count, but no readings.
    samples = Samples(ts, (none,), none, none, none)
    state0, t0 = result.initial_state(trial)
    options = result.problem.options
    (shown,) = shown_by(options, system, [sensor], state0, t0, samples)
    return as_read(sensor, shown)


def of_moments(moments: AnyArray) -> AnyArray:
    """Moments, ratios and shares (..., 8)."""
    xp = moments.__array_namespace__()
    total = xp.sum(moments, axis=-1, keepdims=True)
    ratios = moments[..., 1:] / moments[..., :1]
    return xp.concatenate([moments, ratios, moments / total], axis=-1)


def _one_of_moments(which: Array, tensor: Array) -> Array:
    """One of the moments, ratios and shares of a tensor."""
    return of_moments(eigh(tensor)[0])[which]


def _spread(
    unknowns: Unknowns, numbers: Array, covariance: Array, function: Callable[..., Any]
) -> Array:
    """Covariance of a function of the tensor: see `FitResult.spread`."""

    def of_numbers(x: Array) -> Array:
        return function(unknowns.inertia(x))

    # The numbers of the tensor come first, and the others do not change it.
    points, scales = sigma_points(numbers, covariance, unknowns.of_inertia.stop)
    return spread_of(jax.vmap(of_numbers)(points), scales)


def sigma_points(
    numbers: AnyArray, covariance: AnyArray, size: int
) -> tuple[AnyArray, AnyArray]:
    """Points one standard error from the estimate along each axis of a covariance.

    Errors are multiplied by the root of the count of axes, so that the mean square over
    the points is the variance.

    Args:
        numbers: The estimate.
        covariance: Of the numbers.
        size: How many of them, the first ones, are moved.

    Returns:
        Points (2 size + 1, numbers), the estimate last. Factors by which moves of a
        function between them are too small, as no point is moved by more than
        `_ANOTHER_TENSOR`.
    """
    xp = numbers.__array_namespace__()
    covariance = covariance[:size, :size]
    # A number that is not determined would leave the others no digits: it gets a unit
    # of its own.
    unit = xp.maximum(errors_of(covariance) / _ANOTHER_TENSOR, 1.0)
    values, axes = xp.linalg.eigh(covariance / (unit[:, None] * unit[None]))
    moves = unit[:, None] * axes * xp.sqrt(xp.maximum(values, 0.0) * size)[None]
    lengths = xp.sqrt(xp.sum(moves * moves, axis=0))
    # What is determined worse is continued as a straight line.
    parts = xp.minimum(lengths, _ANOTHER_TENSOR) / xp.where(lengths > 0, lengths, 1.0)
    steps = xp.pad(moves * parts[None], ((0, numbers.size - size), (0, 0))).T
    still = xp.zeros_like(numbers)[None]
    points = numbers[None] + xp.concatenate([steps, -steps, still])
    scales = xp.tile(1 / xp.where(parts > 0, parts, 1.0), 2)
    return points.astype(numbers.dtype), scales


def spread_of(values: AnyArray, scales: AnyArray) -> AnyArray:
    """Covariance of a function, from its values at `sigma_points` (points, k)."""
    moves = (values[:-1] - values[-1:]) * scales[:, None]
    return product("ki,kj->ij", moves, moves) / max(len(scales), 2)
