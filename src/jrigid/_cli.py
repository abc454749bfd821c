"""The command line: `jrigid fit record.csv`, or `python -m jrigid fit record.csv`."""

import argparse
import os
import sys
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from jrigid import identify, plot, records
from jrigid._checks import demand
from jrigid.identify import Status
from jrigid.systems import RigidBody

_LEAST = 4  # rows of a piece that is fitted
# 1 is for what cannot be used, 2 for what argparse does not understand.
_EXIT = {
    "OK": 0,
    "UNIDENTIFIABLE": 3,
    "MISFIT": 4,
    "AT_BOUNDARY": 5,
    "WRONG_BASIN": 6,
    "NOT_CONVERGED": 7,
}
_OPTIONS = {
    "`unmodelled`": "`--unmodelled`",
    "`free`": "`--bias`",
    "`sigma`": "`--sigma`",
    "`absolute_sigma=False`": "no `--sigma`",
}
_INERTIA_MODELS = (
    "tensor",
    "moments",
    "symmetric",
    "top",
    "flat",
)  # of `jrigid.identify`


def _torque(text: str) -> str | identify.GaussMarkov:
    """An unmodelled torque: `estimate`, a level, or a level and a correlation time."""
    if text == "estimate":
        return text
    numbers = [float(x) for x in text.split(",")]
    return identify.GaussMarkov(*numbers)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        "jrigid", description="The rotation of rigid bodies."
    )
    codes = ", ".join(f"{code} {name}" for name, code in _EXIT.items())
    command = parser.add_subparsers(required=True).add_parser(
        "fit",
        help="inertia from a file with a gyro's record of free motion",
        description="Inertia from a file with a gyro's record of free motion, of one trial or "
        "several; units, clocks and repairs are said.",
        epilog=f"Exit status: {codes}; 1 for a file that cannot be used, 2 for these arguments. "
        "`--flights` takes noise and bias from where the body rests; without a sigma the noise is "
        "taken from the residuals.",
    )
    add = command.add_argument
    add("path", help="a file, or a folder, as `jrigid.records.read` takes it")
    units = "of the rates: deg/s, counts or a factor; or times=ms, any number"
    add("--unit", action="append", default=[], help=units)
    add(
        "--columns",
        action="append",
        default=[],
        metavar="NAME=HEADERS",
        help="times=t, rates=gx,gy,gz, any number",
    )
    add(
        "--flights",
        action="store_true",
        help="find trials in the record; else it is one trial",
    )
    add(
        "--sigma",
        type=float,
        help="noise of a reading [rad/s], whatever the file's unit",
    )
    add("--bias", action="store_true", help="seek the gyro's bias")
    add(
        "--inertia-model",
        choices=_INERTIA_MODELS,
        default="tensor",
        help="what is known of it (tensor: nothing)",
    )
    add(
        "--unmodelled",
        type=_torque,
        default=identify.GaussMarkov(0.0),
        metavar="LEVEL[,TIME]",
        help="of an unmodelled torque over the mean moment [rad/s^1.5], and its correlation time "
        "[s] (white without one); or estimate",
    )
    add("--robust", action="store_true", help="leave outliers out")
    add("--plot", metavar="PNG", help="where to draw the fit (needs matplotlib)")
    add(
        "--save",
        metavar="PKL",
        help="where to keep the fit, for `jrigid.identify.load`",
    )
    return parser


def _with_options(report: str) -> str:
    """A report that names options of the command line instead of arguments of `fit`."""
    for argument, option in _OPTIONS.items():
        report = report.replace(argument, option)
    return report


def _trials(reading: records.Reading, fly: bool) -> list[records.Reading]:
    """What is fitted: flights, or the stretches without a break."""
    demand(
        reading.rates is not None,
        "Argument `path` must hold rates of a gyro, but it has none.",
    )
    if fly:
        parts = records.flights(reading)
        for part in parts:
            print(f"  - {part.notes[-1]}")
    else:
        parts = [x for x in reading.pieces() if x.times.size >= _LEAST]
    what = "flights" if fly else f"{_LEAST} readings without a break"
    demand(len(parts) > 0, f"Argument `path` must hold {what}, but it has none.")
    return parts


def _at_rest(reading: records.Reading) -> tuple[np.ndarray | None, np.ndarray]:
    """Noise of a reading and bias [rad/s], as far as the body rests anywhere."""
    try:
        rest = records.noise(reading)
    except ValueError:
        return None, np.zeros(3)
    # A filter's memory makes noise look smaller from reading to reading than it is.
    sigma = np.maximum(rest.sigma, rest.density / np.sqrt(rest.interval))
    shown = (", ".join(f"{x:.3g}" for x in numbers) for numbers in (sigma, rest.bias))
    print("  - at rest ({}): noise {}; bias {} rad/s".format(rest.notes[0], *shown))
    return sigma if np.all(sigma > 0) else None, rest.bias


def _unit(text: str) -> tuple[str, str | float]:
    """What a unit is of, and its name or the factor that it stands for."""
    kind, _, unit = text.rpartition("=")
    try:
        return kind or "rates", float(unit)
    except ValueError:
        return kind or "rates", unit


def _fit(options: argparse.Namespace) -> int:
    units = dict(map(_unit, options.unit))
    named = [x.partition("=") for x in options.columns]
    columns = {name: tuple(x.split(",")) if "," in x else x for name, _, x in named}
    reading = records.read(options.path, unit=units, columns=columns)
    print(reading)
    trials = _trials(reading, options.flights)
    noise, bias = _at_rest(reading) if options.flights else (None, np.zeros(3))
    sigma = noise if options.sigma is None else options.sigma
    gyro = identify.Gyro(jnp.asarray(bias))

    def fit(throw: bool) -> identify.FitResult:
        return identify.fit(
            RigidBody(np.ones(3)),
            [identify.Record(gyro, x.times, x.rates, sigma) for x in trials],
            free=(lambda _, gyro: gyro.bias) if options.bias else None,
            inertia_model=getattr(identify, options.inertia_model.title())(),
            unmodelled=options.unmodelled,
            loss="robust" if options.robust else "squares",
            throw=throw,
        )

    found = fit(throw=False)
    if found.status == Status.BAD_INPUT:
        found = fit(throw=True)  # says what is wrong
    print(_with_options(str(found)))
    if options.save:
        identify.save(options.save, found)
    if options.plot:
        os.environ.setdefault("MPLBACKEND", "Agg")
        plot.fit(found)["record"].figure.savefig(options.plot)
    return next(
        code for name, code in _EXIT.items() if found.status == getattr(Status, name)
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """What `jrigid` does in a shell; returns the exit status."""
    options = _parser().parse_args(arguments)
    jax.config.update("jax_enable_x64", True)
    try:
        return _fit(options)
    except (ValueError, RuntimeError, OSError, ImportError) as error:
        print(f"jrigid: {error}", file=sys.stderr)
        return 1
