"""The free body in closed form, any body, any state, any time, to more than 30 digits.

An independent check of long motions: elliptic functions and one elliptic integral in
mpmath.

The polhode circles the axis c of the largest or the smallest moment; b is the middle
moment's axis and a the third. Landau & Lifshitz, Mechanics, section 37, give omega as
Jacobi functions of u = rate t + u0,

    omega_a = A cn u,   omega_b = B sn u,   omega_c = C dn u.

In a frame whose z axis is the angular momentum L, the body's z-x-z Euler angles about
the axes (a, b, c) obey cos theta = L_c / L, tan psi = L_a / L_b and
phi' = L (omega_a L_a + omega_b L_b) / (L_a^2 + L_b^2), which the functions above turn
into

    phi' = L / I_c + L (1 / I_a - 1 / I_c) / (1 - n sn^2 u),
    n = -(I_c / I_a) (I_a - I_b) / (I_b - I_c),

an elliptic integral of the third kind with n <= 0, so that it is Carlson's R_J of
positive arguments. (Their derivation is checked by Taylor series in
test_free_reference.py.) A body that turns steadily, (I omega) x omega = 0, is one
rotation. Else the sign of

    D = L^2 - 2 E I_b = I_a (I_a - I_b) omega_a^2 + I_c (I_c - I_b) omega_c^2,

without rounding from the doubles given, says which formula applies: with a the axis of
the smallest moment and c that of the largest, D > 0 circles c, D < 0 circles a (their
names then change places), and D = 0 is the exact separatrix: sech and tanh, and phi' =
L / I_b about the intermediate axis.

Every other quantity is a sum of terms of one sign or is bounded away from cancellation
by D, and carries 60 digits and two more for each decade by which D, or 1 - m, is small.
"""

import mpmath as mp
import numpy as np

DIGITS = 60
# Digits in which products of five doubles, and their sums, are exact in these tests
_EXACT = 700


def free_motion(inertia, attitude, omega, times):
    """Attitude (4,) and omega (3,) at each time, as lists of mpf good to more than 30
    digits.

    The attitude's sign is continuous in time from that of the attitude given, which is
    normalised first.

    Args:
        inertia: Three positive moments, or a symmetric tensor (3, 3), which is
            diagonalised to `DIGITS` + 60 digits: a tensor's exact degeneracies are met
            to that precision only.
        attitude: (4,), scalar first.
        omega: (3,), body components.
        times: A sequence of numbers of either sign, exact as doubles.
    """
    with mp.workdps(_EXACT):
        w0 = _exact(omega)
        times = _exact(times)
    with mp.workdps(DIGITS + 60):
        q0 = _exact(attitude)
        norm = mp.sqrt(sum(x * x for x in q0))
        q0 = [x / norm for x in q0]
        if np.ndim(inertia) == 1:
            turns = _turns(_exact(inertia), w0, times)
        else:
            moments, axes = _principal_axes(inertia)
            turns = [
                ([r[0], *_rotate(axes, r[1:])], _rotate(axes, w))
                for r, w in _turns(
                    moments, _rotate(list(zip(*axes, strict=True)), w0), times
                )
            ]
        return [(_multiply(q0, r), w) for r, w in turns]


def _exact(values):
    return [mp.mpf(float(x)) for x in values]


def _rotate(rows, v):
    return [sum(a * x for a, x in zip(row, v, strict=True)) for row in rows]


def _principal_axes(tensor):
    moments, axes = mp.eigsy(mp.matrix([_exact(row) for row in np.asarray(tensor)]))
    sign = mp.sign(mp.det(axes))
    return list(moments), [[sign * axes[i, j] for j in range(3)] for i in range(3)]


def _turns(moments, w0, times):
    """The rotation since time 0, a quaternion in the body axes of then, and omega."""
    with mp.workdps(_EXACT):
        a, b, c = sorted(range(3), key=lambda i: moments[i])
        ia, ib, ic = moments[a], moments[b], moments[c]
        parts = ia * (ib - ia) * w0[a] ** 2, ic * (ic - ib) * w0[c] ** 2
        excess = parts[1] - parts[0]  # L^2 - 2 E Ib
        steady = all(
            (moments[i] - moments[j]) * w0[i] * w0[j] == 0
            for i, j in ((0, 1), (1, 2), (2, 0))
        )
    if steady:
        return [(_rotation(w0, t), list(w0)) for t in times]
    if excess == 0:
        order, motion, digits = (c, a, b), _separatrix, DIGITS
    else:
        order, motion = ((a, b, c) if excess > 0 else (c, b, a)), _generic
        scale = parts[0] + parts[1] + ib * (ic - ia) * w0[b] ** 2
        digits = DIGITS - 2 * int(mp.log10(abs(excess) / scale))
    # Right-handed axes: the second is reversed where the order is not cyclic.
    sign = 1 if order in ((0, 1, 2), (1, 2, 0), (2, 0, 1)) else -1

    def back(v):
        out = [None] * 3
        out[order[0]], out[order[1]], out[order[2]] = v[0], sign * v[1], v[2]
        return out

    with mp.workdps(digits):
        w = [w0[order[0]], sign * w0[order[1]], w0[order[2]]]
        history = motion([moments[i] for i in order], w, [mp.mpf(0), *times])
        start = history[0][0]
        start = [start[0], -start[1], -start[2], -start[3]]
        turns = []
        for q, rate in history[1:]:
            turn = _multiply(start, q)
            turns.append(([turn[0], *back(turn[1:])], back(rate)))
        return turns


def _rotation(w, t):
    speed = mp.sqrt(sum(x * x for x in w))
    if speed == 0:
        return [mp.mpf(1), mp.mpf(0), mp.mpf(0), mp.mpf(0)]
    s = mp.sin(speed * t / 2) / speed
    return [mp.cos(speed * t / 2), *(s * x for x in w)]


def _euler(momentum, phi, psi):
    """The z-x-z attitude of axes in which L has these components,
    L along z in space."""
    theta = mp.atan2(mp.hypot(momentum[0], momentum[1]), momentum[2])
    c, s = mp.cos(theta / 2), mp.sin(theta / 2)
    plus, minus = (phi + psi) / 2, (phi - psi) / 2
    return [c * mp.cos(plus), s * mp.cos(minus), s * mp.sin(minus), c * mp.sin(plus)]


def _generic(moments, w, times):
    """Euler angles about L, as a quaternion, and omega;
    the polhode circles the third axis."""
    ia, ib, ic = moments
    # Coefficients with (A, B, C) the largest values of the components; all summands are
    # positive.
    peak_a = mp.sqrt(w[0] ** 2 + ib * (ib - ic) / (ia * (ia - ic)) * w[1] ** 2)
    peak_b = peak_a * mp.sqrt(ia * (ia - ic) / (ib * (ib - ic)))
    peak_c = mp.sqrt(w[2] ** 2 + ib * (ib - ia) / (ic * (ic - ia)) * w[1] ** 2)
    if w[2] < 0:
        peak_c = -peak_c
    if (ib - ic) * peak_c > 0:
        peak_b = -peak_b
    rate = mp.sqrt((ic - ib) * (ic - ia) / (ia * ib)) * abs(peak_c)
    with mp.workdps(2 * mp.mp.dps):
        # 1 - m is (Ic - Ia) (L^2 - 2 E Ib) / ((Ic - Ib) (L^2 - 2 E Ia))
        mc = (ic - ia) * (ia * (ia - ib) * w[0] ** 2 + ic * (ic - ib) * w[2] ** 2)
        mc /= (ic - ib) * (ib * (ib - ia) * w[1] ** 2 + ic * (ic - ia) * w[2] ** 2)
        m = 1 - mc
    n = -(ic / ia) * (ia - ib) / (ib - ic)
    quarter = mp.pi / (2 * mp.agm(1, mp.sqrt(mc)))
    length = mp.sqrt(sum((i * x) ** 2 for i, x in zip(moments, w, strict=True)))

    def third_kind(u, sn, cn, dn):
        """Integral of 1 / (1 - n sn^2) from 0 to u, |u| <= K."""
        return u + n / 3 * sn**3 * mp.elliprj(cn**2, dn**2, 1, 1 - n * sn**2)

    whole = third_kind(quarter, mp.mpf(1), mp.mpf(0), mp.sqrt(mc))
    sn, cn, dn = w[1] / peak_b, w[0] / peak_a, w[2] / peak_c
    u0 = sn * mp.elliprf(cn**2, dn**2, 1)
    if cn < 0:
        u0 = (2 if sn > 0 else -2) * quarter - u0
    motion = []
    for t in times:
        u = rate * t + u0
        half_turns = int(mp.nint(u / (2 * quarter)))
        u -= 2 * quarter * half_turns
        sn, cn, dn = (mp.ellipfun(name, u=u, m=m) for name in ("sn", "cn", "dn"))
        phi = length * t / ic
        integral = 2 * half_turns * whole + third_kind(u, sn, cn, dn)
        phi += length * (1 / ia - 1 / ic) * integral / rate
        # psi without jumps: it turns by pi with every half turn of u
        psi = (
            mp.atan2(ia * peak_a * cn, ib * peak_b * sn)
            - mp.sign(peak_b) * half_turns * mp.pi
        )
        sign = -1 if half_turns % 2 else 1
        omega = [sign * peak_a * cn, sign * peak_b * sn, peak_c * dn]
        momentum = [i * x for i, x in zip(moments, omega, strict=True)]
        motion.append((_euler(momentum, phi, psi), omega))
    return motion


def _separatrix(moments, w, times):
    """As `_generic`, exactly on the separatrix; the third axis is that of the middle
    moment.

    The components across the intermediate axis go as sech u with a constant ratio, so
    psi is constant; 2 E = L^2 / I_b makes phi' = L / I_b.
    """
    momentum = [i * x for i, x in zip(moments, w, strict=True)]
    across = mp.hypot(momentum[0], momentum[1])
    length = mp.hypot(across, momentum[2])
    peak = length / moments[2]
    growth = (length / across) ** 2
    rate = (moments[0] - moments[1]) / moments[2] * w[0] * w[1] * growth / peak
    u0 = mp.asinh(momentum[2] / across)
    psi = mp.atan2(momentum[0], momentum[1])
    motion = []
    for t in times:
        u = rate * t + u0
        ratio = mp.sech(u) * mp.cosh(u0)
        omega = [ratio * w[0], ratio * w[1], peak * mp.tanh(u)]
        now = [i * x for i, x in zip(moments, omega, strict=True)]
        motion.append((_euler(now, length * t / moments[2], psi), omega))
    return motion


def _multiply(p, q):
    a, b, c, d = p
    w, x, y, z = q
    return [
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ]
