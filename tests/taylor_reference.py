"""The free body by Taylor series in fixed-point integers, to any number of digits: no formulas.

What the closed form of free_reference.py is checked against.
"""

import operator
from fractions import Fraction
from math import isqrt

import mpmath as mp

# q' = q (0, omega) / 2
_QUATERNION = (
    ((1, 4, -1), (2, 5, -1), (3, 6, -1)),
    ((0, 4, 1), (2, 6, 1), (3, 5, -1)),
    ((0, 5, 1), (3, 4, 1), (1, 6, -1)),
    ((0, 6, 1), (1, 5, 1), (2, 4, -1)),
)


def taylor_motion(moments, attitude, omega, time, bits=256):
    """Attitude (4,) and omega (3,) at one time, as lists of mpf.

    Steps are cut so that the series' last terms fall below the last bit: the error is some
    (steps) x 2^-bits times what the motion itself amplifies.

    Args:
        moments: Three positive doubles.
        attitude: (4,), normalised first.
        omega: (3,), not zero.
        time: A double of either sign.
        bits: After the binary point, with the unit of time such that |omega| is about 1.
    """
    order = int(0.35 * bits)
    moments, attitude, omega = ([Fraction(float(x)) for x in v] for v in (moments, attitude, omega))
    unit = Fraction(2) ** int(mp.ceil(mp.log(float(max(abs(x) for x in omega)), 2)))

    def fixed(x):
        return (x.numerator << bits) // x.denominator

    norm = sum(x * x for x in attitude)
    norm = Fraction(isqrt(fixed(norm) << bits), 1 << bits)
    x = [fixed(v / norm) for v in attitude] + [fixed(v / unit) for v in omega]
    ratios = []
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        ratios.append(fixed((moments[j] - moments[k]) / moments[i]))
    remaining = fixed(Fraction(float(time)) * unit)
    while remaining:
        series = _series(x, ratios, order, bits)
        last = max(abs(component[n]) for component in series for n in (order - 1, order))
        # |last| h^order = 2^-bits, or one unit of time
        exponent = min(0.0, (-last.bit_length() if last else 0) / order)
        step = min(abs(remaining), int(2.0 ** (52 + exponent)) << (bits - 52))
        step = step if remaining > 0 else -step
        for i, component in enumerate(series):
            total = component[order]
            for n in range(order - 1, -1, -1):
                total = component[n] + (total * step >> bits)
            x[i] = total
        remaining -= step
    with mp.workprec(bits + 20):
        x = [mp.mpf(v) / (1 << bits) for v in x]
        return x[:4], [v * unit.numerator / unit.denominator for v in x[4:]]


def _series(x, ratios, order, bits):
    series = [[v] for v in x]
    for n in range(order):
        backward = [component[::-1] for component in series[4:]]
        new = []
        for row in _QUATERNION:
            total = 0
            for j, k, sign in row:
                total += sign * sum(map(operator.mul, series[j], backward[k - 4]))
            new.append((total >> (bits + 1)) // (n + 1))
        for i, (j, k) in enumerate(((1, 2), (2, 0), (0, 1))):
            total = sum(map(operator.mul, series[4 + j], backward[k])) >> bits
            new.append((total * ratios[i] >> bits) // (n + 1))
        for component, v in zip(series, new, strict=True):
            component.append(v)
    return series
