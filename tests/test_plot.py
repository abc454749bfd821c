"""Pictures: what is drawn is the physics it shows.
Those of a fit are in test_fit_interface.py."""

import json
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest

import jrigid as jr

matplotlib.use("Agg")
from matplotlib import pyplot
from matplotlib.animation import FFMpegWriter
from matplotlib.backend_bases import MouseEvent
from matplotlib.colors import to_hex

MOMENTS = jnp.array([1.0, 2.0, 3.0])
OMEGA = jnp.array([0.3, 1.0, 0.2])
START = jr.State(jnp.array([1.0, 0.0, 0.0, 0.0]), OMEGA)
TURN = jr.rotation.to_matrix(jr.rotation.normalize(jnp.array([0.8, 0.3, -0.4, 0.2])))
TENSOR = TURN @ jnp.diag(MOMENTS) @ TURN.T
TOP = jr.SymmetricTop(1.0, 0.5, 1.0)
TILTED = jr.top.initial_state(TOP, 0.5, omega3=6.0, phi_dot=-0.4)
TIMES = jnp.linspace(0.0, 20.0, 801)
SPUN = jr.top_motion(TOP, TILTED, TIMES)
AREA = {"a": np.linspace(-1.0, 1.0, 41), "b": np.linspace(0.0, 2.0, 31)}
MAP = np.subtract.outer(AREA["a"], 0.5 * AREA["b"])


@pytest.fixture(autouse=True)
def closed():
    yield
    pyplot.close("all")


def curves(ax):
    """Lines on a surface, of which one artist shows the front and another the back."""
    lines = [np.stack(line.get_data_3d(), axis=1) for line in ax.lines]
    pairs = zip(lines[::2], lines[1::2], strict=True)
    return [np.where(np.isnan(near), far, near) for near, far in pairs]


def named(ax, label):
    at = [line.get_label() for line in ax.lines].index(label)
    return curves(ax)[at // 2]


def has_units(ax):
    return "[" in ax.get_xlabel() and "[" in ax.get_ylabel()


# Free motion


def test_polhodes_keep_momentum_and_energy():
    omegas = OMEGA, jnp.array([1.0, 0.1, 0.05]), jnp.array([1e-7, 1.0, 0.0])
    ax = jr.plot.polhode(TENSOR, *omegas)
    assert "kg m$^2$" in ax.get_legend().get_title().get_text()
    inverse = np.linalg.inv(TENSOR)
    drawn = [x for x in curves(ax) if len(x) > 2]
    for curve, omega in zip(drawn[-3:], omegas, strict=True):
        momentum = np.asarray(TENSOR @ omega)
        level = omega @ momentum / (momentum @ momentum)
        np.testing.assert_allclose(np.sum(curve**2, axis=1), 1, atol=1e-12)
        np.testing.assert_allclose(
            np.einsum("ni,ij,nj->n", curve, inverse, curve), level, 1e-12
        )
        # the library's, whose points are even in time, lies on it and it goes all the
        # way round
        points = np.asarray(jr.free.polhode(TENSOR, omega, 50)) @ np.asarray(TENSOR)
        points /= np.linalg.norm(points, axis=1, keepdims=True)
        apart = np.linalg.norm(points[:, None] - curve, axis=2)
        assert np.max(np.min(apart, axis=1)) < 0.01
        np.testing.assert_allclose(curve[0], curve[-1], atol=1e-12)


def test_the_separatrix_passes_through_the_middle_axis_in_its_planes():
    curve = named(jr.plot.polhode(MOMENTS), "separatrix")
    np.testing.assert_allclose(np.max(curve[:, 1]), 1, atol=1e-12)
    np.testing.assert_allclose(np.min(curve[:, 1]), -1, atol=1e-12)
    ratio = jr.free.separatrix(MOMENTS).momentum_ratio
    np.testing.assert_allclose(
        np.abs(curve[:, 2]), ratio * np.abs(curve[:, 0]), atol=1e-7
    )


def test_on_the_ellipsoid_energy_is_one():
    ax = jr.plot.polhode(MOMENTS, OMEGA, surface="ellipsoid")
    for curve in [x for x in curves(ax) if len(x) > 2]:
        np.testing.assert_allclose(
            np.sum(curve**2 / np.array([1 / 3, 2 / 3, 1]), axis=1), 1, atol=1e-12
        )


def test_a_motion_is_drawn_as_it_went_and_what_is_behind_faintly():
    motion = jr.free_rotation(MOMENTS, START, jnp.linspace(0.0, 3.0, 50))
    ax = jr.plot.polhode(MOMENTS, motion)
    path = np.asarray(motion.omega) * [1, 2, 3]
    path /= np.linalg.norm(path, axis=1, keepdims=True)
    drawn = [x for x in curves(ax) if len(x) == 50]
    np.testing.assert_allclose(drawn[0], path, atol=1e-14)
    eye = [np.cos(np.radians(25)) * np.cos(np.radians(35))]
    eye += [np.cos(np.radians(25)) * np.sin(np.radians(35)), np.sin(np.radians(25))]
    near, far = [x for x in ax.lines if len(x.get_data_3d()[0]) == 50]
    assert far.get_alpha() < 0.5
    np.testing.assert_array_equal(np.isfinite(near.get_data_3d()[0]), path @ eye >= 0)
    ax.view_init(-25, 215)  # from the other side, as the mouse turns it
    moved = MouseEvent("motion_notify_event", ax.figure.canvas, 10, 10)
    ax.figure.canvas.callbacks.process(moved.name, moved)
    np.testing.assert_array_equal(np.isfinite(near.get_data_3d()[0]), path @ eye <= 0)


@pytest.mark.parametrize(
    "moments", [(1.0, 1.0, 1.8), (0.2, 1.0, 1.0), (1e-9, 1e-9, 1e-9)]
)
def test_bodies_of_revolution_and_spheres_have_polhodes(moments):
    ax = jr.plot.polhode(jnp.array(moments), OMEGA)
    momentum = np.asarray(moments) * OMEGA
    np.testing.assert_allclose(
        named(ax, "motion 1")[0], momentum / np.linalg.norm(momentum)
    )
    drawn = [x for x in curves(ax) if len(x) > 2]
    alone = {1.0: 2, 0.2: 0}.get(moments[0])  # the axis of revolution
    assert len(drawn) == (0 if alone is None else 9)
    for curve in drawn[:4] if alone is not None else ():
        assert np.ptp(curve[:, alone]) < 1e-12
    assert "separatrix" not in [line.get_label() for line in ax.lines]
    jr.plot.polhode(jnp.array(moments))  # a sphere has nothing to name
    ax.figure.canvas.draw()


@pytest.mark.parametrize(
    ("moments", "omega"),
    [
        ((1.0, 2.0, 3.0), (0.0, 1.0, 0.0)),  # about the intermediate axis
        ((1.0, 1.0, 2.0), (0.7, 0.2, 0.0)),  # across the axis of revolution
        ((1.0, 2.0, 2.0), (0.0, 0.7, 0.2)),
    ],
)
def test_the_polhode_of_an_equilibrium_is_a_point(moments, omega):
    """L x omega is 0 there, so that L stays."""
    ax = jr.plot.polhode(jnp.array(moments), jnp.array(omega))
    momentum = np.multiply(moments, omega)
    at = [line.get_label() for line in ax.lines].index("motion 1") // 2
    for curve in curves(ax)[at : at + 2]:
        unit = momentum / np.linalg.norm(momentum)
        np.testing.assert_allclose(curve, unit[None], atol=1e-15)


@pytest.mark.parametrize("axis", [*np.eye(3), *-np.eye(3)])
def test_a_spin_about_any_axis_has_a_herpolhode(axis):
    ax = jr.plot.herpolhode(MOMENTS, jr.State(START.attitude, jnp.asarray(axis)))
    for line in ax.lines[2:]:
        np.testing.assert_allclose(line.get_xydata(), 0, atol=1e-12)


def bounds_of_herpolhode(inertia, omega):
    path = np.asarray(jr.free.polhode(inertia, omega, 4001))
    plane = jr.free.poinsot(inertia, omega).plane_distance
    radii = np.sqrt(np.sum(path**2, axis=1) - plane**2)
    return np.min(radii), np.max(radii)


@pytest.mark.parametrize("inertia", [MOMENTS, TENSOR])
def test_the_herpolhode_touches_its_bounds(inertia):
    ax = jr.plot.herpolhode(inertia, START)
    inner, outer, curve = (np.hypot(*line.get_data()) for line in ax.lines[:3])
    least, most = bounds_of_herpolhode(inertia, OMEGA)
    np.testing.assert_allclose([inner[0], outer[0]], [least, most], rtol=1e-5)
    np.testing.assert_allclose([np.min(curve), np.max(curve)], [least, most], rtol=1e-3)
    plane = jr.free.poinsot(inertia, OMEGA).plane_distance
    np.testing.assert_allclose(curve[0] ** 2 + plane**2, np.sum(OMEGA**2), rtol=1e-12)
    assert has_units(ax)


def test_a_herpolhode_is_as_seen_along_the_momentum():
    ts = jnp.linspace(0.0, 5.0, 60)
    ax = jr.plot.herpolhode(MOMENTS, jr.free_rotation(MOMENTS, START, ts))
    x, y = ax.lines[2].get_data()
    space = np.asarray(jr.free.herpolhode(MOMENTS, START, ts))
    momentum = np.asarray(MOMENTS * OMEGA)
    up = momentum / np.linalg.norm(momentum)
    flat = space - (space @ up)[:, None] * up
    np.testing.assert_allclose(np.hypot(x, y), np.linalg.norm(flat, axis=1), atol=1e-12)
    # turned by as much, and in the same sense
    turned = np.arctan2(np.cross(flat[0], flat) @ up, flat @ flat[0])
    np.testing.assert_allclose(
        np.exp(1j * np.arctan2(y, x)), np.exp(1j * turned), atol=1e-9
    )


def test_a_pure_spin_and_a_separatrix_have_herpolhodes():
    ax = jr.plot.herpolhode(
        MOMENTS, jr.State(START.attitude, jnp.array([0.0, 0.0, 2.0]))
    )
    assert np.max(np.hypot(*ax.lines[2].get_data())) < 1e-12
    assert ax.get_xlim()[1] > 0.1
    # These numbers are on the separatrix to the last bit.
    moments = jnp.array([1.0, 2.5, 4.0])
    ax = jr.plot.herpolhode(
        moments, jr.State(START.attitude, jnp.array([1.0, 0.25, 0.5]))
    )
    assert np.hypot(*ax.lines[0].get_data())[0] == 0


ROTOR = jr.RigidBody(MOMENTS, jr.torques.Rotor(jnp.array([0.0, 0.0, 3.0])))


def test_of_a_rotor_the_whole_momentum_is_drawn_alone():
    motion = jr.simulate(ROTOR, START, TIMES[:200])
    ax = jr.plot.polhode(ROTOR, motion, surface="ellipsoid")
    whole = np.asarray(motion.states.omega) * [1, 2, 3] + [0, 0, 3]
    path = whole / np.linalg.norm(whole, axis=1, keepdims=True)
    (drawn,) = [x for x in curves(ax) if len(x) > 2]
    np.testing.assert_allclose(drawn, path, atol=1e-12)
    assert "|L|" in ax.get_title()
    ax = jr.plot.polhode(ROTOR, START)  # which way it goes is not known
    assert [len(x) for x in curves(ax)[:2]] == [1, 1]


def test_what_is_not_finite_at_first_is_passed_over():
    motion = jr.simulate(jr.RigidBody(MOMENTS), START, TIMES[:50])
    late = jax.tree.map(lambda x: x.at[:2].set(jnp.nan), motion.states)
    late = eqx.tree_at(lambda x: x.states, motion, late)
    drift = jr.plot.motion(late)["drift"].lines[0].get_ydata()
    assert np.any(np.isfinite(drift))
    assert np.isfinite(jr.plot.herpolhode(MOMENTS, late).get_xlim()[1])
    first = np.asarray(motion.states.omega)[2] * [1, 2, 3]
    start = named(jr.plot.polhode(MOMENTS, late), "motion 1")
    np.testing.assert_allclose(start[0], first / np.linalg.norm(first))


# Tops


def test_of_several_tops_each_path_is_named_by_its_tilts():
    other = jr.top_motion(TOP, jr.top.initial_state(TOP, 0.9, omega3=6.0), TIMES)
    ax = jr.plot.tip(TOP, SPUN, other, SPUN)
    assert len(ax.get_legend().get_texts()) == 3
    (low, high), path = jr.top.nutation_bounds(TOP, TILTED), curves(ax)[3]
    np.testing.assert_array_equal(
        path, named(ax, f"{np.degrees(low):.1f}° to {np.degrees(high):.1f}°")
    )
    assert "tilts" not in ax.get_title()


def test_the_tip_stays_between_its_turning_points_and_touches_them():
    ax = jr.plot.tip(TOP, SPUN)
    _, low, high, path, start = curves(ax)
    bounds = jr.top.nutation_bounds(TOP, TILTED)
    for circle, tilt in ((low, bounds.theta_min), (high, bounds.theta_max)):
        np.testing.assert_allclose(circle[:, 2], np.cos(tilt), atol=1e-12)
    tilts = np.arccos(path[:, 2])
    np.testing.assert_allclose([np.min(tilts), np.max(tilts)], bounds, atol=1e-4)
    euler = np.asarray(jr.rotation.to_euler(SPUN.attitude[7]))
    azimuth = [
        np.sin(euler[1]) * np.sin(euler[0]),
        -np.sin(euler[1]) * np.cos(euler[0]),
    ]
    np.testing.assert_allclose(path[7, :2], azimuth, atol=1e-12)
    np.testing.assert_array_equal(start, path[:1])
    words = "{:.1f}° to {:.1f}°".format(*np.degrees(bounds))
    assert words in ax.get_title()
    hanging = jr.top_motion(TOP, jr.top.initial_state(TOP, 2.5, omega3=1.0), TIMES)
    assert jr.plot.tip(TOP, hanging).elev < 0 < ax.elev


def test_the_level_ends_on_the_well():
    steady = jr.top.initial_state(TOP, 0.5, omega3=6.0, phi_dot="slow")
    ax = jr.plot.effective_potential(TOP, SPUN, steady)
    for state, (well, level) in zip(
        (TILTED, steady), (ax.lines[:2], ax.lines[2:]), strict=True
    ):
        tilts, heights = level.get_data()
        p_phi, p_psi, _ = jr.top.conserved(TOP, state)
        ends = jr.top.effective_potential(TOP, np.radians(tilts), p_phi, p_psi)
        np.testing.assert_allclose(heights, ends, rtol=1e-12)
        x, y = well.get_data()
        inside = (x > tilts[0]) & (x < tilts[1])
        assert np.all(y[inside] < heights[0])
        assert np.all(y[~inside & (np.abs(x - np.mean(tilts)) > 0.1)] > heights[0])
    assert has_units(ax)
    low, high = ax.get_ylim()
    assert low < np.min(ax.lines[0].get_ydata())
    assert high > ax.lines[3].get_ydata()[0]
    for state in (
        jr.top.initial_state(TOP, 0.0, omega3=5.0),
        jr.top.initial_state(TOP, 2.0),
    ):
        jr.plot.effective_potential(TOP, state).figure.canvas.draw()


# Maps


def test_the_border_runs_where_the_level_is():
    ax = jr.plot.chart(
        MAP, AREA, level=0.0, regions=("below", "above"), title="gap [m]"
    )
    mesh, border = ax.collections[:2]
    np.testing.assert_allclose(mesh.get_array().reshape(31, 41), MAP.T)
    a, b = np.concatenate([x.vertices for x in border.get_paths()]).T
    np.testing.assert_allclose(a, 0.5 * b, atol=1e-12)
    places = {text.get_text(): text.get_position() for text in ax.texts}
    assert places["below"][0] < 0.5 * places["below"][1]
    assert places["above"][0] > 0.5 * places["above"][1]
    assert mesh.colorbar.ax.get_ylabel() == "gap [m]"


def sorted_by(a, b):
    return jr.stability.satellite_stability(jnp.stack([2 + a, b, 1.0])).region


def test_a_sweep_an_xarray_and_an_array_of_regions_give_one_map():
    result = jr.stability.stability_map(sorted_by, {"a": AREA["a"], "b": AREA["b"][1:]})
    result = result._replace(attributes={"a": {"units": "kg m^2"}})
    texts = jr.stability.REGIONS[result.values]
    other = {"first": AREA["a"], "second": AREA["b"][1:]}
    given = (result, None), (result.to_xarray()["value"], None), (texts, other)
    drawn = [jr.plot.chart(values, grid) for values, grid in given]
    names = [[text.get_text() for text in ax.texts] for ax in drawn]
    assert {x.replace("_", "-") for x in names[1]} == set(names[0]) == set(names[2])
    codes = drawn[0].collections[0].get_array().reshape(30, 41)
    np.testing.assert_array_equal(np.array(jr.stability.REGIONS.texts)[codes], texts.T)
    assert [ax.get_xlabel() for ax in drawn] == ["a [kg m^2]", "a [kg m^2]", "first"]


def test_a_refined_map_is_drawn_by_its_classes():
    axes = {"a": np.linspace(-1.0, 1.0, 64), "b": np.linspace(0.02, 2.0, 64)}
    style = {"refine": lambda region: region, "block_size": 16, "progress": False}
    refined = jr.sweep(sorted_by, axes, **style)
    assert not refined.valid.all()
    ax = jr.plot.chart(refined)
    wanted = jr.stability.stability_map(sorted_by, axes)
    other = jr.plot.chart(wanted)
    drawn, whole = (x.collections[0].get_array() for x in (ax, other))
    np.testing.assert_array_equal(drawn, whole)
    names = {text.get_text().replace("_", "-") for text in ax.texts}
    assert names == {text.get_text() for text in other.texts}


def test_narrow_regions_are_named_beside_the_map():
    kinds = np.where(np.abs(MAP) < 0.05, 2, MAP > 0)
    ax = jr.plot.chart(kinds, AREA, regions=("left", "right", "between"))
    assert [text.get_text() for text in ax.texts] == ["left", "right"]
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["between"]


HALVES = np.where(MAP > 0, 2, 0)
TINTS = "#f6cda8", "#a6cee8", "#e4f0c8", "#ebc8dc"
MARGINAL = jax.tree.map(lambda x: np.full(MAP.shape, x), jr.stability.REGIONS.marginal)


def colour_at(ax, x, y):
    """Of a pixel of the picture."""
    ax.figure.canvas.draw()
    column, row = np.round(ax.transData.transform((x, y))).astype(int)
    return to_hex(np.asarray(ax.figure.canvas.buffer_rgba())[-1 - row, column] / 255)


@pytest.mark.parametrize(
    ("values", "regions", "expected"),
    [
        (HALVES, ("sleeps", "nods", "falls"), {"sleeps": 0, "falls": 2}),
        (HALVES > -1, ("stable", "unstable"), {"unstable": 1}),
        (HALVES > 0, (), {"False": 0, "True": 1}),
        (MARGINAL, (), {"marginal": 3}),
        (MARGINAL, "abcde", {"d": 3}),
        (HALVES + 7, (), {"7": 0, "9": 1}),  # more than there are tints
        (np.where(HALVES, "up", "down"), (), {"down": 0, "up": 1}),
    ],
)
def test_a_code_has_its_own_name_and_its_own_tint(values, regions, expected):
    ax = jr.plot.chart(values, AREA, regions=regions)
    assert [text.get_text() for text in ax.texts] == list(expected)
    tints = [TINTS[code] for code in expected.values()]
    assert [colour_at(ax, x, 0.1) for x in (-0.9, 0.9)] == [tints[0], tints[-1]]


def test_what_is_not_known_is_white():
    ax = jr.plot.chart(
        np.where(MAP > 0, np.nan, MAP), AREA, level=-0.5, regions=("low", "high")
    )
    assert colour_at(ax, 0.9, 0.1) == "#ffffff" != colour_at(ax, -0.9, 0.1)


def test_infinite_numbers_are_white_and_colours_run_over_the_others():
    # Of a map of flip times most may be infinite.
    times = np.where(MAP < 0.7, np.inf, MAP)
    ax = jr.plot.chart(times, AREA)
    limits = np.percentile(MAP[MAP >= 0.7], (2, 98))
    np.testing.assert_allclose(ax.collections[0].get_clim(), limits)
    assert colour_at(ax, -0.9, 0.1) == "#ffffff" != colour_at(ax, 0.9, 0.1)
    masked = jr.plot.chart(np.ma.masked_less(MAP, 0.7), AREA)
    np.testing.assert_allclose(masked.collections[0].get_clim(), limits)
    nothing = jr.plot.chart(MAP * np.nan, AREA)
    assert colour_at(nothing, 0.9, 0.1) == "#ffffff"


# Motions and bodies


def test_the_drift_is_that_of_energy_and_momentum():
    body = jr.RigidBody(MOMENTS, jr.torques.LinearDrag(0.1))
    trajectory = jr.simulate(body, START, TIMES[::40])
    axes = jr.plot.motion(trajectory)
    energy, momentum = (line.get_ydata() for line in axes["drift"].lines[:2])
    known = np.asarray(trajectory.energy)
    np.testing.assert_allclose(
        energy[1:], np.abs(known - known[0])[1:] / known[0], 1e-12
    )
    known = np.asarray(trajectory.angular_momentum)
    lost = np.linalg.norm(known - known[0], axis=1) / np.linalg.norm(known[0])
    np.testing.assert_allclose(momentum[1:], lost[1:], 1e-12)
    np.testing.assert_array_equal(
        axes["omega"].lines[2].get_ydata(), trajectory.states.omega[:, 2]
    )
    assert all(has_units(axes[x]) or x == "drift" for x in axes)
    assert axes["drift"].get_ylabel() == "relative change"


def test_about_the_vertical_a_top_keeps_its_momentum():
    some = jr.top_motion(TOP, TILTED, TIMES[:50])
    rest = {"system": TOP, "ts": TIMES[:50]}
    ax = pyplot.figure().add_subplot()
    jr.plot.motion(some, {"drift": ax}, along=jnp.array([0.0, 0.0, 1.0]), **rest)
    assert np.nanmax(ax.lines[1].get_ydata()) < 1e-13
    ax.clear()
    assert jr.plot.motion(some, {"drift": ax}, **rest)["drift"] is ax
    assert np.nanmax(ax.lines[1].get_ydata()) > 1e-3
    with pytest.raises(ValueError, match="`system` must be given"):
        jr.plot.motion(some)
    with pytest.raises(ValueError, match="`ts` must be given"):
        jr.plot.motion(some, system=TOP)


def faces_of(ax):
    """Corners of the faces in space, to which matplotlib has no public way."""
    surface = ax.collections[0]
    if hasattr(surface, "_faces"):
        return np.reshape(surface._faces, (-1, 3))
    return surface._vec[:3].T  # matplotlib before 3.11


def test_the_box_drawn_has_the_inertia():
    film = jr.plot.animate(
        TENSOR + jnp.eye(3), jr.free_rotation(MOMENTS, START, TIMES), ts=TIMES
    )
    surface = film.surface
    triangles = np.concatenate([surface.faces[:, :3], surface.faces[:, [0, 2, 3]]])
    box = jr.from_mesh(surface.vertices, triangles)  # closed, and not inside out
    expected = np.asarray(TENSOR + jnp.eye(3))
    ratio = np.trace(box.inertia) / np.trace(expected)
    np.testing.assert_allclose(box.inertia / ratio, expected, atol=1e-12)
    np.testing.assert_allclose(np.max(np.linalg.norm(surface.vertices, axis=1)), 1)


def test_a_body_is_drawn_as_it_is_turned():
    corners = np.array([[0.0, 0, 0], [3, 0, 0], [0, 1, 0], [0, 0, 1.5]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    ax = jr.plot.body((corners, faces), START.attitude)
    np.testing.assert_allclose(faces_of(ax), corners[faces.ravel()] / 3)
    turned = jr.plot.body(
        (corners, faces), jr.rotation.exp(jnp.array([0.0, 0.0, jnp.pi / 2]))
    )
    np.testing.assert_allclose(
        faces_of(turned), faces_of(ax)[:, [1, 0, 2]] * [-1, 1, 1], atol=1e-15
    )
    for body, title in (
        (TOP, "Top"),
        ((1.0, 2.0, 3.0), "Box of the same inertia"),
        (jr.solids.rod(1.0, 2.0), "Box of the same inertia"),
    ):
        ax = jr.plot.body(body)
        assert ax.get_title().startswith(title + "\nI = ")
        assert ax.get_title().endswith("kg m$^2$")
    assert jr.plot.body(TOP, TILTED, kind="ellipsoid").get_title().startswith("Top")
    with pytest.raises(ValueError, match="`kind` must be one of 'box', 'ellipsoid'"):
        jr.plot.body(TOP, kind="cone")


ALL = jax.tree.map(lambda x: jnp.stack([x, x, x]), SPUN)
DRAGGED = jr.simulate(
    jr.RigidBody(MOMENTS, jr.torques.LinearDrag(0.1)), START, TIMES[::40]
)
REST = jr.State(START.attitude, jnp.zeros(3))
PLOT = jr.plot
ONE = "must be one motion, but it is several: take one"
WRONG = {
    "batch: animate": (lambda: PLOT.animate(TOP, ALL, ts=TIMES), ONE),
    "batch: tip": (lambda: PLOT.tip(TOP, ALL), ONE),
    "batch: potential": (lambda: PLOT.effective_potential(TOP, ALL), ONE),
    "batch: polhode": (lambda: PLOT.polhode(MOMENTS, ALL), ONE),
    "batch: herpolhode": (lambda: PLOT.herpolhode(MOMENTS, ALL), ONE),
    "batch: motion": (lambda: PLOT.motion(ALL, system=TOP, ts=TIMES), ONE),
    "batch of rates": (
        lambda: PLOT.polhode(MOMENTS, np.ones((2, 5, 3))),
        r"`motions` must have shape \(3,\) or \(n, 3\)",
    ),
    "times": (
        lambda: PLOT.animate(TOP, SPUN, ts=TIMES[:7]),
        r"`ts` must be a time for each of 801 states, but it has shape \(7,\)",
    ),
    "times back": (
        lambda: PLOT.animate(TOP, SPUN, ts=TIMES[::-1]),
        "`ts` must not decrease",
    ),
    "no frames": (
        lambda: PLOT.animate(TOP, SPUN, ts=TIMES, fps=0.0),
        "`fps` must be positive",
    ),
    "a state": (
        lambda: PLOT.motion(START, system=TOP, ts=0.0),
        "`motion` must hold many states, but it is a single one",
    ),
    "one frame": (
        lambda: PLOT.animate(
            TOP, jr.State(SPUN.attitude[:1], SPUN.omega[:1]), ts=TIMES[:1]
        ),
        "two states at least",
    ),
    "polhode at rest": (
        lambda: PLOT.polhode(MOMENTS, REST),
        "must turn, but one is at rest",
    ),
    "herpolhode at rest": (lambda: PLOT.herpolhode(MOMENTS, REST), "must turn"),
    "herpolhode of rates": (
        lambda: PLOT.herpolhode(MOMENTS, OMEGA),
        r"`motion` must be a motion or a State, but it is an array of shape \(3,\)",
    ),
    "herpolhode with drag": (
        lambda: PLOT.herpolhode(MOMENTS, DRAGGED),
        "must be free and keep",
    ),
    "axes of another name": (
        lambda: PLOT.motion(DRAGGED, {"drifts": None}),
        "`axes` must be one of 'omega', 'drift', but it is 'drifts'",
    ),
    "along no vector": (
        lambda: PLOT.motion(DRAGGED, along=(0.0, 1.0)),
        r"`along` must have shape \(3,\)",
    ),
    "along nothing": (
        lambda: PLOT.motion(DRAGGED, along=(0.0, 0.0, 0.0)),
        "`along` must be a direction",
    ),
    "no time to play": (
        lambda: PLOT.animate(MOMENTS, DRAGGED, seconds=-1.0),
        "`seconds` must be positive and finite, but it is -1.0",
    ),
    "trace of two numbers": (
        lambda: PLOT.animate(MOMENTS, DRAGGED, trace=np.ones(2)),
        r"`trace` must have shape \(3,\) or \(n, 3\)",
    ),
    "polhodes of no body": (
        lambda: PLOT.polhode(jnp.array([0.0, 1.0, 1.0]), OMEGA),
        "`body` must have positive moments",
    ),
    "polhode of NaN": (
        lambda: PLOT.polhode(MOMENTS, OMEGA * jnp.nan),
        "`motions` must have a finite state",
    ),
    "swapped": (
        lambda: PLOT.polhode(START, MOMENTS),
        "`body` must have or be an inertia, but it is a State",
    ),
    "no finite state": (
        lambda: PLOT.effective_potential(
            TOP, jr.State(START.attitude, OMEGA * jnp.nan)
        ),
        "must have a finite state",
    ),
    "no top": (lambda: PLOT.tip(TOP, MOMENTS), "`motion` must be a motion or a State"),
    "body along a path": (
        lambda: PLOT.body(MOMENTS, SPUN),
        "`attitude` must be one quaternion",
    ),
    "map without grid": (
        lambda: PLOT.chart(MAP),
        r"its shape is \(41, 31\) .* `grid` \(\)",
    ),
    "map over one axis": (
        lambda: PLOT.chart(MAP[0], {"b": AREA["b"]}),
        r"over two axes .* its shape is \(31,\)",
    ),
    "map and another grid": (
        lambda: PLOT.chart(MAP[:30], AREA),
        r"its shape is \(30, 31\) and that of `grid` \(41, 31\)",
    ),
    "narrow map": (
        lambda: PLOT.chart(MAP[:, :1], AREA | {"b": [0.0]}),
        r"two at least, but its shape is \(41, 1\)",
    ),
    "two quantities": (lambda: PLOT.chart({"u": MAP, "v": MAP}, AREA), "several: u, v"),
    "quantities of a named tuple": (
        lambda: PLOT.chart(jr.stability.top_stability(TOP, 3.0), AREA),
        "several: growth_rate_squared, growth_rate",
    ),
    "complex numbers": (
        lambda: PLOT.chart(1j * MAP, AREA),
        "`values` must be real or codes, but it is of complex128",
    ),
    "masked codes": (
        lambda: PLOT.chart(np.ma.masked_equal(HALVES, 2), AREA),
        "`values` must hold floats where it is masked",
    ),
    "too many regions": (
        lambda: PLOT.chart(np.arange(41 * 31).reshape(41, 31), AREA),
        "of few regions, but it has 1271",
    ),
    "too few names": (
        lambda: PLOT.chart(HALVES, AREA, regions=("sleeps", "nods")),
        "`regions` must name the codes 0 to 2",
    ),
    "names without a level": (
        lambda: PLOT.chart(MAP, AREA, regions=("below", "above")),
        "`regions` must name what is below and above a `level`",
    ),
    "names of texts": (
        lambda: PLOT.chart(HALVES.astype(str), AREA, regions=("a", "b")),
        "`regions` must be left out for texts",
    ),
    "level of codes": (
        lambda: PLOT.chart(HALVES, AREA, level=1.0),
        "`level` must be left out",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_drawn_is_told(name, untyped):
    call, message = WRONG[name]
    with pytest.raises(ValueError, match=message):
        call()
    assert not pyplot.get_fignums()  # no empty figure is left


# Animations


@pytest.fixture(scope="module")
def film():
    return jr.plot.animate(TOP, SPUN, ts=TIMES, seconds=2.0, fps=6.0)


def test_a_page_holds_all_frames_and_needs_nothing_else(film, tmp_path):
    page = film.save(tmp_path / "top.html").read_text()
    assert page == film.html
    assert len(page) < 20_000
    assert not any(x in page for x in ("http", "src=", "import ", "NaN"))
    start = page.index("const data = ") + len("const data = ")
    data, _ = json.JSONDecoder().raw_decode(page[start:])
    assert len(data["attitudes"]) == 12
    assert data["times"] == [0.0, 20.0]
    np.testing.assert_allclose(data["attitudes"], film.attitudes, atol=1e-4)
    assert data["trace"] == [[0.0, 0.0, 1.0]]
    assert {len(data[x]) for x in ("faces", "normals", "kinds")} == {
        len(film.surface.faces)
    }
    assert film._repr_html_().startswith("<iframe")


def test_frames_are_the_motion_between_its_states(film):
    exact = jr.top_motion(TOP, TILTED, jnp.asarray(film.times)).attitude
    same = np.abs(np.sum(film.attitudes * exact, axis=1))
    np.testing.assert_allclose(same, 1, atol=1e-6)
    body = jr.RigidBody(MOMENTS)
    trajectory = jr.simulate(body, START, TIMES[:20])
    cut = trajectory.states.attitude.at[10:].set(jnp.nan)  # an event
    short = jr.plot.animate(
        MOMENTS, jr.State(cut, trajectory.states.omega), ts=TIMES[:20]
    )
    assert short.times[-1] == TIMES[9]
    assert short.trace.shape == (0, 3)
    twice = jnp.array([0, 1, 2, 2])
    states = jr.State(SPUN.attitude[twice], SPUN.omega[twice])
    twice = jr.plot.animate(TOP, states, ts=TIMES[twice])
    assert np.all(np.isfinite(twice.attitudes))


def test_a_gif_has_all_frames(film, tmp_path):
    from PIL import Image

    with Image.open(film.save(tmp_path / "top.gif")) as picture:
        assert picture.n_frames == 12
        assert picture.info["duration"] == pytest.approx(1000 / 6, abs=10)
    slow = film._replace(fps=0.5, times=film.times[:2], attitudes=film.attitudes[:2])
    with Image.open(slow.save(tmp_path / "slow.gif")) as picture:
        assert picture.info["duration"] == 2000
    assert not pyplot.get_fignums()


def test_films_need_a_known_suffix_and_ffmpeg(film, tmp_path, monkeypatch):
    with pytest.raises(
        ValueError, match=r"`path` must be one of '.html', '.gif', '.mp4'"
    ):
        film.save(tmp_path / "top.avi")
    monkeypatch.setattr(FFMpegWriter, "isAvailable", classmethod(lambda _: False))
    with pytest.raises(RuntimeError, match="needs ffmpeg"):
        film.save(tmp_path / "top.mp4")


# All of them

CALLS = {
    "polhode": lambda **ax: jr.plot.polhode(MOMENTS, **ax),
    "tip": lambda **ax: jr.plot.tip(TOP, SPUN, **ax),
    "body": lambda **ax: jr.plot.body(MOMENTS, **ax),
    "herpolhode": lambda **ax: jr.plot.herpolhode(MOMENTS, START, ts=TIMES[:9], **ax),
    "effective_potential": lambda **ax: jr.plot.effective_potential(TOP, SPUN, **ax),
    "chart": lambda **ax: jr.plot.chart(MAP, AREA, **ax),
}


@pytest.mark.parametrize("name", CALLS)
def test_pictures_go_where_they_are_told(name, monkeypatch):
    space = name in ("polhode", "tip", "body")
    figure = pyplot.figure()
    ax = figure.add_subplot(1, 2, 2, projection="3d" if space else None)
    if space:
        ax.view_init(10, 20)
    assert CALLS[name](ax=ax) is ax
    assert pyplot.get_fignums() == [figure.number]
    if space:
        assert (ax.elev, ax.azim) == (10, 20)
        with pytest.raises(ValueError, match="`ax` must be 3-d"):
            CALLS[name](ax=figure.add_subplot(1, 2, 1))
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(ImportError, match=r"jrigid\[plot\]"):
        CALLS[name]()


def test_a_motion_without_the_extra_names_it(film, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(ImportError, match=r"jrigid\[plot\]"):
        jr.plot.motion(SPUN, system=TOP, ts=TIMES)
    with pytest.raises(ImportError, match=r"jrigid\[plot\]"):
        film.save(tmp_path / "top.gif")
    assert film.save(tmp_path / "top.html").exists()
