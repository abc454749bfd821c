"""Error at the end against time, at tolerances from 1e-4 to 1e-14, of five bodies.

    taskset -c 1 python benchmarks/bench_accuracy.py [--write] [--lanes N]

I = (1, 2, 3), attitudes at random, |omega| from 1 to 2 rad/s, T = 20: one body at a
time (the mean of eight) and 10,000. Peers: hand-written diffrax, scipy's `solve_ivp`,
heyoka (one body: its scalar integrator, many: its batch integrator) and, for the free
body, MuJoCo's RK4 with its steps in place of tolerances. `--write` draws
docs/images/accuracy_*.png too. Run it on one core: heyoka is timed on one thread.
"""

import functools
import math
import pathlib
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import common
import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import peers

import jrigid as jr

MOMENTS, END, SINGLES, CHECKED = (1.0, 2.0, 3.0), 20.0, 8, 256
TOLERANCES = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12, 1e-14)
STEPS = (100, 300, 1000, 3000, 10_000, 30_000)  # of MuJoCo
TARGETS = (1e-6, 1e-9, 1e-12)
WEIGHT, LEVER, LINEAR, QUADRATIC = 0.3, (0.3, 0.1, 0.5), 0.03, 0.03
ORBIT_RATE, WHEEL = 0.2, (0.3, -0.5, 0.8)
IMAGES = pathlib.Path(__file__).parent.parent / "docs" / "images"
# Colour and marker, by tool.
LOOKS = {
    "jrigid.simulate": ("black", "o"),
    "jrigid.free_rotation": ("black", "*"),
    "diffrax Tsit5": ("#56B4E9", "v"),
    "diffrax Dopri8": ("#0072B2", "^"),
    "scipy DOP853": ("#E69F00", "s"),
    "scipy LSODA": ("#D55E00", "D"),
    "heyoka": ("#009E73", "P"),
    "MuJoCo RK4": ("#CC79A7", "X"),
}


# The bodies: in jrigid, and their torques for numbers, arrays and symbols
# ----------------------


def cross(a, b):
    return [a[i] * b[j] - a[j] * b[i] for i, j in ((1, 2), (2, 0), (0, 1))]


def no_torque(_maths, _t, _w, _attitude):
    return [0.0, 0.0, 0.0]


def weight(_maths, _t, _w, attitude):
    a, b, c, d = attitude
    down = [2 * (a * c - b * d), -2 * (c * d + a * b), b * b + c * c - a * a - d * d]
    return [WEIGHT * x for x in cross(LEVER, down)]


def drag(maths, _t, w, _attitude):
    slowing = LINEAR + QUADRATIC * maths.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    return [-slowing * x for x in w]


def gravity_gradient(maths, t, _w, attitude):
    (a, b, c, d), x, y = attitude, maths.cos(ORBIT_RATE * t), maths.sin(ORBIT_RATE * t)
    outwards = [
        (a * a + b * b - c * c - d * d) * x + 2 * (b * c + a * d) * y,
        2 * (b * c - a * d) * x + (a * a - b * b + c * c - d * d) * y,
        2 * (b * d + a * c) * x + 2 * (c * d - a * b) * y,
    ]
    pull = cross(outwards, [m * n for m, n in zip(MOMENTS, outwards, strict=True)])
    return [3 * ORBIT_RATE**2 * x for x in pull]


def wheel(_maths, _t, w, _attitude):
    return cross(WHEEL, w)


def orbit(t):
    angle = ORBIT_RATE * t
    return jnp.stack([jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)])


class Case(NamedTuple):
    """A body of jrigid and its torque for peers."""

    name: str
    body: jr.RigidBody
    torque: Callable[..., list[Any]]

    def rates(self, maths, t, *z):
        """Of angular velocity and attitude; `maths` has their sin, cos and sqrt."""
        (p, q, r), (a, b, c, d) = z[:3], z[3:7]
        gyroscopic = cross([m * x for m, x in zip(MOMENTS, z[:3], strict=True)], z[:3])
        torque = self.torque(maths, t, z[:3], z[3:7])
        spin_up = [
            (x + y) / m for x, y, m in zip(gyroscopic, torque, MOMENTS, strict=True)
        ]
        turning = (
            -b * p - c * q - d * r,
            a * p + c * r - d * q,
            a * q + d * p - b * r,
            a * r + b * q - c * p,
        )
        return [*spin_up, *(0.5 * x for x in turning)]

    def rates_and_radians(self, maths, t, *z):
        """And of the angle turned."""
        p, q, r = z[:3]
        return [*self.rates(maths, t, *z), maths.sqrt(p * p + q * q + r * r)]


def cases():
    torques, linear, quadratic = jr.torques, jnp.asarray(LINEAR), jnp.asarray(QUADRATIC)
    all_of = (
        ("free", None, no_torque),
        ("heavy", torques.UniformGravity(WEIGHT, LEVER, (0.0, 0.0, -1.0)), weight),
        (
            "dragged",
            torques.LinearDrag(linear) + torques.QuadraticDrag(quadratic),
            drag,
        ),
        (
            "gravity gradient",
            torques.GravityGradient(ORBIT_RATE**2, orbit),
            gravity_gradient,
        ),
        ("with a rotor", torques.Rotor(WHEEL), wheel),
    )
    moments = np.array(MOMENTS)
    return [
        Case(name, jr.RigidBody(moments, torque), peer) for name, torque, peer in all_of
    ]


def starts_of(lanes):
    """Angular velocities and attitudes (lanes, 7)."""
    random = np.random.default_rng(0)
    omega, attitude = random.normal(size=(lanes, 3)), random.normal(size=(lanes, 4))
    omega *= random.uniform(1.0, 2.0, (lanes, 1)) / np.linalg.norm(
        omega, axis=1, keepdims=True
    )
    return np.concatenate(
        [omega, attitude / np.linalg.norm(attitude, axis=1, keepdims=True)], 1
    )


def check_rates(case, starts):
    """Peers integrate the equations that jrigid integrates."""
    for t, z in enumerate(starts[:20]):
        rate = case.body.vector_field(float(t), jr.State(z[3:], z[:3]), None)
        ours = np.concatenate([rate.omega, rate.attitude])
        np.testing.assert_allclose(
            case.rates(math, float(t), *z.tolist()), ours, 0, 1e-14
        )


# The reference, and errors
# --------------------------------------------------------------------


class Truth(NamedTuple):
    """Reference states, radians turned, which are regular, how far references differ.

    Regular: what disturbs the start grows by no more than 1 + radians.
    """

    ends: np.ndarray
    radians: np.ndarray
    regular: np.ndarray
    doubt: float


def errors_of(ends, starts, truth):
    """Of each body, the larger error of q (or -q) and of omega / |omega(0)|."""
    count = min(len(ends), len(truth))
    ends, truth = np.asarray(ends)[:count], truth[:count]
    unit = np.linalg.norm(starts[:count, :3], axis=1)
    rates = np.linalg.norm(ends[:, :3] - truth[:, :3], axis=1) / unit
    sign = np.sign(np.sum(ends[:, 3:] * truth[:, 3:], axis=1, keepdims=True))
    return np.maximum(rates, np.linalg.norm(sign * ends[:, 3:] - truth[:, 3:], axis=1))


def tight(case, starts, tolerance=1e-19):
    """States at the end, and radians: by heyoka in long double, else by scipy."""
    begin, hy = (
        np.concatenate([starts, np.zeros((len(starts), 1))], 1),
        peers.package("heyoka"),
    )
    if hy is not None:
        rates = functools.partial(case.rates_and_radians, hy, hy.time)
        run, _ = peers.by_heyoka_singly(rates, begin, END, tolerance, np.longdouble)
    else:
        rates = functools.partial(case.rates_and_radians, math)
        run, _ = peers.by_scipy(rates, begin, END, tolerance, "DOP853")
    if run is None:
        raise SystemExit("There is no reference without heyoka or scipy.")
    ends = run()
    return ends[:, :7], ends[:, 7]


def truth_of(case, starts):
    """The reference, beside itself with other steps or beside diffrax."""
    ends, radians = tight(case, starts)
    if peers.package("heyoka") is not None:
        others, _ = tight(case, starts, 1e-17)
    else:
        others = jax.jit(jax.vmap(by_diffrax(case, diffrax.Dopri8()), (0, None)))(
            starts, 1e-14
        )
    growth = np.zeros(len(starts))
    for seed in range(3):
        aside = np.random.default_rng(seed).normal(size=starts.shape)
        aside *= 1e-8 / np.linalg.norm(aside, axis=1, keepdims=True)
        growth = np.maximum(
            growth, 1e8 * errors_of(tight(case, starts + aside)[0], starts, ends)
        )
    radians, doubt = (
        radians.astype(float),
        float(np.max(errors_of(others, starts, ends))),
    )
    return Truth(ends.astype(float), radians, growth < 1 + radians, doubt)


# The tools
# ------------------------------------------------------------------------------------


def by_jrigid(case):
    def end(z, rtol):
        state = jr.State(z[3:], z[:3])
        last = jr.simulate(case.body, state, END, rtol=rtol, throw=False).final_state
        return jnp.concatenate([last.omega, last.attitude])

    return end


def by_closed_form(z, _tolerance):
    last = jr.free_rotation(
        jnp.asarray(MOMENTS), jr.State(z[3:], z[:3]), END, throw=False
    )
    return jnp.concatenate([last.omega, last.attitude])


def by_diffrax(case, solver):
    rates = functools.partial(case.rates, jnp)
    return lambda z, tolerance: peers.by_diffrax(
        rates, z, END, tolerance, solver, timed=True
    )


class Curve:
    """Runs of a tool at one tolerance after the other: errors and least times."""

    def __init__(self, make: Callable[[Any], Any], knobs: Sequence[Any], starts, truth):
        """`make` builds a run; a compile time of None is that of a first call."""
        self.runs, self.errors, self.times, self.compile_ms = [], [], [], 0.0
        self.bodies = len(starts)
        for run, built in map(make, knobs):
            if run is None:  # the tool is missing
                break
            first, ends = milliseconds(run)
            again = milliseconds(run)[0]
            self.compile_ms = max(
                self.compile_ms, first - again if built is None else built
            )
            self.errors.append(errors_of(ends, starts, truth.ends))
            self.times.append(again)
            self.runs.append(run)

    def run_again(self, budget=20.0):
        """Each run, for so many milliseconds."""
        for i, run in enumerate(self.runs):
            spent = 0.0
            while spent < budget:
                again = milliseconds(run)[0]
                self.times[i], spent = min(self.times[i], again), spent + again

    def points(self, bodies):
        """Median errors, and times for so many bodies, of runs that did not fail."""
        share = bodies / self.bodies
        pairs = zip((np.median(x) for x in self.errors), self.times, strict=True)
        some = [(error, share * ms) for error, ms in pairs if np.isfinite(error)]
        return np.reshape(some, (-1, 2))


class Measured(NamedTuple):
    """Errors and times [ms] of one body and of many, and the error of each."""

    one: np.ndarray
    many: np.ndarray
    compile_ms: float
    errors: list[np.ndarray]


def milliseconds(run):
    start = time.perf_counter()
    answer = np.asarray(run())
    return 1e3 * (time.perf_counter() - start), answer


def needed(points, target):
    """The time for an error, between two tolerances; None if it is not reached."""
    below = np.flatnonzero(points[:, 0] <= target)
    if not below.size:
        return None
    last = below[0]
    if last == 0:
        return float(points[0, 1])
    (x, y), (error, ms) = np.log(points[last - 1]), np.log(points[last])
    return float(np.exp(y + (ms - y) * (np.log(target) - x) / (error - x)))


def compiled(end, starts, truth, knobs=TOLERANCES):
    """One body and many, of a function (state, tolerance) -> state at the end."""
    eight, one, many = starts[:SINGLES], jax.jit(end), jax.jit(jax.vmap(end, (0, None)))
    singly = lambda x: (lambda: [np.asarray(one(z, x)) for z in eight], None)  # noqa: E731
    together = lambda x: (lambda: many(starts, x), None)  # noqa: E731
    return Curve(singly, knobs, eight, truth), Curve(together, knobs, starts, truth)


def repeated(*arguments):
    """One body, and the same for many, which are run one by one."""
    curve = Curve(*arguments)
    return curve, curve


def curves_of(case, starts, truth):
    """Curves of one body and of many, by tool; without tools that are missing."""
    eight, some = starts[:SINGLES], starts[: -(-len(starts) // 10)]
    found = {"jrigid.simulate": compiled(by_jrigid(case), starts, truth)}
    if case.name == "free":
        found["jrigid.free_rotation"] = compiled(
            by_closed_form, starts, truth, TOLERANCES[-1:]
        )
        mujoco = lambda n: peers.by_mujoco(MOMENTS, eight, END, n)  # noqa: E731
        found["MuJoCo RK4"] = repeated(mujoco, STEPS, eight, truth)
    for name, solver in (("Tsit5", diffrax.Tsit5()), ("Dopri8", diffrax.Dopri8())):
        knobs = TOLERANCES[:-1] if name == "Tsit5" else TOLERANCES
        found[f"diffrax {name}"] = compiled(
            by_diffrax(case, solver), some, truth, knobs
        )
    rates = functools.partial(case.rates, math)
    for method in ("DOP853", "LSODA"):
        make = lambda x, m=method: peers.by_scipy(rates, eight, END, x, m)  # noqa: E731
        found[f"scipy {method}"] = repeated(make, TOLERANCES, eight, truth)
    hy = peers.package("heyoka")
    rates = functools.partial(case.rates, hy, hy and hy.time)
    singly = lambda x: peers.by_heyoka_singly(rates, eight, END, x)  # noqa: E731
    batch = lambda x: peers.by_heyoka(rates, starts, END, x)  # noqa: E731
    found["heyoka"] = (
        Curve(singly, TOLERANCES, eight, truth),
        Curve(batch, TOLERANCES, starts, truth),
    )
    return {name: both for name, both in found.items() if both[0].runs}


def measured(case, starts, truth, rounds=3):
    """All tools that are there, which take turns."""
    found = curves_of(case, starts, truth)
    for _ in range(rounds):
        for curve in dict.fromkeys(x for both in found.values() for x in both):
            curve.run_again()
    return {
        name: Measured(
            one.points(1),
            many.points(len(starts)),
            max(one.compile_ms, many.compile_ms),
            many.errors,
        )
        for name, (one, many) in found.items()
    }


# Tables and pictures
# --------------------------------------------------------------------------


def rows_of(case, found):
    rows = []
    for name in (x for x in LOOKS if x in found):
        one, many, compile_ms, _ = found[name]
        seconds = many * (1.0, 1e-3)
        times = [needed(x, target) for x in (one, seconds) for target in TARGETS]
        rows.append(
            [case.name, name, compile_ms or None, *times, float(one[:, 0].min())]
        )
    return rows


def promised(case, truth, all_errors):
    """Errors of jrigid in parts of what it promises of regular motions: the worst."""
    worst = []
    for rtol, errors in zip(TOLERANCES, all_errors, strict=True):
        bar = max(10 * rtol, 100 * np.finfo(float).eps) * (1 + truth.radians)
        worst.append(float(np.max((errors / bar)[truth.regular])))
    radians, regular = float(np.median(truth.radians)), int(np.sum(truth.regular))
    return [case.name, radians, truth.doubt, regular, *worst]


def picture(path, title, unit, panels, extrapolated=()):
    """Five panels of time against error, and the legend in the place of a sixth."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(2, 3, figsize=(11, 6.8), sharex=True, sharey=True)
    shown = {}
    for ax, (name, found) in zip(axes.flat, panels.items(), strict=False):
        for tool in (x for x in reversed(LOOKS) if x in found):
            colour, marker = LOOKS[tool]
            (shown[tool],) = ax.plot(
                *(found[tool] * (1.0, {"ms": 1.0, "s": 1e-3}[unit])).T,
                color=colour,
                marker=marker,
                linestyle=""
                if marker == "*"
                else "--"
                if tool in extrapolated
                else "-",
                markersize=12 if marker == "*" else 5.5,
                linewidth=2.2 if colour == "black" else 1.4,
            )
        ax.set_title(name, fontweight="bold")
        ax.set(xscale="log", yscale="log", xlim=(1e-1, 1e-16))
        ax.grid(color="0.9")
        ax.tick_params(labelbottom=True)
    for ax in axes[:, 0]:
        ax.set_ylabel(f"time [{unit}]")
    for ax in (*axes[1, :2], axes[0, 2]):
        ax.set_xlabel("error at the end")
    axes.flat[5].axis("off")
    tools = [x for x in LOOKS if x in shown]
    words = [f"{x}, one body × N" if x in extrapolated else x for x in tools]
    axes.flat[5].legend([shown[x] for x in tools], words, loc="center", frameon=False)
    figure.suptitle(title)
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def pictures(results, lanes):
    if peers.package("matplotlib") is None:
        return
    IMAGES.mkdir(exist_ok=True)
    title = "{} to T = 20, 20 to 30 rad, on one core: better is lower and further right"
    one, many = (
        {
            case: {tool: x[i] for tool, x in found.items()}
            for case, found in results.items()
        }
        for i in range(2)
    )
    picture(IMAGES / "accuracy_one.png", title.format("One body"), "ms", one)
    repeated = ("scipy DOP853", "scipy LSODA", "MuJoCo RK4")
    title = title.format(f"{lanes:,} bodies")
    picture(IMAGES / "accuracy_many.png", title, "s", many, repeated)


def main(lanes, write):
    starts, results, rows, promises = starts_of(lanes), {}, [], []
    for case in cases():
        check_rates(case, starts)
        truth = truth_of(case, starts[:CHECKED])
        found = results[case.name] = measured(case, starts, truth)
        rows += rows_of(case, found)
        promises.append(promised(case, truth, found["jrigid.simulate"].errors))
    powers = [f"{x:.0e}".replace("e-0", "e-") for x in TARGETS]
    header = ["body", "tool", "compile ms", *(f"one, ms: {x}" for x in powers)]
    header += [*(f"{lanes}, s: {x}" for x in powers), "least error"]
    reference, other = "scipy's DOP853 at its tightest", "diffrax's Dopri8"
    if peers.package("heyoka") is not None:
        reference, other = "heyoka in long double", "itself with longer steps"
    text = f"""\
The time for a median error of the state at the end (the larger of those of the
quaternion and of omega / |omega(0)|), between two tolerances; empty where it is not
reached. Of diffrax's many a tenth is run, of scipy's and MuJoCo's eight.

{common.table(header, rows)}

The worst error of jrigid in parts of what it promises, 10 rtol (at least 100 eps) times
1 + radians, among those of {min(CHECKED, lanes)} bodies that are regular (a disturbance
grows by no more than 1 + radians). The reference is {reference}: the third column is
how far it is from {other}.

"""
    header = ["body", "radians, median", "reference", "regular"]
    text += common.table([*header, *(f"{x:.0e}" for x in TOLERANCES)], promises)
    optional = [
        x for x in ("scipy", "heyoka", "mujoco") if peers.package(x) is not None
    ]
    title = "Error against time, for five kinds of body"
    common.report(
        "accuracy", title, text, ["jax", "diffrax", "numpy", *optional], write
    )
    if write:
        pictures(results, lanes)


if __name__ == "__main__":
    parser = common.arguments(__doc__)
    parser.add_argument("--lanes", type=int, default=10_000)
    options = parser.parse_args()
    main(options.lanes, options.write)
