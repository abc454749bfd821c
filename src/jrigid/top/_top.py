"""The symmetric top: its three numbers, where they come from, and their checks."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.tree_util as jtu
from jaxtyping import Array, Float

from jrigid._checks import (
    RESULTS,
    Findings,
    all_finite,
    array_of_shape,
    check_shape,
    float_arrays,
    is_unit,
    pair_of_shapes,
)
from jrigid._types import ScalarLike, VectorLike
from jrigid.dynamics import State
from jrigid.mass import MassProperties
from jrigid.systems import RigidBody
from jrigid.torques import UniformGravity

_SYMMETRIC = (
    "Arguments `body` and `lever` must describe a top symmetric about body axis 3, with the centre "
    "of mass on that axis, under a finite gravity, but they do not: for any other body use "
    "`RigidBody` with `torques.UniformGravity`."
)
_BAD_TOP = "Argument `top` must have I1 > 0, I3 > 0 and a finite mgl, but it does not."


class SymmetricTop(eqx.Module):
    """A heavy top, symmetric about body axis 3, with a fixed point on that axis (Lagrange's top).

    Gravity pulls along -z in space.

    Attributes:
        I1: Moment about a transverse axis through the fixed point [kg m^2].
        I3: Moment about the axis [kg m^2].
        mgl: Weight times the distance of the centre of mass from the fixed point along axis 3
            [N m]; negative where the centre of mass is on the negative side, or gravity pulls up.

    Raises:
        ValueError: Not scalars (trace time). Values are checked where the top is used.

    For many tops `jax.vmap` over the numbers, or over a top whose leaves have a leading axis.

    >>> import jrigid as jr
    >>> top = jr.SymmetricTop(I1=2e-3, I3=1e-3, mgl=0.2)
    >>> print(jr.top.sleeping_spin(top).round(6))
    40.0
    """

    I1: Float[Array, ""] = eqx.field(converter=lambda x: _scalar("I1", x))
    I3: Float[Array, ""] = eqx.field(converter=lambda x: _scalar("I3", x))
    mgl: Float[Array, ""] = eqx.field(converter=lambda x: _scalar("mgl", x))

    @classmethod
    def from_mass_properties(
        cls,
        body: MassProperties,
        lever: VectorLike,
        gravity: ScalarLike = 9.80665,
        *,
        throw: bool = True,
    ) -> "SymmetricTop":
        """The top that a body makes when one of its points is held.

        Args:
            body: Mass properties, about the centre of mass.
            lever: From the fixed point to the centre of mass, body components [m].
            gravity: Acceleration of gravity [m/s^2].
            throw: False: bad values give NaN instead of an error.

        Returns:
            The top, its moments about the fixed point (parallel axes).

        Raises:
            ValueError: Wrong shape (trace time).
            RuntimeError: A body that is not symmetric about axis 3, or a lever off that axis (run
                time, any lane).

        Gradients: linear in mass and moments, quadratic in the lever.

        >>> import jax.numpy as jnp, jrigid as jr
        >>> cone = jr.solids.cone(0.5, 0.03, 0.08)
        >>> top = jr.SymmetricTop.from_mass_properties(cone, jnp.array([0.0, 0.0, 0.06]))
        >>> print(top.I1.round(7), top.mgl.round(4))
        0.0019875 0.2942
        """
        lever, gravity = pair_of_shapes("lever", lever, (3,), "gravity", gravity, ())
        if not isinstance(body, MassProperties):
            raise ValueError(
                f"Argument `body` must be MassProperties, but it is {type(body).__name__}."
            )
        about = body.about(body.center_of_mass - lever)
        tensor = jax.lax.stop_gradient(about)
        size = jnp.max(jnp.abs(tensor))
        off = jnp.stack([tensor[0, 0] - tensor[1, 1], tensor[0, 1], tensor[0, 2], tensor[1, 2]])
        tolerance = jnp.sqrt(jnp.finfo(tensor.dtype).eps)
        findings = Findings()
        findings.require(
            jnp.isfinite(gravity)
            & jnp.all(jnp.abs(off) <= tolerance * size)
            & jnp.all(jnp.abs(lever[:2]) <= tolerance * jnp.max(jnp.abs(lever))),
            RESULTS.invalid_inertia,
            _SYMMETRIC,
        )
        top = cls(0.5 * (about[0, 0] + about[1, 1]), about[2, 2], body.mass * gravity * lever[2])
        nan = jtu.tree_map(lambda x: jnp.where(findings.ok, x, jnp.nan), top)
        return findings.apply(nan, throw)

    def as_rigid_body(self) -> RigidBody:
        """The same top for `jrigid.simulate`: a `RigidBody` under `UniformGravity`.

        >>> import jax.numpy as jnp, jrigid as jr
        >>> body = jr.SymmetricTop(1.0, 0.5, 2.0).as_rigid_body()
        >>> print(body.inertia, body.torque.lever)
        [1.  1.  0.5] [0. 0. 2.]
        """
        zero = jnp.zeros_like(self.mgl)
        gravity = UniformGravity(
            1.0, jnp.stack([zero, zero, self.mgl]), jnp.array([0.0, 0.0, -1.0])
        )
        return RigidBody(jnp.stack([self.I1, self.I1, self.I3]), gravity)


def _scalar(name: str, value: Any) -> Any:
    return None if value is None else array_of_shape(name, value)  # None: an axis of vmap


def require_top(findings: Findings, top: SymmetricTop) -> None:
    """Note moments that are not positive and what is not finite."""
    moments = jnp.stack([top.I1, top.I3])
    good = all_finite(top) & jnp.all(moments > 0)
    findings.require(good, RESULTS.invalid_inertia, _BAD_TOP)


def as_arrays(top: Any, *others: Any) -> tuple[Array, ...]:
    """I1, I3, mgl and scalars, of one dtype; ValueError if they are not."""
    if not isinstance(top, SymmetricTop):
        raise ValueError(f"Argument `top` must be a SymmetricTop, but it is {type(top).__name__}.")
    return float_arrays(top.I1, top.I3, top.mgl, *others)


def checked(top: Any, state: Any, throw: bool) -> tuple[Findings, SymmetricTop, State]:
    """Top and state of one dtype, harmless where they are bad."""
    findings, top, state, _ = checked_with(top, state)
    return findings, *findings.apply((top, state), throw)


def checked_with(
    top: Any, state: Any, *others: Any
) -> tuple[Findings, SymmetricTop, State, tuple[Array, ...]]:
    """Top, state and more arrays of one dtype, harmless where top or state are bad."""
    if not isinstance(state, State):
        raise ValueError(f"Argument `state` must be a State, but it is {type(state).__name__}.")
    if jtu.tree_leaves(state.internal):
        raise ValueError(
            "Argument `state.internal` must be empty, but it is not: a top with moving parts is "
            "not Lagrange's; use `jrigid.simulate`."
        )
    arrays = as_arrays(top, state.attitude, state.omega, *others)
    (i1, i3, mgl, attitude, omega), others = arrays[:5], arrays[5:]
    check_shape("state.attitude", attitude, (4,))
    check_shape("state.omega", omega, (3,))
    if i1.dtype not in (jnp.float32, jnp.float64):
        raise ValueError(f"Arguments must be float32 or float64, but they are {i1.dtype}.")
    top, state = SymmetricTop(i1, i3, mgl), State(attitude, omega)
    findings = Findings()
    require_top(findings, top)
    findings.require(all_finite(state), RESULTS.invalid_state)
    findings.require(is_unit(attitude), RESULTS.invalid_attitude)
    findings.require(all_finite(others), RESULTS.invalid_times)
    ok = findings.ok
    # A bad lane does something harmless: no NaN reaches the derivatives of what lanes share.
    harmless = (
        SymmetricTop(*jnp.ones((3,), i1.dtype)),
        State(jnp.zeros(4, i1.dtype).at[0].set(1), jnp.zeros(3, i1.dtype)),
    )
    top, state, others = jtu.tree_map(
        lambda x, y: jnp.where(ok, x, y),
        (top, state, others),
        (*harmless, tuple(jnp.zeros_like(x) for x in others)),
    )
    return findings, top, state, others
