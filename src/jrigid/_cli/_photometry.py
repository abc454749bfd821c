"""The command `jrigid photometry curves.txt --report`."""

import argparse
import os
import pathlib
from collections.abc import Callable
from typing import Any

import numpy as np

from jrigid import photometry, plot
from jrigid._checks import demand
from jrigid._cli._arguments import count, numbers, picture

_HOUR = 3600.0
_DAY = 86400.0
# Faster asteroids of more than some hundred metres would fly apart: P. Pravec and
# A. W. Harris, Icarus 148 (2000) 12.
_SHORTEST = 2.0  # h
# Exact, by the definition of the International Astronomical Union of 2012.
_AU = 149597870700.0  # m
# Of the first word of an ALCDEF file.
_ALCDEF = "STARTMETADATA"
_MODES = ("principal-axis", "short-axis", "long-axis")
_ELEMENTS = "A,E,I,NODE,PERIHELION,ANOMALY,EPOCH"
# Exit statuses, those of a fit with the same meaning.
_DETERMINED = 0
_SEVERAL = 3
_MISFIT = 4
# Patterns of what reports and errors say of arguments in Python, and the options of the
# command line that set them.
OPTIONS = (
    (r"`curves`", "`path`"),
    (r"`shortest`", "`--shortest`"),
    (r"`longest`", "`--longest`"),
    (r"`noise`", "`--noise`"),
    (r"`pairs`", "`--pairs`"),
    (r"`inertia='free'`", "`--inertia free`"),
    (r"`time_scale`", "`--time-scale`"),
    (r": pass positions of your own for an open orbit", ""),
    (
        r"`(semi_major_axis|eccentricity|inclination|node|argument_of_perihelion"
        r"|mean_anomaly|epoch)`",
        r"`--orbit` (\1)",
    ),
)


def add_command(commands: Any) -> argparse.ArgumentParser:
    """Add the command to the subparsers of `jrigid`."""
    command: argparse.ArgumentParser = commands.add_parser(
        "photometry",
        help="periods and tumblers that explain light curves",
        description="Pairs of periods that may explain light curves, in seconds; or "
        "with --report the tumbling ellipsoids that do, in minutes.",
        epilog=f"Exit status with --report: {_DETERMINED} one pair of periods and one "
        "mode explain the curves (the report says how many directions of the angular "
        f"momentum do), {_SEVERAL} several do, {_MISFIT} none was found; 1 for a file "
        "or a value that cannot be used, 2 for arguments that cannot be read.",
    )
    command.add_argument(
        "path",
        help="light curves in the format of DAMIT and convexinv, with vectors to Sun "
        "and Earth; or an ALCDEF file, with --orbit",
    )
    command.add_argument(
        "--shortest",
        type=float,
        default=_SHORTEST,
        metavar="HOURS",
        help=f"shortest period ({_SHORTEST:g})",
    )
    command.add_argument(
        "--longest",
        type=float,
        metavar="HOURS",
        help="longest period; without it, the time that the curves span",
    )
    command.add_argument(
        "--orbit",
        type=_elements,
        metavar=_ELEMENTS,
        help="of an ALCDEF file: semi-major axis [au], eccentricity, inclination, "
        "node, argument of perihelion and mean anomaly [degrees, ecliptic of J2000], "
        "Julian date of the anomaly",
    )
    command.add_argument(
        "--time-scale",
        metavar="SCALE",
        help="of the dates of an ALCDEF file: tdb (without it), tt, tai or utc, which "
        "need astropy",
    )
    _add_options_of_inversion(command)
    return command


def _add_options_of_inversion(command: argparse.ArgumentParser) -> None:
    """Add what says how tumblers are sought and what becomes of them."""
    command.add_argument(
        "--report", action="store_true", help="find the tumblers, with errors"
    )
    command.add_argument(
        "--noise",
        type=float,
        metavar="MAG",
        help="of a point; else that of the file, or it is estimated",
    )
    command.add_argument(
        "--mode",
        action="append",
        choices=_MODES,
        help="kind of motion to try, any number; all without it",
    )
    command.add_argument(
        "--inertia",
        choices=("homogeneous", "free"),
        default="homogeneous",
        help="whether the moments are those of the ellipsoid that is seen",
    )
    command.add_argument(
        "--pairs", type=count, default=100, help="pairs of periods to try (100)"
    )
    command.add_argument(
        "--plot",
        type=picture,
        metavar="PNG",
        help="with --report, where to draw curves and best tumbler (needs matplotlib)",
    )


def _elements(text: str) -> list[float]:
    """Seven numbers: the elements of an orbit in the units of catalogues."""
    elements = numbers(text)
    if len(elements) != len(_ELEMENTS.split(",")):
        raise argparse.ArgumentTypeError(f"{_ELEMENTS} are seven numbers")
    return elements


def _curves(options: argparse.Namespace) -> list[photometry.LightCurve]:
    """The light curves of the file."""
    path = pathlib.Path(options.path)
    # A byte order mark would hide the first word, by which the format is recognised.
    # Only the first word counts here, so bytes of another encoding do no harm.
    text = path.read_text(encoding="utf-8-sig", errors="replace")
    lines = (line.strip() for line in text.splitlines())
    first = next((x for x in lines if x and not x.startswith("#")), "")
    if not first.upper().startswith(_ALCDEF):
        for name in ("orbit", "time_scale"):
            option = "--" + name.replace("_", "-")
            message = f"Argument `{option}` must be left out for a file with vectors."
            demand(getattr(options, name) is None, message)
        return photometry.read_light_curves(path)
    message = (
        "Argument `--orbit` must be given for an ALCDEF file, which has no vectors."
    )
    demand(options.orbit is not None, message)
    axis, eccentricity, inclination, node, argument, anomaly, epoch = options.orbit
    orbit = photometry.Orbit(
        semi_major_axis=_AU * axis,
        eccentricity=eccentricity,
        inclination=np.radians(inclination),
        node=np.radians(node),
        argument_of_perihelion=np.radians(argument),
        mean_anomaly=np.radians(anomaly),
        epoch=epoch,
    )
    return photometry.read_alcdef(
        path,
        photometry.geometry_of_orbit(orbit),
        time_scale=options.time_scale or "tdb",
    )


def _span(curves: list[photometry.LightCurve]) -> float:
    """Time from the first point to the last [s]."""
    return float(np.ptp(np.concatenate([x.ts for x in curves])))


def _summary(curves: list[photometry.LightCurve]) -> str:
    """A sentence that sums up the light curves that were read."""
    ts = np.concatenate([x.ts for x in curves])
    relative = sum(x.is_relative for x in curves)
    # All curves of a file have the same epoch.
    first = curves[0].epoch + ts.min() / _DAY
    return (
        f"{len(curves)} light curves, of which {relative} are relative, with {len(ts)} "
        f"points in {_span(curves) / _DAY:.1f} days from JD {first:.4f}"
    )


def _table(pairs: photometry.PeriodPairs) -> str:
    """Pairs of periods, the best first."""
    lines = ["P_phi [h]  P_psi [h]  variance explained"]
    for first, second, part in zip(*pairs, strict=True):
        periods = f"{first / _HOUR:9.4g}  {second / _HOUR:9.4g}"
        lines.append(f"{periods}  {100 * part:.1f} %")
    return "\n".join(lines)


def run(options: argparse.Namespace, say: Callable[[str], None]) -> int:
    """Read, search, say what was found and draw; returns the exit status."""
    # This is refused before the search, which takes minutes.
    message = "Argument `--plot` needs `--report`, but it is not given."
    demand(options.report or not options.plot, message)
    curves = _curves(options)
    say(_summary(curves))
    shortest = _HOUR * options.shortest
    longest = _span(curves) if options.longest is None else _HOUR * options.longest
    demand(
        0 < shortest < longest,
        "Arguments `--shortest` and `--longest` must be positive periods in this "
        f"order, but they are {shortest / _HOUR:g} and {longest / _HOUR:g} hours.",
    )
    say(f"periods from {shortest / _HOUR:g} to {longest / _HOUR:.5g} hours are tried")
    if not options.report:
        say(_table(photometry.period_pairs(curves, shortest, longest, count=10)))
        return 0
    found = photometry.find_tumblers(
        curves,
        options.noise,
        shortest=shortest,
        longest=longest,
        modes=options.mode or _MODES,
        inertia=options.inertia,
        pairs=options.pairs,
    )
    say(found.report())
    if options.plot:
        # Agg draws without a display. matplotlib reads this when it is first imported.
        os.environ.setdefault("MPLBACKEND", "Agg")
        figure: Any = plot.light_curves(curves, found)["unfolded"].figure
        figure.savefig(options.plot)
    # A count of aliases means nothing where none of them follows the curves.
    if not found.follows:
        return _MISFIT
    return _DETERMINED if found.determined else _SEVERAL
