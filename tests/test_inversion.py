"""Inversion of light curves: tumblers made by other code are found."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tumbler_reference

import jrigid as jr
from jrigid import photometry as ph
from jrigid.photometry import _alias as alias
from jrigid.photometry import _curve_readings as readings
from jrigid.photometry import _many_starts as refine
from jrigid.photometry import _model as model
from jrigid.photometry import _nights as nights
from jrigid.photometry import _periodogram as periodogram
from jrigid.photometry import _spin_search as spin_search
from jrigid.photometry import _tumbler_search as search
from jrigid.photometry import _wobble as wobble
from jrigid.photometry._convex import even_directions
from jrigid.photometry._inversion import in_hours

HOUR = 3600.0
SEMI_AXES = jnp.array([1.0, 0.7, 0.45])


def body(mode, **changes):
    """A tumbler with the periods of Apophis, or with those of a cigar."""
    shape = ph.Ellipsoid(SEMI_AXES)
    rotation = 60.0 if mode == "short-axis" else 40.0
    values = {
        "moments": shape.moments,
        "precession_period": 12.0 * HOUR,
        "rotation_period": rotation * HOUR,
        "longitude": 1.0,
        "latitude": -0.4,
        "precession_angle": 0.3,
        "rotation_phase": 0.2,
        "shape": shape,
        "mode": mode,
    }
    return ph.Tumbler(**values | changes)


@pytest.mark.parametrize("long_axis", [False, True])
@pytest.mark.parametrize("log_tangent", [-2.0, 0.0, 1.0])
def test_the_series_are_the_exact_motion(long_axis, log_tangent):
    inverse = model.inverse_moments(SEMI_AXES, jnp.asarray(long_axis))
    motion = wobble.wobble(inverse, jnp.asarray(log_tangent))
    ts = jnp.linspace(0.0, 300.0, 9)
    axes = jax.vmap(wobble.body_axes, (None, 0, 0))(
        motion, motion.rotation_rate * ts, motion.precession_rate * ts
    )
    moments = 1 / inverse
    start = jnp.stack([motion.first * 0, motion.second]).sum(axis=1)
    momentum = start.at[0].set(0.0)
    momentum = jnp.stack(
        [momentum[0], momentum[1], jnp.cos(jnp.arctan(jnp.exp(log_tangent)))]
    )
    # The axis of the largest moment may be the third or the first by the new names, so
    # the motion of these axes is that of a body with moments in this order.
    attitude = jr.rotation.from_matrix(axes[0].T)
    state = jr.State(attitude, momentum / moments)
    exact = jr.free_rotation(moments, state, ts)
    expected = jax.vmap(jr.rotation.to_matrix)(exact.attitude).transpose(0, 2, 1)
    np.testing.assert_allclose(axes, expected, atol=3e-5)


@pytest.mark.parametrize("mode", ["short-axis", "long-axis"])
def test_a_tumbler_has_the_periods_and_the_pole_that_it_is_given(mode):
    tumbler = body(mode)
    terms = ph.tumbling(tumbler.moments, tumbler.state.omega)
    np.testing.assert_allclose(terms.precession_period, 12.0 * HOUR, rtol=1e-12)
    np.testing.assert_allclose(
        terms.rotation_period, tumbler.rotation_period, rtol=1e-12
    )
    momentum = jr.rotation.rotate(
        tumbler.state.attitude, tumbler.moments * tumbler.state.omega
    )
    pole = momentum / jnp.linalg.norm(momentum)
    expected = [np.cos(1.0) * np.cos(0.4), np.sin(1.0) * np.cos(0.4), -np.sin(0.4)]
    np.testing.assert_allclose(pole, expected, atol=1e-12)


def synthetic(tumbler, rng, noise=0.01, points=60, curves=4, height=0.1):
    """Relative light curves of a tumbler by the exact flow, from a moving observer.

    All directions are in a plane if the height is zero.
    """
    found = []
    for k in range(curves):
        ts = 86400.0 * (3.0 * k + np.sort(rng.uniform(0.0, 2.0, points)))
        angle = ts / 86400.0 * 0.03
        up = height + 0 * angle
        sun = 1e11 * np.stack([np.cos(angle), np.sin(angle), up], axis=1)
        observer = 1e11 * np.stack([0 * ts, 1 + 0 * ts, 10 * up * angle], axis=1)
        light = np.asarray(tumbler.light_curve(ts, sun, observer))
        light = light * np.exp(
            rng.normal() + noise * readings.MAGNITUDE * rng.normal(size=points)
        )
        found.append(ph.LightCurve(0.0, ts, light, sun, observer, is_relative=True))
    return found


def numbers_of(tumbler, data, epoch):
    """The numbers of a tumbler whose axes of the fit are those of space."""
    elapsed = (epoch - 0.0) * 86400.0
    span = float(data.span)
    logits = model.logits_of(
        np.asarray(tumbler.shape.semi_axes[1:] / tumbler.shape.semi_axes[:2])
    )
    momentum = tumbler.moments * tumbler.state.omega
    start = ph.omega_from_periods(
        tumbler.moments,
        tumbler.precession_period,
        tumbler.rotation_period,
        tumbler.mode,
    )
    first = tumbler.moments * start
    circled = 2 if tumbler.mode == "short-axis" else 0
    assert np.linalg.norm(momentum) > 0
    return np.concatenate(
        [
            [span / tumbler.precession_period, span / tumbler.rotation_period],
            [
                tumbler.precession_angle
                + 2 * np.pi * elapsed / tumbler.precession_period,
                2
                * np.pi
                * (tumbler.rotation_phase + elapsed / tumbler.rotation_period),
            ],
            [tumbler.longitude, tumbler.latitude],
            [np.log(abs(first[1] / first[circled]))],
            logits,
            logits,
        ]
    )


@pytest.mark.parametrize("mode", ["short-axis", "long-axis"])
def test_the_model_of_a_fit_is_the_light_curve_of_the_tumbler(mode, rng):
    tumbler = body(mode)
    data, epoch = readings.readings_of(synthetic(tumbler, rng, noise=1e-9), 1.0)
    code = model.Mode.short_axis if mode == "short-axis" else model.Mode.long_axis
    task = model.Task(
        np.eye(3), np.asarray(int(code)), np.asarray(True), np.asarray(1.0)
    )
    vector = numbers_of(tumbler, data, epoch)
    rows = jax.jit(model.rows_of)(vector, task, data)
    np.testing.assert_allclose(rows.residuals, 0.0, atol=1e-4)

    # Derivatives, by central differences.
    def residuals(x):
        return jax.jit(model.rows_of)(x, task, data).residuals

    for k in np.flatnonzero(np.asarray(model.sought(task))):
        step = 1e-5 * np.eye(len(vector))[k]
        slope = (residuals(vector + step) - residuals(vector - step)) / 2e-5
        np.testing.assert_allclose(rows.slopes[:, k], slope, rtol=1e-5, atol=1e-6)


@pytest.fixture(scope="module")
def inversion():
    """A tumbler by DOP853 and facets, and what is found."""
    curves, truth = tumbler_reference.tumbler(np.random.default_rng(3), "long-axis")
    programs = refine.minimised._cache_size()
    found = ph.find_tumblers(
        curves, 0.02, shortest=8 * HOUR, longest=400 * HOUR, pairs=25
    )
    # One for a part of the epochs and one for all, whatever the number of steps.
    assert refine.minimised._cache_size() <= programs + 2
    return curves, truth, found


def test_a_tumbler_of_another_code_is_found(inversion):
    _, truth, found = inversion
    best = found.aliases[0]
    assert found.determined
    assert best.tumbler.mode == truth.mode
    estimates, errors = best.estimates, best.errors
    pairs = [
        (
            estimates.precession_period,
            errors.precession_period,
            truth.precession_period,
        ),
        (estimates.rotation_period, errors.rotation_period, truth.rotation_period),
        (estimates.latitude, errors.latitude, np.arcsin(truth.pole[2])),
        (estimates.moments[0], errors.moments[0], truth.moments[0] / truth.moments[2]),
        (estimates.axis_ratios[0], errors.axis_ratios[0], truth.semi_axes[1]),
    ]
    for value, error, true in pairs:
        assert abs(value - true) < 4 * error
    assert 0.8 < found.reduced_chi_square < 1.2


def test_the_tumbler_that_is_found_has_the_residuals_that_are_stated(inversion):
    curves, _, found = inversion
    best = found.aliases[0]
    # All curves in one call, since each number of epochs compiles a program.
    light = best.tumbler.light_curve(
        np.concatenate([x.ts + (x.epoch - found.epoch) * 86400.0 for x in curves]),
        np.concatenate([x.to_sun for x in curves]),
        np.concatenate([x.to_observer for x in curves]),
    )
    observed = np.concatenate([x.brightness for x in curves])
    magnitudes = -2.5 * np.log10(observed / np.asarray(light))
    ends = np.cumsum([len(x.ts) for x in curves])[:-1]
    residuals = [x - x.mean() for x in np.split(magnitudes, ends)]
    np.testing.assert_allclose(np.concatenate(residuals), best.residuals, atol=1e-5)


def test_a_report_says_which_tumblers_explain_the_curves(inversion):
    _, _, found = inversion
    report = found.report()
    assert report.startswith("One tumbler explains the light curves: ")
    assert "1. long-axis" in report
    assert "P_psi" in report


def shuffled(curve):
    """The same curve with its points in another order."""
    order = np.random.default_rng(1).permutation(len(curve.ts))
    fields = ("ts", "brightness", "to_sun", "to_observer")
    return dataclasses.replace(
        curve, **{name: getattr(curve, name)[order] for name in fields}
    )


def test_a_noise_that_is_not_stated_does_not_hide_a_light_curve_that_is_missed(
    inversion,
):
    """The noise that is found holds the misfit, so that chi-square cannot tell.

    Neighbours are those in time, whatever the order of the points.
    """
    curves, _, found = inversion
    assert abs(found.correlation) < 0.2
    assert "found from what the fit leaves" not in found.report()
    wrong = ph.find_tumblers(
        [shuffled(x) for x in curves],
        shortest=8 * HOUR,
        longest=400 * HOUR,
        modes=["principal-axis"],
        pairs=10,
    )
    assert wrong.reduced_chi_square == 1.0
    assert wrong.noise > 0.03
    assert wrong.correlation > 0.3
    assert not wrong.follows
    assert not wrong.determined
    assert wrong.report().startswith("No tumbler was found")
    assert "found from what the fit leaves" in wrong.report()


@pytest.mark.parametrize("mode", ["short-axis", "long-axis"])
def test_a_mirror_explains_what_is_seen_from_a_plane(mode, rng):
    tumbler = body(mode)

    def tumbler_and_mirror(height):
        # As many points as a tumbler of the reference fills, for the same program.
        curves = synthetic(tumbler, rng, points=90, height=height)
        data, epoch = readings.readings_of(curves, 0.01)
        task = model.Task(
            frame=np.eye(3)[None],
            mode=np.array([int(model.Mode[mode.replace("-", "_")])]),
            homogeneous=np.array([True]),
            link=np.array([search._TIGHT]),
        )
        numbers = numbers_of(tumbler, data, epoch)[None]
        found = search._minimised(data, numbers, task, search._LAST_STEPS)
        both = search._best(search.joined([found, search._mirrored(data, found)]))
        scale = both.quadratic.chi_square[0] / 360
        assert 0.7 < scale < 1.3
        index = search.index_of_mirror(data, both)
        aliases = [
            alias.alias_of(numbers, model.Task(*task), data, scale)
            for numbers, *task in zip(both.numbers, *both.tasks, strict=True)
        ]
        return aliases[0], None if index is None else aliases[index]

    best, mirror = tumbler_and_mirror(0.0)
    assert abs(mirror.chi_square - best.chi_square) < 1e-6
    # Its momentum is on the other side, as high above the plane.
    turn = mirror.estimates.longitude - best.estimates.longitude
    assert np.cos(turn) == pytest.approx(-1, abs=1e-9)
    assert mirror.estimates.latitude == pytest.approx(best.estimates.latitude)
    assert mirror.estimates.moments == pytest.approx(best.estimates.moments)
    # Seen from outside of a plane, a fit that starts at the mirror ends far above the
    # first one, or elsewhere.
    best, mirror = tumbler_and_mirror(0.3)
    assert mirror is None or mirror.chi_square > 100 + best.chi_square


def test_a_report_names_a_mirror(inversion):
    _, _, found = inversion
    assert found.mirror is None
    assert "mirror" not in found.report()
    both = dataclasses.replace(found, mirror=found.aliases[0])
    assert "The mirror of the first has the same periods" in both.report()


def test_the_weight_of_an_alias_does_not_depend_on_how_its_periods_are_linked(
    inversion,
):
    curves, _, found = inversion
    data, _ = readings.readings_of(curves, 0.02)
    best = found.aliases[0]
    evidence = []
    for link in (1e4, 1e6):
        task = best.task._replace(link=np.asarray(link))
        same = alias.alias_of(best.numbers, task, data, 1.0)
        evidence.append(alias.log_evidence(same, 0.0, 50.0))
    np.testing.assert_allclose(evidence[1], evidence[0], atol=1e-3)
    # A second frequency and a second angle lie anywhere in ranges beforehand.
    wider = alias.log_evidence(same, 0.0, 100.0)
    np.testing.assert_allclose(evidence[1] - wider, 2 * np.log(2), atol=1e-9)


def test_neighbours_of_a_principal_axis_rotation_have_no_second_frequency():
    near = search._neighbours(np.array([[7.0, 0.0]]), model.Mode.principal_axis)
    np.testing.assert_array_equal(near, [[6.5, 0.0], [7.0, 0.0], [7.5, 0.0]])
    assert len(search._neighbours(np.array([[7.0, 3.0]]), model.Mode.long_axis)) == 9
    # No frequency is zero or negative.
    near = search._neighbours(np.array([[3.0, 0.5]]), model.Mode.short_axis)
    assert len(near) == 6
    assert near.min() == 0.5


def test_a_report_says_where_a_body_is_round_about_the_axis_it_circles(inversion):
    _, _, found = inversion
    best = found.aliases[0]
    assert "nearly round" not in found.report()
    ratios = np.array([best.estimates.axis_ratios[0], 0.995])
    estimates = best.estimates._replace(axis_ratios=ratios)
    round_one = dataclasses.replace(best, estimates=estimates)
    assert best.tumbler.mode == "long-axis"
    assert "nearly round" in dataclasses.replace(found, aliases=[round_one]).report()


def test_planned_curves_tell_aliases_apart(inversion):
    curves, _, found = inversion
    several = dataclasses.replace(
        found, aliases=[found.aliases[0], *found.rejected[:2]]
    )
    apart = several.separation(curves[:4], 0.02)
    assert apart.shape == (4, 3, 3)
    np.testing.assert_array_equal(apart, np.swapaxes(apart, 1, 2))
    np.testing.assert_array_equal(np.diagonal(apart, axis1=1, axis2=2), 0.0)
    plan = several.choose_nights(curves[:4], 0.02)
    # What one curve says is the same alone and in a plan of this curve only.
    single = several.choose_nights(curves[:4], 0.02, threshold=1e-3)
    np.testing.assert_allclose(single.growth, apart[single.chosen[0]], rtol=1e-9)
    # More curves never say less.
    assert np.all(plan.growth >= np.max(apart[plan.chosen], axis=0) - 1e-6)
    upper = np.triu_indices(3, 1)
    assert np.all(plan.growth[upper] > 25) or len(plan.chosen) == 4
    text = plan.report()
    for index, pairs in zip(plan.chosen, plan.decided, strict=True):
        assert f"curve {index}, JD 24562" in text or f"curve {index}, JD 24563" in text
        for i, j in pairs:
            assert f"{i} from {j} (" in text
    assert sum(len(x) for x in plan.decided) == np.sum(plan.growth[upper] > 25)


def test_a_growth_is_the_least_one_of_two_aliases_that_may_change(inversion):
    """By least squares in the numbers of both, which their old curves hold."""
    curves, _, found = inversion
    right, wrong = found.aliases[0], found.rejected[0]
    several = dataclasses.replace(found, aliases=[right, wrong])
    planned = curves[:3]
    predicted = several._predictions(planned, 0.02)
    expected = nights.growths(predicted, several.aliases, range(3))[0, 1]
    # Of relative curves, a factor each is unknown.
    points = [predicted.of_curve == k for k in range(3)]
    for values in (predicted.rows.T, np.moveaxis(predicted.slopes, 1, 0)):
        for of_curve in points:
            values[of_curve] -= values[of_curve].mean(axis=0)
    difference = predicted.rows[1] - predicted.rows[0]
    # The numbers of both may change: their old curves hold them by the covariances.
    rows = [difference]
    slopes = [np.concatenate([predicted.slopes[1], -predicted.slopes[0]], axis=1)]
    for k, one in enumerate((wrong, right)):
        seeks = np.diag(one.covariance) > 0
        inverse = np.linalg.inv(one.covariance[np.ix_(seeks, seeks)])
        root = np.linalg.cholesky(inverse).T
        block = np.zeros((root.shape[0], 22))
        block[:, 11 * k + np.flatnonzero(seeks)] = root
        rows.append(np.zeros(len(root)))
        slopes.append(block)
    stacked, target = np.concatenate(slopes), -np.concatenate(rows)
    change = np.linalg.lstsq(stacked, target, rcond=None)[0]
    left = np.sum((stacked @ change - target) ** 2)
    np.testing.assert_allclose(left, expected, rtol=1e-3)


def test_calibrated_curves_of_a_plan_share_a_factor_of_the_chosen_ones(inversion):
    curves, _, found = inversion
    several = dataclasses.replace(found, aliases=[found.aliases[0], found.rejected[0]])
    calibrated = [dataclasses.replace(x, is_relative=False) for x in curves[:3]]
    apart = several.separation(calibrated, 0.02)
    for k, curve in enumerate(calibrated):
        alone = several.separation([curve], 0.02)[0]
        np.testing.assert_allclose(apart[k], alone, rtol=1e-6, atol=1e-9)
        # Alone, a factor of its own is as unknown as one that is shared.
        relative = several.separation([curves[k]], 0.02)[0]
        np.testing.assert_allclose(alone, relative, rtol=1e-6, atol=1e-9)
    # Curves of huge noise are worth no night.
    hopeless = several.choose_nights(calibrated, 50.0)
    assert hopeless.chosen == []
    assert "Not even all curves together tell apart 1 and 2 (0)" in hopeless.report()
    empty = dataclasses.replace(
        curves[0],
        **{
            name: getattr(curves[0], name)[:0]
            for name in ("ts", "brightness", "to_sun", "to_observer")
        },
    )
    with pytest.raises(ValueError, match="Curve 1 of `curves` must have a point"):
        several.choose_nights([curves[0], empty], 0.02)
    lost = dataclasses.replace(curves[0], to_sun=0 * curves[0].to_sun)
    with pytest.raises(ValueError, match="Curve 0 of `curves` must have finite times"):
        several.separation([lost], 0.02)
    dark = dataclasses.replace(curves[0], to_sun=-2 * curves[0].to_observer)
    with pytest.raises(ValueError, match="Sun is straight behind it"):
        several.separation([dark], 0.02)


def test_few_points_have_candidates_by_constant_coefficients(inversion):
    """Of a third of the points, a series that is modulated follows too many pairs."""
    curves, truth, _ = inversion
    few = [
        dataclasses.replace(
            x,
            **{
                name: getattr(x, name)[::3]
                for name in ("ts", "brightness", "to_sun", "to_observer")
            },
        )
        for x in curves
    ]
    data, _ = readings.readings_of(few, 0.02)
    assert np.all(periodogram.modulations(data)[:, 1:] == 0)
    data, _ = readings.readings_of(curves, 0.02)
    assert np.any(periodogram.modulations(data)[:, 1:] != 0)
    pairs = ph.period_pairs(few, 8 * HOUR, 400 * HOUR, count=150)
    span = max(x.ts.max() for x in curves) - min(x.ts.min() for x in curves)
    apart = np.maximum(
        abs(span / pairs.precession_period - span / truth.precession_period),
        abs(span / pairs.rotation_period - span / truth.rotation_period),
    )
    # The search looks half a cycle to each side, too.
    assert apart.min() < 1.0


def test_errors_weigh_points_and_factors_of_bands_are_taken_out(rng):
    tumbler = body("short-axis")
    curves = [
        dataclasses.replace(x, is_relative=False, band="RV"[k % 2])
        for k, x in enumerate(synthetic(tumbler, rng, noise=0.01))
    ]
    noisy = [
        dataclasses.replace(x, errors=rng.uniform(0.005, 0.02, len(x.ts)))
        for x in curves
    ]
    errors = np.concatenate([x.errors for x in noisy])
    assert readings.stated_noise(curves, None) is None
    np.testing.assert_array_equal(readings.stated_noise(noisy, None), errors)
    assert readings.stated_noise(noisy, 0.03) == 0.03
    data, _ = readings.readings_of(noisy, errors)
    scale = readings.MAGNITUDE * errors
    np.testing.assert_allclose(data.weights[: len(errors)], 1 / scale)
    np.testing.assert_allclose(data.typical_noise(), np.median(errors))
    # A factor for each band drops out; a factor of one curve of a band does not.
    by_band = [
        dataclasses.replace(
            x, brightness=x.brightness * (3.0 if x.band == "R" else 7.0)
        )
        for x in noisy
    ]
    same, _ = readings.readings_of(by_band, errors)
    np.testing.assert_allclose(same.values, data.values, atol=1e-9)
    one = dataclasses.replace(noisy[0], brightness=1.1 * noisy[0].brightness)
    other, _ = readings.readings_of([one, *noisy[1:]], errors)
    assert np.max(np.abs(other.values - data.values)) > 1.0
    wrong = [dataclasses.replace(noisy[0], errors=0 * noisy[0].errors), *noisy[1:]]
    with pytest.raises(ValueError, match="must have positive `errors`, one for each"):
        readings.stated_noise(wrong, None)


def test_candidates_hold_the_pair_of_a_tumbler(inversion):
    """With terms that do not change with the geometry it is the twelfth, and the best
    series explains .82 of the variance."""
    curves, truth, _ = inversion
    pairs = ph.period_pairs(curves, 8 * HOUR, 400 * HOUR, count=60)
    span = max(x.ts.max() for x in curves) - min(x.ts.min() for x in curves)
    apart = np.maximum(
        abs(span / pairs.precession_period - span / truth.precession_period),
        abs(span / pairs.rotation_period - span / truth.rotation_period),
    )
    assert apart[:5].min() < 0.75
    assert pairs.explained[0] > 0.95
    assert np.all(np.diff(pairs.explained) <= 1e-6)


def test_mistakes_in_an_inversion_say_what_to_pass():
    far = np.ones((20, 3))
    curve = ph.LightCurve(0.0, np.arange(20.0), np.ones(20), far, far, is_relative=True)
    with pytest.raises(ValueError, match="at least 12 points"):
        ph.find_tumblers([], shortest=1.0, longest=2.0)
    with pytest.raises(ValueError, match="in this order"):
        ph.find_tumblers([curve], shortest=2.0, longest=1.0)
    with pytest.raises(ValueError, match="must be positive periods"):
        ph.find_tumblers([curve], shortest=0.0, longest=1.0)
    with pytest.raises(ValueError, match="must span more than half of `shortest`"):
        ph.period_pairs([curve], 40.0, 80.0)
    with pytest.raises(ValueError, match="`noise` must be positive"):
        ph.find_tumblers([curve], 0.0, shortest=1.0, longest=2.0)
    with pytest.raises(ValueError, match="`threshold` must not be negative"):
        ph.find_tumblers([curve], shortest=1.0, longest=2.0, threshold=-1.0)
    with pytest.raises(ValueError, match="`modes` must name a motion"):
        ph.find_tumblers([curve], shortest=1.0, longest=2.0, modes=[])
    with pytest.raises(ValueError, match="`modes` must be"):
        ph.find_tumblers([curve], shortest=1.0, longest=2.0, modes=["spin"])
    dark = ph.LightCurve(0.0, np.arange(20.0), np.zeros(20), far, far, is_relative=True)
    with pytest.raises(ValueError, match="positive brightness"):
        ph.find_tumblers([dark], shortest=1.0, longest=2.0)
    magnitudes = dataclasses.replace(curve, brightness=np.linspace(15.0, 15.5, 20))
    for relative in (True, False):
        wrong = dataclasses.replace(magnitudes, is_relative=relative)
        with pytest.raises(ValueError, match=r"magnitudes m: take 10\^\(-0.4 m\)"):
            ph.find_tumblers([wrong], 0.02, shortest=1.0, longest=2.0)
    few = ph.LightCurve(0.0, np.arange(5.0), np.ones(5), far[:5], far[:5], True)
    with pytest.raises(ValueError, match="at least 12 points"):
        ph.find_tumblers([few], shortest=1.0, longest=2.0)


def test_periods_that_no_motion_has_are_named():
    """About the shortest axis, P_psi is longer than P_phi by more than a third."""
    ts = np.linspace(0.0, 19.0, 60)
    far = np.stack([np.cos(ts / 9), np.sin(ts / 9), 1 + 0 * ts], axis=1)
    light = 1 + 0.1 * np.cos(4 * np.pi * ts / 1.1)
    curve = ph.LightCurve(0.0, ts, light, far, far, is_relative=True)
    with pytest.raises(ValueError, match="must hold the periods of a motion of these"):
        ph.find_tumblers(
            [curve], shortest=1.0, longest=1.3, modes=["short-axis"], pairs=3
        )
    with pytest.raises(ValueError, match="must hold a pair of periods"):
        ph.period_pairs([curve], 19 / 0.51, 19 / 0.505)


@pytest.mark.parametrize("error", [np.nan, np.inf, 0.0])
def test_a_period_is_written_whatever_its_error(error):
    assert in_hours(np.asarray(7200.0), np.asarray(error)).startswith("2.0000 +- ")


def test_places_are_shared_between_groups_of_near_ones():
    turns = np.array([1.0, 1.1, 5.0, 1.2, 5.1, 9.0])
    # All are apart by another number.
    places = np.column_stack([turns, np.arange(6.0)])
    merits = -np.array([0.0, 1.0, 3.0, 2.0, 4.0, 5.0])
    shared = functools.partial(periodogram.shared_places, places, turns, merits, 0.3)
    assert shared(3, 1) == [0, 2, 5]
    assert shared(5, 2) == [0, 1, 2, 4, 5]
    # What other groups leave is filled, and all are in the order of their merits.
    assert shared(6, 1) == [0, 1, 3, 2, 4, 5]
    # A place that is taken is not given again.
    assert periodogram.shared_places(turns[:, None], turns, merits, 0.3, 6, 2) == [
        0,
        2,
        5,
    ]


def test_the_best_rotations_of_a_search_are_not_those_of_one_period_alone():
    """One period has poles that are all better than those of another."""
    turns = np.repeat([10.0, 12.0, 14.0], [20, 3, 3])
    poles = even_directions(20)
    pole = np.concatenate([poles, poles[:3], poles[:3]])
    numbers = np.zeros((26, 12))
    numbers[:, 0] = turns
    quadratic = refine.Quadratic(np.arange(26.0), np.zeros((26, 12)), np.zeros(26))
    frames = np.stack([spin_search.frame_of_pole(x) for x in pole])
    spins = spin_search.Spins(numbers, frames, quadratic)
    kept = spin_search.best(spins, 9)
    # Three places each, in the order of chi-square.
    np.testing.assert_array_equal(kept.numbers[:, 0], np.repeat([10, 12, 14], 3))
    np.testing.assert_array_equal(
        kept.quadratic.chi_square, [0, 1, 2, 20, 21, 22, 23, 24, 25]
    )
    # Places that no other period takes are filled.
    assert len(spin_search.best(spins, 26).numbers) == 26


def test_ratios_of_axes_and_their_logits():
    ratios = np.array([0.3, 0.9])
    logits = model.logits_of(ratios)
    np.testing.assert_allclose(model.ratios_of(logits), ratios, rtol=1e-14)
    # Those of a needle and of a sphere are finite.
    limits = np.asarray(model.ratios_of(model.logits_of(np.array([0.0, 1.0]))))
    assert limits == pytest.approx([0.02, 1.0], abs=2e-3)
    # A needle keeps an area to see.
    needle = np.asarray(model.semi_axes(jnp.array([-1e3, -1e3])))
    np.testing.assert_allclose(needle, [1.0, 0.02, 0.0004], rtol=1e-12)


def test_all_poles_of_a_rotation_are_listed(rng):
    """Four nights of a steady ellipsoid tell its period, and not its pole."""
    shape = ph.Ellipsoid(jnp.array([1.0, 0.7, 0.6]))
    truth = ph.Tumbler(
        shape.moments, 6.3 * HOUR, 1.0, 1.2, 0.7, 0.3, 0.0, shape, mode="principal-axis"
    )
    curves = []
    for night in (0.0, 2.1, 9.95, 20.02):
        ts = 86400.0 * (night + np.linspace(0, 0.25, 30))
        angle = 0.3 + ts / 1.6e7
        sun = np.stack([np.cos(angle), np.sin(angle), 0.1 + 0 * ts], axis=1)
        observer = np.stack([np.cos(2 * angle), np.sin(2 * angle), 0 * ts], axis=1)
        light = np.asarray(truth.light_curve(ts, sun, observer))
        light = light * 10 ** (-0.008 * rng.normal(size=30))
        curves.append(ph.LightCurve(0.0, ts, light, sun, observer, is_relative=True))
    found = ph.find_tumblers(
        curves,
        0.02,
        shortest=5 * HOUR,
        longest=8 * HOUR,
        modes=["principal-axis"],
        pairs=5,
    )
    # Many poles explain these nights, and all have the true period.
    assert len(found.aliases) > 2
    assert found.determined
    assert "differ in the direction of the angular momentum" in found.report()
    poles = search.direction_of_pole(
        *np.transpose([x.estimates[2:4] for x in found.aliases])
    )
    apart = np.abs(poles[:, None] - poles[None]).max(axis=-1)
    assert np.all(apart + np.eye(len(poles)) > 0.25)
    for one in found.aliases:
        assert np.isfinite(one.weight)
        assert one.errors.precession_period > 0
        assert np.all(one.errors.axis_ratios <= 0.5)
    periods = np.array([x.estimates.precession_period for x in found.aliases])
    np.testing.assert_allclose(periods, 6.3 * HOUR, rtol=2e-3)
