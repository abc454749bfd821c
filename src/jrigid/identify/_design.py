"""What a planned record would tell, the likelihood along a line, and residuals for other losses."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float
from jaxtyping import ArrayLike as _ArrayLike

from jrigid._checks import INERTIA, RESULTS, check_shape, check_type, nan_where
from jrigid._numerics import product
from jrigid._types import Real
from jrigid.dynamics import State
from jrigid.free import free_rotation
from jrigid.identify._errors import conclude
from jrigid.identify._flow import depends_on_attitude
from jrigid.identify._inputs import refuse
from jrigid.identify._layout import Layout, first_and_last, times_of, whole
from jrigid.identify._observations import AbstractObservation, known, of_throws, whitened
from jrigid.identify._parameters import LogCholesky
from jrigid.identify._residuals import (
    Args,
    Options,
    by_kind,
    evaluation,
    in_any_order,
    whole_motion,
)
from jrigid.identify._result import FitResult
from jrigid.identify._shooting import ACCURACY, Point, Rows, Stage, levenberg_marquardt
from jrigid.identify._unknowns import as_tensor, unknowns_of
from jrigid.simulate import simulate
from jrigid.systems import RigidBody


class Bound(NamedTuple):
    """The least errors a planned record allows, by Cramer and Rao.

    Attributes:
        covariance: Of the numbers sought and the states, as in `FitResult`; very large numbers
            where the record tells nothing.
        ratios_covariance: Of I2/I1 and I3/I1.
    """

    covariance: Float[Array, "all all"]
    ratios_covariance: Float[Array, "2 2"]


class _Plan(NamedTuple):
    options: Options
    args: Args
    point: Point
    rows: Rows
    layout: Layout


def _with_values(observation: AbstractObservation, values: Array) -> AbstractObservation:
    """With other values, where there are times."""
    values = jnp.where(jnp.isfinite(observation.ts)[..., None], values, jnp.nan)
    return eqx.tree_at(lambda x: x.values, observation, values)


def _planned(
    system: RigidBody,
    state: State,
    observations: Any,
    t0: Any,
    free: Any,
    nuisances: Sequence[str] | Mapping[str, Any],
    scale: str,
    shape: str | LogCholesky,
) -> _Plan:
    """Derivatives of a record that is what the body and the state say."""
    check_type("system", system, RigidBody)
    check_type("state", state, State)
    check_shape("inertia", system.inertia, *INERTIA)
    stacked = of_throws(observations)
    torque_free = system.is_free
    refuse(system, stacked, scale, torque_free)
    stacked = tuple(_with_values(x, jnp.ones_like(x.values)) for x in stacked)
    if any(x.sigma is None and x.covariance is None for x in stacked):
        raise ValueError(
            "Argument `observations` must state the noise (`sigma` or `covariance`), but it does "
            "not."
        )
    ts, there = times_of(stacked)
    throws = ts.shape[0]
    attitude = jnp.broadcast_to(state.attitude.astype(ts.dtype), (throws, 4))[:, None]
    omega = jnp.broadcast_to(state.omega.astype(ts.dtype), (throws, 3))[:, None]
    rate = jax.lax.stop_gradient(jnp.sqrt(jnp.mean(jnp.sum(omega**2, axis=-1))))
    rate = jnp.where(rate > 0, rate, 1.0)
    unknowns = unknowns_of(system, free, nuisances, shape, scale, rate)
    tensor = as_tensor(system.inertia.astype(ts.dtype))
    unknowns, numbers = unknowns.start(tensor, 1e-9)
    options = Options(
        torque_free, any(x.on_attitude for x in stacked) or depends_on_attitude(system), False, 1,
        "squares", 0, True, None, 0, False,
    )  # fmt: skip
    layout = whole(ts, there, 1, jnp.asarray(t0, ts.dtype))
    point = Point(numbers, attitude, omega)
    # Values as they would be seen: a residual of zero.
    found, _ = unknowns.system_and_gyro(numbers)
    plain = options._replace(on_attitude=True)
    weights = tuple(jnp.ones((*x.ts.shape, 1), ts.dtype) for x in stacked)
    local = jnp.ones(6, ts.dtype)
    args = Args(unknowns, stacked, weights, local, jnp.ones((), ts.dtype))
    states = whole_motion(plain, args, layout, point)
    seen = []
    for x, part in by_kind(stacked, states):
        values = jax.vmap(jax.vmap(lambda t, q, w, x=x: x.predict(t, State(q, w), found)))(
            x.ts, part.attitude, part.omega
        )
        seen.append(_with_values(x, jax.lax.stop_gradient(values)))
    args = args._replace(observations=tuple(seen))
    one = jnp.ones((), ts.dtype)
    stage = Stage(0 * one, 2 * one, jnp.asarray(False), jnp.asarray(1))
    rows, _ = evaluation(options)(point, args, layout, stage)
    if not torque_free:  # which is followed forward only
        rows = nan_where(jnp.any(layout.start > first_and_last(ts, there)[0][:, None]), rows)
    return _Plan(options, args, point, rows, layout)


def _information(rows: Rows) -> Array:
    """Of the numbers and of each throw's state."""
    jg, jl = rows.of_numbers, rows.of_state
    throws, locals_ = jl.shape[0], jl.shape[-1]
    gg = product("tri,trj->ij", jg, jg)
    gl = product("tri,trl->itl", jg, jl).reshape(gg.shape[0], throws * locals_)
    ll = product("trk,trl->tkl", jl, jl)
    eye = jnp.eye(throws, dtype=jl.dtype)
    blocks = (eye[:, None, :, None] * ll[:, :, None, :]).reshape(2 * (throws * locals_,))
    return jnp.concatenate(
        [jnp.concatenate([gg, gl], axis=1), jnp.concatenate([gl.T, blocks], axis=1)]
    )


def _inverse(rows: Rows) -> Array:
    """Of the information, from the derivatives themselves: their squares lose digits."""
    jg, jl = rows.of_numbers, rows.of_state
    throws, count, locals_ = jl.shape
    eye = jnp.eye(throws, dtype=jl.dtype)
    apart = (eye[:, None, :, None] * jl[:, :, None, :]).reshape(throws * count, throws * locals_)
    jacobian = jnp.concatenate([jg.reshape(throws * count, -1), apart], axis=1)
    size = jnp.sqrt(jnp.sum(jacobian * jacobian, axis=0))
    size = jax.lax.stop_gradient(jnp.where(size > 0, size, 1.0))
    # Where nothing is told the last rows keep the bound finite, and very large.
    floor = 64 * jnp.finfo(jl.dtype).eps * jnp.eye(size.size, dtype=jl.dtype)
    _, r = jnp.linalg.qr(jnp.concatenate([jacobian / size[None, :], floor]))
    half = jax.scipy.linalg.solve_triangular(r, jnp.eye(size.size, dtype=jl.dtype))
    return product("ij,kj->ik", half, half) / size[:, None] / size[None, :]


def fisher_information(
    system: RigidBody,
    state: State,
    observations: Any,
    *,
    t0: Real[_ArrayLike, "*throws"] = 0.0,
    free: Any = None,
    nuisances: Sequence[str] | Mapping[str, Any] = (),
    scale: str = "trace",
    shape: str | LogCholesky = "tensor",
) -> Float[Array, "all all"]:
    """Fisher information of a planned record, about what `fit` would seek in it.

    Args:
        system: The body as it is thought to be.
        state: State at `t0`, of one throw, or with an axis of throws in front.
        observations: When and how well it will be observed, as for `fit`; values play no role and
            may be None.
        t0: Time of the state [s], or of that of each throw; under a torque not later than the first
            observation, or all is NaN.
        free: As for `fit`, and so on.
        nuisances: Errors of the gyro that will be sought too; with a prior, if given.
        scale: "trace", "known" or "rotor".
        shape: What is known of the tensor.

    Returns:
        The information about the numbers sought (the shape's, the scale's, leaves, nuisances) and
        the states at `t0` (rate, then, if it matters, a small turn, of each throw).

    Gradients: in the state, the times and the noise; in the tensor they are not to be relied on.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> plan = jr.identify.Rates(jnp.linspace(0.0, 20.0, 100), None, 0.01)
    >>> start = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.5, 1.0, 0.3]))
    >>> body = jr.RigidBody(jnp.array([1.0, 1.7, 2.3]))
    >>> print(jr.identify.fisher_information(body, start, plan).shape)
    (8, 8)
    """
    return _information(
        _planned(system, state, observations, t0, free, nuisances, scale, shape).rows
    )


def cramer_rao(
    system: RigidBody,
    state: State,
    observations: Any,
    *,
    t0: Real[_ArrayLike, "*throws"] = 0.0,
    free: Any = None,
    nuisances: Sequence[str] | Mapping[str, Any] = (),
    scale: str = "trace",
    shape: str | LogCholesky = "tensor",
) -> Bound:
    """The least errors that a planned record allows: the inverse of `fisher_information`.

    Args:
        system: As for `fisher_information`, and so on.
        state: State at `t0`.
        observations: The plan.
        t0: Time of the state [s].
        free: Leaves of the system.
        nuisances: Errors of the gyro.
        scale: "trace", "known" or "rotor".
        shape: What is known of the tensor.

    Returns:
        Covariances.

    Gradients: as `fisher_information`, where the record tells all that is sought: so a plan can be
    improved by descent.

    >>> import jax, jax.numpy as jnp, jrigid as jr
    >>> body = jr.RigidBody(jnp.array([1.0, 1.7, 2.3]))
    >>> def error(omega):
    ...     plan = jr.identify.Rates(jnp.linspace(0.0, 20.0, 100), None, 0.01)
    ...     start = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), omega)
    ...     return jr.identify.cramer_rao(body, start, plan).ratios_covariance[1, 1] ** 0.5
    >>> print(f"{jax.jit(error)(jnp.array([0.5, 1.0, 0.3])):.5f}")
    0.00378
    """
    plan = _planned(system, state, observations, t0, free, nuisances, scale, shape)
    covariance = _inverse(plan.rows)
    numbers, unknowns = plan.point.numbers, plan.args.unknowns

    def ratios(numbers: Array) -> Array:
        moments = jnp.linalg.eigvalsh(unknowns.inertia(numbers))
        return moments[1:] / moments[0]

    slopes = jax.jacfwd(ratios)(numbers)
    of_numbers = covariance[: numbers.size, : numbers.size]
    return Bound(covariance, slopes @ of_numbers @ slopes.T)


def identifiability(
    system: RigidBody,
    state: State,
    observations: Any,
    *,
    t0: Real[_ArrayLike, "*throws"] = 0.0,
    free: Any = None,
    nuisances: Sequence[str] | Mapping[str, Any] = (),
    scale: str = "trace",
    shape: str | LogCholesky = "tensor",
) -> FitResult:
    """What a planned record would tell: a `FitResult` before there is a record.

    Its errors are those of `cramer_rao`, its `status` says whether all that is sought is told, and
    `null_directions` what is not, in words.

    Args:
        system: As for `fisher_information`, and so on.
        state: State at `t0`.
        observations: The plan.
        t0: Time of the state [s].
        free: Leaves of the system.
        nuisances: Errors of the gyro.
        scale: "trace", "known" or "rotor".
        shape: What is known of the tensor.

    Returns:
        The result, of chi-square 0.

    Gradients: use `cramer_rao`.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> plan = jr.identify.Rates(jnp.linspace(0.0, 20.0, 100), None, 0.01)
    >>> start = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.5, 0.0, 1.0]))
    >>> top = jr.RigidBody(jnp.array([1.0, 1.0, 1.7]))
    >>> told = jr.identify.identifiability(top, start, plan, nuisances="gyro_scale")
    >>> print(told.null_directions)
    ('overall scale', 'I3/I1 against gyro scale')
    """
    plan = _planned(system, state, observations, t0, free, nuisances, scale, shape)
    seen = tuple(known(x).astype(plan.rows.residual.dtype) for x in plan.args.observations)
    return conclude(
        plan.options, plan.args._replace(weights=seen), plan.point, plan.rows, seen,
        jnp.asarray(True), jnp.full(1, jnp.nan), plan.layout, RESULTS.successful,
    )  # fmt: skip


def profile(
    result: FitResult, function: Callable[[Array], Array], values: Real[_ArrayLike, " n"]
) -> Float[Array, " n"]:
    """Profile likelihood: how chi-square grows as a function of the tensor is held at values.

    Errors that are not symmetric, and bounds that the quadratic form at the best fit misses, show
    here: the interval in which the growth is below 1 holds 68 %, that below 3.84 95 %.

    Args:
        result: A fit (not vmapped).
        function: Inertia tensor to scalar; define it once.
        values: What it is held at.

    Returns:
        Growth of chi-square, in units of the noise; NaN where no fit was found.

    Gradients: none to be relied on.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> record = jr.datasets.gyro_example()
    >>> readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
    >>> found = jr.identify.fit(jr.RigidBody(jnp.ones(3)), readings)
    >>> largest = lambda inertia: jnp.linalg.eigvalsh(inertia)[2] / jnp.trace(inertia)
    >>> best, error = found.moments[2] / 3, found.moments_covariance[2, 2] ** 0.5 / 3
    >>> print(jr.identify.profile(found, largest, best + error * jnp.array([-1.0, 0, 1])).round(1))
    [1. 0. 1.]
    """
    values = jnp.asarray(values, result.numbers.dtype)
    check_shape("values", values, (None,))
    return _profile(result, function, values)


@eqx.filter_jit
def _profile(result: FitResult, function: Callable[[Array], Array], values: Array) -> Array:
    args, options = result.problem, result.options
    slope = jax.grad(lambda x: function(result.unknowns.inertia(x)))(result.numbers)
    size = result.numbers.size
    error = jnp.sqrt(slope @ result.covariance[:size, :size] @ slope)
    ts, there = times_of(args.observations)
    layout = whole(ts, there, 1, result.t0)
    point = Point(result.numbers, result.state.attitude[:, None], result.state.omega[:, None])
    one = jnp.ones(1, ts.dtype)
    stages = Stage(0 * one, 2 * one, jnp.asarray([False]), jnp.asarray([100]))
    evaluate = evaluation(options._replace(shooting=False, nodes=1))

    noise = jnp.ones((), ts.dtype) if options.noise_known else result.reduced_chi_square

    def at(value: Array) -> Array:
        held = args.unknowns.holding(function, value, 1e-3 * error / jnp.sqrt(noise))
        _, rows, settled, *_ = levenberg_marquardt(
            evaluate, args._replace(unknowns=held), point, layout, stages,
            lambda _: ACCURACY * noise, jnp.asarray(0), jnp.zeros(1, ts.dtype),
        )  # fmt: skip
        return jnp.where(settled, (rows.cost - result.chi_square) / noise, jnp.nan)

    return jax.lax.map(at, values)


def residuals(
    system: RigidBody,
    state: State,
    observations: Any,
    *,
    t0: Real[_ArrayLike, "*throws"] = 0.0,
    adjoint: diffrax.AbstractAdjoint | None = None,
) -> Float[Array, "throws rows"]:
    """Whitened residuals of a motion, for a loss or an optimiser of one's own (optax, say).

    Args:
        system: The body.
        state: Its state at `t0`, of one throw, or with an axis of throws in front.
        observations: As for `fit`.
        t0: Time of the state [s], or of that of each throw: `found.t0` for that of a fit. Under a
            torque not later than the first sample.
        adjoint: For `jrigid.simulate`, if there is a torque.

    Returns:
        Predicted less observed, in units of the noise where that is stated; zero where nothing was
        seen.

    Raises:
        RuntimeError: What `free_rotation` or `simulate` raises.

    Gradients: those of the motion, in every mode that `free_rotation` or `simulate` has.

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
    stacked = of_throws(observations)
    ts, _ = times_of(stacked)
    throws = ts.shape[0]
    begin = jnp.broadcast_to(jnp.asarray(t0, ts.dtype), (throws,))
    attitude = jnp.broadcast_to(state.attitude, (throws, 4))
    omega = jnp.broadcast_to(state.omega, (throws, 3))
    torque_free = system.is_free

    def motion(q: Array, w: Array, times: Array, begin: Array) -> State:
        if torque_free:
            return free_rotation(system.inertia, State(q, w), times, t0=begin).states
        return in_any_order(
            lambda ts: simulate(system, State(q, w), ts, t0=begin, adjoint=adjoint).states,
            times,
        )

    states = jax.vmap(motion)(attitude, omega, ts, begin)
    blocks = []
    for x, part in by_kind(stacked, states):
        blocks.append(whitened(x, part, lambda w: w, system).reshape(throws, -1))
    return jnp.concatenate(blocks, axis=1)
