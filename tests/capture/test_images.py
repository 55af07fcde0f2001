"""Images and masks: every kind of file a studio hands over, and every way one can be broken."""

import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stga_addon.capture.camera import camera_from_gl
from stga_addon.capture.images import image_size, read_image, read_mask, read_view
from stga_addon.capture.model import View
from stga_addon.errors import StgaError

WIDTH, HEIGHT = 7, 5
RANDOM = np.random.default_rng(3)
COLOUR = RANDOM.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
GREY = RANDOM.integers(0, 256, (HEIGHT, WIDTH), np.uint8)
ALPHA = RANDOM.integers(0, 255, (HEIGHT, WIDTH), np.uint8)


def view_of(image: Path, mask: Path | None = None) -> View:
    camera = camera_from_gl(np.eye(4), WIDTH, HEIGHT, 10, 10, WIDTH / 2, HEIGHT / 2)
    return View(0, 0, camera, image.name, image, mask)


def saved(path: Path, pixels: np.ndarray) -> Path:
    Image.fromarray(pixels).save(path)
    return path


@pytest.mark.parametrize("background", [(255, 255, 255), (0, 0, 0), (10, 200, 90)])
def test_transparency_is_laid_over_the_background(
    tmp_path: Path, background: tuple[int, int, int]
) -> None:
    """Catches premultiplied mixing and integer overflow, against the same in floating point; alpha
    is the mask."""
    view = view_of(saved(tmp_path / "x.png", np.dstack([COLOUR, ALPHA])))
    share = ALPHA[..., None] / 255
    expected = np.round(COLOUR * share + np.array(background) * (1 - share))
    np.testing.assert_allclose(read_image(view, background), expected, atol=0.51)
    np.testing.assert_array_equal(read_mask(view), ALPHA)


def test_gray_and_palette(tmp_path: Path) -> None:
    """Catches gray, black-and-white, gray with alpha and palette images read with a missing channel
    axis, and 16-bit gray cut off at 255, which turns nearly everything white."""
    bits, few = GREY > 127, (COLOUR // 128) * 255
    la = np.dstack([GREY, np.where(bits, 255, 0).astype(np.uint8)])
    wide = RANDOM.integers(0, 65536, (HEIGHT, WIDTH)).astype(np.uint16)
    for pixels, expected in (
        (GREY, np.dstack([GREY] * 3)), (bits, np.dstack([bits * 255] * 3)),
        (la, np.dstack([np.where(bits, GREY, 255)] * 3)),
    ):  # fmt: skip
        found = read_image(view_of(saved(tmp_path / "x.png", pixels)))
        np.testing.assert_array_equal(found, expected)
    image = read_image(view_of(saved(tmp_path / "x.png", wide)))
    np.testing.assert_allclose(image[..., 0], wide / 257, atol=0.51)
    Image.fromarray(few).quantize(8).save(tmp_path / "p.png")
    np.testing.assert_array_equal(read_image(view_of(tmp_path / "p.png")), few)
    Image.fromarray(COLOUR).save(tmp_path / "t.png", transparency=tuple(map(int, COLOUR[2, 3])))
    np.testing.assert_array_equal(read_image(view_of(tmp_path / "t.png"))[2, 3], [255, 255, 255])


def test_size_mismatch_names_both(tmp_path: Path) -> None:
    """Catches an image that is resized in silence, or broadcast later on."""
    wrong = saved(tmp_path / "wrong.png", COLOUR[:-1])
    expected = r"wrong\.png: the image has 7 x 4 pixels, but the camera of wrong\.png has 7 x"
    with pytest.raises(StgaError, match=expected):
        read_image(view_of(wrong))
    right = saved(tmp_path / "right.png", COLOUR)
    expected = r"wrong\.png: the mask has 7 x 4 pixels, but the image .*right\.png .* 7 x 5"
    with pytest.raises(StgaError, match=expected):
        read_mask(view_of(right, wrong))


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("kept", [0.0, 0.3, 0.6, 0.95])
def test_truncated_images(tmp_path: Path, suffix: str, kept: float) -> None:
    """Catches a download that broke off being read as a half-gray image."""
    path = tmp_path / f"x{suffix}"
    big = RANDOM.integers(0, 256, (64, 64, 3), np.uint8)
    saved(path, big)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * kept)])
    view = view_of(path)
    view = replace(view, camera=replace(view.camera, width=64, height=64))
    with pytest.raises(StgaError, match=rf"x\{suffix}: is not a readable image"):
        read_image(view)


def test_missing_and_foreign_images(tmp_path: Path) -> None:
    """Catches a missing image, a text file, and a format besides those allowed: for some Pillow
    runs other programs."""
    with pytest.raises(StgaError, match=r"none\.png: does not exist"):
        read_image(view_of(tmp_path / "none.png"))
    for text in (b"hello", b"P6 7 5 255 " + bytes(WIDTH * HEIGHT * 3)):
        (tmp_path / "x.png").write_bytes(text)
        with pytest.raises(StgaError, match=r"x\.png: is not a readable image"):
            read_image(view_of(tmp_path / "x.png"))
    with pytest.raises(StgaError, match="is not a readable image"):
        read_image(view_of(tmp_path))


def test_decompression_bomb(tmp_path: Path) -> None:
    """Catches a tiny file that claims gigapixels and would fill the memory."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        check = zlib.crc32(kind + data).to_bytes(4, "big")
        return len(data).to_bytes(4, "big") + kind + data + check

    header = (60000).to_bytes(4, "big") * 2 + bytes([8, 2, 0, 0, 0])
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")
    (tmp_path / "bomb.png").write_bytes(b"\x89PNG\r\n\x1a\n" + body)
    with pytest.raises(StgaError, match=r"bomb\.png: "):
        read_image(view_of(tmp_path / "bomb.png"))
    with pytest.raises(StgaError, match=r"bomb\.png: "):
        image_size(tmp_path / "bomb.png")


def test_scaled_view(tmp_path: Path) -> None:
    """Catches an image and a camera scaled to different sizes, a focal length left behind, a mask
    read as anything but gray, and one invented where there is none."""
    bare = view_of(saved(tmp_path / "x.png", COLOUR))
    assert read_mask(bare) is None
    gray = saved(tmp_path / "m.png", GREY)
    for mask_file in (gray, saved(tmp_path / "c.png", np.dstack([GREY] * 3))):
        np.testing.assert_array_equal(read_mask(replace(bare, mask=mask_file)), GREY)
    view = replace(bare, mask=gray)
    small, image, mask = read_view(view, 0.5)
    assert mask is not None
    assert image.shape == (small.camera.height, small.camera.width, 3)
    np.testing.assert_allclose(image.mean((0, 1)), COLOUR.mean((0, 1)), atol=1)
    assert mask.shape == image.shape[:2]
    assert small.camera.fl_x == pytest.approx(10 * small.camera.width / WIDTH)
    same, image, mask = read_view(view)
    assert same is view
    np.testing.assert_array_equal(image, COLOUR)
