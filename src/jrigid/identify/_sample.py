"""Posterior of a fit as a function, for samplers of other packages."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jrigid._checks import check_shape, demand
from jrigid._numerics import product
from jrigid._types import Scalar
from jrigid.dynamics import State
from jrigid.identify._inertia_models import AbstractInertiaModel
from jrigid.identify._layout import whole
from jrigid.identify._problem import Options, Problem, rows_at
from jrigid.identify._result import FitResult
from jrigid.identify._smoother import Point
from jrigid.identify._unknowns import Unknowns
from jrigid.simulate import simulate
from jrigid.systems import RigidBody


class LogDensity(NamedTuple):
    """A posterior density, and where and how to sample it.

    A position holds the numbers of the fit. After them follow, for each trial, the
    change of its first state from that of the fit and the trial's own numbers. This is
    the order of `covariance`. The change of a state is that of its angular velocity
    (3,) in body axes [rad/s]. Where something depends on the attitude, a rotation
    vector (3,) about body axes follows [rad], by which the body turns from the attitude
    of the fit.

    Attributes:
        function: Logarithm of the density at a position, up to a constant.
        start: The position of the fit, at which the states do not change.
        covariance: Covariance of the fit, which is the inverse of a mass matrix.
    """

    function: Callable[[Array], Scalar]
    start: Float[Array, " size"]
    covariance: Float[Array, "size size"]


def _simulated(system: RigidBody, state: State, ts: Array, t0: Array) -> State:
    """States of a motion, with derivatives in reverse mode."""
    return simulate(system, state, ts, t0=t0, throw=False).states


def _log_volume(model: AbstractInertiaModel, numbers: Array) -> Array:
    """Logarithm of the volume of tensors per volume of the numbers of a model."""

    def tensor(x: Array) -> Array:
        inertia = model.inertia(x)
        return inertia if model.absolute else inertia / jnp.trace(inertia)

    # A model of a body has more numbers than a tensor. Its prior is flat in these.
    if model.body(numbers) is not None:
        return jnp.zeros((), numbers.dtype)
    # A change relative to the trace makes the volume that of the logarithm of the
    # scale. A tensor has nine elements, hence the Gram determinant.
    slopes = jax.jacfwd(tensor)(numbers).reshape(9, -1) / jnp.trace(tensor(numbers))
    return 0.5 * jnp.linalg.slogdet(product("ki,kj->ij", slopes, slopes))[1]


def _log_jacobian(unknowns: Unknowns, numbers: Array, own: Array) -> Array:
    """Logarithm of the volume of all that is sought per volume of its numbers.

    Args:
        unknowns: What is sought.
        numbers: Numbers shared by all trials.
        own: Numbers of each trial (trials, n).
    """
    slices = unknowns.slices
    parts = [_log_volume(unknowns.inertia_model, numbers[slices["inertia"]])]
    parts += [x.log_volume(numbers[slices[x.name]]) for x in unknowns.shared]
    parts += [
        jnp.sum(jax.vmap(x.log_volume)(own[:, part])) for x, part in unknowns.own_slices
    ]
    return jnp.sum(jnp.stack(parts))


def _from_one_state(problem: Problem) -> Problem:
    """The problem with one state for each trial, differentiable in reverse mode."""
    options: Options = problem.options
    motion = options.motion
    if motion is None and not options.free_motion:
        motion = _simulated
    options = options._replace(shooting=False, nodes=1, motion=motion)
    return Problem(options, problem.unknowns, problem.samples, problem.noise)


def log_density(result: FitResult) -> LogDensity:
    """Return the posterior of a fit as a function, for blackjax, numpyro and others.

    The function is defined for all positions. The prior is what `prior` states in
    `free`, and otherwise flat in the following quantities:

    - the tensor of a fixed trace, or of any trace with a flat logarithm where the scale
      is sought. For `LogCholesky` it is flat in the ten numbers;
    - the arrays that `free` picks;
    - the states.

    The density contains the logarithms of the Jacobians that belong to the numbers. The
    posterior has two modes where the record fits two bodies, or a body and its mirror
    image. A sampler that starts at a fit stays in the mode of that fit. Where the
    residuals are larger than the stated noise, the noise is taken to be as large as
    they are, and priors are as stated.

    Args:
        result: A single fit without an unmodelled torque. If no noise was stated, its
            size follows from the residuals.

    Raises:
        ValueError: The fit has an unmodelled torque.

    Gradients: first derivatives in every mode, under a torque in reverse mode; second
    ones without a torque, where the three moments differ.

    >>> import jax, jax.numpy as jnp, jrigid as jr
    >>> record = jr.datasets.gyro_example()
    >>> readings = jr.identify.Rates(record.times, record.omegas, record.sigma)
    >>> result = jr.identify.fit(jr.RigidBody(jnp.ones(3)), readings)
    >>> density = jr.identify.log_density(result)
    >>> print(density.start.shape, bool(jnp.isfinite(density.function(density.start))))
    (8,) True
    """
    demand(
        not result.problem.options.dense,
        "Argument `result` must be of a fit without an unmodelled torque, but it is "
        "not.",
    )
    problem = _from_one_state(result.problem)
    unknowns = problem.unknowns
    rows_at_position = rows_at(problem, whole(problem.samples, 1, result.t0))
    # Each trial has one node, at its first state.
    attitude = result.state.attitude[:, None]
    omega = result.state.omega[:, None]
    no_torque = omega[..., :0]
    size = result.numbers.size
    trials, own_size = result.own_numbers.shape
    state_size = 6 if problem.options.depends_on_attitude else 3
    # Priors stand in rows after the samples. Rows that hold a fit near its start while
    # little of the record takes part are left out.
    priors = problem.known - problem.held
    # An inflation above 1 means noise as large as the residuals, not as stated.
    samples = jnp.where(result.kept, 1.0, 0.0) / result.diagnostics.inflation
    weight = jnp.pad(samples, ((0, 0), (0, priors)), constant_values=1.0)

    no_change = jnp.zeros((trials, state_size), result.numbers.dtype)
    of_trials = jnp.concatenate([no_change, result.own_numbers], axis=1).reshape(-1)
    start = jnp.concatenate([result.numbers, of_trials])

    def function(position: Array) -> Array:
        check_shape("position", position, (start.size,))
        numbers = position[:size]
        of_trials = position[size:].reshape(trials, state_size + own_size)
        own = of_trials[:, state_size:]
        point = Point(numbers, own, attitude, omega, no_torque)
        rows = rows_at_position(point, of_trials[:, None, :state_size])
        chi_square = jnp.sum(weight[..., None] * rows[:, : weight.shape[1]] ** 2)
        return -0.5 * chi_square + _log_jacobian(unknowns, numbers, own)

    return LogDensity(function, start, result.covariance)
