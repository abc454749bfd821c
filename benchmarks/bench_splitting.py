"""Energy of a heavy asymmetric top over ten million symplectic steps.

    taskset -c 1 python benchmarks/bench_splitting.py [--write] [--steps N]

I = (1, 2, 3), the centre of mass on no axis: the motion is chaotic, and all that is
conserved are the energy and the vertical angular momentum. `Splitting` of order 2, 4
and 6, beside `simulate` with its default method; and 32 tops with a tenth of the steps,
so short that rounding is all that is left: does it walk at random? `--write` draws
docs/images/energy.png too.
"""

import pathlib
import time
from typing import Any, NamedTuple

import common
import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import peers

import jrigid as jr

PULL = jr.torques.UniformGravity(
    1.0, np.array([0.3, 0.1, 0.5]), np.array([0.0, 0.0, -1.0])
)
BODY = jr.RigidBody(np.array([1.0, 2.0, 3.0]), PULL)
ATTITUDE, OMEGA = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.1, 1.0, 0.3])
STEPS = {2: 0.05, 4: 0.1, 6: 0.2}  # s, by order
TOLERANCES = (1e-6, 1e-8, 1e-10, 1e-14)
LONGEST = {1e-14: 0.125}  # s: truncation as small as rounding
SHORT, TOPS = 0.02, 32
EPS = float(np.finfo(float).eps)
IMAGE = pathlib.Path(__file__).parent.parent / "docs" / "images" / "energy.png"
COLOURS = {2: "#E69F00", 4: "#D55E00", 6: "#CC79A7"}


class Run(NamedTuple):
    """Steps taken until each output, relative errors there, and microseconds."""

    steps: np.ndarray
    energy: np.ndarray
    momentum: float
    per_step: float
    per_second: float


def outputs(steps, number=400):
    """Numbers of steps, evenly spread over their decades."""
    return np.unique(np.round(np.geomspace(1, steps, number)))


def conserved(omega, ts, **options):
    """Energy and vertical angular momentum."""
    motion = jr.simulate(BODY, jr.State(ATTITUDE, omega), ts, **options)
    return motion.energy, motion.angular_momentum[:, 2], motion.stats["num_steps"]


def measured(ts, **options):
    """One run, the first after the compilation; the clock is that of the process."""
    ts = jnp.append(0.0, ts)
    program, _ = common.compiled(
        lambda omega, ts: conserved(omega, ts, **options), OMEGA, ts
    )
    start = time.process_time()
    energy, momentum, steps = jax.block_until_ready(program(OMEGA, ts))
    clock, end = 1e6 * (time.process_time() - start), float(ts[-1])
    errors = [
        np.maximum.accumulate(np.abs(x / x[0] - 1))[1:] for x in (energy, momentum)
    ]
    number = np.asarray(ts[1:]) / end * int(steps)
    return Run(number, errors[0], float(errors[1][-1]), clock / int(steps), clock / end)


def norm_error(order, step, steps=100_000):
    """Of attitudes as the steps leave them: `simulate` normalises what it returns."""
    solver, state = (
        jr.solvers.Splitting(order),
        jr.State(jnp.asarray(ATTITUDE), jnp.asarray(OMEGA)),
    )
    solution: Any = diffrax.diffeqsolve(
        solver.terms(BODY),
        solver,
        0.0,
        step * steps,
        step,
        state,
        max_steps=steps + 1,
        saveat=diffrax.SaveAt(ts=step * jnp.linspace(0, steps, 1001)),
    )
    return float(jnp.abs(jnp.linalg.norm(solution.ys.attitude, axis=1) - 1).max())


def rounding(steps):
    """Errors of the energy of many tops, by the number of steps."""
    number = outputs(steps, 100)
    ts = jnp.append(0.0, SHORT * number)
    starts = OMEGA * (1 + 0.01 * np.arange(TOPS))[:, None]
    options = {"solver": jr.solvers.Splitting(6), "max_step": SHORT}
    energy = jax.jit(jax.vmap(lambda omega: conserved(omega, ts, **options)[0]))(starts)
    return number, np.asarray(energy / energy[:, :1] - 1)[:, 1:]


def picture(split, stepped, walk):
    if peers.package("matplotlib") is None:
        return
    from matplotlib import pyplot as plt

    figure, ax = plt.subplots(figsize=(9, 5.6))
    last = max(run.steps[-1] for run in split.values())
    for order, run in split.items():
        ax.plot(run.steps, run.energy, color=COLOURS[order], linewidth=2.2)
        words = f"Splitting({order}), {STEPS[order]:g} s"
        ax.text(1.3 * last, run.energy[-1], words, color=COLOURS[order], va="center")
    for rtol, run in stepped.items():
        shown = run.steps >= 10
        ax.plot(run.steps[shown], run.energy[shown], color="#0072B2", linewidth=1.4)
        words = f"rtol {rtol:.0e}".replace("e-0", "e-")
        words += f", steps ≤ {LONGEST[rtol]:g} s" if rtol in LONGEST else ""
        side = "top" if rtol in LONGEST else "bottom"
        ax.text(1.15 * run.steps[-1], run.energy[-1], words, color="#0072B2", va=side)
    number, errors = walk
    ax.plot(number, np.sqrt(np.mean(errors**2, axis=0)), color="black", linewidth=2.2)
    ax.annotate(
        f"Splitting(6), {SHORT:g} s: rms of {TOPS} tops",
        (number[-1], errors.std(axis=0)[-1]),
        (8, 3),
        textcoords="offset points",
        va="center",
    )
    ax.plot(number, EPS * np.sqrt(number), color="0.6", linestyle="--")
    ax.text(
        0.1 * number[-1],
        0.3 * EPS * np.sqrt(0.1 * number[-1]),
        "eps √steps",
        color="0.4",
    )
    ax.set(xscale="log", yscale="log", xlim=(1, last), ylim=(1e-16, 1e-2))
    ax.set(xlabel="steps", ylabel="largest |ΔE / E| so far")
    ax.set_title("Energy of a heavy asymmetric top", loc="left", fontweight="bold")
    ax.grid(color="0.92")
    ax.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    IMAGE.parent.mkdir(exist_ok=True)
    figure.savefig(IMAGE, dpi=110, bbox_inches="tight")
    plt.close(figure)


def row_of(name, run, norm=None):
    """Of the table."""
    early = run.energy[np.searchsorted(run.steps, run.steps[-1] / 1000)]
    numbers = [
        run.per_step,
        run.per_second,
        float(early),
        float(run.energy[-1]),
        run.momentum,
    ]
    return [name, f"{run.steps[-1]:.3g}", *numbers, norm]


def main(steps, write):
    number, split, stepped, rows = outputs(steps), {}, {}, []
    for order, step in STEPS.items():
        options = {
            "solver": jr.solvers.Splitting(order),
            "max_step": step,
            "max_steps": 2 * steps,
        }
        split[order] = measured(step * number, **options)
        rows.append(
            row_of(
                f"Splitting({order}), {step:g} s", split[order], norm_error(order, step)
            )
        )
        print(rows[-1], flush=True)
    times = np.geomspace(1.0, 0.05 * steps, 400)
    for rtol in TOLERANCES:
        name, longest = (
            f"simulate, rtol {rtol:.0e}".replace("e-0", "e-"),
            LONGEST.get(rtol),
        )
        stepped[rtol] = measured(times, rtol=rtol, max_step=longest)
        name += f", steps of at most {longest:g} s" if longest else ""
        rows.append(row_of(name, stepped[rtol]))
        print(rows[-1], flush=True)
    walk = rounding(steps // 10)
    spread = np.sqrt(np.mean(walk[1] ** 2, axis=0))
    late = walk[0] >= walk[0][-1] / 100
    exponent = np.polyfit(np.log(walk[0][late]), np.log(spread[late]), 1)[0]
    header = [
        "method",
        "steps",
        "us a step",
        "us a second",
        "energy, first 1/1000",
        "energy",
    ]
    mean, worst = float(walk[1][:, -1].mean()), float(np.abs(walk[1][:, -1]).max())
    doubt = float(walk[1][:, -1].std(ddof=1)) / TOPS**0.5
    text = f"""\
I = (1, 2, 3), a heavy top that turns by a radian in a second or so. Relative errors,
the largest so far; the norm of the attitude after 1e5 steps in diffrax (`simulate`
normalises).
Microseconds of the processor for a step, and for a second of the motion.

{common.table([*header, "vertical momentum", "norm"], rows)}

Rounding alone: {TOPS} tops, order 6, steps of {SHORT:g} s. Their energy errors after
{walk[0][-1]:.0e} steps are {spread[-1]:.1e} (rms; worst {worst:.1e}), that is
{spread[-1] / EPS / walk[0][-1] ** 0.5:.1f} eps sqrt(steps); their mean is
{mean:.1e} +- {doubt:.1e}. Over the last two decades they grow as
steps^{exponent:.2f}; a random walk grows as steps^0.5, and has no mean.
"""
    title = (
        "Energy over ten million steps"
        if steps == 10**7
        else f"Energy over {steps:.0e} steps"
    )
    common.report("splitting", title, text.rstrip(), ["jax", "diffrax", "numpy"], write)
    if write:
        picture(split, stepped, walk)


if __name__ == "__main__":
    parser = common.arguments(__doc__)
    parser.add_argument("--steps", type=int, default=10**7)
    options = parser.parse_args()
    main(options.steps, options.write)
