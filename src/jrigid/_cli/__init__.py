"""The command line: `jrigid fit record.csv` and `jrigid photometry curves.txt`.

`python -m jrigid` does the same.
"""

import argparse
import math
import os
import re
import sys
from collections.abc import Sequence
from importlib.metadata import version
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jrigid import identify, plot, records
from jrigid._checks import demand
from jrigid._cli import _photometry
from jrigid._cli._arguments import numbers, output, picture
from jrigid.identify import Status
from jrigid.systems import RigidBody

# The initial values of a fit need four samples.
_SHORTEST = 4  # rows of a piece that is fitted
# 1 is for what cannot be used, 2 for what argparse does not understand.
_EXIT = {
    "OK": 0,
    "UNIDENTIFIABLE": 3,
    "MISFIT": 4,
    "AT_BOUNDARY": 5,
    "WRONG_BASIN": 6,
    "NOT_CONVERGED": 7,
}
# Classes of `jrigid.identify`, in lower case.
_INERTIA_MODELS = ("tensor", "moments", "symmetric", "top", "flat")
# Patterns of what reports and errors say of arguments in Python, and the options of the
# command line that set them. They are applied in this order: a pattern that contains a
# later one precedes it.
_OPTIONS = (
    (r"\(`free`\), by `free=[^`]*bias`", "by `--bias`"),
    # The command line seeks nothing else of a gyro.
    (r", or seek it \(`free`\)", ""),
    (r"([Pp]ass it) \(`Gyro\(", r"\1 in Python (`Gyro("),
    (r"`free(=[^`]*bias)?`", "`--bias`"),
    (r"`unmodelled`", "`--unmodelled`"),
    (r"Arguments `sigma` and `covariance` of `Gyro`", "Argument `--sigma`"),
    (r"`sigma`", "`--sigma`"),
    (r"`absolute_sigma=False`", "no `--sigma`"),
    (r"`loss(=\"robust\")?`", "`--robust`"),
    (r"`inertia_model`", "`--inertia-model`"),
    (r"(?<=\. )[^.]*`throw=False`[^.]*", "`--plot` and `--save` show it"),
    (r"see `null_directions`", "see below what is not determined"),
    (r"`columns`", "`--columns`"),
    (r"`unit`", "`--unit`"),
    (r"\bunit=\{'(\w+)': \.\.\.\}", r"--unit \1=..."),
    (r"\bunit='?([\w./]+)'?", r"--unit \1"),
    *_photometry.OPTIONS,
)


def _torque(text: str) -> str | identify.GaussMarkov:
    """An unmodelled torque: `estimate`, a level, or a level and a correlation time."""
    if text == "estimate":
        return text
    values = numbers(text)
    if len(values) not in (1, 2) or not all(0 <= x < math.inf for x in values):
        wanted = "must be `estimate`, or one or two numbers from 0, between commas"
        raise argparse.ArgumentTypeError(f"{wanted}, but it is {text!r}")
    return identify.GaussMarkov(*values)


def _parser() -> argparse.ArgumentParser:
    """The parser of all commands."""
    parser = argparse.ArgumentParser(
        "jrigid", description="The rotation of rigid bodies."
    )
    parser.add_argument(
        "--version", action="version", version=f"%(prog)s {version('jrigid')}"
    )
    codes = ", ".join(f"{code} {name}" for name, code in _EXIT.items())
    commands = parser.add_subparsers(required=True)
    command = commands.add_parser(
        "fit",
        help="inertia from a file with a gyro's record of free motion",
        description="Inertia from a file with a gyro's record of free motion, of one "
        "trial or several; units, clocks and repairs are said.",
        epilog=f"Exit status: {codes}; 1 for a file or a value that cannot be used, 2 "
        "for arguments that cannot be read. `--flights` takes noise and bias from "
        "where the body rests; without a sigma the noise is taken from the residuals.",
    )
    command.set_defaults(run=_fit)
    _add_options_of_reading(command)
    _add_options_of_fit(command)
    _photometry.add_command(commands).set_defaults(run=_light_curves)
    return parser


def _add_options_of_reading(command: argparse.ArgumentParser) -> None:
    """Add what says how the file is read."""
    command.add_argument(
        "path", help="a file, or a folder, as `jrigid.records.read` takes it"
    )
    command.add_argument(
        "--unit",
        action="append",
        default=[],
        help="of the rates: deg/s, counts or a factor; or times=ms, any number",
    )
    command.add_argument(
        "--columns",
        action="append",
        default=[],
        metavar="NAME=HEADERS",
        help="times=t, rates=gx,gy,gz, any number",
    )
    command.add_argument(
        "--flights",
        action="store_true",
        help="find trials in the record; else it is one trial",
    )


def _add_options_of_fit(command: argparse.ArgumentParser) -> None:
    """Add what says how the record is fitted and what becomes of the fit."""
    command.add_argument(
        "--sigma",
        type=float,
        help="noise of a reading [rad/s], whatever the file's unit",
    )
    command.add_argument("--bias", action="store_true", help="seek the gyro's bias")
    command.add_argument(
        "--inertia-model",
        choices=_INERTIA_MODELS,
        default="tensor",
        help="what is known of it (tensor: nothing)",
    )
    command.add_argument(
        "--unmodelled",
        type=_torque,
        default=identify.GaussMarkov(0.0),
        metavar="LEVEL[,TIME]",
        help="of an unmodelled torque over the mean moment [rad/s^1.5], and its "
        "correlation time [s] (white without one); or estimate",
    )
    command.add_argument("--robust", action="store_true", help="leave outliers out")
    command.add_argument(
        "--plot",
        type=picture,
        metavar="PNG",
        help="where to draw the fit (needs matplotlib)",
    )
    command.add_argument(
        "--save",
        type=output,
        metavar="PKL",
        help="where to keep the fit, for `jrigid.identify.load`",
    )


def _with_options(text: str) -> str:
    """Name options of the command line where a text names arguments in Python."""
    for argument, option in _OPTIONS:
        text = re.sub(argument, option, text)
    return text


def _trials(reading: records.Reading, by_flights: bool) -> list[records.Reading]:
    """The readings to fit: flights, or the stretches without a break."""
    message = "Argument `path` must hold rates of a gyro, but it has none."
    demand(reading.rates is not None, message)
    if by_flights:
        trials = records.flights(reading)
        for trial in trials:
            # The notes before the last one are those of the whole file, which are
            # printed already.
            print(f"  - {trial.notes[-1]}")
    else:
        trials = [x for x in reading.pieces() if x.times.size >= _SHORTEST]
    needed = "flights" if by_flights else f"{_SHORTEST} readings without a break"
    demand(len(trials) > 0, f"Argument `path` must hold {needed}, but it has none.")
    return trials


def _at_rest(reading: records.Reading) -> tuple[np.ndarray | None, np.ndarray]:
    """Noise of a reading and bias [rad/s], as far as the body rests anywhere."""
    try:
        rest = records.noise(reading)
    except ValueError:
        # Nothing rests. Without a sigma `fit` takes the noise from the residuals.
        return None, np.zeros(3)
    # A filter's memory makes noise look smaller from reading to reading than it is.
    sigma = np.maximum(rest.sigma, rest.density / np.sqrt(rest.interval))
    shown = (", ".join(f"{x:.3g}" for x in numbers) for numbers in (sigma, rest.bias))
    print("  - at rest ({}): noise {}; bias {} rad/s".format(rest.notes[0], *shown))
    # A coarse gyro may not change at rest. `fit` refuses a sigma of 0.
    return sigma if np.all(sigma > 0) else None, rest.bias


def _unit(text: str) -> tuple[str, str | float]:
    """The quantity of a unit, and the name of the unit or its factor."""
    kind, _, unit = text.rpartition("=")
    try:
        # Without `=` all of the text is the unit, and it is that of the rates.
        return kind or "rates", float(unit)
    except ValueError:
        return kind or "rates", unit


def _reading(options: argparse.Namespace) -> records.Reading:
    """The file, with the units and columns that the command line names."""
    columns = {}
    for text in options.columns:
        name, sign, headers = text.partition("=")
        message = f"Argument `--columns` must be NAME=HEADERS, but it is {text!r}."
        demand(bool(sign), message)
        columns[name] = tuple(headers.split(",")) if "," in headers else headers
    units = dict(map(_unit, options.unit))
    return records.read(options.path, unit=units, columns=columns)


def _fit(options: argparse.Namespace) -> int:
    """Read, fit, print, save and draw; returns the exit status."""
    reading = _reading(options)
    print(_with_options(str(reading)))
    trials = _trials(reading, options.flights)
    noise, bias = _at_rest(reading) if options.flights else (None, np.zeros(3))
    sigma = noise if options.sigma is None else options.sigma
    gyro = identify.Gyro(jnp.asarray(bias))

    def fit(throw: bool) -> identify.FitResult:
        return identify.fit(
            # Free motion determines ratios only, so that any trace will do.
            RigidBody(np.ones(3)),
            [identify.Record(gyro, x.times, x.rates, sigma) for x in trials],
            free=(lambda _, gyro: gyro.bias) if options.bias else None,
            inertia_model=getattr(identify, options.inertia_model.title())(),
            unmodelled=options.unmodelled,
            loss="robust" if options.robust else "squares",
            throw=throw,
        )

    # A fit that went wrong is shown as well. The exit status says how it ended.
    result = fit(throw=False)
    if result.status == Status.BAD_INPUT:
        result = fit(throw=True)  # raises an error that says what is wrong
    report = str(result)
    if options.sigma is None:
        # The noise was measured where the body rests.
        report = report.replace(
            "`sigma` is too", "the noise at rest, for `sigma`, is too"
        ).replace(", or `absolute_sigma=False`", "")
    print(_with_options(report))
    if options.save:
        identify.save(options.save, result)
    if options.plot:
        # Agg draws without a display. matplotlib reads this when it is first imported.
        os.environ.setdefault("MPLBACKEND", "Agg")
        figure: Any = plot.fit(result)["record"].figure
        figure.savefig(options.plot)
    # Bad input is not among these, since it has raised an error above.
    codes = (x for name, x in _EXIT.items() if result.status == getattr(Status, name))
    return next(codes)


def _light_curves(options: argparse.Namespace) -> int:
    """Run the command of light curves; returns the exit status."""
    # Flushed, because a search of minutes follows the first lines.
    return _photometry.run(options, lambda text: print(_with_options(text), flush=True))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command `jrigid`; returns the exit status."""
    options = _parser().parse_args(arguments)
    # JAX rounds to seven digits by default. This must precede the first array.
    jax.config.update("jax_enable_x64", True)
    try:
        return options.run(options)
    # These come from files, arguments and missing extras. A bug keeps its traceback.
    except (ValueError, RuntimeError, OSError, ImportError) as error:
        print(f"jrigid: {_with_options(str(error))}", file=sys.stderr)
        return 1
