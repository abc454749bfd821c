"""Which of several models a record asks for: by what they leave, and by trials they never saw."""

from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float, Int

from jrigid._checks import demand
from jrigid.identify._disturbance import GaussMarkov
from jrigid.identify._errors import SHOWN
from jrigid.identify._fit import fit
from jrigid.identify._inertia_models import Fixed
from jrigid.identify._result import FitResult
from jrigid.systems import RigidBody

_LEAST = 1e-3  # of the largest level, where one of an axis is zero


class Comparison(NamedTuple):
    """Fits of one record side by side; `print` shows it.

    Attributes:
        names: Of the models.
        chi_square: Of each.
        degrees_of_freedom: Residuals less what was sought.
        unknowns: How many numbers were sought, those of the states and an unmodelled torque with
            them.
        aic: Akaike's criterion: a model is the better the less it is.
        bic: The Bayesian one, which asks more of each unknown: 10 less is strong evidence.
    """

    names: tuple[str, ...]
    chi_square: Float[Array, " fits"]
    degrees_of_freedom: Int[Array, " fits"]
    unknowns: Int[Array, " fits"]
    aic: Float[Array, " fits"]
    bic: Float[Array, " fits"]

    def __str__(self) -> str:
        """A table, the best by BIC first; criteria over those of the best."""
        first = max(5, *map(len, self.names))
        heads = "chi-square", "freedom", "unknowns", "AIC", "BIC"
        lines = ["model".ljust(first) + "".join(x.rjust(12) for x in heads)]
        columns = *self[1:4], self.aic - jnp.min(self.aic), self.bic - jnp.min(self.bic)
        for i in jnp.argsort(self.bic).tolist():
            numbers = (
                f"{x[i].item():.1f}" if x.dtype.kind == "f" else str(x[i])
                for x in columns
            )
            lines.append(
                self.names[i].ljust(first) + "".join(x.rjust(12) for x in numbers)
            )
        return "\n".join(lines)


def compare(results: Mapping[str, FitResult]) -> Comparison:
    """Fits of one record with different models: what each leaves, and what it asks for that.

    With the noise stated the criteria are chi-square + 2 k and chi-square + k log n, of k unknowns
    and n residuals; else n log(chi-square / n) stands for chi-square. What was known beforehand
    counts as sought, and its squares are in chi-square. An unmodelled torque makes readings depend
    on each other, so that the logarithm of their covariance's determinant is added to chi-square;
    its numbers count as unknowns where they were sought.

    Args:
        results: Each fit by the name of its model.

    Returns:
        The table.

    Raises:
        ValueError: Fits of different samples.

    Gradients: none.
    Source: G. Schwarz, "Estimating the dimension of a model", Annals of Statistics 6 (1978) 461.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> record, body = jr.datasets.gyro_example(), jr.RigidBody(jnp.ones(3))
    >>> readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
    >>> whole = jr.identify.fit(body, readings)
    >>> known_axes = jr.identify.fit(body, readings, inertia_model=jr.identify.Moments())
    >>> print(jr.identify.compare({"axes known": known_axes, "any body": whole}))
    model       chi-square     freedom    unknowns         AIC         BIC
    axes known       594.7         595           5         0.0         0.0
    any body         593.0         592           8         4.3        17.5
    """
    fits = tuple(results.values())
    asked = [((x.problem.samples, x.kept), x.problem.options.noise_known) for x in fits]
    demand(
        all(bool(eqx.tree_equal(x, asked[0], rtol=1e-6)) for x in asked),
        "Argument `results` must be fits of the same samples, their noise taken alike, but they "
        "are not.",
    )
    n = jnp.sum(jnp.where(fits[0].kept[..., None], fits[0].problem.samples.weight, 0.0))
    values = [x.diagnostics.state_singular_values for x in fits]
    states = [jnp.sum(x > SHOWN * x[:, :1]) for x in values]
    counts = [x.numbers.size + x.diagnostics.torque_numbers for x in fits]
    unknowns = jnp.stack([x + y for x, y in zip(counts, states, strict=True)])
    square, freedom = (
        jnp.stack([getattr(x, y) for x in fits]) for y in Comparison._fields[1:3]
    )
    left, k = (
        square if asked[0][1] else n * jnp.log(square / n),
        unknowns.astype(n.dtype),
    )
    left = left + jnp.stack([x.diagnostics.log_determinant for x in fits])
    criteria = left + 2 * k, left + k * jnp.log(n)
    return Comparison(tuple(results), square, freedom, unknowns, *criteria)


def _split(trial: Any) -> tuple[RigidBody | None, tuple[Any, ...]]:
    """The body of a trial, if it has one of its own, and its records."""
    is_pair = isinstance(trial, tuple) and isinstance(trial[0], RigidBody)
    body, records = trial if is_pair else (None, trial)
    return body, records if isinstance(records, tuple) else (records,)


def _with_what_was_found(found: FitResult, body: RigidBody | None) -> RigidBody:
    """A body that a fit has not seen, with the inertia and the torque that the fit found."""
    if body is None:
        return found.system
    sensors = found.unknowns.original(0)[1:]
    leaves = jtu.tree_leaves(eqx.filter((body, *sensors), eqx.is_inexact_array))
    leaves += [
        jnp.zeros_like(x[0]) for x in found.unknowns.groups.values()
    ]  # it is in none
    return found.unknowns.parts(found.numbers, found.own_numbers[0], tuple(leaves))[0]


def _with_its_own_state(found: FitResult, trials: list[Any]) -> FitResult:
    options = found.problem.options
    sensors = found.fitted()[1:]
    bodies, records = zip(*map(_split, trials), strict=True)
    systems = [_with_what_was_found(found, x) for x in bodies]
    records = [
        eqx.tree_at(lambda x: [y.sensor for y in x], x, sensors) for x in records
    ]
    stated = all(x.states_noise for trial in records for x in trial)
    demand(stated, "Argument `trials` must state the noise, but one does not.")
    level = jnp.maximum(found.level, _LEAST * jnp.max(found.level))
    torque = GaussMarkov(level, found.correlation_time)
    loss = "robust" if options.robust else "squares"
    rest = {"unmodelled": torque, "loss": loss, "motion": options.motion}
    return fit(systems, records, inertia_model=Fixed(), throw=False, **rest)


def cross_validate(
    fit_function: Callable[[list[Any]], FitResult],
    trials: Sequence[Any],
    *,
    refit: Callable[[FitResult, list[Any]], FitResult] = _with_its_own_state,
) -> Float[Array, " trials"]:
    """How well trials that a fit has not seen are described: chi-square of each, left out in turn.

    A fit of the others gives the body, its torque and the sensors; of the trial left out only the
    state is sought. Models are compared trial by trial: the difference and its scatter tell which
    predicts better, with no count of unknowns.

    Args:
        fit_function: Fits a list of trials: `lambda trials: jr.identify.fit(body, trials, ...)`.
        trials: Of each a record or a tuple of records; or, where trials have bodies of their own,
            as with a record of a wheel for each, a pair of the body and these, which
            `fit_function` then takes apart. A list of trials is left out as a group.
        refit: What finds the states of trials left out from the fit of the others, where the
            default cannot: numbers sought by `each`, a motion that depends on an attitude that was
            not observed. The default keeps the level and the correlation time of an unmodelled
            torque, the loss and the motion.

    Returns:
        Chi-square of each trial or group.

    Gradients: none.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> record, body = jr.datasets.gyro_example(), jr.RigidBody(jnp.ones(3))
    >>> parts = [slice(0, 100), slice(50, 150), slice(100, 200)]
    >>> rates = lambda x: jr.identify.Rates(record.times[x], record.omegas[x], record.sigma)
    >>> trials = [rates(x) for x in parts]  # of 300 numbers each, less three of its state
    >>> print(jr.identify.cross_validate(lambda x: jr.identify.fit(body, x), trials).round())
    [293. 300. 307.]
    """
    groups = [x if isinstance(x, list) else [x] for x in trials]
    demand(
        len(groups) > 1,
        f"Argument `trials` must hold two trials or groups at least, but it holds {len(groups)}.",
    )
    others = ([*chain(*groups[:i], *groups[i + 1 :])] for i in range(len(groups)))
    fits = map(refit, map(fit_function, others), groups)
    return jnp.stack([x.chi_square for x in fits])
