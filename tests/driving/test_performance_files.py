"""Performances of every tool as the same weights."""

import json
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusal import refusal

from stga_addon.driving.performance import (
    ARKIT_SHAPES,
    COLUMN,
    Performance,
    arkit_name,
    mirrored,
    resampled,
    smoothed,
)
from stga_addon.driving.performers import is_performance, read_performance

from .live import wire

PASCAL = [name[0].upper() + name[1:] for name in ARKIT_SHAPES]
ROTATIONS = [f"{s}{a}" for s in ("Head", "LeftEye", "RightEye") for a in ("Yaw", "Pitch", "Roll")]
HEADER = ["Timecode", "BlendShapeCount", *PASCAL, *ROTATIONS]
RNG = np.random.default_rng(0)
WEIGHTS = RNG.random((6, 52)).round(4)


def codes_of(count):
    """Timecodes of a take at 60 frames a second, shorter than a second."""
    return [f"01:00:00:{n:02d}.0" for n in range(count)]


def write_csv(path, codes, weights, header=HEADER):
    """A Live Link Face file; head rotation is (0.1, 0.2, 0.3) in each row."""
    head = np.tile([0.1, 0.2, 0.3, *[0] * 6], (len(weights), 1))
    values = dict(zip([*PASCAL, *ROTATIONS], np.hstack([weights, head]).T, strict=True))
    columns = [[f"{value:.6f}" for value in values[name]] for name in header[2:]]
    rows = [",".join([code, "61", *row]) for code, *row in zip(codes, *columns, strict=True)]
    path.write_text("\n".join([",".join(header), *rows]) + "\n")
    return path


def test_live_link_face_rows_at_half_the_timecodes_rate_over_midnight(tmp_path):
    """Catches columns read by place, a time base guessed from the rows, and a jump at midnight."""
    frames = np.arange(0, 130, 2) + 60 * 86_399 + 31  # of 60 a second
    parts = [(n // 216000 % 24, n // 3600 % 60, n // 60 % 60, n % 60) for n in frames.tolist()]
    codes = ["{:02d}:{:02d}:{:02d}:{:02d}.250".format(*each) for each in parts]
    weights = np.random.default_rng(1).random((len(codes), 52)).round(5)
    swapped = HEADER.copy()
    swapped[2], swapped[40] = swapped[40], swapped[2]
    found = read_performance(write_csv(tmp_path / "take.csv", codes, weights, swapped))
    assert_allclose(found.weights, weights, atol=1e-6)
    assert_allclose(found.times, np.arange(len(codes)) / 30, atol=1e-9)
    assert found.fps == pytest.approx(30)
    assert_allclose(found.head, [[0.1, 0.2, 0.3]] * len(codes))


def test_lost_rows_and_rows_without_a_face(tmp_path):
    """Catches a performance that plays faster over lost rows, and drop frames that count as
    lost."""
    codes = [f"10:00:{n // 60:02d}:{n % 60:02d}.000" for n in range(55, 65)]
    weights = np.repeat(np.linspace(0, 0.9, 10)[:, None], 52, axis=1)
    lines = write_csv(tmp_path / "take.csv", codes, weights).read_text().splitlines()
    lines[4] = "10:00:00:58.000,0"
    del lines[6:8]
    (tmp_path / "take.csv").write_text("\n".join(lines))
    found = read_performance(tmp_path / "take.csv")
    assert (len(found.times), found.lost) == (7, 3)
    assert_allclose(resampled(found).weights, weights, atol=1e-6)
    assert_allclose(resampled(found, 120.0).weights[::2], weights, atol=1e-6)
    codes = [f"00:00:59;{n:02d}" for n in range(20, 30)]
    codes += [f"00:01:00;{n:02d}" for n in range(2, 12)]
    found = read_performance(write_csv(tmp_path / "take.csv", codes, np.zeros((20, 52))))
    assert_allclose(np.diff(found.times), 1001 / 30000, atol=1e-9)


def test_every_form_of_csv_json_and_text(tmp_path):
    """Catches a tool whose file is refused, or whose weights come to other shapes."""
    header = [name for name in HEADER if name != "TongueOut"]
    (tmp_path / "take").mkdir()
    write_csv(tmp_path / "take/Slate_1.csv", codes_of(6), WEIGHTS, header)
    write_csv(tmp_path / "take/Slate_1_neutral.csv", codes_of(1), WEIGHTS[:1])
    assert is_performance(tmp_path / "take")
    assert not is_performance(tmp_path / "take.mp4")
    found = read_performance(tmp_path / "take")
    (tmp_path / "take/transforms.json").touch()
    assert not is_performance(tmp_path / "take")
    assert_allclose(found.weights[:, :51], WEIGHTS[:, :51], atol=1e-6)
    assert not found.weights[:, 51].any()
    order = RNG.permutation(52)
    names = [ARKIT_SHAPES[k] for k in order]
    rows = WEIGHTS[:, order].tolist()
    categories = [[("_neutral", 0.5), *zip(names, row, strict=True)] for row in rows]
    scores = [[{"categoryName": n, "score": v} for n, v in frame] for frame in categories]
    mediapipe = [{"blendshapes": frame} for frame in scores]
    audio = {"exportFps": 25.0, "numPoses": 52, "numFrames": 6}
    timed = [{"weights": row, "time": n / 25} for n, row in enumerate(rows)]
    documents = {
        "audio2face": {**audio, "facsNames": names, "weightMat": rows},
        "lam": {"names": names, "metadata": {"fps": 25.0}, "frames": timed},
        "mediapipe": {"fps": 25, "frames": mediapipe},
        "plain": {"fps": 25, "frames": [dict(zip(names, row, strict=True)) for row in rows]},
    }
    for name, document in documents.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(document))
        found = read_performance(tmp_path / f"{name}.json")
        assert_allclose(found.weights, WEIGHTS, err_msg=name)
        assert found.fps == pytest.approx(25), name
    named = [dict(zip(ARKIT_SHAPES, row, strict=True)) for row in WEIGHTS]
    packets = [wire.facial_mocap(row, (90, 45, -30)) for row in named]
    (tmp_path / "take.txt").write_bytes(b"\n".join(packets))
    found = read_performance(tmp_path / "take.txt")
    assert_allclose(found.weights, WEIGHTS, atol=0.0051)  # whole percents
    assert_allclose(np.degrees(found.head), [[45, 90, -30]] * 6)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda text: text.replace("JawOpen", "JawOpne"), "lacks jawOpen; it has 'JawOpne'"),
        (lambda text: re.sub("JawLeft", "JawLefft", text), "lacks jawLeft; it has 'JawLefft'"),
        (lambda text: "Timecode,Smile\n0,1\n", "names none of ARKit's 52"),
        (lambda text: text.replace("0.5", "half", 1), "expected a number"),
        (lambda text: text.replace("01:00:00:00.0", "noon"), "Timecode is 'noon'"),
        (lambda text: text.splitlines()[0], "has no row with a face"),
        (lambda text: text.replace("0.1", "911.1"), "beyond"),
        (lambda text: "", "is empty"),
        (lambda text: "time,name,other\n0,jawOpen,1\n", "names none of ARKit's 52"),
        (lambda text: "time,name,value\n0,jawOpen,1\n1,jawOpen\n", "names none of ARKit's 52"),
        (
            lambda text: re.sub("(?m)^(.*?),(.*)$", r"\2,\1", text).rpartition(",")[0],
            "row 6: Timeco",
        ),
    ],
)
def test_mistakes_are_one_sentence(tmp_path, change, sentence):
    """Catches tracebacks, and sentences that do not say which names are missing."""
    path = write_csv(tmp_path / "take.csv", codes_of(6), np.full((6, 52), 0.5))
    path.write_text(change(path.read_text()))
    with refusal(sentence) as caught:
        read_performance(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("document", "sentence"),
    [
        ({"names": ["jawOpen"], "frames": [[0.1, 0.2]]}, "has 2 weights, but the file names 1"),
        ({"frames": [{"jawOpne": 0.1}, {}]}, "names none of ARKit's 52"),
        ({"frames": [{"jawOpne": 0.1, "mouthClose": 0}]}, "it has 'jawOpne'"),
        ({"frames": [dict.fromkeys(ARKIT_SHAPES, "x")]}, "expected a number"),
        ({"other": 1}, "has no list of frames"),
        ([3], "expected named weights"),
        ([{"time": [1], "name": "jawOpen", "value": 0.5}], "names none of ARKit's 52"),
        ([{"time": 1, "name": "jawOpen"}], "names none of ARKit's 52"),
        ({"fps": 0, "frames": [dict.fromkeys(ARKIT_SHAPES, 0.1)]}, "not usable"),
    ],
)
def test_mistakes_in_json(tmp_path, document, sentence):
    """Catches tracebacks for JSON of other forms."""
    (tmp_path / "x.json").write_text(json.dumps(document))
    with refusal(sentence):
        read_performance(tmp_path / "x.json")


def test_names_in_every_spelling():
    """Catches a shape lost by another tool's spelling, and words that only look like shapes."""
    spellings = "mouthSmileLeft MouthSmileLeft mouthSmile_L mouth_smile_left"
    for spelled in [*spellings.split(), "blendShapes.MouthSmileLeft"]:
        assert arkit_name(spelled) == "mouthSmileLeft", spelled
    assert arkit_name("browInnerUp_L") is None
    assert arkit_name("_neutral") is None


def test_mirror_and_smoothing():
    """Catches a pair not exchanged, and smoothing that moves a take or changes a held pose."""
    head = np.tile([0.1, 0.2, 0.3], (40, 1))
    base = Performance(np.arange(40) / 30, np.zeros((40, 52)), head, 30.0)
    base.weights[20, COLUMN["eyeBlinkLeft"]] = 1.0
    base.weights[:, COLUMN["jawOpen"]] = 0.4
    other = mirrored(base)
    assert other.weights[20, COLUMN["eyeBlinkRight"]] == 1.0
    assert_allclose(other.head[0], [-0.1, 0.2, -0.3])
    assert_array_equal(mirrored(other).weights, base.weights)
    soft = smoothed(base, 0.05).weights
    assert_allclose(soft[:, COLUMN["jawOpen"]], 0.4)
    blink = soft[:, COLUMN["eyeBlinkLeft"]]
    assert blink.argmax() == 20
    assert blink.sum() == pytest.approx(1)
    assert blink.max() < 0.4
