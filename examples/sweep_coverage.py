"""Do the error bars of a fit contain the truth as often as they state?

A body with three different moments tumbles freely for three turns. A gyroscope measures
its rates 60 times, with a noise of a twelfth of the rates. Each trial has new noise and
a fit of the two ratios of moments. The estimates, their stated errors and the status
are kept. Workers of a dask cluster share the trials, a hundred at a time. The seed
alone determines the noise of a trial, so the result is the same anywhere.

Run it: `python sweep_coverage.py [--size 4000]`.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import jax
import matplotlib.pyplot as plt
import numpy as np
from dask.distributed import Client, LocalCluster

import jrigid as jr

PICTURE = Path(__file__).parents[1] / "outputs" / "sweep_coverage.png"
MOMENTS, OMEGA = (1.0, 1.5, 2.0), (0.5, 1.0, 0.4)  # kg m^2, rad/s
TIMES = np.linspace(0.0, 16.0, 60)  # s
NOISE = 0.1  # rad/s
NAMES = ("$I_2 / I_1$", "$I_3 / I_1$")
TOGETHER = 100  # trials of one call
INTERVALS = {"68.3 %": (1.0, 0.6827), "95 %": (1.96, 0.95)}


def trials(seeds: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ratios of moments, their errors, and whether the fit is OK."""
    jax.config.update("jax_enable_x64", True)  # in each worker
    state0 = jr.State(np.array([1.0, 0.0, 0.0, 0.0]), np.array(OMEGA))
    rates = np.asarray(jr.free_rotation(np.array(MOMENTS), state0, TIMES).omega)
    noise = [
        NOISE * np.random.default_rng(seed).normal(size=rates.shape) for seed in seeds
    ]
    found = jr.identify.fit_each(
        jr.RigidBody(np.ones(3)),
        [jr.identify.Rates(TIMES, rates + x, NOISE) for x in noise],
        inertia_model=jr.identify.Moments(),
    )
    good = found.status == jr.identify.Status.OK
    return np.asarray(found.ratios), np.asarray(found.ratios_errors), np.asarray(good)


def draw(normalised: np.ndarray) -> None:
    """Actual errors over stated errors, beside the unit normal distribution."""
    figure, panels = plt.subplots(
        1, 2, figsize=(9.0, 3.8), constrained_layout=True, sharey=True
    )
    x = np.linspace(-4.0, 4.0, 201)
    for panel, errors, name in zip(panels, normalised.T, NAMES, strict=True):
        panel.hist(
            errors, bins=40, range=(-4, 4), density=True, color="#9ecae1", label="fits"
        )
        panel.plot(
            x,
            np.exp(-(x**2) / 2) / np.sqrt(2 * np.pi),
            color="#08306b",
            label="unit normal",
        )
        panel.set(title=name, xlabel="(estimate - truth) / stated error")
        panel.spines[["top", "right"]].set_visible(False)
    panels[0].set(ylabel="density")
    panels[0].legend(frameon=False)
    figure.savefig(PICTURE, dpi=150)


def main() -> None:
    """Start a cluster of two processes, sweep over the seeds, and count."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=4000, help="number of trials")
    seeds = np.arange(parser.parse_args().size)
    start = time.perf_counter()
    no_dashboard: Any = None
    cluster = LocalCluster(
        n_workers=2, threads_per_worker=1, dashboard_address=no_dashboard
    )
    with cluster, Client(cluster) as client:
        parts = np.array_split(seeds, -(-seeds.size // TOGETHER))
        found: Any = client.gather(client.map(trials, parts))
    ratios, errors, good = map(np.concatenate, zip(*found, strict=True))
    print(f"{seeds.size} fits in {time.perf_counter() - start:.0f} s")
    print(f"of which {np.sum(good)} ended OK")
    truth = np.array(MOMENTS[1:]) / MOMENTS[0]
    normalised = ((ratios - truth) / errors)[good]
    print("interval   should     I2/I1             I3/I1")
    for label, (width, wanted) in INTERVALS.items():
        shares = np.mean(np.abs(normalised) < width, axis=0)
        spread = np.sqrt(wanted * (1 - wanted) / len(normalised))
        columns = "   ".join(f"{x:6.2%} +- {spread:.2%}" for x in shares)
        print(f"{label:8}   {wanted:.2%}   {columns}")
    PICTURE.parent.mkdir(exist_ok=True)
    draw(normalised)
    print(f"written to {PICTURE}")


if __name__ == "__main__":
    main()
