"""What a planned record would tell, the likelihood along a line, and residuals for other losses."""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
import numpy as np
from jaxtyping import Array, Float
from jaxtyping import ArrayLike as _ArrayLike

from jrigid._checks import INERTIA, check_shape, check_type, demand, nan_where
from jrigid._numerics import or_one, product
from jrigid._types import Readable, Real
from jrigid.dynamics import State
from jrigid.free import free_rotation
from jrigid.identify import _problem as problems
from jrigid.identify._compile import Static, program, quick_jit
from jrigid.identify._disturbance import no_disturbance
from jrigid.identify._errors import conclude
from jrigid.identify._flow import needs_attitude
from jrigid.identify._inertia_models import AbstractInertiaModel, Tensor, as_tensor
from jrigid.identify._inputs import refuse, sizes_of, typical_rate
from jrigid.identify._layout import Layout, first_and_last, whole
from jrigid.identify._minimise import FIRST_DAMPING, STEPS, Minimum, Settings
from jrigid.identify._quality import Fit
from jrigid.identify._records import Samples, of_trials, samples_of
from jrigid.identify._result import FitResult, result_of
from jrigid.identify._search import ACCURACY, Request, minima
from jrigid.identify._smoother import Point, Rows
from jrigid.identify._unknowns import Unknowns, unknowns_of
from jrigid.simulate import simulate
from jrigid.systems import RigidBody


class Bound(NamedTuple):
    """The least errors a planned record allows, by Cramer and Rao.

    Attributes:
        covariance: Of the numbers sought and the states, as in `FitResult`; very large
            numbers where the record tells nothing.
        ratios_covariance: Of I2/I1 and I3/I1.
    """

    covariance: Float[Array, "all all"]
    ratios_covariance: Float[Array, "2 2"]


class Plan(Readable):
    """A record before it is taken: what it would tell, with derivatives in all that is planned.

    Made within a function of the rate, the times, a wheel's samples, it can be improved
    by descent: see `optimal_trial`.

    Attributes:
        system: The body as it is thought to be.
        state: State at `t0`, of one trial, or with an axis of trials in front.
        observations: When and how well it will be observed, as for `fit`; values play
            no role and may be None.
        t0: Time of the state [s], or of that of each trial; under a torque not later
            than the first observation, or all is NaN.
        free: What is sought beside the inertia, as for `fit`; nothing of each trial.
        scale: "trace", "known" or "rotor".
        inertia_model: What is known of the tensor.

    Raises:
        ValueError: A request that no record could answer, or noise that is not stated.

    Gradients: of `information` and `bound` in the state, the times and the noise, of
    the bound where the record tells all that is sought; in the tensor they are not to
    be relied on. Under a torque in forward mode.

    >>> import jax, jax.numpy as jnp, jrigid as jr
    >>> body, ts = jr.RigidBody(jnp.array([1.0, 1.7, 2.3])), jnp.linspace(0.0, 20.0, 100)
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
        """A body, its state at `t0`, and what will be seen of it."""
        check_type("system", system, RigidBody)
        check_type("state", state, State)
        check_shape("inertia", system.inertia, *INERTIA)
        inertia_model, records = (
            Tensor() if inertia_model is None else inertia_model,
            of_trials(observations),
        )
        check_type("inertia_model", inertia_model, AbstractInertiaModel)
        refuse(system, records, scale, inertia_model)
        demand(
            all(x.states_noise for x in records),
            "Argument `observations` must state the noise (`sigma` or `covariance`), but it does "
            "not.",
        )
        self.system, self.state, self.observations = system, state, observations
        self.t0 = jnp.asarray(t0, records[0].ts.dtype)
        self.free, self.scale, self.inertia_model = free, scale, inertia_model

    @property
    @quick_jit
    def information(self) -> Float[Array, "all all"]:
        """Fisher information about all numbers that are sought, and the states.

        These are at `t0`, of each trial the rate and, if it matters, a small turn.
        """
        jacobian = _jacobian(_planned(self)[1].rows)
        return product("ri,rj->ij", jacobian, jacobian)

    @property
    @quick_jit
    def bound(self) -> Bound:
        """The least errors: the inverse of the information."""
        problem, found, _ = _planned(self)
        # From the derivatives themselves: their squares lose digits.
        jacobian, numbers = _jacobian(found.rows), found.point.numbers
        size = or_one(
            jax.lax.stop_gradient(jnp.sqrt(jnp.sum(jacobian * jacobian, axis=0)))
        )
        # Where nothing is told the last rows keep the bound finite, and very large.
        eye = jnp.eye(size.size, dtype=jacobian.dtype)
        floor = 64 * jnp.finfo(eye.dtype).eps * eye
        _, r = jnp.linalg.qr(jnp.concatenate([jacobian / size[None, :], floor]))
        half = jax.scipy.linalg.solve_triangular(r, eye) / size[:, None]

        def ratios(numbers: Array) -> Array:
            moments = jnp.linalg.eigvalsh(problem.unknowns.inertia(numbers))
            return moments[1:] / moments[0]

        of_ratios = product(
            "ij,jk->ik", jax.jacfwd(ratios)(numbers), half[: numbers.size]
        )
        return Bound(*(product("ij,kj->ik", x, x) for x in (half, of_ratios)))

    @property
    def predicted(self) -> FitResult:
        """A result before there is a record, of chi-square 0; no gradients, outside of jit.

        Its errors are those of `bound`, its `status` says whether all that is sought is
        told, and `null_directions` what is not, in words.

        >>> import jax.numpy as jnp, jrigid as jr
        >>> record = jr.identify.Rates(jnp.linspace(0.0, 20.0, 100), None, 0.01)
        >>> start = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.5, 0.0, 1.0]))
        >>> top = jr.RigidBody(jnp.array([1.0, 1.0, 1.7]))
        >>> plan = jr.identify.Plan(top, start, record, free=lambda body, gyro: gyro.scale)
        >>> print(plan.predicted.null_directions)
        ('overall scale', 'I3/I1 against gyro scale')
        """
        problem, minimum, layout = jtu.tree_map(np.asarray, _planned_once(self))
        # Rounding alone is left of residuals; NaN stays, where there is no motion.
        rows = minimum.rows._replace(residual=0 * minimum.rows.residual)
        minimum = minimum._replace(rows=rows)
        dtype, samples = layout.ts.dtype, problem.samples
        kept, scales = samples.seen.astype(dtype), np.ones(len(samples.values), dtype)
        none = no_disturbance(kept.shape[0], dtype)
        found = Fit(minimum, layout, kept, scales, none, None, np.zeros(0, dtype))
        lengths = [x.shape[1] for x in samples.values]
        return result_of(conclude(problem, found, lengths))


def _planned(plan: Plan) -> tuple[problems.Problem, Minimum, Layout]:
    """Derivatives of a record that is what the body and the state say."""
    system, state, inertia_model = plan.system, plan.state, plan.inertia_model
    records = of_trials(plan.observations)
    records = tuple(x.with_values(jnp.ones_like(x.values)) for x in records)
    one = jnp.ones((), records[0].ts.dtype)
    samples, sensors = samples_of(records, one), tuple(x.sensor for x in records)
    (trials, _), dtype = samples.ts.shape, samples.ts.dtype
    sizes, rate = sizes_of(samples), typical_rate(None, state, dtype)
    scaled = plan.scale != "trace" and not inertia_model.absolute
    unknowns = unknowns_of(
        (system,), sensors, sizes, plan.free, inertia_model, scaled, rate, trials
    )
    shared = not any(x.own for x in unknowns.sought) and not unknowns.groups
    demand(shared, "Argument `free` must pick nothing of `each` trial, but it does.")
    unknowns, numbers = unknowns.start(as_tensor(system.inertia.astype(dtype)), 1e-9)
    attitude = jnp.broadcast_to(state.attitude.astype(dtype), (trials, 4))[:, None]
    omega = jnp.broadcast_to(state.omega.astype(dtype), (trials, 3))[:, None]
    point = Point(
        numbers, unknowns.own_start(trials, dtype), attitude, omega, omega[..., :0]
    )
    depends_on_attitude = any(x.depends_on_attitude for x in sensors) or needs_attitude(
        system
    )
    options, layout = (
        problems.Options(system.is_free, depends_on_attitude),
        whole(samples, 1, plan.t0),
    )
    problem = problems.Problem(options, unknowns, samples, jnp.ones(6, dtype))
    # Values as they would be seen: a residual of zero.
    seen = jax.lax.stop_gradient(problems.predictions(problem, layout, point))
    records = [x.with_values(y) for x, y in zip(records, seen, strict=True)]
    problem = dataclasses.replace(problem, samples=samples_of(records, one))
    rows, links = problems.evaluation(problem, layout)(point)
    if not system.is_free:  # which is followed forward only
        first = first_and_last(samples.ts, samples.seen)[0]
        rows = nan_where(jnp.any(layout.start > first[:, None]), rows)
    prior = problem.known - problem.held
    weight = jnp.pad(
        samples.seen.astype(dtype), ((0, 0), (0, prior)), constant_values=1
    )
    none = jnp.zeros((), dtype)
    minimum = Minimum(
        point=point,
        rows=rows,
        links=links,
        weight=jnp.pad(weight, ((0, 0), (0, problem.held))),
        kicks=none,
        square=none,
        settled=jnp.asarray(True),
        steps=jnp.asarray(0),
        history=none[None],
        damping=none,
        tensor=unknowns.inertia(numbers),
        units=unknowns.natural_units(numbers),
    )
    return problem, minimum, layout


_planned_once = quick_jit(_planned)


def _jacobian(rows: Rows) -> Array:
    """Of all residuals in the numbers and in each trial's state."""
    trials, samples, width = rows.residual.shape
    count = samples * width
    locals_ = rows.of_state.shape[-1]
    jg = rows.of_border.reshape(trials, count, rows.of_border.shape[-1])
    jl = rows.of_state.reshape(trials, count, locals_)
    eye = jnp.eye(trials, dtype=jl.dtype)
    apart = (eye[:, None, :, None] * jl[:, :, None, :]).reshape(
        trials * count, trials * locals_
    )
    return jnp.concatenate([jg.reshape(trials * count, jg.shape[-1]), apart], axis=1)


def profile(
    result: FitResult,
    function: Callable[[Array], Array],
    values: Real[_ArrayLike, " n"],
) -> Float[Array, " n"]:
    """Profile likelihood: how chi-square grows as a function of the tensor is held at values.

    Errors that are not symmetric, and bounds that the quadratic form at the best fit
    misses, show
    here: the interval in which the growth is below 1 holds 68 %, that below 3.84 95 %.

    Args:
        result: A fit (not vmapped).
        function: Inertia tensor to scalar; define it once.
        values: What it is held at.

    Returns:
        Growth of chi-square, in units of the noise; NaN where no fit was found.

    Raises:
        ValueError: A fit with an unmodelled torque.

    Gradients: none to be relied on.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> record = jr.datasets.gyro_example()
    >>> readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
    >>> found = jr.identify.fit(jr.RigidBody(jnp.ones(3)), readings)
    >>> largest = lambda inertia: jnp.linalg.eigvalsh(inertia)[2] / jnp.trace(inertia)
    >>> best, error = found.moments[2] / 3, found.moments_covariance[2, 2] ** 0.5 / 3
    >>> growth = jr.identify.profile(found, largest, best + error * jnp.array([-1.0, 0.0, 1.0]))
    >>> print(growth.round(1) + 0)
    [1. 0. 1.]
    """
    values = jnp.asarray(values, result.numbers.dtype)
    check_shape("values", values, (None,))
    text = "Argument `result` must be of a fit without an unmodelled torque, but it is not."
    demand(not result.problem.options.dense, text)
    return _profile(result, function, values)


@program
def _held_on(unknowns: Unknowns, numbers: Array, function: Static) -> Array:
    """The slope of a function of the tensor in the numbers."""
    return jax.grad(lambda x: function.value(unknowns.inertia(x)))(numbers)


class _Held(eqx.Module):
    """Holds a function of the tensor at a value: a residual that is zero there."""

    function: Callable[[Array], Array] = eqx.field(static=True)
    value: Any
    unit: Any

    def __call__(self, unknowns: Unknowns, numbers: Array) -> Array:
        return (self.function(unknowns.inertia(numbers)) - self.value) / self.unit


def _profile(
    result: FitResult, function: Callable[[Array], Array], values: Array
) -> Array:
    """Fit anew at each value, all of them side by side."""
    options = result.problem.options._replace(
        shooting=False, unmodelled="none", nodes=1
    )
    result = jtu.tree_map(np.asarray, result)
    problem = dataclasses.replace(result.problem, options=options)
    unknowns, numbers, dtype = result.unknowns, result.numbers, result.numbers.dtype
    slope = np.asarray(_held_on(unknowns, numbers, Static(function)))
    unit = 1e-3 * np.sqrt(
        slope @ result.numbers_covariance @ slope / result.diagnostics.inflation
    )
    single = jtu.tree_map(np.asarray, whole(problem.samples, 1, result.t0))
    states = result.state.attitude[:, None], result.state.omega[:, None]
    one = np.ones((), dtype)
    settings = Settings(
        kept=result.kept.astype(dtype),
        scales=result.diagnostics.scales,
        disturbance=no_disturbance(result.kept.shape[0], dtype),
        weight=0 * one,
        horizon=2 * one,
        soft=np.asarray(False),
        enough=(ACCURACY * result.diagnostics.inflation).astype(dtype),
        steps=np.asarray(STEPS),
        damping=FIRST_DAMPING * one,
    )
    point = Point(numbers, result.own_numbers, *states, states[1][..., :0])

    def request(value: Any) -> Request:
        hold = _Held(function, value.astype(dtype), unit.astype(dtype))
        held = dataclasses.replace(problem, unknowns=unknowns.holding(hold))
        return Request(held, single, point, settings)

    growth = []
    for found in minima([request(x) for x in np.asarray(values)], len(values)):
        more = (found.square - result.chi_square) / result.diagnostics.inflation
        growth.append(more if found.settled else np.nan)
    return jnp.asarray(np.asarray(growth, dtype))


def residuals(
    system: RigidBody,
    state: State,
    observations: Any,
    *,
    t0: Real[_ArrayLike, "*trials"] = 0.0,
    adjoint: diffrax.AbstractAdjoint | None = None,
) -> Float[Array, "trials rows"]:
    """Whitened residuals of a motion, for a loss or an optimiser of one's own (optax, say).

    Args:
        system: The body.
        state: Its state at `t0`, of one trial, or with an axis of trials in front.
        observations: As for `fit`.
        t0: Time of the state [s], or of that of each trial: `found.t0` for that of a
            fit. Under a torque not later than the first sample.
        adjoint: For `jrigid.simulate`, if there is a torque.

    Returns:
        Predicted less observed, in units of the noise where that is stated; zero where
        nothing was seen.

    Raises:
        RuntimeError: What `free_rotation` or `simulate` raises.

    Gradients: those of the motion, in every mode that `free_rotation` or `simulate`
        has.

    >>> import jax, jax.numpy as jnp, jrigid as jr
    >>> record = jr.datasets.gyro_example()
    >>> readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
    >>> def loss(moments, omega):
    ...     state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), omega)
    ...     return jnp.mean(jr.identify.residuals(jr.RigidBody(moments), state, readings) ** 2)
    >>> print(loss(record.true_moments, jnp.array([0.3, 3.0, 0.4])).round(2))
    1.0
    """
    check_type("system", system, RigidBody)
    check_type("state", state, State)
    records = of_trials(observations)
    guess = jnp.ones((), records[0].values.dtype)
    samples, sensors = samples_of(records, guess), [x.sensor for x in records]
    trials, begin = samples.ts.shape[0], jnp.asarray(t0, samples.ts.dtype)
    shapes = (state.attitude, (4,)), (state.omega, (3,)), (begin, ())
    q, w, begin = (jnp.broadcast_to(x, (trials, *shape)) for x, shape in shapes)

    def motion(system: Any, start: State, ts: Array, t0: Array) -> State:
        if system.is_free:
            return free_rotation(system.inertia, start, ts, t0=t0).states
        return simulate(system, start, ts, t0=t0, adjoint=adjoint).states

    options = problems.Options(False, True, motion=motion)

    def trial(q: Array, w: Array, begin: Array, samples: Samples) -> Array:
        values = problems.shown_by(
            options, system, sensors, State(q, w), begin, samples
        )
        return problems.whitened(sensors, samples, values).reshape(-1)

    return jax.vmap(trial)(q, w, begin, samples)
