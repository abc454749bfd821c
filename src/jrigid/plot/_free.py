"""Poinsot's pictures: polhodes on the sphere or the ellipsoid, and the herpolhode."""

from itertools import product
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array

from jrigid._checks import check_option, check_shape, demand
from jrigid._types import AnyArray
from jrigid.free import free_rotation, mean_precession_rate, polhode_period
from jrigid.plot import _drawing as common
from jrigid.plot._drawing import (
    LOOKS,
    TURN,
    Axes,
    Axes3D,
    Body,
    Look,
    Motion,
    Rotating,
    looks,
    on_surface,
    states_of,
)
from jrigid.simulate import Trajectory
from jrigid.systems import RigidBody

_FAMILY = np.radians([20, 40, 60, 78])  # widths of the polhodes drawn of any body
# Relative difference of moments below which no polhode goes round their axes.
_EQUAL = 1e-9
_CONSERVED = 1e-3  # relative change of the angular momentum of a free motion
# Most points, precessions and polhode periods of a herpolhode.
_POINTS = 4000
_PRECESSIONS = 20
_PERIODS = 3


def _cone(moments: np.ndarray, level: float, side: int) -> tuple[np.ndarray, int]:
    """L / |L| along a polhode with 2 E / |L|^2 given, and the number of its axis.

    The sphere and the ellipsoid cut each other above an ellipse in the plane of the
    other axes.
    """
    rates = 1 / moments
    spread = rates[0] - rates[2]
    if rates[1] - rates[2] <= _EQUAL * spread:
        about = 0
    elif rates[0] - rates[1] <= _EQUAL * spread:
        about = 2
    else:
        # The separatrix has the level 1 / I2. Below it the motion is about the axis of
        # the largest moment.
        about = 2 if level <= rates[1] else 0
    other = 2 - about
    # With n = L / |L| and a = 1 / I, the sum of a n^2 is the level, and that of n^2 is
    # 1. Hence n_other^2 (a_other - a_about) + n_2^2 (a_2 - a_about) = level - a_about.
    gaps = np.array([rates[other], rates[1]]) - rates[about]
    # Rounding may put the level of a spin beyond that of its axis.
    wide, high = np.sqrt(np.clip((level - rates[about]) / gaps, 0, 1))
    curve = np.zeros((TURN.size, 3))
    curve[:, other] = wide * np.cos(TURN)
    curve[:, 1] = high * np.sin(TURN)
    curve[:, about] = side * np.sqrt(np.maximum(1 - np.sum(curve**2, axis=1), 0))
    return curve, about


class _Momentum(NamedTuple):
    """Angular momentum in body axes, with that of parts within.

    Attributes:
        values: (3,) of a state, or (n, 3) along a path [kg m^2/s].
        has_parts: Whether parts within the body have any.
    """

    values: np.ndarray
    has_parts: bool

    @classmethod
    def of(cls, body: Body, motion: Any) -> "_Momentum":
        """Angular momentum for angular velocities, or for a motion."""
        states = None if np.ndim(motion) else states_of(motion)
        omega = np.asarray(motion if states is None else states.omega, float)
        check_shape("motions", omega, (3,), (None, 3))
        message = "Arguments `motions` must have a finite state, but one has none."
        demand(bool(np.any(np.all(np.isfinite(omega), axis=-1))), message)
        message = "Arguments `motions` must turn, but one is at rest."
        demand(bool(np.any(omega)), message)
        of_body = omega @ common.tensor_of(body)
        system = motion.system if isinstance(motion, Trajectory) else body
        if states is None or not isinstance(system, RigidBody):
            return cls(of_body, False)
        of_parts = _of_parts(system, motion, states)
        return cls(of_body + of_parts, bool(np.any(of_parts)))


def _of_parts(system: RigidBody, motion: Motion, states: Rotating) -> np.ndarray:
    """Angular momentum of parts within the body, body axes."""
    ts: AnyArray = np.zeros(states.omega.shape[:-1])
    args = None
    if isinstance(motion, Trajectory):
        ts = motion.ts
        args = motion.args

    def momentum(t: AnyArray, state: Any, args: Any) -> Array:
        return system.torque.internal_momentum(t, system.with_parts(state), args)

    if states.omega.ndim == 1:
        return np.asarray(momentum(ts, states, args))
    return np.asarray(jax.vmap(momentum, (0, 0, None))(ts, states, args))


class _Surface(NamedTuple):
    """The sphere or ellipsoid on which polhodes are drawn.

    Attributes:
        ax: Axes of three dimensions.
        moments: Principal moments, ascending.
        axes: Principal axes in columns.
        semi_axes: Of the surface, along the principal axes.
    """

    ax: Axes3D
    moments: np.ndarray
    axes: np.ndarray
    semi_axes: np.ndarray

    @property
    def rates(self) -> np.ndarray:
        """1 / I, which is 2 E / |L|^2 of spin about each principal axis."""
        return 1 / self.moments

    @property
    def has_polhodes(self) -> bool:
        """Whether angular momenta move: not in a body of equal moments."""
        return bool(self.rates[0] - self.rates[2] > _EQUAL * self.rates[0])

    def rests(self, unit: np.ndarray) -> bool:
        """Whether L / |L|, in principal axes, stays where it is: at an equilibrium."""
        turning = np.cross(unit, self.rates * unit)
        spread = self.rates[0] - self.rates[2]
        return bool(np.linalg.norm(turning) <= _EQUAL * spread)

    def draw(self, unit: np.ndarray, **style: Any) -> None:
        """Draw L / |L| in principal axes; the ellipsoid's point is on the same ray."""
        length = np.linalg.norm(unit / self.semi_axes, axis=1, keepdims=True)
        points = unit / length
        # This is the gradient of the ellipsoid's equation.
        normals = points / self.semi_axes**2
        on_surface(self.ax, points @ self.axes.T, normals @ self.axes.T, **style)

    def draw_family(self, about: int, side: int, is_faint: bool) -> None:
        """Draw polhodes about one end of a principal axis, and the separatrix."""
        style: dict[str, Any] = {
            "color": LOOKS[about // 2][0],
            "ls": "--" if about else "-",
            "lw": 1.1,
            "label": f"about axis {about + 1}",
        }
        if is_faint:
            style |= {"color": "0.6", "lw": 0.7, "label": None}
        rates = self.rates
        gap = rates[1] - rates[about]
        if abs(gap) > _EQUAL * rates[0]:
            for width in _FAMILY:
                level = rates[about] + gap * np.sin(width) ** 2
                self.draw(_cone(self.moments, level, side)[0], **style)
        # Both families share the separatrix, which is drawn once. A symmetric body has
        # none.
        if about and min(rates[0] - rates[1], gap) > _EQUAL * rates[0]:
            curve, _ = _cone(self.moments, rates[1], side)
            self.draw(curve, color="k", lw=1.6, label="separatrix")

    def draw_motion(
        self, momentum: np.ndarray, look: Look, name: str, is_free: bool
    ) -> None:
        """Draw where a motion starts, and its path or its polhode."""
        colour, marker = look
        sizes = np.linalg.norm(momentum, axis=-1, keepdims=True)
        path = np.atleast_2d(momentum / np.where(sizes > 0, sizes, np.nan)) @ self.axes
        start = path[np.isfinite(path[:, 0])][:1]
        self.draw(start, color=colour, marker=marker, ls="none", label=name)
        if momentum.ndim == 1 and is_free and not self.rests(path[0]):
            level = np.sum(path**2 * self.rates)
            curve, about = _cone(self.moments, level, 1)
            # Of the two ends of the axis, the one that the motion circles.
            curve[:, about] *= np.sign(path[0, about])
            path = curve
        self.draw(path, color=colour, lw=1.8 if momentum.ndim == 1 else 0.9)

    def draw_axes(self) -> None:
        """Draw ends of the principal axes, with numbers where they face the eye."""
        place: dict[str, Any] = {"ha": "center", "va": "center", "zorder": common.FRONT}
        for name, axis in zip("123", (self.axes * self.semi_axes).T, strict=True):
            for end in (axis, -axis):
                line = end * [[1.0], [1.15]]
                on_surface(self.ax, line, np.stack([end, end]), color="k", lw=1)
                if end @ common.eye(self.ax) >= 0:
                    self.ax.text(*(1.22 * end), name, **place)


def polhode(
    body: Body,
    *motions: Motion,
    ax: Axes3D | None = None,
    surface: str = "sphere",
) -> Axes3D:
    """Draw paths of the angular momentum in the body, with the separatrix.

    The paths are L / |L| on the sphere, or L / sqrt(2 E I3) on the ellipsoid of energy.
    With no motion given, they are polhodes of all kinds of a free rigid body with this
    inertia. Where parts within the body have momentum (a rotor), L includes it. Then
    only motions of `simulate` have paths, on the sphere, and the polhodes of the rigid
    body are left out.

    Args:
        body: Whatever has an inertia, or moments or a tensor [kg m^2].
        motions: Angular velocities or states, whose polhodes are drawn; or what
            `free_rotation` and `simulate` return, or angular velocities (n, 3) [rad/s]:
            paths from point to point.
        ax: Axes of three dimensions.
        surface: "sphere" or "ellipsoid".

    Returns:
        The axes.

    Raises:
        ImportError: Without the extra `jrigid[plot]`.
        ValueError: Axes of two dimensions, no such surface, moments that are not
            positive, or a motion at rest or without a finite state.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> ax = jr.plot.polhode(jnp.array([1.0, 2.0, 3.0]), jnp.array([0.05, 1.0, 0.0]))
    >>> print(ax.get_title())
    Angular momentum in the body, L/|L|
    """
    check_option("surface", surface, ("sphere", "ellipsoid"))
    moments, axes = common.principal(body)
    message = f"Argument `body` must have positive moments, but they are {moments}."
    demand(bool(np.all(moments > 0) & np.all(np.isfinite(moments))), message)
    momenta = [_Momentum.of(body, x) for x in motions]
    has_parts = any(x.has_parts for x in momenta)
    is_sphere = has_parts or surface == "sphere"
    semi_axes = np.ones(3) if is_sphere else np.sqrt(moments / moments[2])
    space = common.space_axes(ax, 1.15)
    common.globe(space, semi_axes, axes)
    drawn_on = _Surface(space, moments, axes, semi_axes)
    is_free = drawn_on.has_polhodes and not has_parts
    if is_free:
        for about, side in product((0, 2), (1, -1)):
            drawn_on.draw_family(about, side, is_faint=bool(motions))
    for look, (i, momentum) in looks(enumerate(momenta)):
        drawn_on.draw_motion(momentum.values, look, f"motion {i + 1}", is_free)
    drawn_on.draw_axes()
    scale = "|L|" if is_sphere else "$\\sqrt{2 E I_3}$"
    space.set_title(f"Angular momentum in the body, L/{scale}")
    space.legend(
        *space.get_legend_handles_labels(),
        loc="lower center",
        frameon=False,
        title="I = {:.3g}, {:.3g}, {:.3g} kg m$^2$".format(*moments),
        ncols=4,
    )
    return space


def herpolhode(
    body: Body, motion: Motion, *, ax: Axes | None = None, ts: AnyArray | None = None
) -> Axes:
    """Draw the angular velocity in the invariable plane, between the bounds it touches.

    Args:
        body: Whatever has an inertia, or moments or a tensor [kg m^2].
        motion: A state, or what `free_rotation` returned, or `simulate` of a free body.
        ax: Axes.
        ts: Times since the state [s]; by default three polhode periods, or twenty turns
            about the angular momentum if that is less.

    Returns:
        The axes: components at right angles to the momentum [rad/s], the first along
        that at the start.

    Raises:
        ImportError: Without the extra `jrigid[plot]`.
        ValueError: At rest, or a motion that does not keep I omega in space: it is not
            free.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> state = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.3, 1.0, 0.2]))
    >>> ax = jr.plot.herpolhode(jnp.array([1.0, 2.0, 3.0]), state)
    >>> print(ax.get_xlabel())
    angular velocity across the momentum [rad/s]
    """
    inertia = common.tensor_of(body)
    start = common.start_of(motion)
    omega = np.asarray(start.omega, float)
    demand(bool(np.any(omega)), "Argument `motion` must turn, but it is at rest.")
    states = states_of(motion)
    if states.omega.ndim == 1:
        times = _times_of_herpolhode(inertia, omega) if ts is None else ts
        states = free_rotation(inertia, start, times).states
    curve, momentum = _in_space(states, inertia)
    up = momentum / np.linalg.norm(momentum)
    across = _across(up, curve[0], omega)
    plane = curve @ np.stack([np.cross(across, up), across], axis=1)
    bounds = _bounds_of_herpolhode(inertia, omega, float(np.linalg.norm(momentum)))
    ax = common.flat_axes(ax)
    for radius, style in zip(bounds, (":", "--"), strict=True):
        ax.plot(radius * np.cos(TURN), radius * np.sin(TURN), style, color="0.4", lw=1)
    ax.plot(*plane.T, color=LOOKS[0][0], lw=0.9)
    ax.plot(*plane[0], LOOKS[1][1], color=LOOKS[1][0])
    ax.plot(0, 0, "+", color="k", ms=9)
    # The curve of a pure spin is a point, but limits of axes must differ.
    edge = 1.08 * bounds[1] or 0.1 * np.linalg.norm(omega)
    ax.set(aspect="equal", xlim=(-edge, edge), ylim=(-edge, edge))
    title = "Herpolhode, {:.3g} to {:.3g} rad/s from the momentum (+)".format(*bounds)
    names = "angular velocity across the momentum [rad/s]", "and across that [rad/s]"
    common.label(ax, title, *names)
    ax.locator_params(nbins=6)
    return ax


def _times_of_herpolhode(inertia: np.ndarray, omega: np.ndarray) -> np.ndarray:
    """Times in which the curve shows its shape [s]."""
    turn = 2 * np.pi / float(mean_precession_rate(inertia, omega))
    periods = _PERIODS * float(polhode_period(inertia, omega))
    # The period is infinite on the separatrix, and of a sphere.
    return np.linspace(0, min(periods, _PRECESSIONS * turn), _POINTS)


def _in_space(states: Rotating, inertia: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Angular velocities in space, and the angular momentum that must stay the same."""
    omegas = np.asarray(states.omega)
    vectors = np.stack([omegas, omegas @ inertia], axis=-2)
    curve, momenta = np.moveaxis(common.turned(states.attitude, vectors), -2, 0)
    finite = np.isfinite(np.sum(curve, axis=1))
    curve = curve[finite]
    momenta = momenta[finite]
    changes = np.linalg.norm(momenta - momenta[0], axis=1)
    is_free = bool(np.max(changes) < _CONSERVED * np.linalg.norm(momenta[0]))
    message = "must be free and keep I omega in space, but it does not."
    demand(is_free, f"Argument `motion` {message}")
    return curve, momenta[0]


def _across(up: np.ndarray, first: np.ndarray, omega: np.ndarray) -> np.ndarray:
    """A unit vector at right angles to the angular momentum and the first point."""
    across = np.cross(up, first)
    # A pure spin is along the angular momentum: any vector across it will do.
    if np.linalg.norm(across) < _EQUAL * np.linalg.norm(omega):
        across = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    return across / np.linalg.norm(across)


def _bounds_of_herpolhode(
    inertia: np.ndarray, omega: np.ndarray, size: float
) -> np.ndarray:
    """Least and largest distance from the angular momentum, whose size is given."""
    moments, axes = common.principal(inertia)
    unit = omega @ inertia @ axes / size
    polhode = unit[None]
    # The angular momentum of a sphere does not move in the body.
    if np.ptp(moments):
        polhode, _ = _cone(moments, np.sum(unit**2 / moments), 1)
    # The part of omega across L has the length |L x omega| / |L|.
    radii = size * np.linalg.norm(np.cross(polhode, polhode / moments), axis=1)
    bounds = np.array([np.min(radii), np.max(radii)])
    bounds[bounds < _EQUAL * np.linalg.norm(omega)] = 0.0
    return bounds
