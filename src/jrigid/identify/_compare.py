"""Comparison of models by information criteria and by cross-validation."""

from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, Int

from jrigid._checks import check_type, demand
from jrigid.identify._disturbance import GaussMarkov
from jrigid.identify._fit import fit
from jrigid.identify._inertia_models import Fixed
from jrigid.identify._precision import SHOWN
from jrigid.identify._records import Record
from jrigid.identify._result import FitResult, demand_single
from jrigid.systems import RigidBody

# Level of an unmodelled torque about an axis for which a fit finds none, over the
# largest level.
_LEAST = 1e-3
_HEADS = ("chi-square", "freedom", "unknowns", "AIC", "BIC")
_WIDTH = 12  # of a column
_HUGE = 1e8


class Comparison(NamedTuple):
    """Fits of one record side by side. `print` shows a table.

    Attributes:
        names: Names of the models.
        chi_square: Chi-square of each.
        degrees_of_freedom: Number of residuals less number of unknowns.
        unknowns: Number of unknowns, including those of the states and of an unmodelled
            torque.
        aic: Akaike information criterion. A smaller value means a better model.
        bic: Bayesian information criterion, which weighs each unknown more. A value
            smaller by 10 is strong evidence.
    """

    names: tuple[str, ...]
    chi_square: Float[Array, " fits"]
    degrees_of_freedom: Int[Array, " fits"]
    unknowns: Int[Array, " fits"]
    aic: Float[Array, " fits"]
    bic: Float[Array, " fits"]

    def __str__(self) -> str:
        """A table, the best by BIC first; criteria are relative to the best."""
        width = max(len(x) for x in ("model", *self.names))
        columns = (
            self.chi_square,
            self.degrees_of_freedom,
            self.unknowns,
            self.aic - jnp.min(self.aic),
            self.bic - jnp.min(self.bic),
        )
        lines = [_line("model", width, _HEADS)]
        for i in jnp.argsort(self.bic).tolist():
            cells = [_cell(column[i]) for column in columns]
            lines.append(_line(self.names[i], width, cells))
        return "\n".join(lines)


def _cell(number: Array) -> str:
    """A number with one decimal; a huge one in digits that fit the column."""
    if number.dtype.kind != "f":
        return str(number)
    value = number.item()
    return f"{value:.1f}" if abs(value) < _HUGE else f"{value:.3g}"


def _line(name: str, width: int, cells: Sequence[str]) -> str:
    return name.ljust(width) + "".join(x.rjust(_WIDTH) for x in cells)


def _unknowns(result: FitResult) -> Int[Array, ""]:
    """Number of unknowns, with those of the states that the record shows."""
    # Singular values of rounding size belong to directions that no sample shows.
    values = result.diagnostics.state_singular_values
    states = jnp.sum(values > SHOWN * values[:, :1])
    return result.numbers.size + result.diagnostics.torque_numbers + states


def compare(results: Mapping[str, FitResult]) -> Comparison:
    """Compare fits of one record with different models by information criteria.

    With the noise stated the criteria are chi-square + 2 k and chi-square + k log n, of
    k unknowns and n residuals. Otherwise n log(chi-square / n) replaces chi-square.
    Quantities with a prior count as unknowns, and the squares of the prior are in
    chi-square. An unmodelled torque correlates the readings, so that the logarithm of
    the determinant of their covariance is added to chi-square. Its numbers count as
    unknowns where they were sought.

    Args:
        results: Each fit by the name of its model.

    Returns:
        The comparison, which `print` shows as a table.

    Raises:
        ValueError: The fits are of different samples.

    Gradients: none.
    Source: G. Schwarz, "Estimating the dimension of a model", Annals of Statistics 6
    (1978) 461.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> record, body = jr.datasets.gyro_example(), jr.RigidBody(jnp.ones(3))
    >>> readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
    >>> any_body = jr.identify.fit(body, readings)
    >>> known_axes = jr.identify.fit(
    ...     body, readings, inertia_model=jr.identify.Moments())
    >>> print(jr.identify.compare({"axes known": known_axes, "any body": any_body}))
    model       chi-square     freedom    unknowns         AIC         BIC
    axes known       594.7         595           5         0.0         0.0
    any body         593.0         592           8         4.3        17.5
    """
    check_type("results", results, Mapping)
    fits = tuple(results.values())
    demand(bool(fits), "Argument `results` must hold fits, but it is empty.")
    for x in fits:
        check_type("results", x, FitResult)
        demand_single(x)
    first = fits[0]
    noise_known = first.problem.options.noise_known

    def data(x: FitResult) -> tuple[Any, ...]:
        return x.problem.samples, x.kept, x.problem.options.noise_known

    demand(
        all(bool(eqx.tree_equal(data(x), data(first), rtol=1e-6)) for x in fits),
        "Argument `results` must be fits of the same samples, with the noise stated in "
        "all or in none, but they are not.",
    )
    samples = first.problem.samples
    # As in chi-square, saturated numbers do not count.
    counted = first.kept[..., None] & (samples.sign == 0)
    n = jnp.sum(jnp.where(counted, samples.weight, 0.0))
    unknowns = jnp.stack([_unknowns(x) for x in fits])
    chi_square = jnp.stack([x.chi_square for x in fits])
    # -2 log of the likelihood, up to a constant, at the most likely noise if that is
    # not stated.
    misfit = chi_square if noise_known else n * jnp.log(chi_square / n)
    # The kicks of the torque are in chi-square, so that this makes it -2 log of the
    # likelihood of the readings.
    misfit = misfit + jnp.stack([x.diagnostics.log_determinant for x in fits])
    k = unknowns.astype(n.dtype)
    return Comparison(
        names=tuple(results),
        chi_square=chi_square,
        degrees_of_freedom=jnp.stack([x.degrees_of_freedom for x in fits]),
        unknowns=unknowns,
        aic=misfit + 2 * k,
        bic=misfit + k * jnp.log(n),
    )


def _split(trial: Any) -> tuple[RigidBody | None, tuple[Record, ...]]:
    """The body of a trial, if it has one of its own, and its records."""
    is_pair = isinstance(trial, tuple) and isinstance(trial[0], RigidBody)
    body, records = trial if is_pair else (None, trial)
    return body, records if isinstance(records, tuple) else (records,)


def _with_estimates(result: FitResult, body: RigidBody | None) -> RigidBody:
    """The fitted body, or another one with the estimates of inertia and torque."""
    if body is None:
        return result.system
    unknowns = result.unknowns
    # `parts` expects the arrays of a system and of the sensors. Those of the sensors
    # only keep their places here, since the system alone is returned.
    sensors = unknowns.original(0)[1:]
    leaves = jtu.tree_leaves(eqx.filter((body, *sensors), eqx.is_inexact_array))
    # The trial of this body was not in the fit, so that it belongs to no group.
    leaves += [jnp.zeros_like(x[0]) for x in unknowns.groups.values()]
    # An array that is sought anew in each trial is not known in a trial that was left
    # out. The first trial lends its own.
    own = result.own_numbers[0]
    return unknowns.parts(result.numbers, own, tuple(leaves))[0]


def _fit_of_states(result: FitResult, trials: list[Any]) -> FitResult:
    """Fit the states of other trials, and keep all else that a fit found."""
    options = result.problem.options
    sensors = result.fitted()[1:]
    bodies, records = zip(*map(_split, trials), strict=True)
    systems = [_with_estimates(result, x) for x in bodies]
    demand(
        all(x.states_noise for trial in records for x in trial),
        "Argument `trials` must state the noise, but one does not.",
    )

    def sensors_of(trial: tuple[Record, ...]) -> list[Any]:
        return [x.sensor for x in trial]

    records = [eqx.tree_at(sensors_of, x, sensors) for x in records]
    # `fit` needs a positive level about each axis, unless all are zero.
    level = jnp.maximum(result.level, _LEAST * jnp.max(result.level))
    return fit(
        systems,
        records,
        inertia_model=Fixed(),
        unmodelled=GaussMarkov(level, result.correlation_time),
        loss="robust" if options.robust else "squares",
        motion=options.motion,
        # A trial that the others do not describe is no error: its misfit is what is
        # asked for.
        throw=False,
    )


def cross_validate(
    fit_function: Callable[[list[Any]], FitResult],
    trials: Sequence[Any],
    *,
    refit: Callable[[FitResult, list[Any]], FitResult] = _fit_of_states,
) -> Float[Array, " trials"]:
    """Return the misfit of each trial, as predicted by a fit of the other trials.

    A fit of the other trials gives the body, its torque and the sensors. Of the trial
    that is left out only the state is sought. Compare models trial by trial: the
    differences and their scatter show which model predicts better, without a count of
    unknowns.

    The misfit is -2 log of the likelihood, up to a constant: chi-square, plus the
    logarithm of a determinant where there is an unmodelled torque (see `compare`).

    Args:
        fit_function: Fits a list of trials, such as
            `lambda trials: jr.identify.fit(body, trials, ...)`.
        trials: A record or a tuple of records for each trial. Where trials have bodies
            of their own, such as a rotor with its own record, an entry is a pair of the
            body and the records, which `fit_function` has to separate. A list of trials
            is left out as a group.
        refit: Finds the states of the trials left out, given the fit of the others. The
            default keeps the level and the correlation time of an unmodelled torque,
            the loss and the motion. Pass a function where the default fails: for
            unknowns by `each`, or a motion that depends on an attitude that was not
            observed.

    Returns:
        Misfit of each trial or group; without an unmodelled torque its chi-square.

    Raises:
        ValueError: There is only one trial or group, or the noise is not stated.

    Gradients: none.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> record, body = jr.datasets.gyro_example(), jr.RigidBody(jnp.ones(3))
    >>> parts = [slice(0, 100), slice(50, 150), slice(100, 200)]
    >>> trials = [
    ...     jr.identify.Rates(record.times[x], record.omegas[x], record.sigma)
    ...     for x in parts]
    >>> squares = jr.identify.cross_validate(
    ...     lambda trials: jr.identify.fit(body, trials), trials)
    >>> print(squares.round())  # of 300 numbers each, less three of its state
    [293. 300. 307.]
    """
    groups = [x if isinstance(x, list) else [x] for x in trials]
    demand(
        len(groups) > 1,
        "Argument `trials` must hold two trials or groups at least, but it holds "
        f"{len(groups)}.",
    )
    misfits = []
    for i, group in enumerate(groups):
        others = [*chain(*groups[:i], *groups[i + 1 :])]
        result = refit(fit_function(others), group)
        # Without the determinant the largest torque would be the best model.
        misfits.append(result.chi_square + result.diagnostics.log_determinant)
    return jnp.stack(misfits)
