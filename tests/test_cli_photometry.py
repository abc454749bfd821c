"""The command line of light curves: files, options, reports and mistakes."""

import re

import numpy as np
import pytest

import jrigid as jr
from jrigid import _cli
from jrigid._cli import _photometry

ph = jr.photometry
HOUR = 3600.0
DAY = 86400.0
AU = 149597870700.0
EPOCH = 2451545.0
PERIODS = ["--shortest", "4", "--longest", "20"]
ORBIT = "2.3,0.35,10,60,140,40,2451500.5"


def magnitudes(ts):
    """A light curve with a period of 6 h."""
    return 0.3 * np.sin(4 * np.pi * ts / (6 * HOUR))


@pytest.fixture
def damit(tmp_path):
    """A file of DAMIT with two nights."""
    lines = ["2"]
    for night in (0.0, 3.0):
        dates = EPOCH + night + np.linspace(0.0, 0.3, 15)
        light = 10 ** (-0.4 * magnitudes((dates - EPOCH) * DAY))
        lines.append(f"{len(dates)} 0")
        for date, one in zip(dates, light, strict=True):
            lines.append(f"{date:.6f} {one:.6f} 2.0 0.1 0.0 1.0 0.2 0.0")
    path = tmp_path / "curves.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture
def alcdef(tmp_path):
    """An ALCDEF file with a night."""
    dates = EPOCH + np.linspace(0.0, 0.8, 30)
    rows = [
        f"DATA={date:.6f}|{15 + magnitudes((date - EPOCH) * DAY):.4f}" for date in dates
    ]
    head = ["STARTMETADATA", "MAGBAND=V", "DELIMITER=PIPE", "ENDMETADATA"]
    path = tmp_path / "night.txt"
    path.write_text("\n".join(["# a comment", *head, *rows, "ENDDATA"]) + "\n")
    return path


def table(inversion=None):
    """A table as `find_tumblers` returns it, without a search."""
    given = {"correlation": 0.0, "follows": True, "determined": False}
    given |= inversion or {}
    return ph.Inversion([], [], EPOCH, 0.02, 1.0, 20, span=3 * DAY, **given)


def test_pairs_of_periods_of_a_file(damit, capsys):
    assert _cli.main(["photometry", str(damit), *PERIODS]) == 0
    first, tried, head, *rows = capsys.readouterr().out.splitlines()
    assert first == (
        "2 light curves, of which 2 are relative, with 30 points in 3.3 days from JD "
        "2451545.0000"
    )
    assert tried == "periods from 4 to 20 hours are tried"
    assert head.split("  ")[0] == "P_phi [h]"
    assert len(rows) == 10
    best = re.fullmatch(r" *([\d.]+) +([\d.]+) +([\d.]+) %", rows[0])
    assert float(best[3]) > 99


def test_periods_from_two_hours_to_the_span_are_tried_by_themselves(
    damit, monkeypatch, capsys
):
    asked = []

    def find_tumblers(curves, noise, **options):
        asked.append((options["shortest"], options["longest"]))
        return table({"determined": True})

    monkeypatch.setattr(ph, "find_tumblers", find_tumblers)
    assert _cli.main(["photometry", str(damit), "--report"]) == 0
    # Two nights of 0.3 days, 3 days apart.
    np.testing.assert_allclose(asked, [[2 * HOUR, 3.3 * DAY]])
    assert "periods from 2 to 79.2 hours are tried" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("verdict", "status"),
    [
        ({"determined": True}, 0),
        ({}, 3),
        ({"follows": False}, 4),
    ],
)
def test_every_option_reaches_the_inversion(
    damit, monkeypatch, capsys, verdict, status
):
    asked = {}

    def find_tumblers(curves, noise, **options):
        asked.update(options, noise=noise, points=sum(len(x.ts) for x in curves))
        return table(verdict)

    monkeypatch.setattr(ph, "find_tumblers", find_tumblers)
    options = ["--noise", "0.03", "--mode", "long-axis", "--mode", "short-axis"]
    more = ["--inertia", "free", "--pairs", "7"]
    arguments = ["photometry", str(damit), "--report", *PERIODS, *options, *more]
    assert _cli.main(arguments) == status
    assert asked == {
        "shortest": 4 * HOUR,
        "longest": 20 * HOUR,
        "modes": ["long-axis", "short-axis"],
        "inertia": "free",
        "pairs": 7,
        "noise": 0.03,
        "points": 30,
    }
    shown = capsys.readouterr().out
    assert "chi-square over 20 degrees of freedom is 1.00" in shown
    assert "`pairs`" not in shown


def test_an_orbit_gives_an_alcdef_file_its_vectors(alcdef, monkeypatch, capsys):
    read = []

    def period_pairs(curves, *_, **__):
        read.extend(curves)
        return ph.PeriodPairs(np.ones(1), np.ones(1), np.ones(1))

    monkeypatch.setattr(ph, "period_pairs", period_pairs)
    command = ["photometry", str(alcdef), *PERIODS, "--orbit", ORBIT]
    assert _cli.main(command) == 0
    assert _cli.main([*command, "--time-scale", "tai"]) == 0
    assert "30 points" in capsys.readouterr().out
    angles = np.radians([10, 60, 140, 40])
    orbit = ph.Orbit(2.3 * AU, 0.35, *angles, 2451500.5)
    for curve, time_scale in zip(read, ("tdb", "tai"), strict=True):
        (expected,) = ph.read_alcdef(
            alcdef, ph.geometry_of_orbit(orbit), time_scale=time_scale
        )
        np.testing.assert_array_equal(curve.to_sun, expected.to_sun)
        np.testing.assert_array_equal(curve.ts, expected.ts)


def test_the_best_tumbler_is_drawn(damit, tmp_path, monkeypatch):
    from matplotlib import pyplot

    drawn = []

    def light_curves(curves, found):
        drawn.append((len(curves), found))
        return {"unfolded": pyplot.figure().add_subplot()}

    found = table()
    monkeypatch.setattr(ph, "find_tumblers", lambda *_, **__: found)
    monkeypatch.setattr(jr.plot, "light_curves", light_curves)
    picture = tmp_path / "curves.png"
    arguments = ["photometry", str(damit), "--report", *PERIODS, "--plot", str(picture)]
    assert _cli.main(arguments) == 3
    assert drawn == [(2, found)]
    assert picture.stat().st_size > 1000
    pyplot.close("all")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["none.txt"], "No such file"),
        (["curves.txt", "--orbit", ORBIT], "Argument `--orbit` must be left out"),
        (["curves.txt", "--time-scale", "utc"], "Argument `--time-scale` must be left"),
        (["night.txt"], "Argument `--orbit` must be given for an ALCDEF file"),
        (
            ["night.txt", "--orbit", ORBIT, "--time-scale", "gps"],
            "Argument `--time-scale` must be one of tdb, tt, tai, utc",
        ),
        (
            ["night.txt", "--orbit", ORBIT.replace("0.35", "1.2")],
            "Argument `--orbit` (eccentricity) must be from 0 to below 1",
        ),
        (["broken.txt"], "broken.txt, line 3: brightness must be positive"),
        (["curves.txt", "--plot", "a.png"], "Argument `--plot` needs `--report`"),
        (["few.txt", "--report"], "Argument `path` must hold at least 12 points"),
        (
            ["curves.txt", "--longest", "3"],
            "must be positive periods in this order, but they are 4 and 3 hours",
        ),
    ],
)
def test_mistakes_are_said_in_a_sentence(
    arguments, words, damit, alcdef, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    lines = damit.read_text().splitlines()
    broken = [*lines[:2], lines[2].replace(lines[2].split()[1], "-1"), *lines[3:]]
    (tmp_path / "broken.txt").write_text("\n".join(broken))
    (tmp_path / "few.txt").write_text("\n".join(["1", "3 0", *lines[2:5]]))
    assert _cli.main(["photometry", *PERIODS, *arguments]) == 1
    said = capsys.readouterr().err
    assert said.startswith("jrigid: ")
    assert said.count("\n") == 1
    assert words in said


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["photometry"], "required: path"),
        (["photometry", "a.txt", "--shortest", "x"], "--shortest: invalid float"),
        (["photometry", "a.txt", *PERIODS, "--mode", "spin"], "invalid choice"),
        (
            ["photometry", "a.txt", *PERIODS, "--report", "--pairs", "0"],
            "argument --pairs: it must be a whole number from 1, but it is '0'",
        ),
        (["photometry", "a.txt", *PERIODS, "--orbit", "1,2,3"], "seven numbers"),
        (["photometry", "a.txt", *PERIODS, "--orbit", "a,b"], "seven numbers"),
        (
            ["photometry", "a.txt", *PERIODS, "--report", "--plot", "none/a.png"],
            "argument --plot: its folder must exist, but 'none' does not",
        ),
        (
            ["photometry", "a.txt", *PERIODS, "--report", "--plot", "a.xyz"],
            "argument --plot: its suffix must be one of .png, .pdf, ",
        ),
    ],
)
def test_wrong_arguments_are_left_to_argparse(arguments, words, capsys):
    with pytest.raises(SystemExit) as stop:
        _cli.main(arguments)
    assert stop.value.code == 2
    said = capsys.readouterr().err
    assert "usage: jrigid photometry" in said
    assert words in said


def test_no_text_of_the_search_names_an_argument_that_has_an_option():
    texts = [x for _, x in _photometry.OPTIONS]
    report = table({"follows": False}).report()
    assert "`pairs`" in report
    assert "`--pairs`" in _cli._with_options(report)
    assert all("--" in x or x in ("", "`path`") for x in texts)
