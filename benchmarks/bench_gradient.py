"""Run times of reverse mode: gradients beside values, and beside hand-written diffrax.

    python benchmarks/bench_gradient.py [--quick] [--write]

The two works of bench_first_call.py. First the gradient of one heavy asymmetric top
(T = 100, rtol 1e-8, in its moments) and of 2,000, relative to their values. Then the
vmapped gradients of 1,000 and 2,000 motions relative to vmapped diffrax (Dopri8): its
time is interpolated between the two tolerances whose errors enclose ours. The errors
are those of the first 100 motions. `--quick` leaves out the 2,000 beside diffrax.
"""

import functools

import bench_first_call as first
import common
import jax
import jax.numpy as jnp
import numpy as np

STARTS = np.random.default_rng(0).normal(size=(2000, 3))


def relative_to_value(work, omega):
    """Row of the first table."""
    kind = "vmapped " if omega.ndim == 2 else ""
    inputs = jnp.asarray(work.parameter), jnp.asarray(omega)
    cases = {}
    for what in ("value", "gradient"):
        function = first.program(kind + what, work.ours, first.RTOL, False)
        compiled = jax.jit(function).lower(*inputs).compile()
        cases[what] = lambda compiled=compiled: compiled(*inputs)
    times = first.turns(cases)
    value, gradient = times["value"], times["gradient"]
    who = f"{len(omega)} motions" if kind else "one motion"
    target = 5 if kind else 6
    ratios = gradient.wall / value.wall, gradient.wall_median / value.wall_median
    return [who, value.wall, gradient.wall, *ratios, gradient.cpu / value.cpu, target]


def beside_diffrax(work, sizes):
    """Rows of the second table."""
    what = "vmapped gradient"
    ours = jax.jit(first.program(what, work.ours, first.RTOL, False))

    def at(tolerance, *inputs):
        return first.program(what, work.peer, tolerance, False)(*inputs)

    peer = jax.jit(at)

    def inputs(lanes):
        return jnp.asarray(work.parameter), jnp.asarray(STARTS[:lanes])

    fewest = first.ERROR_LANES
    reference = peer(first.REFERENCE_TOLERANCE, *inputs(fewest))

    def error_of(outputs):
        return first.relative_error(outputs, reference, fewest)

    error = error_of(ours(*inputs(fewest)))
    near = first.enclosing(
        lambda exponent: error_of(peer(10.0**-exponent, *inputs(fewest))), error
    )
    rows = []
    for lanes in sizes:
        given = inputs(lanes)
        cases = {"ours": functools.partial(ours, *given)}
        cases |= {x: functools.partial(peer, 10.0**-x, *given) for x in near}
        times = first.turns(cases)
        equal = first.at_equal_error(near, {x: times[x].wall for x in near}, error)
        span = " to ".join(f"1e-{x}" for x in near)
        wall = times["ours"].wall
        rows.append([work.title, lanes, wall, error, equal, span, wall / equal, 0.25])
    return rows


def main():
    parser = common.arguments(__doc__)
    parser.add_argument("--quick", action="store_true", help="no 2,000 beside diffrax")
    options = parser.parse_args()
    top = first.WORKS["top"]
    header = [
        "heavy asymmetric top, T = 100",
        "value ms, min",
        "gradient ms, min",
        "ratio of minima",
        "of medians",
        "of CPU times",
        "target",
    ]
    rows = [relative_to_value(top, omega) for omega in (STARTS[0], STARTS)]
    text = common.table(header, rows)
    header = [
        "vmapped gradient",
        "lanes",
        "jrigid ms, min",
        "error, median",
        "diffrax ms at that error",
        "its tolerances",
        "ratio",
        "target",
    ]
    sizes = [1000] if options.quick else [1000, 2000]
    rows = [row for x in first.WORKS.values() for row in beside_diffrax(x, sizes)]
    text += "\n\n" + common.table(header, rows)
    packages = ["jax", "diffrax", "equinox", "numpy"]
    common.report_by_jax(
        "gradient", "Run times of gradients", text, packages, options.write
    )


if __name__ == "__main__":
    main()
