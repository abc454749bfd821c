"""Doctests run in float64, as the examples in the docstrings are written."""

import jax

jax.config.update("jax_enable_x64", True)
