"""Innovations of a record: readings less their predictions from all earlier readings.

Where an unknown torque acts on the body, the residuals of a smooth path through the
record are not independent. The innovations of a Kalman filter are. The filter runs over
residuals and, with the same gains, over their derivatives in a trial's first state, its
own numbers and the numbers of all trials. The result is the rows of an ordinary
least-squares problem, and the log determinant that completes their likelihood (P. de
Jong, "The diffuse Kalman filter", Annals of Statistics 19, 1991).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jrigid._core.compile import program, small_program
from jrigid._numerics import product
from jrigid._types import AnyArray
from jrigid.identify._disturbance import Disturbance, Push, push_of, with_torque
from jrigid.identify._layout import Layout
from jrigid.identify._smoother import Links, Rows, solve_positive


class Linearised(NamedTuple):
    """A record at the point where a fit ended.

    Attributes:
        layout: Its segments.
        tensor: The inertia.
        rows: Residuals of the samples and their derivatives.
        links: Gaps between states and their derivatives, without the torque.
        weight: Weight of each sample (trials, samples).
        own: Numbers of each trial (trials, own).
    """

    layout: Layout
    tensor: AnyArray
    rows: Rows
    links: Links
    weight: AnyArray
    own: AnyArray


class Innovations(NamedTuple):
    """Innovations of all samples, in units of their standard deviations.

    Attributes:
        rows: (trials, samples, degrees, columns): first the innovations, then their
            derivatives in the first state, the trial's own numbers and the numbers.
        log_determinant: Of the covariance of the innovations of each trial.
    """

    rows: Array
    log_determinant: Array


class TrialLikelihoods(NamedTuple):
    """-2 log likelihood of each trial.

    Attributes:
        together: With the numbers at which the record was linearised.
        alone: With the numbers that suit the trial best, as if it had another body.
    """

    together: AnyArray
    alone: AnyArray


class _Estimate(NamedTuple):
    """Estimated state of the filter.

    Attributes:
        state: Mean (local, columns). It is affine in the first state and the border:
            its constant part comes first, then its derivatives.
        covariance: (local, local).
    """

    state: Array
    covariance: Array


class _Sample(NamedTuple):
    """One sample.

    Attributes:
        residual: The residual and its derivatives as columns (degrees, columns), times
            the root of the sample's weight.
        of_state: Derivatives in the state at its node (degrees, local), times the same.
        crosses: Whether a link lies between the sample before and this one.
        link: Index of that link.
    """

    residual: Array
    of_state: Array
    crosses: Array
    link: Array


def _columns(value: Array, local: int, of_border: Array) -> Array:
    """A value, zeros for the first state, and derivatives in the border, as columns."""
    still = jnp.zeros((*value.shape, local), value.dtype)
    return jnp.concatenate([value[..., None], still, of_border], axis=-1)


def _initial_estimate(
    local: int, inner: int, columns: int, dtype: jnp.dtype
) -> _Estimate:
    """Estimate before the first sample.

    The first state is unknown and has columns of its own. The torque is random.

    Args:
        local: Size of the state.
        inner: The same without the torque.
        columns: How many columns there are.
        dtype: Of all arrays.
    """
    state = jnp.zeros((local, columns), dtype)
    state = state.at[:inner, 1 : 1 + inner].set(jnp.eye(inner, dtype=dtype))
    is_torque = jnp.arange(local) >= inner
    return _Estimate(state, jnp.diag(is_torque.astype(dtype)))


def _with_reading(
    estimate: _Estimate, residual: Array, of_state: Array
) -> tuple[_Estimate, Array, Array]:
    """Update an estimate by one number of unit noise.

    Returns:
        The estimate, the whitened innovation (columns,) and the logarithm of its
        variance.
    """
    # The residual is predicted less observed, so that the gain lowers the state.
    state, covariance = estimate
    with_state = product("ij,j->i", covariance, of_state)
    variance = 1 + product("i,i->", of_state, with_state)
    gain = with_state / variance
    innovation = residual + product("i,ic->c", of_state, state)
    state = state - gain[:, None] * innovation[None, :]
    covariance = covariance - gain[:, None] * with_state[None, :]
    return (
        _Estimate(state, covariance),
        innovation / jnp.sqrt(variance),
        jnp.log(variance),
    )


class _Filter(NamedTuple):
    """The Kalman filter of one trial.

    Attributes:
        of_state: Derivatives of each link's end in the state at its start (nodes,
            local, local).
        gaps: Gaps of the links as columns (nodes, local, columns).
        covariance: Covariance that each link adds (nodes, local, local).
    """

    of_state: Array
    gaps: Array
    covariance: Array

    def across_link(self, estimate: _Estimate, link: Array) -> _Estimate:
        """Predict the state at the end of a link."""
        of_state = self.of_state[link]
        state = product("ij,jc->ic", of_state, estimate.state) + self.gaps[link]
        covariance = product("ij,jk,lk->il", of_state, estimate.covariance, of_state)
        return _Estimate(state, covariance + self.covariance[link])

    def step(
        self, estimate: _Estimate, sample: _Sample
    ) -> tuple[_Estimate, tuple[Array, Array]]:
        """Update the estimate by a sample; return innovations and log determinant."""
        after = self.across_link(estimate, sample.link)
        estimate = _Estimate(
            jnp.where(sample.crosses, after.state, estimate.state),
            jnp.where(sample.crosses, after.covariance, estimate.covariance),
        )
        log_determinant = jnp.zeros((), estimate.state.dtype)
        whitened = []
        # The noise of the sample's numbers is independent, so that they can be used one
        # by one, which needs no inverse of a matrix.
        for residual, of_state in zip(sample.residual, sample.of_state, strict=True):
            estimate, innovation, log = _with_reading(estimate, residual, of_state)
            whitened.append(innovation)
            log_determinant = log_determinant + log
        return estimate, (jnp.stack(whitened), log_determinant)


def _innovations_of_trial(
    rows: Rows, links: Links, weight: Array, push: Push
) -> tuple[Array, Array]:
    """Innovations of one trial, whose states hold the torque."""
    local = links.gap.shape[-1]
    inner = local - 3  # without the torque
    root = jnp.sqrt(weight)[:, None, None]
    residuals = _columns(rows.residual, inner, rows.of_border)
    gaps = _columns(links.gap, inner, links.of_border)
    # Samples of several sensors are not in the order of time.
    order = jnp.argsort(rows.node, stable=True)
    node = rows.node[order]
    # Where a torque is unmodelled each node has a sample, so that a sample never
    # crosses more than one link.
    before = jnp.concatenate([jnp.zeros(1, node.dtype), node[:-1]])
    samples = _Sample(
        residual=(root * residuals)[order],
        of_state=(root * rows.of_state)[order],
        crosses=node > before,
        link=before,
    )
    start = _initial_estimate(local, inner, residuals.shape[-1], links.gap.dtype)
    kalman = _Filter(links.of_state, gaps, push.covariance)
    _, (innovations, log_determinants) = jax.lax.scan(kalman.step, start, samples)
    return innovations[jnp.argsort(order)], jnp.sum(log_determinants)


def _filtered(record: Linearised, torque: Disturbance) -> Innovations:
    """Innovations of a record."""
    layout, links = record.layout, record.links
    inner = links.gap.shape[-1]
    span = layout.end - layout.start
    push = push_of(torque, span, layout.linked, record.tensor, inner == 6)
    # Everything is linear in the torque, so that it may be zero at first.
    zero = jnp.zeros((*links.gap.shape[:2], 3), links.gap.dtype)
    rows, links = with_torque(record.rows, links, push, zero)
    results = jax.vmap(_innovations_of_trial)(rows, links, record.weight, push)
    return Innovations(*results)


@small_program
def innovations(record: Linearised, torque: Disturbance) -> Innovations:
    """Innovations of a record under an unmodelled torque."""
    return _filtered(record, torque)


def _without_own(own: int, products: Array) -> tuple[Array, Array]:
    """Products of one trial's columns, its state and own numbers eliminated.

    Args:
        own: How many there are.
        products: Of all columns; those of what is eliminated follow the first.

    Returns:
        Products of the other columns, and the log determinant.
    """
    inside = slice(1, 1 + own)
    rest = jnp.concatenate([jnp.arange(1), jnp.arange(1 + own, products.shape[0])])
    across = products[inside][:, rest]
    solved, log_determinant = solve_positive(products[inside, inside], across)
    explained = product("ki,kj->ij", across, solved)
    return products[rest][:, rest] - explained, log_determinant


def _at_best_numbers(products: Array) -> tuple[Array, Array]:
    """Chi-square with the numbers that make it smallest, and their log determinant."""
    # Without numbers only the square of the residuals is left.
    if products.shape[0] == 1:
        return products[0, 0], jnp.zeros_like(products[0, 0])
    solved, log_determinant = solve_positive(products[1:, 1:], products[1:, :1])
    return products[0, 0] - jnp.sum(products[1:, :1] * solved), log_determinant


def _minus_two_log_likelihood(
    levels: Array,
    times: Array,
    trials: Array,
    record: Linearised,
    prior: Array,
    freedom: Array,
    noise_known: Array,
) -> tuple[Array, TrialLikelihoods]:
    """The value of `likelihood`, of the record and of each trial."""
    torque = Disturbance(jnp.exp(trials[:, None] + levels[None]), jnp.exp(times))
    rows, log_determinant = _filtered(record, torque)
    products = prior + product("tndi,tndj->tij", rows, rows)
    # Numbers are eliminated as in least squares: first those of each trial.
    own = record.links.gap.shape[-1] + record.own.shape[-1]
    products, log_of_own = jax.vmap(lambda x: _without_own(own, x))(products)
    # With the determinants of what is eliminated the likelihood is the restricted one
    # (REML), whose levels are not too low where unknowns are many.
    logs = log_determinant + log_of_own
    chi_square, log_of_numbers = _at_best_numbers(jnp.sum(products, axis=0))
    # An unknown noise has in each trial the size that is most likely for all.
    noise = jnp.where(noise_known, 1.0, chi_square / freedom)
    alone = jax.vmap(_at_best_numbers)(products)[0]
    of_trials = TrialLikelihoods(
        together=products[:, 0, 0] / noise + logs, alone=alone / noise + logs
    )
    # At the most likely noise chi-square over it is constant, and the logarithm of the
    # noise remains.
    of_noise = freedom * jnp.log(jnp.maximum(chi_square, 1e-30))
    of_residuals = jnp.where(noise_known, chi_square, of_noise)
    return of_residuals + jnp.sum(logs) + log_of_numbers, of_trials


@program
def likelihood(
    record: Linearised,
    prior: Array,
    freedom: Array,
    noise_known: Array,
    levels: Array,
    times: Array,
    trials: Array,
) -> tuple[tuple[Array, TrialLikelihoods], tuple[Array, Array, Array]]:
    """-2 log likelihood of a torque: of the record with its derivatives, of each trial.

    Args:
        record: The record, linearised.
        prior: Products of the columns of prior knowledge (trials, columns, columns).
        freedom: Degrees of freedom of the record.
        noise_known: Whether the noise is known; otherwise it has the size that makes
            the record most likely.
        levels: Logarithms of the levels along each axis.
        times: Logarithms of the correlation times.
        trials: Logarithm of the size of the torque in each trial, over its level.

    Returns:
        Value of the record and values of the trials, and derivatives of the former in
        the last three arguments.
    """
    value = jax.value_and_grad(
        _minus_two_log_likelihood, argnums=(0, 1, 2), has_aux=True
    )
    return value(levels, times, trials, record, prior, freedom, noise_known)
