"""Interfaces of a fit: predictions, shares, files, pictures and the command line."""

import ast
import dataclasses
import importlib
import inspect
import os
import re
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
import pytest
import worlds
from helpers import in_a_process

import jrigid as jr
from jrigid import _cli, identify
from jrigid.identify import Status
from jrigid.identify._problem import Problem

matplotlib.use("Agg")

DEGREE = np.pi / 180
TENSOR = np.array([[2.0, 0.2, -0.1], [0.2, 3.0, 0.3], [-0.1, 0.3, 4.0]]) / 3
MOMENTS = np.linalg.eigvalsh(TENSOR)
RATIOS = MOMENTS[1:] / MOMENTS[0]
TS = 0.05 * np.arange(200)
OMEGA = np.array([0.6, 2.0, 0.8])
SIGMA = 0.02
QUICK = "--xla_backend_optimization_level=0"  # to compile
BLIND = jr.RigidBody(np.ones(3))
LATER = np.array([0.33, 7.5, 12.0])


@pytest.fixture(scope="module")
def readings():
    rng = np.random.default_rng(7)
    return worlds.gyro((TS, worlds.tumble(TENSOR, OMEGA, TS).omega), TS, rng, SIGMA)


@pytest.fixture(scope="module")
def found(readings):
    """As the command line asks for it, so that both are compiled once."""
    record = identify.Record(identify.Gyro(), TS, readings, SIGMA)
    return identify.fit(BLIND, [record])


# Predictions


def test_a_prediction_is_the_record_less_its_noise(found, readings):
    shown = found.predict(TS)
    np.testing.assert_allclose(shown, readings + found.residuals()[0], atol=1e-12)
    times = np.concatenate([TS[:1], LATER])
    true = worlds.tumble(TENSOR, OMEGA, times).omega
    np.testing.assert_allclose(found.predict(times), true, atol=0.8 * SIGMA)
    backward = found.predict(-LATER)  # free motion goes both ways
    again = jr.free_rotation(
        found.inertia, found.initial_state()[0], -LATER
    ).states.omega
    np.testing.assert_allclose(backward, again, atol=1e-12)


def test_a_fit_without_an_unmodelled_torque_has_none(found):
    np.testing.assert_array_equal(np.stack([found.level, found.level_errors]), 0)


def test_times_of_a_prediction_may_have_any_shape(found):
    flat = found.predict(LATER)
    assert found.predict(LATER[1]).shape == (3,)
    np.testing.assert_array_equal(found.predict(LATER[:, None, None])[:, 0, 0], flat)
    inside = jax.jit(lambda ts: found.predict(ts))(LATER)
    np.testing.assert_allclose(inside, flat, atol=1e-12)


def test_masked_values_were_not_seen():
    values = np.ma.masked_array(np.ones((4, 3)), mask=False)
    values[1] = np.ma.masked
    values[2, 0] = np.ma.masked
    seen = np.isfinite(identify.Rates(np.arange(4.0), values, 0.1).values)
    np.testing.assert_array_equal(seen, ~values.mask)


def test_groups_of_trials_are_whole_numbers(untyped):
    with pytest.raises(ValueError, match="`groups` must be an integer"):
        identify.each(jnp.zeros(3), ["first", "second"])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"record": 1}, "`record` must be at least 0 and below 1, but it is 1"),
        ({"trial": -1}, "`trial` must be at least 0 and below 1, but it is -1"),
    ],
)
def test_a_prediction_of_what_is_not_there_is_refused(found, options, words):
    with pytest.raises(ValueError, match=words):
        found.predict(TS, **options)


def with_parts(found, body, *sensors, omegas=None, t0=(0.0,)):
    """A result as if these had been fitted, which would take long to compile."""
    trials = len(t0)
    found = jax.tree.map(
        lambda x: jnp.repeat(x, trials, axis=0) if x.ndim and x.shape[0] == 1 else x,
        found,
    )
    given, rest = eqx.partition((body, *sensors), eqx.is_inexact_array)
    old, stacked = found.problem, (False,) * len(jax.tree.leaves(given))
    unknowns = dataclasses.replace(
        old.unknowns, given=given, rest=rest, stacked=stacked
    )
    options = old.options._replace(free_motion=body.is_free, depends_on_attitude=True)
    samples = old.samples._replace(values=old.samples.values * len(sensors))
    problem = Problem(options, unknowns, samples, old.noise)
    omegas = found.state.omega if omegas is None else jnp.asarray(omegas)
    state = jr.State(jnp.tile(jnp.array([1.0, 0, 0, 0]), (trials, 1)), omegas)
    return dataclasses.replace(found, state=state, t0=jnp.asarray(t0), problem=problem)


def test_a_prediction_has_the_sensors_memory_and_the_torque(found, rng):
    """A late, slow, biased gyro that saturates, of two trials in air.

    The second starts at 3 s.
    """
    late, slow, bias, limit, drag = 0.02, 0.015, 0.1, 1.7, 0.05
    omegas, start = np.array([[0.6, 2.0, 0.8], [1.5, -0.4, 1.9]]), 3.0
    gyro = identify.Gyro(
        bias * jnp.ones(3), delay=late, time_constant=slow, limit=limit
    )
    body = jr.RigidBody(found.inertia, jr.torques.QuadraticDrag(drag * jnp.ones(3)))
    star = identify.AttitudeSensor()
    fitted = with_parts(found, body, star, gyro, omegas=omegas, t0=(0.0, start))
    ts = start + np.array([2.4, 0.3, 4.1, 1.2])  # in any order
    shown = fitted.predict(ts, record=1, trial=1)
    grid = np.arange(0, 5, 0.001)
    air, tensor = worlds.quadratic_drag(drag), np.asarray(found.inertia)
    motion = worlds.tumble(tensor, omegas[1], grid, air)
    order = np.argsort(ts)
    true = worlds.gyro(
        (start + grid, motion.omega),
        ts[order],
        rng,
        0.0,
        bias,
        delay=late,
        time_constant=slow,
        limit=limit,
    )
    assert np.max(np.abs(true)) == limit
    np.testing.assert_allclose(shown[order], true, atol=1e-4)
    assert np.abs(fitted.predict(ts, record=1, trial=0) - shown).max() > 0.1
    turned = fitted.predict(ts[order], trial=1)
    times, upright = np.append(0, ts[order] - start), np.array([1.0, 0, 0, 0])
    true = worlds.tumble(tensor, omegas[1], times, air, attitude0=upright).attitude[1:]
    side = np.sign(np.sum(turned * true, axis=1, keepdims=True))
    np.testing.assert_allclose(side * turned, true, atol=1e-6)
    with pytest.raises(ValueError, match="`ts` must not be before the trial's `t0`"):
        fitted.predict(2.9, record=1, trial=1)


# Shares


def test_shares_are_moments_over_their_sum(found):
    np.testing.assert_allclose(found.shares, found.moments / 3, rtol=1e-12)
    pulls = (found.shares - MOMENTS / np.sum(MOMENTS)) / found.shares_errors
    assert np.abs(pulls).max() < 4

    def shares(numbers):
        moments = jnp.linalg.eigvalsh(found.unknowns.inertia(numbers))
        return moments / jnp.sum(moments)

    slopes = jax.jacfwd(shares)(found.numbers)
    straight = slopes @ found.numbers_covariance @ slopes.T
    np.testing.assert_allclose(found.shares_covariance, straight, rtol=0.02, atol=1e-9)
    np.testing.assert_allclose(
        found.shares_errors, np.sqrt(np.diagonal(straight)), rtol=0.02
    )
    np.testing.assert_allclose(jnp.sum(found.shares_covariance, axis=0), 0, atol=1e-15)


# Diagnostics


def test_sensitivity_is_the_change_of_the_state_that_the_numbers_ask_for(found):
    """The state follows changed numbers so that residuals grow least."""
    size = found.numbers.size
    jacobian = np.asarray(found.diagnostics.jacobian[0]).reshape(-1, size + 3)
    slopes = jacobian[:, :size]
    of_state = jacobian[:, size:]
    expected = np.linalg.lstsq(of_state, -slopes, rcond=None)[0]
    sensitivity = np.asarray(found.diagnostics.sensitivity[0])
    atol = 1e-9 * np.abs(expected).max()
    np.testing.assert_allclose(sensitivity, expected, rtol=1e-9, atol=atol)


# Files


def test_a_fit_is_read_as_it_was_written(found, tmp_path):
    path = tmp_path / "fit.pkl"
    identify.save(path, found)
    again = identify.load(path)
    assert str(again) == str(found)
    assert again.status == Status.OK
    assert jax.tree.structure(again) == jax.tree.structure(found)
    for x, y in zip(jax.tree.leaves(again), jax.tree.leaves(found), strict=True):
        np.testing.assert_array_equal(x, y, strict=True)
    np.testing.assert_array_equal(again.ratios_intervals, found.ratios_intervals)
    np.testing.assert_array_equal(again.predict(LATER), found.predict(LATER))


READ = """
import jax
from jrigid import identify
try:
    identify.load("{path}")
except ValueError as error:
    print(error)
jax.config.update("jax_enable_x64", True)
found = identify.load("{path}")
print(found)
print(*found.ratios_intervals.ravel())
"""


def test_a_fit_is_read_in_another_process(found, tmp_path):
    identify.save(tmp_path / "fit.pkl", found)
    shown, _ = in_a_process(READ.format(path=tmp_path / "fit.pkl"))
    refused, *report, limits = shown.splitlines()
    assert "must be read with `jax_enable_x64` on" in refused
    assert report == str(found).splitlines()
    limits = np.array(limits.split(), float)
    np.testing.assert_allclose(limits, np.ravel(found.ratios_intervals), rtol=1e-9)


def spin(_, state, __):
    return state.omega[2:]


def test_functions_are_kept_by_their_names(found, tmp_path):
    def fitted(function):
        return with_parts(found, BLIND, identify.FunctionSensor(function))

    path = tmp_path / "fit.pkl"
    named = fitted(spin)
    identify.save(path, named)
    again = identify.load(path)
    assert again.fitted()[1].function is spin
    np.testing.assert_array_equal(again.predict(1.0), named.predict(1.0))
    with pytest.raises(
        ValueError, match=r"Argument `result` must hold functions .*lambda"
    ):
        identify.save(path, fitted(lambda _, state, __: state.omega[2:]))
    path.write_bytes(path.read_bytes().replace(b"spin", b"spun"))
    with pytest.raises(ValueError, match=r"Argument `path` must be a file .*spun"):
        identify.load(path)


def test_what_is_no_fit_is_not_read(tmp_path, untyped):
    path = tmp_path / "fit.pkl"
    path.write_text("not a fit\n")
    with pytest.raises(
        ValueError, match="Argument `path` must be a file that `save` wrote"
    ):
        identify.load(path)
    path.write_bytes(b"N.")  # None, as a pickle
    with pytest.raises(
        ValueError, match="`path` must be a FitResult, but it is a NoneType"
    ):
        identify.load(path)
    with pytest.raises(
        ValueError, match="`result` must be a FitResult, but it is a str"
    ):
        identify.save(path, "fit")
    with pytest.raises(FileNotFoundError):
        identify.load(tmp_path / "none.pkl")


# Pictures


@pytest.fixture
def pictures():
    from matplotlib import pyplot

    yield pyplot
    pyplot.close("all")


def test_five_pictures_of_a_fit(found, readings, pictures, tmp_path):
    axes = jr.plot.fit(found)
    assert set(axes) == {"record", "residuals", "spectrum", "histogram", "ratios"}
    axes["record"].figure.savefig(tmp_path / "fit.png")
    assert axes["record"].figure.get_suptitle() == "OK"
    assert axes["record"].get_ylabel() == "rate [rad/s]"
    assert axes["record"].get_xlabel() == "time [s]"
    model, points, dropped = axes["record"].lines[:3]
    np.testing.assert_array_equal(
        points.get_xydata(), np.stack([TS, readings[:, 0]], axis=1)
    )
    np.testing.assert_allclose(
        model.get_ydata(), found.predict(model.get_xdata())[:, 0]
    )
    assert dropped.get_xdata().size == 0
    left = [line.get_ydata() for line in axes["residuals"].lines]
    np.testing.assert_allclose(np.stack(left, axis=1), found.diagnostics.residuals[0])
    assert axes["ratios"].get_xlabel() == "I2/I1"


def test_the_spectrum_of_white_noise_lies_in_its_range(found, pictures):
    ax = jr.plot.fit(found, {"spectrum": pictures.figure().add_subplot()})["spectrum"]
    frequencies, power = ax.lines[0].get_data()
    assert ax.get_xlabel() == "frequency [Hz]"
    assert 1 / 10 <= frequencies[0] < 1 / 5  # of 10 s, read at 20 Hz
    assert 8 < frequencies[-1] < 10
    edges = ax.collections[0].get_paths()[0].vertices
    inside = [
        np.min(edges[edges[:, 0] == f, 1]) < p < np.max(edges[edges[:, 0] == f, 1])
        for f, p in zip(frequencies, power, strict=True)
    ]
    assert np.mean(inside) > 0.8
    # A slow wave that no model has, of a tenth of its noise's power, in one band, and
    # beyond it.
    wave = 0.45 * np.sin(2 * np.pi * 0.3 * TS)[None, :, None]
    ax.clear()
    waved = eqx.tree_at(
        lambda x: x.diagnostics.residuals, found, replace_fn=lambda x: x + wave
    )
    jr.plot.fit(waved, {"spectrum": ax})
    power = ax.lines[0].get_ydata()
    assert abs(frequencies[np.argmax(power)] - 0.3) < 0.06
    assert np.max(power) > 5


def test_the_ellipse_is_that_of_the_covariance(found, pictures):
    ax = jr.plot.fit(found, {"ratios": pictures.figure().add_subplot()})["ratios"]
    inverse = np.linalg.inv(found.ratios_covariance)
    for line, square in (
        (ax.lines[1], 2.279),
        (ax.lines[2], 5.991),
    ):  # chi-square of two
        apart = line.get_xydata() - np.asarray(found.ratios)
        np.testing.assert_allclose(
            np.einsum("ni,ij,nj->n", apart, inverse, apart), square, 1e-3
        )


def test_errors_beyond_the_noise_stated_are_drawn_about_the_bound(found, pictures):
    sizes = lambda x: (x.diagnostics.inflation, x.ratios_covariance)  # noqa: E731
    wide = eqx.tree_at(sizes, found, replace_fn=lambda x: 9 * x)
    ax = pictures.figure().add_subplot()
    jr.plot.fit(wide, {"ratios": ax})
    dashed, dotted = ax.lines[2:4]
    assert dotted.get_label() == "bound"
    apart = [line.get_xydata() - np.asarray(found.ratios) for line in (dashed, dotted)]
    np.testing.assert_allclose(apart[0], 3 * apart[1], atol=1e-12)
    plan = identify.Plan(
        found.system, found.initial_state()[0], [identify.Rates(TS, None, SIGMA)]
    )
    least = np.linalg.inv(plan.bound.ratios_covariance)
    np.testing.assert_allclose(
        np.einsum("ni,ij,nj->n", apart[1], least, apart[1]), 5.991, 0.01
    )


def test_observations_are_what_was_read_and_what_was_left(found, readings):
    observations = found.observations()
    np.testing.assert_array_equal(observations.times, TS[None])
    np.testing.assert_allclose(observations.values, readings[None])
    assert np.all(observations.kept)
    left = np.asarray(found.residuals()) / SIGMA
    np.testing.assert_allclose(observations.residuals, left, rtol=1e-9)
    assert not found.has_unmodelled_torque


def test_what_a_record_does_not_tell_is_written(found, pictures):
    ax = jr.plot.fit(found, {"ratios": pictures.figure().add_subplot()})["ratios"]
    assert ax.texts[0].get_text() == "not determined: overall scale"


def test_ratios_that_are_not_told_have_no_ellipse(found, pictures):
    spun = eqx.tree_at(lambda x: x.diagnostics.pure_spin, found, jnp.array(True))
    ax = jr.plot.fit(spun, {"ratios": pictures.figure().add_subplot()})["ratios"]
    assert ax.get_title("left") == "Ratios: not determined"
    assert len(ax.lines) == 4  # a point, and the bounds of real bodies
    assert ax.get_legend() is None
    assert min(ax.axis()) > 0.5
    assert "spin is pure" in ax.texts[0].get_text()


@pytest.mark.parametrize(
    "wrong", [{"record": 1}, {"trial": -1}, {"axes": {"wrong": None}}]
)
def test_what_is_not_in_a_fit_is_not_drawn(found, pictures, wrong):
    with pytest.raises(ValueError, match=f"`{next(iter(wrong))}` must be one of"):
        jr.plot.fit(found, **({"axes": {}} | wrong))
    assert not pictures.get_fignums()


def test_a_record_with_unmodelled_torque_is_drawn_as_it_was_followed(
    found, readings, pictures
):
    options = found.problem.options._replace(unmodelled="known")
    problem = dataclasses.replace(found.problem, options=options)
    kicked = dataclasses.replace(found, problem=problem)
    kicked = eqx.tree_at(
        lambda x: x.diagnostics.residuals, kicked, replace_fn=lambda x: 2 * x
    )
    ax = jr.plot.fit(kicked, {"record": pictures.figure().add_subplot()})["record"]
    np.testing.assert_allclose(
        ax.lines[0].get_ydata(), (readings + kicked.residuals()[0])[:, 0]
    )


def test_attitudes_are_drawn_on_the_models_side(found, pictures):
    fitted = with_parts(found, BLIND, identify.AttitudeSensor())
    ax = pictures.figure().add_subplot()

    def drawn(values):
        samples = fitted.problem.samples._replace(values=(jnp.asarray(values)[None],))
        problem = dataclasses.replace(fitted.problem, samples=samples)
        ax.clear()
        jr.plot.fit(dataclasses.replace(fitted, problem=problem), {"record": ax})
        return ax.lines

    model = drawn(np.ones((TS.size, 4)))[::3]
    values = np.stack([np.interp(TS, *line.get_data()) for line in model], axis=1)
    lines = drawn(np.where(np.arange(TS.size)[:, None] % 3 == 0, -values, values))
    assert len(lines) == 12
    np.testing.assert_allclose(lines[1].get_ydata(), values[:, 0], atol=1e-9)
    assert ax.get_ylabel() == "attitude, quaternion"


def test_a_picture_without_the_extra_names_it(found, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.pyplot", None)
    with pytest.raises(ImportError, match=r"jrigid\[plot\]"):
        jr.plot.fit(found)


# Command line


def write(path, times, rates, **forces):
    """Milliseconds and degrees a second."""
    columns = [1e3 * times, *(rates / DEGREE).T]
    names = ["t_ms", "gx (deg/s)", "gy (deg/s)", "gz (deg/s)"]
    for name, force in forces.items():
        columns += [*force.T / 9.80665]
        names += [f"{name}{axis} (g)" for axis in "xyz"]
    np.savetxt(
        path,
        np.stack(columns, axis=1),
        delimiter=",",
        header=",".join(names),
        comments="",
    )
    return str(path)


def assert_true(result):
    pulls = (np.asarray(result.ratios) - RATIOS) / np.asarray(result.ratios_errors)
    assert np.abs(pulls).max() < 4


def test_a_file_in_degrees_becomes_ratios(found, readings, tmp_path, capsys):
    path, out = write(tmp_path / "a.csv", TS, readings), str(tmp_path / "fit.pkl")
    assert _cli.main(["fit", path, "--sigma", str(SIGMA), "--save", out]) == 0
    shown = capsys.readouterr().out
    assert "rates (gx, gy, gz) taken as deg/s: the header says so" in shown
    assert "OK: The fit describes the record" in shown
    again = identify.load(out)
    assert_true(again)
    np.testing.assert_allclose(again.ratios, found.ratios, rtol=1e-6)


def test_the_exit_status_is_the_fits(readings, tmp_path, capsys):
    path = write(tmp_path / "a.csv", TS, readings)
    assert _cli.main(["fit", path, "--sigma", str(SIGMA / 3)]) == 4
    first, *_ = capsys.readouterr().out.partition("samples")
    assert "MISFIT" in first
    assert "`--sigma` is too small" in first
    rng = np.random.default_rng(3)
    pure = np.linalg.norm(OMEGA) * np.linalg.eigh(TENSOR)[1][:, 2] * np.ones((200, 1))
    path = write(tmp_path / "b.csv", TS, pure + SIGMA * rng.normal(size=pure.shape))
    assert _cli.main(["fit", path, "--sigma", str(SIGMA)]) == 3
    assert "spin is pure" in capsys.readouterr().out
    assert len(set(_cli._EXIT.values()) - {1, 2}) == len(_cli._EXIT)
    ends = {x for x in dir(Status) if x.isupper()}
    assert set(_cli._EXIT) == ends - {"BAD_INPUT"}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["none.csv"], "No such file"),
        (["words.csv"], "Argument `path` must have names of its columns above numbers"),
        (["good.csv", "--unit", "furlong"], "Argument `--unit` must be one of"),
        (
            ["good.csv", "--columns", "rates=p,q,r"],
            "Argument `--columns` must name columns",
        ),
        (
            ["good.csv", "--columns", "rates"],
            "Argument `--columns` must be NAME=HEADERS, but it is 'rates'",
        ),
        (
            ["held.csv", "--flights"],
            "Argument `path` must hold flights, but it has none",
        ),
        (["still.csv"], "Argument `path` must hold rates of a gyro, but it has none"),
        (
            ["good.csv", "--sigma", "-1"],
            "Argument `--sigma` must be positive",
        ),
    ],
)
def test_what_cannot_be_used_is_said_in_a_sentence(
    readings, tmp_path, capsys, arguments, words, monkeypatch, rng
):
    monkeypatch.chdir(tmp_path)
    Path("words.csv").write_text("no numbers\nhere\n")
    Path("still.csv").write_text(
        "t,ax,ay,az\n" + "".join(f"{i},0,0,9.8\n" for i in range(9))
    )
    write("good.csv", TS, readings)
    write("held.csv", TS, readings, a=9.8 * np.abs(rng.normal(size=readings.shape)))
    assert _cli.main(["fit", *arguments]) == 1
    said = capsys.readouterr().err
    assert said.startswith("jrigid: ")
    assert said.count("\n") == 1
    assert words in said


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], "required"),
        (["fit"], "required: path"),
        (["fit", "a", "--unmodelled", "some"], "must be `estimate`, or one or two"),
        (["fit", "a", "--unmodelled", "1,2,3"], "two numbers from 0, between commas"),
        (["fit", "a", "--unmodelled", "-1"], "from 0, between commas, but it is '-1'"),
        (
            ["fit", "a", "--unmodelled", "inf"],
            "from 0, between commas, but it is 'inf'",
        ),
        (["fit", "a", "--inertia-model", "cube"], "invalid choice"),
        (["fit", "a", "--save", "none/a.pkl"], "argument --save: its folder must"),
        (["fit", "a", "--plot", "none/a.png"], "argument --plot: its folder must"),
        (["photometry", "a", "--pairs", "0"], "a whole number from 1, but it is '0'"),
    ],
)
def test_wrong_arguments_are_argparses_to_tell(arguments, words, capsys):
    with pytest.raises(SystemExit) as stop:
        _cli.main(arguments)
    assert stop.value.code == 2
    said = capsys.readouterr().err
    assert "usage: jrigid" in said
    assert words in said


def test_the_version_is_that_of_the_package(capsys):
    with pytest.raises(SystemExit) as stop:
        _cli.main(["--version"])
    assert stop.value.code == 0
    assert capsys.readouterr().out == f"jrigid {jr.__version__}\n"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            "seek it (`free`), by `free=lambda body, gyro: gyro.bias`.",
            "seek it by `--bias`.",
        ),
        (
            "pass it (`Gyro(delay=...)`), or seek it (`free`).",
            "pass it in Python (`Gyro(delay=...)`).",
        ),
        ('`loss="robust"` leaves such trials out', "`--robust` leaves such trials out"),
        ("See `unmodelled` and `free`.", "See `--unmodelled` and `--bias`."),
        ("Pass `sigma`, or the torque", "Pass `--sigma`, or the torque"),
        ("or `absolute_sigma=False`.", "or no `--sigma`."),
        ("Argument `inertia_model` must", "Argument `--inertia-model` must"),
        ("by `unit='rad/s'`, 3", "by `--unit rad/s`, 3"),
        ("counts (unit='counts')", "counts (--unit counts)"),
        ("tenths, pass unit=0.00174533", "tenths, pass --unit 0.00174533"),
        ("(`unit={'rates': ...}`, one", "(`--unit rates=...`, one"),
        ("rates taken as rpm: `unit` says so", "rates taken as rpm: `--unit` says so"),
    ],
)
def test_a_text_names_options_instead_of_arguments(text, expected):
    assert _cli._with_options(text) == expected


REPORTS = ("_reasons", "_words", "_result", "_fit")


def is_doc(node):
    first = node.body[0] if isinstance(node.body, list) else None
    return isinstance(first, ast.Expr) and isinstance(first.value, ast.Constant)


def test_no_reason_or_status_names_an_argument_that_has_an_option():
    """What the report of a fit may say, from the source: it may be reworded there."""
    sources = [
        inspect.getsource(importlib.import_module(f"jrigid.identify.{x}"))
        for x in REPORTS
    ]
    nodes = [node for text in sources for node in ast.walk(ast.parse(text))]
    docs = {x.body[0].value for x in nodes if getattr(x, "body", None) and is_doc(x)}
    texts = {x.value for x in nodes if isinstance(x, ast.Constant) and x not in docs}
    shown = [_cli._with_options(x) for x in texts if isinstance(x, str)]
    assert any("`--unmodelled`" in x for x in shown)
    named = r"`(free|sigma|absolute_sigma|unmodelled|loss|inertia_model|throw)\b"
    assert not [x for x in shown if re.search(named, x)]


def test_every_option_reaches_the_fit(readings, tmp_path, monkeypatch):
    asked = {}

    def fit(system, observations, **options):
        asked.update(options, observations=observations)
        raise ValueError("stopped")

    monkeypatch.setattr(identify, "fit", fit)
    path = tmp_path / "a.csv"
    rows = np.c_[TS, readings, readings]
    np.savetxt(path, rows, delimiter=",", header="when,p,q,r,x,y,z", comments="")
    columns = ["--columns", "times=when", "--columns", "rates=p,q,r"]
    units = ["--unit", "times=s", "--unit", "rpm"]
    rest = ["--unmodelled", "0.1,0.5", "--robust", "--bias", "--inertia-model", "flat"]
    assert _cli.main(["fit", *columns, *units, *rest, str(path)]) == 1
    np.testing.assert_array_equal(asked["unmodelled"].level, [0.1] * 3)
    np.testing.assert_array_equal(asked["unmodelled"].time, [0.5] * 3)
    assert asked["loss"] == "robust"
    assert asked["inertia_model"] == identify.Flat()
    assert asked["free"](None, identify.Gyro(jnp.ones(3))).shape == (3,)
    (record,) = asked["observations"]
    assert not record.states_noise
    np.testing.assert_allclose(record.values, readings * 2 * np.pi / 60, rtol=1e-6)
    assert (
        _cli.main(["fit", *columns, "--unit", "times=s", "--unit", "dps", str(path)])
        == 1
    )
    assert (asked["free"], asked["loss"]) == (None, "squares")
    np.testing.assert_array_equal(asked["unmodelled"].level, np.zeros(3))
    assert asked["inertia_model"] == identify.Tensor()


@pytest.mark.parametrize(
    ("text", "unit"),
    [
        ("deg/s", ("rates", "deg/s")),
        ("times=ms", ("times", "ms")),
        ("0.00174533", ("rates", 0.00174533)),
        ("rates=0.5", ("rates", 0.5)),
    ],
)
def test_a_unit_of_the_command_line_is_a_name_or_a_factor(text, unit):
    assert _cli._unit(text) == unit


def test_three_trials_in_a_process_of_its_own(tmp_path):
    """Rest, hand, flight, catch, three times; noise and bias are those of the rest."""
    rng, step, lever = np.random.default_rng(3), 0.01, np.array([0.03, -0.02, 0.05])
    rates, forces = [np.zeros((300, 3))], [np.tile([0, 0, 9.81], (300, 1))]
    for _ in range(3):
        motion = worlds.tumble(TENSOR, 8 * rng.normal(size=3), step * np.arange(60))
        hand = np.linspace(0, 1, 40)[:, None]
        rates += [hand * motion.omega[0], motion.omega, hand[::-1] * motion.omega[-1]]
        rates[-3] += 0.8 * rng.normal(size=(40, 3))
        rates[-1] += 0.8 * rng.normal(size=(40, 3))
        forces += [5 * rng.normal(size=(40, 3)) + [0, 0, 20]]
        forces += [worlds.accelerometer(motion, lever, rng, 0.0)]
        forces += [9 * rng.normal(size=(40, 3)) + [0, 0, 30]]
        rates += [np.zeros((250, 3))]
        forces += [np.tile([0, 0, 9.81], (250, 1))]
    rates, forces, bias = (
        np.concatenate(rates),
        np.concatenate(forces),
        [0.02, -0.03, 0.01],
    )
    rates = rates + bias + 0.01 * rng.normal(size=rates.shape)
    forces = forces + 0.1 * rng.normal(size=forces.shape)
    write(tmp_path / "a.csv", step * np.arange(len(rates)), rates, a=forces)
    flags = ["--flights", "--plot", "fit.png", "--save", "fit.pkl"]
    done = subprocess.run(
        [sys.executable, "-m", "jrigid", "fit", "a.csv", *flags],
        cwd=tmp_path,
        env=os.environ
        | {"PYTHONPATH": str(Path(jr.__file__).parents[1]), "XLA_FLAGS": QUICK},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert "flight 3 of 3" in done.stdout
    assert "samples of 3 trials" in done.stdout
    result = identify.load(tmp_path / "fit.pkl")
    assert_true(result)
    assert str(result) in done.stdout
    np.testing.assert_allclose(result.fitted()[1].bias, bias, atol=0.002)
    sigma = 1 / np.asarray(result.problem.samples.whitener)[0, 0].diagonal()
    np.testing.assert_allclose(sigma, 0.01, rtol=0.15)
    assert (tmp_path / "fit.png").read_bytes().startswith(b"\x89PNG")
