"""What a fit does with its arguments: options at trace time, values at run time."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jrigid._checks import RESULTS, Findings, all_finite, is_inertia, is_unit
from jrigid._numerics import safe_norm
from jrigid.dynamics import State
from jrigid.identify._layout import Samples
from jrigid.identify._observations import (
    AbstractObservation,
    AngularMomenta,
    Attitudes,
    Directions,
    Rates,
    known,
)
from jrigid.identify._unknowns import as_tensor
from jrigid.systems import RigidBody
from jrigid.torques import Rotor, SpinningMass, Sum


def start_of(start: Any) -> tuple[Any, State | None]:
    """The tensor to start from, if one is given, and the state."""
    if start is None:
        return None, None
    if isinstance(start, State):
        return None, start
    if isinstance(start, tuple) and len(start) == 2:
        inertia, state = start
        if isinstance(inertia, RigidBody):
            inertia = inertia.inertia
        if state is None or isinstance(state, State):
            return None if inertia is None else as_tensor(jnp.asarray(inertia)), state
    raise ValueError(
        "Argument `start` must be a State, or a tuple of an inertia and a State (either may be "
        f"None), but it is {start!r}."
    )


def refuse(system: Any, stacked: tuple[AbstractObservation, ...], scale: str, free: bool) -> None:
    momenta = any(isinstance(x, AngularMomenta) for x in stacked)
    if scale == "trace" or not isinstance(system, RigidBody):
        return
    if scale == "rotor":
        terms = system.torque.terms if isinstance(system.torque, Sum) else (system.torque,)
        if not any(isinstance(x, Rotor | SpinningMass) for x in terms):
            raise ValueError(
                "Argument `scale` must not be 'rotor' for a system without a `torques.Rotor`, but "
                "it is: nothing sets the scale of the tensor."
            )
    elif free and not momenta:
        raise ValueError(
            "Argument `scale` must be 'trace' for a body without torque, but it is 'known': free "
            "motion tells ratios of the moments, never their scale."
        )


def typical_rate(samples: Samples | None, state: State | None, dtype: Any) -> Array:
    if samples is not None:
        shown = jnp.where(samples.there[..., None], samples.omega, 0.0)
        count = jnp.sum(samples.there)
    else:
        assert state is not None
        shown = state.omega.astype(dtype)
        count = jnp.asarray(shown.shape[0])
    size = safe_norm(shown.reshape(-1)) / jnp.sqrt(jnp.maximum(count, 1).astype(dtype))
    size = jax.lax.stop_gradient(size)
    return jnp.where(jnp.isfinite(size) & (size > 0), size, 1.0)


def findings_of(
    system: Any,
    stacked: tuple[AbstractObservation, ...],
    samples: Samples | None,
    tensor: Any,
    state: State | None,
) -> Findings:
    findings = Findings()
    findings.require(is_inertia(system.inertia), RESULTS.invalid_inertia)
    system.torque.check(findings)
    if tensor is not None:
        findings.require(is_inertia(tensor), RESULTS.invalid_inertia)
    if state is not None:
        findings.require(all_finite(state), RESULTS.invalid_state)
        findings.require(jnp.all(jax.vmap(is_unit)(state.attitude)), RESULTS.invalid_attitude)
    for x in stacked:
        findings.require(
            jnp.any(known(x)),
            RESULTS.invalid_state,
            f"Argument `values` of `{type(x).__name__}` must hold values, but all are NaN.",
        )
    numbers = jnp.sum(jnp.stack([jnp.sum(known(x)) for x in stacked]))
    findings.require(
        numbers >= 12,
        RESULTS.invalid_state,
        "Argument `observations` must hold more numbers than a body and its state have, but it "
        "holds too few.",
    )
    for x in stacked:
        seen = jnp.any(known(x), axis=-1)
        running = jax.lax.cummax(jnp.where(seen, x.ts, -jnp.inf), axis=1)
        before = jnp.concatenate([jnp.full_like(running[:, :1], -jnp.inf), running[:, :-1]], axis=1)
        findings.require(
            jnp.all(~seen | (x.ts > before)),
            RESULTS.invalid_times,
            f"Argument `ts` of `{type(x).__name__}` must be increasing, each time once, but it is "
            "not.",
        )
        findings.require(
            ~jnp.any(jnp.isnan(x.ts) & jnp.all(jnp.isfinite(x.values), axis=-1)),
            RESULTS.invalid_times,
            f"Argument `ts` of `{type(x).__name__}` must be finite where there are values, but it "
            "is not.",
        )
        if x.sigma is not None:
            good = jnp.all(~known(x) | ((x.sigma > 0) & jnp.isfinite(x.sigma)))
        elif x.covariance is not None:
            noise = x.covariance
            swapped = jnp.swapaxes(noise, -1, -2)
            eye = jnp.broadcast_to(jnp.eye(noise.shape[-1], dtype=noise.dtype), noise.shape)
            filled = jnp.where(seen[..., None, None], noise, eye)
            positive = jnp.all(jnp.isfinite(jnp.linalg.cholesky(filled)))
            good = positive & jnp.all(
                ~seen[..., None, None] | (jnp.abs(noise - swapped) <= 1e-6 * jnp.abs(noise))
            )
        else:
            good = jnp.asarray(True)
        findings.require(
            good,
            RESULTS.invalid_state,
            f"Arguments `sigma` and `covariance` of `{type(x).__name__}` must be positive, but one "
            "is not.",
        )
        if isinstance(x, Attitudes):
            norm = jnp.sum(jnp.where(seen[..., None], x.values, 0.5) ** 2, axis=-1)
            findings.require(
                jnp.all(jnp.abs(norm - 1) < 1e-3),
                RESULTS.invalid_attitude,
                "Argument `values` of `Attitudes` must be unit quaternions, but one is not.",
            )
        if isinstance(x, Directions):
            shown = jnp.where(seen[..., None], x.values, 1 / 3**0.5)
            findings.require(
                jnp.all(jnp.abs(jnp.sum(shown**2, axis=-1) - 1) < 0.5),
                RESULTS.invalid_state,
                "Argument `values` of `Directions` must be unit vectors, but one is not.",
            )
    if samples is not None and any(isinstance(x, Rates) for x in stacked):
        turned = _between(samples)
        findings.require(
            turned < jnp.pi,
            RESULTS.invalid_state,
            "Argument `values` of `Rates` must be in radians a second and sampled more than twice "
            "a turn, but the body turns more between samples: are the rates in degrees a second?",
        )
    return findings


def _between(samples: Samples) -> Array:
    """Angle turned between neighbouring samples, as a median."""
    if samples.ts.shape[1] < 2:
        return jnp.zeros((), samples.ts.dtype)
    ok = samples.there[:, 1:] & samples.there[:, :-1]
    step = jnp.where(ok, jnp.diff(samples.ts, axis=1), jnp.nan)
    speed = jnp.sqrt(jnp.sum(samples.omega[:, 1:] ** 2, axis=-1))
    median = jnp.nanmedian(jnp.where(ok, step * speed, jnp.nan))
    return jnp.where(jnp.isnan(median), 0.0, median)


def local_scales(
    stacked: tuple[AbstractObservation, ...], rate: Array
) -> tuple[Array, Array, Array]:
    """Noise of rates [rad/s] and of attitudes [rad], and a guess of a sample's if it is unknown."""

    def median(x: AbstractObservation) -> Array:
        if x.sigma is not None:
            noise = x.sigma
        elif x.covariance is not None:
            noise = jnp.sqrt(jnp.diagonal(x.covariance, axis1=-2, axis2=-1))
        else:
            return jnp.full((), 0.02, rate.dtype) * (rate if isinstance(x, Rates) else 1.0)
        found = jnp.nanmedian(jnp.where(known(x), noise, jnp.nan))
        fallback = 0.02 * rate if isinstance(x, Rates) else jnp.full((), 0.02, rate.dtype)
        return jnp.where(jnp.isnan(found), fallback, found)

    of_rates = [median(x) for x in stacked if isinstance(x, Rates)]
    of_angles = [median(x) for x in stacked if isinstance(x, Attitudes | Directions)]
    guess = 0.02 * rate
    rates = of_rates[0] if of_rates else (of_angles[0] * rate if of_angles else guess)
    angles = of_angles[0] if of_angles else rates / rate
    return rates, angles, guess
