"""Least squares on residuals that come out of an integration: the fit, its start, its error.

Private: the pieces that a fit of a rotating body needs whatever the body and the record are.

- `least_squares`: from a start within the basin of the answer.
- `doubling_horizon`: the same, blind: a record of many turns is fitted by its beginning first.
- `influence`, `covariance`, `coloured_covariance`, `block_bootstrap`: what noise in the record,
  white or coloured, does to the parameters.

Parameters are any pytree of float arrays, scaled by the caller to be of order one. Residual
functions have the signature `residuals(params, args) -> array`, and are integrated with an adjoint
that allows forward mode (`diffrax.ForwardMode()`). Everything can be jitted and vmapped; the fits
cannot be differentiated in their turn (an error, not a wrong number).
"""

import math
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, PyTree

Residuals = Callable[[PyTree, Any], Array]

# Damping of the first step relative to the squared columns of the Jacobian.
_FIRST_DAMPING = 1e-2


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


def _value_and_jacobian(function, point):
    """Both in one pass."""

    def twice(point):
        value = function(point)
        return value, value

    jacobian, value = jax.jacfwd(twice, has_aux=True)(point)
    return value, jacobian


def _jacobian_at_once(function):
    """The same function; where it is linearised its whole Jacobian is formed, beside the value.

    optimistix applies the linearised function anew for every trial of the damping, and each
    application would integrate again.
    """
    wrapped = jax.custom_jvp(function)

    @wrapped.defjvp
    def _(primals, tangents):
        value, jacobian = _value_and_jacobian(function, *primals)
        return value, jacobian @ tangents[0]

    return wrapped


def least_squares(
    residuals: Residuals,
    start: PyTree,
    args: Any = None,
    *,
    tolerance: float = 1e-3,
    max_steps: int = 40,
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
    times = jnp.zeros(jax.eval_shape(residuals, start, args).shape[0])
    return doubling_horizon(
        residuals, start, args, times, jnp.zeros(1), tolerance=tolerance, max_steps=max_steps
    )


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

    optimistix damps all parameters alike, so each stage measures them in units in which the columns
    of the Jacobian have one length (Marquardt, J. SIAM 11, 431 (1963)): the noise over the column,
    at the start of the stage.

    Args:
        residuals: Residuals, all of the same noise; their first axis runs along `times`.
        start: Parameters of order one.
        args: Passed on to `residuals`.
        times: Time of each row, increasing, any unit.
        horizons: Stage by stage, rows with `times <= horizon` take part: see `doublings`.
        stiffness: Non-negative, in the structure of `start`; none by default.
        tolerance: The last stage stops when a step is shorter than this fraction of the standard
            errors, in each parameter.
        max_steps: Evaluations allowed in each stage. An early stage may run out and do its job.

    Returns:
        The fit over the whole record, free of `stiffness`.
    """
    flat, unravel = ravel_pytree(start)
    stiff = jnp.zeros_like(flat) if stiffness is None else ravel_pytree(stiffness)[0]
    shape = jax.eval_shape(residuals, start, args).shape
    times = jnp.broadcast_to(times.reshape((-1,) + (1,) * (len(shape) - 1)), shape).reshape(-1)
    horizons = jnp.append(horizons, jnp.inf)
    springs = jnp.ones_like(horizons).at[-1].set(0.0)
    floor = 8 * jnp.finfo(flat.dtype).eps / tolerance

    def function(point):
        return residuals(unravel(point), args).reshape(-1)

    def stage(carry, horizon_and_spring):
        begin, steps, _ = carry
        horizon, spring = horizon_and_spring
        value, jacobian = _value_and_jacobian(function, begin)
        weights = (times <= horizon).astype(flat.dtype)
        stiffs = spring * stiff

        columns = jnp.sqrt(jnp.sum((weights[:, None] * jacobian) ** 2, axis=0) + stiffs**2)
        columns = jnp.where(columns > 0, columns, 1.0)
        squares = jnp.sum((weights * value) ** 2) + jnp.sum((stiffs * (begin - flat)) ** 2)
        noise = jnp.sqrt(squares / jnp.maximum(jnp.sum(weights) - flat.size, 1))
        # Residuals may vanish; parameters cannot be told to better than their rounding.
        noise = jnp.maximum(noise, floor * jnp.max(columns * (1 + jnp.abs(begin))))
        unit = noise / columns / math.sqrt(_FIRST_DAMPING)

        def scaled(move):
            point = begin + unit * move
            rows = [weights * function(point), stiffs * (point - flat)]
            return jnp.concatenate(rows) / noise

        scaled = _jacobian_at_once(scaled)
        # An early stage only has to start the next one.
        accuracy: Any = jnp.where(spring > 0, max(tolerance, 0.1), tolerance)
        solution = optx.least_squares(
            lambda move, _: scaled(move),
            optx.LevenbergMarquardt(rtol=0.0, atol=accuracy * math.sqrt(_FIRST_DAMPING)),
            jnp.zeros_like(flat),
            options={"jac": "fwd"},
            max_steps=max_steps,
            throw=False,
        )
        steps = steps + 1 + jnp.asarray(solution.stats["num_steps"])
        converged = solution.result == optx.RESULTS.successful
        return (begin + unit * solution.value, steps, converged), None

    carry = (flat, jnp.asarray(1), jnp.asarray(False))
    (best, steps, converged), _ = jax.lax.scan(stage, carry, (horizons, springs))
    value, jacobian = _value_and_jacobian(function, best)
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
