"""Posteriors by blackjax beside linear errors and intervals: where they agree.

Three bodies, one record each of 200 rates in ten turns: a plain one, one of nearly
equal moments and one that is nearly flat. NUTS starts at the fit, its mass matrix is
the inverse of the fit's covariance; two chains. The prior is flat in the tensor. Needs
blackjax (`make bench` installs it).
"""

import importlib
import pathlib
import time
from typing import Any

import common
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import jrigid as jr
from jrigid.identify import Rates, fit, log_density

try:
    blackjax: Any = importlib.import_module("blackjax")
except ModuleNotFoundError:
    blackjax = None  # of the group `peers`
# Moments, noise, spin, and NUTS's step.
CASES = {
    "plain": ((1.0, 1.7, 2.3), 0.01, (0.5, 1.0, 0.4), 0.5),
    "nearly equal moments": ((0.6794, 0.6796, 0.6892), 0.001, (0.5, 0.3, 0.8), 0.5),
    "nearly flat": ((1.0, 1.7, 2.685), 0.01, (0.5, 1.0, 0.4), 0.08),
}
WARM, DRAWS, CHAINS = 200, 1000, 2
PICTURE = pathlib.Path(__file__).parents[1] / "docs" / "images" / "posterior.png"


def record(moments, noise, spin, rng):
    """Rates in axes turned at random."""
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    axes = axes * np.linalg.det(axes)
    tensor = axes @ np.diag(moments) @ axes.T
    tensor, ts = (tensor + tensor.T) / 2, np.arange(200) * 2 * np.pi / 20
    omega = axes @ np.array(spin) / np.linalg.norm(spin)
    state = jr.State(np.array([1.0, 0.0, 0.0, 0.0]), omega)
    omegas = np.asarray(jr.free_rotation(tensor, state, ts).omega)
    return Rates(ts, omegas + noise * rng.normal(size=omegas.shape), noise)


def sampled(found, key, size):
    """Numbers of the tensor (chains, draws, ...), and how many draws they are worth."""
    density = log_density(found)
    kernel = blackjax.nuts(
        jax.jit(density.function), size, np.asarray(density.covariance)
    )

    @jax.jit
    def chain(key):
        def step(state, key):
            state, info = kernel.step(key, state)
            return state, (state.position, info.is_divergent)

        keys = jax.random.split(key, WARM + DRAWS)
        _, (positions, divergent) = jax.lax.scan(step, kernel.init(density.start), keys)
        return positions[WARM:], jnp.mean(divergent[WARM:])

    positions, divergent = jax.lax.map(chain, jax.random.split(key, CHAINS))
    worth = blackjax.diagnostics.effective_sample_size(positions)
    return (
        positions[..., : found.numbers.size],
        float(worth.min()),
        float(divergent.max()),
    )


def main(write: bool) -> None:
    """Sample, compare, draw."""
    if blackjax is None:
        print("blackjax is not installed: nothing to compare with")
        return
    rows, (figure, axes) = (
        [],
        plt.subplots(1, len(CASES), figsize=(12, 4), layout="constrained"),
    )
    for index, (name, (moments, noise, spin, size)) in enumerate(CASES.items()):
        rng = np.random.default_rng([7, index])
        found = fit(
            jr.RigidBody(np.ones(3)), record(moments, noise, spin, rng), throw=False
        )
        start = time.perf_counter()
        numbers, worth, divergent = sampled(found, jax.random.key(index), size)
        seconds = time.perf_counter() - start
        tensors = jax.vmap(found.unknowns.inertia)(
            numbers.reshape(-1, found.numbers.size)
        )
        spread = jnp.linalg.eigvalsh(tensors)
        ratios = np.asarray(spread[:, 1:] / spread[:, :1])
        low, high = np.asarray(found.ratios_intervals)
        best, error = np.asarray(found.ratios), np.asarray(found.ratios_errors)
        true = np.array(moments)[1:] / moments[0]
        for i, label in enumerate(("I2/I1", "I3/I1")):
            quantiles = np.quantile(ratios[:, i], [0.025, 0.975])
            rows.append(
                [
                    f"{name}, {label}",
                    float(true[i]),
                    f"{best[i]:.5f} +- {error[i]:.5f}",
                    f"{low[i]:.5f} to {high[i]:.5f}",
                    f"{quantiles[0]:.5f} to {quantiles[1]:.5f}",
                    float(ratios[:, i].std() / error[i]),
                    worth,
                    100 * divergent,
                    seconds,
                ]
            )
            print(rows[-1], flush=True)
        draw(axes[index], name, ratios, found, true, (low, high))
    header = [
        "body, ratio",
        "true",
        "fit, by derivatives",
        "`ratios_intervals`, 95 %",
        "posterior, 95 %",
        "its spread to the error",
        "draws it is worth",
        "divergent %",
        "s",
    ]
    if write:
        PICTURE.parent.mkdir(exist_ok=True)
        figure.savefig(PICTURE, dpi=120)
    text = (
        common.table(header, rows)
        + "\n\n![posteriors](../../docs/images/posterior.png)"
    )
    packages = ["jax", "blackjax", "numpy", "matplotlib"]
    common.report(
        "posterior", "Posteriors of the ratios by NUTS", text, packages, write
    )


def draw(axis, name, ratios, found, true, limits):
    """Draws, the ellipse of 95 % by derivatives, the intervals, the truth."""
    axis.plot(*ratios.T, ".", ms=2, color="0.6", label="posterior, by NUTS")
    values, turn = np.linalg.eigh(np.asarray(found.ratios_covariance))
    circle = np.stack([f(np.linspace(0, 2 * np.pi, 200)) for f in (np.cos, np.sin)])
    ellipse = turn @ (np.sqrt(5.991 * np.maximum(values, 0))[:, None] * circle)
    best = np.asarray(found.ratios)
    axis.plot(*(best[:, None] + ellipse), color="#0072B2", label="95 % by derivatives")
    for i, line in ((0, axis.axvline), (1, axis.axhline)):
        for limit in limits:
            style = {"color": "#D55E00", "lw": 1, "ls": "--"}
            line(
                limit[i],
                label="`ratios_intervals`"
                if (i, limit[i]) == (0, limits[0][0])
                else None,
                **style,
            )
    axis.plot(*true, "k+", ms=12, mew=2, label="true")
    axis.set(title=name, xlabel="$I_2/I_1$", ylabel="$I_3/I_1$")
    if name == "plain":
        axis.legend(fontsize=8)


if __name__ == "__main__":
    main(common.arguments(__doc__).parse_args().write)
