"""The closed form of Lagrange's top in mpmath, at 50 digits,
for times out of a series' reach."""

import mpmath as mp

DIGITS = 50
DOUBLINGS = 40


def _elapsed(mu, a, b, g_alpha, g_beta, h):
    s = h / 2**DOUBLINGS
    w_alpha = s**3 / 3 + (a - 3 * mu) * s**5 / 15
    w_beta = s**3 / 3 + a * s**5 / 15
    s = s + a * s**3 / 6 + (a * a + 12 * b) * s**5 / 120
    for _ in range(DOUBLINGS):
        z = s * s
        slope = mp.sqrt(1 + a * z + b * z**2 - g_beta**2 * z**3)
        y, b_low = z / (1 + mu * z), b + mu * (3 * mu - 2 * a)
        y_rate = 2 * s * slope / (1 + mu * z) ** 2
        f_alpha = y * y_rate / (1 - b_low * y**2 + 2 * g_alpha**2 * y**3)
        f_beta = 2 * z * s * slope / (1 - b * z**2 + 2 * g_beta**2 * z**3)
        w_alpha = 2 * w_alpha + mp.atan(g_alpha * f_alpha) / g_alpha
        w_beta = 2 * w_beta + mp.atan(g_beta * f_beta) / g_beta
        s = (
            2
            * s
            * slope
            / mp.sqrt(
                1
                - 2 * b * z**2
                + 8 * g_beta**2 * z**3
                + (b * b + 4 * a * g_beta**2) * z**4
            )
        )
    return s, w_alpha, w_beta


def _carried(x, dx, m, a, b, g, s, slope, w):
    y = s * s
    n = 1 - m * abs(x) ** 2 * y
    k = slope - 1j * g * s * y
    bend = a + m * abs(x) ** 2 + y * (b - g * g * y) - 1j * g * s * slope
    factor = mp.expj(g * w) / n
    return factor * (x * k + dx * s), factor * (
        dx * (2 * slope / n - k) + x * s * (2 * bend / n - a)
    )


def closed_form(i1, i3, mgl, attitude, omega, time):
    """Attitude (4,) and omega (3,) at one time, as lists of mpf;
    mgl > 0 and no special case."""
    with mp.workdps(DIGITS):
        i1, i3, mgl, time = (mp.mpf(float(x)) for x in (i1, i3, mgl, time))
        q = [mp.mpf(float(x)) for x in attitude]
        norm = mp.sqrt(sum(x * x for x in q))
        q0, q1, q2, q3 = (x / norm for x in q)
        w1, w2, w3 = (mp.mpf(float(x)) for x in omega)
        mu, spin = mgl / i1, i3 / i1 * w3
        alpha, beta, across = mp.mpc(q0, q3), mp.mpc(q1, q2), mp.mpc(w1, w2)
        d_alpha = (1j * spin * alpha - beta * mp.conj(across)) / 2
        d_beta = (alpha * across - 1j * spin * beta) / 2
        sigma = abs(beta) ** 2
        a = (
            3 * mu - 2 * (abs(d_alpha) ** 2 + abs(d_beta) ** 2) - mu * (1 - 2 * sigma)
        ) / 2
        b = -mu * (abs(d_beta) ** 2 + sigma * (mu * sigma - a))
        g_alpha = mu * (mp.conj(alpha) * d_alpha).imag
        g_beta = -mu * (mp.conj(beta) * d_beta).imag
        x = 3 * (
            abs(a) + mp.sqrt(abs(b)) + abs(g_beta) ** (mp.mpf(2) / 3)
        )  # above the largest root
        for _ in range(200):
            x = x - (x**3 + a * x * x + b * x - g_beta**2) / (3 * x * x + 2 * a * x + b)
        q = mp.sqrt(3 * x * x + 2 * a * x + b)
        period = mp.pi / mp.agm(mp.sqrt(a + 3 * x + 2 * q) / 2, mp.sqrt(q))
        r = mp.sqrt(a + 3 * x + 2 * q)
        _, w_alpha, w_beta = _elapsed(mu, a, b, g_alpha, g_beta, period / 4)
        whole = mp.nint(time / period)
        turn_alpha, turn_beta = (
            mp.expj(whole * (4 * g * w + 2 * mp.atan(g / (r * height)) + mp.pi))
            for g, w, height in ((g_alpha, w_alpha, x + mu), (g_beta, w_beta, x))
        )
        s, w_alpha, w_beta = _elapsed(
            mu, a, b, g_alpha, g_beta, (time - whole * period) / 2
        )
        z = s * s
        slope = mp.sqrt(1 + a * z + b * z**2 - g_beta**2 * z**3)
        low = 1 / (1 + mu * z)
        lower = s * mp.sqrt(low), slope * low * mp.sqrt(low)
        for _ in range(2):
            alpha, d_alpha = _carried(
                alpha,
                d_alpha,
                mu,
                a - 3 * mu,
                b + mu * (3 * mu - 2 * a),
                g_alpha,
                *lower,
                w_alpha,
            )
            beta, d_beta = _carried(beta, d_beta, -mu, a, b, g_beta, s, slope, w_beta)
        across = 2 * (mp.conj(alpha) * d_beta - beta * mp.conj(d_alpha))
        turn = mp.expj((w3 - spin) * time / 2)
        alpha, beta = alpha * turn_alpha * turn, beta * turn_beta * mp.conj(turn)
        across = across * turn_beta * mp.conj(turn_alpha) * mp.conj(turn) ** 2
        return [alpha.real, beta.real, beta.imag, alpha.imag], [
            across.real,
            across.imag,
            w3,
        ]
