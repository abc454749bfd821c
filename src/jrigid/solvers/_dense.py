"""What the dense outputs of the solvers here share."""

import abc
from typing import Any

import diffrax
import jax.tree_util as jtu


class Dense(diffrax.AbstractLocalInterpolation):
    """Dense output that knows the state at a time; diffrax asks for changes between two, too."""

    @abc.abstractmethod
    def at(self, t: Any) -> Any:
        """The state at t."""

    def evaluate(self, t0: Any, t1: Any | None = None, left: bool = True) -> Any:
        """The state at t0, or its change from t0 to t1."""
        del left
        start = self.at(t0)
        return (
            start
            if t1 is None
            else jtu.tree_map(lambda a, b: b - a, start, self.at(t1))
        )
