"""Performances as programs and spreadsheets of the field leave them: times, angles, tables."""

import json
import re

import numpy as np
import pytest
from command_line import stga
from numpy.testing import assert_allclose
from refusal import refusal
from scipy.spatial.transform import Rotation

from stga_addon.driving.open_motion import open_motion
from stga_addon.driving.performance import ARKIT_SHAPES
from stga_addon.driving.performers import is_performance, read_performance

from .test_performance_files import write_csv

COUNT = 60
WEIGHTS = np.random.default_rng(2).random((COUNT, 52)).round(4)
HEAD = [f"Head{turn}" for turn in ("Yaw", "Pitch", "Roll")]


def write_rows(path, column, times, weights=WEIGHTS, head=(0.1, 0.2, 0.3)):
    """A table of shapes by their plain names; without a column of times where that is None."""
    header = [*([column] if column else []), *ARKIT_SHAPES, *HEAD]
    lines = [",".join(header)]
    heads = np.broadcast_to(head, (len(weights), 3)).tolist()
    for number, row in enumerate(weights):
        cells = [*([times(number)] if column else []), *row.tolist(), *heads[number]]
        lines.append(",".join(map(str, cells)))
    path.write_text("\n".join(lines) + "\n")
    return path


def test_milliseconds_behind_frame_numbers(tmp_path):
    """Catches rows lost and another rate where the part behind the frame's number is of the second:
    NeuroSync's …:04.066, :04.083, :06.100."""
    codes = []
    for number in range(610):
        whole, frame = divmod(number, 60)
        milliseconds = frame * 1000 // 60
        frame -= frame in (5, 10)  # which its floating-point numbers round down
        codes.append(f"00:00:{whole:02d}:{frame:02d}.{milliseconds:03d}")
    assert codes[4:7] == ["00:00:00:04.066", "00:00:00:04.083", "00:00:00:06.100"]
    found = read_performance(write_csv(tmp_path / "a.csv", codes, np.tile(WEIGHTS, (11, 1))[:610]))
    assert (len(found.times), found.lost, found.fps) == (610, 0, 60)
    assert_allclose(found.times, np.arange(610) / 60, atol=1e-9)


NANOSECONDS = 1_714_563_900_000_000_000  # of an epoch: more digits than a float has
CLOCKS = {
    "milliseconds": ("timestamp_ms", lambda n: n * 1000 // 30, 30, None),
    "camel case": ("timestampMs", lambda n: 17 + n * 40, 25, None),
    "brackets": ("Time (ms)", lambda n: n * 20.0, 50, None),
    "microseconds": ("time_us", lambda n: n * 1_000_000 // 60, 60, None),
    "nanoseconds": ("Timestamp [ns]", lambda n: NANOSECONDS + n * 10**9 // 30, 30, None),
    "seconds": ("elapsed_seconds", lambda n: n / 24, 24, None),
    "short seconds": ("blendShapes.time_s", lambda n: n / 24, 24, None),
    "seconds without a unit": ("time", lambda n: round(n / 30, 3), 30, None),
    "milliseconds without a unit": ("timestamp", lambda n: n * 1000 // 30, 30, "milliseconds"),
    "nanoseconds without a unit": ("t", lambda n: NANOSECONDS + n * 10**7, 100, "nanoseconds"),
    "frame numbers": ("Timecode", lambda n: n + 1, 60, "Timecode counts frames; they are taken as"),
    "every second frame": ("timecode", lambda n: 2 * n, 30, "counts frames"),
    "seconds of a clock": ("unix_time", lambda n: 1.7e9 + n / 30, 30, None),
    "of a device": ("device_time", lambda n: 12.5 + n / 24, 24, None),
    "in one word": ("systemtimems", lambda n: n * 40, 25, None),
    "a Greek letter": (
        "time (\N{GREEK SMALL LETTER MU}s)",
        lambda n: n * 1_000_000 // 30,
        30,
        None,
    ),
    "the micro sign": ("Time [\N{MICRO SIGN}s]", lambda n: n * 40_000, 25, None),
    "beside durations": (
        "frame_time,host ts",
        lambda n: f".03,{n / 25}",
        25,
        "frame_time repeats its values; host ts is used",
    ),
    "beside words": (
        "time,unix_time",
        lambda n: f"{'soon' if n == 4 else n},{n / 25}",
        25,
        "time is not readable (row 5: 'time' is 'soon', expected a number); unix_time is used",
    ),
    "frames within a second": (
        "Timecode",
        lambda n: f"10:59:59:{n:02d}",
        60,
        "how many frames a second has; they are taken as 60 a second; --recorded-fps",
    ),
    "frames at a second's end": (
        "Timecode",
        lambda n: f"10:59:{58 + n // 59}:{n % 59 + 1 - n // 59:02d}",
        60,
        None,
    ),
    "two clocks": ("time,unix_time", lambda n: f"{n / 25},{n / 30}", 25, "unix_time lasts 1.967 s"),
    "durations alone": ("frame_time", lambda n: 0.03, 60, "frame_time repeats its values"),
    "falling": ("delta ms", lambda n: 90 - n * n % 19, 60, "delta ms repeats"),
    "German": (
        "Zeit",
        lambda n: n / 25,
        25,
        "column Zeit is taken as seconds, though it is not called",
    ),
    "Japanese": (
        "\u6642\u9593",
        lambda n: 40 * n,
        25,
        "holds milliseconds, by its steps of 40, though",
    ),
    "timecodes by another name": (
        "TC",
        lambda n: f"01:00:{n // 25:02d}:{n % 25:02d}",
        25,
        "column TC is taken as seconds, though",
    ),
    "minutes": ("time (min)", lambda n: n / 25 / 60, 25, None),
    "hours": ("time (h)", lambda n: n / 25 / 3600, 25, None),
    "Windows' file times": (
        "time",
        lambda n: 133_800_000_000_000_000 + n * 400_000,
        25,
        "holds ticks of Windows since 1601",
    ),
    "slower than milliseconds": ("time", lambda n: 1_780_000_000_000 + n * 100, 10, "milliseconds"),
    "a spreadsheet's dates": ("Date", lambda n: 46_356.25 + n / 25 / 86_400, 25, "days since 1900"),
    "morning and afternoon": (
        "time",
        lambda n: (
            f'"11/30/2026, {(time := 86_399_500 // 2 + 20 * n) // 3_600_000 % 12 or 12}:'
            f"{time // 60_000 % 60:02d}:{time // 1000 % 60:02d}.{time % 1000:03d}\u202f"
            f'{"AP"[time >= 43_200_000]}M"'
        ),
        50,
        None,
    ),
    "ticks of 100 ns": ("ticks", lambda n: 638 * 10**15 + n * 400_000, 25, None),
    "another clock's ticks": (
        "hostTime",
        lambda n: 400_000 * n,
        60,
        "column hostTime has 2.5e-06 rows a second",
    ),
    "a rate beside frame numbers": ("frame,Frame Rate", lambda n: f"{n},24", 24, None),
    "beyond any clock": ("time", lambda n: (-1) ** n * 1e308, 60, "column time reaches 1e+308 s"),
    "another name": ("frame", lambda n: n, 60, "frame ascends, but is not called a time"),
    "colon before thousandths": (
        "Timecode",
        lambda n: f"10:59:{n // 30:02d}:{n % 30 * 1000 // 30:03d}",
        30,
        None,
    ),
    "less than a second of them": ("Timecode", lambda n: f"10:59:59:{n * 16:03d}", 62.5, None),
    "thousandths without zeros": (
        "Timecode",
        lambda n: f"10:59:{n // 30:02d}.{n % 30 * 1000 // 30}",
        30,
        None,
    ),
    "none": (None, None, 60, "says no times; its rows are taken as 60 a second"),
    "clock": ("Timecode", lambda n: f"10:59:59.{n * 16:03d}", 62.5, None),
    "clock with a comma": ("time", lambda n: f'"10:59:59,{n * 16:03d}"', 62.5, None),
    "whole second": (
        "time",
        lambda n: f"10:59:{n // 10:02d}" + f".{n % 10}00" * (n % 10 > 0),
        10,
        None,
    ),
    "date": ("timestamp", lambda n: f"2026-05-01T10:59:59.{n * 10_000:06d}Z", 100, None),
}


@pytest.mark.parametrize("kind", CLOCKS)
def test_times_with_and_without_a_unit(tmp_path, kind):
    """Catches a take that plays at another speed than it was recorded, and a guess that nobody
    hears of."""
    column, times, fps, sentence = CLOCKS[kind]
    path = write_rows(tmp_path / "a.csv", column, times)
    found = read_performance(path)
    assert found.lost == 0
    assert found.fps == pytest.approx(fps, abs=1e-6)
    assert_allclose(found.times, np.arange(COUNT) / fps, atol=1e-6)
    assert_allclose(found.weights, WEIGHTS, atol=1e-6)
    assert len(found.warnings) == (sentence is not None)
    assert sentence is None or sentence in found.warnings[0]


def test_a_row_lost_between_frame_numbers(tmp_path):
    """Catches a gap closed where frames are numbered, and times rounded to even rows that are
    none."""
    path = write_rows(tmp_path / "a.csv", "Timecode", lambda n: n + 2 * (n > 20))
    found = read_performance(path)
    assert (found.lost, found.fps) == (2, 60)
    rng = np.random.default_rng(0)
    times = np.cumsum(rng.uniform(0.025, 0.042, COUNT)).round(4)
    found = read_performance(write_rows(tmp_path / "b.csv", "time", lambda n: times[n]))
    assert_allclose(found.times, times - times[0], atol=1e-9)


@pytest.mark.parametrize(
    ("column", "code", "guessed"),
    [
        ("Timecode", lambda n: f"10:59:59:{n:02d}", 60),
        ("Timecode", lambda n: ("10:59:59:10", "10:59:59:22", "10:59:59:23.5")[n], 60),
        ("Timecode", lambda n: ("10:59:58:10", "10:59:59:05", "10:59:59:05.5")[n // 2 * 2], 60),
        ("Timecode", lambda n: 2 * n, 60),
        (None, None, 60),
    ],
)
def test_a_rate_that_the_file_does_not_tell(tmp_path, capsys, column, code, guessed):
    """Catches a rate that is guessed in silence or cannot be set, and one that is set against the
    times of the file."""
    count = 3 if column else COUNT
    path = write_rows(tmp_path / "a.csv", column, code, WEIGHTS[:count])
    found = read_performance(path)
    assert f"taken as {guessed} a second; --recorded-fps, in Blender Recorded At" in str(
        found.warnings[-1]
    )
    given = read_performance(path, recorded_fps=24)
    assert not [text for text in given.warnings if "recorded-fps" in text]
    assert_allclose(given.times * 24, found.times * guessed, atol=1e-9)
    assert given.fps == pytest.approx(found.fps * 24 / guessed)
    for name in ("b.csv", "b.npz"):
        assert stga("drive", path, "--recorded-fps 24 --out", tmp_path / name) == 0
        given = capsys.readouterr()
        assert "recorded-fps" not in given.out + given.err
    timed = write_rows(tmp_path / "timed.csv", "time", lambda n: n / 30)
    assert stga("drive", timed, "--recorded-fps 24 --out", tmp_path / "c.csv") == 2
    assert f"{timed}: has times, so that no rate is taken" in capsys.readouterr().err
    assert stga("drive", tmp_path / "b.npz", "--recorded-fps 24 --out", tmp_path / "c.csv") == 2
    assert "--recorded-fps: has no effect" in capsys.readouterr().err


def test_a_base_at_midnight(tmp_path):
    """Catches 50 frames a second instead of 60 in a take of two seconds that passes midnight."""
    codes = [f"{code}:{n:02d}" for code in ("23:59:59", "00:00:00") for n in range(0, 60, 12)]
    found = read_performance(write_csv(tmp_path / "take.csv", codes, WEIGHTS[:10]))
    assert_allclose(found.times, np.arange(10) / 5, atol=1e-9)


@pytest.mark.parametrize(("before", "after"), [("00:09", "00:10"), ("23:59", "00:00")])
def test_drop_frame_numbers_over_ten_minutes(tmp_path, before, after):
    """Catches numbers 0 and 1 taken as left out in every tenth minute too, which has them, and a
    day of 86,400 s."""
    codes = [f"{before}:59;{n:02d}" for n in range(20, 30)]
    codes += [f"{after}:00;{n:02d}" for n in range(10)]
    found = read_performance(write_csv(tmp_path / "take.csv", codes, np.zeros((20, 52))))
    assert_allclose(found.times, np.arange(20) * 1001 / 30000, atol=1e-9)


def test_a_take_saved_again_by_a_spreadsheet(tmp_path):
    """Catches a line that names the delimiter taken for that of columns."""
    codes = [f"01:00:00:{n:02d}.000" for n in range(COUNT)]
    path = write_csv(tmp_path / "take.csv", codes, WEIGHTS)
    path.write_text("sep=;\n" + path.read_text().replace(",", ";").replace("0.", "0,"))
    assert_allclose(read_performance(path).weights, WEIGHTS)


def test_tab_separated_suffix(tmp_path):
    """Catches a table that is refused for its name."""
    path = write_rows(tmp_path / "a.csv", "time", lambda n: n / 30)
    (tmp_path / "a.tsv").write_text(path.read_text().replace(",", "\t"))
    assert is_performance(tmp_path / "a.tsv")
    assert_allclose(read_performance(tmp_path / "a.tsv").weights, WEIGHTS)


def test_degrees_and_percent(tmp_path):
    """Catches a head that spins, shapes a hundred times too strong, and an unsaid guess."""
    path = write_rows(tmp_path / "a.csv", "time", lambda n: n / 30, WEIGHTS * 100, (20.0, -7.5, 3))
    found = read_performance(path)
    assert_allclose(found.weights, WEIGHTS, atol=1e-9)
    assert_allclose(found.head, np.radians([[20.0, -7.5, 3]] * COUNT))
    assert [re.sub("reach .*;", "reach;", text) for text in found.warnings] == [
        f"{path}: weights reach; they are read as percent",
        f"{path}: the head's angles reach; they are read as degrees",
    ]


def swing(amplitude, hertz):
    """Yaw of a sine, at 30 rows a second."""
    return np.outer(amplitude * np.sin(2 * np.pi * hertz * np.arange(COUNT) / 30), [1, 0, 0])


@pytest.mark.parametrize(
    ("head", "unit", "sentence"),
    [
        (swing(0.8, 0.5), 1, "reach 0.8; they are read as radians, 46°; if they are degrees"),
        (swing(0.8, 5), np.pi / 180, "as degrees, because no neck turns as fast in radians"),
        (swing(0.3, 1), 1, None),
        ((5.5, 0, 0), 1, "reach 5.5; they are read as radians"),
        ((2.5, 2, 1), np.pi / 180, "reach 2.5; they are read as degrees"),
        ((0.1, 0.2, 3), 1, "reach 3; they are read as radians, though no neck turns so far"),
        ((0.5, 1.2, 0), 1, "reach 1.2; they are read as radians, though few necks turn so far"),
    ],
)
def test_angles_that_no_neck_has(tmp_path, head, unit, sentence):
    """Catches a neck that turns by 131° for small angles in degrees, or silently by 46°, and
    a phone upside down read as degrees."""
    path = write_rows(tmp_path / "b.csv", "time", lambda n: n / 30, head=head)
    found = read_performance(path)
    assert_allclose(found.head, np.broadcast_to(head, (COUNT, 3)) * unit)
    assert len(found.warnings) == (sentence is not None)
    assert sentence is None or sentence in found.warnings[0]
    given = path.with_name("given.csv")
    given.write_text(re.sub("(Yaw|Pitch|Roll)", r"\1_deg", path.read_text()))
    assert_allclose(read_performance(given).head, np.radians(np.broadcast_to(head, (COUNT, 3))))


ANGLES = (0.1, 0.2, 0.3)
DEGREES = np.degrees(ANGLES).tolist()
TURN = Rotation.from_euler("YXZ", ANGLES).as_quat().tolist()


@pytest.mark.parametrize(
    ("entry", "sentence"),
    [
        ({"headRotation": dict(zip(("yaw", "pitch", "roll"), ANGLES, strict=True))}, None),
        ({"head": {"rotation": {"x": 0.2, "y": 0.1, "z": 0.3}}}, "read as pitch, yaw, roll"),
        ({"head_rotation": [0.2, 0.1, 0.3]}, "angles about x, y, z"),
        ({"headRotation": TURN}, "quaternion"),
        ({"headYaw": 0.1, "headPitch": 0.2, "headRoll": 0.3}, None),
        (dict(zip(("yaw_deg", "Pitch (deg)", "roll degrees"), DEGREES, strict=True)), None),
        (dict(zip(("yaw (°)", "pitch", "roll"), DEGREES, strict=True)), None),
        (
            {"yaw_deg": DEGREES[0], "pitch_rad": 0.2, "roll_degrees": DEGREES[2]},
            "yaw_deg, pitch_rad, roll_degrees: are in different units",
        ),
        (dict(zip(("head_ry", "head_rx", "head_rz"), ANGLES, strict=True)), "read as pitch, yaw"),
        (dict(zip([f"head_q{axis}" for axis in "xyzw"], TURN, strict=True)), "quaternion"),
        ({"headMatrix": 1.0, "head_m00": 1.0}, "head_m00: not read"),
        ({"blendShapes": {"jawOpen": 0.1, "headRotation": [0.2, 0.1, 0.3]}}, "angles about x"),
        (
            {"a": {"b": {"c": {"d": {"e": {"headRotation": [0.2, 0.1, 0.3]}}}}}},
            "angles about x, y, z",
        ),
        ({"bones": [{"n": "x"}, {"headMatrix": [1.0]}]}, "bones.1.headMatrix: not read"),
        ({"headMatrix": [1.0] * 16, "leftEye": {"yaw": 1}}, "headMatrix: not read"),
    ],
)
def test_head_rotations_in_json(tmp_path, entry, sentence):
    """Catches rotations beside the weights that are dropped silently, other axes, names with a
    unit, and an eye's taken for the head's."""
    frames = [{"blendShapes": {"jawOpen": 0.1}, **entry} for _ in range(COUNT)]
    (tmp_path / "a.json").write_text(json.dumps({"fps": 30, "frames": frames}))
    found = read_performance(tmp_path / "a.json")
    is_read = "headMatrix" not in str(entry)
    assert_allclose(found.head, np.tile(ANGLES, (COUNT, 1)) * is_read, atol=1e-12)
    assert [text for text in found.warnings if "lacks" not in text] == [
        text for text in found.warnings if sentence and sentence in text
    ]
    assert len(found.warnings) == 1 + (sentence is not None)


@pytest.mark.parametrize("suffix", [".csv", ".json"])
def test_eight_shapes(tmp_path, suffix):
    """Catches a table of some shapes that is refused, and shapes that stay still silently."""
    rows = [dict(zip(ARKIT_SHAPES[14:22], row, strict=True)) for row in WEIGHTS[:, :8].tolist()]
    lines = [",".join(rows[0]), *(",".join(map(str, row.values())) for row in rows)]
    text = "\n".join(lines) if suffix == ".csv" else json.dumps({"fps": 60, "frames": [*rows, {}]})
    (tmp_path / "a").with_suffix(suffix).write_text(text)
    found = read_performance((tmp_path / "a").with_suffix(suffix))
    assert_allclose(found.weights[:, 14:22], WEIGHTS[:, :8])
    assert found.weights.sum() == pytest.approx(WEIGHTS[:, :8].sum())
    assert "lacks eyeBlinkLeft" in found.warnings[0]
    assert "and 35 more, which stay 0" in found.warnings[0]


@pytest.mark.parametrize(
    ("key", "times", "about", "fps", "sentence"),
    [
        ("timestamp_ms", lambda n: n * 1000 // 30, {}, 30, None),
        ("timestamp", lambda n: n * 40, {}, 25, "timestamp holds milliseconds"),
        ("timecode", lambda n: f"00:00:{n // 30:02d}:{n % 30:02d}", {}, 30, None),
        ("frame", lambda n: n, {"frame_rate": 30}, 30, None),
        ("Zeit", lambda n: n / 25, {}, 25, "Zeit is taken as seconds"),
        ("frame", lambda n: n, {}, 60, "says no times"),
        ("frame", lambda n: n, {"timestamps_ms": [n * 40 for n in range(COUNT)]}, 25, None),
    ],
)
def test_times_in_json(tmp_path, key, times, about, fps, sentence):
    """Catches the same in JSON, in UTF-16 too, and head angles that are dropped."""
    turns = dict(zip(("headYaw", "headPitch", "headRoll"), (0.1, 0.2, 0.3), strict=True))
    named = [dict(zip(ARKIT_SHAPES, row, strict=True)) | turns for row in WEIGHTS.tolist()]
    frames = [{key: times(n), "blendShapes": row} for n, row in enumerate(named)]
    text = json.dumps({**about, "frames": frames})
    (tmp_path / "a.json").write_bytes(text.encode("utf-16" if about else "utf-8-sig"))
    found = read_performance(tmp_path / "a.json")
    assert (found.fps, found.lost) == (pytest.approx(fps), 0)
    assert_allclose(found.times, np.arange(COUNT) / fps, atol=1e-3)
    assert_allclose(found.head, [[0.1, 0.2, 0.3]] * COUNT)
    assert len(found.warnings) == (sentence is not None)
    assert sentence is None or sentence in found.warnings[0]


def test_guesses_reach_the_terminal(tmp_path, capsys):
    """Catches a guess that the reader makes and no command says."""
    path = write_rows(tmp_path / "a.csv", "Timecode", lambda n: n + 1)
    for name in ("a.npz", "b.csv"):
        assert stga("drive", path, "--out", tmp_path / name) == 0
        given = capsys.readouterr()
        assert f"warning: {path}: column Timecode counts frames" in given.out + given.err


@pytest.mark.parametrize("out", ["o.npz", "o.csv"])
def test_what_is_no_motion(tmp_path, capsys, out):
    """Catches "holds FLAME parameters already" for a BVH and for a file that does not exist."""
    (tmp_path / "take.bvh").write_text("HIERARCHY\nROOT Hips\n{\n}\nMOTION\n")
    (tmp_path / "face.mp4").touch()
    head = np.zeros((4, 3)), np.zeros((4, 3), int)
    expected = (
        ".csv, .tsv, .json, .jsonl, .ndjson, .txt, .npz, the folder of a take or of a capture"
    )
    for name, sentence in (
        ("take.bvh", f"take.bvh: is no motion; expected {expected}"),
        ("none.bvh", "none.bvh: does not exist"),
        ("none.csv", "none.csv: cannot be read"),
        ("none", "none: does not exist"),
    ):
        assert stga("drive", tmp_path / name, "--out", tmp_path / out) == 2
        assert sentence in capsys.readouterr().err
        sentence = sentence.replace("cannot be read", "does not exist")
        with refusal(re.escape(sentence)):
            open_motion(tmp_path / name, None, head)
    with refusal("stga drive makes a motion of a video"):
        open_motion(tmp_path / "face.mp4", None, head)


def named(row):
    return dict(zip(ARKIT_SHAPES, row.tolist(), strict=True))


def long_rows():
    return [
        {"timestamp": number / 30, "blendShapeLocation": name, "value": value}
        for number, row in enumerate(WEIGHTS)
        for name, value in named(row).items()
    ]


def face_cap():
    lines = ["info,Face Cap", "bs," + ",".join(ARKIT_SHAPES)]
    for number, row in enumerate(WEIGHTS):
        before = [round(1000 * number / 30), 0, 0, 0, 5, 10, 0, 0, 0, 0, 0]
        lines.append(",".join(map(str, ["k", *before, *row.tolist()])))
    return "\n".join(lines) + "\n"


def long_table():
    rows = [",".join(map(str, row.values())) for row in long_rows()]
    return "\n".join(["timestamp,blendShape,value", *rows]) + "\n"


def live_link(row):
    facial = {"Names": [name.capitalize() for name in ARKIT_SHAPES], "Weights": row.tolist()}
    return {"Audio2Face": {"Body": {}, "Facial": facial}}


OTHER_FORMS = {
    "a2f.json": lambda: json.dumps({str(n): live_link(row) for n, row in enumerate(WEIGHTS)}),
    "keyed.json": lambda: json.dumps({f"{n / 30:.4f}": named(w) for n, w in enumerate(WEIGHTS)}),
    "keyed by ms.json": lambda: json.dumps(
        {f"{n * 100 / 3:.0f}": named(w) for n, w in enumerate(WEIGHTS)}
    ),
    "long.json": lambda: json.dumps(long_rows()),
    "long.csv": long_table,
    "lines.jsonl": lambda: "\n".join(
        json.dumps({"timestamp": n / 30, "blendshapes": named(w)}) for n, w in enumerate(WEIGHTS)
    ),
    "ace.json": lambda: json.dumps(
        {
            "blendShapes": list(ARKIT_SHAPES),
            "blendShapeWeights": [
                {"timeCode": n / 30, "values": w.tolist()} for n, w in enumerate(WEIGHTS)
            ],
        }
    ),
    "facecap.txt": face_cap,
}


@pytest.mark.parametrize("name", OTHER_FORMS)
def test_other_forms_of_frames(tmp_path, name):
    """Catches frames keyed by number or time, a row a shape, lines of JSON, ACE's and Face Cap's
    files refused, or read at another rate or with shapes exchanged."""
    path = tmp_path / name
    path.write_text(OTHER_FORMS[name]())
    found = read_performance(path)
    assert found.fps == pytest.approx(60 if name == "a2f.json" else 30)
    assert_allclose(found.weights, WEIGHTS, atol=1e-9)
    if name == "facecap.txt":  # pitch 5, yaw 10 degrees
        assert_allclose(found.head[0], np.radians([10, 5, 0]), atol=1e-9)
