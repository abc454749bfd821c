"""The main job: the Earth's wobble, and a synthetic top whose answer is known."""

import pathlib
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jrigid as jr

pytest.importorskip("astropy_iers_data")
sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "examples"))
import earth_wobble
import symmetric_top


@pytest.fixture(scope="module")
def pole():
    return earth_wobble.rotation_pole(jr.datasets.earth_pole())


@pytest.fixture(scope="module")
def result(pole):
    return earth_wobble.analyse(pole)


def test_from_305_days_to_the_least_squares_answer(result):
    assert abs(result.period - result.linear_period) < 0.1 * result.bootstrap_error
    assert result.bootstrap_error < result.period_error


def test_period_agrees_with_an_independent_analysis(result):
    # 432.6 +- 0.4 days: cubic trend, annual and semiannual terms, one prograde
    # exponential.
    assert abs(result.period - 432.6) < 0.4
    assert abs(result.ellipticity - 0.002305) < 3e-6
    assert result.rms < 0.55 * result.rigid_rms


def test_error_allows_for_the_kicks(result):
    # The wobble depends on the window by ten days, see below; a bootstrap that cannot
    # see the memory of the wobble claims 0.4 days.
    assert 1.0 < result.period_error < 4.0


def test_period_depends_on_the_window(pole):
    for begin, end, days in ((2000, 2010, 441), (2005, 2027, 428)):
        inside = (pole.years >= begin) & (pole.years < end)
        part = earth_wobble.Pole(pole.mjd[inside], pole.m[inside])
        assert abs(earth_wobble.linear_fit(part) - days) < 1.5


@pytest.mark.slow
def test_another_start_ends_at_the_same_period(pole, result):
    fit = earth_wobble.fit_wobble(pole, 2000.0)
    assert bool(fit.converged)
    assert (
        abs(earth_wobble.period_of_fit(fit) - result.period)
        < 0.01 * result.period_error
    )


def test_the_wobble_turns_with_the_spin_and_naively_read_against_it(pole):
    """y is positive toward the west: read as x + i y, the Earth comes out prolate."""
    assert earth_wobble.linear_fit(pole) > 0
    naive = earth_wobble.Pole(pole.mjd, pole.m.conj())
    assert earth_wobble.linear_fit(naive) < 0
    fit = earth_wobble.fit_wobble(naive, -earth_wobble.RIGID_PERIOD)
    assert earth_wobble.period_of_fit(fit) < -400  # I3 < I1


def test_published_pole_is_not_the_pole_of_rotation():
    """m = p - (i / Omega) p': a wobble with the spin is larger in m than in p."""
    days = np.arange(4000.0)
    rate = 2 * np.pi / 432.6
    p = 1e-6 * np.exp(1j * rate * days)
    zeros = np.zeros_like(days)
    record = jr.datasets.EarthPole(51544.5 + days, p.real, -p.imag, zeros, zeros)
    m = earth_wobble.rotation_pole(record, days=1).m * earth_wobble.SCALE
    factor = 1 + rate / earth_wobble.SPIN_PER_DAY
    np.testing.assert_allclose(m[1:-1], factor * p[1:-1], rtol=1e-6)


def test_integrated_body_is_the_exponential_of_linear_theory(pole):
    rng = np.random.default_rng(5)
    wobble = earth_wobble.Wobble(
        jnp.asarray(earth_wobble.RIGID_PERIOD / 432.6),
        jnp.asarray(rng.normal(size=2)),
        jnp.asarray(rng.normal(size=(4, 2))),
        jnp.zeros((4, 2)),
    )
    tau = pole.tau
    moved = np.asarray(earth_wobble.pole_of_body(wobble, jnp.asarray(tau)))
    rate = earth_wobble.ellipticity_of_period(432.6)
    expected = (np.asarray(wobble.start) @ [1, 1j]) * np.exp(1j * rate * tau)
    for season, (real, imaginary) in zip(
        earth_wobble.SEASONS, np.asarray(wobble.seasons), strict=True
    ):
        torque = (real + 1j * imaginary) * earth_wobble.ANNUAL
        answer = (np.exp(1j * season * tau) - np.exp(1j * rate * tau)) / (
            1j * (season - rate)
        )
        expected = expected + torque * answer
    np.testing.assert_allclose(moved[:, 0] + 1j * moved[:, 1], expected, atol=2e-4)


def solve_normal_equations(basis, rows):
    return np.linalg.solve(basis.conj().T @ basis, basis.conj().T @ rows)


def linearised_fit(pole, observed, ellipticity):
    """Linear least squares and its Jacobian, by Gauss-Newton from within the basin."""
    unit = earth_wobble.ellipticity_of_period(earth_wobble.RIGID_PERIOD)
    tau = pole.tau
    seasons = np.exp(1j * np.outer(tau, earth_wobble.SEASONS))
    others = np.concatenate([seasons, earth_wobble.drift_basis(tau)], axis=1)
    for _ in range(4):
        basis = np.concatenate(
            [np.exp(1j * ellipticity * tau)[:, None], others], axis=1
        )
        amplitudes = solve_normal_equations(basis, observed)
        residual = basis @ amplitudes - observed
        slope = 1j * unit * tau * amplitudes[0] * basis[:, 0]
        columns = np.concatenate([slope[:, None], basis, 1j * basis], axis=1)
        jacobian = np.stack([columns.real, columns.imag], axis=1)
        jacobian = jacobian.reshape(-1, columns.shape[1])
        rows = np.stack([residual.real, residual.imag], axis=1).reshape(-1)
        ellipticity -= unit * solve_normal_equations(jacobian, rows)[0]
    wobble = earth_wobble.Wobble(
        jnp.asarray(ellipticity / unit),
        jnp.zeros(2),
        jnp.zeros((4, 2)),
        jnp.zeros((4, 2)),
    )
    return earth_wobble.WobbleFit(
        wobble, jnp.asarray(rows), jnp.asarray(jacobian), 0, True
    )


def test_standard_error_is_right_for_a_wobble_that_is_kicked_all_the_time():
    """Over simulated Earths the kicked covariance gives honest pulls,
    the block bootstrap not."""
    pole = earth_wobble.rotation_pole(jr.datasets.earth_pole(), days=80)
    rng = np.random.default_rng(1891)
    rate = earth_wobble.ellipticity_of_period(432.6)
    wobble = np.exp(1j * rate * pole.tau)
    step = pole.tau[1] - pole.tau[0]
    level = (
        2.2 / 100**2 / earth_wobble.SPIN_PER_DAY
    )  # 2.2 mas^2 a day, as in the record

    @jax.jit
    def bootstrap(jacobian, residuals):
        jacobian, residuals = jacobian.reshape(-1, 2, 19), residuals.reshape(-1, 2)
        shifts = jr.identify.block_bootstrap(
            jacobian, residuals, 18, jax.random.key(0), samples=100
        )
        return jnp.std(shifts[:, 0])

    honest, naive = [], []
    for _ in range(40):
        kicks = rng.normal(size=(len(wobble), 2)) @ [1, 1j] * np.sqrt(level * step / 2)
        fit = linearised_fit(pole, wobble * (1.5 + np.cumsum(kicks / wobble)), rate)
        off = float(fit.params.ellipticity) - rate / earth_wobble.ellipticity_of_period(
            305.0
        )
        honest.append(off / np.sqrt(earth_wobble.kicked_covariance(pole, fit)[0, 0]))
        naive.append(off / bootstrap(fit.jacobian, fit.residuals))
    print("pulls", np.mean(honest), np.std(honest), np.std(naive))
    assert abs(np.mean(honest)) < 0.4
    assert 0.75 < np.std(honest) < 1.4
    assert np.std(naive) > 2.5


@pytest.mark.slow  # pulls of blind fits are in test_identify_fit.py, too
def test_pulls_of_the_synthetic_top_are_standard_normal():
    keys = jax.random.split(jax.random.key(7), 100)
    readings = jax.jit(jax.vmap(symmetric_top.read_gyro))(keys)
    found = [symmetric_top.recover(x) for x in readings]
    ratio, error, converged = map(jnp.stack, zip(*found, strict=True))
    assert bool(jnp.all(converged))
    pulls = (ratio - symmetric_top.TRUE_RATIO) / error
    assert abs(float(jnp.mean(pulls))) < 0.3
    assert 0.8 < float(jnp.std(pulls)) < 1.2
