"""The references of free motion against others that know nothing of them."""

from pathlib import Path

import mpmath as mp
import numpy as np
import pytest
from free_reference import free_motion
from reference import LONG, free_hessian_vector, heavy_body
from taylor_reference import taylor_motion

DATA = np.load(Path(__file__).parent / "data" / "free_rotation.npz")
REGIMES = list(dict.fromkeys(DATA["regime"].tolist()))


def _distance(motion, other, omega):
    """Largest difference of the attitudes, sign included,
    and of omega relative to its size."""
    scale = mp.sqrt(sum(mp.mpf(float(w)) ** 2 for w in omega)) or mp.mpf(1)
    with mp.workdps(50):
        attitude = max(abs(a - b) for a, b in zip(motion[0], other[0], strict=True))
        return max(
            attitude,
            *(abs(a - b) / scale for a, b in zip(motion[1], other[1], strict=True)),
        )


def _difference(moments, attitude, omega, time, bits=160):
    (closed,) = free_motion(moments, attitude, omega, [time])
    return _distance(closed, taylor_motion(moments, attitude, omega, time, bits), omega)


@pytest.mark.parametrize(
    ("moments", "omega", "time"),
    [
        ((1.0, 2.0, 3.3), (0.2, -0.3, -0.9), 40.0),
        ((2.0, 1.0, 3.3), (0.3, -0.9, 0.2), -40.0),
        ((3.3, 1.0, 2.0), (0.9, 0.2, 0.3), 40.0),
        ((1.0, 2.0, 2.25), (-0.75, 0.5, 1.0), 15.0),
        ((2.0, 1.0, 2.25), (0.5, 0.75 * (1 + 1e-13), 1.0), -20.0),
        ((1.7, 0.6, 1.7), (0.5, 0.2, 0.6), 40.0),
        ((1.0, 1.0 + 1e-13, 1.0 - 3e-14), (0.5, 0.7, 0.1), 40.0),
        ((1.0, 2.0, 3.0), (1e-8, 1.0, 2e-9), 25.0),
    ],
    ids=[
        "largest",
        "smallest",
        "other handedness",
        "separatrix",
        "near separatrix",
        "symmetric",
        "nearly sphere",
        "near the intermediate axis",
    ],
)
def test_closed_form_against_taylor_series(moments, omega, time):
    assert _difference(moments, (0.5, -0.1, 0.7, 0.3), omega, time) < 1e-30


@pytest.mark.parametrize("every", [50, pytest.param(1, marks=pytest.mark.slow)])
def test_stored_motions_are_those_of_the_closed_form(every):
    for k in range(0, len(DATA["time"]), every):
        attitude, omega = (DATA[name][k] for name in ("attitude", "omega"))
        body = DATA["tensor" if DATA["regime"][k] == "tensor" else "inertia"][k]
        (closed,) = free_motion(body, attitude, omega, [DATA["time"][k]])
        with mp.workdps(50):
            stored = [
                [
                    mp.mpf(float(high)) + mp.mpf(float(low))
                    for high, low in zip(
                        DATA[f"{name}_out"][k], DATA[f"{name}_low"][k], strict=True
                    )
                ]
                for name in ("attitude", "omega")
            ]
        assert _distance(closed, stored, omega) < 1e-30, k


@pytest.mark.slow
@pytest.mark.parametrize("regime", [r for r in REGIMES if r not in ("rest", "tensor")])
def test_every_regime_against_taylor_series(regime, rng):
    """Four cases of each, 60 to 200 radians, less where the body itself is much
    faster."""
    rows = np.flatnonzero(DATA["regime"] == regime)
    largest = 0.0
    for k in rng.choice(rows, 4, replace=False):
        moments, attitude, omega = (
            DATA[name][k] for name in ("inertia", "attitude", "omega")
        )
        unstable = "separatrix" in regime or "middle" in regime
        radians = rng.uniform(60, 100 if unstable else 200) * rng.choice([-1, 1])
        i1, i2, i3 = np.sort(moments)
        radians /= max(1, (i3 - i1) / i1 / 5)
        bits = 160
        if unstable:
            bits += int(
                abs(radians) * np.sqrt((i2 - i1) * (i3 - i2) / (i1 * i3)) / np.log(2)
            )
        speed = np.max(np.abs(omega))
        speed *= np.linalg.norm(omega / speed)
        difference = _difference(moments, attitude, omega, radians / speed, bits)
        largest = max(largest, difference)
    print(f"{regime}: {mp.nstr(largest, 2)}")
    assert largest < 1e-30


def test_tensor_is_its_principal_moments_in_other_axes(rng):
    """About axes of whole numbers over 3, so that the tensor is exact."""
    axes = np.array([[2.0, 1, 2], [-2, 2, 1], [1, 2, -2]]).T
    axes *= np.sign(np.linalg.det(axes))
    moments = np.array([9.0, 27, 36])
    for _ in range(4):
        local, attitude = rng.normal(size=3).astype(np.float16), rng.normal(size=4)
        omega = axes @ local.astype(
            float
        )  # exact: three times the components in principal axes
        tensor = axes @ np.diag(moments / 9) @ axes.T
        (q, w), (p, v) = (
            free_motion(tensor, attitude, omega, [20.0])[0],
            free_motion(moments, attitude, 3 * local.astype(float), [20.0])[0],
        )
        with mp.workdps(50):
            start = [mp.mpf(x) for x in attitude.tolist()]
            norm = mp.sqrt(sum(x * x for x in start))
            start = [x / norm for x in start]
            turn, principal = _relative(start, q), _relative(start, p)
            back = [
                [
                    sum(mp.mpf(a) / 3 * x for a, x in zip(row, u, strict=True))
                    for row in axes.tolist()
                ]
                for u in (principal[1:], v)
            ]
            expected = [principal[0], *back[0]], back[1]
        assert _distance((turn, w), expected, omega) < 1e-30


def _relative(p, q):
    """Conjugate of p times q."""
    a, b, c, d = p
    w, x, y, z = q
    return [
        a * w + b * x + c * y + d * z,
        a * x - b * w - c * z + d * y,
        a * y + b * z - c * w - d * x,
        a * z - b * y + c * x - d * w,
    ]


@pytest.mark.slow
def test_three_thousand_radians_against_taylor_series():
    omega = (0.2, -0.4, 0.9)
    time = 3000 / float(np.linalg.norm(omega))
    assert _difference((1.0, 2.0, 3.3), (0.5, -0.1, 0.7, 0.3), omega, time, 128) < 1e-30


@pytest.mark.parametrize("duration", [5.0, -8.0])
def test_second_derivatives_are_differences_of_the_first(rng, duration):
    """Of any body, the separatrix, a sphere, a symmetric body,
    and spin about an axis."""
    moments = rng.uniform(1, 2, (6, 3))
    moments[1], moments[2], moments[3, 0] = [1, 2, 2.25], 1.5, moments[3, 1]
    omega = rng.normal(size=(6, 3))
    omega /= np.linalg.norm(omega, axis=1, keepdims=True)
    omega[1], omega[4, 1:], omega[5] = [0.6, 0.2, -0.8], 0, [0, 1, 0]
    inputs = np.concatenate([rng.normal(size=(6, 4)), omega, moments], axis=1).astype(
        LONG
    )
    direction = rng.normal(size=(6, 10))

    def jacobian(shift):
        x = inputs + shift * direction
        return heavy_body(x[:, 7:], x[:, :4], x[:, 4:7], duration)[1]

    h = LONG(2) ** -15
    near, far = ((jacobian(s) - jacobian(-s)) / (2 * s) for s in (h, 2 * h))
    expected = (4 * near - far) / 3
    durations = np.full(6, duration)
    found = free_hessian_vector(moments, inputs[:, :4], omega, durations, direction)
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(
            one, other, rtol=0, atol=1e-11 * np.max(np.abs(other))
        )
