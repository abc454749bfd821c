"""A torque that no model has, with a memory: its random walk, its likelihood, and what a fit finds.

Judges: quadrature in 30 digits, a covariance written out as one matrix, and trials by
an integrator in numpy whose torque is drawn step by step.
"""

import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
import worlds
from scipy.linalg import block_diag, expm

import jrigid as jr
from jrigid import identify
from jrigid.identify import Status
from jrigid.identify import _disturbance as disturbances
from jrigid.identify import _errors as errors
from jrigid.identify import _filter as filters
from jrigid.identify import _torque_errors as torque_errors
from jrigid.identify._layout import Layout
from jrigid.identify._smoother import Links, Rows

MOMENTS = np.array([0.5, 0.8, 1.0])
RATIOS = MOMENTS[1:] / MOMENTS[0]
BLIND = jr.RigidBody(np.full(3, MOMENTS.mean()))
LEVELS = np.array([0.02, 0.03, 0.05])
NOISE = 5e-3


@pytest.mark.parametrize("steps", [1e-6, 1e-3, 0.1, 0.999, 1.001, 7.0, 300.0])
def test_what_a_torque_adds_in_a_step_is_its_integral(steps):
    """White noise drives the torque, the torque the momentum, and the momentum the turn."""
    found, along = disturbances._torque_over_a_step(jnp.array(steps))
    with mpmath.workdps(30):
        a = mpmath.mpf(steps)
        # Responses to a unit kick r ago, of level 1 and dt = 1.
        torque = lambda r: mpmath.sqrt(2 * a) * mpmath.exp(-a * r)  # noqa: E731
        momentum = lambda r: 1 - mpmath.exp(-a * r)  # noqa: E731
        turn = lambda r: r - (1 - mpmath.exp(-a * r)) / a  # noqa: E731
        of = [momentum, turn, torque]
        points = [0, min(1, 5 / a), 1]
        wanted = [
            [mpmath.quad(lambda r, f=f, g=g: f(r) * g(r), points) for g in of]
            for f in of
        ]
        x = 1 - mpmath.exp(-a)
        # Of a torque at the start, in units of its rms 1 / sqrt(2 T), T = 1 / a.
        rms = mpmath.sqrt(a / 2)
        ahead = [rms * x / a, rms * (1 - x / a) / a, mpmath.exp(-a)]
    np.testing.assert_allclose(found, np.array(wanted, float), rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(along, np.array(ahead, float), rtol=1e-11, atol=1e-99)


def a_linear_record(rng, samples=7, columns=2):
    """A record of two trials, one node a sample, as if linearised; and its tensor."""
    trials, degrees = 2, 3
    ts = np.sort(rng.uniform(0, 1, (trials, samples)), axis=1)
    linked = np.ones((trials, samples), bool)
    linked[:, -1] = False
    layout = Layout(
        ts,
        np.tile(np.arange(samples), (trials, 1)),
        ts,
        np.roll(ts, -1, axis=1),
        linked,
        ts,
    )
    near_eye = np.eye(3) + 0.2 * rng.normal(size=(trials, samples, 3, 3))
    there = linked[..., None]
    links = Links(
        there * rng.normal(size=(trials, samples, 3)),
        there[..., None] * rng.normal(size=(trials, samples, 3, columns)),
        there[..., None] * near_eye,
        np.zeros((trials, 0)),
    )
    rows = Rows(
        rng.normal(size=(trials, samples, degrees)),
        rng.normal(size=(trials, samples, degrees, columns)),
        rng.normal(size=(trials, samples, degrees, 3)),
        layout.node,
    )
    mixed = rng.normal(size=(3, 3))
    tensor = np.eye(3) + 0.1 * mixed @ mixed.T
    weight = rng.uniform(0.2, 1, (trials, samples))
    return filters.Linearised(
        layout, tensor, rows, links, weight, np.zeros((trials, 0))
    )


def likelihood_by_one_matrix(record, level, time):
    """-2 log of the restricted likelihood, the covariance of all readings written out.

    The torque is followed on a grid so fine that it is constant in its steps.
    """
    layout, rows, links = record.layout, record.rows, record.links
    logs, designs, offsets = 0.0, [], []
    for t in range(level.shape[0]):
        samples = layout.ts.shape[1]
        # Covariance of torque and momentum over a step, by the matrix exponential (van
        # Loan).
        jump, parts = [], []
        for k in range(samples - 1):
            dt = layout.ts[t, k + 1] - layout.ts[t, k]
            carried, spread = np.zeros((6, 6)), np.zeros((6, 6))
            for i in range(3):
                drift = np.array([[0.0, 1.0], [0.0, -1 / time[i]]])
                drive = np.diag([0.0, (level[t, i] / time[i]) ** 2])
                big = np.block([[-drift, drive], [np.zeros((2, 2)), drift.T]]) * dt
                e = expm(big)
                turn = e[2:, 2:].T
                axes = np.ix_([i, 3 + i], [i, 3 + i])
                carried[axes], spread[axes] = turn, turn @ e[:2, 2:]
            jump.append(carried)
            parts.append(spread)
        inverse = block_diag(np.linalg.inv(record.tensor), np.eye(3))
        size = np.diag(level[t] ** 2 / (2 * time))
        mean = np.zeros((6, 1 + 3 + rows.of_border.shape[-1]))
        mean[:3, 1:4] = np.eye(3)
        covariance = {(0, 0): block_diag(np.zeros((3, 3)), size)}
        means = [mean]
        for k in range(samples - 1):
            ahead = inverse @ jump[k] @ np.linalg.inv(inverse)
            ahead[:3, :3] = links.of_state[t, k]
            extra = np.concatenate(
                [links.gap[t, k][:, None], np.zeros((3, 3)), links.of_border[t, k]],
                axis=1,
            )
            means.append(
                ahead @ means[k] + np.concatenate([extra, np.zeros_like(extra)])
            )
            for j in range(k + 1):
                covariance[(k + 1, j)] = ahead @ covariance[(k, j)]
                covariance[(j, k + 1)] = covariance[(k + 1, j)].T
            noise = inverse @ parts[k] @ inverse.T
            covariance[(k + 1, k + 1)] = ahead @ covariance[(k, k)] @ ahead.T + noise
        root = np.sqrt(record.weight[t])[:, None, None]
        shown = root * np.concatenate(
            [rows.of_state[t], np.zeros_like(rows.of_state[t])], axis=-1
        )
        whole = np.block(
            [
                [shown[i] @ covariance[(i, j)] @ shown[j].T for j in range(samples)]
                for i in range(samples)
            ]
        )
        whole = whole + np.eye(whole.shape[0])
        still = np.zeros((samples, 3, 3))
        offset = np.concatenate(
            [rows.residual[t][..., None], still, rows.of_border[t]], axis=-1
        )
        columns = root * offset + np.einsum("nij,njk->nik", shown, np.stack(means))
        columns = columns.reshape(-1, columns.shape[-1])
        lower = np.linalg.cholesky(whole)
        logs += 2 * np.sum(np.log(np.diagonal(lower)))
        white = np.linalg.solve(lower, columns)
        offsets.append(white[:, 0])
        design = np.zeros((white.shape[0], 3 * level.shape[0]))
        design[:, 3 * t : 3 * t + 3] = white[:, 1:4]
        designs.append(np.concatenate([design, white[:, 4:]], axis=1))
    design, offset = np.concatenate(designs), np.concatenate(offsets)
    left = offset - design @ np.linalg.lstsq(design, offset, rcond=None)[0]
    return float(left @ left) + logs + np.linalg.slogdet(design.T @ design)[1]


def test_the_likelihood_is_that_of_one_large_matrix(rng):
    record = a_linear_record(rng)
    columns = 1 + 3 + record.rows.of_border.shape[-1]
    prior, freedom = np.zeros((2, columns, columns)), np.array(20.0)

    def found(levels, times, sizes):
        given = prior, freedom, np.array(True), levels, times, sizes
        (value, _), slopes = filters.likelihood(record, *given)
        return value, slopes

    levels, times, sizes = (
        rng.normal(size=3),
        rng.normal(size=3) - 1,
        0.3 * rng.normal(size=2),
    )
    value, slopes = found(levels, times, sizes)
    level = np.exp(sizes)[:, None] * np.exp(levels)
    wanted = likelihood_by_one_matrix(record, level, np.exp(times))
    assert float(value) == pytest.approx(wanted, rel=1e-9)
    h = 1e-5
    for k, slope in enumerate(slopes):
        for i in range(slope.size):
            ends = []
            for sign in (h, -h):
                moved = [levels.copy(), times.copy(), sizes.copy()]
                moved[k][i] += sign
                ends.append(float(found(*moved)[0]))
            assert float(slope[i]) == pytest.approx(
                (ends[0] - ends[1]) / (2 * h), rel=1e-5, abs=1e-5
            )


def test_innovations_of_a_path_that_nothing_pushes_are_its_residuals(rng):
    """A torque of no size adds nothing: the rows are those condensed on the first state."""
    record = a_linear_record(rng)
    none = disturbances.Disturbance(np.full((2, 3), 1e-12), np.full(3, 0.1))
    found = np.asarray(filters.innovations(record, none).rows)
    root = np.sqrt(record.weight)[..., None]
    state = np.broadcast_to(np.eye(3), (2, 3, 3))
    mean = np.zeros((2, 3))
    for k in range(record.layout.ts.shape[1]):
        residual = record.rows.residual[:, k]
        shown = record.rows.of_state[:, k]
        wanted = residual + np.einsum("tij,tj->ti", shown, mean)
        np.testing.assert_allclose(found[:, k, :, 0], root[:, k] * wanted, atol=1e-9)
        wanted = root[:, k, :, None] * (shown @ state)
        np.testing.assert_allclose(found[:, k, :, 1:4], wanted, atol=1e-9)
        ahead = record.links.of_state[:, k]
        mean = np.einsum("tij,tj->ti", ahead, mean) + record.links.gap[:, k]
        state = ahead @ state


def some_trials(rng, count, time=0.1, size=1.0, moments=MOMENTS):
    """Records of a second each; the torque is held for a sixteenth of the time between samples."""
    grid = np.arange(64 * 16) / (64 * 16)
    spin = rng.normal(size=(count, 3))
    spin *= (rng.uniform(5, 20, count) / np.linalg.norm(spin, axis=1))[:, None]
    levels = np.broadcast_to(size, count)[:, None] * LEVELS
    held = worlds.ou_torque(rng, grid, levels, time)
    omega = worlds.tumble(np.diag(moments), spin, grid, held=held).omega[:, ::16]
    omega = omega + NOISE * rng.normal(size=omega.shape)
    return [identify.Rates(grid[::16], x, NOISE) for x in omega]


def off(found):
    """Errors of the ratios over those stated."""
    return (np.asarray(found.ratios) - RATIOS) / np.asarray(found.ratios_errors)


def test_a_torque_with_a_memory_is_found_with_its_levels_and_its_time(rng):
    sizes = np.array([0.5, 1.0, 2.0, 1.0, 0.5, 2.0, 1.0, 1.0])
    found = identify.fit(
        BLIND,
        some_trials(rng, sizes.size, size=sizes),
        unmodelled="estimate",
        throw=False,
    )
    assert bool(found.status == Status.OK), str(found)
    assert np.all(np.abs(off(found)) < 4)
    level = np.asarray(found.level) * np.exp(np.mean(np.log(found.level_by_trial)))
    level = level / np.exp(np.mean(np.log(sizes)))
    assert np.all(np.abs(np.log(level / LEVELS)) < 0.6), str(found)
    time, error = (
        np.asarray(found.correlation_time),
        np.asarray(found.correlation_time_errors),
    )
    assert np.all(np.abs(time - 0.1) < 4 * error), str(found)
    assert np.corrcoef(np.log(found.level_by_trial), np.log(sizes))[0, 1] > 0.8, str(
        found
    )
    assert "correlation time" in str(found)


@pytest.mark.parametrize("fits", [5, pytest.param(12, marks=pytest.mark.slow)])
def test_errors_stated_are_those_made_where_torques_have_a_memory(fits, rng):
    """Fits of four trials each: the levels differ between axes."""
    records = some_trials(rng, 4 * fits)
    groups = [records[4 * i : 4 * i + 4] for i in range(fits)]
    found = identify.fit_each(BLIND, groups, unmodelled="estimate")
    pulls = off(found)
    # Two numbers of each fit: of 12 fits 1 +- 0.15.
    assert 0.5 < np.sqrt(np.mean(pulls**2)) < 1.6, pulls


def test_errors_include_those_of_the_torque(monkeypatch):
    """They are those of many fits, each given a torque that is as likely as the record
    says."""
    rng = np.random.default_rng(0)
    (record,) = some_trials(rng, 1)
    fits = []

    def caught(fit):
        fits.append(fit)
        return torque_errors.added_by_torque(fit)

    monkeypatch.setattr(errors, "added_by_torque", caught)
    found = identify.fit(BLIND, record, unmodelled="estimate")
    sought = torque_errors.sought_torque(fits[-1])
    assert np.max(np.diagonal(sought.covariance)) < 1  # not bounded by what is known
    half = np.linalg.cholesky(sought.covariance)

    def given(numbers):
        torque = sought.torque._replace(numbers=numbers).typical
        fit = identify.fit(BLIND, record, unmodelled=torque)
        return np.asarray(fit.ratios), np.asarray(fit.ratios_errors)

    _, at_best = given(sought.torque.numbers)
    draws = half @ rng.normal(size=(half.shape[0], 30))
    pairs = np.array([given(sought.torque.numbers + x) for x in draws.T])
    variances = np.var(pairs[:, 0], axis=0) + np.mean(pairs[:, 1] ** 2, axis=0)
    total = np.sqrt(variances)
    assert np.all(at_best < 0.9 * total)
    np.testing.assert_allclose(found.ratios_errors, total, rtol=0.1)


@pytest.mark.parametrize("parts", [(1.0, 1.0, 1.0), (0.4, 1.0, 2.5)])
def test_levels_and_times_that_are_not_there_are_seldom_found(parts):
    """Akaike's criterion finds unlike levels, or a time, in several of these 12."""
    rng = np.random.default_rng(7)
    ts = np.arange(200) * np.pi / 10
    turns = np.stack([worlds.random_axes(rng) for _ in range(12)])
    tensors = np.einsum("nij,j,nkj->nik", turns, MOMENTS / MOMENTS.mean(), turns)
    omega = worlds.times(turns, np.array([0.5, 1.0, 0.4]))
    noise = 0.01
    # A torque of this level changes a rate by its noise from sample to sample.
    level = noise / np.sqrt(ts[1])
    moved = worlds.tumble(tensors, omega, ts, rng=rng, kick=level * np.array(parts))
    readings = moved.omega + noise * rng.normal(size=moved.omega.shape)
    body = jr.RigidBody(np.ones(3))
    found = [
        identify.fit(body, identify.Rates(ts, x, noise), unmodelled="estimate")
        for x in readings
    ]
    unlike = sum(not np.allclose(x.level, x.level[0]) for x in found)
    correlated = sum(bool(np.any(x.correlation_time > 0)) for x in found)
    assert unlike <= 1 if len(set(parts)) == 1 else unlike == 12
    assert correlated <= 1


def test_a_torque_that_is_given_is_used(rng):
    records = some_trials(rng, 2)
    record = records[0]
    torque = identify.GaussMarkov(
        LEVELS, np.array([0.1, 0.1, 0.0])
    )  # white along one axis
    found = identify.fit(BLIND, records, unmodelled=torque, throw=False)
    np.testing.assert_allclose(found.level, LEVELS)
    np.testing.assert_allclose(found.correlation_time, [0.1, 0.1, 0.0], atol=1e-6)
    np.testing.assert_array_equal(found.level_by_trial, [1.0, 1.0])
    assert np.all(np.isfinite(found.level_errors))
    assert np.all(np.abs(off(found)) < 5)
    with pytest.raises(ValueError, match="unmodelled"):
        identify.fit(BLIND, record, unmodelled=identify.GaussMarkov(LEVELS, -0.1))


def test_a_trial_of_another_body_is_named(rng):
    records = some_trials(rng, 10)
    records[3:4] = some_trials(rng, 1, moments=np.array([0.5, 0.9, 1.0]))
    found = identify.fit(BLIND, records, unmodelled="estimate", throw=False)
    np.testing.assert_array_equal(np.flatnonzero(found.rejected_trials), [3])
    assert "trials left out: 3" in str(found)
    assert "trials differ" not in str(found)
    assert np.all(np.abs(off(found)) < 4), str(found)
    # The trial that is left out says nothing of the torque.
    assert found.status == identify.Status.OK, str(found)
    assert np.all(found.level_errors < 0.5 * found.level)


def test_a_level_without_bound_is_a_failed_fit():
    """Nothing but the torque moves the readings, and the noise is not known: it may be none."""
    rng = np.random.default_rng(1)
    failed = []
    for _ in range(6):
        values = np.ones(3) + 0.01 * np.cumsum(rng.normal(size=(60, 3)), axis=0)
        readings = identify.Rates(np.arange(60) * 0.1, values)
        options = {"inertia_model": identify.Fixed(), "unmodelled": "estimate"}
        found = identify.fit(BLIND, readings, throw=False, **options)
        failed.append(bool(found.status == Status.NOT_CONVERGED))
        assert failed[-1] == (not np.all(np.isfinite(found.level)))
        assert failed[-1] == ("has no bound" in str(found).splitlines()[0])
        if failed[-1]:
            with pytest.raises(RuntimeError, match="not converged"):
                identify.fit(BLIND, readings, **options)
    assert any(failed)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("time", [10.0, 1e3, 1e6, 1e10])
def test_a_torque_of_a_long_memory_keeps_its_rms(time, dtype):
    """A constant torque of the rms level / sqrt(2 time) adds that times the step."""
    step = 0.01
    torque = disturbances.Disturbance(
        LEVELS[None].astype(dtype), np.full(3, time, dtype)
    )
    push = disturbances.push_of(
        torque,
        jnp.full((1, 1), step, dtype),
        jnp.ones((1, 1), bool),
        jnp.diag(MOMENTS.astype(dtype)),
        True,
    )
    rms = LEVELS / np.sqrt(2 * time)
    added = np.concatenate(
        [np.diag(rms * step / MOMENTS), np.diag(rms * step**2 / 2 / MOMENTS), np.eye(3)]
    )
    np.testing.assert_allclose(push.carried[0, 0], added, rtol=2e-3)
    assert np.all(np.isfinite(push.whitener))
    # The variance of what the torque itself changes by, in units of its own.
    changes = np.diagonal(push.covariance[0, 0])[6:]
    shortest = 1e-6 if dtype == np.float64 else 1e-4
    np.testing.assert_allclose(changes, 2 * max(step / time, shortest), rtol=1e-2)
