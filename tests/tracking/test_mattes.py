"""Mattes of a take: made, read from a folder, kept and continued."""

from dataclasses import replace

import numpy as np
import pytest
from command_line import refused
from PIL import Image
from refusal import refusal

from stga_addon.tracking import mattes
from stga_addon.tracking.footage.open import open_footage
from stga_addon.tracking.mattes import with_mattes
from stga_addon.tracking.stages import Workers
from stga_addon.worker.helpers import Helpers

from .scenes import HEIGHT, WIDTH, write_image, write_video

pytest.importorskip("cv2")


class Halves:
    """Takes the left half of each image for the person, and counts."""

    def __init__(self):
        self.asked = 0

    def probability(self, image):
        self.asked += 1
        left = np.arange(image.shape[1]) < image.shape[1] // 2
        return np.repeat(left[None].astype(np.float32), len(image), axis=0)


class Everybody:
    """Takes all that is not as bright as a backdrop for the person."""

    def probability(self, image):
        return (image.max(axis=2) < 200).astype(np.float32)


@pytest.fixture
def halves(monkeypatch):
    segmenter = Halves()
    monkeypatch.setattr(mattes, "PersonNetwork", lambda: segmenter)
    return segmenter


def head(timestep, camera):
    found = np.zeros((HEIGHT, WIDTH), bool)
    found[8:20, 4:16] = True
    return found


def take(folder, frames=3):
    """A camera's images: dark on the left, bright on the right."""
    for number in range(frames):
        path = folder / "footage/left" / f"{number:04d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        pixels = np.full((HEIGHT, WIDTH, 3), 220, np.uint8)
        pixels[:, : WIDTH // 2] = (60, 40, 30)
        Image.fromarray(pixels).save(path)
    return open_footage(folder / "footage", focal=50.0)


def made(footage, folder, source=None):
    """The footage with mattes, and warnings."""
    return with_mattes(footage, head, folder / "out", source or {}, Workers(Helpers(1)))


def brightest(footage):
    """Of the first camera's masks, by timestep."""
    camera = footage.cameras[0]
    return [int(camera.mask(timestep).max()) for timestep in camera.timesteps]


def test_made_once_and_kept(tmp_path, halves):
    """Catches mattes that an interrupted tracking makes again, and those of another head that are
    kept."""
    footage = take(tmp_path)
    found, warnings = made(footage, tmp_path, {"head": "a"})
    assert (halves.asked, warnings) == (3, ())
    files = sorted(path.name for path in (tmp_path / "out/fg_masks").iterdir())
    assert files == ["00000_00.png", "00001_00.png", "00002_00.png"]
    mask = found.cameras[0].mask(1)
    assert mask[:, : WIDTH // 2 - 2].min() == 255
    assert mask[:, WIDTH // 2 + 2 :].max() == 0
    (tmp_path / "out/fg_masks/00001_00.png").unlink()
    made(footage, tmp_path, {"head": "a"})
    assert halves.asked == 4
    made(footage, tmp_path, {"head": "b"})
    assert halves.asked == 7


def test_masks_of_the_footage_stay(tmp_path, halves):
    """Catches a user's masks that are replaced, a camera of which only the first frame is asked for
    its mask, so that the others get no matte, and made mattes, which are of the undistorted frame,
    that are resampled by the lens once more."""
    for number in (0, 2):
        write_image(tmp_path / f"footage/masks/left/{number:04d}.png", 90)
    found, warnings = made(take(tmp_path, 4), tmp_path)
    assert brightest(found) == [90, 255, 90, 255]
    assert (halves.asked, warnings) == (2, ())
    camera = replace(found.cameras[0], undistortion=lambda mask: pytest.fail("resampled"))
    assert camera.mask(1) is not None


def test_clean_plate_of_a_camera(tmp_path, halves):
    """Catches a plate that is taken for a camera, or not found, and one of another size that ends
    in OpenCV's error; no network is asked."""
    (tmp_path / "footage/plates").mkdir(parents=True)
    Image.new("RGB", (WIDTH, HEIGHT), (220, 220, 220)).save(tmp_path / "footage/plates/left.png")
    footage = take(tmp_path)
    assert [camera.name for camera in footage.cameras] == ["left"]
    found, warnings = made(footage, tmp_path)
    assert (halves.asked, warnings) == (0, ())
    assert found.cameras[0].mask(2)[:, : WIDTH // 2 - 2].min() == 255
    assert found.cameras[0].mask(2)[:, WIDTH // 2 + 2 :].max() == 0
    write_image(tmp_path / "footage/plates/left.png", size=(7, 5))
    with refusal(r"left\.png: the image has 7 x 5 pixels"):
        made(footage, tmp_path, {"head": "another"})


@pytest.mark.parametrize(
    ("sides", "level"),
    [((0, 3, 0, 0), 0), ((3, 3, 0, 0), 0), ((0, 0, 4, 4), 255), ((0, 0, 0, 0), 0)],
    ids=["below", "letterbox", "pillarbox", "none"],
)
def test_bars_belong_to_nobody(sides, level, tmp_path, monkeypatch):
    """Catches a bar of one color that becomes a bib over the chest, and a plain backdrop or cloth
    that are taken for one."""
    monkeypatch.setattr(mattes, "PersonNetwork", Everybody)
    noise = np.random.default_rng(0)
    top, bottom, left, right = sides
    is_bar = np.ones((HEIGHT, WIDTH), bool)
    is_bar[top : HEIGHT - bottom, left : WIDTH - right] = False
    rows, columns = np.ogrid[:HEIGHT, :WIDTH]
    person = np.hypot(rows - 14, columns - 12) < 9
    for number in range(3):
        pixels = np.full((HEIGHT, WIDTH, 3), 220, np.uint8)
        pixels[person] = 60, 40, 30
        pixels[is_bar] = np.clip(level + noise.normal(0, 2, (is_bar.sum(), 3)), 0, 255)
        path = tmp_path / "footage/left" / f"{number:04d}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(pixels).save(path)
    footage, warnings = made(open_footage(tmp_path / "footage", focal=50.0), tmp_path)
    for timestep in footage.timesteps:
        mask = footage.cameras[0].mask(timestep)
        assert not mask[is_bar].any()
        assert mask[8:20, 6:18].mean() > 200
    assert len(warnings) == any(sides)
    names = ("above", "below", "on the left", "on the right")
    named = [f"pixels {name}" in "".join(warnings) for name in names]
    assert named == [size > 0 for size in sides]


@pytest.mark.parametrize("suffix", ["png", "jpg"])
def test_a_folder_of_mattes(tmp_path, suffix):
    """Catches mattes of other frames, photos without one that are turned by EXIF, whose stored
    pixels are not the frame's, and a frame without a matte that is not said."""
    exif = Image.Exif()
    exif[274] = 3  # upside down
    for number in range(3):
        path = tmp_path / f"footage/left/{number:04d}.{suffix}"
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", (WIDTH, HEIGHT)).save(path, exif=exif if suffix == "jpg" else None)
        write_image(tmp_path / f"mattes/left/{number:04d}.png", 10 * number)
    footage = open_footage(tmp_path / "footage", focal=50.0, mattes=tmp_path / "mattes")
    assert brightest(footage) == [0, 10, 20]
    (tmp_path / "mattes/left/0001.png").unlink()
    with refusal(rf"has no matte of .*0001\.{suffix}; expected left/0001\.png"):
        open_footage(tmp_path / "footage", focal=50.0, mattes=tmp_path / "mattes")


def test_mattes_of_a_video(tmp_path):
    """Catches mattes that are counted from 1, or by timestep where frames are left out."""
    pytest.importorskip("av")
    write_video(tmp_path / "footage/left.mp4", [20, 60, 100, 140])
    for number in range(4):
        write_image(tmp_path / f"mattes/left/{number:05d}.png", 10 * number)
    footage = open_footage(tmp_path / "footage", focal=50.0, mattes=tmp_path / "mattes")
    assert brightest(footage) == [0, 10, 20, 30]


def test_a_folder_that_is_none(tmp_path, capsys):
    """Catches a traceback for a folder that does not exist."""
    take(tmp_path)
    words = (
        "track",
        tmp_path / "footage",
        "--out",
        tmp_path / "out",
        "--mattes",
        tmp_path / "nowhere",
    )
    assert "nowhere: is not a folder; expected one of mattes" in refused(capsys, *words)
