"""CSV performances as the page reads them: as the add-on does, at the times of the cameras."""

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from stga_addon.driving.performance import ARKIT_SHAPES, COUNT, resampled
from stga_addon.driving.performers import read_performance
from stga_addon.errors import StgaError
from stga_addon.export.web.page import PLAYER

pytestmark = pytest.mark.needs("node")

SHAPES = [name[0].upper() + name[1:] for name in ARKIT_SHAPES]
HEADER = ["Timecode", "BlendShapeCount", *SHAPES, "HeadYaw", "HeadPitch", "HeadRoll"]
HEAD = np.array([0.1, -0.2, 0.3])


def take(codes, header=HEADER, rest="", is_quoted=False):
    """A Live Link Face file in which all weights of row n are n / rows; rest: at the end of rows
    below the header."""
    lines = [header]
    for row, code in enumerate(codes):
        lines.append([code, "61", *[f"{row / len(codes):.6f}"] * COUNT, *map(str, HEAD)])
    if is_quoted:
        lines = [['"' + cell.replace('"', '""') + '"' for cell in line] for line in lines]
    first, *others = (",".join(line) for line in lines)
    return "\r\n".join([first, *(line + rest for line in others)])


def drop_frame_codes(first, count):
    """Codes of a 29.97 Hz camera: the numbers 0 and 1 are skipped at each minute but the tenth."""
    hour, minute, second, frame = map(int, first.replace(";", ":").split(":"))
    codes = []
    while len(codes) < count:
        codes.append(f"{hour:02d}:{minute:02d}:{second:02d};{frame:02d}")
        frame += 1
        if frame == 30:
            second = second + 1
            frame = 0
        if second == 60:
            minute = minute + 1
            second = 0
            frame = 2 if minute % 10 else 0
    return codes


def read_by_page(texts, folder):
    (folder / "texts.json").write_text(json.dumps([ARKIT_SHAPES, *texts]))
    command = ["node", Path(__file__).with_name("performances.mjs"), PLAYER, folder / "texts.json"]
    done = subprocess.run(command, capture_output=True, timeout=120)
    assert not done.stderr, done.stderr.decode()
    return list(json.loads(done.stdout))


CODES = [f"10:00:00:{frame:02d}.000" for frame in range(6)]
DROPPING = drop_frame_codes("00:08:59;10", 1860)
MIDNIGHT = ["23:59:59:58.5", "23:59:59:59.5", "00:00:00:00.5", "00:00:00:01.5"]
PLAIN = take(CODES)
LATE = PLAIN.split("\r\n")
READABLE = {
    "plain": (PLAIN, 60, 6),
    "drop frame": (take(DROPPING), 30000 / 1001, 1860),
    "midnight": (take(MIDNIGHT), 60, 4),
    "quoted": (take(CODES, is_quoted=True), 60, 6),
    "quoted lines": (take(CODES, ['Time\ncode, "own"', *HEADER[1:]], is_quoted=True), 60, 6),
    "trailing commas": (take(CODES, rest=",,"), 60, 6),
    "named trailing commas": (take(CODES, [*HEADER, "", ""], rest=",,"), 60, 6),
    "prefixes": (take(CODES, [f"face.{name}" for name in HEADER]), 60, 6),
    "a row late": ("\r\n".join([*LATE[:2], *LATE[3:], LATE[2]]), 60, 6),
    "a row twice": ("\r\n".join([*LATE[:3], LATE[2], *LATE[3:]]), 60, 6),
    "a row without a face": ("\r\n".join([*LATE[:3], "10:00:00:02.000,0", *LATE[4:]]), 60, 6),
    "old Mac lines": (PLAIN.replace("\r\n", "\r"), 60, 6),
    "seconds": (take([f"{n / 25}" for n in range(6)]), 25, 6),
}


def test_every_form_comes_at_its_times(tmp_path):
    """Catches drop frames that count as lost, cells that keep their quotes, rows left out for their
    trailing commas, and all else that the add-on reads otherwise."""
    texts = [text for text, _, _ in READABLE.values()]
    for (name, (text, fps, count)), page in zip(
        READABLE.items(), read_by_page(texts, tmp_path), strict=True
    ):
        assert "error" not in page, (name, page)
        (tmp_path / "take.csv").write_bytes(text.encode())
        addon = resampled(read_performance(tmp_path / "take.csv"))
        weights = np.tile(np.arange(count)[:, None] / count, COUNT)
        for found in (addon.weights, page["weights"]):
            assert np.shape(found) == (count, COUNT), name
            assert_allclose(found, weights, atol=2e-3, err_msg=name)
        for found in (addon.head, page["head"]):
            assert_allclose(found, np.tile(HEAD, (count, 1)), err_msg=name)
        assert page["fps"] == pytest.approx(fps, rel=1e-4), name
        assert addon.fps == pytest.approx(fps, rel=1e-4), name


UNTOLD = {
    "timecodes within a second": (take([f"10:00:00:{n:02d}" for n in range(20)]), 60.0),
    "every second frame": (take([f"10:00:0{n // 12}:{n % 12 * 2:02d}" for n in range(30)]), None),
    "no times": ("\n".join(line[line.index(",") + 1 :] for line in PLAIN.split("\r\n")), 60.0),
    "seconds": (READABLE["seconds"][0], None),
}
"""Text, and the rate that is assumed where the file has none; None: it has times."""


def test_rates_that_no_file_tells_are_asked_for(tmp_path):
    """Catches a take of 30 frames a second that plays at double speed without a warning."""
    texts = [text for text, _ in UNTOLD.values()]
    plain, asked = (
        read_by_page([given(text) for text in texts], tmp_path)
        for given in (lambda text: text, lambda text: [text, 30])
    )
    for name, page, other in zip(UNTOLD, plain, asked, strict=True):
        text, rate = UNTOLD[name]
        (tmp_path / "take.csv").write_text(text)
        guessed = read_performance(tmp_path / "take.csv").guessed_fps
        assert page["guessedFps"] == guessed == rate, name
        if rate is None:
            assert "has times" in other["error"], name
        else:
            expected = read_performance(tmp_path / "take.csv", recorded_fps=30.0)
            assert other["fps"] == pytest.approx(expected.fps), name
            assert other["weights"] == page["weights"], name


REFUSED = {
    "head angles that are no numbers": (PLAIN.replace("-0.2,", "nan,", 1), "HeadPitch"),
    "weights that are no numbers": (PLAIN.replace("0.500000", "half", 1), "half"),
    "empty weights": (PLAIN.replace("0.500000", "", 1), "EyeBlinkLeft"),
    "times that are none": (PLAIN.replace(CODES[2], "noon"), "noon"),
    "a shape under another name": (PLAIN.replace("JawOpen", "JawOpne"), "jawOpen"),
    "no row": (PLAIN.split("\r\n")[0], "no row with a face"),
    "another table": ("a,b\r\n1,2", "no table of face shapes"),
    "nothing": ("", "no table of face shapes"),
}


REFUSED_BY_THE_PAGE = {
    "empty head angles": (PLAIN.replace("-0.2,", ",", 1), "HeadPitch"),
    "seconds that are none": (take(["0", "1e999", "2"]), "times"),
    "two rows in an hour": (take(["0", "3600"]), "times"),
    "head angles in degrees": (PLAIN.replace("-0.2,", "-20,", 1), "two turns"),
    "weights in percent": (PLAIN.replace("0.500000", "50", 1), "weights"),
}
"""The add-on reads these, and names what it does not use, or the unit."""


def test_unusable_values_are_refused_in_one_sentence(tmp_path):
    """Catches a head that vanishes, or a face that stays still, without a warning."""
    refused = REFUSED | REFUSED_BY_THE_PAGE
    pages = read_by_page([text for text, _ in refused.values()], tmp_path)
    for (name, (text, word)), page in zip(refused.items(), pages, strict=True):
        if name in REFUSED:
            (tmp_path / "take.csv").write_bytes(text.encode())
            with pytest.raises(StgaError):
                read_performance(tmp_path / "take.csv")
        error = str(page.get("error"))
        assert error.startswith("DataError: "), (name, error)
        assert word in error, (name, error)
        assert error.endswith("."), (name, error)
