"""Which rotations of Hyperion are chaotic?

A moon rotates in the plane of its orbit, a fixed ellipse. The map is over the angle of
its longest axis from Saturn and its rate, both at a pericentre. The numbers are from J.
Wisdom, S. Peale, F. Mignard, Icarus 58 (1984) 137: e = 0.1 and omega_0 =
sqrt(3 (B - A) / C) = 0.89 mean motions. MEGNO, the mean exponential growth of nearby
orbits, uses a neighbour in the plane. Therefore the map shows planar chaos, and islands
may still be unstable out of the plane. Angles from 0 to 90 degrees are computed. The
others are their mirror image with time reversed.

Run it: `python sweep_hyperion.py [--size 300]`. 45,000 motions of 60 orbits took four
and a half minutes on two cores of an AMD EPYC, which other work shared.
"""

import argparse
import math
import time
from fractions import Fraction
from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Array
from matplotlib.colors import LogNorm

import jrigid as jr

PICTURE = Path(__file__).parents[1] / "outputs" / "sweep_hyperion.png"
ECCENTRICITY, OMEGA_0 = 0.1, 0.89
ORBITS, STEPS = 60, 24  # steps of an orbit
RESONANCES = [Fraction(x) for x in ("1/2", "1", "3/2", "2", "9/4", "5/2")]


def hyperion() -> jr.RigidBody:
    """The body, with C = 1. Only (B - A)/C matters. The mean motion is 1."""
    moments = jnp.array([0.7, 0.7 + OMEGA_0**2 / 3, 1.0])
    orbit = jr.torques.KeplerOrbit(1.0, 1.0, ECCENTRICITY)
    return jr.RigidBody(moments, jr.torques.GravityGradient(1.0, orbit))


def at_pericentre(angle: Array, rate: Array) -> jr.State:
    """State of a rotation about the normal of the orbit."""
    normal = jnp.array([0.0, 0.0, 1.0])
    return jr.State(jr.rotation.exp(angle * normal), rate * normal)


def chaos(angle: Array, rate: Array) -> Array:
    """MEGNO with a deviation in the plane, of angle and rate about the normal."""
    return jr.stability.megno(
        hyperion(),
        at_pericentre(angle, rate),
        2 * math.pi * ORBITS,
        STEPS * ORBITS,
        vector=jnp.array([0.0, 0.0, 1.0, 0.0, 0.0, 1.0]),
        samples=1,
        throw=False,
    ).megno


def mean_rate(angle: Array, rate: Array) -> Array:
    """Mean rate over all orbits [mean motions]."""
    ts = 2 * math.pi * jnp.linspace(0.0, ORBITS, 16 * ORBITS + 1)
    motion = jr.simulate(hyperion(), at_pericentre(angle, rate), ts, throw=False)
    return jnp.mean(motion.states.omega[1:, 2])


def islands() -> list[tuple[Fraction, float, float]]:
    """Resonance, angle and rate at the centre of each island at an angle of 0 or 90."""
    axes = {"angle": np.array([0.0, np.pi / 2]), "rate": np.linspace(0.01, 3.0, 240)}
    calm = jr.sweep(chaos, axes, progress=False).values < 3
    means = jr.sweep(mean_rate, axes, progress=False).values
    centres = []
    for resonance in RESONANCES:
        for angle, row, mean in zip(axes["angle"], calm, means, strict=True):
            locked = axes["rate"][row & (np.abs(mean - resonance) < 0.01)]
            if locked.size > 2:
                centres.append((resonance, math.degrees(angle), np.median(locked)))
    return centres


def draw(found: jr.SweepResult, centres: list) -> None:
    """Half of the map and its mirror image. The spin rate names each island."""
    figure, axes = plt.subplots(figsize=(7.2, 6.4), constrained_layout=True)
    half = np.maximum(found.values, 1)
    both = np.roll(np.concatenate([half, half[::-1]]), 2 * len(half) // 3, axis=0)
    image = axes.imshow(
        both.T,
        origin="lower",
        aspect="auto",
        extent=(-60, 120, 0, 3),
        cmap="magma",
        norm=LogNorm(1, 40),
    )
    for resonance, angle, rate in centres:
        colour, aside = (
            ("black", 8) if resonance == RESONANCES[0] else ("white", 0)
        )  # a small island
        axes.text(
            angle + aside, rate, str(resonance), color=colour, ha="center", va="center"
        )
    axes.text(40, 1.5, "chaotic sea", ha="center")
    bar = figure.colorbar(image, ax=axes, label=f"MEGNO after {ORBITS} orbits")
    bar.set_ticks(
        [1, 2, 5, 10, 20, 40], labels=["1", "2 (order)", "5", "10", "20", "40 (chaos)"]
    )
    bar.ax.minorticks_off()
    axes.set(
        xlabel="angle at pericentre [deg]",
        ylabel="rate at pericentre / mean motion",
        title="Hyperion; islands are named by mean spin rate / mean motion",
    )
    figure.savefig(PICTURE, dpi=150)


def main() -> None:
    """Sweep, print the result, and draw it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--size", type=int, default=300, help="points along a side, 6 n"
    )
    size = parser.parse_args().size
    jax.config.update("jax_enable_x64", True)
    start = time.perf_counter()
    angles = (np.arange(size // 2) + 0.5) * np.pi / size  # to 90 degrees
    axes = {"angle": angles, "rate": (np.arange(size) + 0.5) * 3 / size}
    found = jr.sweep(chaos, axes, block_size=2048)
    print(f"{found.valid.sum()} of {found.valid.size} motions are valid")
    print(
        f"chaotic {np.mean(found.values > 5):.0%}, regular "
        f"{np.mean(found.values < 3):.0%}"
    )
    centres = islands()
    for resonance, angle, rate in centres:
        print(f"island of {resonance!s:>3}: angle {angle:.0f} deg, rate {rate:.2f}")
    PICTURE.parent.mkdir(exist_ok=True)
    draw(found, centres)
    print(f"{time.perf_counter() - start:.0f} s, written to {PICTURE}")


if __name__ == "__main__":
    main()
