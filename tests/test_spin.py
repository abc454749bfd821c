"""Inversion to a spin and a convex shape: bodies made by plain numpy are found."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from jrigid import photometry as ph
from jrigid._core.host_rows import rows_of
from jrigid.photometry import _convex as convex
from jrigid.photometry import _curve_readings as readings
from jrigid.photometry import _spin as spin
from jrigid.photometry import _spin_search as search
from jrigid.photometry._many_starts import Quadratic

HOUR, DAY, AU = 3600.0, 86400.0, 149597870700.0
PERIOD = 7.1 * HOUR
POLE = np.deg2rad([130.0, 40.0])
LAW = {"lambert": 0.1, "amplitude": 0.4, "width": 0.12, "slope": -0.6}
RANGE = {"shortest": 7.098 * HOUR, "longest": 7.102 * HOUR}
POINTS = 15  # in a night
SMALL = {"degree": 3, "facets": 128}


@functools.cache
def shape():
    """Areas and normals of a convex body without symmetry: a bent ellipsoid."""
    around, along = np.meshgrid(np.arange(40), np.arange(1, 20))
    phi = np.pi * (around + 0.5) / 20
    theta = np.pi * along / 20
    corners = np.stack(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1
    ).reshape(-1, 3)
    corners[:, 0] += 0.15 * corners[:, 0] ** 2 + 0.1 * corners[:, 2] ** 2
    corners = corners * [1.6, 1.1, 0.9]
    facets = ph.facets_from_mesh(corners, np.zeros((1, 3), int), hull=True)
    return np.asarray(facets.areas), np.asarray(facets.normals)


def directions(ts, inclination):
    """Vectors to the Sun and to the Earth from a body in the main belt."""
    orbit = 2 * np.pi * ts / (1300 * DAY)
    year = 2 * np.pi * ts / (365.25 * DAY) + 0.3
    height = np.sin(inclination) * np.sin(orbit)
    sun = -2.3 * np.stack([np.cos(orbit), np.sin(orbit), height], axis=1)
    earth = np.stack([np.cos(year), np.sin(year), 0 * ts], axis=1)
    return AU * sun, AU * (sun + earth)


def light_by_numpy(ts, sun, earth, albedo):
    """Brightness of the body, with nothing of the package."""
    areas, normals = shape()
    reflecting = areas * np.exp(normals @ albedo)
    sun = sun / np.linalg.norm(sun, axis=1, keepdims=True)
    earth = earth / np.linalg.norm(earth, axis=1, keepdims=True)
    angles = np.stack(
        [0 * ts + POLE[0], 0 * ts + np.pi / 2 - POLE[1], 2 * np.pi * ts / PERIOD], 1
    )
    to_body = Rotation.from_euler("ZYZ", angles).inv()
    mu0 = np.maximum(to_body.apply(sun) @ normals.T, 0.0)
    mu = np.maximum(to_body.apply(earth) @ normals.T, 0.0)
    scattered = mu0 * mu * (1 / np.maximum(mu0 + mu, 1e-300) + LAW["lambert"])
    alpha = np.arccos(np.sum(sun * earth, axis=1))
    phase = 1 + LAW["amplitude"] * np.exp(-alpha / LAW["width"]) + LAW["slope"] * alpha
    return phase * (scattered @ reflecting)


def observed(noise, relative, inclination, albedo=(0.0, 0.0, 0.0), nights=16):
    """Light curves of some nights in two years, with noise [mag]."""
    rng = np.random.default_rng(5)
    curves = []
    for night in np.sort(rng.uniform(0.0, 2 * 365.0, nights)):
        ts = night * DAY + np.sort(rng.uniform(0.0, 6 * HOUR, POINTS))
        sun, earth = directions(ts, inclination)
        light = light_by_numpy(ts, sun, earth, np.array(albedo))
        light *= 10 ** (-0.4 * noise * rng.normal(size=POINTS))
        if relative:
            light /= light.mean()
        curves.append(ph.LightCurve(2450000.5, ts, light, sun, earth, relative))
    return curves


def apart(estimates, pole):
    """Angle between a pole that was found and another one [deg]."""
    ends = []
    for longitude, latitude in ((estimates.longitude, estimates.latitude), pole):
        across = np.cos(latitude)
        ends.append(
            [across * np.cos(longitude), across * np.sin(longitude), np.sin(latitude)]
        )
    return np.rad2deg(np.arccos(np.clip(np.dot(*ends), -1, 1)))


@functools.cache
def found():
    """The inversion of relative curves from an orbit with an inclination."""
    curves = observed(0.01, True, np.deg2rad(12.0))
    return curves, ph.find_spin(curves, 0.01, **RANGE, **SMALL)


def test_period_and_pole_are_found():
    _, result = found()
    best = result.solutions[0]
    assert result.follows
    assert abs(best.estimates.period - PERIOD) < 4 * best.errors.period
    assert best.errors.period < 0.05
    assert apart(best.estimates, POLE) < 2.0
    assert best.open_share < 0.02
    np.testing.assert_allclose(np.std(best.residuals), 0.01, rtol=0.15)


def test_the_body_has_the_light_of_the_fit():
    curves, result = found()
    body = result.solutions[0].body
    sun, earth = (
        np.concatenate([getattr(x, name) for x in curves])
        for name in ("to_sun", "to_observer")
    )
    ts = np.concatenate([x.ts for x in curves])
    ts += (curves[0].epoch - result.epoch) * DAY
    light = np.asarray(body.light_curve(ts, sun, earth)).reshape(len(curves), -1)
    magnitudes = -2.5 * np.log10([x.brightness for x in curves] / light)
    left = magnitudes - magnitudes.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(left.ravel(), result.solutions[0].residuals, atol=1e-7)
    np.testing.assert_allclose(np.sum(body.shape.areas), 4 * np.pi)


def test_the_mirror_is_named_and_excluded_by_the_inclination():
    _, result = found()
    mirror = (POLE[0] + np.pi, POLE[1])
    assert result.mirror is not None
    assert apart(result.mirror.estimates, mirror) < 30
    assert len(result.solutions) == 1
    assert "The mirror of 1, with its pole at longitude" in result.report()


def test_the_plane_of_the_ecliptic_leaves_two_poles():
    curves = observed(0.01, True, 0.0)
    result = ph.find_spin(curves, 0.01, **RANGE, **SMALL)
    assert len(result.solutions) == 2
    assert result.solutions[1] is result.mirror
    first, second = (x.chi_square for x in result.solutions)
    assert second - first < 0.1
    poles = [POLE, (POLE[0] + np.pi, POLE[1])]
    nearest = [
        min(apart(x.estimates, pole) for pole in poles) for x in result.solutions
    ]
    assert max(nearest) < 3
    assert "Solution 2 is the mirror of 1" in result.report()


def test_calibrated_curves_give_the_phase_function_and_the_albedo():
    albedo = np.array([0.15, -0.1, 0.05])
    curves = observed(0.008, False, np.deg2rad(12.0), albedo)
    start = ph.Mixture(0.1, amplitude=0.5, width=0.1, slope=-0.5)
    result = ph.find_spin(
        curves,
        **RANGE,
        **SMALL,
        scattering=start,
        fitted=["amplitude", "width", "slope"],
        albedo=True,
    )
    best = result.solutions[0]
    np.testing.assert_allclose(result.noise, 0.008, rtol=0.25)
    truth = [LAW[name] for name in ("amplitude", "width", "slope")]
    off = (best.estimates.scattering[1:] - truth) / best.errors.scattering[1:]
    assert np.max(np.abs(off)) < 4
    # The body axes are those of the truth but for the angle about z.
    along = best.estimates.albedo[2] - albedo[2]
    assert abs(along) < 4 * best.errors.albedo[2]
    size = np.linalg.norm(best.estimates.albedo)
    np.testing.assert_allclose(size, np.linalg.norm(albedo), atol=0.06)
    assert "albedo varies by a factor of" in result.report()


def test_harmonics_are_those_of_scipy():
    normals = convex.even_directions(60)
    theta = np.arccos(normals[:, 2])
    phi = np.arctan2(normals[:, 1], normals[:, 0])
    expected = []
    for degree in range(1, 6):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), theta, phi) * (-1) ** order
            part = value.imag if order < 0 else value.real
            expected.append(part * np.sqrt(4 * np.pi * (1 if order == 0 else 2)))
    np.testing.assert_allclose(
        convex.real_harmonics(normals, 5), np.stack(expected, axis=1), atol=1e-13
    )


def test_derivatives_are_those_of_central_differences():
    curves = observed(0.01, False, 0.2, nights=6)
    taken, _ = readings.readings_of(curves, 0.01)
    start = ph.Mixture(0.2, amplitude=0.4, width=0.1, slope=-0.5)
    surface = convex.surface_of(
        np.ones(3, bool), 3, 80, start, convex.SCATTERING, True, 0.01
    )
    # Arrays of JAX, as those of a compiled program are.
    on_device, data = jax.tree.map(jnp.asarray, (surface, taken))
    rng = np.random.default_rng(1)
    frame = jnp.asarray(Rotation.random(random_state=2).as_matrix())
    vector = surface.centre + 0.2 * rng.normal(size=surface.centre.size)
    vector[0] = 500.0

    @jax.jit
    def rows(vector):
        return convex.spin_rows(vector, frame, on_device, data)

    @jax.jit
    def quadratic(vector):
        return convex.spin_quadratic(vector, frame, on_device, data)

    slopes = rows(jnp.asarray(vector)).slopes
    half_gradient = quadratic(jnp.asarray(vector)).slope
    for index in range(vector.size):
        step = 1e-5 * (np.arange(vector.size) == index)
        ahead = jnp.asarray(vector + step)
        behind = jnp.asarray(vector - step)
        difference = rows(ahead).residuals - rows(behind).residuals
        scale = np.max(np.abs(slopes[:, index])) + 1
        assert np.max(np.abs(difference / 2e-5 - slopes[:, index])) < 1e-6 * scale
        growth = quadratic(ahead).chi_square - quadratic(behind).chi_square
        expected = 2 * half_gradient[index]
        np.testing.assert_allclose(growth / 2e-5, expected, rtol=1e-5, atol=1.0)


def test_a_tumbler_is_refused_by_its_misfit():
    curves = observed(0.01, True, 0.2)
    rng = np.random.default_rng(3)
    spoiled = [
        dataclasses.replace(x, brightness=x.brightness * rng.uniform(0.8, 1.2, POINTS))
        for x in curves
    ]
    result = ph.find_spin(spoiled, 0.01, shortest=PERIOD, longest=PERIOD, **SMALL)
    assert not result.follows
    assert "No steady rotation was found" in result.report()


@pytest.mark.parametrize(("factor", "follows"), [(1.0, True), (1.03, False)])
def test_a_noise_that_is_not_stated_does_not_hide_a_misfit(factor, follows):
    period = factor * PERIOD
    result = ph.find_spin(
        observed(0.01, True, 0.2), shortest=period, longest=period, **SMALL
    )
    assert result.follows == follows
    assert (result.correlation > 0.3) != follows
    assert "found from what the fit leaves" in result.report()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"curves": []}, "must hold a light curve, but it is empty"),
        ({"threshold": -1.0}, "`threshold` must not be negative"),
        ({"noise": 0.0}, "`noise` must be a positive number or None"),
        ({"shortest": 8.0 * HOUR}, "must be periods in seconds in rising order"),
        ({"shortest": 60.0}, "trial periods, more than 50000: narrow the range"),
        ({"degree": 1}, "`degree` must be"),
        ({"degree": 13}, "`degree` must be at most 12, but it is 13"),
        ({"facets": 20}, "`facets` must be"),
        ({"fitted": ["colour"]}, "`fitted`"),
        (
            {"fitted": ["slope"]},
            "must be empty or `lambert` for curves that are relative",
        ),
        ({"closure": 0.0}, "`closure` must be positive"),
        ({"scattering": ph.Mixture(-0.1)}, "must have a positive `lambert`"),
        ({"scattering": ph.Mixture(0.1, width=0.0)}, "must have a positive `width`"),
    ],
)
def test_malformed_arguments_say_what_to_pass(changes, message):
    arguments = {"curves": observed(0.01, True, 0.0, nights=3), "noise": 0.01, **RANGE}
    with pytest.raises(ValueError, match=message):
        ph.find_spin(**(arguments | changes))


def test_errors_of_points_are_no_noise(untyped):
    curves = observed(0.01, True, 0.0, nights=3)
    with pytest.raises(ValueError, match="are those of a `LightCurve`"):
        ph.find_spin(curves, np.array([0.01, 0.02]), **RANGE)


def test_curves_at_one_time_and_epochs_of_two_kinds_are_refused():
    curves = observed(0.01, True, 0.0, nights=3)
    still = [dataclasses.replace(x, ts=0 * x.ts) for x in curves]
    with pytest.raises(ValueError, match="more than half of `shortest`, but they span"):
        ph.find_spin(still, 0.01, **RANGE)
    mixed = [*curves[:2], dataclasses.replace(curves[2], epoch=curves[2].epoch - 2.4e6)]
    with pytest.raises(ValueError, match="are some modified Julian dates"):
        ph.find_spin(mixed, 0.01, **RANGE)


def test_sparse_calibrated_points_of_one_curve_say_something_of_the_phase_function():
    curves = observed(0.01, False, 0.2)

    def joined(name):
        return np.concatenate([getattr(x, name) for x in curves])

    fields = ("ts", "brightness", "to_sun", "to_observer")
    one = dataclasses.replace(curves[0], **{name: joined(name) for name in fields})
    search = {"shortest": PERIOD, "longest": PERIOD, "fitted": ("slope",), **SMALL}
    both = [ph.find_spin(x, 0.01, **search).solutions[0] for x in (curves, [one])]
    np.testing.assert_allclose(both[0].chi_square, both[1].chi_square, rtol=1e-6)


@pytest.mark.parametrize("factor", [1.0, 1.03])
def test_a_noise_stated_too_large_does_not_hide_a_misfit(factor):
    """At another period neighbouring residuals are alike."""
    period = factor * PERIOD
    found = ph.find_spin(
        observed(0.01, True, 0.2), 0.2, shortest=period, longest=period, **SMALL
    )
    assert found.reduced_chi_square < 0.3
    assert found.follows == (factor == 1.0)


def test_errors_of_a_pole_hold_other_minima_about_it():
    """Two minima as good, across longitude 0, are one pole of twice the spread."""
    _, inversion = found()
    first = inversion.solutions[0]

    def moved(longitude, chi_square):
        estimates = first.estimates._replace(longitude=np.asarray(longitude))
        return dataclasses.replace(first, estimates=estimates, chi_square=chi_square)

    own = first.errors.longitude
    alone = spin._with_spread([moved(0.1, 50.0)], 1.0)
    np.testing.assert_allclose(alone.errors.longitude, own)
    both = spin._with_spread([moved(6.2, 50.0), moved(0.1, 50.0)], 1.0)
    gap = 0.1 - (6.2 - 2 * np.pi)
    expected = np.sqrt(own**2 + gap**2 / 2)
    np.testing.assert_allclose(both.errors.longitude, expected)
    np.testing.assert_allclose(both.errors.period, first.errors.period)
    # A minimum that is much worse adds nothing.
    worse = spin._with_spread([moved(6.2, 150.0), moved(0.1, 50.0)], 1.0)
    np.testing.assert_allclose(worse.errors.longitude, own)
    assert worse.estimates.longitude == 0.1


def test_minima_about_a_pole_are_told_from_other_poles():
    # Turns, longitude and latitude are the first numbers, in the frame of the pole.
    numbers = np.zeros((4, 12))
    numbers[:, 0] = [10.0, 10.1, 10.0, 10.0]
    numbers[:, 1] = [0.0, 0.1, 0.5, 0.0]
    numbers[:, 2] = [0.0, 0.0, 0.0, 0.05]
    frames = np.tile(search.frame_of_pole(np.array([1.0, 0.0, 0.0])), (4, 1, 1))
    quadratic = Quadratic(np.arange(4.0), np.zeros((4, 12)), np.zeros(4))
    spins = search.Spins(numbers, frames, quadratic)
    kept = search.best(spins, 4)
    np.testing.assert_array_equal(kept.quadratic.chi_square, [0.0, 2.0])
    assert len(search.distinct(spins).numbers) == 4
    near = search.neighbours(spins, rows_of(kept, [0]))
    np.testing.assert_array_equal(near, [0, 1, 3])
    # One between two poles belongs to the better one.
    numbers[:, 1] = [0.0, 0.2, 0.4, 0.0]
    between = search.Spins(numbers, frames, quadratic)
    poles = search.best(between, 4)
    np.testing.assert_array_equal(poles.quadratic.chi_square, [0.0, 2.0])
    groups = search.minima_about(between, poles)
    np.testing.assert_array_equal(groups[0], [0, 1, 3])
    np.testing.assert_array_equal(groups[1], [2])


def test_a_single_curve_is_told_from_a_list(untyped):
    (curve,) = observed(0.01, True, 0.0, nights=1)
    for find in (ph.find_spin, ph.find_tumblers):
        with pytest.raises(ValueError, match="must be a list of light curves"):
            find(curve, 0.01, **RANGE)


def test_too_few_points_are_refused():
    curves = observed(0.01, True, 0.0, nights=2)
    with pytest.raises(ValueError, match="take a smaller `degree`"):
        ph.find_spin(curves, 0.01, **RANGE)
