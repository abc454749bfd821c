"""The base class of the solvers' dense outputs."""

import abc

import diffrax
import jax.tree_util as jtu
from jaxtyping import PyTree

from jrigid._types import TimeLike


class Dense(diffrax.AbstractLocalInterpolation):
    """Dense output by the state at a time, from which changes of the state follow."""

    @abc.abstractmethod
    def at(self, t: TimeLike) -> PyTree:
        """The state at t."""

    def evaluate(
        self, t0: TimeLike, t1: TimeLike | None = None, left: bool = True
    ) -> PyTree:
        """The state at t0, or its change from t0 to t1."""
        del left
        start = self.at(t0)
        if t1 is None:
            return start
        return jtu.tree_map(lambda a, b: b - a, start, self.at(t1))
