"""ALCDEF files and Kepler orbits: known geometry, light time, and errors by line."""

import importlib.util
import sys
import warnings

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import jrigid as jr

ph = jr.photometry
# Astropy says so half a year after its last update.
pytestmark = pytest.mark.filterwarnings("ignore:leap-second file is expired")

AU = 149597870700.0
LIGHT = 299792458.0
DAY = 86400.0
GM = 1.32712440041e20
J2000 = 2451545.0
OBLIQUITY = np.radians(84381.448 / 3600)  # of the ecliptic of J2000
ORBIT = ph.Orbit(2.3 * AU, 0.35, 0.2, 1.1, 2.5, 0.7, 2457000.5)
DATES = [f"{2457100.5 + 0.013 * i:.6f}" for i in range(40)]


def write(tmp_path, lines):
    """A file of these lines."""
    path = tmp_path / "session.txt"
    path.write_text("\n".join(lines) + "\n")
    return path


def block(rows, delimiter="PIPE", **metadata):
    """The lines of a session."""
    sign = {"PIPE": "|", "TAB": "\t"}.get(delimiter, "|")
    pairs = {"OBJECTNAME": "Test", "FILTER": "C", "MAGBAND": "V", **metadata}
    lines = [f"{key}={value}" for key, value in pairs.items()]
    data = ["DATA=" + sign.join(row) for row in rows]
    head = ["STARTMETADATA", *lines, f"DELIMITER={delimiter}", "ENDMETADATA"]
    return [*head, *data, "ENDDATA"]


def linear(julian_dates):
    """A body that leaves the Sun and the Earth fast and in a straight line."""
    days = (julian_dates - 2457100.5)[:, None]
    to_sun = AU * (np.array([[2.0, 0.3, -0.1]]) + days * np.array([[0.3, 0.0, 0.1]]))
    to_observer = to_sun - AU * np.array([[0.9, 0.4, 0.0]])
    return to_sun, to_observer


def modulus(to_sun, to_observer):
    """5 log10(r delta)."""
    r = np.linalg.norm(to_sun, axis=1) / AU
    delta = np.linalg.norm(to_observer, axis=1) / AU
    return 5 * np.log10(r * delta)


def truth(ts):
    """Magnitudes of a body at unit distances, at times of departure."""
    return 15 + 0.3 * np.sin(2 * np.pi * ts / 7000)


@pytest.mark.parametrize("delimiter", ["PIPE", "TAB"])
@pytest.mark.parametrize("positions", [linear, ph.geometry_of_orbit(ORBIT)])
def test_apparent_magnitudes_come_back(tmp_path, delimiter, positions):
    dates = np.array(DATES, dtype=float)
    to_sun, to_observer = positions(dates)
    seen = np.array([round((float(d) - 2457100.5) * DAY, 3) for d in DATES])
    left = seen - np.linalg.norm(to_observer, axis=1) / LIGHT
    magnitudes = truth(left) + modulus(to_sun, to_observer)
    rows = [
        (d, f"{m:.12f}", "0.01", "1.2", "")
        for d, m in zip(DATES, magnitudes, strict=True)
    ]
    path = write(tmp_path, block(rows, delimiter, LTCAPP="NONE", REDUCEDMAGS="NONE"))
    (curve,) = ph.read_alcdef(path, positions, epoch=2457100.5)
    assert curve.epoch == 2457100.5
    assert curve.is_relative
    assert curve.band == "V"
    np.testing.assert_allclose(curve.ts, left, rtol=0, atol=1e-6)
    expected = 10 ** (-0.4 * truth(left))
    np.testing.assert_allclose(curve.brightness, expected / expected.mean(), rtol=1e-10)
    np.testing.assert_array_equal(curve.to_sun, to_sun)
    np.testing.assert_array_equal(curve.to_observer, to_observer)
    np.testing.assert_array_equal(curve.errors, 0.01)


def test_errors_are_taken_where_each_point_has_one(tmp_path):
    rows = [("2457100.5", "15.0", "0.01"), ("2457100.6", "15.1", "")]
    (curve,) = ph.read_alcdef(write(tmp_path, block(rows)), linear)
    assert curve.errors is None
    wrong = [("2457100.5", "15.0", "bad")]
    with pytest.raises(ValueError, match="the error must be a number"):
        ph.read_alcdef(write(tmp_path, block(wrong)), linear)


def test_a_table_gives_the_vectors_of_an_orbit(untyped):
    """Splines of a table of days are good to a hundredth of a second of light time."""
    orbit = ph.geometry_of_orbit(ORBIT)
    days = 2457100.5 + np.arange(-3.0, 6.0)
    table = ph.geometry_of_table(days, *orbit(days))
    dates = np.array(DATES, dtype=float)
    for found, expected in zip(table(dates), orbit(dates), strict=True):
        np.testing.assert_allclose(found, expected, rtol=0, atol=0.01 * LIGHT)
    with pytest.raises(ValueError, match=r"within the table, from 2457097\.5 to"):
        table(dates + 100)
    with pytest.raises(ValueError, match="four dates or more that increase"):
        ph.geometry_of_table(days[::-1], *orbit(days))
    with pytest.raises(ValueError, match="four dates or more that increase"):
        ph.geometry_of_table(days[0], *orbit(days[:1]))
    with pytest.raises(ValueError, match=r"finite and have the shape \(9, 3\)"):
        ph.geometry_of_table(days, orbit(days)[0], orbit(days[1:])[1])
    with pytest.raises(ValueError, match=r"finite and have the shape \(9, 3\)"):
        ph.geometry_of_table(days, *orbit(days[1:]))


@pytest.mark.parametrize("applied", ["AVERAGE", "POINT", "point"])
def test_corrected_times_stay_and_the_geometry_is_that_of_observation(
    tmp_path, applied
):
    seen = 2457100.5 + 0.01 * np.arange(5)
    to_sun, to_observer = linear(seen)
    left = seen - np.linalg.norm(to_observer, axis=1) / LIGHT / DAY
    rows = [(f"{date:.12f}", "15.0") for date in left]
    path = write(tmp_path, block(rows, LTCAPP=applied, LTCDAYS="-0.01"))
    (curve,) = ph.read_alcdef(path, linear, epoch=2457100.5)
    np.testing.assert_allclose(curve.ts, (left - 2457100.5) * DAY, atol=1e-4)
    # A Julian date as a float is good to 4e-10 days.
    np.testing.assert_allclose(curve.to_sun, to_sun, rtol=0, atol=1e-8 * AU)
    np.testing.assert_allclose(curve.to_observer, to_observer, rtol=0, atol=1e-8 * AU)
    wrong = linear(left)[0]
    assert np.abs(wrong - curve.to_sun).max() > 1e-4 * AU


@pytest.mark.parametrize(
    ("reduced", "takes_off"), [("NONE", True), ("AVERAGE", True), ("POINT", False)]
)
def test_distances_are_taken_off_once(tmp_path, reduced, takes_off):
    dates = ["2457100.5", "2457101.5"]
    rows = [(date, "15") for date in dates]
    path = write(tmp_path, block(rows, REDUCEDMAGS=reduced, UCORMAG="-2.1"))
    (curve,) = ph.read_alcdef(path, linear)
    off = modulus(*linear(np.array(dates, dtype=float))) * takes_off
    expected = 10 ** (0.4 * off)
    np.testing.assert_allclose(curve.brightness, expected / expected.mean(), rtol=1e-12)


def test_sessions_share_an_epoch_and_dates_keep_their_digits(tmp_path):
    first = block([("2457100.1234567891", "3"), ("2457100.1234567892", "3")])
    second = block([("2457101.1234567891", "-400e-1")], MAGBAND="", FILTER="R")
    path = write(tmp_path, ["# a comment", "", *first, *second])
    one, two = ph.read_alcdef(path, linear)
    assert one.epoch == two.epoch == 2457100.1234567891
    assert (one.band, two.band) == ("V", "R")
    steps = np.diff(one.ts + np.linalg.norm(one.to_observer, axis=1) / LIGHT)
    np.testing.assert_allclose(steps, DAY * 1e-10, rtol=1e-3)
    np.testing.assert_array_equal(two.brightness, [1.0])


GOOD = block([("2457100.5", "15"), ("2457100.6", "15")])


def changed(line, text):
    """The good file with another line; lines count from 1."""
    return [*GOOD[: line - 1], *text, *GOOD[line:]]


@pytest.mark.parametrize(
    ("lines", "line", "words"),
    [
        (GOOD[:-1], 8, "the block of line 1 has no ENDDATA"),
        (GOOD[:-1] + GOOD, 9, "the block of line 1 has no ENDDATA"),
        (["DATA=2457100.5|15", *GOOD], 1, "'DATA' is outside of a block"),
        ([*GOOD, "DATA=2457100.5|15"], 10, "'DATA' is outside of a block"),
        (changed(6, []), 6, "put ENDMETADATA before it"),
        (changed(7, ["DATA=24571OO.5|15"]), 7, "the Julian date must be a number"),
        (changed(7, ["DATA=57100.5|15"]), 7, "is no Julian date of this age"),
        (changed(7, ["DATA=2457100.5|bright"]), 7, "the magnitude must be a number"),
        (changed(7, ["DATA=2457100.5|inf"]), 7, "the magnitude must be a number"),
        (changed(7, ["DATA=2457100.5|"]), 7, "the magnitude is missing"),
        (changed(7, ["DATA=2457100.5\t15"]), 7, "the magnitude is missing"),
        (changed(8, ["DATA=2457100.6|99.99"]), 8, "stands for a missing one"),
        (changed(8, ["DATA=2457100.4|15"]), 8, "sort the points"),
        (changed(5, ["DELIMITER=COMMA"]), 5, "DELIMITER must be one of PIPE, TAB"),
        (changed(5, []), 1, "the metadata have no DELIMITER"),
        (changed(4, ["LTCAPP=MAYBE"]), 4, "LTCAPP must be one of NONE"),
        (changed(4, ["REDUCEDMAGS=YES"]), 4, "REDUCEDMAGS must be one of NONE"),
        (changed(4, ["no keyword here"]), 4, "a line must be KEYWORD=value"),
        ([*GOOD[:6], "ENDDATA"], 7, "the block of line 1 has no DATA"),
        (["# nothing"], 1, "there is no STARTMETADATA"),
    ],
)
def test_errors_name_the_file_and_the_line(tmp_path, lines, line, words):
    path = write(tmp_path, lines)
    with pytest.raises(ValueError, match=rf"session.txt, line {line}: .*{words}") as e:
        ph.read_alcdef(path, linear)
    assert len(str(e.value)) < 200


def test_several_objects_are_refused(tmp_path):
    eros = block([("2457100.5", "15.0")], OBJECTNUMBER="433")
    # A number is not known at first.
    first = block([("2457100.4", "15.0")], OBJECTNUMBER="0")
    lines = [*first, *eros, *eros]
    assert len(ph.read_alcdef(write(tmp_path, lines), linear)) == 3
    other = block([("2457100.6", "15.0")], OBJECTNUMBER="99942")
    with pytest.raises(ValueError, match="the object is 99942, but that of sessions"):
        ph.read_alcdef(write(tmp_path, [*lines, *other]), linear)


def test_numbers_and_designations_tell_objects_apart(tmp_path):
    padded = block([("2457100.5", "15.0")], OBJECTNUMBER="00433")
    plain = block([("2457100.6", "15.0")], OBJECTNUMBER="433")
    assert len(ph.read_alcdef(write(tmp_path, [*padded, *plain]), linear)) == 2
    one = block([("2457100.5", "15.0")], OBJECTNUMBER="0", MPCDESIG="2001 AA")
    other = block([("2457100.6", "15.0")], OBJECTNUMBER="0", MPCDESIG="2002 BB")
    same = block([("2457100.6", "15.0")], OBJECTNUMBER="0", MPCDESIG="2001_aa")
    assert len(ph.read_alcdef(write(tmp_path, [*one, *same]), linear)) == 2
    # A numbered object has the designations of all its discoveries.
    names = ("1898 DQ", "1956 PC", "I98D00Q")
    lines = []
    for i, name in enumerate(names):
        point = [(f"245710{i}.5", "15.0")]
        lines += block(point, OBJECTNUMBER="433", MPCDESIG=name)
    assert len(ph.read_alcdef(write(tmp_path, lines), linear)) == 3
    with pytest.raises(ValueError, match="the object is 2002BB, but that of sessions"):
        ph.read_alcdef(write(tmp_path, [*one, *other]), linear)


@pytest.mark.parametrize("epoch", [np.nan, np.inf, 57100.5])
def test_an_epoch_that_is_no_julian_date_is_refused(epoch, tmp_path):
    with pytest.raises(ValueError, match="`epoch` must be a Julian date of this age"):
        ph.read_alcdef(write(tmp_path, GOOD), linear, epoch=epoch)


def test_kilometres_and_astronomical_units_are_refused(tmp_path):
    dates = 2457099.0 + np.arange(6)
    sun, observer = linear(dates)
    # A body as far from the Sun as Jupiter's Trojans.
    with pytest.raises(ValueError, match="must give the Sun in metres"):
        ph.geometry_of_table(dates, 2.5 * sun / 1e3, observer)
    for unit in (1e3, 1.495978707e11):
        with pytest.raises(ValueError, match="must give the Sun in metres"):
            ph.geometry_of_table(dates, sun / unit, observer / unit)
        with pytest.raises(ValueError, match="must give the Sun in metres"):
            ph.read_alcdef(
                write(tmp_path, GOOD), lambda x, u=unit: [y / u for y in linear(x)]
            )


def test_positions_must_be_vectors(tmp_path):
    path = write(tmp_path, GOOD)

    def short(julian_dates):
        return linear(julian_dates[:1])

    def outside(julian_dates):
        to_sun, to_observer = linear(julian_dates)
        return to_sun, np.nan * to_observer

    with pytest.raises(ValueError, match=r"`positions` must return two arrays of"):
        ph.read_alcdef(path, short)
    with pytest.raises(ValueError, match="check the dates that it covers"):
        ph.read_alcdef(path, outside)


@pytest.mark.parametrize("eccentricity", [0.0, 0.35, 0.97])
def test_orbit_is_the_two_body_problem(eccentricity):
    axis = 1.4 * AU
    orbit = ph.Orbit(axis, eccentricity, 0.6, 1.1, 2.5, 0.0, J2000)
    normal = [np.sin(1.1) * np.sin(0.6), -np.cos(1.1) * np.sin(0.6), np.cos(0.6)]
    start = orbit.position(np.array([J2000]))[0]
    # At perihelion the velocity is across, of the speed of the vis-viva equation.
    size = np.sqrt(GM / axis * (1 + eccentricity) / (1 - eccentricity))
    velocity = size * np.cross(normal, start) / np.linalg.norm(start)
    np.testing.assert_allclose(np.linalg.norm(start), axis * (1 - eccentricity))
    np.testing.assert_allclose(np.dot(normal, start) / axis, 0, atol=1e-15)

    def rate(_, y):
        return np.concatenate([y[3:], -GM * y[:3] / np.linalg.norm(y[:3]) ** 3])

    days = np.linspace(0.0, 700.0, 15)
    solution = solve_ivp(
        rate,
        (0.0, days[-1] * DAY),
        np.concatenate([start, velocity]),
        method="DOP853",
        t_eval=days * DAY,
        rtol=1e-12,
        atol=1e-3,
    )
    difference = orbit.position(J2000 + days) - solution.y[:3].T
    assert np.abs(difference).max() < 1e-8 * AU


def test_node_and_argument_of_perihelion_are_where_they_should_be():
    """At perihelion with argument 0 a body is at its node, and then rises."""
    orbit = ph.Orbit(AU, 0.2, 0.3, 1.1, 0.0, 0.0, J2000)
    at_node, later = orbit.position(J2000 + np.array([0.0, 10.0]))
    direction = at_node / np.linalg.norm(at_node)
    np.testing.assert_allclose(direction, [np.cos(1.1), np.sin(1.1), 0], atol=1e-15)
    assert later[2] > 0


def test_earth_at_j2000_agrees_with_vsop87():
    """Check value of VSOP87 (P. Bretagnon and G. Francou, 1988), for the Earth."""
    longitude, latitude, distance = 1.7519238681, -0.0000039656, 0.9833276819
    level = distance * np.cos(latitude)
    expected = [
        level * np.cos(longitude),
        level * np.sin(longitude),
        distance * np.sin(latitude),
    ]
    (earth,) = ph.earth_position(np.array([J2000])) / AU
    np.testing.assert_allclose(earth, expected, rtol=0, atol=1.3e-4)


def test_sun_at_the_equinox_of_2013():
    """2013-03-20 11:02 UT: apparent longitude 0 of date, precessed to J2000."""
    date = 2456371.5 + (11 + 2 / 60) / 24 + 67 / DAY
    x, y, _ = -ph.earth_position(np.array([date]))[0]
    precession = 50.29 / 3600 * (date - J2000) / 365.25
    aberration = -20.5 / 3600
    longitude = np.degrees(np.arctan2(y, x)) + precession + aberration
    assert abs(longitude) < 0.02


def test_perihelion_of_the_earth_in_2013():
    """2013-01-02, 0.98329 au; the Moon shifts the date by up to about two days."""
    dates = 2456289.5 + np.arange(0.0, 15.0, 0.05)
    distance = np.linalg.norm(ph.earth_position(dates), axis=1) / AU
    assert abs(distance.min() - 0.98329) < 1e-4
    assert abs(dates[distance.argmin()] - 2456294.7) < 3


def test_light_time_of_an_orbit():
    dates = 2457100.5 + 30 * np.arange(4.0)
    to_sun, to_observer = ph.geometry_of_orbit(ORBIT)(dates)
    days = np.linalg.norm(to_observer, axis=1) / LIGHT / DAY
    # A Julian date as a float is good to 4e-10 days, in which the body moves 1 m.
    np.testing.assert_allclose(to_sun, -ORBIT.position(dates - days), rtol=0, atol=20)
    earth = ph.earth_position(dates)
    np.testing.assert_allclose(to_observer - to_sun, earth, rtol=0, atol=1)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ((-AU, 0.1, 0.0), "`semi_major_axis` must be positive"),
        ((AU, 1.0, 0.0), "`eccentricity` must be from 0 to below 1"),
        ((AU, -0.1, 0.0), "`eccentricity` must be from 0 to below 1"),
        ((AU, 0.1, np.nan), "`inclination` must be finite"),
        ((AU, 0.1, 3.331), "`inclination` must be from 0 to pi, in radians"),
    ],
)
def test_elements_that_are_no_ellipse(changes, words):
    with pytest.raises(ValueError, match=words):
        ph.Orbit(*changes, 0.0, 0.0, 0.0, J2000)


@pytest.fixture(autouse=True)
def _no_network(monkeypatch):
    """Tests look for no newer tables of the Earth's rotation."""
    if importlib.util.find_spec("astropy"):
        iers = importlib.import_module("astropy.utils.iers")
        monkeypatch.setattr(iers.conf, "auto_download", False)


def sky(frame, positions, dates, scale="tdb"):
    """Coordinates of astropy from positions [m] at Julian dates."""
    coordinates = pytest.importorskip("astropy.coordinates")
    units = pytest.importorskip("astropy.units")
    time = pytest.importorskip("astropy.time")
    times = time.Time(dates, format="jd", scale=scale)
    x, y, z = np.asarray(positions).T * units.m
    return coordinates.SkyCoord(
        x, y, z, representation_type="cartesian", frame=frame, obstime=times
    )


def test_heliocentric_coordinates_are_those_of_an_orbit(tmp_path):
    """The Earth's mean elements are good to 1e-4 au."""
    orbit = ph.geometry_of_orbit(ORBIT)
    days = 2457100.5 + np.arange(-3.0, 6.0)
    body = sky("heliocentriceclipticiau76", -orbit(days)[0], days)
    positions = ph.geometry_of_coordinates(body)
    dates = np.array(DATES, dtype=float)
    to_sun, to_observer = positions(dates)
    expected, to_earth = orbit(dates)
    np.testing.assert_allclose(to_sun, expected, rtol=0, atol=0.01 * LIGHT)
    np.testing.assert_allclose(to_observer, to_earth, rtol=0, atol=2e-4 * AU)
    path = write(tmp_path, block([(date, "15.0") for date in DATES]))
    (curve,) = ph.read_alcdef(path, positions)
    np.testing.assert_array_equal(curve.to_sun, to_sun)


def test_the_earth_of_astropy_agrees_with_vsop87():
    """The check value of the test above, now for the Earth's centre itself."""
    days = J2000 + np.arange(-2.0, 3.0)
    body = sky("heliocentriceclipticiau76", np.full((5, 3), AU), days)
    to_sun, to_observer = ph.geometry_of_coordinates(body)(np.array([J2000]))
    x, y, z = (to_observer - to_sun)[0] / AU
    longitude, distance = np.arctan2(y, x), np.sqrt(x**2 + y**2 + z**2)
    assert abs(longitude - 1.7519238681) < 1e-6
    assert abs(z / distance + 0.0000039656) < 1e-6
    assert abs(distance - 0.9833276819) < 1e-6


def test_equatorial_coordinates_are_turned_by_the_obliquity():
    """Up to aberration, 1e-4 rad."""
    days = 2457100.5 + np.arange(4.0)
    rng = np.random.default_rng(0)
    from_earth = AU * rng.normal(size=(4, 3))
    _, to_observer = ph.geometry_of_coordinates(sky("gcrs", from_earth, days))(days)
    cosine, sine = np.cos(OBLIQUITY), np.sin(OBLIQUITY)
    turn = np.array([[1, 0, 0], [0, cosine, sine], [0, -sine, cosine]])
    np.testing.assert_allclose(
        to_observer, -from_earth @ turn.T, rtol=0, atol=5e-4 * AU
    )


def test_an_observer_is_away_from_the_centre_of_the_earth():
    """At J2000 the sidereal time of Greenwich was 280.46 degrees."""
    coordinates = pytest.importorskip("astropy.coordinates")
    units = pytest.importorskip("astropy.units")
    days = J2000 + np.arange(-2.0, 3.0)
    body = sky("heliocentriceclipticiau76", np.full((5, 3), AU), days, scale="utc")
    site = coordinates.EarthLocation.from_geocentric(6.4e6, 0, 0, units.m)
    from_site = ph.geometry_of_coordinates(body, site)
    again = ph.geometry_of_coordinates(body, site.get_itrs(body.obstime))
    # The dates of the table are those of TDB.
    dates = body.obstime.tdb.jd
    from_centre = ph.geometry_of_coordinates(body)
    offset = (from_site(dates)[1] - from_centre(dates)[1])[2]
    np.testing.assert_array_equal(from_site(dates)[1], again(dates)[1])
    x, y, z = offset
    ascension = np.arctan2(np.cos(OBLIQUITY) * y - np.sin(OBLIQUITY) * z, x)
    assert abs(np.linalg.norm(offset) - 6.4e6) < 2e3
    assert abs(np.degrees(ascension) % 360 - 280.46) < 0.01


@pytest.mark.parametrize(
    ("time_scale", "behind"), [("utc", 68.184), ("tai", 32.184), ("tt", 0.0)]
)
def test_a_time_scale_becomes_that_of_seconds(tmp_path, time_scale, behind):
    """A leap second was at the end of 2016, 2457754.5. TDB and TT agree to 2 ms."""
    dates = ["2457753.25", "2457755.25"]
    path = write(tmp_path, block([(date, "15.0") for date in dates], LTCAPP="POINT"))
    asked = []

    def positions(julian_dates):
        asked.append(julian_dates)
        return linear(julian_dates)

    (curve,) = ph.read_alcdef(path, positions, epoch=2457753.25, time_scale=time_scale)
    assert abs(curve.ts[0] - behind) < 2e-3
    leap = 1.0 if time_scale == "utc" else 0.0
    assert abs(curve.ts[1] - curve.ts[0] - 2 * DAY - leap) < 1e-4
    # Positions are asked for at dates of TDB.
    np.testing.assert_allclose((asked[0] - 2457753.25) * DAY, curve.ts, atol=1e-3)


def test_times_of_another_scale_keep_their_digits(tmp_path):
    rows = [("2457754.250000000012", "15.0"), ("2457754.250000000112", "15.0")]
    path = write(tmp_path, block(rows, LTCAPP="POINT"))
    (curve,) = ph.read_alcdef(path, linear, time_scale="tai")
    np.testing.assert_allclose(curve.ts, [0, 1e-10 * DAY], rtol=1e-4)


def test_nothing_is_downloaded(monkeypatch):
    """Not even where the tables of the Earth's rotation are old."""
    coordinates = pytest.importorskip("astropy.coordinates")
    iers = pytest.importorskip("astropy.utils.iers.iers")
    monkeypatch.setattr(iers.conf, "auto_download", True)
    # So old that all tables are.
    monkeypatch.setattr(iers.conf, "auto_max_age", 10)
    asked = []

    def download(*arguments, **options):
        asked.append(arguments)
        raise OSError

    monkeypatch.setattr(iers, "download_file", download)
    days = 2461380.5 + np.arange(5.0)
    body = sky("gcrs", np.full((5, 3), AU), days)
    site = coordinates.EarthLocation.from_geodetic(10.0, 50.0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        to_sun, _ = ph.geometry_of_coordinates(body, site)(days)
    assert np.all(np.isfinite(to_sun))
    assert not asked


def test_dates_may_be_one_number_or_a_list(untyped):
    days = J2000 + np.arange(5.0)
    orbit = ph.geometry_of_orbit(ORBIT)
    for positions in (orbit, ph.geometry_of_table(days, *orbit(days))):
        expected = positions(days[1:2])
        for dates in (float(days[1]), [days[1]]):
            np.testing.assert_array_equal(positions(dates), expected)
    assert ph.earth_position([J2000, J2000 + 1]).shape == (2, 3)
    assert ORBIT.position([J2000]).shape == (1, 3)


def test_mistakes_with_coordinates_are_named(tmp_path):
    days = J2000 + np.arange(5.0)
    body = sky("icrs", np.full((5, 3), AU), days)
    for wrong in (body[:3], body[::-1]):
        with pytest.raises(ValueError, match="at least 4 times that increase"):
            ph.geometry_of_coordinates(wrong)
    coordinates = pytest.importorskip("astropy.coordinates")
    with pytest.raises(ValueError, match="at least 4 times that increase"):
        ph.geometry_of_coordinates(coordinates.SkyCoord(body.cartesian, frame="icrs"))
    sphere = body.represent_as("unitspherical")
    direction = coordinates.SkyCoord(sphere, obstime=body.obstime)
    with pytest.raises(
        ValueError, match="`body` must have a distance for each of the 5"
    ):
        ph.geometry_of_coordinates(direction)
    with pytest.raises(ValueError, match="`observer` must have a distance for each"):
        ph.geometry_of_coordinates(body, body[1:])
    path = write(tmp_path, block([(DATES[0], "15.0")]))
    with pytest.raises(
        ValueError, match="`time_scale` must be one of tdb, tt, tai, utc"
    ):
        ph.read_alcdef(path, linear, time_scale="UTC")


def test_another_scale_without_astropy_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "astropy", None)
    path = write(tmp_path, block([(DATES[0], "15.0")]))
    with pytest.raises(ImportError, match=r'pip install "jrigid\[photometry\]"'):
        ph.read_alcdef(path, linear, time_scale="utc")
