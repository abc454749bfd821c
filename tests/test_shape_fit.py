"""A convex shape of a tumbler: bodies made by plain numpy and DOP853 are found."""

import dataclasses
import re

import numpy as np
import pytest
import tumbler_reference as reference
from scipy.spatial.transform import Rotation

from jrigid import photometry as ph

HOUR, DAY = 3600.0, 86400.0
NOISE = 0.01
# The shape is not aligned with the principal axes of inertia.
SHAPE = Rotation.from_euler("xyz", [0.2, 0.3, 0.25])
SEMI_AXES = np.array([1.0, 0.7, 0.5])
LAW = {"lambert": 0.1, "amplitude": 0.5, "width": 0.1, "slope": -0.3}
ALBEDO = np.array([0.2, -0.1, 0.15])
MOMENTS = {
    "short-axis": np.array([0.55, 0.9, 1.0]),
    "long-axis": np.array([0.5, 0.9, 1.0]),
}
PERIODS = {
    "short-axis": (8 * HOUR, 40 * HOUR),
    "long-axis": (8 * HOUR, 21 * HOUR),
}
EPOCH = 2456285.5
# Few points of a coarse surface: one program for all tests.
SMALL = {"degree": 4, "facets": 128}


def start_of(mode):
    """Near the truth, but for the shape and the surface."""
    ellipsoid = ph.Ellipsoid(SEMI_AXES)
    return ph.Tumbler(
        MOMENTS[mode], *PERIODS[mode], 1.0, 0.6, 0.3, 0.2, ellipsoid, mode=mode
    )


def surface():
    """Areas and normals of an ellipsoid with other axes than those of inertia."""
    facets = ph.Ellipsoid(SEMI_AXES).facets(40)
    return np.asarray(facets.areas), np.asarray(facets.normals) @ SHAPE.as_matrix().T


def light_by_numpy(turned, sun, earth, albedo):
    """Brightness for rotations from body to space, by nothing of the package."""
    areas, normals = surface()
    reflecting = areas * np.exp(normals @ albedo)
    sun, earth = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (sun, earth))
    mu0 = np.maximum(np.einsum("nij,ni->nj", turned, sun) @ normals.T, 0.0)
    mu = np.maximum(np.einsum("nij,ni->nj", turned, earth) @ normals.T, 0.0)
    scattered = mu0 * mu * (1 / np.maximum(mu0 + mu, 1e-300) + LAW["lambert"])
    alpha = np.arccos(np.sum(sun * earth, axis=1))
    phase = 1 + LAW["amplitude"] * np.exp(-alpha / LAW["width"]) + LAW["slope"] * alpha
    return phase * (scattered @ reflecting)


def observed(mode, is_relative, albedo, nights=30, points=25):
    """Light curves of some nights in 120 days, from the ecliptic and from above it."""
    rng = np.random.default_rng(4)
    starts = 4 * DAY * np.arange(nights) + rng.uniform(0, DAY, nights)
    ts = starts[:, None] + np.sort(rng.uniform(0, 7 * HOUR, (nights, points)), axis=1)
    flat = ts.ravel()
    angle = 2 * np.pi * flat / (400 * DAY)
    seen = angle + 0.6 * np.cos(3 * angle)
    sun = np.stack([np.cos(angle), np.sin(angle), 0.1 + 0 * flat], axis=1)
    earth = np.stack([np.cos(seen), np.sin(seen), 0.15 * np.sin(2 * angle)], axis=1)
    state = start_of(mode).state
    attitude = Rotation.from_quat(np.roll(np.asarray(state.attitude), -1))
    turned = reference.attitudes(
        MOMENTS[mode], np.asarray(state.omega), attitude, np.append(0.0, flat)
    )[1:]
    light = light_by_numpy(turned, sun, earth, albedo)
    light = light * 10 ** (-0.4 * NOISE * rng.normal(size=flat.size))
    parts = np.arange(flat.size).reshape(nights, points)
    return [
        ph.LightCurve(EPOCH, flat[x], light[x], sun[x], earth[x], is_relative)
        for x in parts
    ]


def displaced(mode):
    """A start that is a few degrees off, with the shape of a published ellipsoid."""
    start = start_of(mode)
    return dataclasses.replace(
        start,
        precession_angle=start.precession_angle + 0.05,
        longitude=start.longitude + 0.05,
    )


def pulls(found, mode):
    """Errors of the motion in units of those that are stated."""
    truth = {
        "precession_period": PERIODS[mode][0],
        "rotation_period": PERIODS[mode][1],
        "longitude": 1.0,
        "latitude": 0.6,
        "moments": MOMENTS[mode][:2],
    }
    parts = [
        (getattr(found.estimates, name) - value) / getattr(found.errors, name)
        for name, value in truth.items()
    ]
    return np.concatenate([np.atleast_1d(x) for x in parts])


@pytest.fixture(scope="module")
def relative():
    """Relative curves of a short-axis mode, and what was fitted to them."""
    curves = observed("short-axis", True, np.zeros(3))
    start = displaced("short-axis")
    return curves, ph.fit_shape(curves, start, NOISE, epoch=EPOCH, **SMALL)


def test_a_tumbler_of_any_convex_shape_is_found(relative):
    _, found = relative
    assert np.max(np.abs(pulls(found, "short-axis"))) < 4
    assert found.reduced_chi_square < 1.2
    assert found.open_share < 0.02
    # An ellipsoid along the axes of inertia leaves far more.
    np.testing.assert_allclose(np.std(found.residuals), NOISE, rtol=0.1)
    text = found.report()
    assert text.startswith("short-axis mode of a convex body: chi-square over 6")
    assert "I1/I3 0.55" in text
    # The moments of a homogeneous ellipsoid are sums of the squares of its semi-axes.
    a, b, c = SEMI_AXES**2
    found = re.findall(r"this shape has I1/I3 ([\d.]+), I2/I3 ([\d.]+)", text)
    expected = [(b + c) / (a + b), (a + c) / (a + b)]
    np.testing.assert_allclose(np.array(found[0], float), expected, atol=0.03)


def test_the_tumbler_has_the_light_of_the_fit(relative):
    curves, found = relative
    ts, sun, earth, light = (
        np.concatenate([getattr(x, name) for x in curves])
        for name in ("ts", "to_sun", "to_observer", "brightness")
    )
    shift = (EPOCH - found.epoch) * DAY
    modelled = np.asarray(found.tumbler.light_curve(ts + shift, sun, earth))
    magnitudes = -2.5 * np.log10(light / modelled).reshape(len(curves), -1)
    left = magnitudes - magnitudes.mean(axis=1, keepdims=True)
    # The periods, the tilt and the moments agree to a millionth.
    np.testing.assert_allclose(left.ravel(), found.residuals, atol=1e-5)


def test_calibrated_curves_give_the_scattering_and_the_albedo():
    curves = observed("long-axis", False, ALBEDO)
    found = ph.fit_shape(
        curves,
        displaced("long-axis"),
        epoch=EPOCH,
        scattering=ph.Mixture(0.2, amplitude=0.3, width=0.15, slope=-0.1),
        fitted=tuple(LAW),
        albedo=True,
        **SMALL,
    )
    assert np.max(np.abs(pulls(found, "long-axis"))) < 4
    # The noise was not stated.
    np.testing.assert_allclose(found.noise, NOISE, rtol=0.1)
    x, error = found.estimates, found.errors
    off = np.abs(x.scattering - np.array(list(LAW.values()))) / error.scattering
    assert np.all(off < 4)
    assert np.all(np.abs(x.albedo - ALBEDO) < 4 * error.albedo)
    assert np.all(error.albedo < 0.1)
    assert "albedo varies by a factor of" in found.report()


def test_a_fit_may_start_from_facets(relative):
    curves, found = relative
    again = ph.fit_shape(curves, found.tumbler, NOISE, epoch=found.epoch, **SMALL)
    np.testing.assert_allclose(again.chi_square, found.chi_square, rtol=1e-3)


def test_a_noise_that_is_not_stated_does_not_hide_a_misfit(relative):
    curves, found = relative
    assert found.follows
    assert abs(found.correlation) < 0.3
    start = found.tumbler
    slower = dataclasses.replace(
        start,
        precession_period=1.02 * start.precession_period,
        rotation_period=1.02 * start.rotation_period,
    )
    wrong = ph.fit_shape(curves, slower, epoch=found.epoch, **SMALL)
    assert wrong.noise > 5 * NOISE
    assert not wrong.follows
    assert "correlate by" in wrong.report()


def test_mistakes_say_what_to_pass(relative):
    curves, _ = relative
    steady = dataclasses.replace(start_of("short-axis"), mode="principal-axis")
    with pytest.raises(ValueError, match="principal-axis rotation: use `find_spin`"):
        ph.fit_shape(curves, steady, NOISE, epoch=EPOCH)
    start = start_of("short-axis")
    swapped = dataclasses.replace(start, rotation_period=start.precession_period)
    with pytest.raises(ValueError, match="must have periods of a motion of its mode"):
        ph.fit_shape(curves, swapped, NOISE, epoch=EPOCH)
    with pytest.raises(ValueError, match="say nothing of the phase function"):
        ph.fit_shape(curves, start, NOISE, epoch=EPOCH, fitted=("slope",))
    one = [dataclasses.replace(curves[0], is_relative=False), *curves[1:]]
    with pytest.raises(ValueError, match="for curves that are relative"):
        ph.fit_shape(one, start, NOISE, epoch=EPOCH, fitted=("slope",))
