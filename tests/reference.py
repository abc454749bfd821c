"""Reference motions in extended precision, by a method unlike the package's:
Taylor series.

Free and heavy bodies are quadratic differential equations, x_i' = sum of c x_j x_k over
a short list of terms. Their Taylor coefficients and those of the variational equations
follow from a recurrence, here in 80-bit floating point, for many bodies side by side,
with steps short enough that truncation is below rounding (1e-19 a step).
"""

import numpy as np

LONG = np.longdouble
ORDER = 20
LARGEST_STEP = 0.25

# q' = q (0, omega) / 2
_QUATERNION = (
    (0, 1, 0, -1),
    (0, 2, 1, -1),
    (0, 3, 2, -1),
    (1, 0, 0, 1),
    (1, 2, 2, 1),
    (1, 3, 1, -1),
    (2, 0, 1, 1),
    (2, 3, 0, 1),
    (2, 1, 2, -1),
    (3, 0, 2, 1),
    (3, 1, 1, 1),
    (3, 2, 0, -1),
)
_CYCLIC = ((0, 1, 2), (1, 2, 0), (2, 0, 1))


def _bilinear(x, y, terms):
    """Sum of c x_j y_k into row i; x (a, n, B), y (a, n, ...,
    B) summed over the first axis."""
    i, j, k, c = terms
    left = x[:, j]
    right = y[:, k]
    if right.ndim == 4:
        left = left[:, :, None]
        c = c[:, None]
    products = c * np.sum(left * right, axis=0)
    out = np.zeros(y.shape[1:], LONG)
    np.add.at(out, i, products)
    return out


def _flow(terms, derivative_terms, x, dx, duration):
    i, j, k, c = terms
    swapped = (i, k, j, c)
    di, dj, dk, parameter, dc = derivative_terms
    steps = max(1, int(np.ceil(abs(duration) / LARGEST_STEP)))
    h = LONG(duration) / steps
    for _ in range(steps):
        series = np.zeros((ORDER + 1, *x.shape), LONG)
        slopes = np.zeros((ORDER + 1, *dx.shape), LONG)
        series[0], slopes[0] = x, dx
        for n in range(ORDER):
            forward, backward = series[: n + 1], series[n::-1]
            slope = slopes[n::-1]
            series[n + 1] = _bilinear(forward, backward, terms) / (n + 1)
            total = _bilinear(forward, slope, terms) + _bilinear(
                forward, slope, swapped
            )
            explicit = dc * np.sum(forward[:, dj] * backward[:, dk], axis=0)
            np.add.at(total, (di, parameter), explicit)
            slopes[n + 1] = total / (n + 1)
        x, dx = series[ORDER], slopes[ORDER]
        for n in range(ORDER - 1, -1, -1):
            x, dx = series[n] + h * x, slopes[n] + h * dx
    return x, dx


def heavy_body(moments, attitude, omega, duration, moment_of_weight=None):
    """Motion of heavy (or free) bodies and its derivatives, at the end of `duration`.

    Gravity pulls along -z in space; `moment_of_weight` w is m g lever in body
    components, so that I omega' = (I omega) x omega + gamma x w, gamma' = gamma x
    omega, gamma the vertical in the body. For a free body leave it out.

    Args:
        moments: (B, 3).
        attitude: (B, 4), unit.
        omega: (B, 3).
        duration: One number.
        moment_of_weight: (B, 3) or None.

    Returns:
        State (B, 7): attitude and omega; Jacobian (B, 7, 10 or 13) with respect to
        attitude (4), omega (3), moments (3) and w (3), as long doubles.
    """
    moments, attitude, omega = (
        np.asarray(v, LONG).T for v in (moments, attitude, omega)
    )
    bodies = moments.shape[1]
    heavy = moment_of_weight is not None
    one = np.ones(bodies, LONG)
    terms, derivatives = [], []
    for i, j, k, sign in _QUATERNION:
        terms.append((i, j, 4 + k, sign * one / 2))
    for i, j, k in _CYCLIC:
        ratio = (moments[j] - moments[k]) / moments[i]
        terms.append((4 + i, 4 + j, 4 + k, ratio))
        derivatives.append((4 + i, 4 + j, 4 + k, 7 + j, 1 / moments[i]))
        derivatives.append((4 + i, 4 + j, 4 + k, 7 + k, -1 / moments[i]))
        derivatives.append((4 + i, 4 + j, 4 + k, 7 + i, -ratio / moments[i]))
    rows, columns = 7, 10
    if heavy:
        weight = np.asarray(moment_of_weight, LONG).T
        rows, columns = 11, 13  # gamma, and a component that is always 1
        for i, j, k in _CYCLIC:
            terms.append((7 + i, 7 + j, 4 + k, one))
            terms.append((7 + i, 7 + k, 4 + j, -one))
            for a, c, sign in ((j, k, 1), (k, j, -1)):
                terms.append((4 + i, 7 + a, 10, sign * weight[c] / moments[i]))
                derivatives.append((4 + i, 7 + a, 10, 10 + c, sign / moments[i]))
                derivatives.append(
                    (4 + i, 7 + a, 10, 7 + i, -sign * weight[c] / moments[i] ** 2)
                )
    x = np.zeros((rows, bodies), LONG)
    dx = np.zeros((rows, columns, bodies), LONG)
    x[:4], x[4:7] = attitude, omega
    dx[np.arange(7), np.arange(7)] = 1
    if heavy:
        w, p, q, r = attitude
        x[7:10] = (
            2 * (p * r - w * q),
            2 * (q * r + w * p),
            w * w - p * p - q * q + r * r,
        )
        x[10] = 1
        dx[7:10, :4] = 2 * np.array([[-q, r, -w, p], [p, w, r, q], [w, -p, -q, r]])
    columns_of = [np.array(v) for v in zip(*terms, strict=True)]
    derivative_columns = [np.array(v) for v in zip(*derivatives, strict=True)]
    x, dx = _flow(columns_of, derivative_columns, x, dx, duration)
    return x[:7].T, np.moveaxis(dx[:7], -1, 0)


def _products(x, y):
    """The n-th Taylor coefficient of all x_j y_k; x (J, B, n) and y (K, columns, B,
    n)."""
    return np.einsum("jbn,kcbn->jkcb", x, y[..., ::-1])


def _turned(products):
    """Of products (4, 3, ...) of quaternion and rate, the rates of the quaternion."""
    out = np.zeros((4, *products.shape[2:]), LONG)
    for i, j, k, sign in _QUATERNION:
        out[i] += sign * products[j, k] / 2
    return out


def free_hessian_vector(moments, attitude, omega, duration, direction):
    """The derivative of `heavy_body`'s Jacobian along a direction, for free bodies.

    By the second variational equations. As there, the attitude's norm is a free input:
    the motion is q' = q (0, omega) / 2 for any q, so that its last state is linear in
    the first attitude.

    Args:
        moments: (B, 3).
        attitude: (B, 4).
        omega: (B, 3).
        duration: A number or (B,), of either sign.
        direction: (B, 10) or (10,): attitude (4), omega (3), moments (3).

    Returns:
        (B, 7, 10), long doubles: d/ds of the Jacobian at inputs + s direction.
    """
    moments, attitude, omega = (
        np.asarray(v, LONG).T for v in (moments, attitude, omega)
    )
    bodies = moments.shape[1]
    along = np.broadcast_to(np.asarray(direction, LONG), (bodies, 10)).T
    # omega_i' = ratio_i omega_j omega_k, ratio_i = (I_j - I_k) / I_i, and its
    # derivatives with respect to the moments, along the direction, and both
    ratio = np.zeros((3, bodies), LONG)
    slope = np.zeros((3, 3, bodies), LONG)
    turned_slope = np.zeros((3, 3, bodies), LONG)
    change = along[7:]
    for i, j, k in _CYCLIC:
        ratio[i] = (moments[j] - moments[k]) / moments[i]
        slope[i, j], slope[i, k], slope[i, i] = 1, -1, -ratio[i]
        slope[i] /= moments[i]
    turned_ratio = np.sum(slope * change, axis=1)
    for i, j, k in _CYCLIC:
        turned_slope[i, j] = -change[i] / moments[i] ** 2
        turned_slope[i, k] = change[i] / moments[i] ** 2
        turned_slope[i, i] = -(turned_ratio[i] + slope[i, i] * change[i]) / moments[i]

    # The turn r since the start, q = q0 r, depends on omega and the moments alone (6
    # columns). Columns of dx: 0-5 the derivatives, 6 that along the direction, 7-12
    # both.
    x = np.zeros((7, bodies), LONG)
    dx = np.zeros((7, 13, bodies), LONG)
    x[0], x[4:] = 1, omega
    dx[[4, 5, 6], [0, 1, 2]] = 1
    dx[4:, 6] = along[4:7]
    speed = np.sqrt(np.sum(omega**2, axis=0)) * np.maximum(
        0.5, np.max(np.abs(ratio), axis=0)
    )
    steps = max(1, int(np.ceil(np.max(np.abs(duration) * speed) / LARGEST_STEP)))
    h = np.broadcast_to(np.asarray(duration, LONG), (bodies,)) / steps
    first, second = [1, 2, 0], [2, 0, 1]
    for _ in range(steps):
        # One series a component, its coefficients along the last axis: that is fastest.
        series = np.zeros((*x.shape, ORDER + 1), LONG)
        slopes = np.zeros((*dx.shape, ORDER + 1), LONG)
        series[..., 0], slopes[..., 0] = x, dx
        for n in range(ORDER):
            here, there = series[..., : n + 1], slopes[..., : n + 1]
            r, w, dr, dw = here[:4], here[4:], there[:4], there[4:]
            yr, yw, jr, jw = dr[:, 6], dw[:, 6], dr[:, :6], dw[:, :6]
            product = _products(w, w[:, None])[first, second, 0]
            both = _products(w, dw)
            both = both[first, second] + both[second, first]
            across = _products(yw, jw)
            across = across[first, second] + across[second, first]
            new, slopes_new = np.zeros(x.shape, LONG), np.zeros(dx.shape, LONG)
            new[:4] = _turned(_products(r, w[:, None]))[:, 0]
            new[4:] = ratio * product
            slopes_new[:4] = _turned(_products(r, dw) + _products(w, dr).swapaxes(0, 1))
            slopes_new[:4, 7:] += _turned(
                _products(yr, jw) + _products(yw, jr).swapaxes(0, 1)
            )
            slopes_new[4:] = ratio[:, None] * both
            slopes_new[4:, 3:6] += slope * product[:, None]
            slopes_new[4:, 6] += turned_ratio * product
            slopes_new[4:, 7:] += (
                turned_ratio[:, None] * both[:, :6] + ratio[:, None] * across
            )
            slopes_new[4:, 10:] += (
                slope * both[:, 6:7] + turned_slope * product[:, None]
            )
            series[..., n + 1], slopes[..., n + 1] = new / (n + 1), slopes_new / (n + 1)
        x, dx = series[..., ORDER], slopes[..., ORDER]
        for n in range(ORDER - 1, -1, -1):
            x, dx = series[..., n] + h * x, slopes[..., n] + h * dx

    out = np.zeros((7, 10, bodies), LONG)
    for i, j, k, sign in (*_QUATERNION, *((i, i, -1, 1) for i in range(4))):
        out[i, j] += sign * dx[k + 1, 6]
        out[i, 4:] += sign * (along[j] * dx[k + 1, :6] + attitude[j] * dx[k + 1, 7:])
    out[4:, 4:] = dx[4:, 7:]
    return np.moveaxis(out, -1, 0)
