"""Explicit Runge-Kutta methods, prepared for a loop over their stages."""

import itertools
from typing import Any, NamedTuple

import diffrax
import numpy as np
from jaxtyping import Float

# Number of groups in which the rows of a tableau are summed, by the largest number of
# stages for which it holds. More groups have fewer terms, but each is a branch that is
# compiled.
_GROUPS = {4: 1, 8: 2}
_MOST_GROUPS = 4
# On a turn by this angle [rad] the second estimate of the error of a step is this part
# of the first. It is of one order less, so they are equal at a quarter of the angle.
# Most steps of smooth motions turn by more, and there the first estimate decides.
_ANGLE = 0.6
_PART = 0.25
# Singular values below this part of the largest count as zero.
_ZERO = 1e-9


#: Groups of consecutive rows of tables. Each has its first row and, for each table, the
#: columns with a coefficient in one of its rows.
Groups = tuple[tuple[int, tuple[tuple[int, ...], ...]], ...]


class Method(NamedTuple):
    """Coefficients of an explicit Runge-Kutta method whose last stage is the new state.

    Attributes:
        order: Order of the error of a step's result.
        times: Fractions of the step at which the stages are.
        rows: Coefficients of the states at the stages; the last row is that of the
            error estimate.
        groups: Consecutive rows that use nearly the same stages.
        reverse_groups: Groups of the tables `reverse_rows`.
        own: Number of stages in the solver's own tableau.
        second_row: Coefficients of a second error estimate.
    """

    order: int
    times: Float[np.ndarray, " stages"]
    rows: Float[np.ndarray, "stages+1 stages"]
    groups: Groups
    reverse_groups: Groups
    own: int
    second_row: Float[np.ndarray, " stages"]

    @property
    def stages(self) -> int:
        """Number of evaluations of the vector field in a step."""
        return len(self.times)

    @property
    def reverse_rows(self) -> tuple[np.ndarray, np.ndarray]:
        """The two tables by which the reverse of a step sums: rows, and columns."""
        return _of_reverse(self.rows)


def method_of(solver: diffrax.AbstractERK) -> Method:
    """The method of a solver of diffrax, from its tableau."""
    tableau: Any = solver.tableau
    order: Any = solver.order(None)
    rows = [np.zeros(0), *tableau.a_lower]
    times = [0.0, *tableau.c]
    # With `ssal` the last stage of the solver is already at the new state.
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
        second_row=_second_estimate(table, int(order)),
    )


def _second_estimate(table: np.ndarray, order: int) -> np.ndarray:
    """Coefficients of an error estimate whose zeros are not those of the first.

    If a torque has a kink within a step, the error and its estimate depend on where it
    is, and the estimate has zeros. There the error may be any multiple of it. With a
    kink at a random place of a step of `Verner9`, the error is 3500 times the first
    estimate once in 10,000 times. It is at most 200 times the larger of both.

    Args:
        table: Coefficients of the stages; the last row is that of the first estimate.
        order: Order of the method.

    Returns:
        The coefficients; zeros where the stages allow no other estimate.
    """
    stages = table[:-1]
    # The first estimate is zero for the trees of up to `order - 1` nodes. With one node
    # less there are others. In methods of order 2 they are not zero at constant rates.
    nodes = order - 2
    if nodes < 1:
        return np.zeros(len(stages))
    # The others use the same stages: more terms would cost time in lanes. Coefficients
    # that are zero but for rounding would cost it too.
    used = np.flatnonzero(table[-1])
    weights = np.array(_elementary_weights(stages, nodes))
    conditions = np.vstack([weights, table[-1] / np.linalg.norm(table[-1])])
    _, sizes, vectors = np.linalg.svd(conditions[:, used])
    rank = np.count_nonzero(sizes > _ZERO * sizes[0])
    others = np.zeros((len(vectors) - rank, len(stages)))
    others[:, used] = vectors[rank:]
    if not len(others):
        return np.zeros(len(stages))
    # Rates of the stages, times the length of the step, of y' = i y.
    angle = 1j * _ANGLE
    ones = np.ones(len(stages))
    rates = np.linalg.solve(np.eye(len(stages)) - angle * stages, angle * ones)
    # Of several, that which is largest here. Combinations that happen to be small here
    # would be much larger than the first estimate in longer steps.
    by_part = np.stack([others @ rates.real, others @ rates.imag], axis=1)
    left, _, _ = np.linalg.svd(by_part)
    second = left[:, 0] @ others
    return second * _PART * abs(table[-1] @ rates) / abs(second @ rates)


def _elementary_weights(stages: np.ndarray, nodes: int) -> list[np.ndarray]:
    """The weights of the stages in the conditions of order up to `nodes`.

    There is one for each rooted tree of at most so many nodes (E. Hairer, S. P.
    Norsett, G. Wanner, Solving Ordinary Differential Equations I, section II.2). The
    weight of a tree is the product of those of its branches.
    """
    products = [[np.ones(len(stages))], *([] for _ in range(nodes))]
    for size in range(1, nodes + 1):
        # Branches of `size - 1` nodes in all, on a root, make a tree of `size` nodes.
        for tree in tuple(products[size - 1]):
            branch = stages @ tree
            # In ascending order, so that a branch may occur several times.
            for total in range(size, nodes):
                products[total] += [branch * x for x in products[total - size]]
    return [x for some in products[:nodes] for x in some]


def _of_reverse(table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows, and columns as rows, of all stages but the last.

    Args:
        table: Coefficients of the stages; the last row is that of the error estimate.
    """
    return table[:-2], table[:-1, :-1].T


def _groups(first: int, *tables: np.ndarray) -> Groups:
    """Group rows such that sums over the columns of their groups have the fewest terms.

    Args:
        first: The number of the first row.
        tables: Tables of the same number of rows, which have the same groups of rows.
    """
    count = len(tables[0])
    used = [[set(np.flatnonzero(row).tolist()) for row in table] for table in tables]
    groups = next((g for most, g in _GROUPS.items() if count <= most), _MOST_GROUPS)

    def divided(cuts: tuple[int, ...]) -> list[tuple[int, list[set[int]], int]]:
        """First row, columns by table, and number of rows of each group."""
        pairs = itertools.pairwise((0, *cuts, count))
        return [
            (a, [set().union(*rows[a:b]) for rows in used], b - a) for a, b in pairs
        ]

    def terms(cuts: tuple[int, ...]) -> int:
        """Number of terms of all sums."""
        return sum(
            length * sum(map(len, columns)) for _, columns, length in divided(cuts)
        )

    # All divisions are tried: of the 17 stages of `Verner9` there are 455.
    best = min(itertools.combinations(range(1, count), groups - 1), key=terms)
    # A sum has at least one term, if necessary one with the coefficient zero.
    return tuple(
        (first + start, tuple(tuple(sorted(x or {0})) for x in columns))
        for start, columns, _ in divided(best)
    )
