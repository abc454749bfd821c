"""Ways to try a step of a motion: with error control, or with a given length."""

from collections.abc import Callable
from typing import NamedTuple, Protocol, TypeVar

import diffrax
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jrigid._stepping.control import Verdict, in_tolerances, judge
from jrigid._stepping.method import Method
from jrigid._stepping.motion import Motion, Progress, fastest_rate
from jrigid._stepping.scales import rate_along
from jrigid._stepping.step import apart, error_of, pull_back, stages

#: A vector field, of (parameters, t, y).
Field = Callable[[list[Array], Array, Array], Array]

#: A pytree of arrays from which the parameters of a motion are made.
Tree = TypeVar("Tree")

# A remainder of this fraction of a step, perhaps from rounding, does not make one more
# equal step.
_RAGGED = 1e-3


class Trial(NamedTuple):
    """The result of a step that was tried.

    Attributes:
        y1: The state at its end.
        direction: Of a small displacement, which finds the fastest rate.
        verdict: Whether the step is accepted, and the length of the next one.
        infinite: Whether a rate is not finite.
        rates: Of its stages, or of the last one alone.
    """

    y1: Float[Array, " n"]
    direction: Float[Array, " n"]
    verdict: Verdict
    infinite: Bool[Array, ""]
    rates: Float[Array, "stages n"]


class Stretch(NamedTuple):
    """A step that was taken: its start and its end, and the rates of its stages."""

    t0: Float[Array, ""]
    t1: Float[Array, ""]
    y0: Float[Array, " n"]
    y1: Float[Array, " n"]
    rates: Float[Array, "stages n"]


class Stepper(Protocol):
    """Tries a step. `parameters` are those of the motion."""

    @property
    def first(self) -> float:
        """Length of the first step, as a part of the longest."""
        ...

    def end(self, t: Array, step: Array, goal: Array) -> Float[Array, ""]:
        """Time at which a step of about this length ends, on the way to a goal."""
        ...

    def attempt(
        self,
        field: Field,
        motion: Motion,
        progress: Progress,
        t1: Array,
        in_lanes: bool,
        keeps_rates: bool,
    ) -> Trial:
        """The result of a step to a time, and whether it is accepted.

        With `keeps_rates` the result has the rates of all stages.
        """
        ...

    def state_at(
        self, parameters: list[Array], step: Stretch, t: Array
    ) -> Float[Array, " n"]:
        """The state within a step."""
        ...

    def taken(
        self, field: Field, parameters: list[Array], t: Array, h: Array, y: Array
    ) -> Float[Array, " n"]:
        """The state after a step, with derivatives of every mode and order."""
        ...

    def pull_back(
        self,
        field: Field,
        complete: Callable[[Tree], list[Array]],
        varied: Tree,
        step: tuple[Array, Array, Array],
        rates: Array,
        change: Array,
        in_lanes: bool,
    ) -> tuple[Tree, Float[Array, " n"]]:
        """Cotangents of `varied` and of the start of a step, from that of its result.

        Args:
            field: The vector field.
            complete: Returns the parameters of the motion from `varied`.
            varied: The arrays whose cotangents are needed.
            step: Start, length, and state at the start.
            rates: Of its stages.
            change: Cotangent of its result.
            in_lanes: Whether there are many lanes.
        """
        ...


class ErrorControlled(NamedTuple):
    """Steps of an explicit Runge-Kutta method, as long as their error allows.

    Attributes:
        method: The method.
        interpolation: Its dense output.
        omega: Where in the state the angular velocity starts.
    """

    method: Method
    interpolation: Callable[..., diffrax.AbstractLocalInterpolation]
    omega: int

    @property
    def first(self) -> float:
        """The first step is short: the next ones grow as their errors allow."""
        return 0.3

    def end(self, t: Array, step: Array, goal: Array) -> Float[Array, ""]:
        """The end of the step, or the goal if the step ends just before it."""
        # Otherwise a step of a few roundings may be left before the goal.
        near = t + step > goal * (1 - 100 * jnp.finfo(t.dtype).eps)
        return jnp.where(near, goal, t + step)

    def attempt(
        self,
        field: Field,
        motion: Motion,
        progress: Progress,
        t1: Array,
        in_lanes: bool,
        keeps_rates: bool,
    ) -> Trial:
        """The result, judged by its error and by the fastest rate at its end."""
        y, direction, (t, step, rate0, _), counts, _ = progress
        limits = motion.limits

        def rates_at(t: Array, y: Array) -> Array:
            return field(motion.parameters, t, y)

        def fixed_rates_at_end(y: Array) -> Array:
            return jax.lax.stop_gradient(rates_at(t1, y))

        def step_to(h: Array, y: Array) -> tuple[Array, ...]:
            rates, y1 = stages(self.method, rates_at, t, h, y, in_lanes)
            # The fastest rate is found from the rate at the end alone.
            returned = rates if keeps_rates else rates[-1]
            return y1, error_of(self.method, rates, h), returned

        h = t1 - t
        if in_lanes:
            y1, estimate, rates = step_to(h, y)
        else:
            # A number of steps is never negative, so that the branch is always taken.
            y1, estimate, rates = apart(step_to, counts[1] >= 0, h, y)
        rates = rates.reshape(-1, y.size)
        # The choice of steps is not differentiated.
        before, after, estimate, base = jax.lax.stop_gradient(
            (y, y1, estimate, rates[-1])
        )
        error = in_tolerances(limits, motion.scales, before, after, estimate)
        fastest, along = rate_along(
            fixed_rates_at_end, after, base, direction, motion.scales
        )
        rate1 = fastest_rate(motion.scales, self.omega, after, fastest)
        verdict = judge(limits, self.method.order, step, h, error, rate0, rate1)
        # `in_tolerances` makes infinity of an error that is NaN.
        return Trial(y1, along, verdict, ~(error < jnp.inf), rates)

    def state_at(
        self, parameters: list[Array], step: Stretch, t: Array
    ) -> Float[Array, " n"]:
        """The state within a step, by the dense output of the method."""
        del parameters
        # A stage that `method_of` adds is not part of the solver's dense output.
        increments = (step.t1 - step.t0) * step.rates[: self.method.own]
        curve = self.interpolation(
            t0=step.t0, t1=step.t1, y0=step.y0, y1=step.y1, k=increments
        )
        return curve.evaluate(t)

    def taken(
        self, field: Field, parameters: list[Array], t: Array, h: Array, y: Array
    ) -> Float[Array, " n"]:
        """The state after a step."""
        return stages(self.method, lambda t, y: field(parameters, t, y), t, h, y)[1]

    def pull_back(
        self,
        field: Field,
        complete: Callable[[Tree], list[Array]],
        varied: Tree,
        step: tuple[Array, Array, Array],
        rates: Array,
        change: Array,
        in_lanes: bool,
    ) -> tuple[Tree, Float[Array, " n"]]:
        """The reverse of a step, which is another Runge-Kutta step."""

        def of_varied(varied: Tree, t: Array, y: Array) -> Array:
            return field(complete(varied), t, y)

        return pull_back(self.method, of_varied, varied, step, rates, change, in_lanes)


class EqualSteps(NamedTuple):
    """Steps of equal length between two output times, which are always accepted.

    Attributes:
        advance: The state after a step, of (parameters, t, h, y).
    """

    advance: Callable[[list[Array], Array, Array, Array], Array]

    @property
    def first(self) -> float:
        """All steps are as long as they may be."""
        return 1.0

    def end(self, t: Array, step: Array, goal: Array) -> Float[Array, ""]:
        """The end of the first of the equal steps that reach the goal."""
        count = jnp.ceil((goal - t) / step - _RAGGED)
        # The last of the steps ends at the goal itself, without rounding.
        return jnp.where(count <= 1, goal, t + (goal - t) / jnp.maximum(count, 1))

    def attempt(
        self,
        field: Field,
        motion: Motion,
        progress: Progress,
        t1: Array,
        in_lanes: bool,
        keeps_rates: bool,
    ) -> Trial:
        """The result, which is accepted."""
        del field, in_lanes, keeps_rates
        y, direction, (t, step, rate, _), _, _ = progress
        y1 = self.advance(motion.parameters, t, t1 - t, y)
        yes = jnp.array(True)
        no = jnp.array(False)
        # Neither `state_at` nor `pull_back` uses rates of stages.
        none = jnp.zeros((0, *y.shape), y.dtype)
        return Trial(y1, direction, Verdict(yes, no, step, rate), no, none)

    def state_at(
        self, parameters: list[Array], step: Stretch, t: Array
    ) -> Float[Array, " n"]:
        """The state within a step, by a shorter one."""
        return self.advance(parameters, step.t0, t - step.t0, step.y0)

    def taken(
        self, field: Field, parameters: list[Array], t: Array, h: Array, y: Array
    ) -> Float[Array, " n"]:
        """The state after a step."""
        del field
        return self.advance(parameters, t, h, y)

    def pull_back(
        self,
        field: Field,
        complete: Callable[[Tree], list[Array]],
        varied: Tree,
        step: tuple[Array, Array, Array],
        rates: Array,
        change: Array,
        in_lanes: bool,
    ) -> tuple[Tree, Float[Array, " n"]]:
        """The reverse of a step, by automatic differentiation."""
        del field, rates, in_lanes
        t, h, y = step

        def after(varied: Tree, y: Array) -> Array:
            return self.advance(complete(varied), t, h, y)

        return jax.vjp(after, varied, y)[1](change)
