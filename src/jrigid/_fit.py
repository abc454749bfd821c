"""Least squares on residuals that come out of an integration: the fit, its start, its error.

Private: the pieces that a fit of a rotating body needs whatever the body and the record are.

- `least_squares`: Levenberg-Marquardt with a forward-mode Jacobian.
- `doubling_horizon`: the same, blind: a record of many turns is fitted by its beginning first.
- `influence`, `covariance`, `coloured_covariance`, `block_bootstrap`: what noise in the record,
  white or coloured, does to the parameters.

Parameters are any pytree of float arrays, scaled by the caller to be of order one. Residual
functions have the signature `residuals(params, args) -> array`, and are integrated with an adjoint
that allows forward mode (`diffrax.ForwardMode()`). Everything can be jitted and vmapped.

Why not optimistix: its Levenberg-Marquardt damps all parameters alike, and evaluates residuals and
Jacobian apart. On the Earth's pole (19 parameters, 4728 residuals, 2363 steps of an integration) it
took 100 to 200 steps of 160 ms and compiled for 18 s; damping by the columns of the Jacobian, which
comes in one pass with the residuals, takes about 30 steps of 60 ms and compiles in 4 s.
"""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

Residuals = Callable[[PyTree, Any], Array]


class LeastSquaresFit(eqx.Module):
    """What a least-squares fit found.

    Attributes:
        params: Best parameters, in the structure of the start.
        residuals: Residuals there, flattened.
        jacobian: Their derivatives with respect to the flattened parameters.
        steps: Evaluations of residuals and Jacobian, over all stages.
        converged: Whether the (last) fit met its tolerance.
    """

    params: PyTree
    residuals: Float[Array, " rows"]
    jacobian: Float[Array, "rows params"]
    steps: Int[Array, ""]
    converged: Bool[Array, ""]


class _Iterate(eqx.Module):
    best: Array
    residuals: Array
    jacobian: Array
    candidate: Array
    predicted: Array  # fall of the sum of squares that the candidate promised
    damping: Array
    growth: Array
    steps: Array
    converged: Array


def _levenberg_marquardt(evaluate, start, rows, tolerance, max_steps):
    """Minimise |residuals|^2; `evaluate(flat)` gives residuals and Jacobian in one pass."""
    dtype = start.dtype
    size = start.size
    eps = jnp.finfo(dtype).eps

    def unfinished(it):
        return (it.steps < max_steps) & ~it.converged

    def step(it):
        residuals, jacobian = evaluate(it.candidate)
        new, old = jnp.sum(residuals**2), jnp.sum(it.residuals**2)
        better = new < old  # also false for NaN: the step is then rejected and damped
        # Damping as Nielsen, Damping parameter in Marquardt's method (IMM-REP-1999-05), eq. 2.4.
        gain = (old - new) / it.predicted
        shrunk = it.damping * jnp.maximum(1 / 3, 1 - (2 * gain - 1) ** 3)
        first = it.steps == 0
        damping = jnp.where(better, jnp.where(first, it.damping, shrunk), it.damping * it.growth)
        growth = jnp.where(better, 2.0, 2.0 * it.growth).astype(dtype)
        best = jnp.where(better, it.candidate, it.best)
        residuals = jnp.where(better, residuals, it.residuals)
        jacobian = jnp.where(better, jacobian, it.jacobian)

        lengths = jnp.sqrt(jnp.sum(jacobian**2, axis=0))
        lengths = jnp.where(lengths > 0, lengths, 1.0)
        scaled = jacobian / lengths[None, :]
        q, r = jnp.linalg.qr(
            jnp.concatenate([scaled, jnp.sqrt(damping) * jnp.eye(size, dtype=dtype)])
        )
        move = jax.scipy.linalg.solve_triangular(r, -(q[:rows].T @ residuals))
        promised = scaled @ move
        predicted = -2 * residuals @ promised - promised @ promised
        # The step in units of the parameters' standard errors; then the floor of rounding.
        noise = jnp.sum(residuals**2) / max(rows - size, 1)
        small = promised @ promised <= tolerance**2 * noise
        exact = jnp.all(jnp.abs(move / lengths) <= 8 * eps * (1 + jnp.abs(best)))
        stuck = damping > 1 / eps
        return _Iterate(
            best,
            residuals,
            jacobian,
            best + move / lengths,
            predicted,
            damping,
            growth,
            it.steps + 1,
            (better & (small | exact)) | (stuck & ~first),
        )

    first = _Iterate(
        best=start,
        residuals=jnp.full((rows,), jnp.inf, dtype),
        jacobian=jnp.zeros((rows, size), dtype),
        candidate=start,
        predicted=jnp.ones((), dtype),
        damping=jnp.full((), 1e-2, dtype),
        growth=jnp.full((), 2.0, dtype),
        steps=jnp.asarray(0),
        converged=jnp.asarray(False),
    )
    return jax.lax.while_loop(unfinished, step, first)


def _with_jacobian(function):
    def twice(flat):
        value = function(flat)
        return value, value

    def evaluate(flat):
        jacobian, value = jax.jacfwd(twice, has_aux=True)(flat)
        return value, jacobian

    return evaluate


def least_squares(
    residuals: Residuals,
    start: PyTree,
    args: Any = None,
    *,
    tolerance: float = 1e-3,
    max_steps: int = 100,
) -> LeastSquaresFit:
    """Levenberg-Marquardt from a start that is already within the basin of the answer.

    Args:
        residuals: Residuals, all of the same noise.
        start: Parameters of order one.
        args: Passed on to `residuals`.
        tolerance: Stop when a step is shorter than this fraction of the standard errors.
        max_steps: Give up after so many evaluations: `converged` is then false.

    Returns:
        The fit; check `converged`.
    """
    flat, unravel = ravel_pytree(start)
    rows = jax.eval_shape(residuals, start, args).size

    def function(flat):
        return residuals(unravel(flat), args).reshape(-1)

    end = _levenberg_marquardt(_with_jacobian(function), flat, rows, tolerance, max_steps)
    return LeastSquaresFit(unravel(end.best), end.residuals, end.jacobian, end.steps, end.converged)


def doublings(times: Float[np.ndarray, " times"], first: float) -> Float[Array, " stages"]:
    """Horizons for `doubling_horizon`: the first after `first`, about one turn, then each twice."""
    stages = max(0, math.ceil(math.log2((times[-1] - times[0]) / first)))
    return jnp.asarray(times[0] + first * 2.0 ** np.arange(stages + 1))


def doubling_horizon(
    residuals: Residuals,
    start: PyTree,
    args: Any,
    times: Float[Array, " times"],
    horizons: Float[Array, " stages"],
    *,
    stiffness: PyTree | None = None,
    tolerance: float = 1e-3,
    max_steps: int = 40,
) -> LeastSquaresFit:
    """Levenberg-Marquardt from a blind start, over a horizon that doubles from stage to stage.

    A wobble of n turns pins its rate so well that the sum of squares has a valley only 0.3/n wide
    (relative to the rate) and is flat outside. A record of one turn has a wide valley. So the
    beginning is fitted first, and each answer starts a fit over twice the time. Later rows have
    weight zero until their stage comes: one compilation serves all stages.

    Nuisances can explain away a short record. `stiffness` holds them near their start, by further
    rows `stiffness * (params - start)`, in all stages but the last, which is free.

    Args:
        residuals: Residuals, all of the same noise; their first axis runs along `times`.
        start: Parameters of order one.
        args: Passed on to `residuals`.
        times: Time of each row, increasing, any unit.
        horizons: Stage by stage, rows with `times <= horizon` take part: see `doublings`.
        stiffness: Non-negative, in the structure of `start`; none by default.
        tolerance: The last stage stops when a step is shorter than this fraction of the standard
            errors.
        max_steps: Evaluations allowed in each stage. An early stage may run out and do its job.

    Returns:
        The fit over the whole record, free of `stiffness`.
    """
    flat, unravel = ravel_pytree(start)
    stiff = jnp.zeros_like(flat) if stiffness is None else ravel_pytree(stiffness)[0]
    shape = jax.eval_shape(residuals, start, args)
    horizons = jnp.append(horizons, jnp.inf)
    springs = jnp.ones_like(horizons).at[-1].set(0.0)

    def stage(carry, horizon_and_spring):
        begin, steps, *_ = carry
        horizon, spring = horizon_and_spring
        # An early stage only has to start the next one.
        accuracy = jnp.where(spring > 0, max(tolerance, 0.1), tolerance)
        weights = (times <= horizon).astype(flat.dtype)
        weights = weights.reshape(weights.shape + (1,) * (len(shape.shape) - 1))

        def function(point):
            rows = (residuals(unravel(point), args) * weights).reshape(-1)
            return jnp.concatenate([rows, spring * stiff * (point - flat)])

        rows = shape.size + flat.size
        end = _levenberg_marquardt(_with_jacobian(function), begin, rows, accuracy, max_steps)
        carry = (end.best, steps + end.steps, end.residuals, end.jacobian, end.converged)
        return carry, None

    rows = shape.size + flat.size
    carry = (
        flat,
        jnp.asarray(0),
        jnp.zeros(rows, flat.dtype),
        jnp.zeros((rows, flat.size), flat.dtype),
        jnp.asarray(False),
    )
    (best, steps, value, jacobian, converged), _ = jax.lax.scan(stage, carry, (horizons, springs))
    value, jacobian = value[: shape.size], jacobian[: shape.size]
    return LeastSquaresFit(unravel(best), value, jacobian, steps, converged)


def influence(jacobian: Float[Array, "rows params"]) -> Float[Array, "params rows"]:
    """Shift of the fitted parameters for each unit of noise in each row (the pseudo-inverse).

    By a QR decomposition, so the condition number is not squared. A Jacobian without full rank
    gives infinities or NaN: the record cannot tell these parameters apart.
    """
    q, r = jnp.linalg.qr(jacobian)
    return jax.scipy.linalg.solve_triangular(r, q.T)


def covariance(
    jacobian: Float[Array, "rows params"], residuals: Float[Array, " rows"]
) -> Float[Array, "params params"]:
    """Covariance of the parameters for white noise whose level the residuals tell.

    Honest only when the residuals are white; see `coloured_covariance` and `block_bootstrap`.
    """
    gain = influence(jacobian)
    rows, params = jacobian.shape
    return gain @ gain.T * jnp.sum(residuals**2) / (rows - params)


def coloured_covariance(
    jacobian: Float[Array, "rows params"], colour: Callable[[Array], Array]
) -> Float[Array, "params params"]:
    """Covariance of the parameters of an unweighted fit when the noise has a known colour.

    Args:
        jacobian: Of the residuals, as fitted.
        colour: Takes a vector of rows to `B^T` times it, where the noise is `B` times independent
            draws of unit variance, that is, its covariance is `B B^T`.

    Returns:
        `A B B^T A^T`, A the `influence`.
    """
    shaped = jax.vmap(colour)(influence(jacobian))
    return shaped @ shaped.T


def block_bootstrap(
    jacobian: Float[Array, "times outputs params"],
    residuals: Float[Array, "times outputs"],
    block: int,
    key: PRNGKeyArray,
    *,
    samples: int = 1000,
) -> Float[Array, "samples params"]:
    """Shifts of the parameters when blocks of residuals are dealt out anew.

    The moving-block bootstrap of Kuensch (1989), with the fit linearised at its optimum, so that no
    refit is needed. It keeps the correlation of the noise up to the length of a block and loses
    what is longer: for noise with a longer memory the spread comes out too small.

    Args:
        jacobian: Of the residuals, as fitted.
        residuals: At the optimum, equally spaced in time.
        block: Length of a block in samples.
        key: Random key.
        samples: Number of redrawn records.

    Returns:
        Parameter shifts; their standard deviation estimates the standard error.
    """
    times, outputs, params = jacobian.shape
    gain = influence(jacobian.reshape(times * outputs, params))
    centred = residuals - jnp.mean(residuals, axis=0, keepdims=True)
    blocks = -(-times // block)

    def shift(key):
        starts = jax.random.randint(key, (blocks,), 0, times - block + 1)
        rows = (starts[:, None] + jnp.arange(block)[None, :]).reshape(-1)[:times]
        return gain @ centred[rows].reshape(-1)

    return jax.lax.map(shift, jax.random.split(key, samples), batch_size=50)
