"""Plans of records and their expected precision, profile likelihoods and residuals."""

import dataclasses
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float
from jaxtyping import ArrayLike as _ArrayLike

from jrigid._checks import (
    INERTIA,
    all_finite,
    check_shape,
    check_type,
    demand,
    nan_where,
)
from jrigid._core.compile import Static, program, small_jit
from jrigid._numerics import as_tensor, or_one, product
from jrigid._types import AnyArray, Matrix, Readable, Real, Scalar
from jrigid.dynamics import State
from jrigid.free import free_rotation
from jrigid.identify import _problem as problems
from jrigid.identify._disturbance import no_disturbance
from jrigid.identify._errors import conclude
from jrigid.identify._flow import needs_attitude
from jrigid.identify._inertia_models import AbstractInertiaModel, Tensor
from jrigid.identify._inputs import refuse, sizes_of, typical_rate
from jrigid.identify._layout import Layout, whole
from jrigid.identify._minimise import (
    FIRST_DAMPING,
    FIRST_GROWTH,
    STEPS,
    Minimum,
    Settings,
)
from jrigid.identify._quality import Fit
from jrigid.identify._records import (
    Record,
    Samples,
    first_and_last,
    of_trials,
    samples_of,
)
from jrigid.identify._result import FitResult, check_rank, demand_single, result_of
from jrigid.identify._search import ACCURACY, Request, minima
from jrigid.identify._smoother import Links, Point, Rows
from jrigid.identify._unknowns import Unknowns, unknowns_of
from jrigid.simulate import simulate
from jrigid.systems import RigidBody

# Second moments of the mass, of their trace, below which a planned body counts as flat.
_FLATTEST = 1e-9
# Standard errors by which a profile may miss the value at which it holds a function.
_HELD_TO = 1e-3


class Bound(NamedTuple):
    """The smallest errors that a planned record allows, by Cramer and Rao.

    Attributes:
        covariance: Covariance of the unknowns and the states, as in `FitResult`. It is
            very large where the record determines nothing.
        ratios_covariance: Covariance of I2/I1 and I3/I1.
    """

    covariance: Float[Array, "all all"]
    ratios_covariance: Float[Array, "2 2"]


class Plan(Readable):
    """An experiment that has not been made: a body, a state and times.

    A plan states what a record would determine, with derivatives in all that is
    planned. A plan that is made within a function of the rates, the times or the
    samples of a rotor can be improved by gradients: see `optimal_trial`.

    Attributes:
        system: The body as it is assumed to be.
        state: State at `t0`, of one trial, or with an axis of trials in front.
        observations: When and how precisely the body will be observed, as for `fit`.
            The values have no effect and may be None.
        t0: Time of the state [s], or of that of each trial. Under a torque it must not
            be later than the first observation, or all results are NaN.
        free: What is sought beside the inertia, as for `fit`, but nothing by `each`.
        scale: "trace", "known" or "rotor".
        inertia_model: What is known of the tensor.

    Raises:
        ValueError: No record could answer the request, or the noise is not stated.

    Gradients: of `information` and `bound` in the state, the times and the noise. Those
    of the bound exist where the record determines all that is sought. Gradients in the
    tensor are not reliable. Under a torque only forward mode works.

    >>> import jax, jax.numpy as jnp, jrigid as jr
    >>> body = jr.RigidBody(jnp.array([1.0, 1.7, 2.3]))
    >>> ts = jnp.linspace(0.0, 20.0, 100)
    >>> def error(omega):
    ...     start = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), omega)
    ...     plan = jr.identify.Plan(body, start, jr.identify.Rates(ts, None, 0.01))
    ...     return plan.bound.ratios_covariance[1, 1] ** 0.5  # of a `Bound`
    >>> print(f"{error(jnp.array([0.5, 1.0, 0.3])):.5f}")
    0.00378
    """

    system: RigidBody
    state: State
    observations: Any
    t0: Float[Array, "*trials"]
    free: Callable[..., Any] | None = eqx.field(static=True)
    scale: str = eqx.field(static=True)
    inertia_model: AbstractInertiaModel

    def __init__(
        self,
        system: RigidBody,
        state: State,
        observations: Any,
        *,
        t0: Real[_ArrayLike, "*trials"] = 0.0,
        free: Callable[..., Any] | None = None,
        scale: str = "trace",
        inertia_model: AbstractInertiaModel | None = None,
    ):
        """Plan to observe a body from its state at `t0`."""
        check_type("system", system, RigidBody)
        check_type("state", state, State)
        check_shape("inertia", system.inertia, *INERTIA)
        inertia_model = Tensor() if inertia_model is None else inertia_model
        records = of_trials(observations)
        check_type("inertia_model", inertia_model, AbstractInertiaModel)
        refuse(system, records, scale, inertia_model)
        demand(
            all(x.states_noise for x in records),
            "Argument `observations` must state the noise (`sigma` or `covariance`), "
            "but it does not.",
        )
        self.system = system
        self.state = state
        self.observations = observations
        self.t0 = jnp.asarray(t0, records[0].ts.dtype)
        self.free = free
        self.scale = scale
        self.inertia_model = inertia_model

    @property
    def information(self) -> Float[Array, "all all"]:
        """Fisher information about all unknowns and the states at `t0`.

        The state of each trial counts by its rates and, if it has an effect, a small
        turn of its attitude.
        """
        return _information(_planned(self))

    @property
    def bound(self) -> Bound:
        """The smallest errors: the inverse of the information."""
        return _bound(_planned(self))

    @property
    def predicted(self) -> FitResult:
        """The expected result of a fit, with a chi-square of 0.

        Its errors are those of `bound`. Its `status` states whether the record
        determines all that is sought, and `null_directions` names what it does not
        determine. It has no gradients and cannot be used under `jit`.

        >>> import jax.numpy as jnp, jrigid as jr
        >>> record = jr.identify.Rates(jnp.linspace(0.0, 20.0, 100), None, 0.01)
        >>> omega = jnp.array([0.5, 0.0, 1.0])
        >>> start = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), omega)
        >>> top = jr.RigidBody(jnp.array([1.0, 1.0, 1.7]))
        >>> plan = jr.identify.Plan(
        ...     top, start, record, free=lambda body, gyro: gyro.scale)
        >>> print(plan.predicted.null_directions)
        ('overall scale', 'I3/I1 against gyro scale')
        """
        planned = jtu.tree_map(np.asarray, _planned(self))
        minimum = planned.minimum
        samples = planned.problem.samples
        # Residuals are rounding errors only. NaN stays, where there is no motion.
        rows = minimum.rows._replace(residual=0 * minimum.rows.residual)
        dtype = planned.layout.ts.dtype
        kept = samples.seen.astype(dtype)
        fit = Fit(
            problem=planned.problem,
            minimum=minimum._replace(rows=rows),
            layout=planned.layout,
            kept=kept,
            scales=np.ones(len(samples.values), dtype),
            disturbance=no_disturbance(kept.shape[0], dtype),
            torque=None,
            history=np.zeros(0, dtype),
        )
        lengths = [x.shape[1] for x in samples.values]
        return result_of(conclude(fit, lengths))


class _Planned(NamedTuple):
    """A fit of a record that agrees exactly with a plan."""

    problem: problems.Problem
    minimum: Minimum
    layout: Layout


def _unknowns(
    plan: Plan, records: tuple[Record, ...], samples: Samples
) -> tuple[Unknowns, AnyArray]:
    """Unknowns that a plan seeks, and their numbers for the assumed tensor."""
    trials, _ = samples.ts.shape
    dtype = samples.ts.dtype
    model = plan.inertia_model
    unknowns = unknowns_of(
        (plan.system,),
        tuple(x.sensor for x in records),
        sizes_of(samples),
        plan.free,
        model,
        # An absolute model holds the scale in its own numbers.
        plan.scale != "trace" and not model.absolute,
        typical_rate(None, plan.state, dtype),
        trials,
    )
    demand(
        # `predictions` evaluates one body and one set of sensors for all trials.
        not any(x.own for x in unknowns.sought) and not unknowns.groups,
        "Argument `free` must pick nothing of `each` trial, but it does.",
    )
    inertia = as_tensor(plan.system.inertia.astype(dtype))
    return unknowns.start(inertia, _FLATTEST)


def _first_point(state: State, numbers: AnyArray, own: AnyArray) -> Point:
    """Numbers and the state of each trial, whose first sample is its only node."""
    trials = own.shape[0]
    dtype = own.dtype
    attitude = jnp.broadcast_to(state.attitude.astype(dtype), (trials, 4))[:, None]
    omega = jnp.broadcast_to(state.omega.astype(dtype), (trials, 3))[:, None]
    return Point(numbers, own, attitude, omega, omega[..., :0])


@small_jit
def _planned(plan: Plan) -> _Planned:
    """Derivatives of a record that agrees exactly with a plan."""
    system = plan.system
    records = of_trials(plan.observations)
    # The values of a plan may be NaN, which would count as not observed.
    records = tuple(x.with_values(jnp.ones_like(x.values)) for x in records)
    # A plan states its noise, so that this guess of it has no effect.
    one = jnp.ones((), records[0].ts.dtype)
    samples = samples_of(records, one)
    trials, _ = samples.ts.shape
    dtype = samples.ts.dtype
    unknowns, numbers = _unknowns(plan, records, samples)
    point = _first_point(plan.state, numbers, unknowns.own_start(trials, dtype))
    by_sensor = any(x.sensor.depends_on_attitude for x in records)
    options = problems.Options(system.is_free, by_sensor or needs_attitude(system))
    layout = whole(samples, 1, plan.t0)
    # This noise weighs links only, and a plan has none.
    problem = problems.Problem(options, unknowns, samples, jnp.ones(6, dtype))
    # Readings equal to the predictions, so that residuals within the limit of a sensor
    # are zero. They are data: derivatives of a plan do not go through them.
    values = jax.lax.stop_gradient(problems.predictions(problem, layout, point))
    pairs = zip(records, values, strict=True)
    records = tuple(x.with_values(problems.as_read(x.sensor, y)) for x, y in pairs)
    read = samples_of(records, one)
    # Errors of sensors get their natural units from the readings, as in a fit.
    unknowns, numbers = _unknowns(plan, records, read)
    point = _first_point(plan.state, numbers, unknowns.own_start(trials, dtype))
    problem = dataclasses.replace(problem, unknowns=unknowns, samples=read)
    rows, links = problems.evaluation(problem, layout)(point)
    if not system.is_free:
        # `simulate` cannot go back from `t0` to an earlier sample.
        first = first_and_last(samples.ts, samples.seen)[0]
        rows = nan_where(jnp.any(layout.start > first[:, None]), rows)
    minimum = _minimum_at(problem, point, rows, links)
    return _Planned(problem, minimum, layout)


@small_jit
def _information(planned: _Planned) -> Array:
    """Fisher information about all unknowns and the states at `t0`."""
    jacobian = _jacobian(planned.minimum)
    return product("ri,rj->ij", jacobian, jacobian)


@small_jit
def _bound(planned: _Planned) -> Bound:
    """The inverse of the information."""
    unknowns = planned.problem.unknowns
    numbers = planned.minimum.point.numbers
    root = _inverse_root(_jacobian(planned.minimum))
    # Readings that are not finite count as not seen: without a motion none is.
    point = planned.minimum.point
    root = jnp.where(all_finite((point.attitude, point.omega)), root, jnp.nan)

    def ratios(numbers: Array) -> Array:
        moments = jnp.linalg.eigvalsh(unknowns.inertia(numbers))
        return moments[1:] / moments[0]

    slopes = jax.jacfwd(ratios)(numbers)
    # The derivatives have the numbers in their first columns, before the states.
    of_ratios = product("ij,jk->ik", slopes, root[: numbers.size])
    return Bound(
        covariance=product("ij,kj->ik", root, root),
        ratios_covariance=product("ij,kj->ik", of_ratios, of_ratios),
    )


def _minimum_at(
    problem: problems.Problem, point: Point, rows: Rows, links: Links
) -> Minimum:
    """A search that ended at a point without taking a step."""
    dtype = problem.samples.ts.dtype
    # After the samples come rows of priors, and rows that hold a fit near its start.
    priors = problem.known - problem.held
    weight = problem.samples.seen.astype(dtype)
    weight = jnp.pad(weight, ((0, 0), (0, priors)), constant_values=1)
    weight = jnp.pad(weight, ((0, 0), (0, problem.held)))
    zero = jnp.zeros((), dtype)
    return Minimum(
        point=point,
        rows=rows,
        links=links,
        weight=weight,
        kicks=zero,
        square=zero,
        settled=jnp.asarray(True),
        steps=jnp.asarray(0),
        history=zero[None],
        damping=zero,
        growth=zero,
        tensor=problem.unknowns.inertia(point.numbers),
        units=problem.unknowns.natural_units(point.numbers),
    )


def _jacobian(minimum: Minimum) -> Array:
    """Weighted derivatives of all residuals in the numbers and each trial's state."""
    rows = minimum.rows
    trials, samples, width = rows.residual.shape
    count = samples * width
    states = rows.of_state.shape[-1]
    # Rows that would hold a fit near its start weigh nothing: they are no knowledge.
    root = jnp.sqrt(minimum.weight)[..., None, None]
    of_numbers = root * rows.of_border
    of_numbers = of_numbers.reshape(trials, count, rows.of_border.shape[-1])
    of_state = (root * rows.of_state).reshape(trials, count, states)
    # Residuals of a trial depend on its own state alone.
    eye = jnp.eye(trials, dtype=of_state.dtype)
    blocks = eye[:, None, :, None] * of_state[:, :, None, :]
    columns = [
        of_numbers.reshape(trials * count, of_numbers.shape[-1]),
        blocks.reshape(trials * count, trials * states),
    ]
    return jnp.concatenate(columns, axis=1)


def _inverse_root(jacobian: Array) -> Array:
    """A matrix R with R R^T the inverse of J^T J.

    It is computed from the derivatives themselves, because their squares lose digits.
    """
    square = jnp.sum(jacobian * jacobian, axis=0)
    # The scale of the columns cancels in the result, and so does its derivative.
    size = or_one(jax.lax.stop_gradient(jnp.sqrt(square)))
    # Where nothing is determined the last rows keep the result finite, and very large.
    eye = jnp.eye(size.size, dtype=jacobian.dtype)
    floor = 64 * jnp.finfo(eye.dtype).eps * eye
    _, r = jnp.linalg.qr(jnp.concatenate([jacobian / size[None, :], floor]))
    return jax.scipy.linalg.solve_triangular(r, eye) / size[:, None]


def profile(
    result: FitResult,
    function: Callable[[Matrix], Scalar],
    values: Real[_ArrayLike, " n"],
) -> Float[Array, " n"]:
    """Return the growth of chi-square as a function of the tensor is held at values.

    This is the profile likelihood. It shows asymmetric errors and bounds, which the
    quadratic form at the minimum does not. The interval in which the growth is below 1
    contains the true value in 68 % of all cases, that below 3.84 in 95 %.

    Args:
        result: A fit (not vmapped).
        function: Function of the inertia tensor that returns a scalar. Define it once,
            since each new function object is compiled.
        values: Values at which it is held.

    Returns:
        Growth of chi-square, in units of the noise; NaN where no fit was found.

    Raises:
        ValueError: The fit has an unmodelled torque, or the function returns no scalar.

    Gradients: not reliable.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> record = jr.datasets.gyro_example()
    >>> readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
    >>> result = jr.identify.fit(jr.RigidBody(jnp.ones(3)), readings)
    >>> def largest_share(inertia):
    ...     return jnp.linalg.eigvalsh(inertia)[2] / jnp.trace(inertia)
    >>> best = result.moments[2] / 3
    >>> error = result.moments_covariance[2, 2] ** 0.5 / 3
    >>> values = best + error * jnp.array([-1.0, 0.0, 1.0])
    >>> print(jr.identify.profile(result, largest_share, values).round(1) + 0)
    [1. 0. 1.]
    """
    demand_single(result)
    check_rank(function, result.inertia, 0)
    values = jnp.asarray(values, result.numbers.dtype)
    check_shape("values", values, (None,))
    demand(
        not result.problem.options.dense,
        "Argument `result` must be of a fit without an unmodelled torque, but it is "
        "not.",
    )
    return _profile(result, function, values)


@program
def _slope(unknowns: Unknowns, numbers: Array, function: Static) -> Array:
    """Derivative of a function of the tensor in the numbers."""
    return jax.grad(lambda x: function.value(unknowns.inertia(x)))(numbers)


class _Held(eqx.Module):
    """Holds a function of the tensor at a value: a residual that is zero there."""

    function: Callable[[Matrix], Scalar] = eqx.field(static=True)
    value: AnyArray
    unit: AnyArray

    def __call__(self, unknowns: Unknowns, numbers: Array) -> Array:
        return (self.function(unknowns.inertia(numbers)) - self.value) / self.unit


def _profile_settings(result: FitResult) -> Settings:
    """Settings of a minimisation that begins at a fit."""
    dtype = result.numbers.dtype
    one = np.ones((), dtype)
    # A noise that is not stated is taken from the residuals by the minimisation itself.
    noise_known = result.problem.options.noise_known
    noise = result.diagnostics.inflation if noise_known else one
    return Settings(
        kept=result.kept.astype(dtype),
        scales=result.diagnostics.scales,
        disturbance=no_disturbance(result.kept.shape[0], dtype),
        # The layout has one segment for each trial, so that there are no links.
        weight=0 * one,
        # Beyond 1 the whole record takes part, and nothing holds the fit near its
        # start.
        horizon=2 * one,
        soft=np.asarray(False),
        enough=(ACCURACY * noise).astype(dtype),
        steps=np.asarray(STEPS),
        damping=FIRST_DAMPING * one,
        growth=FIRST_GROWTH * one,
    )


def _profile(
    result: FitResult, function: Callable[[Matrix], Scalar], values: Array
) -> Array:
    """Fit again with the function held at each value, all values in one batch."""
    result = jtu.tree_map(np.asarray, result)
    dtype = result.numbers.dtype
    unknowns = result.unknowns
    inflation = result.diagnostics.inflation
    # The search begins at a minimum, where one state for each trial suffices.
    options = result.problem.options._replace(
        shooting=False, unmodelled="none", nodes=1
    )
    problem = dataclasses.replace(result.problem, options=options)
    slope = np.asarray(_slope(unknowns, result.numbers, Static(function)))
    # The residuals are in units of the stated noise, so that the inflation is taken
    # off.
    variance = slope @ result.numbers_covariance @ slope / inflation
    # In this unit the residual that holds the function outweighs the record.
    unit = (_HELD_TO * np.sqrt(variance)).astype(dtype)
    layout = jtu.tree_map(np.asarray, whole(problem.samples, 1, result.t0))
    attitude = result.state.attitude[:, None]
    omega = result.state.omega[:, None]
    point = Point(result.numbers, result.own_numbers, attitude, omega, omega[..., :0])
    settings = _profile_settings(result)

    def request(value: AnyArray) -> Request:
        held = unknowns.holding(_Held(function, value.astype(dtype), unit))
        at_value = dataclasses.replace(problem, unknowns=held)
        return Request(at_value, layout, point, settings)

    requests = [request(x) for x in np.asarray(values)]
    # The sums that are minimised count saturated readings, which chi-square leaves out.
    is_bound = problem.samples.sign != 0
    of_bounds = np.sum(np.where(is_bound, result.diagnostics.residuals**2, 0.0))
    least = result.chi_square + of_bounds
    growth = []
    for minimum in minima(requests):
        # The noise that errors go by has the variance `inflation` in these units.
        added = (minimum.square - least) / inflation
        growth.append(added if minimum.settled else np.nan)
    return jnp.asarray(np.asarray(growth, dtype))


def _motion(
    adjoint: diffrax.AbstractAdjoint | None,
    system: RigidBody,
    state: State,
    ts: Array,
    t0: Array,
) -> State:
    """States of a motion, exact where it is free."""
    if system.is_free:
        return free_rotation(system.inertia, state, ts, t0=t0).states
    return simulate(system, state, ts, t0=t0, adjoint=adjoint).states


def residuals(
    system: RigidBody,
    state: State,
    observations: Any,
    *,
    t0: Real[_ArrayLike, "*trials"] = 0.0,
    adjoint: diffrax.AbstractAdjoint | None = None,
) -> Float[Array, "trials rows"]:
    """Return whitened residuals of a motion, for a custom loss or optimiser.

    Args:
        system: The body.
        state: Its state at `t0`, of one trial, or with an axis of trials in front.
        observations: As for `fit`. Their sensors predict as they are given: put those
            that a fit found, `result.fitted()[1:]`, into its records.
        t0: Time of the state [s], or of that of each trial. For the state of a fit it
            is `result.t0`. Under a torque it must not be later than the first sample.
        adjoint: Passed to `jrigid.simulate`, which computes a motion under a torque.

    Returns:
        Predicted less observed, in units of the noise where that is stated. A residual
        is zero where nothing was observed.

    Raises:
        RuntimeError: `free_rotation` or `simulate` fails.

    Gradients: those of the motion, in every mode that `free_rotation` or `simulate`
    has.

    >>> import jax, jax.numpy as jnp, jrigid as jr
    >>> record = jr.datasets.gyro_example()
    >>> readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
    >>> def loss(moments, omega):
    ...     state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), omega)
    ...     rows = jr.identify.residuals(jr.RigidBody(moments), state, readings)
    ...     return jnp.mean(rows**2)
    >>> print(loss(record.true_moments, jnp.array([0.3, 3.0, 0.4])).round(2))
    1.0
    """
    check_type("system", system, RigidBody)
    check_type("state", state, State)
    records = of_trials(observations)
    sensors = [x.sensor for x in records]
    # Where no noise is stated the residuals are in units of the readings.
    samples = samples_of(records, jnp.ones((), records[0].values.dtype))
    trials = samples.ts.shape[0]
    times = jnp.asarray(t0, samples.ts.dtype)
    attitude = jnp.broadcast_to(state.attitude, (trials, 4))
    omega = jnp.broadcast_to(state.omega, (trials, 3))
    times = jnp.broadcast_to(times, (trials,))
    # The flow of a fit would be quicker, but its derivatives are inexact at close
    # moments.
    options = problems.Options(
        free_motion=False, depends_on_attitude=True, motion=partial(_motion, adjoint)
    )

    def of_trial(q: Array, w: Array, t0: Array, samples: Samples) -> Array:
        state = State(q, w)
        values = problems.shown_by(options, system, sensors, state, t0, samples)
        return problems.whitened(sensors, samples, values).reshape(-1)

    return jax.vmap(of_trial)(attitude, omega, times, samples)
