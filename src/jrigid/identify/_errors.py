"""What a fit tells: errors, what the record does not determine, and how the fit ended."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jrigid._checks import RESULTS, nan_where
from jrigid._numerics import product
from jrigid._spectral import eigh
from jrigid.dynamics import State
from jrigid.identify._layout import Layout
from jrigid.identify._observations import Rates
from jrigid.identify._residuals import Args, Options
from jrigid.identify._result import LARGEST_ERROR, FitResult, Status
from jrigid.identify._shooting import Point, Rows
from jrigid.identify._unknowns import is_near_flat

GATE = 5.0  # standard deviations of chi-square
_TOLD = 1e-9  # of the largest singular value: a change of the state that the record shows


def conclude(
    options: Options,
    args: Args,
    point: Point,
    rows: Rows,
    seen: tuple[Array, ...],
    settled: Array,
    history: Array,
    single: Layout,
    input_result: Any,
) -> FitResult:
    unknowns, kept, t0 = args.unknowns, args.weights, single.start[:, 0]
    numbers = point.numbers
    dtype = numbers.dtype
    size = numbers.size
    count = sum(jnp.sum(w > 0) for w in kept)
    alive = jnp.any(jnp.stack([jnp.any(w > 0, axis=(1, 2)) for w in kept]), axis=0)
    chi_square = rows.cost
    values, directions, covariance, of_state = told(rows, unknowns.natural_units(numbers))
    shown = (of_state > _TOLD * of_state[:, :1]) & alive[:, None]
    freedom = count - size - jnp.sum(shown)
    noise = chi_square / jnp.maximum(freedom, 1).astype(dtype)
    inflate = jnp.ones((), dtype) if options.noise_known else noise
    covariance = inflate * covariance

    tensor = unknowns.inertia(numbers)
    moments, axes = eigh(tensor)
    slopes = jax.jacfwd(unknowns.inertia)(numbers) if size else jnp.zeros((3, 3, 0), dtype)
    inside = product("ki,kln,lj->ijn", axes, slopes, axes)
    cov = covariance[:size, :size]
    of_moments = jnp.stack([inside[i, i] for i in range(3)])
    eps = jnp.finfo(dtype).eps

    def turn(i: int, j: int) -> Array:
        gap = moments[i] - moments[j]
        floor = eps * moments[2]
        return inside[i, j] / jnp.where(jnp.abs(gap) > floor, gap, floor)

    turns = jnp.stack([turn(1, 2), turn(2, 0), turn(0, 1)])
    ratios = moments[1:] / moments[0]
    of_ratios = (of_moments[1:] - ratios[:, None] * of_moments[:1]) / moments[0]

    def spread(x: Array) -> Array:
        return product("in,nm,jm->ij", x, cov, x)

    pure = _is_pure(args, rows, inflate) & (unknowns.shape != "fixed")
    largest = jnp.sqrt(inflate) / jnp.min(values) if size else jnp.zeros((), dtype)
    gate = 1 + GATE * jnp.sqrt(2 / jnp.maximum(freedom, 1).astype(dtype))
    # A fit that creeps along a direction which the record does not tell is as good as any.
    untold = (largest > LARGEST_ERROR) | pure
    status = Status.where(settled, Status.OK, Status.NOT_CONVERGED)
    sound = jnp.all(jnp.isfinite(covariance)) & (freedom > 0)
    status = Status.where(untold, Status.UNIDENTIFIABLE, status)
    if unknowns.shape not in ("flat", "fixed"):
        status = Status.where(is_near_flat(tensor), Status.AT_BOUNDARY, status)
    status = Status.where(pure, Status.UNIDENTIFIABLE, status)
    if options.noise_known:
        wrong = Status.where(settled, Status.WRONG_BASIN, Status.NOT_CONVERGED)
        status = Status.where(noise > gate, wrong, status)
    status = Status.where(sound, status, Status.NOT_CONVERGED)
    status = Status.where(input_result == RESULTS.successful, status, Status.BAD_INPUT)
    seen_rows = sum(w.shape[1] * w.shape[2] for w in kept)  # then what was known beforehand
    jacobian = jnp.concatenate([rows.of_numbers, rows.of_state], axis=-1)
    found = FitResult(
        status, tensor, moments, axes, spread(of_moments),
        jnp.sqrt(jnp.maximum(jnp.diagonal(spread(turns)), 0.0)), ratios, spread(of_ratios),
        State(point.attitude[:, 0], point.omega[:, 0]), t0, numbers, covariance,
        rows.residual[:, :seen_rows], jacobian[:, :seen_rows], chi_square,
        freedom, values, directions, of_state, tuple(jnp.any(w > 0, axis=-1) for w in kept),
        ~alive & jnp.any(jnp.stack([jnp.any(w > 0, axis=(1, 2)) for w in seen]), axis=0),
        history, pure, input_result, unknowns, args, options, options.noise_known,
        options.free_motion,
    )  # fmt: skip
    return nan_where(input_result != RESULTS.successful, found)


def _is_pure(args: Args, rows: Rows, noise: Array) -> Array:
    """Whether a constant rate in each throw describes a gyro's record as well.

    Where the rates do not vary the Fisher information at the estimate is no guide: a motion fitted
    to the noise seems to tell what the true one does not.
    """
    if not all(isinstance(x, Rates) and x.covariance is None for x in args.observations):
        return jnp.asarray(False)
    x, weight = args.observations[0], args.weights[0]
    fitted = jnp.sum(rows.residual[:, : weight.shape[1] * weight.shape[2]] ** 2)
    if x.sigma is not None:
        inverse = 1 / x.sigma**2
    else:
        inverse = jnp.full(weight.shape, 1.0, weight.dtype) / args.unit**2
    inverse = jnp.where(weight > 0, inverse, 0.0)
    values = jnp.where(weight > 0, x.values, 0.0)
    total = jnp.sum(inverse, axis=1, keepdims=True)
    mean = jnp.sum(inverse * values, axis=1, keepdims=True) / jnp.where(total > 0, total, 1.0)
    constant = jnp.sum(inverse * (values - mean) ** 2)
    return constant - fitted < noise * (5 + GATE * 10**0.5)  # of the shape's five numbers


def told(rows: Rows, units: Array) -> tuple[Array, Array, Array, Array]:
    """Singular values and directions of the numbers, states removed, and the whole covariance.

    Last the singular values of each throw's state, descending.
    """
    jg, jl = rows.of_numbers * units[None, None, :], rows.of_state
    throws, size, locals_ = jg.shape[0], jg.shape[-1], jl.shape[-1]
    eps = jnp.finfo(jg.dtype).eps

    def throw(jg: Array, jl: Array) -> tuple[Array, Array, Array, Array]:
        scale = jnp.sqrt(jnp.sum(jl * jl, axis=0))
        scale = jnp.where(scale > 0, scale, 1.0)
        u, s, vt = jnp.linalg.svd(jl / scale[None, :], full_matrices=False)
        told = s > _TOLD * s[0]
        u = jnp.where(told[None, :], u, 0.0)
        inverse = jnp.where(told, 1 / jnp.where(told, s, 1.0), 1 / (eps * jnp.maximum(s[0], 1.0)))
        half = vt.T * inverse[None, :] / scale[:, None]
        of_told = jnp.where(told[None, :], half, 0.0)
        cause = product("lk,rk,rg->lg", of_told, u, jg)
        rest = jg - product("rk,sk,sg->rg", u, u, jg)
        return jnp.linalg.qr(rest, mode="r") if size else rest[:0], half, cause, s

    r, half, cause, of_state = jax.vmap(throw)(jg, jl)
    own = product("tik,tjk->tij", half, half)
    if size:
        _, values, vt = jnp.linalg.svd(r.reshape(-1, size), full_matrices=False)
        floor = jnp.maximum(values, 16 * eps * values[0] + 1e-150)
        cov = product("ki,kj->ij", vt / floor[:, None], vt / floor[:, None])
        directions = vt.T
    else:
        values, cov = jnp.zeros(0, jg.dtype), jnp.zeros((0, 0), jg.dtype)
        directions = cov
    across = -product("tlg,gh->tlh", cause, cov).reshape(throws * locals_, size)
    everywhere = product("tlg,gh,smh->tlsm", cause, cov, cause)
    blocks = everywhere + jnp.eye(throws, dtype=jg.dtype)[:, None, :, None] * own[:, :, None, :]
    blocks = blocks.reshape(throws * locals_, throws * locals_)
    whole_ = jnp.concatenate(
        [jnp.concatenate([cov, across.T], axis=1), jnp.concatenate([across, blocks], axis=1)]
    )
    scale = jnp.concatenate([units, jnp.ones(throws * locals_, jg.dtype)])
    return values, directions, whole_ * scale[:, None] * scale[None, :], of_state
