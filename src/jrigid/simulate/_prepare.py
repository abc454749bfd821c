"""Convert the arguments of `simulate` to a motion that can be integrated."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, ArrayLike

from jrigid._checks import RESULTS, AnyBool, Findings, array_of_shape, harmless
from jrigid._core.third_party import ClosedJaxpr, jaxpr_as_fun
from jrigid._motion_inputs import check_motion, depends_on, harmless_motion, resolves
from jrigid._stepping.control import Limits, largest_steps
from jrigid._stepping.derivatives import moved_in_a_step
from jrigid._stepping.motion import Motion, constant
from jrigid._stepping.scales import units
from jrigid._types import BodyState
from jrigid.simulate._options import SMALLEST_RTOL, Inputs, Options
from jrigid.solvers import Splitting
from jrigid.systems import AbstractSystem

# One step may commit this fraction of rtol. The fraction is smaller for methods of an
# order below 8, whose error estimates are as large as their errors.
_FRACTION = 0.5
_FRACTION_OF_LOWER_ORDERS = 0.03
# The error of the energy adds up over the turns, and the error of the phase adds up
# from that of the energy. Therefore the fraction falls with the radians of a long run.
# It is at most this number divided by the radians.
_RADIANS = 50.0
# Below this many eps of the state the error estimate is rounding noise.
_NOISE = 40.0
# No step is shorter than this many eps of the run.
_SHORTEST = 64.0
# The vector field is evaluated this many eps of the time beside a jump.
_BESIDE = 4.0
# Bits of the mantissa of the rate that bounds the steps.
_RATE_BITS = 16
# By rounding a run may take fewer steps than the smallest number, by this fraction.
_SAVED = 1e-2
_TOO_FEW_STEPS = (
    "The maximum number of solver steps is too small for the fastest rate at the start "
    "[rad/s] and the radians requested. (More turns cost no more by "
    "`jrigid.free_rotation` of a free body or `jrigid.top_motion`. A torque that jumps "
    "at the state, like `sign` of a rate of 0, needs `torques.CoulombFriction`. Else "
    "check the units, or pass a larger `max_steps`.)"
)


class Prepared(NamedTuple):
    """A motion ready to be integrated.

    Attributes:
        findings: Errors in the arguments.
        inputs: The arguments, harmless where they are invalid.
        motion: The motion as arrays. Its parameters and times are those of the
            arguments, so that lanes share what they share there. Its fastest rate is
            zero where an argument is invalid.
        field: Vector field of (parameters, t, y).
        parameters: Those of the field, harmless where an argument is invalid.
        times: The output times, all zero where an argument is invalid.
        to_state: Converts an array to a state.
        omega: Where in the array the angular velocity starts.
        start: Time of the start, in the precision of the state.
        fastest: Fastest rate at the start [rad/s].
    """

    findings: Findings
    inputs: Inputs
    motion: Motion
    field: Callable[[list[Array], Array, Array], Array]
    parameters: list[Array]
    times: Array
    to_state: Callable[[Array], BodyState]
    omega: int
    start: Array
    fastest: Array

    @property
    def harmless_motion(self) -> Motion:
        """The motion, with harmless parameters and times for invalid arguments."""
        limits = self.motion.limits._replace(end=jax.lax.stop_gradient(self.times[-1]))
        return self.motion._replace(
            parameters=self.parameters, times=self.times, limits=limits
        )


def judged(inputs: Inputs, options: Options) -> tuple[Findings, Limits, Array]:
    """Check the values of the arguments; bound the steps, and choose scales."""
    inputs = constant(inputs)
    system, state0, _, t0, args, _ = inputs
    findings = Findings()
    since_start = inputs.since_start
    _check_values_of_options(findings, options, since_start.dtype)
    _check_times(findings, inputs, since_start)
    start = t0.astype(since_start.dtype)
    check_motion(findings, system, state0, start, args)
    fastest, scales = jax.lax.stop_gradient(
        units(system, state0, since_start[-1], start, args, options.fastest_of)
    )
    # Compiled code rounds differently in different lanes, which must take equal steps.
    bits = jnp.finfo(fastest.dtype).nexp
    fastest = jax.lax.reduce_precision(fastest, bits, _RATE_BITS)
    seen = t0
    if t0.dtype != start.dtype and _depends_on_time(inputs, start):
        # Torques are given times in the precision of the state.
        seen = start
    findings.require(resolves(seen, fastest), RESULTS.unresolved_times, value=t0)
    limits = limits_of(since_start[-1], fastest, options)
    if options.is_worth_foreseeing:
        require_enough_steps(findings, _can_be_enough(limits, options), limits)
    findings.compute_once()
    return findings, limits, scales


def with_derivatives_of_start(inputs: Inputs) -> Inputs:
    """The same motion, whose derivatives in `t0` are in its initial state alone.

    Times of a motion count from its start. Thus an earlier start would move all jumps
    of the torque along, and derivatives do not see jumps move. Therefore the time of
    the start is fixed, and the state there is that after a step of length zero from
    `t0` to this time. Its derivatives in `t0` are those of the motion, up to the order
    of the method.
    """
    held = jax.lax.stop_gradient(inputs.t0)
    start, to_state = ravel_pytree(inputs.state0)

    def rates(inputs: Inputs, t: Array, y: Array) -> Array:
        return _rates(inputs, t, to_state(y))

    length = (held - inputs.t0).astype(start.dtype)
    t = inputs.t0.astype(start.dtype)
    moved = moved_in_a_step(rates, inputs, t, start, length)
    return inputs._replace(state0=to_state(moved), t0=held)


def _rates(inputs: Inputs, t: Array, state: BodyState) -> Array:
    """The vector field as one array."""
    return ravel_pytree(inputs.system.vector_field(t, state, inputs.args))[0]


def _depends_on_time(inputs: Inputs, start: Array) -> bool:
    """Whether a torque or a force is a function of time."""
    return depends_on(lambda t: _rates(inputs, t, inputs.state0), start)


def _check_values_of_options(
    findings: Findings, options: Options, dtype: np.dtype
) -> None:
    """Note a tolerance or a longest step out of range."""
    smallest = SMALLEST_RTOL[dtype.itemsize]
    for x in (options.rtol, options.atol):
        ok = (x >= smallest) & (x < 1)
        findings.require(ok, RESULTS.invalid_tolerance, value=x)
    positive = options.max_step > 0
    findings.require(positive, RESULTS.invalid_max_step, value=options.max_step)


def _check_times(findings: Findings, inputs: Inputs, since_start: Array) -> None:
    """Note times that are not finite, decrease, or are before the start."""
    flat = inputs.ts.reshape(-1)
    before = jnp.concatenate([inputs.t0[None], flat[:-1]])
    # Every comparison with NaN is false, so that this form finds NaN too.
    wrong = ~jnp.isfinite(since_start) | ~(flat >= before)
    value = flat[jnp.argmax(wrong)]
    findings.require(~jnp.any(wrong), RESULTS.invalid_times, value=value)
    # Infinite jumps are padding.
    known = ~jnp.any(jnp.isnan(inputs.jumps))
    message = "Argument `jumps` must hold times, but one is NaN."
    findings.require(known, RESULTS.invalid_times, message)


def require_enough_steps(findings: Findings, ok: AnyBool, limits: Limits) -> None:
    """Note, unless `ok`, that a motion needs more steps; shows its rate and radians."""
    value = jnp.stack([limits.start_rate, limits.start_rate * limits.end])
    findings.require(ok, RESULTS.max_steps_reached, _TOO_FEW_STEPS, value)


def _can_be_enough(limits: Limits, options: Options) -> Array:
    """Whether the largest number of steps can reach the end of a motion.

    No step is longer than the longest at the start, even if the rate falls.
    """
    longest = (
        options.max_step if isinstance(options.solver, Splitting) else limits.longest
    )
    # The result is True for NaN, which other findings report.
    return ~((1 - _SAVED) * limits.end > options.max_steps * longest)


def opened(
    function: Callable[..., Array], *example: Array
) -> tuple[Callable, list[Array]]:
    """Convert the arrays that a function closes over to its first argument.

    Returns:
        The function of these arrays and its own arguments, and the arrays.
    """
    closed = jax.make_jaxpr(function)(*example)

    def of(consts: list[Array], *arguments: Array) -> Array:
        (result,) = jaxpr_as_fun(ClosedJaxpr(closed.jaxpr, consts))(*arguments)
        return result

    return of, [jnp.asarray(x) for x in closed.consts]


def prepared(inputs: Inputs, options: Options) -> Prepared:
    """The motion, ready to be integrated."""
    findings, limits, scales = judged(inputs, options)
    usable = harmless_motion(findings.ok, inputs)
    y0, to_state = ravel_pytree(usable.state0)
    times = jnp.where(findings.ok, inputs.since_start, 0.0)
    start = usable.t0.astype(y0.dtype)

    # With `usable`, which depends on the findings, lanes could not share parameters.
    def rates(t: Array, y: Array) -> Array:
        return _rates(inputs, inputs.t0.astype(y0.dtype) + t, to_state(y))

    field, parameters = opened(rates, times[-1], y0)
    end = jax.lax.stop_gradient(times[-1])
    jumps = jax.lax.stop_gradient(inputs.jumps_since_start)
    motion = Motion(
        parameters=parameters,
        observed=[],
        y0=y0,
        times=inputs.since_start,
        jumps=jumps,
        beside=_beside(jumps, jax.lax.stop_gradient(start), end),
        scales=scales,
        limits=limits._replace(
            start_rate=jnp.where(findings.ok, limits.start_rate, 0.0)
        ),
    )
    return Prepared(
        findings=findings,
        inputs=usable,
        motion=motion,
        field=field,
        # Functions of a user may close over invalid values, too.
        parameters=harmless(findings.ok, parameters),
        times=times,
        to_state=to_state,
        omega=_place_of_omega(usable.state0),
        start=start,
        fastest=limits.start_rate,
    )


def _beside(jumps: Array, start: Array, end: Array) -> Array:
    """Distance from each jump at which the torque is evaluated, to be past the jump.

    A torque receives rounded times, so the distance is a few eps of the time. For a
    jump at time 0 this would be zero. Therefore as many eps of a gap between jumps are
    added, the shorter one of those before and after.

    Args:
        jumps: Times since the start, in order; infinite ones count as none.
        start: Time of the start.
        end: Time of the end since the start.
    """
    times = jnp.where(jnp.isfinite(jumps), jumps, end)
    around = jnp.concatenate([jnp.zeros_like(end)[None], times, end[None]])
    gaps = jnp.abs(jnp.diff(around))
    gaps = jnp.where(gaps > 0, gaps, jnp.inf)
    shorter = jnp.minimum(gaps[:-1], gaps[1:])
    shorter = jnp.where(jnp.isfinite(shorter), shorter, 0.0)
    eps = jnp.finfo(jumps.dtype).eps
    return _BESIDE * eps * (jnp.abs(start) + jnp.abs(times) + shorter)


def _place_of_omega(state: BodyState) -> int:
    """Index of the angular velocity in a state that is flattened to an array."""
    before = 0
    for name, part in vars(state).items():
        if name == "omega":
            break
        before += sum(x.size for x in jax.tree_util.tree_leaves(part))
    return before


def jumps_of(system: AbstractSystem, jumps: ArrayLike | None, dtype: np.dtype) -> Array:
    """Times at which the vector field is not smooth: the user's and the system's."""
    own = array_of_shape("jumps", system.jumps, None)
    if jumps is None:
        return own.astype(dtype)
    given = array_of_shape("jumps", jumps, None)
    return jnp.concatenate([given.astype(dtype), own.astype(dtype)])


def limits_of(end: Array, fastest: Array, options: Options) -> Limits:
    """Bounds of the steps of a motion."""
    eps = jnp.finfo(end.dtype).eps
    order = options.solver.order(None)
    high = order is None or order >= 8
    fraction = _FRACTION if high else _FRACTION_OF_LOWER_ORDERS
    radians = end * fastest
    share = jnp.minimum(fraction, _RADIANS / jnp.maximum(radians, _RADIANS))
    tolerances = jnp.stack([options.rtol, options.atol])
    rtol, atol = jnp.maximum(share * tolerances, _NOISE * eps)
    # `ExactFree` has no order. The bounds of order 8 serve it.
    span, fine = largest_steps(order or 8, share * options.rtol)
    # The rate at the start does not bound an implicit solver, which may step over it.
    longest = jnp.inf if options.is_implicit else span / fastest
    return Limits(
        end=end,
        rtol=rtol,
        atol=atol,
        radians=span,
        fine=fine,
        whole=span,
        longest=jnp.minimum(longest, options.max_step),
        shortest=_SHORTEST * eps * end,
        start_rate=fastest,
    )
