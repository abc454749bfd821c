"""The free body in closed form at 25 digits, for any time: elliptic functions and one quadrature.

An independent check of long integrations. About the angular momentum L (the z axis of an auxiliary
frame) the body's z-x-z Euler angles obey cos theta = L3 / L, tan psi = L1 / L2 and
phi' = L (omega1 L1 + omega2 L2) / (L1^2 + L2^2), whose right side is periodic in time.
"""

import mpmath as mp


def free_motion(moments, attitude, omega, times):
    """Attitude (4,) and omega (3,) at each time, as lists of mpf.

    For I1 < I2 < I3, any initial state off the separatrix, in the regime that circles axis 3
    (2 E I2 < L^2), which is that of the callers.
    """
    mp.mp.dps = 25
    i1, i2, i3 = (mp.mpf(float(x)) for x in moments)
    w0 = [mp.mpf(float(x)) for x in omega]
    q0 = [mp.mpf(float(x)) for x in attitude]
    norm = mp.sqrt(sum(x * x for x in q0))
    q0 = [x / norm for x in q0]
    energy2 = i1 * w0[0] ** 2 + i2 * w0[1] ** 2 + i3 * w0[2] ** 2
    square = (i1 * w0[0]) ** 2 + (i2 * w0[1]) ** 2 + (i3 * w0[2]) ** 2
    assert square > energy2 * i2
    # Landau & Lifshitz, Mechanics, section 37
    a1 = mp.sqrt((energy2 * i3 - square) / (i1 * (i3 - i1)))
    a2 = mp.sqrt((energy2 * i3 - square) / (i2 * (i3 - i2)))
    a3 = mp.sqrt((square - energy2 * i1) / (i3 * (i3 - i1)))
    rate = mp.sqrt((i3 - i2) * (square - energy2 * i1) / (i1 * i2 * i3))
    m = (i2 - i1) * (energy2 * i3 - square) / ((i3 - i2) * (square - energy2 * i1))
    side = 1 if w0[2] > 0 else -1
    period = 4 * mp.ellipk(m) / rate
    # omega = (a1 cn u, side a2 sn u, side a3 dn u), u = rate t + u0
    amplitude = mp.atan2(side * w0[1] / a2, w0[0] / a1)
    u0 = mp.ellipf(amplitude, m)

    def body_rate(t):
        u = rate * t + u0
        sn, cn, dn = (mp.ellipfun(name, u=u, m=m) for name in ("sn", "cn", "dn"))
        return [a1 * cn, side * a2 * sn, side * a3 * dn]

    length = mp.sqrt(square)

    def precession(t):
        sine = mp.ellipfun("sn", u=rate * t + u0, m=m) ** 2
        first, second = i1 * a1 * a1 * (1 - sine), i2 * a2 * a2 * sine
        return length * (first + second) / (i1 * first + i2 * second)

    def quadrature(a, b):
        pieces = int(mp.ceil(4 * (b - a) / period))
        return mp.quad(precession, mp.linspace(a, b, pieces + 1), method="gauss-legendre")

    whole = quadrature(mp.mpf(0), period)

    def about_momentum(w, phi):
        l1, l2, l3 = i1 * w[0], i2 * w[1], i3 * w[2]
        theta = mp.atan2(mp.sqrt(l1 * l1 + l2 * l2), l3)
        psi = mp.atan2(l1, l2)
        c, s = mp.cos(theta / 2), mp.sin(theta / 2)
        plus, minus = (phi + psi) / 2, (phi - psi) / 2
        return [c * mp.cos(plus), s * mp.cos(minus), s * mp.sin(minus), c * mp.sin(plus)]

    start = about_momentum(w0, mp.mpf(0))
    frame = _multiply(q0, [start[0], -start[1], -start[2], -start[3]])
    motion = []
    for time in times:
        t = mp.mpf(float(time))
        turns = mp.floor(t / period)
        rest = t - turns * period
        phi = turns * whole + (quadrature(mp.mpf(0), rest) if rest > 0 else 0)
        w = body_rate(t)
        motion.append((_multiply(frame, about_momentum(w, phi)), w))
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
