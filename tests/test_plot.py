"""Pictures: what is drawn is the physics it shows. Those of a fit are in test_fit_doors.py."""

import json
import sys

import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest

import jrigid as jr

matplotlib.use("Agg")
from matplotlib import pyplot
from matplotlib.animation import FFMpegWriter
from matplotlib.backend_bases import MouseEvent

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
        np.testing.assert_allclose(np.einsum("ni,ij,nj->n", curve, inverse, curve), level, 1e-12)
        # the library's, whose points are even in time, lies on it and it goes all the way round
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
    np.testing.assert_allclose(np.abs(curve[:, 2]), ratio * np.abs(curve[:, 0]), atol=1e-7)


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


@pytest.mark.parametrize("moments", [(1.0, 1.0, 1.8), (0.2, 1.0, 1.0), (1e-9, 1e-9, 1e-9)])
def test_bodies_of_revolution_and_spheres_have_polhodes(moments):
    ax = jr.plot.polhode(jnp.array(moments), OMEGA)
    momentum = np.asarray(moments) * OMEGA
    np.testing.assert_allclose(named(ax, "motion 1")[0], momentum / np.linalg.norm(momentum))
    drawn = [x for x in curves(ax) if len(x) > 2]
    alone = {1.0: 2, 0.2: 0}.get(moments[0])  # the axis of revolution
    assert len(drawn) == (0 if alone is None else 11)
    for curve in drawn[:4] if alone is not None else ():
        assert np.ptp(curve[:, alone]) < 1e-12
    ax.figure.canvas.draw()


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
    np.testing.assert_allclose(np.exp(1j * np.arctan2(y, x)), np.exp(1j * turned), atol=1e-9)


def test_a_pure_spin_and_a_separatrix_have_herpolhodes():
    ax = jr.plot.herpolhode(MOMENTS, jr.State(START.attitude, jnp.array([0.0, 0.0, 2.0])))
    assert np.max(np.hypot(*ax.lines[2].get_data())) < 1e-12
    assert ax.get_xlim()[1] > 0.1
    ax = jr.plot.herpolhode(MOMENTS, jr.State(START.attitude, jnp.array([1.0, 0.2, 1 / 3**0.5])))
    assert np.hypot(*ax.lines[0].get_data())[0] == 0


# Tops


def test_the_tip_stays_between_its_turning_points_and_touches_them():
    ax = jr.plot.tip(TOP, SPUN)
    _, low, high, path, start = curves(ax)
    bounds = jr.top.nutation_bounds(TOP, TILTED)
    for circle, tilt in ((low, bounds.theta_min), (high, bounds.theta_max)):
        np.testing.assert_allclose(circle[:, 2], np.cos(tilt), atol=1e-12)
    tilts = np.arccos(path[:, 2])
    np.testing.assert_allclose([np.min(tilts), np.max(tilts)], bounds, atol=1e-4)
    euler = np.asarray(jr.rotation.to_euler(SPUN.attitude[7]))
    azimuth = [np.sin(euler[1]) * np.sin(euler[0]), -np.sin(euler[1]) * np.cos(euler[0])]
    np.testing.assert_allclose(path[7, :2], azimuth, atol=1e-12)
    np.testing.assert_array_equal(start, path[:1])
    words = "{:.1f}° to {:.1f}°".format(*np.degrees(bounds))
    assert words in ax.get_title()
    hanging = jr.top_motion(TOP, jr.top.initial_state(TOP, 2.5, omega3=1.0), TIMES)
    assert jr.plot.tip(TOP, hanging).elev < 0 < ax.elev


def test_the_level_ends_on_the_well():
    steady = jr.top.initial_state(TOP, 0.5, omega3=6.0, phi_dot="slow")
    ax = jr.plot.effective_potential(TOP, SPUN, steady)
    for state, (well, level) in zip((TILTED, steady), (ax.lines[:2], ax.lines[2:]), strict=True):
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
    for state in (jr.top.initial_state(TOP, 0.0, omega3=5.0), jr.top.initial_state(TOP, 2.0)):
        jr.plot.effective_potential(TOP, state).figure.canvas.draw()


# Maps


def test_the_border_runs_where_the_level_is():
    ax = jr.plot.chart(MAP, AREA, level=0.0, regions=("below", "above"), title="gap [m]")
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
    kinds = np.unique(texts)
    np.testing.assert_array_equal(kinds[codes], texts.T)
    assert [ax.get_xlabel() for ax in drawn] == ["a [kg m^2]", "a [kg m^2]", "first"]


def test_narrow_regions_are_named_beside_the_map():
    kinds = np.where(np.abs(MAP) < 0.05, 2, MAP > 0)
    ax = jr.plot.chart(kinds, AREA, regions=("left", "right", "between"))
    assert [text.get_text() for text in ax.texts] == ["left", "right"]
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["between"]


def test_what_is_no_map_is_refused():
    with pytest.raises(ValueError, match="`values` must be over two axes"):
        jr.plot.chart(MAP[0], {"a": AREA["b"]})
    with pytest.raises(ValueError, match="`values` must be over two axes"):
        jr.plot.chart(MAP)
    with pytest.raises(ValueError, match="of few regions"):
        jr.plot.chart(np.arange(41 * 31).reshape(41, 31), AREA)


# Motions and bodies


def test_the_drift_is_that_of_energy_and_momentum():
    body = jr.RigidBody(MOMENTS, jr.torques.LinearDrag(0.1))
    trajectory = jr.simulate(body, START, TIMES[::40])
    axes = jr.plot.motion(trajectory)
    energy, momentum = (line.get_ydata() for line in axes["drift"].lines[:2])
    known = np.asarray(trajectory.energy)
    np.testing.assert_allclose(energy[1:], np.abs(known - known[0])[1:] / known[0], 1e-12)
    known = np.asarray(trajectory.angular_momentum)
    lost = np.linalg.norm(known - known[0], axis=1) / np.linalg.norm(known[0])
    np.testing.assert_allclose(momentum[1:], lost[1:], 1e-12)
    np.testing.assert_array_equal(axes["omega"].lines[2].get_ydata(), trajectory.states.omega[:, 2])
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
    return np.reshape(ax.collections[0]._faces, (-1, 3))


def test_the_box_drawn_has_the_inertia():
    film = jr.plot.animate(TENSOR + jnp.eye(3), jr.free_rotation(MOMENTS, START, TIMES), ts=TIMES)
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
    turned = jr.plot.body((corners, faces), jr.rotation.exp(jnp.array([0.0, 0.0, jnp.pi / 2])))
    np.testing.assert_allclose(
        faces_of(turned), faces_of(ax)[:, [1, 0, 2]] * [-1, 1, 1], atol=1e-15
    )
    for body, title in ((TOP, "Top"), (jr.solids.rod(1.0, 2.0), "Box of the same inertia")):
        ax = jr.plot.body(body)
        assert ax.get_title().startswith(title + "\nI = ")
        assert ax.get_title().endswith("kg m$^2$")
    assert jr.plot.body(TOP, TILTED, kind="ellipsoid").get_title().startswith("Top")
    with pytest.raises(ValueError, match="`kind` must be one of 'box', 'ellipsoid'"):
        jr.plot.body(TOP, kind="cone")


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
    assert {len(data[x]) for x in ("faces", "normals", "kinds")} == {len(film.surface.faces)}
    assert film._repr_html_().startswith("<iframe")


def test_frames_are_the_motion_between_its_states(film):
    exact = jr.top_motion(TOP, TILTED, jnp.asarray(film.times)).attitude
    same = np.abs(np.sum(film.attitudes * exact, axis=1))
    np.testing.assert_allclose(same, 1, atol=1e-6)
    body = jr.RigidBody(MOMENTS)
    trajectory = jr.simulate(body, START, TIMES[:20])
    cut = trajectory.states.attitude.at[10:].set(jnp.nan)  # an event
    short = jr.plot.animate(MOMENTS, jr.State(cut, trajectory.states.omega), ts=TIMES[:20])
    assert short.times[-1] == TIMES[9]
    assert short.trace.shape == (0, 3)
    with pytest.raises(ValueError, match="two states at least"):
        jr.plot.animate(TOP, TILTED, ts=TIMES[:1])


def test_a_gif_has_all_frames(film, tmp_path):
    from PIL import Image

    with Image.open(film.save(tmp_path / "top.gif")) as picture:
        assert picture.n_frames == 12
    assert not pyplot.get_fignums()


def test_films_need_a_known_suffix_and_ffmpeg(film, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"`path` must be one of '.html', '.gif', '.mp4'"):
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
