"""Independent rows of a fit: residuals, or innovations under an unmodelled torque."""

from typing import NamedTuple

import numpy as np

from jrigid.identify import _quality as quality
from jrigid.identify._disturbance import Disturbance
from jrigid.identify._filter import innovations
from jrigid.identify._quality import Fit
from jrigid.identify._smoother import Links, Rows


def condensed(rows: Rows, links: Links) -> Rows:
    """Rows in the first state of each trial, as if nothing acted between segments."""
    # Where each trial has one node its rows are in the first state already.
    if not np.any(rows.node):
        return rows
    trials, nodes, local = links.gap.shape
    border = rows.of_border.shape[-1]
    # Derivatives of the state at a node in the border and in the first state.
    state = np.zeros((trials, local, border + local), links.gap.dtype)
    state[:, :, border:] = np.eye(local)
    states = np.zeros((trials, nodes, local, border + local), links.gap.dtype)
    # The end of a segment is the start of the next one, so that derivatives chain from
    # node to node.
    for node in range(nodes):
        states[:, node] = state
        state = links.of_state[:, node] @ state
        state[:, :, :border] += links.of_border[:, node]
    of_nodes = np.take_along_axis(states, rows.node[:, :, None, None], axis=1)
    through = rows.of_state @ of_nodes
    return Rows(
        residual=rows.residual,
        of_border=rows.of_border + through[..., :border],
        of_state=through[..., border:],
        node=np.zeros_like(rows.node),
    )


class Independent(NamedTuple):
    """Independent rows of a fit, in first states, own numbers and numbers.

    Attributes:
        rows: Innovations where a torque may have acted, else residuals.
        weight: Of each row.
        log_determinant: Of the covariance of what was observed, in units of the noise:
            with the sum of squares it makes -2 log likelihood.
    """

    rows: Rows
    weight: np.ndarray
    log_determinant: float


@quality.once_for_each_fit
def condensed_rows(fit: Fit) -> Rows:
    """Rows of a minimum in the first state of each trial."""
    return condensed(fit.minimum.rows, fit.minimum.links)


@quality.once_for_each_fit
def independent_rows(fit: Fit) -> Independent:
    """The rows by which a fit is judged, those of what is known beforehand last."""
    minimum = fit.minimum
    if not fit.problem.options.dense:
        return Independent(condensed_rows(fit), minimum.weight, 0.0)
    return innovations_under(fit, fit.disturbance)


def innovations_under(fit: Fit, disturbance: Disturbance) -> Independent:
    """The innovations of a fit if this torque acted, those of prior knowledge last."""
    minimum = fit.minimum
    filtered = innovations(quality.linearised(fit), disturbance)
    columns = np.concatenate(
        [np.asarray(filtered.rows), quality.columns_of_prior(fit)], axis=1
    )
    border = 1 + minimum.links.gap.shape[-1]
    rows = Rows(
        residual=columns[..., 0],
        of_border=columns[..., border:],
        of_state=columns[..., 1:border],
        node=np.zeros_like(minimum.rows.node),
    )
    # They have their weights already.
    weight = np.ones_like(minimum.weight)
    return Independent(rows, weight, float(np.sum(filtered.log_determinant)))
