"""The brightness of a body in a state, and of a free body as it turns."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from jrigid._checks import RESULTS, demand, is_concrete, nan_where, shaped
from jrigid._core.compile import quick_jit
from jrigid._numerics import product, safe_arctan2, safe_norm
from jrigid._types import InertiaLike, Real, Scalar, ScalarLike, Vector, VectorLike
from jrigid.dynamics import State
from jrigid.free import free_rotation
from jrigid.photometry._ellipsoid import Ellipsoid
from jrigid.photometry._facets import Facets, as_unit
from jrigid.photometry._scattering import AbstractScattering, LommelSeeliger
from jrigid.photometry._sun_and_earth import SPEED_OF_LIGHT
from jrigid.rotation import rotate_inverse
from jrigid.simulate import simulate
from jrigid.systems import RigidBody


def brightness(
    shape: Facets | Ellipsoid,
    to_sun: VectorLike,
    to_observer: VectorLike,
    scattering: AbstractScattering | None = None,
) -> Scalar:
    """Brightness of a body for directions in body axes, at unit distances.

    Args:
        shape: `Facets` or an `Ellipsoid`.
        to_sun: Vector to the Sun, body axes, of any length but 0.
        to_observer: Vector to the observer, body axes, of any length but 0.
        scattering: The law; `LommelSeeliger()` where it is None.

    Returns:
        Sum over the lit and visible surface [m^2], times the phase function. The light
        that arrives is this over the squares of both distances, times a constant. NaN
        for a direction that is 0 or not finite.

    Gradients: exact, of any order but at a phase angle of 0: the second derivatives of
    an ellipsoid have no bound there, and finite ones are returned. A facet that turns
    dark or out of sight has a slope from one side; half the sum of both is what a
    central difference sees.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> ball = jr.photometry.Ellipsoid(jnp.ones(3))
    >>> x, y = jnp.eye(3)[:2]
    >>> print(jr.photometry.brightness(ball, x, x).round(4))  # pi / 2
    1.5708
    """
    to_sun, to_observer = shaped(to_sun=(to_sun, 3), to_observer=(to_observer, 3))
    scattering = LommelSeeliger() if scattering is None else scattering
    return _brightness(shape, scattering, to_sun, to_observer)


@quick_jit  # outside of jit each operation is a program of its own
def _brightness(
    shape: Facets | Ellipsoid,
    scattering: AbstractScattering,
    to_sun: Vector,
    to_observer: Vector,
) -> Scalar:
    """The brightness of `brightness`."""
    sun = as_unit(to_sun)
    observer = as_unit(to_observer)
    surface = shape.brightness(scattering, sun, observer)
    return surface * scattering.phase_factor(phase_angle(sun, observer))


def phase_angle(to_sun: Vector, to_observer: Vector) -> Scalar:
    """Angle between Sun and observer from the body [rad]; its gradient at 0 is 0."""
    # The arc cosine of a product would lose digits near 0, with an infinite slope.
    across = safe_norm(jnp.cross(to_sun, to_observer))
    return safe_arctan2(across, product("i,i->", to_sun, to_observer))


def light_curve(
    inertia: InertiaLike | RigidBody,
    state0: State,
    ts: Real[ArrayLike, " epochs"],
    to_sun: Real[ArrayLike, "epochs 3"],
    to_observer: Real[ArrayLike, "epochs 3"],
    shape: Facets | Ellipsoid,
    scattering: AbstractScattering | None = None,
    *,
    t0: ScalarLike = 0.0,
    light_time: bool = True,
) -> Float[Array, " epochs"]:
    """Brightness of a rotating body at many epochs.

    The motion of a free body, given by its inertia, is the exact flow: an epoch after a
    thousand turns costs the same as one after the first. A `RigidBody` with a torque
    moves by `simulate`.

    Args:
        inertia: Principal moments, or a symmetric tensor in body axes [kg m^2]; or a
            `RigidBody`, whose torque needs no `args`.
        state0: State at `t0`.
        ts: Epochs [s], in any order. The light of a `RigidBody` must leave it at `t0`
            or later.
        to_sun: Vectors from the body to the Sun at the epochs, space axes [m].
        to_observer: Vectors from the body to the observer, space axes [m].
        shape: `Facets` or an `Ellipsoid`, in body axes.
        scattering: The law; `LommelSeeliger()` where it is None.
        t0: Time of `state0` [s], at the body.
        light_time: True: `ts` are times at the observer, and light left the body
            earlier by the distance over the speed of light. False: `ts` are times at
            the body, as in files that are corrected for the light time.

    Returns:
        Brightness at unit distances [m^2], as by `brightness`. NaN for an inertia, a
        state or times that no body has.

    Raises:
        ValueError: Not one vector for each epoch, or light of a `RigidBody` from before
            `t0`, if both are known when the function is called.

    Gradients: exact in all arguments, as those of `free_rotation` and `brightness`.
    They are of any order, but for an ellipsoid at a phase angle of 0 of first order.
    Those of a `RigidBody` are as by `simulate`: of first order, by reverse mode.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> cigar = jr.photometry.Ellipsoid(jnp.array([3.0, 1.0, 1.0]))
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 0.0, 1.0]))
    >>> ts, far = jnp.array([0.0, jnp.pi / 2]), jnp.array([[1e11, 0.0, 0.0]] * 2)
    >>> print(jr.photometry.light_curve(jnp.ones(3), state, ts, far, far, cigar,
    ...                                 light_time=False).round(3))
    [1.571 4.712]
    """
    ts, to_sun, to_observer = shaped(
        ts=(ts, None), to_sun=(to_sun, None, 3), to_observer=(to_observer, None, 3)
    )
    demand(
        len(ts) == len(to_sun) == len(to_observer),
        "Arguments `ts`, `to_sun` and `to_observer` must have one entry for each "
        f"epoch, but they have {len(ts)}, {len(to_sun)} and {len(to_observer)}.",
    )
    if light_time:
        ts = ts - safe_norm(to_observer) / SPEED_OF_LIGHT
    # An invalid motion raises no error here: its curve is NaN below.
    if isinstance(inertia, RigidBody):
        demand(
            not (is_concrete(ts) and is_concrete(t0)) or bool(np.all(ts >= t0)),
            "Argument `t0` must not be later than the first light that is seen, but it "
            "is. (With `light_time` the light left the body before `ts`.)",
        )
        order = jnp.argsort(ts)
        run = simulate(inertia, state0, ts[order], t0=t0, throw=False)
        attitude = jnp.zeros_like(run.states.attitude)
        attitude = attitude.at[order].set(run.states.attitude)
        result = run.result
    else:
        motion = free_rotation(inertia, state0, ts, t0=t0, throw=False)
        attitude, result = motion.attitude, motion.result
    scattering = LommelSeeliger() if scattering is None else scattering
    ok = result == RESULTS.successful
    return _seen_from_space(shape, scattering, attitude, to_sun, to_observer, ok)


@quick_jit  # outside of jit each operation is a program of its own
def _seen_from_space(
    shape: Facets | Ellipsoid,
    scattering: AbstractScattering,
    attitude: Float[Array, "epochs 4"],
    to_sun: Float[Array, "epochs 3"],
    to_observer: Float[Array, "epochs 3"],
    ok: Bool[Array, ""],
) -> Float[Array, " epochs"]:
    """Brightness for directions in space axes; NaN for a motion that is not ok."""

    def at(attitude: Array, to_sun: Vector, to_observer: Vector) -> Scalar:
        sun = rotate_inverse(attitude, to_sun)
        observer = rotate_inverse(attitude, to_observer)
        return _brightness(shape, scattering, sun, observer)

    curve = jax.vmap(at)(attitude, to_sun, to_observer)
    # Some invalid motions have finite attitudes.
    return nan_where(~ok, curve)
