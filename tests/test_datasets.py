"""Records: where the axes point, what the units are, what the missing extra says."""

import sys

import diffrax
import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import jrigid as jr

MAS = np.pi / 648e6


@pytest.fixture(scope="module")
def earth():
    pytest.importorskip("astropy_iers_data")
    return jr.datasets.earth_pole()


@pytest.fixture(scope="module")
def toutatis():
    return jr.datasets.toutatis_1992()


def test_earth_pole_is_daily_from_1962_on(earth):
    assert earth.mjd[0] == 37665.0  # 1 January 1962
    assert len(earth.mjd) > 23000
    np.testing.assert_array_equal(np.diff(earth.mjd), 1.0)
    assert all(np.all(np.isfinite(series)) for series in (earth.x, earth.y))
    assert np.all(earth.x_sigma > 0)
    assert np.all(earth.y_sigma > 0)


def test_earth_pole_reads_the_published_digits(earth):
    # First line of the file: x = -0.0127", y = 0.2130", errors 0.03".
    np.testing.assert_allclose(earth.x[0] / MAS, -12.7, rtol=1e-12)
    np.testing.assert_allclose(earth.y[0] / MAS, 213.0, rtol=1e-12)
    np.testing.assert_allclose(earth.x_sigma[0] / MAS, 30.0, rtol=1e-12)


def test_earth_pole_without_its_extra_says_which(monkeypatch):
    monkeypatch.setitem(sys.modules, "astropy_iers_data", None)
    with pytest.raises(
        ImportError, match=r'astropy-iers-data: pip install "jrigid\[data\]"'
    ):
        jr.datasets.earth_pole()


def hat_rotation(attitudes):
    w, x, y, z = np.moveaxis(attitudes, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def test_toutatis_attitudes_are_z_x_z(toutatis):
    def about(axis, angle):
        c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        matrices = {
            "x": [[1, 0, 0], [0, c, -s], [0, s, c]],
            "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
        }
        return np.array(matrices[axis])

    expected = (
        about("z", 122.2) @ about("x", 86.5) @ about("z", 107.0)
    )  # first line of the file
    np.testing.assert_allclose(
        hat_rotation(toutatis.attitudes[0]), expected, atol=1e-14
    )
    np.testing.assert_allclose(
        np.linalg.norm(toutatis.attitudes, axis=1), 1.0, atol=1e-15
    )


@eqx.filter_jit
def free_body(moments, attitude, omega, times):
    def rate(t, y, moments):
        q, w = y[:4], y[4:]
        q_rate = jnp.stack(
            [
                -q[1] * w[0] - q[2] * w[1] - q[3] * w[2],
                q[0] * w[0] + q[2] * w[2] - q[3] * w[1],
                q[0] * w[1] + q[3] * w[0] - q[1] * w[2],
                q[0] * w[2] + q[1] * w[1] - q[2] * w[0],
            ]
        )
        return jnp.concatenate([q_rate / 2, jr.euler_equations(moments, w)])

    return diffrax.diffeqsolve(
        diffrax.ODETerm(rate),
        diffrax.Dopri8(),
        0.0,
        times[-1],
        1000.0,
        jnp.concatenate([attitude, omega]),
        moments,
        saveat=diffrax.SaveAt(ts=times),
        stepsize_controller=diffrax.PIDController(rtol=1e-9, atol=1e-15),
    ).ys


def misfit_degrees(toutatis, omega):
    given = (toutatis.moments, toutatis.epoch_attitude, omega, toutatis.times[:17])
    state = np.asarray(free_body(*map(jnp.asarray, given)))
    overlap = np.abs(np.sum(state[:, :4] * toutatis.attitudes[:17], axis=1))
    overlap /= np.linalg.norm(state[:, :4], axis=1)
    degrees = np.degrees(2 * np.arccos(np.minimum(overlap, 1.0)))
    per_day = (
        np.degrees(np.linalg.norm(state[:, 4:] - toutatis.omegas[:17], axis=1)) * 86400
    )
    return degrees, per_day


def test_toutatis_axes_are_right_handed_as_labelled(toutatis):
    """The published epoch state, moving freely with the published moments,
    meets the radar."""
    degrees, per_day = misfit_degrees(toutatis, toutatis.epoch_omega)
    assert np.median(degrees) < 6.0
    assert np.max(degrees) < 16.5
    wrong = np.nonzero(per_day > 20.0)[0]
    np.testing.assert_array_equal(wrong, [5, 12])  # as the docstring says
    assert np.median(per_day) < 7.0


@pytest.mark.parametrize(
    "signs", [(-1, 1, 1), (1, -1, 1), (1, 1, -1), (-1, -1, 1), (1, -1, -1)]
)
def test_toutatis_axes_labelled_otherwise_miss_the_radar(toutatis, signs):
    degrees, _ = misfit_degrees(toutatis, toutatis.epoch_omega * np.array(signs))
    assert np.median(degrees) > 30.0


def test_gyro_example_is_free_rotation_plus_its_noise():
    record = jr.datasets.gyro_example()
    assert record.omegas.shape == (200, 3)
    energy = np.sum(record.true_moments * record.true_omegas**2, axis=1)
    momentum = np.sum((record.true_moments * record.true_omegas) ** 2, axis=1)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-7)
    np.testing.assert_allclose(momentum, momentum[0], rtol=1e-7)
    np.testing.assert_allclose(
        np.std(record.omegas - record.true_omegas), record.sigma, rtol=0.1
    )
    assert np.ptp(np.sign(record.true_omegas[:, 1])) == 2.0  # it flips over


def test_gyro_example_is_the_same_at_every_call():
    first, second = jr.datasets.gyro_example(), jr.datasets.gyro_example()
    np.testing.assert_array_equal(first.omegas, second.omegas)


def test_records_print_their_numbers():
    assert "moments=[3.0836, 3.235 , 1. " in repr(jr.datasets.toutatis_1992())
    assert "sigma=0.06" in repr(jr.datasets.gyro_example())
