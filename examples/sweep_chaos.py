"""Where is a heavy top chaotic that is released at a tilt, with a spin?

The top has three different moments and a centre of mass off its axes. Only energy and
the angular momentum about the vertical are conserved. MEGNO, the mean exponential
growth of nearby orbits, separates regular motion from chaos after 200 s. Only tiles of
the map that contain a boundary between the two are computed. They are stored, so a run
that was stopped resumes.

Run it: `python sweep_chaos.py [--size 1000] [--store outputs/chaos.zarr]`. 1000 x 1000
points, 16 % of them computed, took 95 s on two cores of an AMD EPYC, which other work
shared.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
from jaxtyping import Array
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.patches import Patch

import jrigid as jr

OUTPUTS = Path(__file__).parents[1] / "outputs"
COLOURS = "#2a6f97", "#f4a259"  # of order and of chaos
ORDER = jr.stability.ORDER
UNITS = {"tilt": {"units": "rad"}, "spin": {"units": "rad/s"}, "megno": {"units": "1"}}


def chaos(tilt: Array, spin: Array) -> dict[str, Any]:
    """A top released at a tilt about its first axis, with a spin about its third."""
    gravity = jr.torques.UniformGravity(
        1.0, jnp.array([0.3, 0.1, 0.5]), jnp.array([0.0, 0.0, -1.0])
    )
    top = jr.RigidBody(jnp.array([1.0, 1.5, 0.7]), gravity)
    turn, rate = tilt * jnp.array([1.0, 0.0, 0.0]), spin * jnp.array([0.0, 0.0, 1.0])
    start = jr.State(jr.rotation.exp(turn), rate)
    found = jr.stability.megno(top, start, 200.0, 800, samples=1, throw=False)
    return {"megno": found.megno, "order": found.order}


def is_chaotic(values: dict[str, Any]) -> Array:
    """The class of a point. An undecided motion counts as chaos after 200 s."""
    return values["order"] != ORDER.regular


def draw(found: jr.SweepResult) -> None:
    """Regular motion and chaos at every point, and MEGNO in the computed tiles."""
    figure, (left, right) = plt.subplots(
        1, 2, figsize=(12.0, 5.2), constrained_layout=True, sharey=True
    )
    assert found.classes is not None  # of a refined map
    extent = (*np.degrees(found.extent[:2]), *found.extent[2:])
    style: dict[str, Any] = {"origin": "lower", "aspect": "auto", "extent": extent}
    left.imshow(found.classes.T, cmap=ListedColormap(COLOURS), vmin=0, vmax=1, **style)
    kinds = [
        Patch(color=x, label=y)
        for x, y in zip(COLOURS, ("order", "chaos"), strict=True)
    ]
    left.legend(handles=kinds, loc="upper right")
    right.set_facecolor("#c8ccd0")
    image = right.imshow(
        found.values["megno"][...].T, cmap="magma", norm=LogNorm(1.5, 60), **style
    )
    bar = figure.colorbar(
        image, ax=right, label="MEGNO after 200 s (grey: not computed)"
    )
    bar.set_ticks([2, 5, 10, 20, 50], labels=["2", "5", "10", "20", "50"])
    bar.ax.minorticks_off()
    left.set(ylabel="spin at release [rad/s]", title="Order and chaos of a heavy top")
    right.set(title="What was computed of it: tiles on a coast")
    for panel in (left, right):
        panel.set_xlabel("tilt at release [deg]")
    figure.savefig(OUTPUTS / "sweep_chaos.png", dpi=150)


def main() -> None:
    """Start or resume the sweep, and draw it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=1000, help="points along each side")
    parser.add_argument("--store", type=Path, default=OUTPUTS / "chaos.zarr")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    OUTPUTS.mkdir(exist_ok=True)
    axes = {
        "tilt": np.linspace(0.0, np.pi, given.size),
        "spin": np.linspace(0.0, 5.0, given.size),
    }
    start = time.perf_counter()
    found = jr.sweep(
        chaos, axes, refine=is_chaotic, store=given.store, attributes=UNITS
    )
    seconds = time.perf_counter() - start
    computed = np.mean(found.valid)
    assert found.classes is not None  # of a refined map
    print(
        f"{found.classes.size} points in {seconds:.0f} s, {computed:.1%} of them "
        "computed"
    )
    print(f"chaotic: {found.classes.mean():.1%}")
    draw(found)
    print(f"written to {given.store} and {OUTPUTS / 'sweep_chaos.png'}")


if __name__ == "__main__":
    main()
