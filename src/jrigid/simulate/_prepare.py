"""From the arguments of `simulate` to a motion that can be integrated."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array

from jrigid._checks import RESULTS, Findings, array_of_shape, harmless
from jrigid._core.third_party import ClosedJaxpr, jaxpr_as_fun
from jrigid._motion import check_motion, harmless_motion, resolves
from jrigid._stepping.control import Limits, largest_steps
from jrigid._stepping.motion import Motion, constant
from jrigid._stepping.scales import units
from jrigid.simulate._options import SMALLEST_RTOL, Inputs, Options
from jrigid.solvers import Splitting
from jrigid.systems import AbstractSystem

# One step may commit this fraction of rtol, less with methods of lower order than 8,
# whose estimates are as large as their errors.
_FRACTION, _FRACTION_OF_LOWER_ORDERS = 0.5, 0.03
# The error of the energy adds up over the turns, and that of the phase over the
# energy's: in a long run one step may commit no more than so much of rtol for each
# radian.
_RADIANS = 50.0
# Below this many eps of the state the error estimate is rounding noise.
_NOISE = 40.0
# No step is shorter than this many eps of the run.
_SHORTEST = 64.0
# The vector field is evaluated so many eps of the time beside a jump.
_BESIDE = 4.0
_RATE_BITS = 16  # of the rate that bounds the steps
# By rounding a run may take fewer steps than the fewest it needs, by this fraction.
_SAVED = 1e-2
_TOO_FEW_STEPS = (
    "The maximum number of solver steps is too small for the fastest rate at the start [rad/s] "
    "and the radians requested. (Closed forms cost no more for more turns: `jrigid.free_rotation` "
    "of a free body, `jrigid.top_motion` of a symmetric top. Else check the units, shorten `ts` or "
    "pass a larger `max_steps`.)"
)


class Prepared(NamedTuple):
    """A motion ready to be integrated.

    Attributes:
        findings: What is wrong with the arguments.
        inputs: The arguments, harmless where they are wrong.
        motion: In numbers, its parameters and times as they were given: what lanes
            share stays shared. Where an argument is wrong its fastest rate is zero.
        field: Vector field of (parameters, t, y).
        parameters: Those of the field, harmless where an argument is wrong.
        times: The output times, all zero where an argument is wrong.
        to_state: The state of an array.
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
    to_state: Callable[[Array], Any]
    omega: int
    start: Array
    fastest: Array

    @property
    def harmless_motion(self) -> Motion:
        """The motion with parameters and times of each lane, harmless where one is wrong."""
        limits = self.motion.limits._replace(end=jax.lax.stop_gradient(self.times[-1]))
        return self.motion._replace(
            parameters=self.parameters, times=self.times, limits=limits
        )


def judged(inputs: Inputs, options: Options) -> tuple[Findings, Limits, Array]:
    """Every invalid value among the arguments; what holds the steps, and scales."""
    inputs = constant(inputs)
    system, state0, ts, t0, args, _ = inputs
    findings, flat, since_start = Findings(), ts.reshape(-1), inputs.since_start
    smallest = SMALLEST_RTOL[since_start.dtype.itemsize]
    for x in (options.rtol, options.atol):
        ok = (x >= smallest) & (x < 1)
        findings.require(ok, RESULTS.invalid_tolerance, value=x)
    positive = options.max_step > 0
    findings.require(positive, RESULTS.invalid_max_step, value=options.max_step)
    before = jnp.concatenate([t0[None], flat[:-1]])
    wrong = ~jnp.isfinite(since_start) | ~(flat >= before)
    value = flat[jnp.argmax(wrong)]
    findings.require(~jnp.any(wrong), RESULTS.invalid_times, value=value)
    start = t0.astype(since_start.dtype)
    check_motion(findings, system, state0, start, args)
    fastest, scales = jax.lax.stop_gradient(
        units(system, state0, since_start[-1], start, args, options.fastest_of)
    )
    # A compiler rounds differently in different lanes; their steps are to be the same.
    bits = jnp.finfo(fastest.dtype).nexp
    fastest = jax.lax.reduce_precision(fastest, bits, _RATE_BITS)
    findings.require(resolves(t0, fastest), RESULTS.unresolved_times, value=t0)
    limits = limits_of(since_start[-1], fastest, options)
    if options.is_worth_foreseeing:
        require_enough_steps(findings, _can_be_enough(limits, options), limits)
    return findings, limits, scales


def require_enough_steps(findings: Findings, ok: Array, limits: Limits) -> None:
    """Note that the steps are too few for a motion, with its fastest rate and its radians."""
    value = jnp.stack([limits.start_rate, limits.start_rate * limits.end])
    findings.require(ok, RESULTS.max_steps_reached, _TOO_FEW_STEPS, value)


def _can_be_enough(limits: Limits, options: Options) -> Array:
    """Whether the largest number of steps can lead to the end of a motion.

    No step is longer than the longest at the start, even where the rate falls.
    """
    longest = (
        options.max_step if isinstance(options.solver, Splitting) else limits.longest
    )
    return ~((1 - _SAVED) * limits.end > options.max_steps * longest)


def opened(
    function: Callable[..., Array], *example: Array
) -> tuple[Callable, list[Array]]:
    """A function with the arrays that it closes over as a first argument, and these."""
    closed = jax.make_jaxpr(function)(*example)

    def of(consts: list[Array], *arguments: Array) -> Array:
        (result,) = jaxpr_as_fun(ClosedJaxpr(closed.jaxpr, consts))(*arguments)
        return result

    return of, [jnp.asarray(x) for x in closed.consts]


def prepared(inputs: Inputs, options: Options) -> Prepared:
    """The motion that the arguments ask for."""
    findings, limits, scales = judged(inputs, options)
    usable = harmless_motion(findings.ok, inputs)
    y0, to_state = ravel_pytree(usable.state0)
    times = jnp.where(findings.ok, inputs.since_start, 0.0)
    start = usable.t0.astype(y0.dtype)

    def rates(t: Array, y: Array) -> Array:
        since_zero = inputs.t0.astype(y0.dtype) + t
        rates = inputs.system.vector_field(since_zero, to_state(y), inputs.args)
        return ravel_pytree(rates)[0]

    field, parameters = opened(rates, times[-1], y0)
    end = jax.lax.stop_gradient(times[-1])
    jumps = jax.lax.stop_gradient(inputs.jumps_since_start)
    beside = _BESIDE * jnp.finfo(end.dtype).eps * (jnp.abs(start) + end)
    motion = Motion(
        parameters=parameters,
        observed=[],
        y0=y0,
        times=inputs.since_start,
        jumps=jumps,
        beside=jnp.full_like(jumps, beside),
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
        # Functions of a user may close over bad values, too.
        parameters=harmless(findings.ok, parameters),
        times=times,
        to_state=to_state,
        omega=_place_of_omega(usable.state0),
        start=start,
        fastest=limits.start_rate,
    )


def _place_of_omega(state: Any) -> int:
    """Where the angular velocity starts in a state as one array."""
    before = 0
    for name, part in vars(state).items():
        if name == "omega":
            break
        before += sum(x.size for x in jax.tree_util.tree_leaves(part))
    return before


def jumps_of(system: AbstractSystem, jumps: Any, dtype: Any) -> Array:
    """Times at which the vector field is not smooth: those given and the system's."""
    own = array_of_shape("jumps", system.jumps, None)
    if jumps is None:
        return own.astype(dtype)
    given = array_of_shape("jumps", jumps, None)
    return jnp.concatenate([given.astype(dtype), own.astype(dtype)])


def limits_of(end: Array, fastest: Array, options: Options) -> Limits:
    """What holds the steps of a motion."""
    eps = jnp.finfo(end.dtype).eps
    order = options.solver.order(None)
    high = order is None or order >= 8
    fraction = _FRACTION if high else _FRACTION_OF_LOWER_ORDERS
    radians = end * fastest
    share = jnp.minimum(fraction, _RADIANS / jnp.maximum(radians, _RADIANS))
    asked = jnp.stack([options.rtol, options.atol])
    rtol, atol = jnp.maximum(share * asked, _NOISE * eps)
    span, fine = largest_steps(order or 8, share * options.rtol)
    # What an implicit solver steps over bounds it only where it is on the way.
    longest = jnp.inf if options.is_implicit else span / fastest
    return Limits(
        end=end,
        rtol=rtol,
        atol=atol,
        radians=span,
        fine=fine,
        longest=jnp.minimum(longest, options.max_step),
        shortest=_SHORTEST * eps * end,
        start_rate=fastest,
    )
