"""Free bodies and symmetric tops by Taylor series in fixed-point integers: no formulas.

Good to any number of digits; what the closed form of free_reference.py is checked
against.
"""

import operator
from fractions import Fraction
from math import isqrt

import mpmath as mp

# The state is the attitude (0 to 3), omega (4 to 6) and, for a top, the vertical gamma
# in body components (7 to 9). A rate is the sum of sign * state[j] * state[k] over its
# (j, k, sign).

# q' = q (0, omega) / 2, without the half
_QUATERNION = (
    ((1, 4, -1), (2, 5, -1), (3, 6, -1)),
    ((0, 4, 1), (2, 6, 1), (3, 5, -1)),
    ((0, 5, 1), (3, 4, 1), (1, 6, -1)),
    ((0, 6, 1), (1, 5, 1), (2, 4, -1)),
)
# gamma' = gamma x omega
_VERTICAL = (
    ((8, 6, 1), (9, 5, -1)),
    ((9, 4, 1), (7, 6, -1)),
    ((7, 5, 1), (8, 4, -1)),
)


def taylor_motion(moments, attitude, omega, time, bits=256):
    """Attitude (4,) and omega (3,) of a free body at one time, as lists of mpf.

    Steps are cut so that the series' last terms fall below the last bit: the error is
    some (steps) x 2^-bits times what the motion itself amplifies.

    Args:
        moments: Three positive doubles.
        attitude: (4,), normalised first.
        omega: (3,), not zero.
        time: A double of either sign.
        bits: After the binary point, with the unit of time such that |omega| is about
            1.
    """
    moments = _exact(moments)
    ratios = []
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        ratios.append((moments[j] - moments[k]) / moments[i])
    fastest = max(abs(float(x)) for x in omega)
    return _motion(ratios, None, attitude, omega, time, fastest, bits)


def taylor_top(i1, i3, mgl, attitude, omega, time, bits=128):
    """Attitude (4,) and omega (3,) of a heavy symmetric top at one time,
    as lists of mpf.

    I1 omega1' = (I1 - I3) omega2 omega3 + mgl gamma2, and so on, with gamma the
    vertical in body components. The error is as in `taylor_motion`.

    Args:
        i1: The moment about body axes 1 and 2.
        i3: The moment about body axis 3, on which the centre of mass lies.
        mgl: Weight times the height of the centre of mass on axis 3, of either sign.
        attitude: (4,), body to space, normalised first.
        omega: (3,), in body components.
        time: A double of either sign.
        bits: After the binary point, with the unit of time such that the largest of
            |omega|,
            |I3 / I1 omega3| and sqrt(|mgl| / I1) is about 1.
    """
    i1, i3, mgl = _exact((i1, i3, mgl))
    rates = [*_exact(omega), i3 / i1 * _exact(omega)[2]]
    fastest = max(*(abs(float(x)) for x in rates), float(abs(mgl / i1)) ** 0.5)
    ratio = (i1 - i3) / i1
    return _motion(
        (ratio, -ratio, Fraction(0)), mgl / i1, attitude, omega, time, fastest, bits
    )


def _motion(ratios, torque, attitude, omega, time, fastest, bits):
    """omega1' = ratio1 omega2 omega3 + torque gamma2, and so on; `torque` None:
    a free body."""

    def fixed(x):
        return (x.numerator << bits) // x.denominator

    order = int(0.35 * bits)
    unit = Fraction(2) ** int(mp.ceil(mp.log(fastest, 2)) if fastest else 0)
    attitude, omega = _exact(attitude), _exact(omega)
    square = sum(x * x for x in attitude)
    norm = Fraction(isqrt(fixed(square) << bits), 1 << bits)
    x = [fixed(v / norm) for v in attitude] + [fixed(v / unit) for v in omega]
    if torque is not None:
        q0, q1, q2, q3 = attitude
        vertical = (
            2 * (q1 * q3 - q0 * q2),
            2 * (q2 * q3 + q0 * q1),
            q0**2 - q1**2 - q2**2 + q3**2,
        )
        x += [fixed(v / square) for v in vertical]
        torque = fixed(torque / unit**2)
    ratios = [fixed(r) for r in ratios]
    remaining = fixed(Fraction(float(time)) * unit)
    while remaining:
        series = _series(x, ratios, torque, order, bits)
        last = max(abs(v) for component in series for v in component[order - 1 :])
        # |last| h^order = 2^-bits, or one unit of time
        exponent = min(0.0, (-last.bit_length() if last else 0) / order)
        step = min(abs(remaining), int(2.0 ** (52 + exponent)) << (bits - 52))
        step = step if remaining > 0 else -step
        for i, component in enumerate(series):
            total = component[-1]
            for v in component[-2::-1]:
                total = v + (total * step >> bits)
            x[i] = total
        remaining -= step
    with mp.workprec(bits + 20):
        x = [mp.mpf(v) / (1 << bits) for v in x]
        return x[:4], [v * unit.numerator / unit.denominator for v in x[4:7]]


def _series(x, ratios, torque, order, bits):
    """Taylor coefficients of each component; of a constant omega, the first alone."""
    series = [[v] for v in x]
    moving = [ratio or (torque and i < 2) for i, ratio in enumerate(ratios)]
    for n in range(order):
        new = [_rate(series, row) >> (bits + 1) for row in _QUATERNION]
        for i, (j, k) in enumerate(((5, 6), (6, 4), (4, 5))):
            rate = None
            if moving[i]:
                rate = (_product(series[j], series[k]) >> bits) * ratios[i] >> bits
            if moving[i] and torque:
                rate += (torque * series[8][n], -torque * series[7][n])[i] >> bits
            new.append(rate)
        if torque is not None:
            new += [_rate(series, row) >> bits for row in _VERTICAL]
        for component, rate in zip(series, new, strict=True):
            if rate is not None:
                component.append(rate // (n + 1))
    return series


def _rate(series, row):
    return sum(sign * _product(series[j], series[k]) for j, k, sign in row)


def _product(a, b):
    """The last coefficient of the product of two series,
    one of which may be constant."""
    short, long = (a, b) if len(a) < len(b) else (b, a)
    return sum(map(operator.mul, short, reversed(long)))


def _exact(values):
    return [Fraction(float(x)) for x in values]
