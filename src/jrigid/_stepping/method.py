"""Explicit Runge-Kutta methods, prepared for a loop over their stages."""

import itertools
from typing import Any, NamedTuple

import diffrax
import numpy as np
from jaxtyping import Float

# The rows of a tableau are summed in so many groups, by the number of stages.
_GROUPS = {4: 1, 8: 2}
_MOST_GROUPS = 4


#: Of consecutive rows of tables: the first row of each, and for each table the columns that
#: one of its rows uses.
Groups = tuple[tuple[int, tuple[tuple[int, ...], ...]], ...]


class Method(NamedTuple):
    """Coefficients of an explicit Runge-Kutta method whose last stage is the new state.

    Attributes:
        order: Order of the error of a step's result.
        times: Fractions of the step at which the stages are.
        rows: Coefficients of the places of the stages; the last row is that of the
            error estimate.
        groups: Consecutive rows that use nearly the same stages.
        reverse_groups: The same of the rows, and of the columns of the same numbers, by
            which the reverse of a step sums.
        own: How many of the stages the solver knows itself.
    """

    order: int
    times: Float[np.ndarray, " stages"]
    rows: Float[np.ndarray, "stages+1 stages"]
    groups: Groups
    reverse_groups: Groups
    own: int

    @property
    def stages(self) -> int:
        """How often a step evaluates the vector field."""
        return len(self.times)

    @property
    def reverse_rows(self) -> tuple[np.ndarray, np.ndarray]:
        """The rows, and the columns as rows, by which the reverse of a step sums."""
        return _of_reverse(self.rows)


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
        # The first row is that of the start itself.
        groups=_groups(1, table[1:-1]),
        reverse_groups=_groups(0, *_of_reverse(table)),
        own=len(tableau.b_sol),
    )


def _of_reverse(table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of all stages but the last, from coefficients and those of the error."""
    return table[:-2], table[:-1, :-1].T


def _groups(first: int, *tables: np.ndarray) -> Groups:
    """Group rows so that sums over the columns of their groups have the fewest terms.

    Args:
        first: The number of the first row.
        tables: Of as many rows. A group has the rows of the same numbers of each.
    """
    count = len(tables[0])
    used = [[set(np.flatnonzero(row).tolist()) for row in table] for table in tables]
    groups = next((g for most, g in _GROUPS.items() if count <= most), _MOST_GROUPS)

    def divided(cuts: tuple[int, ...]) -> list[tuple[int, list[set[int]], int]]:
        pairs = itertools.pairwise((0, *cuts, count))
        return [
            (a, [set().union(*rows[a:b]) for rows in used], b - a) for a, b in pairs
        ]

    def terms(cuts: tuple[int, ...]) -> int:
        return sum(
            length * sum(map(len, columns)) for _, columns, length in divided(cuts)
        )

    best = min(itertools.combinations(range(1, count), groups - 1), key=terms)
    # A sum has a term, if only one with the coefficient zero.
    return tuple(
        (first + start, tuple(tuple(sorted(x or {0})) for x in columns))
        for start, columns, _ in divided(best)
    )
