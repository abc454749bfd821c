"""Explicit Runge-Kutta methods, prepared for a loop over their stages."""

import itertools
from typing import Any, NamedTuple

import diffrax
import numpy as np
from jaxtyping import Float

# The rows of a tableau are summed in so many groups, by the number of stages.
_GROUPS = {4: 1, 8: 2}
_MOST_GROUPS = 5


class Method(NamedTuple):
    """Coefficients of an explicit Runge-Kutta method whose last stage is the new state.

    Attributes:
        order: Order of the error of a step's result.
        times: Fractions of the step at which the stages are.
        rows: Coefficients of the places of the stages; the last row is that of the error
            estimate.
        groups: Consecutive rows that use nearly the same stages: the first of the rows,
            and the stages that one of them uses.
        own: How many of the stages the solver knows itself.
    """

    order: int
    times: Float[np.ndarray, " stages"]
    rows: Float[np.ndarray, "stages+1 stages"]
    groups: tuple[tuple[int, tuple[int, ...]], ...]
    own: int

    @property
    def stages(self) -> int:
        """How often a step evaluates the vector field."""
        return len(self.times)


def method_of(solver: diffrax.AbstractERK) -> Method:
    """The method of a solver of diffrax, from its tableau."""
    tableau: Any = solver.tableau
    order: Any = solver.order(None)
    rows = [np.zeros(0), *tableau.a_lower]
    times = [0.0, *tableau.c]
    if not tableau.ssal or len(rows[-1]) != len(tableau.b_sol) - 1:
        # The new state becomes a stage of its own.
        rows.append(tableau.b_sol)
        times.append(1.0)
    count = len(rows)
    table = np.zeros((count + 1, count))
    for row, coefficients in zip(table, [*rows, tableau.b_error], strict=True):
        row[: len(coefficients)] = coefficients
    return Method(
        order=int(order),
        times=np.array(times, float),
        rows=table,
        groups=_groups(table[1:-1]),
        own=len(tableau.b_sol),
    )


def _groups(rows: np.ndarray) -> tuple[tuple[int, tuple[int, ...]], ...]:
    """Group rows so that sums over the stages of their groups have the fewest terms."""
    count = len(rows)
    used = [set(np.flatnonzero(row).tolist()) for row in rows]
    groups = next((g for most, g in _GROUPS.items() if count <= most), _MOST_GROUPS)

    def divided(cuts: tuple[int, ...]) -> list[tuple[int, set[int], int]]:
        pairs = itertools.pairwise((0, *cuts, count))
        return [(a, set().union(*used[a:b]), b - a) for a, b in pairs]

    def terms(cuts: tuple[int, ...]) -> int:
        return sum(length * len(stages) for _, stages, length in divided(cuts))

    best = min(itertools.combinations(range(1, count), groups - 1), key=terms)
    # The first row of a tableau, that of the start itself, is not among these.
    return tuple((first + 1, tuple(sorted(x))) for first, x, _ in divided(best))
