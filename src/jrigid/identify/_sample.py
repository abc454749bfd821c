"""The posterior of a fit, for samplers of others."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jrigid._checks import demand
from jrigid._numerics import product
from jrigid._types import Scalar
from jrigid.dynamics import State
from jrigid.identify._inertia_models import AbstractInertiaModel
from jrigid.identify._layout import whole
from jrigid.identify._problem import Problem, rows_at
from jrigid.identify._result import FitResult
from jrigid.identify._smoother import Point
from jrigid.simulate import simulate


class LogDensity(NamedTuple):
    """A posterior density and where and how to sample it.

    Attributes:
        function: Logarithm of the density, but for a constant, of a position.
        start: The position of the fit: its numbers, then, for each trial, the moves of
            its state from that of the fit, zero, and its own numbers: in the order of
                `covariance`.
        covariance: That of the fit: the inverse of a mass matrix.
    """

    function: Callable[[Array], Scalar]
    start: Float[Array, " size"]
    covariance: Float[Array, "size size"]


def _simulated(system: Any, state: State, ts: Array, t0: Array) -> State:
    """A motion with derivatives in reverse mode."""
    return simulate(system, state, ts, t0=t0, throw=False).states


def _log_volume(model: AbstractInertiaModel, numbers: Array) -> Array:
    """Logarithm of the volume of tensors that a volume of the numbers of a model makes."""

    def tensor(x: Array) -> Array:
        inertia = model.inertia(x)
        return inertia if model.absolute else inertia / jnp.trace(inertia)

    if model.body(numbers) is not None:  # more numbers than a tensor has
        return jnp.zeros((), numbers.dtype)
    slopes = jax.jacfwd(tensor)(numbers).reshape(9, -1) / jnp.trace(tensor(numbers))
    return 0.5 * jnp.linalg.slogdet(product("ki,kj->ij", slopes, slopes))[1]


def log_density(result: FitResult) -> LogDensity:
    """The posterior of a fit as a function without bounds, for blackjax, numpyro and their like.

    Prior: what `prior` said in `free`; apart from that flat in the tensor (of a fixed
    trace, or, where the scale is sought, in the logarithm of the scale too; of a
    `LogCholesky`, in its numbers), in the arrays picked, and in the states: the
    logarithms of the Jacobians that belong to the numbers are in the density. A record
    that fits two bodies, the mirror one, or spins about any axis, has two modes: a
        sampler that starts at a fit stays in its own.

    Args:
        result: A single fit without an unmodelled torque. A noise that was not stated
            is as large as the residuals say.

    Raises:
        ValueError: A fit with an unmodelled torque.

    Gradients: in every mode; in reverse mode under a torque.

    >>> import jax, jax.numpy as jnp, jrigid as jr
    >>> record = jr.datasets.gyro_example()
    >>> readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
    >>> found = jr.identify.fit(jr.RigidBody(jnp.ones(3)), readings)
    >>> density = jr.identify.log_density(found)
    >>> print(density.start.shape, bool(jnp.isfinite(density.function(density.start))))
    (8,) True
    """
    problem, options = result.problem, result.problem.options
    text = "Argument `result` must be of a fit without an unmodelled torque, but it is not."
    demand(not options.dense, text)
    motion = options.motion or (None if options.free_motion else _simulated)
    options = options._replace(shooting=False, nodes=1, motion=motion)
    problem = Problem(options, problem.unknowns, problem.samples, problem.noise)
    unknowns, layout = problem.unknowns, whole(problem.samples, 1, result.t0)
    states = result.state.attitude[:, None], result.state.omega[:, None]
    size = result.numbers.size
    (trials, own), local = (
        result.own_numbers.shape,
        6 if options.depends_on_attitude else 3,
    )
    known = (0, 0), (0, problem.known - problem.held)
    weight = jnp.pad(jnp.where(result.kept, 1.0, 0.0), known, constant_values=1.0)
    rows_of = rows_at(problem, layout)

    def function(position: Array) -> Array:
        numbers, rest = position[:size], position[size:].reshape(trials, local + own)
        point = Point(numbers, rest[:, local:], *states, states[1][..., :0])
        rows = rows_of(point, rest[:, None, :local])
        chi_square = jnp.sum(weight[..., None] * rows[:, : weight.shape[1]] ** 2)
        likelihood = -0.5 * chi_square / result.diagnostics.inflation
        return likelihood + log_jacobian(numbers, rest[:, local:])

    def log_jacobian(numbers: Array, own: Array) -> Array:
        parts = [
            _log_volume(unknowns.inertia_model, numbers[unknowns.slices["inertia"]])
        ]
        shared = [x for x in unknowns.sought if not x.own]
        parts += [x.log_volume(numbers[unknowns.slices[x.name]]) for x in shared]
        parts += [
            jnp.sum(jax.vmap(x.log_volume)(own[:, s])) for x, s in unknowns.own_slices
        ]
        return jnp.sum(jnp.stack(parts))

    still = jnp.zeros((trials, local), result.numbers.dtype)
    start = jnp.concatenate([still, result.own_numbers], axis=1).reshape(-1)
    return LogDensity(
        function, jnp.concatenate([result.numbers, start]), result.covariance
    )
