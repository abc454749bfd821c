"""Inertia from a noisy gyro: a fixed grid of bodies and records, speed, and peers.

Each record is rates along the axes of a sensor turned at random from the principal
axes, one radian a second, the noise a fraction of that; a turn is 2 pi seconds. The
grid: five bodies, 1, 10 and 100 turns, 5, 20 and 50 samples a turn, noise of 0.1, 1 and
5 %, 100 records in each cell, fitted blind (`fit` is given a sphere and no state). The
bound is Cramer and Rao's at the truth; errors are of the tensor's five numbers at unit
mean moment; cells whose bound exceeds 0.3 of a ratio are counted apart. Normalised
error squared is chi-square over 5, by the covariance each fit reports.

Cells of their own (`--cells`: these alone) have what a plain fit does not expect, in
records by an independent integrator (tests/worlds.py): a body of moments 1, 1.7, 2.3
whose axes and spin are drawn anew for each, 1 % noise, ten turns of 20 samples, unless
said. Counted are the fits that end OK, and how many of their 95 % intervals (1.96
errors) hold the truth; those of a level are of its logarithm. White torque is in units
of what moves the rates by the noise from one sample to the next.

Peers start from the same: a sphere and the first reading.
`scipy.optimize.least_squares` differs the exact flow by finite differences; Adam
(optax) descends its gradients.
"""

import functools
import pathlib
import sys
import time

import common
import jax
import jax.numpy as jnp
import numpy as np
import optax
import scipy.optimize

import jrigid as jr
from jrigid.identify import (
    Attitudes,
    Gyro,
    Plan,
    Rates,
    Record,
    Status,
    fit,
    fit_each,
    prior,
    residuals,
)

sys.path.insert(0, str(pathlib.Path(__file__).parents[1] / "tests"))
import worlds  # pyright: ignore[reportMissingImports]

BODIES = {
    "asymmetric": ((1.0, 1.7, 2.3), (0.5, 1.0, 0.4)),
    "symmetric": ((1.0, 1.0, 1.6), (0.6, 0.0, 0.8)),
    "nearly symmetric": ((1.0, 1.02, 1.5), (0.6, 0.3, 0.8)),
    "slender rod": ((0.05, 1.0, 1.02), (1.0, 0.3, 0.3)),
    "near separatrix": ((1.0, 1.7, 2.3), (0.02, 1.0, 0.01)),
}
TURNS, A_TURN, NOISE, TRIALS = (1, 10, 100), (5, 20, 50), (0.001, 0.01, 0.05), 100
UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])
SPHERE = jr.RigidBody(np.ones(3))
FIVE = ((0, 0), (1, 1), (0, 1), (0, 2), (1, 2))


def record(name, turns, a_turn):
    """Tensor of trace 3, times, true rates."""
    moments, direction = BODIES[name]
    seed = [list(BODIES).index(name), turns, a_turn]
    axes = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))[0]
    axes = axes * np.linalg.det(axes)
    tensor = axes @ np.diag(moments) @ axes.T
    tensor = 3 * (tensor + tensor.T) / (2 * np.trace(tensor))
    omega = axes @ np.array(direction) / np.linalg.norm(direction)
    ts = np.arange(turns * a_turn) * 2 * np.pi / a_turn
    motion = jr.free_rotation(tensor, jr.State(UNTURNED, omega), ts)
    return tensor, ts, np.asarray(motion.omega)


def of_elements(inertia):
    return jnp.stack([inertia[i, j] for i, j in FIVE])


def fits(values, ts, noise):
    """Estimates and covariances of the five numbers, and how the fits ended."""
    found = fit_each(SPHERE, [Rates(ts, y, noise) for y in values])
    places = [3 * i + j for i, j in FIVE]
    elements = np.asarray(found.inertia).reshape(-1, 9)[:, places]
    covariance = np.asarray(found.inertia_covariance)[:, places][:, :, places]
    return elements, covariance, found.status, found.degrees_of_freedom


def bound_at_truth(tensor, omega, ts, noise):
    """Covariance of the five numbers, and the relative bounds of the ratios."""
    plan = Plan(jr.RigidBody(tensor), jr.State(UNTURNED, omega), Rates(ts, None, noise))
    predicted, bound = plan.predicted, plan.bound
    tensor_of = predicted.unknowns.inertia
    slopes = jax.jacfwd(lambda p: of_elements(tensor_of(p)))(predicted.numbers)
    moments = jnp.linalg.eigvalsh(tensor)
    relative = jnp.sqrt(jnp.diagonal(bound.ratios_covariance)) / (
        moments[1:] / moments[0]
    )
    of_numbers = bound.covariance[:5, :5]
    return slopes @ of_numbers @ slopes.T, jnp.max(relative)


def grid():
    """One row for each noise and kind of record, over bodies; pooled numbers."""
    rows, pooled, worst_cell = [], {n: [] for n in NOISE}, 1.0
    apart, silent = [], []
    for turns in TURNS:
        for a_turn in A_TURN:
            for noise in NOISE:
                cells = []
                for name in BODIES:
                    tensor, ts, omegas = record(name, turns, a_turn)
                    rng = np.random.default_rng(
                        [1, turns, a_turn, list(BODIES).index(name)]
                    )
                    values = omegas + noise * rng.normal(size=(TRIALS, *omegas.shape))
                    true_spread, relative = bound_at_truth(tensor, omegas[0], ts, noise)
                    found, spread, status, _ = fits(values, ts, noise)
                    bad = (status == Status.WRONG_BASIN) | (
                        status == Status.NOT_CONVERGED
                    )
                    good = np.asarray(status == Status.OK)
                    # At the boundary, or not determined by the record.
                    undetermined = ~good & ~np.asarray(bad)
                    error = np.asarray(found) - np.asarray(of_elements(tensor))
                    converged = 1 - np.mean(np.asarray(bad))
                    cell = f"{name}, {turns} turns of {a_turn}, {100 * noise:g} %"
                    if not relative < 0.3:
                        apart.append((cell, float(relative), converged))
                        continue
                    worst_cell = min(worst_cell, converged)
                    if not good.any():  # each fit says that it is not determined
                        silent.append(cell)
                        continue
                    scaled = error[good] / np.sqrt(np.diagonal(true_spread))
                    inverse = np.linalg.inv(np.asarray(spread)[good])
                    squared = (
                        np.einsum("ni,nij,nj->n", error[good], inverse, error[good]) / 5
                    )
                    width = 1.96 * np.sqrt(
                        np.diagonal(np.asarray(spread)[good], axis1=1, axis2=2)
                    )
                    inside = np.abs(error[good]) < width
                    rms = np.sqrt(np.mean(scaled**2))
                    pooled[noise].append((squared, inside, len(error), converged))
                    cells.append(
                        (
                            float(relative),
                            converged,
                            rms,
                            squared.mean(),
                            inside.mean(),
                            undetermined.sum(),
                        )
                    )
                    print(cell, [f"{x:.3g}" for x in cells[-1]], flush=True)
                if cells:
                    bounds, ok, rms, squared, inside, undetermined = np.array(cells).T
                    rows.append(
                        [
                            f"{turns} turns of {a_turn}, {100 * noise:g} %",
                            len(cells),
                            f"{bounds.min():.1g} to {bounds.max():.1g}",
                            100 * ok.min(),
                            np.sqrt(np.mean(rms**2)),
                            rms.max(),
                            squared.mean(),
                            100 * inside.mean(),
                            int(undetermined.sum()),
                        ]
                    )
    for noise, parts in pooled.items():
        squared = np.concatenate([p[0] for p in parts])
        inside = np.concatenate([p[1] for p in parts])
        ok = np.average([p[3] for p in parts])
        label = f"all, {100 * noise:g} % ({squared.size} fits)"
        cover = 100 * inside.mean()
        rows.append(
            [label, len(parts), "", 100 * ok, None, None, squared.mean(), cover, None]
        )
    return rows, apart, silent, worst_cell


TEN, STEP, SIGMA = np.arange(200) * np.pi / 10, np.pi / 10, 0.01
MOMENTS = np.array([1.0, 1.7, 2.3])
LEVEL = SIGMA / np.sqrt(
    STEP
)  # of a torque that moves rates of a unit body by SIGMA in a step
CLOCK = np.arange(-20, 121) * 0.01  # of a wheel's record [s]
SECOND = np.arange(100) * 0.01


def scene(rng, count, ts, spin=1.0, **motion):
    """Tensors of mean moment 1 and their motions, all drawn anew for each."""
    axes = np.stack([worlds.random_axes(rng) for _ in range(count)])
    tensors = np.einsum("nij,j,nkj->nik", axes, MOMENTS / MOMENTS.mean(), axes)
    inside = np.array([0.5, 1.0, 0.4]) + 0.25 * rng.uniform(-1, 1, size=(count, 3))
    omega = worlds.times(
        axes, spin * inside / np.linalg.norm(inside, axis=1, keepdims=True)
    )
    tensors = (tensors + tensors.swapaxes(1, 2)) / 2
    return tensors, worlds.tumble(tensors, omega, ts, rng=rng, **motion)


def smoothed(values):
    found = fit(SPHERE, Rates(TEN, values, SIGMA), unmodelled="estimate", throw=False)
    level, error = float(found.level[0]), float(found.level_errors[0])
    # An error of a level is that of its logarithm; none is counted as its own error.
    level = level if level > 0 else error
    return found, {"level": (np.log(level), error / level)}


def delayed(values, attitudes):
    records = (
        Record(Gyro(delay=jnp.zeros(())), TEN, values, SIGMA),
        Attitudes(TEN, attitudes, SIGMA),
    )
    found = fit(SPHERE, records, free=lambda _, gyro: gyro.delay, throw=False)
    return found, {"delay": found.estimates["gyro.delay"]}


def clipped(values, limit):
    return fit(SPHERE, Record(Gyro(limit=limit), TEN, values, SIGMA), throw=False), {}


def with_wheel(values, momenta):
    def free(body):
        wheel = body.torque.momentum
        return prior(wheel.scale, 0.02), prior(wheel.delay, 0.005)

    body = jr.RigidBody(
        np.ones(3), jr.torques.Rotor(jr.torques.Sampled(CLOCK, momenta))
    )
    found = fit(
        body, Rates(SECOND, values, 0.02), scale="rotor", free=free, throw=False
    )
    spread = jnp.sum(found.moments_covariance) ** 0.5
    sought = {x: found.estimates[f"torque.momentum.{x}"] for x in ("scale", "delay")}
    return found, sought | {"trace": (jnp.sum(found.moments), spread)}


def lanes(one):
    """The fits of many records."""

    def every(*given):
        results = []
        for parts in zip(*given, strict=True):
            found, sought = one(*parts)
            spread = found.inertia_covariance, found.ratios_errors
            results.append(
                (np.asarray(found.status), found.inertia, found.ratios, *spread, sought)
            )
        return jax.tree.map(lambda *x: np.stack(x), *results)

    return every


def covered(label, one, given, tensors, truths, absolute=False):
    """A row: fits that are OK, and how many of their intervals hold the truth."""
    status, inertia, ratios, spread, errors, sought = lanes(one)(*given)
    good = np.asarray(status) == int(Status.OK)
    pick = np.array([3 * i + j for i, j in FIVE + ((2, 2),) * absolute])
    error = (np.asarray(inertia) - tensors).reshape(-1, 9)[:, pick][good]
    spread = np.asarray(spread)[:, pick][:, :, pick][good]
    squared = np.einsum(
        "ni,ni->n", error, np.linalg.solve(spread, error[..., None])[..., 0]
    )
    within = np.abs(error) < 1.96 * np.sqrt(np.diagonal(spread, axis1=1, axis2=2))
    pulls = (np.asarray(ratios) - MOMENTS[1:] / MOMENTS[0])[good] / np.asarray(errors)[
        good
    ]
    row = [
        label,
        f"{good.sum()} of {good.size}",
        *(100 * np.mean(np.abs(pulls) < 1.96, axis=0)),
        100 * within.mean(),
        squared.mean() / pick.size,
    ]
    texts = []
    for name, truth in truths.items():
        value, error = (np.asarray(x)[good] for x in sought[name])
        off = (value - np.broadcast_to(truth, good.shape)[good]) / error
        inside, rms = 100 * np.mean(np.abs(off) < 1.96), np.sqrt(np.mean(off**2))
        texts.append(f"{name} {inside:.1f} ({rms:.2f})")
    print(row, texts, flush=True)
    return [*row, ", ".join(texts)]


def unmodelled(rng, count, size):
    tensors, moved = scene(rng, count, TEN, kick=size * LEVEL)
    values = moved.omega + SIGMA * rng.normal(size=moved.omega.shape)
    label = f"white torque, {size:g} of the noise"
    return covered(label, smoothed, (values,), tensors, {"level": np.log(size * LEVEL)})


def half_a_sample_late(rng, count):
    grid = np.arange(-20, 20 * len(TEN)) * STEP / 20
    start = np.array([1.0, 0.0, 0.0, 0.0])
    tensors, moved = scene(rng, count, grid, attitude0=start)
    values = worlds.gyro((grid, moved.omega), TEN, rng, SIGMA, delay=STEP / 2)
    turned = jax.vmap(
        jax.vmap(lambda q, v: jr.rotation.multiply(q, jr.rotation.exp(v)))
    )
    small = SIGMA * rng.normal(size=values.shape)
    given = values, turned(moved.attitude[:, 20::20], small)
    return covered(
        "gyro half a sample late, beside attitudes",
        delayed,
        given,
        tensors,
        {"delay": STEP / 2},
    )


def saturated(rng, count):
    """One axis for a tenth of the time."""
    tensors, moved = scene(rng, count, TEN)
    values = moved.omega + SIGMA * rng.normal(size=moved.omega.shape)
    limit = np.full((count, 3), 1e3)
    limit[:, 0] = np.quantile(np.abs(moved.omega[..., 0]), 0.9, axis=1)
    values = np.clip(values, -limit[:, None], limit[:, None])
    return covered(
        "one axis saturated a tenth of the time", clipped, (values, limit), tensors, {}
    )


def beside_a_wheel(rng, count, drawn):
    """A second at 100 Hz and 5 rad/s; the wheel is as large as the body's momentum."""
    scale, delay = np.full(count, 1 / 1.01), np.full(count, -0.005)
    if drawn:
        scale, delay = 1 + 0.02 * rng.normal(size=count), 0.005 * rng.normal(size=count)
    profile = functools.partial(
        worlds.wheel_profile, np.array([0.0, 0.6, 0.8]), 3.0, 0.1, 0.6
    )
    tensors, moved = scene(rng, count, SECOND, spin=5.0, wheel=profile()[0])
    values = moved.omega + 0.02 * rng.normal(size=moved.omega.shape)
    predicted = [
        profile(1 / a, -b)[1](CLOCK)[0] for a, b in zip(scale, delay, strict=True)
    ]
    name = "drawn from their priors" if drawn else "1 % and 5 ms"
    return covered(
        f"a wheel's scale and delay: {name}",
        with_wheel,
        (values, np.stack(predicted)),
        tensors,
        {"scale": scale, "delay": delay, "trace": 3.0},
        True,
    )


def cells(count):
    """A table of records that a plain fit does not expect."""
    header = [
        "records",
        "OK",
        "I2/I1 covered %",
        "I3/I1 covered %",
        "elements covered %",
        "normalised error squared",
        "also sought: covered % (RMS / stated)",
    ]
    rows = [
        *(
            unmodelled(np.random.default_rng(7), count, size)
            for size in (0.1, 1.0, 10.0)
        ),
        half_a_sample_late(np.random.default_rng(7), count),
        saturated(np.random.default_rng(7), count),
        *(
            beside_a_wheel(np.random.default_rng(7), count, drawn)
            for drawn in (False, True)
        ),
    ]
    spread = 100 * np.sqrt(0.0475 / count)
    text = f"A standard error of 95 % of {count} records is {spread:.1f} points."
    return common.table(header, rows) + "\n\n" + text


def speed():
    """Milliseconds of a fit, of a thousand, and of compiling one."""
    rows = []
    for label, turns, a_turn in (
        ("200 samples, 10 turns", 10, 20),
        ("2000 samples, 100", 100, 20),
    ):
        _, ts, omegas = record("asymmetric", turns, a_turn)
        values = omegas + 0.01 * np.random.default_rng(0).normal(size=omegas.shape)
        jax.clear_caches()
        start = time.perf_counter()
        jax.block_until_ready(fit(SPHERE, Rates(ts, values, 0.01)).inertia)
        first = (time.perf_counter() - start) * 1e3
        found = common.timed(
            {"": lambda v=values, t=ts: fit(SPHERE, Rates(t, v, 0.01)).inertia}
        )
        least, median, _ = found[""]
        rows.append([label, first - median, least, median])
    _, ts, omegas = record("asymmetric", 10, 20)
    values = omegas + 0.01 * np.random.default_rng(0).normal(size=(1000, *omegas.shape))
    records = [Rates(ts, y, 0.01) for y in values]
    many = lambda: fit_each(SPHERE, records).inertia  # noqa: E731
    jax.clear_caches()
    start = time.perf_counter()
    jax.block_until_ready(many())
    first = (time.perf_counter() - start) * 1e3
    least, median, _ = common.timed({"": many}, 3)[""]
    rows.append(["1000 fits of 200 samples, `fit_each`", first - median, least, median])
    return rows


def peers(turns, count):
    """Success, time and error of each method on the same records."""
    tensor, ts, omegas = record("asymmetric", turns, 20)
    rng = np.random.default_rng(5)
    records = omegas + 0.01 * rng.normal(size=(count, *omegas.shape))
    gate = 1 + 5 * np.sqrt(2 / (records[0].size - 8))

    def unpacked(x):
        body = jr.identify.inertia_from_parameters(jnp.append(0.0, x[:5]))
        return jr.RigidBody(3 * body / jnp.trace(body)), jr.State(UNTURNED, x[5:])

    @jax.jit
    def rows_of(motion, y):
        body, state = motion
        return residuals(body, state, Rates(ts, y, 0.01)).reshape(-1)

    @jax.jit
    def rows_at(x, y):
        return rows_of(unpacked(x), y)

    def by_scipy(y):
        start = np.concatenate([np.zeros(5), y[0]])
        found = scipy.optimize.least_squares(
            lambda x: np.asarray(rows_at(x, y)), start, method="lm", max_nfev=2000
        )
        return unpacked(found.x)

    optimiser = optax.adam(optax.cosine_decay_schedule(0.02, 1500))

    @jax.jit
    def by_adam(y):
        def loss(x):
            return jnp.mean(rows_at(x, y) ** 2)

        def step(carry, _):
            x, state = carry
            updates, state = optimiser.update(jax.grad(loss)(x), state)
            return (optax.apply_updates(x, updates), state), None

        x = jnp.concatenate([jnp.zeros(5), y[0]])
        carry = (x, optimiser.init(x))
        return unpacked(jax.lax.scan(step, carry, None, length=1500)[0][0])

    def by_fit(y):
        found = fit(SPHERE, Rates(ts, y, 0.01), throw=False)
        return found.system, jr.State(UNTURNED, found.state.omega[0])

    rows = []
    true = np.asarray(of_elements(tensor))
    methods = {"jrigid fit": by_fit, "scipy least_squares": by_scipy}
    if turns < 100:
        methods["Adam, 1500 steps"] = by_adam
    for name, method in methods.items():
        jax.block_until_ready(method(records[0]))
        start = time.perf_counter()
        answers = [jax.block_until_ready(method(y)) for y in records]
        each = (time.perf_counter() - start) * 1e3 / count
        chi = [
            np.mean(np.asarray(rows_of(motion, y)) ** 2)
            for motion, y in zip(answers, records, strict=True)
        ]
        errors = [
            np.abs(np.asarray(of_elements(body.inertia)) - true).max()
            for body, _ in answers
        ]
        success = np.array(chi) < gate
        rows.append(
            [
                f"{turns} turns: {name}",
                f"{success.sum()} of {count}",
                each,
                float(np.median(errors)),
            ]
        )
        print(rows[-1], flush=True)
    return rows


def main(write: bool, short: bool, trials: int) -> None:
    compared = peers(10, 10) + peers(100, 3)
    parts = [
        common.table(["one call", "compile ms", "min ms", "median ms"], speed()),
        common.table(
            ["1 % noise, 20 samples a turn", "found", "ms each", "median error"],
            compared,
        ),
    ]
    if not short:
        parts.append(cells(trials))
        rows, apart, silent, worst = grid()
        header = [
            "records",
            "cells",
            "bound, relative",
            "converged %, worst cell",
            "RMS / bound",
            "worst cell",
            "normalised error squared",
            "95 % interval covers %",
            "of which not determined",
        ]
        text = ", ".join(
            f"{cell} ({bound:.2g}; {100 * ok:.0f} %)" for cell, bound, ok in apart
        )
        parts.append(common.table(header, rows))
        parts.append(f"Worst cell: {100 * worst:.1f} % converged.")
        parts.append(
            "Left out, since each fit says that the record does not determine it: "
            + ", ".join(silent)
            + "."
        )
        parts.append(
            "Apart, bound above 0.3 of a ratio (bound; converged): " + text + "."
        )
    packages = ["jax", "diffrax", "optimistix", "optax", "numpy", "scipy"]
    common.report(
        "identify", "Inertia from a noisy gyro", "\n\n".join(parts), packages, write
    )


if __name__ == "__main__":
    parser = common.arguments(__doc__)
    parser.add_argument("--short", action="store_true", help="leave grid and cells out")
    parser.add_argument(
        "--cells", action="store_true", help="print the cells of their own alone"
    )
    parser.add_argument(
        "--trials", type=int, default=200, help="records in each of these"
    )
    given = parser.parse_args()
    if given.cells:
        print(cells(given.trials))
    else:
        main(given.write, given.short, given.trials)
