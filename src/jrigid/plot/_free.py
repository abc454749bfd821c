"""Poinsot's pictures: polhodes on the sphere or the ellipsoid, the herpolhode in its plane."""

from itertools import product
from typing import Any

import jax
import numpy as np

from jrigid._checks import check_option, check_shape, demand
from jrigid.free import free_rotation, mean_precession_rate, polhode_period
from jrigid.plot import _common as common
from jrigid.plot._common import LOOKS, TURN, looks, on_surface, states_of

_FAMILY = np.radians([20, 40, 60, 78])  # widths of the polhodes drawn of any body
_EQUAL = (
    1e-9  # relative difference of moments below which no polhode goes round their axes
)
_KEPT = 1e-3  # relative change of the momentum of a free motion
_MOST, _TURNS, _PERIODS = (
    4000,
    20,
    3,
)  # points, precessions and polhodes of a herpolhode


def _cone(moments: np.ndarray, level: float, side: int) -> tuple[np.ndarray, int]:
    """L / |L| along a polhode with 2 E / |L|^2 given, and the number of the axis it is about.

    The sphere and the ellipsoid cut each other above an ellipse in the plane of the
    other axes.
    """
    rates = 1 / moments
    spread = rates[0] - rates[2]
    about = 2 if level <= rates[1] and rates[1] - rates[2] > _EQUAL * spread else 0
    other, over = 2 - about, level - rates[about]
    gaps = np.array([rates[other], rates[1]]) - rates[about]
    wide, high = np.sqrt(np.clip(over / gaps, 0, 1))
    curve = np.zeros((TURN.size, 3))
    curve[:, other], curve[:, 1] = wide * np.cos(TURN), high * np.sin(TURN)
    curve[:, about] = side * np.sqrt(np.maximum(1 - np.sum(curve**2, axis=1), 0))
    return curve, about


def _momentum(body: Any, motion: Any) -> tuple[np.ndarray, bool]:
    """Angular momentum in the body, of parts within too, and whether these have any."""
    states = None if np.ndim(motion) else states_of(motion)
    omega = np.asarray(motion if states is None else states.omega, float)
    check_shape("motions", omega, (3,), (None, 3))
    demand(bool(np.any(omega)), "Arguments `motions` must turn, but one is at rest.")
    system, own = getattr(motion, "system", body), omega @ common.tensor_of(body)
    if states is None or not hasattr(system, "torque"):
        return own, False

    def of(t: Any, state: Any, args: Any) -> Any:
        return system.torque.internal_momentum(t, system.with_parts(state), args)

    ts, args = (
        getattr(motion, "ts", np.zeros(omega.shape[:-1])),
        getattr(motion, "args", None),
    )
    inner = np.asarray(
        (of if own.ndim == 1 else jax.vmap(of, (0, 0, None)))(ts, states, args)
    )
    return own + inner, bool(np.any(inner))


def polhode(body: Any, *motions: Any, ax: Any = None, surface: str = "sphere") -> Any:
    """Paths of the angular momentum in the body, with the separatrix.

    On the sphere L / |L|, or on the ellipsoid of energy L / sqrt(2 E I3). With no
    motion given, polhodes of all kinds of a free rigid body with this inertia. Where
    parts within the body have momentum (a rotor), L has it, only motions of `simulate`
    have paths, on the sphere, and the polhodes of the rigid body are left out.

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
        ValueError: Axes of two dimensions, no such surface, or a motion at rest.

    >>> import jax.numpy as jnp, jrigid as jr
    >>> ax = jr.plot.polhode(jnp.array([1.0, 2.0, 3.0]), jnp.array([0.05, 1.0, 0.0]))
    >>> print(ax.get_title())
    Angular momentum in the body, L/|L|
    """
    check_option("surface", surface, ("sphere", "ellipsoid"))
    (moments, axes), momenta = (
        common.principal(body),
        [_momentum(body, x) for x in motions],
    )
    inner = any(x for _, x in momenta)
    surface = "sphere" if inner else surface
    semi_axes = np.ones(3) if surface == "sphere" else np.sqrt(moments / moments[2])
    ax, rates = common.space_axes(ax, 1.15), 1 / moments
    common.globe(ax, semi_axes, axes)

    def draw(unit: np.ndarray, **style: Any) -> None:
        """Of L / |L| in principal axes; the ellipsoid's point is on the same ray."""
        points = unit / np.linalg.norm(unit / semi_axes, axis=1, keepdims=True)
        on_surface(ax, points @ axes.T, points / semi_axes**2 @ axes.T, **style)

    parted = rates[0] - rates[2] > _EQUAL * rates[0]  # else momenta stay where they are
    for about, side in product((0, 2), (1, -1)) if parted and not inner else ():
        style = {"color": LOOKS[about // 2][0], "ls": "--" if about else "-", "lw": 1.1}
        style |= (
            {"color": "0.6", "lw": 0.7}
            if motions
            else {"label": f"about axis {about + 1}"}
        )
        gap = rates[1] - rates[about]
        for width in _FAMILY if abs(gap) > _EQUAL * rates[0] else ():
            draw(
                _cone(moments, rates[about] + gap * np.sin(width) ** 2, side)[0],
                **style,
            )
        if about and min(rates[0] - rates[1], gap) > _EQUAL * rates[0]:
            draw(
                _cone(moments, rates[1], side)[0], color="k", lw=1.6, label="separatrix"
            )
    for (colour, marker), (i, (momentum, _)) in looks(enumerate(momenta)):
        sizes = np.linalg.norm(momentum, axis=-1, keepdims=True)
        path = np.atleast_2d(momentum / np.where(sizes > 0, sizes, np.nan)) @ axes
        style = {
            "color": colour,
            "marker": marker,
            "ls": "none",
            "label": f"motion {i + 1}",
        }
        draw(path[np.isfinite(path[:, 0])][:1], **style)
        if momentum.ndim == 1 and parted and not inner:
            curve, about = _cone(moments, np.sum(path**2 * rates), 1)
            curve[:, about] *= np.sign(path[0, about])
            path = curve
        draw(path, color=colour, lw=1.8 if momentum.ndim == 1 else 0.9)
    for name, axis in zip("123", (axes * semi_axes).T, strict=True):
        for end in (axis, -axis):
            on_surface(ax, end * [[1.0], [1.15]], np.stack([end, end]), color="k", lw=1)
            if end @ common.eye(ax) >= 0:
                ax.text(
                    *(1.22 * end), name, ha="center", va="center", zorder=common.FRONT
                )
    scale = "|L|" if surface == "sphere" else "$\\sqrt{2 E I_3}$"
    ax.set_title(f"Angular momentum in the body, L/{scale}")
    style = {
        "title": "I = {:.3g}, {:.3g}, {:.3g} kg m$^2$".format(*moments),
        "ncols": 4,
    }
    ax.legend(
        *ax.get_legend_handles_labels(), loc="lower center", frameon=False, **style
    )
    return ax


def herpolhode(body: Any, motion: Any, *, ax: Any = None, ts: Any = None) -> Any:
    """The angular velocity in space, in the invariable plane, between the bounds it touches.

    Args:
        body: Whatever has an inertia, or moments or a tensor [kg m^2].
        motion: A state, or what `free_rotation` returned, or `simulate` of a free body.
        ax: Axes.
        ts: Times since the state [s]; by default three polhode periods, or twenty turns
            about the momentum if that is less.

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
    state, inertia = states_of(motion), common.tensor_of(body)
    start = common.start_of(motion)
    omega = np.asarray(start.omega, float)
    demand(bool(np.any(omega)), "Argument `motion` must turn, but it is at rest.")
    if state.omega.ndim == 1:
        turn = 2 * np.pi / float(mean_precession_rate(inertia, omega))
        most = min(_PERIODS * float(polhode_period(inertia, omega)), _TURNS * turn)
        ts = np.linspace(0, most, _MOST) if ts is None else ts
        state = free_rotation(inertia, start, ts).states
    vectors = np.stack(
        [np.asarray(state.omega), np.asarray(state.omega) @ inertia], axis=-2
    )
    curve, momenta = np.moveaxis(common.turned(state.attitude, vectors), -2, 0)
    seen = np.isfinite(np.sum(curve, axis=1))
    curve, momenta, momentum = curve[seen], momenta[seen], momenta[seen][0]
    size, changes = np.linalg.norm(momentum), np.linalg.norm(momenta - momentum, axis=1)
    free = bool(np.max(changes) < _KEPT * size)
    demand(
        free,
        "Argument `motion` must be free and keep I omega in space, but it does not.",
    )
    up, across = momentum / size, np.cross(momentum / size, curve[0])
    if np.linalg.norm(across) < _EQUAL * np.linalg.norm(
        omega
    ):  # a pure spin: any will do
        across = np.cross(up, np.roll(up, 1) + np.eye(3)[0])
    across /= np.linalg.norm(across)
    (moments, axes), ax = common.principal(body), common.flat_axes(ax)
    unit = omega @ inertia @ axes / size
    around = (
        _cone(moments, np.sum(unit**2 / moments), 1)[0]
        if np.ptp(moments)
        else unit[None]
    )
    radii = size * np.linalg.norm(np.cross(around, around / moments), axis=1)
    bounds = np.array([np.min(radii), np.max(radii)])
    bounds[bounds < _EQUAL * np.linalg.norm(omega)] = 0.0
    for radius, style in zip(bounds, (":", "--"), strict=True):
        ax.plot(radius * np.cos(TURN), radius * np.sin(TURN), style, color="0.4", lw=1)
    plane = curve @ np.stack([np.cross(across, up), across], axis=1)
    ax.plot(*plane.T, color=LOOKS[0][0], lw=0.9)
    ax.plot(*plane[0], LOOKS[1][1], color=LOOKS[1][0])
    ax.plot(0, 0, "+", color="k", ms=9)
    edge = 1.08 * bounds[1] or 0.1 * np.linalg.norm(omega)
    ax.set(aspect="equal", xlim=(-edge, edge), ylim=(-edge, edge))
    title = "Herpolhode, {:.3g} to {:.3g} rad/s from the momentum (+)".format(*bounds)
    names = "angular velocity across the momentum [rad/s]", "and across that [rad/s]"
    common.label(ax, title, *names)
    ax.locator_params(nbins=6)
    return ax
