"""Inversion to a spin and a convex shape, beside DAMIT's convexinv.

    python benchmarks/bench_convex.py FOLDER [--write] [--repeats 3]

FOLDER is a copy of https://github.com/mkretlow/DAMIT-convex (CC-BY-4.0) with the
programs of its folders `convexinv`, `fortran` and `lcgenerator` built there. Its test
asteroid is (43) Ariadne: 37 relative light curves of 1,541 points. Both programs search
the same range of periods with harmonics to degree 6 and 512 facets, and then refine to
the end: `period_scan` and `convexinv`, and `find_spin`, whose solutions have 2048.

The package makes its own model of the asteroid with `convexinv`, `minkowski` and
`standardtri`. The brightness of that model by `light_curve` is compared with that by
`lcgenerator` at all epochs.
"""

import pathlib
import re
import resource
import subprocess
import tempfile
import time

import common
import jax.numpy as jnp
import numpy as np

from jrigid import photometry as ph

HOUR = 3600.0
SHORTEST, LONGEST = 5.7615, 5.7625  # h, the range of the package's own example
# convexinv_doc.pdf of the package: the best solution of the relative curves. The other
# pole is its mirror.
PERIOD = 5.761985  # h
POLES = ((253.0, -15.0), (73.0, -15.0))
# Starting poles of convexinv [deg], as many as its scan of periods has.
STARTS = ((0, 0), (180, 0), (90, 60), (240, 60), (90, -60), (240, -60))
ROUNDING = 0.5e-6  # of lcgenerator, which writes six decimals


def seconds_of(command, text, folder):
    """Standard output of a program, and its CPU seconds."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    run = subprocess.run(
        command, input=text, cwd=folder, capture_output=True, text=True, check=True
    )
    return run.stdout, resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before


def by_convexinv(package, scratch):
    """Period, pole and deviation of convexinv's best solution, and its CPU seconds.

    The scan takes 50 steps for each period and pole, and each of six poles is refined
    by 300 steps from the best period.
    """
    curves = (package / "test_lcs_rel").read_text()
    scan = (package / "input_period_scan").read_text()
    (scratch / "scan").write_text(scan)
    command = [package / "convexinv" / "period_scan", "scan", "periods"]
    _, seconds = seconds_of(command, curves, scratch)
    periods = np.loadtxt(scratch / "periods")
    best = periods[np.argmin(periods[:, 1]), 0]
    solutions = []
    lines = (package / "input_convexinv").read_text().splitlines()
    for longitude, latitude in STARTS:
        head = [f"{longitude} 1", f"{latitude} 1", f"{best} 1"]
        (scratch / "fit").write_text("\n".join([*head, *lines[3:-1], "300"]) + "\n")
        command = [package / "convexinv" / "convexinv", "-v", "fit", "curves"]
        output, more = seconds_of(command, curves, scratch)
        seconds += more
        words = output.split("lambda, beta and period (hrs):")[1].split()
        deviation = float(output.split(" dev ")[-1].split()[0])
        solutions.append((deviation, *(float(x) for x in words[:3])))
    return min(solutions), len(periods), seconds


def write_model(package, scratch):
    """Write the spin and the shape that the package's example of convexinv ends with.

    convexinv gives areas and normals of facets. minkowski makes a polyhedron of them,
    and standardtri cuts its faces into triangles.
    """
    curves = (package / "test_lcs_rel").read_text()
    command = [package / "convexinv" / "convexinv", "-o", "areas", "-p", "spin"]
    command += [package / "input_convexinv", "curves"]
    seconds_of(command, curves, scratch)
    areas = (scratch / "areas").read_text()
    polyhedron, _ = seconds_of([package / "fortran" / "minkowski"], areas, scratch)
    command = [package / "fortran" / "standardtri"]
    triangles, _ = seconds_of(command, polyhedron, scratch)
    (scratch / "shape").write_text(triangles)


def model_of(scratch):
    """Epoch, state, shape and scattering law of the files of `write_model`."""
    numbers = [float(x) for x in (scratch / "spin").read_text().split()]
    longitude, latitude, period, epoch, angle, *phase, lambert = numbers
    pole = np.deg2rad([longitude, latitude])
    state = ph.state_of_pole(pole[0], pole[1], period * HOUR, np.deg2rad(angle))
    law = ph.Mixture(*(jnp.asarray(x) for x in (lambert, *phase)))
    return epoch, state, ph.read_shape(scratch / "shape"), law


def compare_brightness(package, scratch):
    """A row of the table of brightness: the package's own model at all epochs."""
    write_model(package, scratch)
    # lcgenerator divides a relative curve by its mean, so all are made absolute.
    relative = (package / "test_lcs_rel").read_text()
    text = re.sub(r"(?m)^(\d+) 0 *$", r"\1 1", relative)
    command = [package / "lcgenerator" / "lcgenerator", "spin", "shape", "light"]
    seconds_of(command, text, scratch)
    theirs = np.loadtxt(scratch / "light")
    epoch, state, shape, law = model_of(scratch)
    curves = ph.read_light_curves(package / "test_lcs_rel", epoch=epoch)
    ours = ph.light_curve(
        np.ones(3),  # a steady rotation is the same for all moments
        state,
        np.concatenate([x.ts for x in curves]),
        np.concatenate([x.to_sun for x in curves]),
        np.concatenate([x.to_observer for x in curves]),
        shape,
        law,
        light_time=False,  # the file is corrected for it
    )
    return [
        len(theirs),
        len(shape.areas),
        f"{theirs.min():.2f} to {theirs.max():.2f}",
        f"{ROUNDING / theirs.min():.1e}",
        f"{np.max(np.abs(ours / theirs - 1)):.1e}",
    ]


def by_jrigid(curves, **options):
    """The inversion and its CPU seconds."""
    start = time.process_time()
    found = ph.find_spin(
        curves, shortest=SHORTEST * HOUR, longest=LONGEST * HOUR, **options
    )
    return found, time.process_time() - start


def apart(first, second):
    """Angle between two poles, all in degrees."""
    ends = []
    for longitude, latitude in np.deg2rad([first, second]):
        across = np.cos(latitude)
        ends.append(
            [across * np.cos(longitude), across * np.sin(longitude), np.sin(latitude)]
        )
    return float(np.rad2deg(np.arccos(np.dot(*ends))))


def row(name, period, error, pole, deviation, seconds):
    """A row of the table of solutions."""
    near = min(apart(pole, x) for x in POLES)
    return [
        name,
        f"{period:.6f}" + ("" if error is None else f" +- {error:.6f}"),
        f"{1e6 * (period - PERIOD):+.1f}",
        f"{pole[0] % 360:.1f}, {pole[1]:+.1f}",
        f"{near:.1f}",
        f"{deviation:.4f}",
        seconds,
    ]


def rows_of(name, found, seconds):
    """Rows of the solutions of one inversion."""
    rows = []
    mirror = found.mirror
    others = [] if mirror is None else [("its mirror", mirror)]
    for text, spin in [("best", found.solutions[0]), *others]:
        x = spin.estimates
        # Residuals in magnitudes, as relative deviations.
        deviation = np.sqrt(np.mean(spin.residuals**2)) * 0.4 * np.log(10)
        rows.append(
            row(
                f"{name}, {text}",
                float(x.period) / HOUR,
                float(spin.errors.period) / HOUR,
                np.rad2deg([float(x.longitude), float(x.latitude)]),
                float(deviation),
                seconds if text == "best" else None,
            )
        )
    return rows


def shown(times):
    """Minimum and median."""
    return f"{min(times):.0f}, {np.median(times):.0f}"


def main(package, repeats, write):
    """Measure and report."""
    curves = ph.read_light_curves(package / "test_lcs_rel")
    ours = []
    theirs = []
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(repeats):
            found, seconds = by_jrigid(curves)
            ours.append(seconds)
            theirs.append(by_convexinv(package, pathlib.Path(folder)))
            print("jrigid", ours, "convexinv", theirs, flush=True)
        light = compare_brightness(package, pathlib.Path(folder))
    found, seconds = by_jrigid(curves)
    first = ours[0]
    ours = [*ours[1:], seconds]
    best, periods, _ = theirs[-1]
    table = rows_of("`find_spin`", found, shown(ours))
    deviation, longitude, latitude, period = best
    pole = (longitude, latitude)
    table.append(
        row("convexinv", period, None, pole, deviation, shown([x[-1] for x in theirs]))
    )
    for degree in (4, 8):
        other, seconds = by_jrigid(curves, degree=degree)
        table += rows_of(f"`find_spin`, degree {degree}", other, None)[:1]
    header = [
        "program",
        "period [h]",
        "less the published one [1e-6 h]",
        "pole [deg]",
        "from a published pole [deg]",
        "rms relative residual",
        "CPU s, min, median",
    ]
    header_of_light = [
        "epochs",
        "facets",
        "brightness",
        "largest relative rounding by lcgenerator",
        "largest relative deviation",
    ]
    span = float(np.ptp(np.concatenate([x.ts for x in curves]))) / HOUR
    # `find_spin` tries a period every 0.4 turns within the span.
    trials = round(span * (1 / SHORTEST - 1 / LONGEST) / 0.4) + 1
    separation = 0.5 * PERIOD**2 / (float(np.ptp([x.ts[0] for x in curves])) / HOUR)
    text = (
        "The command takes the folder of DAMIT's package, as its docstring says.\n\n"
        "The test asteroid of DAMIT's package, (43) Ariadne, from its relative light "
        "curves. Published with the package (convexinv_doc.pdf, without errors): "
        f"period {PERIOD} h, pole {POLES[0]}, rms 0.016; {POLES[1]} is the mirror of "
        "that pole.\n\n"
        + common.table(header, table)
        + f"\n\nRange of periods: {SHORTEST} to {LONGEST} h, in which period_scan "
        f"takes {periods} trial periods with 6 poles and 50 steps, and `find_spin` "
        f"{trials} with 24 poles. Neighbouring minima of chi-square are "
        f"{1e6 * separation:.0f}e-6 h apart. convexinv then takes 300 steps from each "
        f"of 6 poles. Times: {repeats} runs in turns, of `find_spin` without the first "
        f"one, which compiles and took {first:.0f} CPU s.\n\n"
        "Brightness by `light_curve`, compared with that by lcgenerator, which writes "
        "six decimals. The spin and the shape are those that the package's example of "
        "convexinv ends with. The brightness is in the unit of area of the shape.\n\n"
        + common.table(header_of_light, [light])
    )
    title = "Inversion to a spin and a convex shape"
    common.report("convex", title, text, ["jax", "numpy"], write)


if __name__ == "__main__":
    parser = common.arguments(__doc__)
    parser.add_argument("folder", type=pathlib.Path)
    parser.add_argument("--repeats", type=int, default=3)
    given = parser.parse_args()
    main(given.folder.resolve(), given.repeats, given.write)
