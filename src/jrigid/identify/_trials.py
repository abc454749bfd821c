"""What trials say beside each other: trials of another body, and errors by their scatter.

Plain numpy, from each trial's information about the numbers and its part of the gradient.
"""

import numpy as np

FEWEST = 8  # trials whose scatter says how large errors are
DISAGREEING = 3.0  # times the errors stated: trials are not of one body, or their errors are alike
_FEWEST_FOR_FOREIGN = 5
_FOREIGN = 16.0  # times what other trials are off, squared
_MOST_FOREIGN = 0.25  # of all trials: beyond, nobody knows who is foreign


def disagreement(scores: np.ndarray, information: np.ndarray, alive: np.ndarray) -> np.ndarray:
    """How far each trial is from what all others say of the numbers.

    Args:
        scores: Each trial's part of the gradient of half the squares (throws, numbers).
        information: Each trial's (throws, numbers, numbers).
        alive: Trials that take part.

    Returns:
        Mean square in standard errors of the numbers that a trial tells: about 1 where the noise is
        as stated, 0 of trials that take no part.
    """
    found = np.zeros(alive.shape)
    total = np.sum(information[alive], axis=0)
    for i in np.flatnonzero(alive):
        own = information[i]
        # From where the others put the numbers, the trial's gradient and its covariance.
        back = np.linalg.pinv(total - own, hermitian=True) @ own
        score = scores[i] + scores[i] @ back
        covariance = own + own @ back
        values, axes = np.linalg.eigh(0.5 * (covariance + covariance.T))
        told = values > 1e-9 * max(values[-1], 1e-300)
        if np.any(told):
            found[i] = np.mean((axes[:, told].T @ score) ** 2 / values[told])
    return found


def foreign(scores: np.ndarray, information: np.ndarray, alive: np.ndarray) -> int | None:
    """The trial that is of another body, as far as the others show; None where there is none.

    Args:
        scores: As for `disagreement`.
        information: As for `disagreement`.
        alive: As for `disagreement`.
    """
    if np.sum(alive) < _FEWEST_FOR_FOREIGN or np.mean(~alive) >= _MOST_FOREIGN:
        return None
    off = disagreement(scores, information, alive)
    usual = max(float(np.median(off[alive])), 1.0)
    worst = int(np.argmax(off))
    return worst if off[worst] > _FOREIGN * usual else None


def scatter(scores: np.ndarray, values: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Errors by the scatter of trials over those stated, along each principal direction.

    Args:
        scores: Of trials that take part (throws, numbers), in natural units.
        values: Inverse errors along the directions.
        directions: Columns, in natural units.
    """
    throws = scores.shape[0]
    along = scores @ directions / np.maximum(values, 1e-150)
    return np.sqrt(np.sum(along**2, axis=0) * throws / max(throws - 1, 1))
