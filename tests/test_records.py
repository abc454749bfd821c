"""Files of sensors as apps write them; clocks, flights and noise with a known truth."""

import io
import itertools
import sys
import types
import zipfile

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

import jrigid as jr

GRAVITY = 9.80665
DEGREE = np.pi / 180
PHYPHOX = '"Time (s)","Gyroscope x (rad/s)","Gyroscope y (rad/s)","Gyroscope z (rad/s)"'
ROWS = np.array([[0.01 * i, 0.1 * i, -0.2 * i, 1.5] for i in range(6)])


def scientific(rows, separator=",", point="."):
    """Numbers as phyphox writes them, `0.000000000E0`."""
    lines = (separator.join(f"{x:.9E}" for x in row) for row in rows)
    return "\n".join(lines).replace(".", point).replace("NAN", "NaN") + "\n"


def read(text, **options):
    return jr.records.read(io.StringIO(text), **options)


def said(reading, words):
    assert any(words in note for note in reading.notes), reading.notes


# phyphox
# --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("separator", "point"),
    [(",", "."), ("\t", "."), (";", "."), ("\t", ","), (";", ",")],
)
def test_phyphox_in_all_its_separators(separator, point):
    text = PHYPHOX.replace(",", separator) + "\n" + scientific(ROWS, separator, point)
    reading = read(text)
    np.testing.assert_allclose(reading.times, ROWS[:, 0], atol=1e-12)
    np.testing.assert_allclose(reading.rates, ROWS[:, 1:], atol=1e-9)
    assert reading.specific_forces is None
    said(reading, "rates (Gyroscope) taken as rad/s: the header says so")
    assert any("decimal commas" in x for x in reading.notes) == (point == ",")


def test_decimal_commas_in_quotes_between_commas():
    reading = read(
        '"t (s)","gx (rad/s)","gy (rad/s)","gz (rad/s)"\n'
        + '"0,5","1,5","2","3"\n' * 1
        + '"0,6","1,5","2","3"\n'
    )
    np.testing.assert_array_equal(reading.times, [0.5, 0.6])
    np.testing.assert_array_equal(reading.rates[0], [1.5, 2.0, 3.0])


def test_columns_between_spaces_under_names_after_a_hash():
    names = "# time (s)  gx (deg/s) gy (deg/s)   gz (deg/s)\n"
    reading = read(names + " 0.5   90 -180  0 \n 0.6 90 -180 45\n0.7 90 -180 45\n")
    np.testing.assert_array_equal(reading.times, [0.5, 0.6, 0.7])
    rates = np.pi * np.array([[0.5, -1, 0], [0.5, -1, 0.25], [0.5, -1, 0.25]])
    np.testing.assert_allclose(reading.rates, rates, rtol=1e-12)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be"])
def test_a_file_of_unicode_text_of_a_spreadsheet(tmp_path, encoding):
    text = PHYPHOX.replace('"', "").replace(",", "\t") + "\n"
    text += scientific(ROWS, "\t", ",")
    mark = "\ufeff" if encoding.endswith("e") else ""  # the others write one
    path = tmp_path / "sheet.txt"
    path.write_bytes((mark + text).encode(encoding))
    np.testing.assert_allclose(
        jr.records.read(path).rates, ROWS[:, 1:], rtol=0, atol=1e-9
    )


def test_phyphox_zip_with_a_clock_for_each_sensor(tmp_path):
    forces = [[0.005 + 0.02 * i, 0.0, 2.0 * i, GRAVITY] for i in range(3)]
    header = PHYPHOX.replace("Gyroscope", "Acceleration").replace("rad/s", "m/s^2")
    with zipfile.ZipFile(tmp_path / "both.zip", "w") as archive:
        archive.writestr("Accelerometer.csv", header + "\n" + scientific(forces))
        archive.writestr("Gyroscope.csv", PHYPHOX + "\n" + scientific(ROWS))
        archive.writestr(
            "meta/time.csv", '"event","experiment time","system time"\n"START",0,1\n'
        )
    reading = jr.records.read(tmp_path / "both.zip")
    np.testing.assert_allclose(reading.times, ROWS[:, 0], atol=1e-12)
    # linear in between, silent before the first and after the last
    y = [np.nan, 0.5, 1.5, 2.5, 3.5, np.nan]
    np.testing.assert_allclose(reading.specific_forces[:, 1], y, atol=1e-9)
    said(reading, "Acceleration: times of its own")


def test_two_time_columns_in_a_file_with_the_shorter_padded():
    header = (
        PHYPHOX
        + ","
        + PHYPHOX.replace("Gyroscope", "Acceleration").replace("rad/s", "m/s²")
    )
    rows = np.full((6, 8), np.nan)
    rows[:, :4], rows[:3, 4:] = (
        ROWS,
        [[0.0, 0, 0, 9.0], [0.02, 0, 0, 10.0], [0.04, 0, 0, 11.0]],
    )
    reading = read(header + "\n" + scientific(rows))
    z = [9.0, 9.5, 10.0, 10.5, 11.0, np.nan]
    np.testing.assert_allclose(reading.specific_forces[:, 2], z)
    np.testing.assert_allclose(reading.rates, ROWS[:, 1:], atol=1e-9)


def test_accelerations_without_gravity_are_no_specific_forces():
    header = PHYPHOX + "".join(f',"Linear Acceleration {a} (m/s^2)"' for a in "xyz")
    reading = read(header + "\n" + scientific(np.hstack([ROWS, ROWS[:, 1:]])))
    assert reading.specific_forces is None
    said(reading, "no specific force")
    header += "".join(f',"Acceleration {a} (m/s^2)"' for a in "xyz")
    reading = read(
        header + "\n" + scientific(np.hstack([ROWS, ROWS[:, 1:], 2 * ROWS[:, 1:]]))
    )
    np.testing.assert_allclose(reading.specific_forces, 2 * ROWS[:, 1:])
    assert "Linear Acceleration x (m/s^2)" in reading.columns


# Sensor Logger
# ------------------------------------------------------------------------------------


def sensor_logger(folder, **sensors):
    folder.mkdir(exist_ok=True)
    for name, rows in sensors.items():
        lines = [
            f"{1727600000000000000 + round(1e9 * t)},{t},{z},{y},{x}\n"
            for t, x, y, z in rows
        ]
        (folder / f"{name}.csv").write_text(
            "time,seconds_elapsed,z,y,x\n" + "".join(lines)
        )
    return folder


def still(force):
    return [[0.01 * i, *force] for i in range(6)]


def test_sensor_logger_columns_are_z_y_x(tmp_path):
    folder = sensor_logger(
        tmp_path / "log",
        Gyroscope=ROWS,
        TotalAcceleration=still([1.0, 2.0, 9.5]),
        Accelerometer=still([7.0, 7.0, 7.0]),
        Magnetometer=still([20.0, 0.0, -40.0]),
    )
    (folder / "Annotation.csv").write_text("time,seconds_elapsed,text\n1,2,trial\n")
    reading = jr.records.read(folder)
    np.testing.assert_allclose(reading.times, ROWS[:, 0], atol=1e-12)
    np.testing.assert_allclose(reading.rates, ROWS[:, 1:])
    np.testing.assert_allclose(reading.specific_forces[3], [1.0, 2.0, 9.5])
    np.testing.assert_allclose(reading.magnetic_fields[3], [20e-6, 0.0, -40e-6])
    said(reading, "rates (Gyroscope) taken as rad/s: so Sensor Logger writes it")
    assert "seconds_elapsed" not in reading.columns


def test_sensor_logger_of_an_iphone_adds_gravity_and_turns_the_sign(tmp_path):
    folder = sensor_logger(
        tmp_path / "log",
        Gyroscope=ROWS,
        Accelerometer=still([0.5, 0.0, 0.0]),
        Gravity=still([0.0, 0.0, -9.8]),
    )
    about = "version,device name,platform,standardisation\n3,phone,{},{}\n"
    for platform, same, sign in (
        ("ios", "false", -1),
        ("ios", "true", 1),
        ("android", "", 1),
    ):
        (folder / "Metadata.csv").write_text(about.format(platform, same))
        reading = jr.records.read(folder)
        np.testing.assert_allclose(
            reading.specific_forces[2], sign * np.array([0.5, 0, -9.8])
        )


@pytest.mark.parametrize(("size", "unit"), [(1.0, "g"), (9.8, "m/s^2")])
def test_forces_without_a_unit_are_recognised_by_gravity(tmp_path, size, unit):
    raw = {"Gyroscope": ROWS, "AccelerometerUncalibrated": still([0.0, 0.0, size])}
    reading = jr.records.read(sensor_logger(tmp_path / "log", **raw))
    expected = size * (GRAVITY if unit == "g" else 1.0)
    np.testing.assert_allclose(reading.specific_forces[0, 2], expected)
    said(reading, f"taken as {unit}: their median is")


def test_the_calibrated_gyro_is_taken(tmp_path):
    raw = {"GyroscopeUncalibrated": 0 * ROWS + ROWS[:, :1], "Gyroscope": ROWS}
    folder = sensor_logger(tmp_path / "log", **raw)
    with zipfile.ZipFile(tmp_path / "log.zip", "w") as archive:
        for name in raw:
            archive.write(folder / f"{name}.csv", f"2026-01-01/{name}.csv")
    reading = jr.records.read(tmp_path / "log.zip")
    np.testing.assert_allclose(reading.rates, ROWS[:, 1:])


def test_sensor_logger_in_one_file():
    names = ["time", "seconds_elapsed", *(f"gyroscope_{a}" for a in "xyz")]
    names += [f"{what}_{a}" for what in ("accelerometer", "gravity") for a in "xyz"]
    rows = np.column_stack(
        [1e9 * ROWS[:, 0], ROWS, np.tile([0.5, 0, 0, 0, 0, 9.8], (6, 1))]
    )
    reading = read(table(names, rows))
    np.testing.assert_allclose(reading.rates, ROWS[:, 1:])
    np.testing.assert_allclose(reading.specific_forces, np.tile([0.5, 0, 9.8], (6, 1)))
    said(reading, "rates (gyroscope) taken as rad/s: so Sensor Logger writes it")


def test_only_what_is_used_is_told_of(tmp_path):
    """And a column may be named that is in one of several files."""
    with zipfile.ZipFile(tmp_path / "some.zip", "w") as archive:
        archive.writestr(
            "Gyroscope.csv", PHYPHOX.replace(",", ";") + "\n" + scientific(ROWS, ";")
        )
        archive.writestr("meta/time.csv", '"event";"time";"system"\n"START";0,5;1,5\n')
        archive.writestr(
            "wind.csv", "t (s),label,u,v,w\n0,calm,1,2,3\n0.1,calm,1,2,3\n"
        )
    reading = jr.records.read(
        tmp_path / "some.zip",
        columns={"specific_forces": ("w", "u", "v")},
        unit={"specific_forces": "g"},
    )
    assert reading.specific_forces[0].tolist() == [3 * GRAVITY, GRAVITY, 2 * GRAVITY]
    assert not any("commas" in note for note in reading.notes)
    with pytest.raises(
        ValueError, match=r"must name columns of one file, but \{'breeze'\} is apart"
    ):
        jr.records.read(tmp_path / "some.zip", columns={"breeze": "u"})
    assert not any(
        "commas" in x for x in read(PHYPHOX + ',n\n0,1,2,3,"a, b"\n1,1,2,3,"c"\n').notes
    )


# Betaflight
# --------------------------------------------------------------------------------------


BETAFLIGHT = (
    "loopIteration, time (us), axisP[0], gyroADC[0]{r}, gyroADC[1]{r}, "
    "gyroADC[2]{r}, accSmooth[0]{a}, accSmooth[1]{a}, accSmooth[2]{a}, motor[0], "
    "flightModeFlags (flags)\n"
)


def blackbox_csv(rates="", forces="", one=2048.0):
    rows = "".join(
        f"{8 * i}, {33011567 + 500 * i}, 0, {i}, -90, 180, 0, 0, {one:g}, {158 + i}, "
        "ANGLE\n"
        for i in range(5)
    )
    return BETAFLIGHT.format(r=rates, a=forces) + rows


def test_blackbox_decode_writes_degrees_and_counts():
    reading = read(blackbox_csv())
    np.testing.assert_allclose(
        reading.times, 33.011567 + 5e-4 * np.arange(5), rtol=1e-12
    )
    np.testing.assert_allclose(
        reading.rates[4], np.array([4, -90, 180]) * DEGREE, rtol=1e-9
    )
    assert reading.specific_forces is None
    said(reading, "left out: their unit is not stated")
    np.testing.assert_array_equal(reading.columns["motor[0]"], 158 + np.arange(5))
    np.testing.assert_array_equal(reading.columns["accSmooth[2]"], 2048)
    assert "flightModeFlags (flags)" not in reading.columns


def raw_counts(most, settings="", integers=True, header=""):
    """A log of counts of a gyro that turns slowly, then as fast as `most` says."""
    shares = np.sin(np.linspace(0, 6, 200))
    values = np.round(most * shares) if integers else most * shares
    rows = "".join(
        f"{i}, {1000 * i}, 0, {x:.7g}, 0, 5, 0, 0, 2048, 158, 0\n"
        for i, x in enumerate(values)
    )
    return settings + BETAFLIGHT.format(r=header, a="") + rows, values


def test_blackbox_raw_counts_are_recognised_by_their_range():
    """12,100 deg/s is no reading of a gyro of 2000 deg/s; 738 deg/s are."""
    text, values = raw_counts(12100)
    reading = read(text)
    np.testing.assert_allclose(reading.rates[:, 0], values / 16.4 * DEGREE, rtol=1e-9)
    said(reading, "taken as counts: no gyro of 2000 deg/s reads 12100 deg/s")
    said(reading, "if they are tenths of deg/s, pass unit=0.00174533")
    one = '"gyro_scale","0x3f800000"\n'  # the bits of 1.0
    np.testing.assert_allclose(read(raw_counts(12100, one)[0]).rates, reading.rates)
    slow = read(raw_counts(900)[0])
    np.testing.assert_allclose(slow.rates[:, 0], raw_counts(900)[1] * DEGREE, rtol=1e-9)
    said(slow, "so Betaflight logs it")


def test_blackbox_unfiltered_rates_alone_are_recognised():
    text, values = raw_counts(12100)
    reading = read(text.replace("gyroADC", "gyroUnfilt"))
    np.testing.assert_allclose(reading.rates[:, 0], values / 16.4 * DEGREE, rtol=1e-9)


@pytest.mark.parametrize(
    ("scale", "factor"),
    [
        ("0x3d79c190", 1 / 16.4),  # degrees per second for each count
        ("3d79c190", 1 / 16.4),  # the same without a prefix
        ("1031389584", 1 / 16.4),  # the same in decimal digits
        ("0x3295ec32", 1.0),  # radians per microsecond: of 1 deg/s
        ("0x30924418", 1 / 16.4),  # radians per microsecond: of one count
    ],
)
def test_blackbox_scales_of_old_firmware(scale, factor):
    text, values = raw_counts(1900, f'"gyro_scale","{scale}"\n')
    reading = read(text)
    np.testing.assert_allclose(reading.rates[:, 0], values * factor * DEGREE, rtol=1e-4)
    assert any("gyro_scale" in x for x in reading.notes)


@pytest.mark.parametrize("scale", ["null", "0", "nan", ""])
def test_a_blackbox_scale_that_is_none(scale):
    text, values = raw_counts(900, f'"gyro_scale","{scale}"\n')
    reading = read(text)
    np.testing.assert_allclose(reading.rates[:, 0], values * DEGREE, rtol=1e-9)
    said(reading, f"gyro_scale is {scale!r}, which is no scale: 1 is taken")


@pytest.mark.parametrize("one", ["0", "null", "nan", ""])
def test_a_blackbox_log_without_an_accelerometer(one):
    reading = read(f'"acc_1G","{one}"\n' + blackbox_csv())
    np.testing.assert_allclose(reading.rates[:, 2], 180 * DEGREE, rtol=1e-9)
    assert reading.specific_forces is None
    said(reading, "left out: their unit is not stated")


def test_blackbox_high_resolution_logs_tenths():
    settings = '"gyro_scale","0x3f800000"\n"blackbox_high_resolution","1"\n'
    text, values = raw_counts(15000, settings)
    reading = read(text)
    np.testing.assert_allclose(reading.rates[:, 0], values / 10 * DEGREE, rtol=1e-9)
    said(reading, "blackbox_high_resolution: tenths")


def test_what_the_caller_says_of_blackbox_counts():
    text, values = raw_counts(12100)
    for unit, factor in (("counts", DEGREE / 16.4), (DEGREE / 10, DEGREE / 10)):
        reading = read(text, unit=unit)
        np.testing.assert_allclose(reading.rates[:, 0], values * factor, rtol=1e-9)
    reading = read(text, unit="deg/s")
    np.testing.assert_allclose(reading.rates[:, 0], values * DEGREE)
    said(reading, "`unit` says so, though no common gyro reads 211 rad/s")


def test_blackbox_numbers_that_are_no_counts_are_asked_about():
    with pytest.raises(
        ValueError, match=r"Argument `unit` must say the unit of the rates"
    ):
        read(raw_counts(12100.5, integers=False)[0])
    with pytest.raises(
        ValueError, match=r"Argument `unit` must say the unit of the rates"
    ):
        read(raw_counts(40000)[0])


def test_blackbox_decode_with_units_asked_for():
    text = blackbox_csv(" (rad/s)", " (m/s/s)", 9.5).replace("-90, 180", "-9, 18")
    reading = read(text)
    np.testing.assert_allclose(reading.rates[4], [4, -9, 18])
    np.testing.assert_allclose(reading.specific_forces[:, 2], 9.5)


def test_blackbox_viewer_puts_its_settings_above():
    above = (
        '"Product","Blackbox flight data recorder"\n"looptime","125"\n"acc_1G","2048"\n'
    )
    above += '"gyro_scale","0x40000000"\n"rates","70,70,70"\n'
    header = BETAFLIGHT.format(r="", a="").replace(" (us)", "")
    reading = read(above + header + "".join(blackbox_csv().splitlines(True)[1:]))
    np.testing.assert_allclose(reading.specific_forces[:, 2], GRAVITY)
    # the bits of 2.0
    np.testing.assert_allclose(
        reading.rates[4], 2 * np.array([4, -90, 180]) * DEGREE, rtol=1e-9
    )
    said(reading, "times (time) taken as us: their median step is 500")
    names = ("gyroADC[2]", "gyroADC[0]", "gyroADC[1]")
    turned = read(
        above + header + "".join(blackbox_csv().splitlines(True)[1:]),
        columns={"rates": names},
    )
    np.testing.assert_array_equal(turned.rates, reading.rates[:, [2, 0, 1]])


def variable_byte(value):
    """Seven bits a byte, the lowest first, as blackbox logs have unsigned numbers."""
    out = []
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def blackbox_log(rows, scale="0x3f800000"):
    """A log with nothing but whole frames, in the format of blackbox version 2."""
    names = (
        "loopIteration,time,gyroADC[0],gyroADC[1],gyroADC[2],"
        "accSmooth[0],accSmooth[1],accSmooth[2]"
    )
    signed = [0, 0, 1, 1, 1, 1, 1, 1]
    header = [
        "Product:Blackbox flight data recorder by Nicholas Sherlock",
        "Data version:2",
        f"Field I name:{names}",
        f"Field I signed:{','.join(map(str, signed))}",
        "Field I predictor:" + ",".join("0" * 8),
        "Field I encoding:" + ",".join(str(1 - x) for x in signed),  # 0 is zigzag
        "Firmware type:Cleanflight",
        f"gyro_scale:{scale}",
        "acc_1G:2048",
        "I interval:1",
        "P interval:1/1",
        "vbatref:0",
        "minthrottle:1070",
        "motorOutput:158,2047",
    ]
    frames = b"".join(
        b"I"
        + b"".join(
            variable_byte((x << 1 ^ x >> 31) if s else x)
            for x, s in zip(row, signed, strict=True)
        )
        for row in rows
    )
    return "".join(f"H {x}\n" for x in header).encode() + frames


END = b"E\xffEnd of log\x00"
FRAMES = [[i, 5000000 + 500 * i, 90 * i, -7, 1000, 3, -4, 2048] for i in range(20)]


def test_a_blackbox_log(tmp_path):
    pytest.importorskip("orangebox")
    path = tmp_path / "log.bbl"
    path.write_bytes(blackbox_log(FRAMES) + END)
    reading = jr.records.read(path)
    rows = np.array(FRAMES, float)
    np.testing.assert_allclose(reading.times, rows[:, 1] * 1e-6)
    np.testing.assert_allclose(reading.rates, rows[:, 2:5] * DEGREE)
    np.testing.assert_allclose(reading.specific_forces, rows[:, 5:] * GRAVITY / 2048)
    np.testing.assert_array_equal(reading.columns["loopIteration"], np.arange(20))
    assert not any("breaks off" in x for x in reading.notes)


def test_logs_in_one_blackbox_file_and_one_that_breaks_off(tmp_path):
    pytest.importorskip("orangebox")
    path = tmp_path / "LOG00001.TXT"  # by what is in it, not by its name
    path.write_bytes(
        blackbox_log(FRAMES) + END + blackbox_log(FRAMES[:9], "0x40000000")
    )
    first, second = (jr.records.read(path, log=i) for i in (1, 2))
    assert first.times.size == 20
    assert second.times.size in (8, 9)
    np.testing.assert_allclose(second.rates[1, 0], 180 * DEGREE)  # its own gyro_scale
    said(first, "log 1 of 2")
    said(second, "the log breaks off")
    with pytest.raises(
        ValueError, match="must be of a log that can be decoded, but: Invalid log"
    ):
        jr.records.read(path, log=3)


def test_a_blackbox_log_through_a_decoder_that_stands_in(tmp_path, monkeypatch):
    class Parser:
        field_names = [  # noqa: RUF012
            "time",
            "gyroADC[0]",
            "gyroADC[1]",
            "gyroADC[2]",
            "flightModeFlags",
        ]
        headers = {"gyro_scale": 0x3F800000}  # noqa: RUF012
        reader = types.SimpleNamespace(log_count=1)

        @staticmethod
        def load(*_, **__):
            return Parser()

        def frames(self):
            for i in range(5):
                yield types.SimpleNamespace(data=(1000 * i, i, 0, 90, ""))
            raise RuntimeError("Unexpected end of log")

    monkeypatch.setitem(sys.modules, "orangebox", types.SimpleNamespace(Parser=Parser))
    path = tmp_path / "log.bfl"
    path.write_bytes(b"H Product:Blackbox flight data recorder")
    reading = jr.records.read(path)
    np.testing.assert_allclose(reading.times, 1e-3 * np.arange(5))
    np.testing.assert_allclose(reading.rates[4], [4 * DEGREE, 0, np.pi / 2])
    said(reading, "breaks off after 5 frames (Unexpected end of log)")


def test_a_blackbox_log_without_the_extra_names_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "orangebox", None)
    path = tmp_path / "log.bbl"
    path.write_bytes(b"H Product:Blackbox flight data recorder")
    with pytest.raises(ImportError, match=r"jrigid\[records\]"):
        jr.records.read(path)


# Anyone's columns, and their units
# ----------------------------------------------------------------


def table(names, columns, separator=","):
    lines = [separator.join(names)]
    return (
        "\n".join(lines + [separator.join(f"{x:.12g}" for x in row) for row in columns])
        + "\n"
    )


def test_the_unit_of_times_is_recognised_where_they_decrease():
    ts = 0.05 * np.arange(50)
    rows = np.column_stack([ts, np.cos(ts), np.sin(ts), ts])[::-1]
    reading = read(table(["t", "wx (rad/s)", "wy (rad/s)", "wz (rad/s)"], rows))
    said(reading, "taken as s: their median step is 0.05")
    said(reading, "newest first")
    np.testing.assert_allclose(reading.times, ts, atol=1e-12)


def test_columns_of_one_name_are_noted():
    rows = np.column_stack([0.01 * np.arange(50), np.ones((50, 4))])
    names = ["t (s)", "wx (rad/s)", "wx (rad/s)", "wy (rad/s)", "wz (rad/s)"]
    said(read(table(names, rows)), "2 columns are called 'wx (rad/s)'")


@pytest.mark.parametrize(
    "names",
    [
        "t,gx,gy,gz",
        "timestamp,gyro_x,gyro_y,gyro_z",
        "Time,GyroX,GyroY,GyroZ",
        "time,omega_x,omega_y,omega_z",
        "ts,rotationRateX,rotationRateY,rotationRateZ",
        "seconds,angular velocity x,angular velocity y,angular velocity z",
        "t,wx,wy,wz",
        "time,gyro.x,gyro.y,gyro.z",
        "t,gyro[0],gyro[1],gyro[2]",
    ],
)
def test_names_that_are_recognised(names):
    reading = read(table(names.split(","), ROWS), unit="rad/s")
    np.testing.assert_allclose(reading.rates, ROWS[:, 1:])
    said(reading, "taken as rad/s: `unit` says so")


def test_columns_by_name_and_a_wheel():
    names = [
        "clock [ms]",
        "a1",
        "a2",
        "a3",
        "b1",
        "b2",
        "b3",
        "speed (rpm)",
        "note",
        "",
    ]
    rows = [[10 * i, 1, 2, 3, 0, 0, 1, 60, np.nan, np.nan] for i in range(5)]
    reading = read(
        table(names, rows, ";"),
        columns={
            "times": "clock",
            "rates": ("a3", "a1", "a2"),
            "wheel": "speed",
            "specific_forces": ("b1", "b2", "b3"),
        },
        unit={"rates": "DPS", "specific_forces": "g"},
    )
    np.testing.assert_allclose(reading.times, 0.01 * np.arange(5))
    np.testing.assert_allclose(reading.rates[0], np.array([3, 1, 2]) * DEGREE)
    np.testing.assert_allclose(reading.specific_forces[0], [0, 0, GRAVITY])
    np.testing.assert_allclose(reading.columns["wheel"], 2 * np.pi)
    assert set(reading.columns) == {"wheel"}


def test_the_caller_is_right_and_the_header_is_told_of():
    reading = read(
        table(["t (s)", "gx (rad/s)", "gy (rad/s)", "gz (rad/s)"], ROWS), unit="°/s"
    )
    np.testing.assert_allclose(reading.rates, ROWS[:, 1:] * DEGREE)
    said(reading, "`unit` says so, though the file says rad/s")


@pytest.mark.parametrize(
    ("step", "unit", "factor"),
    [
        (0.005, "s", 1.0),
        (0.1, "s", 1.0),
        (5.0, "ms", 1e-3),
        (125.0, "us", 1e-6),
        (2e6, "ns", 1e-9),
    ],
)
def test_times_are_recognised_by_their_step(step, unit, factor):
    rows = np.column_stack([step * np.arange(6), ROWS[:, 1:]])
    reading = read(table(["t", "gx", "gy", "gz"], rows), unit="rad/s")
    np.testing.assert_allclose(reading.times, factor * rows[:, 0], rtol=1e-9)
    said(reading, f"times (t) taken as {unit}: their median step is")


def test_times_of_an_epoch_count_from_the_first_reading():
    rows = np.column_stack([1.7276e9 + 0.01 * np.arange(6), ROWS[:, 1:]])
    names = ["t (s)", "gx (rad/s)", "gy (rad/s)", "gz (rad/s)"]
    text = "\n".join(
        [",".join(names), *(",".join(repr(float(x)) for x in r) for r in rows)]
    )
    reading = read(text)
    np.testing.assert_allclose(reading.times, ROWS[:, 0], atol=1e-6)
    said(reading, "times count from 1727600000.0")


@pytest.mark.parametrize(
    ("stated", "factor"),
    [
        ("rad/sec", 1.0),
        ("radians/second", 1.0),
        ("Degrees / s", DEGREE),
        ("mdps", 1e-3 * DEGREE),
    ],
)
def test_spellings_of_units(stated, factor):
    names = ["time (seconds)", *(f"gyro {a} [{stated}]" for a in "xyz")]
    np.testing.assert_allclose(read(table(names, ROWS)).rates, factor * ROWS[:, 1:])


def test_a_unit_may_be_the_end_of_a_name():
    names = ["t_s", *(f"g{a}_mdps" for a in "xyz")]
    rates = read(table(names, ROWS)).rates
    np.testing.assert_allclose(rates, 1e-3 * DEGREE * ROWS[:, 1:])


@pytest.mark.parametrize(("stated", "most"), [("deg/s", 12100), ("rad/s", 200)])
def test_rates_beyond_every_gyro_are_asked_about(stated, most):
    names = ["t (s)", *(f"gyro {a} ({stated})" for a in "xyz")]
    rows = ROWS * [1, 1, 1, most / 1.5]
    with pytest.raises(
        ValueError, match=r"Argument `unit` must .* no common gyro reads"
    ) as error:
        read(table(names, rows))
    for words in (
        f"number, {most}, is",
        "`unit='rad/s'`",
        "`unit='deg/s'`",
        "`unit='counts'`",
    ):
        assert words in str(error.value), words
    reading = read(table(names, rows), unit=stated)
    assert reading.rates[0, 2] == pytest.approx(
        most * (DEGREE if stated == "deg/s" else 1)
    )
    said(reading, "though no common gyro reads")


def test_a_unit_may_be_a_factor():
    names = ["t", "gx", "gy", "gz", "ax", "ay", "az"]
    rows = np.column_stack([ROWS, np.tile([0, 0, 2048], (6, 1))])
    reading = read(table(names, rows), unit=0.001)
    np.testing.assert_allclose(reading.rates, 0.001 * ROWS[:, 1:])
    said(reading, "rates (gx, gy, gz) multiplied by 0.001: `unit` says so")
    reading = read(
        table(names, rows), unit={"rates": 2, "specific_forces": GRAVITY / 2048}
    )
    np.testing.assert_allclose(reading.rates, 2 * ROWS[:, 1:])
    np.testing.assert_allclose(reading.specific_forces[0], [0, 0, GRAVITY])
    for wrong in (0.0, -1.0, np.nan, np.inf, True):
        with pytest.raises(
            ValueError, match=r"Argument `unit` must be a unit or a positive"
        ):
            read(table(names, rows), unit=wrong)


def test_rows_without_numbers_are_counted():
    rows = np.vstack(
        [ROWS, [0.06, np.nan, 1, 2], [0.07, 1, 1, 1], [0.08, np.nan, np.nan, np.nan]]
    )
    reading = read(table(["t (s)", "gx (rad/s)", "gy (rad/s)", "gz (rad/s)"], rows))
    assert reading.times.size == 7
    said(reading, "2 rows without numbers of all three axes dropped")


def test_degrees_are_recognised_by_the_range_of_gyros():
    reading = read(table(["t", "gx", "gy", "gz"], ROWS * [1, 1, 1, 300]))
    np.testing.assert_allclose(reading.rates[:, 2], 450 * DEGREE)
    said(reading, "taken as deg/s: no gyro reads 450 rad/s")


@pytest.mark.parametrize("unit", ["rad/s", "deg/s"])
def test_the_unit_is_recognised_by_how_gravity_turns(unit, rng):
    times = np.arange(0, 10, 0.01)
    rates = np.stack(
        [np.sin(times), 0.8 * np.cos(1.7 * times), 0.5 * np.sin(2.3 * times)], axis=1
    )
    turned = Rotation.identity()
    forces = []
    for rate in rates:
        forces.append(turned.inv().apply([0, 0, GRAVITY]))
        turned = turned * Rotation.from_rotvec(0.01 * rate)
    forces = np.array(forces) + 0.3 * rng.normal(size=rates.shape)
    rows = np.column_stack(
        [times, rates / (DEGREE if unit == "deg/s" else 1.0), forces]
    )
    text = table(["t", "gx", "gy", "gz", "ax", "ay", "az"], rows)
    reading = read(text)
    np.testing.assert_allclose(reading.rates, rates, atol=1e-9)
    said(reading, f"taken as {unit}: so gravity turns")
    # headers and callers may be wrong
    for stated in ("rad/s", "deg/s"):
        reading = read(text, unit=stated)
        assert any("yet gravity turns" in x for x in reading.notes) == (stated != unit)
    # no word where gravity turns otherwise than the rates say
    rows[:, 1:4] = rows[::-1, [2, 3, 1]]
    with pytest.raises(ValueError, match="must say the unit of the rates"):
        read(table(["t", "gx", "gy", "gz", "ax", "ay", "az"], rows))


def test_a_file_of_one_row():
    names = "t (s),gx (rad/s),gy (rad/s),gz (rad/s),ax (m/s^2),ay (m/s^2),az (m/s^2)"
    reading = read(f"{names}\n0.5,1,2,3,0,0,9.8\n")
    np.testing.assert_array_equal(reading.rates, [[1, 2, 3]])
    np.testing.assert_array_equal(reading.specific_forces, [[0, 0, 9.8]])


def test_times_by_name_in_one_file_of_a_folder(tmp_path):
    """In the other file the times are recognised."""
    rows = "".join(f"{0.01 * i:.2f},{i},2,9.8\n" for i in range(5))
    gyro = "stamp (s),gx (rad/s),gy (rad/s),gz (rad/s)\n"
    forces = "time (s),ax (m/s^2),ay (m/s^2),az (m/s^2)\n"
    (tmp_path / "gyro.csv").write_text(gyro + rows)
    (tmp_path / "acc.csv").write_text(forces + rows)
    reading = jr.records.read(tmp_path, columns={"times": "stamp"})
    np.testing.assert_allclose(reading.times, 0.01 * np.arange(5))
    np.testing.assert_allclose(reading.rates, reading.specific_forces)


def test_a_note_names_the_log_of_a_folder_that_is_not_read(tmp_path):
    for name, rate in (("first", 1), ("second", 2)):
        rows = "".join(f"{0.01 * i:.2f},{rate},2,3\n" for i in range(5))
        text = "t (s),gx (rad/s),gy (rad/s),gz (rad/s)\n" + rows
        (tmp_path / f"{name}.csv").write_text(text)
    reading = jr.records.read(tmp_path)
    assert "rates of 'second' left out: those of 'first' are read" in reading.notes
    np.testing.assert_array_equal(reading.rates[:, 0], 1.0)
    alone = jr.records.read(tmp_path / "second.csv")
    assert not any("left out" in x for x in alone.notes)


def test_capital_suffixes_and_equal_names(tmp_path):
    """A folder may hold `.CSV`, and folders of an archive files of the same name."""
    gyro = PHYPHOX + "\n" + scientific(ROWS)
    forces = gyro.replace("Gyroscope", "Acceleration").replace("rad/s", "m/s^2")
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "GYRO.CSV").write_text(gyro)
    archive = tmp_path / "both.zip"
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("gyro/data.csv", gyro)
        file.writestr("acc/data.csv", forces)
    np.testing.assert_allclose(jr.records.read(folder).rates, ROWS[:, 1:], atol=1e-9)
    reading = jr.records.read(archive)
    np.testing.assert_allclose(reading.rates, ROWS[:, 1:], atol=1e-9)
    np.testing.assert_allclose(reading.specific_forces, ROWS[:, 1:], atol=1e-9)


def test_what_read_refuses(tmp_path):
    rates = ["t", "gx", "gy", "gz"]
    good = table(rates, ROWS)
    with pytest.raises(
        ValueError, match="Argument `unit` must say the unit of the rates"
    ):
        read(good)
    with pytest.raises(ValueError, match="up to 30000 do not tell"):
        read(table(rates, ROWS * [1, 1, 1, 20000]))
    with pytest.raises(ValueError, match=r"Argument `unit` must be one of .*'knots'"):
        read(good, unit="knots")
    with pytest.raises(ValueError, match=r"Argument `unit` must be one of .*'speed'"):
        read(good, unit={"speed": "rpm"})
    with pytest.raises(
        ValueError, match=r"unit of `rates`, but .* 'furlong' is not known"
    ):
        read(good.replace("gx", "gx (furlong)"))
    with pytest.raises(ValueError, match="steps of 1e-05 are neither"):
        read(table(rates, ROWS * [1e-3, 1, 1, 1]), unit="rad/s")
    with pytest.raises(
        ValueError, match=r"Argument `columns` must name columns .* 'foo' is none"
    ):
        read(good, columns={"rates": ("foo", "gy", "gz")})
    with pytest.raises(ValueError, match="must name three columns for `rates`"):
        read(good, columns={"rates": ("gy", "gz")})
    with pytest.raises(ValueError, match=r"none is recognised.*There are t, a, b, c"):
        read(table(["t", "a", "b", "c"], ROWS))
    with pytest.raises(ValueError, match="name the column of the times"):
        read(table(["n", "gx", "gy", "gz"], ROWS), unit="rad/s")
    (tmp_path / "numbers.csv").write_text("1,2,3\n4,5,6\n")
    with pytest.raises(ValueError, match=r"names of its columns.*'numbers'"):
        jr.records.read(tmp_path / "numbers.csv")


# Text ---------------------------------------------------------------------------------


def test_a_file_that_has_been_through_much(tmp_path):
    """Byte order mark, remarks, Windows lines, quotes, empty cells, a header twice,
    a cut end."""
    lines = [
        "made by hand",
        '"Time (ms)","Gyro X (°/s)","Gyro Y (°/s)","Gyro Z (°/s)","Temp","µ"',
        "0,1,2,3,20.5,",
        "10,1,2,3,20.5,",
        "",
        "20,,2,3,20.5,",
        "30,NaN,2,3,20.5,",
        '"Time (ms)","Gyro X (°/s)","Gyro Y (°/s)","Gyro Z (°/s)","Temp","µ"',
        "40,1,2,3,20.5,",
        "50,1,2,3,20.5,",
        "60,1,2,3,null,",
        "70,1,2",
    ]
    path = tmp_path / "worn.csv"
    path.write_bytes(b"\xef\xbb\xbf" + "\r\n".join(lines).encode())
    reading = jr.records.read(path)
    np.testing.assert_allclose(reading.times, [0.0, 0.01, 0.04, 0.05, 0.06])
    np.testing.assert_allclose(reading.rates, np.tile([1, 2, 3], (5, 1)) * DEGREE)
    np.testing.assert_array_equal(reading.columns["Temp"], [20.5] * 4 + [np.nan])
    assert list(reading.columns) == ["Temp"]
    said(reading, "the last line is cut off")
    said(reading, "1 line of headers in the middle skipped")


def test_a_byte_order_mark_in_an_open_text():
    text = "\ufeff" + table(
        ["gx (rad/s)", "gy (rad/s)", "gz (rad/s)", "t (s)"], ROWS[:, [1, 2, 3, 0]]
    )
    np.testing.assert_allclose(read(text).rates, ROWS[:, 1:])


def test_rows_without_a_time_and_sensors_that_never_meet():
    rows = np.array([[0.0, 1, 2, 3], [np.nan, 1, 2, 3], [0.2, 1, 2, 3]])
    header = ["t (s)", "gx (rad/s)", "gy (rad/s)", "gz (rad/s)"]
    reading = read(table(header, rows))
    np.testing.assert_array_equal(reading.times, [0.0, 0.2])
    said(reading, "1 row without a time dropped")
    late = np.column_stack([rows, 9.0 + rows[:, :1], rows[:, 1:]])
    reading = read(table([*header, "t", "ax", "ay", "az"], late), unit={"times": "s"})
    assert reading.specific_forces is None
    assert np.isnan(
        read(
            table([*header, "t", "ax (g)", "ay (g)", "az (g)"], late),
            unit={"times": "s"},
        ).specific_forces
    ).all()


def test_an_attitude_is_no_rate():
    names = [
        "t (s)",
        *(f"ROTATION VECTOR {a}" for a in "XYZ"),
        *(f"gyro {a} (dps)" for a in "XYZ"),
    ]
    reading = read(table(names, np.column_stack([ROWS, ROWS[:, 1:]])))
    np.testing.assert_allclose(reading.rates, ROWS[:, 1:] * DEGREE)
    assert "ROTATION VECTOR X" in reading.columns


def test_latin_1_does_not_stop_a_reading(tmp_path):
    header = "t (s),mag x (µT),mag y (µT),mag z (µT)\n"
    path = tmp_path / "old.csv"
    path.write_bytes((header + "0,10,20,30\n0.1,10,20,30\n").encode("latin-1"))
    np.testing.assert_allclose(
        jr.records.read(path).magnetic_fields[0], [1e-5, 2e-5, 3e-5]
    )


def test_a_reading_is_cut_and_printed():
    times = np.concatenate([np.arange(5), 100 + np.arange(5)]) / 100
    reading = read(
        table(
            ["t (s)", "gx (rad/s)", "gy (rad/s)", "gz (rad/s)", "n"],
            np.column_stack([times, np.ones((10, 3)), np.arange(10)]),
        )
    )
    assert reading.breaks == (5,)
    first, second = reading.pieces()
    np.testing.assert_array_equal(second.columns["n"], np.arange(5, 10))
    assert first.breaks == second.breaks == ()
    assert reading[3:8].breaks == (2,)
    assert reading[3:8].rates.shape == (5, 3)
    assert reading.interval == pytest.approx(0.01)
    text = str(reading)
    assert text.startswith(
        "10 readings over 1.04 s, one in 10 ms\n  rates: 1.732 rad/s at most"
    )
    assert "pieces without a break: 2" in text
    assert "- 1 gap, of 0.96 s after 0.04 s" in text
    with pytest.raises(ValueError, match="must be consecutive"):
        reading[::2]


# Clocks
# --------------------------------------------------------------------------------------


def test_a_good_clock_is_left_alone(rng):
    times = 5.0 + np.arange(500) * 0.00997 + 1e-4 * rng.normal(size=500)
    clock = jr.records.repair(times)
    np.testing.assert_array_equal(clock.times, times)
    np.testing.assert_array_equal(clock.rows, np.arange(500))
    assert clock.notes == clock.breaks == ()


def test_rows_written_twice_and_late():
    times = np.arange(100) * 0.01
    rows = np.r_[0:50, 49, 50:70, 71, 70, 72:100]
    clock = jr.records.repair(times[rows], rows[:, None].astype(float))
    np.testing.assert_allclose(clock.times, times, atol=1e-15)
    np.testing.assert_array_equal(rows[clock.rows], np.arange(100))
    assert clock.notes == (
        "1 row out of order sorted in",
        "1 row written twice dropped",
    )


def test_a_table_with_its_newest_row_first_is_reversed():
    times = np.arange(40) * 0.01
    clock = jr.records.repair(times[::-1])
    np.testing.assert_allclose(clock.times, times)
    np.testing.assert_array_equal(clock.rows, np.arange(40)[::-1])
    assert clock.notes == ("rows had the newest first, and were reversed",)


def test_a_reset_clock_goes_on_after_a_break():
    times = np.concatenate([10 + np.arange(100) * 0.01, np.arange(50) * 0.01])
    clock = jr.records.repair(times)
    np.testing.assert_allclose(clock.times, 10 + np.arange(150) * 0.01)
    assert clock.breaks == (100,)
    assert "went back by 11 s at row 100" in clock.notes[0]


@pytest.mark.parametrize("tick", [1e-6, 1e-3])
def test_a_counter_that_wraps(tick):
    step = round(0.01 / tick)
    ticks = (2**32 - 50 * step + np.arange(100) * step) % 2**32
    clock = jr.records.repair(ticks * tick)
    np.testing.assert_allclose(np.diff(clock.times), step * tick, rtol=1e-4)
    assert clock.breaks == ()
    assert "wrapped at row 50" in clock.notes[0]


def test_a_lone_repeated_stamp_is_no_rounding():
    clock = jr.records.repair(np.array([0.0, 0.1, 0.1, 0.2, 0.3, 0.4, 2.4, 2.5]))
    np.testing.assert_array_equal(clock.rows, [0, 1, 3, 4, 5, 6, 7])
    np.testing.assert_array_equal(clock.times, [0.0, 0.1, 0.2, 0.3, 0.4, 2.4, 2.5])
    assert clock.breaks == (5,)


def test_gaps_are_breaks_and_are_not_filled():
    times = np.delete(np.arange(300) * 0.01, np.r_[50:60, 200:250, 270:272])
    clock = jr.records.repair(times)
    np.testing.assert_array_equal(clock.times, times)
    assert clock.breaks == (50, 190)
    assert clock.notes == ("2 gaps, the longest of 0.51 s after 1.99 s",)
    assert jr.records.repair(times, gap=2.5).breaks == (50, 190, 210)


@pytest.mark.parametrize("rows_of_a_tick", [2, 5, 10, 20, 50])
def test_many_rows_that_share_a_tick_of_the_clock_are_all_kept(rows_of_a_tick, rng):
    true = 1e-3 * np.arange(3000)
    ticks = 1e-3 * rows_of_a_tick * (np.arange(3000) // rows_of_a_tick)
    clock = jr.records.repair(ticks, rng.normal(size=(3000, 3)))
    np.testing.assert_array_equal(clock.rows, np.arange(3000))
    # The line through 60 ticks is worse known than that through 1,500.
    np.testing.assert_allclose(np.diff(clock.times), 1e-3, rtol=1e-3)
    assert np.ptp(clock.times - true) < 1e-3 * rows_of_a_tick
    assert f"rounded to {rows_of_a_tick} ms" in clock.notes[-1]


@pytest.mark.parametrize("interval", [0.4e-3, 0.625e-3, 1.7e-3, 3.3e-3])
def test_times_rounded_to_milliseconds_are_put_on_a_line(interval):
    true = 3.0 + interval * np.arange(1000)
    for rounded in (np.round(true, 3), np.floor(1e3 * true) / 1e3):
        clock = jr.records.repair(rounded)
        np.testing.assert_array_equal(clock.rows, np.arange(1000))
        late = clock.times - true
        assert (
            np.ptp(late) < 0.1e-3
        )  # but for the half digit that cutting takes from all
        assert "rounded to 1 ms" in clock.notes[-1]
        kept = jr.records.repair(rounded, clock="recorded").times
        np.testing.assert_array_equal(kept, np.unique(rounded))


def test_late_stamps_of_an_even_clock_with_readings_lost(rng):
    true = np.delete(0.01 * np.arange(2000), [100, 700, 701, 1500])
    times = np.sort(true + rng.exponential(1.5e-3, size=true.size))
    assert jr.records.repair(times).notes == ()
    clock = jr.records.repair(times, clock="uniform")
    late = clock.times - true
    assert np.std(late) < 0.1e-3
    assert "as asked" in clock.notes[-1]


def test_stamps_far_out_do_not_tilt_the_line(rng):
    true = 0.01 * np.arange(1000)
    times = true + 1e-4 * rng.normal(size=1000)
    times[-60:] += 0.004
    late = jr.records.repair(times, clock="uniform").times - true
    assert np.abs(late).max() < 1e-4


def test_a_piece_whose_line_ends_late_does_not_reach_into_the_next():
    """Three stamps that come together are three readings of an even clock."""
    crowded = np.concatenate([np.arange(31.0), [30.03, 30.06, 30.1]])
    clock = jr.records.repair(
        np.concatenate([crowded, np.arange(10.0)]), clock="uniform"
    )
    np.testing.assert_allclose(clock.times, np.arange(44.0), atol=1e-9)
    assert clock.breaks == (34,)
    assert "a piece put 2.9 s later" in clock.notes[-1]


@pytest.mark.parametrize("clock", [None, "uniform", "recorded"])
def test_times_increase_whatever_the_clock_did(clock, rng):
    """Steps of any size, resets and rounding."""
    for _ in range(300):
        count = int(rng.integers(2, 60))
        times = np.cumsum(rng.choice([0.0, 0.01, 1.0, 1.0, 1.0, 1.1, 30.0], count))
        for row in rng.integers(0, count, size=2):
            times[row:] -= rng.choice([0.0, times[row], 1.5, rng.uniform(0, 50)])
        repaired = jr.records.repair(np.round(times, rng.integers(0, 4)), clock=clock)
        assert np.all(np.diff(repaired.times) > 0)
        edges = (0, *repaired.breaks, repaired.times.size)
        assert np.all(np.diff(edges) > 0)


def test_a_piece_of_equal_times_has_no_line():
    times = np.array([0.0, 0, 0, 0, 10, 11, 12, 13])
    clock = jr.records.repair(times, clock="uniform")
    np.testing.assert_array_equal(clock.times, [0, 10, 11, 12, 13])
    assert clock.breaks == (1,)


def test_times_that_say_nothing():
    clock = jr.records.repair(np.array([1.0, np.nan, 1.0, 1.0]))
    assert clock.times.tolist() == [1.0]
    assert clock.notes == ("1 row without a time dropped", "all rows are of one time")
    assert jr.records.repair(np.array([])).times.size == 0
    with pytest.raises(ValueError, match="Argument `clock` must be one of"):
        jr.records.repair(np.arange(3.0), clock="atomic")


# Flights
# --------------------------------------------------------------------------------------


TENSOR = np.array([[2.0, 0.2, -0.1], [0.2, 3.0, 0.3], [-0.1, 0.3, 4.0]]) * 1e-3


def thrown(rng, rate, flights, spin, lever, total=5.0, gyro=0.01, accelerometer=0.1):
    """A hand that shakes, spins up, trials and catches, by scipy's integrator.

    In the hand the rates follow their target within 20 ms; in flight there is a little
    drag.
    """
    frequency, phase = rng.uniform(0.7, 4, (2, 3, 3)), rng.uniform(0, 6, (2, 3, 3))
    size = rng.uniform(0.5, 3, (2, 3, 3))

    def shaking(t, which):
        return np.sum(
            size[which] * np.sin(6.28 * frequency[which] * t + phase[which]), axis=1
        )

    def free(t):
        return any(a <= t < b for a, b in flights)

    def rates_of_change(t, state):
        omega, attitude = state[:3], state[3:]
        if free(t):
            change = np.linalg.solve(
                TENSOR, -np.cross(omega, TENSOR @ omega) - 1e-5 * omega
            )
        else:
            ahead = [a - t for a, _ in flights if 0 < a - t < 0.25]
            target = spin * (1.2 - 3 * ahead[0]) if ahead else shaking(t, 0)
            change = (target - omega) / 0.02
        x, y, z, w = attitude
        turn = np.array([[w, -z, y], [z, w, -x], [-y, x, w], [-x, -y, -z]])
        return np.concatenate([change, 0.5 * turn @ omega])

    times, state = np.arange(0, total, 1 / rate), np.array([0, 0, 0, 0, 0, 0, 1.0])
    edges, states = sorted({0.0, total, *np.ravel(flights).tolist()}), []
    for a, b in itertools.pairwise(edges):
        inside = times[(times >= a) & (times < b)]
        ends = np.append(inside, b - 1e-9)
        run = solve_ivp(
            rates_of_change, (a, ends[-1]), state, t_eval=ends, rtol=1e-8, max_step=0.01
        )
        states.append(run.y[:, :-1].T)
        state = run.y[:, -1]
    states = np.concatenate(states)
    omega, changes = states[:, :3], np.zeros((times.size, 3))
    space = np.zeros((times.size, 3))  # acceleration less gravity
    for i, t in enumerate(times):
        changes[i] = rates_of_change(t, states[i])[:3]
        since = min((t - b for _, b in flights if t >= b), default=9.0)
        trial = 15.0 * any(0 < a - t < 0.12 for a, _ in flights)
        up = GRAVITY + trial + 60 * np.exp(-since / 0.03)
        space[i] = [0.1, 0, -0.3] if free(t) else shaking(t, 1) + np.array([0, 0, up])
    forces = Rotation.from_quat(states[:, 3:]).inv().apply(space)
    forces += np.cross(changes, lever) + np.cross(omega, np.cross(omega, lever))
    return jr.records.Reading(
        times,
        omega + gyro * rng.normal(size=omega.shape),
        forces + accelerometer * rng.normal(size=forces.shape),
    )


def assert_within(found, flights, rate):
    """Start and end within 30 ms, and never a reading with contact."""
    assert len(found) == len(flights), [(x.times[0], x.times[-1]) for x in found]
    for flight, (start, end) in zip(found, flights, strict=True):
        assert start <= flight.times[0] <= start + 0.03 + 1e-9
        assert end - 0.03 - 1 / rate <= flight.times[-1] < end


CASES = {
    "a tool, spinning": (
        200.0,
        [[1.5, 2.1], [3.2, 3.65]],
        [3.0, 14.0, -6.0],
        [0.03, -0.02, 0.05],
    ),
    "an accelerometer far out": (
        500.0,
        [[2.0, 2.5]],
        [10.0, -22.0, 6.0],
        [0.15, 0.1, -0.1],
    ),
    "a slow phone": (100.0, [[2.0, 2.7]], [3.0, 5.0, 2.0], [0.01, 0.02, 0.0]),
    "hardly turning": (100.0, [[2.0, 2.6]], [0.3, 0.2, -0.1], [0.0, 0.05, 0.0]),
}


@pytest.mark.parametrize("case", CASES)
def test_flights_by_the_specific_force(case, rng):
    rate, flights, spin, lever = CASES[case]
    reading = thrown(rng, rate, flights, np.array(spin), np.array(lever))
    found = jr.records.flights(reading)
    assert_within(found, flights, rate)
    assert f"flight 1 of {len(flights)}" in found[0].notes[-1]
    assert "specific forces" in found[0].notes[-1]


@pytest.mark.parametrize("case", ["a tool, spinning", "an accelerometer far out"])
def test_flights_by_the_momentum(case, rng):
    rate, flights, spin, lever = CASES[case]
    reading = thrown(rng, rate, flights, np.array(spin), np.array(lever))
    gyro = jr.records.Reading(reading.times, reading.rates)
    found = jr.records.flights(gyro)
    assert_within(found, flights, rate)
    assert found[0].notes[-1].endswith("no contact by the momentum")
    assert len(jr.records.flights(reading, by="momentum")) == len(found)


@pytest.mark.parametrize("seed", range(4))
def test_no_flight_in_a_hand(seed):
    rng = np.random.default_rng(seed)
    reading = thrown(rng, 200.0, [], np.ones(3), np.array([0.05, 0.02, 0.0]), total=6.0)
    assert jr.records.flights(reading) == []
    assert jr.records.flights(reading, by="momentum") == []


def test_a_lever_is_not_taken_for_contact(rng):
    """Where the spin shows 40 m/s^2, a threshold on the force alone would find
    nothing."""
    rate, flights, spin, lever = CASES["an accelerometer far out"]
    reading = thrown(rng, rate, flights, np.array(spin), np.array(lever))
    [flight] = jr.records.flights(reading)
    assert np.linalg.norm(flight.specific_forces, axis=1).min() > 15


def test_short_flights_breaks_and_silence(rng):
    times = np.arange(300) / 100
    flying = (times > 1) & (times < 1.6)
    forces = np.where(flying[:, None], 0.0, [0.0, 0.0, GRAVITY])
    reading = jr.records.Reading(times, np.zeros((300, 3)), forces)
    assert len(jr.records.flights(reading)) == 1
    assert jr.records.flights(reading, min_duration=0.7) == []
    [wide], [narrow] = (jr.records.flights(reading, margin=m) for m in (0.0, 0.1))
    # The margin counts from the last reading with contact, one interval before the
    # first without.
    assert narrow.times[0] - wide.times[0] == pytest.approx(0.09)
    broken = jr.records.Reading(times, np.zeros((300, 3)), forces, breaks=(130,))
    assert [x.times.size > 20 for x in jr.records.flights(broken)] == [True, True]
    forces = np.where(np.arange(300)[:, None] == 130, np.nan, forces)
    assert (
        len(jr.records.flights(jr.records.Reading(times, np.zeros((300, 3)), forces)))
        == 2
    )
    assert jr.records.flights(reading[:5]) == jr.records.flights(reading[:0]) == []


def test_a_gyro_at_rest_keeps_its_bias_but_does_not_fly(rng):
    rates = 0.05 + 1e-4 * rng.normal(size=(500, 3))
    assert jr.records.flights(jr.records.Reading(np.arange(500) / 100, rates)) == []
    rates[200:250] = np.arange(50)[:, None]  # and some that are exactly zero
    rates[:200] = 0.0
    assert jr.records.flights(jr.records.Reading(np.arange(500) / 100, rates)) == []


def test_a_loud_gyro_sees_flights_by_the_momentum(rng):
    reading = thrown(
        rng, 400.0, [[2.0, 2.6]], np.array([4.0, -9.0, 3.0]), np.zeros(3), gyro=0.1
    )
    [flight] = jr.records.flights(reading, by="momentum")
    assert 1.95 < flight.times[0] < 2.04
    assert 2.55 < flight.times[-1] < 2.6


def test_what_flights_needs():
    times = np.arange(100) / 100
    with pytest.raises(ValueError, match="Argument `reading` must have rates"):
        jr.records.flights(
            jr.records.Reading(times, specific_forces=np.zeros((100, 3)))
        )
    with pytest.raises(ValueError, match="must have specific forces"):
        jr.records.flights(jr.records.Reading(times, np.zeros((100, 3))), by="forces")
    with pytest.raises(ValueError, match="Argument `by` must be one of"):
        jr.records.flights(jr.records.Reading(times, np.zeros((100, 3))), by="eye")


# Noise --------------------------------------------------------------------------------


def direct_allan(x, m):
    """The definition, average by average."""
    means = np.array([x[k : k + m].mean() for k in range(x.size - m + 1)])
    return np.sqrt(0.5 * np.mean((means[m:] - means[:-m]) ** 2))


def test_allan_is_its_definition(rng):
    x = np.cumsum(rng.normal(size=(200, 2)), axis=0)
    allan = jr.records.allan(x, 0.5)
    for time, deviations in zip(allan.times, allan.deviations, strict=True):
        expected = [direct_allan(c, round(time / 0.5)) for c in x.T]
        np.testing.assert_allclose(deviations, expected, rtol=1e-9)


def test_white_noise_falls_with_the_root_of_time(rng):
    allan = jr.records.allan(0.3 * rng.normal(size=(200_000, 1)) + 7.0, 0.01)
    short = allan.times < 5
    expected = 0.3 / np.sqrt(allan.times / 0.01)
    np.testing.assert_allclose(allan.deviations[short, 0], expected[short], rtol=0.1)


def test_a_random_walk_rises_with_the_root_of_time(rng):
    """Of steps q the variance over m averages is q^2 (2 m^2 + 1) / (6 m)."""
    walk = np.cumsum(0.01 * rng.normal(size=(400_000, 1)), axis=0)
    allan = jr.records.allan(walk, 1.0)
    m = allan.times
    short = (m > 3) & (m < 1000)
    expected = 0.01 * np.sqrt((2 * m**2 + 1) / (6 * m))
    np.testing.assert_allclose(allan.deviations[short, 0], expected[short], rtol=0.15)


def test_flicker_is_level(rng):
    """Of two-sided spectral density B^2 / (2 pi f):
    0.664 B over all averaging times."""
    size, instability = 2**19, 0.02
    frequency = np.fft.rfftfreq(size, 1.0)
    density = np.zeros_like(frequency)
    density[1:] = instability**2 / (np.pi * frequency[1:])  # one-sided
    spectrum = np.sqrt(density * size / 4) * (
        rng.normal(size=density.size) + 1j * rng.normal(size=density.size)
    )
    values = np.fft.irfft(spectrum, size)
    allan = jr.records.allan(values[:, None], 1.0)
    level = (allan.times > 10) & (allan.times < 2000)
    np.testing.assert_allclose(
        allan.deviations[level, 0], 0.664 * instability, rtol=0.12
    )


def test_pieces_are_pooled(rng):
    x = rng.normal(size=(3000, 3))
    pooled = jr.records.allan([x[:1000], x[1000:]], 1.0)
    short, long = jr.records.allan(x[:1000], 1.0), jr.records.allan(x[1000:], 1.0)
    weight = short.counts[0], long.counts[0]
    expected = np.sqrt(
        np.average([short.deviations[0] ** 2, long.deviations[0] ** 2], 0, weight)
    )
    np.testing.assert_allclose(pooled.deviations[0], expected)
    assert pooled.counts[0] == sum(weight)
    with pytest.raises(ValueError, match="must have 3 readings, but it has 2"):
        jr.records.allan(x[:2], 1.0)


def resting(rng, sigma=0.01, bias=(0.02, -0.01, 0.03)):
    """Rest, a hand for 10 s, rest."""
    times = np.arange(6000) / 100
    rates = np.array(bias) + sigma * rng.normal(size=(6000, 3))
    hand = (times > 20) & (times < 30)
    rates[hand] += 2 * np.sin(7 * times[hand, None] + np.arange(3.0))
    return jr.records.Reading(times, rates)


def test_noise_from_the_rests_around_a_motion(rng):
    noise = jr.records.noise(resting(rng))
    np.testing.assert_allclose(noise.bias, [0.02, -0.01, 0.03], atol=1e-3)
    np.testing.assert_allclose(noise.sigma, 0.01, rtol=0.06)
    np.testing.assert_allclose(noise.density, 0.01 * np.sqrt(0.01), rtol=0.15)
    assert "2 rests" in noise.notes[0]
    first, second = jr.records.rests(resting(rng))
    assert first.times[0] == 0.0
    assert 19 < first.times[-1] < 20.01
    assert 29.99 < second.times[0] < 31


def test_a_hand_that_trembles_is_no_rest_where_there_is_one(rng):
    times = np.arange(3000) / 100
    rates = 0.002 * rng.normal(size=(3000, 3))
    rates[1000:] += 0.02 * np.sin(60 * times[1000:, None])
    [rest] = jr.records.rests(jr.records.Reading(times, rates))
    assert 9 < rest.times[-1] < 10.01


def test_bias_instability_of_white_noise_and_flicker(rng):
    """Where N / sqrt(t) meets a level of 0.664 B,
    the least is a little above the level."""
    size, instability = 2**18, 0.002
    frequency = np.fft.rfftfreq(size, 0.01)
    density = np.zeros_like(frequency)
    density[1:] = instability**2 / (np.pi * frequency[1:])
    shape = (density.size, 3)
    pink = np.sqrt(density * size / 0.04)[:, None] * (
        rng.normal(size=shape) + 1j * rng.normal(size=shape)
    )
    rates = np.fft.irfft(pink, size, axis=0) + 0.02 * rng.normal(size=(size, 3))
    reading = jr.records.Reading(np.arange(size) / 100, rates)
    noise = jr.records.noise(reading, at_rest=True)
    np.testing.assert_allclose(noise.sigma, 0.02, rtol=0.05)
    np.testing.assert_allclose(noise.density, 0.002, rtol=0.1)
    assert np.all(
        (noise.instability > 0.6 * instability)
        & (noise.instability < 1.4 * instability)
    )
    assert np.all(noise.instability_times > 1.0)


def test_noise_of_a_gyro_that_filters(rng):
    """Averages over 10 readings: sigma small, the density that of the noise before the
    filter."""
    white = 0.1 * rng.normal(size=(60_009, 3))
    sums = np.cumsum(np.concatenate([np.zeros((1, 3)), white]), axis=0)
    reading = jr.records.Reading(
        np.arange(60_000) / 1000, (sums[10:] - sums[:-10]) / 10
    )
    noise = jr.records.noise(reading, at_rest=True)
    assert np.all(noise.sigma < 0.02)
    np.testing.assert_allclose(noise.density, 0.1 * np.sqrt(1e-3), rtol=0.15)


def test_no_rest(rng):
    times = np.arange(2000) / 100
    moving = jr.records.Reading(times, 2 * np.sin(7 * times[:, None] + np.arange(3.0)))
    assert jr.records.rests(moving) == []
    with pytest.raises(ValueError, match="must have rates at rest for 1 s"):
        jr.records.noise(moving)
    with pytest.raises(ValueError, match="must have rates"):
        jr.records.rests(jr.records.Reading(times))
    shaken = jr.records.Reading(
        times, 2 * np.sin(130 * times[:, None] + np.arange(3.0))
    )
    assert jr.records.rests(shaken) == []
    steady = jr.records.Reading(
        times, np.tile([0.0, 0.0, 3.0], (2000, 1))
    )  # on a turntable
    assert jr.records.rests(steady) == []


def test_a_rest_ends_before_a_hand_takes_the_body_up(rng):
    rate = 400
    spin = np.array([6.0, 8.0, 3.0])
    x = np.linspace(0, 1, 160)[:, None]
    taken_up = spin * x**2 * (3 - 2 * x)
    rest, held = np.zeros((600, 3)), np.repeat([spin], 360, axis=0)
    parts = [rest, taken_up, held, taken_up[::-1]] * 8
    bias = np.array([0.02, -0.01, 0.03])
    rates = np.concatenate([*parts, rest]) + bias
    rates = rates + 0.02 * rng.normal(size=rates.shape)
    reading = jr.records.Reading(np.arange(len(rates)) / rate, rates)
    parts = jr.records.rests(reading)
    assert len(parts) == 9
    for part in parts:
        for end in (part.rates[:100], part.rates[-100:]):
            assert np.linalg.norm(end.mean(axis=0) - bias) < 0.02
    count = sum(x.times.size for x in parts)
    assert count > 0.6 * 9 * 600
    noise = jr.records.noise(reading)
    np.testing.assert_allclose(noise.density * rate**0.5, 0.02, rtol=0.1)
    assert np.all(np.abs(noise.bias - bias) < 4 * 0.02 / count**0.5)
