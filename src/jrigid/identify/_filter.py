"""A record's innovations: what each sample adds to what the samples before it foretold.

Where an unknown torque pushes the body, the residuals of a smooth path through the
record are no independent numbers; the innovations of a Kalman filter are. The filter
runs over residuals and, with the same gains, over their derivatives in a trial's first
state, its own numbers and the numbers of all trials: what comes out are rows of an
ordinary least-squares problem, and the log determinant that completes their likelihood
(P. de Jong, "The diffuse Kalman filter", Annals of Statistics 19, 1991).
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jrigid._numerics import product
from jrigid.identify._compile import program, small_program
from jrigid.identify._disturbance import Disturbance, Push, push_of, with_torque
from jrigid.identify._layout import Layout
from jrigid.identify._smoother import Links, Rows, solve_positive


class Linearised(NamedTuple):
    """A record at a point where a fit ended.

    Attributes:
        layout: Its segments.
        tensor: The inertia.
        rows: Residuals of the samples and their derivatives.
        links: Gaps between states and their derivatives, without the torque.
        weight: Of each sample (trials, samples).
        own: Numbers of each trial's own (trials, own).
    """

    layout: Layout
    tensor: Any
    rows: Rows
    links: Links
    weight: Any
    own: Any


class Innovations(NamedTuple):
    """Innovations of all samples, in units of what was expected of them.

    Attributes:
        rows: (trials, samples, degrees, columns): first the innovations, then their
            derivatives in the first state, the trial's own numbers and the numbers.
        log_determinant: Of the covariance expected, of each trial.
    """

    rows: Any
    log_determinant: Any


class OfTrials(NamedTuple):
    """-2 log likelihood of each trial.

    Attributes:
        together: With the numbers at which the record was linearised.
        alone: With the numbers that suit the trial best, as if it were of another body.
    """

    together: Any
    alone: Any


def _of_trial(
    rows: Rows, links: Links, weight: Array, push: Push
) -> tuple[Array, Array]:
    """Innovations of one trial, whose states hold the torque."""
    local = links.gap.shape[-1]
    inner = local - 3  # without the torque
    dtype = links.gap.dtype
    # Rows and links are affine in the first state and the border: offsets come first.
    root = jnp.sqrt(weight)[:, None, None]
    still = jnp.zeros((*rows.residual.shape, inner), dtype)
    offsets = jnp.concatenate(
        [rows.residual[..., None], still, rows.of_border], axis=-1
    )
    still = jnp.zeros((*links.gap.shape, inner), dtype)
    gaps = jnp.concatenate([links.gap[..., None], still, links.of_border], axis=-1)
    columns = offsets.shape[-1]
    # At first the state is made of its own columns, and the torque is random.
    state = jnp.zeros((local, columns), dtype)
    state = state.at[:inner, 1 : 1 + inner].set(jnp.eye(inner, dtype=dtype))
    spread = jnp.diag((jnp.arange(local) >= inner).astype(dtype))
    order = jnp.argsort(rows.node, stable=True)
    node = rows.node[order]
    before = jnp.concatenate([jnp.zeros(1, node.dtype), node[:-1]])

    def step(carry: tuple[Array, Array], sample: tuple) -> tuple[tuple, tuple]:
        state, spread = carry
        offset, shown, moves, link = sample
        of_state = links.of_state[link]
        ahead = product("ij,jc->ic", of_state, state) + gaps[link]
        wider = (
            product("ij,jk,lk->il", of_state, spread, of_state) + push.covariance[link]
        )
        state = jnp.where(moves, ahead, state)
        spread = jnp.where(moves, wider, spread)
        logs = jnp.zeros((), dtype)
        whitened = []
        # The noise of its numbers is independent: they may come one after another.
        for h, y in zip(shown, offset, strict=True):
            seen = product("ij,j->i", spread, h)
            variance = 1 + product("i,i->", h, seen)
            gain = seen / variance
            y = y + product("i,ic->c", h, state)
            state = state - gain[:, None] * y[None, :]
            spread = spread - gain[:, None] * seen[None, :]
            whitened.append(y / jnp.sqrt(variance))
            logs = logs + jnp.log(variance)
        return (state, spread), (jnp.stack(whitened), logs)

    weighted = (root * offsets)[order], (root * rows.of_state)[order]
    samples = *weighted, node > before, before
    _, (innovations, logs) = jax.lax.scan(step, (state, spread), samples)
    return innovations[jnp.argsort(order)], jnp.sum(logs)


def _filtered(record: Linearised, torque: Disturbance) -> Innovations:
    layout, links = record.layout, record.links
    inner = links.gap.shape[-1]
    span = layout.end - layout.start
    push = push_of(torque, span, layout.linked, record.tensor, inner == 6)
    # Everything is linear in the torque, so that it may start from none.
    still = jnp.zeros((*links.gap.shape[:2], 3), links.gap.dtype)
    rows, links = with_torque(record.rows, links, push, still)
    return Innovations(*jax.vmap(_of_trial)(rows, links, record.weight, push))


@small_program
def innovations(record: Linearised, torque: Disturbance) -> Innovations:
    """Innovations of a record that a torque pushed."""
    return _filtered(record, torque)


@program
def likelihood(
    record: Linearised,
    prior: Any,
    freedom: Any,
    noise_known: Any,
    levels: Any,
    times: Any,
    trials: Any,
) -> tuple[tuple[Array, OfTrials], tuple[Array, Array, Array]]:
    """-2 log likelihood of a torque, of the record and of each trial, and the former's derivatives.

    Args:
        record: Where it was linearised.
        prior: Products of the columns of what is known beforehand (trials, columns,
            columns).
        freedom: Numbers of the record less those sought.
        noise_known: Whether the noise is what was stated; else it is as large as makes
            the record most likely.
        levels: Logarithms of the levels about each axis.
        times: Logarithms of the correlation times.
        trials: Logarithms of each trial's size beside that.
    """
    own = record.links.gap.shape[-1] + record.own.shape[-1]

    def value(levels: Array, times: Array, trials: Array) -> tuple[Array, OfTrials]:
        torque = Disturbance(jnp.exp(trials[:, None] + levels[None]), jnp.exp(times))
        found = _filtered(record, torque)
        products = prior + product("tndi,tndj->tij", found.rows, found.rows)

        def without_own(products: Array) -> tuple[Array, Array]:
            """Of one trial, its state and own numbers eliminated."""
            inside = slice(1, 1 + own)
            rest = jnp.concatenate(
                [jnp.arange(1), jnp.arange(1 + own, products.shape[0])]
            )
            across = products[inside][:, rest]
            solved, log_determinant = solve_positive(products[inside, inside], across)
            return products[rest][:, rest] - across.T @ solved, log_determinant

        def at_best_numbers(left: Array) -> tuple[Array, Array]:
            """Chi-square where the numbers are the best, and their log determinant."""
            if left.shape[0] == 1:
                return left[0, 0], jnp.zeros_like(left[0, 0])
            solved, log_determinant = solve_positive(left[1:, 1:], left[1:, :1])
            return left[0, 0] - jnp.sum(left[1:, :1] * solved), log_determinant

        left, of_own = jax.vmap(without_own)(products)
        logs = found.log_determinant + of_own
        chi_square, of_numbers = at_best_numbers(jnp.sum(left, axis=0))
        # Of a noise that is not known each trial has the size that all make likely.
        noise = jnp.where(noise_known, 1.0, chi_square / freedom)
        alone = jax.vmap(at_best_numbers)(left)[0]
        of_trials = OfTrials(left[:, 0, 0] / noise + logs, alone / noise + logs)
        of_noise = freedom * jnp.log(jnp.maximum(chi_square, 1e-30))
        whole = (
            jnp.where(noise_known, chi_square, of_noise) + jnp.sum(logs) + of_numbers
        )
        return whole, of_trials

    differentiated = jax.value_and_grad(value, argnums=(0, 1, 2), has_aux=True)
    return differentiated(levels, times, trials)
