"""Pictures of light curves: what is drawn is the model and the data that it shows."""

import dataclasses

import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest

import jrigid as jr

matplotlib.use("Agg")
from matplotlib import pyplot

ph = jr.photometry
HOUR = 3600.0
DAY = 86400.0
SHAPE = ph.Ellipsoid(jnp.array([1.0, 0.7, 0.5]))
TUMBLER = ph.Tumbler(
    SHAPE.moments, 12 * HOUR, 60 * HOUR, 1.0, -0.4, 0.3, 0.2, SHAPE, mode="short-axis"
)
SPINNER = ph.Tumbler(
    SHAPE.moments, 6 * HOUR, 1.0, 0.5, 1.2, 0.3, 0.0, SHAPE, mode="principal-axis"
)
EPOCH = 2451545.0


@pytest.fixture(autouse=True)
def closed():
    yield
    pyplot.close("all")


def geometry(ts):
    """Vectors to a Sun and an observer that move."""
    angle = ts / (40 * DAY)
    sun = 1e11 * np.stack([np.cos(angle), np.sin(angle), 0.2 + 0 * ts], axis=1)
    observer = 1e11 * np.stack([0.8 - angle, 0.5 + 0 * ts, 0.1 + 0 * ts], axis=1)
    return sun, observer


def made(tumbler, noise=0.0):
    """Two relative curves and two calibrated ones, of which a factor is unknown each.

    The reader's order is not that of time, and their time 0 is not the model's.
    """
    rng = np.random.default_rng(0)
    curves = []
    for night, is_relative in ((3, True), (0, True), (1, False), (2, False)):
        ts = night * DAY + np.sort(rng.uniform(0.0, 2 * HOUR, 7))
        sun, observer = geometry(ts)
        light = np.asarray(tumbler.light_curve(ts, sun, observer))
        shift = 1.7 if not is_relative else rng.normal()
        light = light * 10 ** (-0.4 * (shift + noise * rng.normal(size=7)))
        early = ts + 0.5 * DAY
        curves.append(
            ph.LightCurve(EPOCH - 0.5, early, light, sun, observer, is_relative)
        )
    return curves


CURVES = made(TUMBLER)


def estimates(first, second):
    """Numbers of an alias of which only the periods are drawn."""
    one = np.asarray(1.0)
    hours = [np.asarray(x * HOUR) for x in (first, second)]
    return ph.Estimates(*hours, one, one, one, np.ones(2), np.ones(2))


def alias(tumbler, first, second, weight):
    """A row of a table."""
    return ph.Alias(
        tumbler=tumbler,
        estimates=estimates(first, second),
        errors=estimates(0.1, 0.5),
        chi_square=10.0,
        weight=weight,
        residuals=np.zeros(28),
        numbers=np.zeros(11),
        task=None,
        covariance=np.eye(11),
    )


@pytest.fixture
def inversion(untyped):
    """A table made by hand."""
    aliases = [
        alias(TUMBLER, 12.0, 60.0, 0.9),
        alias(SPINNER, 6.0, np.nan, 0.1),
    ]
    return ph.Inversion(
        aliases=aliases,
        rejected=[alias(TUMBLER, 14.0, 50.0, 0.0)],
        epoch=EPOCH,
        noise=0.01,
        reduced_chi_square=1.0,
        degrees_of_freedom=20,
        correlation=0.0,
        follows=True,
        determined=False,
        span=3 * DAY,
    )


def points_in(ax):
    """All points that are drawn, in the order of the axis."""
    drawn = [np.array(x.get_data()) for x in ax.lines if x.get_marker() in "osd^"]
    both = np.concatenate(drawn, axis=1)
    return both[:, np.argsort(both[0], kind="stable")]


@pytest.mark.parametrize("tumbler", [TUMBLER, SPINNER], ids=["tumbler", "spinner"])
def test_points_without_noise_lie_on_the_model_in_every_picture(tumbler):
    axes = jr.plot.light_curves(made(tumbler), tumbler, epoch=EPOCH)
    np.testing.assert_allclose(points_in(axes["residuals"])[1], 0.0, atol=1e-9)
    places, magnitudes = points_in(axes["unfolded"])
    line = np.array(axes["unfolded"].lines[0].get_data())
    model = np.interp(places, *line[:, np.isfinite(line[0])])
    np.testing.assert_allclose(magnitudes, model, atol=2e-3)
    assert axes["unfolded"].yaxis_inverted()
    if tumbler is SPINNER:
        line = axes["folded"].lines[0].get_data()
        phases, magnitudes = points_in(axes["folded"])
        assert 0 <= phases.min() < phases.max() < 1
        np.testing.assert_allclose(magnitudes, np.interp(phases, *line), atol=1e-3)
        np.testing.assert_allclose(line[1][0], line[1][-1], atol=1e-9)


def test_a_tumbler_is_folded_by_both_periods():
    ax = pyplot.figure().add_subplot()
    given = {"folded": ax}
    assert jr.plot.light_curves(CURVES, TUMBLER, given, epoch=EPOCH) == given
    ground, points = ax.collections
    phases = np.asarray(points.get_offsets())
    ts = np.sort(np.concatenate([x.ts for x in CURVES])) - 0.5 * DAY
    expected = np.stack([ts / (12 * HOUR), ts / (60 * HOUR)], axis=1) % 1
    np.testing.assert_allclose(phases, expected, atol=1e-9)
    side = int(np.sqrt(ground.get_array().size))
    cells = np.reshape(ground.get_array(), (side, side))
    across, up = np.minimum((phases * side).astype(int), side - 1).T
    # A cell is 1/48 of a period wide: the magnitudes agree but for the slope in it.
    near = points.get_array() - cells[up, across]
    assert np.max(np.abs(near)) < 0.08 < 0.5 < np.ptp(cells)
    assert ground.get_clim() == points.get_clim()


def test_gaps_are_cut_out_and_the_times_written_below():
    ax = jr.plot.light_curves(CURVES, TUMBLER, epoch=EPOCH)["unfolded"]
    places, _ = points_in(ax)
    ts = np.sort(np.concatenate([x.ts for x in CURVES]))
    within = np.diff(ts) < 3 * HOUR
    np.testing.assert_allclose(np.diff(places)[within], np.diff(ts)[within], rtol=1e-9)
    assert np.ptp(places) < 10 * HOUR
    firsts = ts[np.concatenate([[True], ~within])] - ts[0]
    shown = [x.get_text() for x in ax.get_xticklabels()]
    assert shown == [f"{x / HOUR / 24:.1f}" for x in firsts]
    assert "[d]" in ax.get_xlabel()
    assert [x.get_text() for x in ax.texts] == ["50 min"]


def test_curves_of_one_stretch_have_no_gaps():
    ax = jr.plot.light_curves(CURVES[:1], TUMBLER, epoch=EPOCH)["unfolded"]
    assert ax.get_xlabel() == "time since the first point [min]"
    assert not ax.texts


def test_residuals_are_those_of_the_points_and_noise_has_its_range(inversion):
    curves = made(TUMBLER, noise=0.05)
    axes = jr.plot.light_curves(curves, inversion)
    _, residuals = points_in(axes["residuals"])
    expected = []
    for part in (curves[:1], curves[1:2], curves[2:]):
        left = []
        for curve in part:
            ts = curve.ts - 0.5 * DAY
            light = TUMBLER.light_curve(ts, curve.to_sun, curve.to_observer)
            left.append(-2.5 * np.log10(curve.brightness / np.asarray(light)))
        left = np.concatenate(left)
        expected.append(left - left.mean())
    ordered = np.concatenate([expected[1], expected[2], expected[0]])
    np.testing.assert_allclose(residuals, ordered, atol=1e-9)
    band = axes["residuals"].patches[0]
    np.testing.assert_allclose(band.get_height(), 2 * 1.96 * 0.01)


def test_the_map_of_periods_holds_aliases_and_candidates(inversion):
    pairs = ph.PeriodPairs(
        np.array([10.0, 100.0]) * HOUR, np.array([25.0, 40.0]) * HOUR, np.ones(2)
    )
    ax = jr.plot.period_map(inversion, pairs)
    dots = ax.lines[0]
    np.testing.assert_allclose(dots.get_data(), [[10, 100], [25, 40]])
    drawn = {x.get_label(): x for x in ax.containers}
    best = drawn["short-axis"].lines[0]
    np.testing.assert_allclose(np.array(best.get_data(), float), [[12], [60]])
    rejected = drawn["short-axis, rejected"].lines[0]
    np.testing.assert_allclose(np.array(rejected.get_data(), float), [[14], [50]])
    assert rejected.get_markerfacecolor() == "none"
    (steady,) = [x for x in ax.lines if x.get_label() == "principal-axis"]
    np.testing.assert_allclose(steady.get_xdata(), 6)
    assert [x.get_text() for x in ax.texts] == ["1", "2", "weights\n1: 0.9\n2: 0.1"]
    assert (ax.get_xscale(), ax.get_yscale()) == ("log", "linear")


def greys_and_corners(ax):
    """Grey and corners of each face."""
    faces = ax.collections[0]
    corners = [x.vertices[:-1] for x in faces.get_paths()]
    return faces.get_facecolors()[:, 0], corners


def outline_area(corners):
    """Area on the sky of all faces that are seen."""
    total = 0.0
    for face in corners:
        x, y = face.T
        total += abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))) / 2
    return total


def test_the_disc_has_the_area_and_the_light_of_the_body():
    to_sun = np.array([0.3, 1.0, 0.4])
    to_observer = np.array([1.0, 0.2, -0.3])
    attitude = jr.rotation.normalize(jnp.array([0.8, 0.3, -0.4, 0.2]))
    ax = jr.plot.appearance(SHAPE, to_sun, to_observer, attitude)
    greys, corners = greys_and_corners(ax)
    # A projected ellipsoid has the area pi |A| |A^-1 e|, A with the semi-axes.
    unit = to_observer / np.linalg.norm(to_observer)
    in_body = np.asarray(jr.rotation.rotate_inverse(attitude, jnp.asarray(unit)))
    semi_axes = np.asarray(SHAPE.semi_axes)
    area = np.pi * np.prod(semi_axes) * np.linalg.norm(in_body / semi_axes)
    np.testing.assert_allclose(outline_area(corners), area, rtol=5e-3)
    # The sum of the light of all faces is the brightness, but for a factor.
    light = (greys - greys.min()) / (1 - greys.min())
    sums = [sum(k * outline_area([x]) for k, x in zip(light, corners, strict=True))]
    opposite = jr.plot.appearance(SHAPE, to_observer, to_observer, attitude)
    greys, corners = greys_and_corners(opposite)
    np.testing.assert_allclose(greys, 1.0, atol=1e-9)  # Lommel and Seeliger's full disc
    sums.append(outline_area(corners) / 2)
    sun = jr.rotation.rotate_inverse(attitude, jnp.asarray(to_sun))
    exact = [ph.brightness(SHAPE, x, in_body) for x in (sun, in_body)]
    # Of mu0 / (mu0 + mu), the largest is 1, at the edge that faces the Sun.
    np.testing.assert_allclose(sums[0] / sums[1], float(exact[0] / exact[1]), rtol=0.03)


def test_north_is_up_and_longitudes_grow_to_the_left():
    attitude = (1.0, 0.0, 0.0, 0.0)
    corners = np.array([[0, 0, 0], [1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    # Seen from the x axis; the y axis is at a larger longitude of what lies behind.
    ax = jr.plot.appearance(
        (corners, faces), np.array([1.0, -1, 1]), np.array([-1.0, 0, 0]), attitude
    )
    _, drawn = greys_and_corners(ax)
    points = {tuple(x.round(9) + 0.0) for face in drawn for x in face}
    assert points == {(0.0, 0.0), (-1.0, 0.0), (0.0, 1.0)}
    sun = ax.lines[-1].get_data()
    assert sun[0][1] > 0  # to the right, at a smaller longitude
    assert sun[1][1] > 0


def test_a_tumbler_is_seen_at_its_time():
    ts = np.array([7 * HOUR])
    sun, observer = geometry(ts)
    motion = jr.free_rotation(SHAPE.moments, TUMBLER.state, ts)
    by_hand = jr.plot.appearance(SHAPE, sun[0], observer[0], motion.attitude[0])
    ax = jr.plot.appearance(TUMBLER, sun[0], observer[0], time=7 * HOUR)
    for one, other in zip(
        greys_and_corners(ax), greys_and_corners(by_hand), strict=True
    ):
        np.testing.assert_allclose(np.array(one), np.array(other), atol=1e-9)


def test_facets_alone_are_drawn_as_the_body_that_has_them():
    ts = np.array([7 * HOUR])
    sun, observer = geometry(ts)
    whole = jr.plot.appearance(TUMBLER, sun[0], observer[0], time=ts[0])
    faceted = dataclasses.replace(TUMBLER, shape=SHAPE.facets(20))
    ax = jr.plot.appearance(faceted, sun[0], observer[0], time=ts[0])
    areas = [outline_area(greys_and_corners(x)[1]) for x in (ax, whole)]
    np.testing.assert_allclose(*areas, rtol=0.03)


def test_a_film_is_seen_from_the_observer_above_its_curve(tmp_path):
    film = jr.plot.animate_light_curve(
        CURVES[1], TUMBLER, epoch=EPOCH, seconds=2.0, fps=3.0
    )
    start = CURVES[1].ts[0] - 0.5 * DAY
    ts = film.times + start
    sun, observer = geometry(ts)
    expected = TUMBLER.light_curve(ts, sun, observer)
    # The brightness depends on directions in the body alone.
    seen = []
    for attitude, light in zip(film.attitudes, film.lights, strict=True):
        towards = [
            jr.rotation.rotate_inverse(jnp.asarray(attitude), jnp.asarray(x))
            for x in (light, np.eye(3)[0])
        ]
        seen.append(float(ph.brightness(SHAPE, *towards)))
    np.testing.assert_allclose(seen, expected, rtol=1e-3)
    magnitudes = -2.5 * np.log10(np.asarray(expected))
    shifted = film.curve.values - film.curve.values[0]
    np.testing.assert_allclose(shifted, magnitudes - magnitudes[0], atol=2e-3)
    assert film.unit == (60.0, "min")
    page = film.save(tmp_path / "curve.html").read_text()
    assert "NaN" not in page
    assert '"lights":[[' in page
    assert film.save(tmp_path / "curve.gif").stat().st_size > 1000
    assert not pyplot.get_fignums()


FACETS = ph.Tumbler(
    SHAPE.moments, 6 * HOUR, 1.0, 0.5, 1.2, 0.3, 0.0, SHAPE.facets(4), mode=SPINNER.mode
)
X = np.eye(3)[0]
PLATE = dataclasses.replace(FACETS, shape=ph.Facets(np.ones(1), X[None]))
WRONG = {
    "no curves": (
        lambda: jr.plot.light_curves([], TUMBLER),
        "`curves` must hold a light curve",
    ),
    "no such picture": (
        lambda: jr.plot.light_curves(CURVES, TUMBLER, {"fold": None}),
        "`axes` must be one of",
    ),
    "facets": (
        lambda: jr.plot.appearance(PLATE, X, X),
        "`facets` must have normals in all directions",
    ),
    "no attitude": (
        lambda: jr.plot.appearance(SHAPE, X, X),
        "`attitude` must be one quaternion or State",
    ),
    "an attitude": (
        lambda: jr.plot.appearance(TUMBLER, X, X, np.ones(4)),
        "`attitude` must be left out for a `Tumbler`",
    ),
    "no vector": (
        lambda: jr.plot.appearance(TUMBLER, 0 * X, X),
        "`to_sun` must be a finite vector other than 0",
    ),
    "vectors": (
        lambda: jr.plot.appearance(TUMBLER, X, np.ones((2, 3))),
        r"`to_observer` must have shape \(3,\)",
    ),
    "no frames": (
        lambda: jr.plot.animate_light_curve(CURVES[0], SPINNER, fps=0.0),
        "`fps` must be positive",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_drawn_is_said(name, untyped):
    call, message = WRONG[name]
    with pytest.raises(ValueError, match=message):
        call()
    assert not pyplot.get_fignums()


def test_an_inversion_has_its_epoch_and_its_aliases(inversion):
    with pytest.raises(ValueError, match="`epoch` must be left out for an `Inversion`"):
        jr.plot.light_curves(CURVES, inversion, epoch=EPOCH)
    with pytest.raises(ValueError, match="`alias` must be one of 0, 1"):
        jr.plot.light_curves(CURVES, inversion, alias=2)
