"""Images and masks: every kind of file that a studio hands over, as phones and editors store them,
turned by EXIF or in other colors than sRGB; and every way one can be broken."""

import io
import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image, ImageCms
from refusal import refusal

from stga_addon.capture.camera import camera_from_gl
from stga_addon.capture.images import image_size, is_plain, read_image, read_mask, read_view
from stga_addon.capture.model import View
from stga_addon.tracking.footage.open import open_footage, sized

WIDTH = 48
HEIGHT = 32
RANDOM = np.random.default_rng(3)
COLOUR = RANDOM.integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
GREY = RANDOM.integers(0, 256, (HEIGHT, WIDTH), np.uint8)
ALPHA = RANDOM.integers(0, 255, (HEIGHT, WIDTH), np.uint8)
LEVELS = {"a": 30, "b": 90, "c": 150, "d": 210}
# How a viewer shows the corners a b / c d of the stored picture (EXIF 2.32, tag Orientation).
ORIENTATIONS = {
    1: "ab cd",
    2: "ba dc",
    3: "dc ba",
    4: "cd ab",
    5: "ac bd",
    6: "ca db",
    7: "db ca",
    8: "bd ac",
}


def view_of(image, width=WIDTH, height=HEIGHT, mask=None):
    camera = camera_from_gl(np.eye(4), (width, height), (60, 60), (width / 2, height / 2))
    return View(0, 0, camera, image.name, image, mask)


def chunk(name, data):
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def saved(path, pixels):
    Image.fromarray(pixels).save(path)
    return path


@pytest.mark.parametrize("background", [(255, 255, 255), (0, 0, 0), (10, 200, 90)])
def test_transparency_is_laid_over_the_background(tmp_path, background):
    """Catches premultiplied mixing and overflow; alpha is the mask."""
    view = view_of(saved(tmp_path / "x.png", np.dstack([COLOUR, ALPHA])))
    share = ALPHA[..., None] / 255
    expected = np.round(COLOUR * share + np.array(background) * (1 - share))
    assert_allclose(read_image(view, background), expected, atol=0.51)
    assert_array_equal(read_mask(view), ALPHA)


def test_gray_and_palette(tmp_path):
    """Catches a missing channel axis of gray or palettes, and 16-bit gray cut off at 255."""
    bits = GREY > 127
    few = (COLOUR // 128) * 255
    la = np.dstack([GREY, np.where(bits, 255, 0).astype(np.uint8)])
    wide = RANDOM.integers(0, 65536, (HEIGHT, WIDTH)).astype(np.uint16)
    for pixels, expected in (
        (GREY, np.dstack([GREY] * 3)),
        (bits, np.dstack([bits * 255] * 3)),
        (la, np.dstack([np.where(bits, GREY, 255)] * 3)),
    ):
        found = read_image(view_of(saved(tmp_path / "x.png", pixels)))
        assert_array_equal(found, expected)
    image = read_image(view_of(saved(tmp_path / "x.png", wide)))
    assert_allclose(image[..., 0], wide / 257, atol=0.51)
    Image.fromarray(few).quantize(8).save(tmp_path / "p.png")
    assert_array_equal(read_image(view_of(tmp_path / "p.png")), few)
    Image.fromarray(COLOUR).save(tmp_path / "t.png", transparency=tuple(map(int, COLOUR[2, 3])))
    assert_array_equal(read_image(view_of(tmp_path / "t.png"))[2, 3], [255, 255, 255])


def test_size_mismatch_names_both(tmp_path):
    """Catches an image that is resized in silence, or broadcast later on."""
    wrong = saved(tmp_path / "wrong.png", COLOUR[:-1])
    expected = r"wrong\.png: the image has 48 x 31 pixels, but the camera of wrong\.png has 48 x 32"
    with refusal(expected):
        read_image(view_of(wrong))
    right = saved(tmp_path / "right.png", COLOUR)
    with refusal(r"wrong\.png: the mask has 48 x 31 pixels, but the image .*right\.png .* 48 x 32"):
        read_mask(view_of(right, mask=wrong))


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("kept", [0.0, 0.3, 0.6, 0.95])
def test_truncated_images(tmp_path, suffix, kept):
    """Catches a download that broke off being read as a half-gray image."""
    path = tmp_path / f"x{suffix}"
    big = RANDOM.integers(0, 256, (64, 64, 3), np.uint8)
    saved(path, big)
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * kept)])
    with refusal(rf"x\{suffix}: is not a readable image"):
        read_image(view_of(path, 64, 64))


def test_missing_and_foreign_images(tmp_path):
    """Catches no image, a text, a format that runs programs, and a claim of gigapixels."""
    with refusal(r"none\.png: does not exist"):
        read_image(view_of(tmp_path / "none.png"))
    for text in (b"hello", b"P6 48 32 255 " + bytes(WIDTH * HEIGHT * 3)):
        (tmp_path / "x.png").write_bytes(text)
        with refusal(r"x\.png: is not a readable image"):
            read_image(view_of(tmp_path / "x.png"))
    with refusal("is not a readable image"):
        read_image(view_of(tmp_path))
    header = (60000).to_bytes(4, "big") * 2 + bytes([8, 2, 0, 0, 0])
    body = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")
    (tmp_path / "bomb.png").write_bytes(b"\x89PNG\r\n\x1a\n" + body)
    with refusal(r"bomb\.png: "):
        read_image(view_of(tmp_path / "bomb.png"))
    with refusal(r"bomb\.png: "):
        image_size(tmp_path / "bomb.png")


def test_scaled_view(tmp_path):
    """Catches an image and a camera scaled to different sizes, a focal length left behind, a mask
    read as anything but gray, and one invented where there is none."""
    bare = view_of(saved(tmp_path / "x.png", COLOUR))
    assert read_mask(bare) is None
    gray = saved(tmp_path / "m.png", GREY)
    for mask_file in (gray, saved(tmp_path / "c.png", np.dstack([GREY] * 3))):
        assert_array_equal(read_mask(replace(bare, mask=mask_file)), GREY)
    view = replace(bare, mask=gray)
    small, image, mask = read_view(view, 0.5)
    assert image.shape == (small.camera.height, small.camera.width, 3)
    assert_allclose(image.mean((0, 1)), COLOUR.mean((0, 1)), atol=1)
    assert mask.shape == image.shape[:2]
    assert small.camera.fl_x == pytest.approx(60 * small.camera.width / WIDTH)
    same, image, mask = read_view(view)
    assert same is view
    assert_array_equal(image, COLOUR)


def corners(image):
    """Letters of the four quarters, row by row."""
    height, width = image.shape[:2]
    gray = image.reshape(height, width, -1)[..., 0].astype(int)
    gray = gray[height // 4 :: height // 2, width // 4 :: width // 2]
    names = np.array(list("abcd"))[np.abs(gray[..., None] - list(LEVELS.values())).argmin(-1)]
    return " ".join("".join(row) for row in names)


def write_turned(path, orientation):
    quarters = np.reshape(list(LEVELS.values()), (2, 2, 1)).astype(np.uint8)
    pixels = quarters.repeat(HEIGHT // 2, 0).repeat(WIDTH // 2, 1).repeat(3, 2)
    exif = Image.Exif()
    exif[0x0112] = orientation
    Image.fromarray(pixels).save(path, exif=exif, quality=95)


@pytest.mark.parametrize("suffix", [".jpg", ".webp", ".tif", ".png"])
@pytest.mark.parametrize("orientation", ORIENTATIONS)
def test_orientation(tmp_path, orientation, suffix):
    """Catches a phone's photo that is tracked and trained lying, upside down or mirrored."""
    path = tmp_path / f"x{suffix}"
    write_turned(path, orientation)
    size = (WIDTH, HEIGHT) if orientation < 5 else (HEIGHT, WIDTH)
    assert image_size(path) == size
    assert corners(read_image(view_of(path, *size))) == ORIENTATIONS[orientation]
    assert corners(read_mask(view_of(path, *size, mask=path))) == ORIENTATIONS[orientation]
    camera = open_footage(tmp_path, focal=50).cameras[0]
    assert corners(camera.image(0)) == ORIENTATIONS[orientation]
    # A file that other programs would show turned is not copied into a capture; TIFF is turned by
    # all.
    assert is_plain(path) == (camera.file(0) is not None) == (orientation == 1 or suffix == ".tif")


def test_footage_of_half_the_size(tmp_path):
    """Catches images of another size than their camera, shifted by a part of a pixel."""
    rng = np.random.default_rng(0)
    coarse = rng.integers(60, 200, (6, 9, 3))
    smooth = np.asarray(Image.fromarray(coarse.astype(np.uint8)).resize((90, 60), 2))
    Image.fromarray(smooth).save(tmp_path / "x.png")
    camera = sized(open_footage(tmp_path, focal=50), 0.5).cameras[0]
    assert (camera.camera.width, camera.camera.height, camera.camera.fl_x) == (45, 30, 25)
    blocks = smooth.reshape(30, 2, 45, 2, 3).mean(axis=(1, 3))
    assert np.abs(camera.image(0) - blocks).mean() < 0.5
    assert camera.file(0) is None


def test_camera_of_the_stored_pixels(tmp_path):
    """Catches a capture whose cameras were calibrated without EXIF refused, or turned."""
    write_turned(tmp_path / "x.jpg", 6)
    assert corners(read_image(view_of(tmp_path / "x.jpg", WIDTH, HEIGHT))) == "ab cd"


SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
DISPLAY_P3 = Path(__file__).with_name("display_p3.icc").read_bytes()
"""With the colorants that Apple published, and an exponent of 2.2."""


def icc(data):
    return chunk(b"iCCP", b"p\0\0" + zlib.compress(data))


def png(path, color, *chunks, mode="RGB"):
    """A PNG of one color with chunks before its pixels."""
    stream = io.BytesIO()
    Image.new(mode, (WIDTH, HEIGHT), color).save(stream, format="PNG")
    data = stream.getvalue()
    path.write_bytes(data[:33] + b"".join(chunks) + data[33:])


# In Display P3 sRGB's red is (0.9175, 0.2003, 0.1386) by CSS Color 4; it is near that with an
# exponent of 2.2 as well.
RED_IN_P3 = (234, 51, 35)
LINEAR = chunk(b"gAMA", struct.pack(">I", 100000))
STORED = {
    "profile": (RED_IN_P3, [icc(DISPLAY_P3)], (255, 0, 0)),
    "sRGB's profile": (RED_IN_P3, [icc(SRGB)], RED_IN_P3),
    "damaged profile": (RED_IN_P3, [icc(DISPLAY_P3[:140])], RED_IN_P3),
    "cICP of Display P3": (RED_IN_P3, [chunk(b"cICP", bytes([12, 13, 0, 1]))], (255, 0, 0)),
    "cICP of sRGB before a profile": (
        RED_IN_P3,
        [chunk(b"cICP", bytes([1, 13, 0, 1])), icc(DISPLAY_P3)],
        RED_IN_P3,
    ),
    "cICP of PQ": ((148, 148, 148), [chunk(b"cICP", bytes([9, 16, 0, 1]))], (255, 255, 255)),
    "linear gAMA": ((55, 55, 55), [LINEAR], (128, 128, 128)),
    "sRGB gAMA": ((55, 55, 55), [chunk(b"gAMA", struct.pack(">I", 45455))], (55, 55, 55)),
    "gAMA beside sRGB": ((55, 55, 55), [LINEAR, chunk(b"sRGB", b"\0")], (55, 55, 55)),
}


@pytest.mark.parametrize("name", STORED)
def test_colors_become_srgb(tmp_path, name):
    """Catches skin that is pale or dark because the file's colors are not sRGB's; and sRGB that is
    converted."""
    color, chunks, expected = STORED[name]
    path = tmp_path / "x.png"
    png(path, color, *chunks)
    assert_allclose(read_image(view_of(path))[5, 5], expected, atol=7)
    if expected == color:
        assert_array_equal(read_image(view_of(path))[5, 5], color)
    assert is_plain(path) == (expected == color)


def test_profile_beside_transparency_and_in_jpeg(tmp_path):
    """Catches alpha lost in the conversion, a mask that is converted, and profiles of JPEG left
    out."""
    path = tmp_path / "x.png"
    png(path, (*RED_IN_P3, 128), icc(DISPLAY_P3), mode="RGBA")
    assert_allclose(read_image(view_of(path), (0, 0, 0))[5, 5], (128, 0, 0), atol=4)
    assert read_mask(view_of(path))[5, 5] == 128
    red = Image.new("RGB", (WIDTH, HEIGHT), RED_IN_P3)
    red.save(tmp_path / "x.jpg", quality=98, icc_profile=DISPLAY_P3)
    assert_allclose(read_image(view_of(tmp_path / "x.jpg"))[5, 5], (255, 0, 0), atol=8)
