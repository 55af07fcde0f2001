"""Reading of images and masks with Pillow, upright and in sRGB, checked against the camera."""

import io
import stat
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import IO

import numpy as np
from PIL import Image, ImageCms, ImageOps

from ..errors import StgaError
from ..files import damage_of
from .camera import MAX_IMAGE_PIXELS, is_image_size
from .color import in_bands, is_srgb, to_srgb, with_gamma
from .green_screen import without_spill
from .model import View

WHITE_LEVEL = 247
"""Level of all channels from which a pixel without a mask counts as a white background."""
MIN_DARK_FRACTION = 0.02
"""Least fraction of dark pixels in an inverted mask."""
MIN_BRIGHT_BORDER = 0.95
"""Least fraction of bright pixels along an inverted mask's upper border."""
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP")
"""Pillow opens more than these, some by running other programs."""
ORIENTATION_TAG = 0x0112
"""EXIF's: 1 upright, 2 to 4 mirrored or upside down, 5 to 8 with width and height exchanged."""
# PNG's gAMA of what is shown as sRGB
SRGB_GAMMA = 0.45455
"""Value of a PNG's gAMA chunk that stands for sRGB."""
GAMMA_TOLERANCE = 0.02
"""Difference from it that still does."""
CICP = "stga_cicp"
"""Key of an opened image's information: what `_cicp` found in its file."""
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
WHITE = (255, 255, 255)

# Once, not by `catch_warnings`, which is not safe in threads. Sizes have limits of their own; what
# else Pillow warns about, such as damaged metadata, does not concern the pixels.
warnings.filterwarnings("ignore", module=r"PIL\.")


def image_size(path: Path, is_as_stored: bool = False) -> tuple[int, int]:
    """(width, height) as displayed, or as stored, without EXIF's orientation. Raises StgaError
    where it is no image, or too large a one."""
    with _opened(path) as image:
        width, height = image.size if is_as_stored else _displayed_size(image)
    if not is_image_size(width, height):
        raise StgaError(
            f"{path}: claims {width} x {height} pixels; at most {MAX_IMAGE_PIXELS} are read"
        )
    return width, height


@contextmanager
def _opened(path: Path) -> Iterator[Image.Image]:
    """The image of a file. Raises StgaError for whatever fails while it is open."""
    try:
        if not stat.S_ISREG(path.stat().st_mode):  # a pipe or device may never end
            raise OSError("not a regular file")
        with path.open("rb") as stream:
            codes = _cicp(stream)
            stream.seek(0)
            with Image.open(stream, formats=FORMATS) as image:
                image.info[CICP] = codes
                yield image
    except FileNotFoundError as error:
        raise StgaError(f"{path}: does not exist; expected an image") from error
    except Exception as error:  # Pillow's decoders raise any kind of error for a bad file
        problem = damage_of(path) or f"is not a readable image ({error})"
        raise StgaError(f"{path}: {problem}") from error


def is_turned(path: Path) -> bool:
    """Whether EXIF's orientation turns or mirrors the image. Raises StgaError."""
    with _opened(path) as image:
        return _orientation(image) != 1


def has_alpha(path: Path) -> bool:
    """Whether an image has a channel or a color of transparency, which may be its mask."""
    with _opened(path) as image:
        return image.getbands()[-1] in ("A", "a") or "transparency" in image.info


def is_plain(path: Path) -> bool:
    """Whether programs that know neither EXIF's orientation nor color profiles show the image as it
    is read here."""
    try:
        with _opened(path) as image:
            return _orientation(image) == 1 and _conversion(image) is None
    except StgaError:  # reading it will say what is wrong
        return True


def read_image(view: View, background: tuple[int, int, int] = WHITE) -> np.ndarray:
    """The view's image (H, W, 3) uint8 sRGB; transparent pixels are laid over `background` (0 to
    255).

    Gray, palette and 16-bit images are converted, and so are color profiles, PNG's gAMA and cICP;
    EXIF's orientation is applied unless the camera has the size of the pixels as stored. Raises
    StgaError naming the file where it is missing, truncated or not as large as the camera's.
    """
    return _over(_undistorted(view, _decode(view.image, view, "image")), background)


def read_mask(view: View) -> np.ndarray | None:
    """The view's foreground mask (H, W) uint8, 255 inside, also where its file holds only 0 and
    another number; an image's transparency where it has no mask file. None where there is neither.
    Raises StgaError as `read_image` does."""
    if view.mask is None:
        return _transparency(_undistorted(view, _decode(view.image, view, "image")))
    mask = stored_mask(view)
    mask = np.where(mask > 0, np.uint8(255), np.uint8(0)) if is_labeled(mask) else mask
    return _undistorted(view, 255 - mask if view.is_mask_inverted else mask)


def stored_mask(view: View) -> np.ndarray:
    """The view's mask file (H, W) uint8, as it is stored. Raises StgaError as `read_image` does."""
    assert view.mask is not None
    pixels = _decode(view.mask, view, "mask")
    # A mask drawn in color is gray in all channels; one drawn in transparency only is its alpha.
    alpha = _transparency(pixels)
    return pixels if pixels.ndim == 2 else pixels[..., 0] if alpha is None else alpha


def is_labeled(mask: np.ndarray) -> bool:
    """Whether a stored mask holds 0 and one other number that is not 255, or 1 alone, as
    segmentation networks write it for a head. A matte has numbers between."""
    level = mask.max(initial=0)
    is_background = mask == 0
    is_two = 0 < level < 255 and (is_background | (mask == level)).all()
    return bool(is_two and (level == 1 or is_background.any()))


def is_inverted(mask: np.ndarray) -> bool:
    """Whether a stored mask (H, W) is inverted: bright along the top and the upper half of the
    sides, and dark at the median row and column of its dark pixels."""
    bright = mask > mask.max(initial=0) // 2
    rows, columns = np.nonzero(~bright)
    if len(rows) < MIN_DARK_FRACTION * bright.size:
        return False
    middle = bright[int(np.median(rows)), int(np.median(columns))]
    return bool(upper_border(bright).mean() >= MIN_BRIGHT_BORDER and not middle)


def upper_border(mask: np.ndarray) -> np.ndarray:
    """The values of a mask (H, W) along the top and the upper half of the sides."""
    upper = mask[: max(1, len(mask) // 2)]
    return np.concatenate([upper[0], upper[:, 0], upper[:, -1]])


def read_view(
    view: View, scale: float = 1.0, background: tuple[int, int, int] = WHITE
) -> tuple[View, np.ndarray, np.ndarray | None]:
    """Image and mask at `scale` in (0, 1]: the view with its camera scaled alike, image and mask as
    above, the image without the light of a green screen. Every small pixel is the mean over the
    area it covers, to avoid aliasing. Raises StgaError as `read_image` does."""
    if not 0 < scale <= 1:
        raise ValueError(f"scale {scale} is not in (0, 1]")
    pixels = _undistorted(view, _decode(view.image, view, "image"))
    mask = _transparency(pixels) if view.mask is None else read_mask(view)
    small = view if scale == 1 else replace(view, camera=view.camera.scaled(scale))
    size = small.camera.height, small.camera.width
    image = area_mean(_over(pixels, background), *size)
    if mask is None:
        return small, image, None
    mask = area_mean(mask, *size)
    return small, without_spill(image, mask), mask


def _undistorted(view: View, pixels: np.ndarray) -> np.ndarray:
    return pixels if view.undistortion is None else view.undistortion(pixels)


def area_mean(pixels: np.ndarray, height: int, width: int) -> np.ndarray:
    """Shrink (H, W) or (H, W, C) uint8 to height x width: mean over each new pixel's area,
    rounded."""
    if pixels.shape[:2] == (height, width):
        return pixels
    import cv2

    return cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)


def _decode(path: Path, view: View, kind: str) -> np.ndarray:
    """Pixels (H, W) gray or (H, W, 2 to 4) uint8, the last of an even number of channels alpha."""
    expected = view.camera.width, view.camera.height
    with _opened(path) as image:
        stored = image.size
        size = _displayed_size(image)
        # before any pixel is unpacked
        if expected in (stored, size) and is_image_size(*expected):
            convert = _conversion(image) if kind == "image" else None
            turn = size == expected and _orientation(image) != 1 and not view.is_as_stored
            turned = ImageOps.exif_transpose(image) if turn else image
            if kind == "mask" and turned.mode.startswith("I"):
                numbers = np.asarray(turned)
                if 0 <= numbers.min() <= numbers.max() <= 255:  # those of 8 bits, in 16
                    return numbers.astype(np.uint8)
            return _as_uint8(turned if convert is None else convert(turned))
    if size == expected:
        raise StgaError(
            f"{path}: has {size[0]} x {size[1]} pixels, more than are read ({MAX_IMAGE_PIXELS})"
        )
    camera = f"the camera of {view.name} has {expected[0]} x {expected[1]}"
    if kind == "mask":
        camera = f"the image {view.image} and its camera have {expected[0]} x {expected[1]}"
    raise StgaError(f"{path}: the {kind} has {size[0]} x {size[1]} pixels, but {camera}")


def _displayed_size(image: Image.Image) -> tuple[int, int]:
    width, height = image.size
    return (height, width) if _orientation(image) >= 5 else (width, height)


def _orientation(image: Image.Image) -> int:
    """EXIF's, 1 where there is none, as in TIFF, which Pillow turns, and behind a PNG's pixels."""
    if image.format == "TIFF" or "exif" not in image.info:
        return 1
    try:
        found = image.getexif().get(ORIENTATION_TAG, 1)
    except Exception:  # damaged metadata does not concern the pixels
        return 1
    return found if isinstance(found, int) and 1 <= found <= 8 else 1


def _conversion(image: Image.Image) -> Callable[[Image.Image], Image.Image] | None:
    """How the image's colors become sRGB, None where they are: by cICP, profile, or gAMA."""
    if image.mode not in ("RGB", "RGBA", "CMYK"):
        return None
    codes = image.info.get(CICP)
    if codes is not None:
        convert = partial(_by_pixels, lambda pixels: to_srgb(pixels, *codes))
        return None if is_srgb(*codes) else convert
    if image.info.get("icc_profile"):
        return _by_profile(image.info["icc_profile"])
    gamma = image.info.get("gamma")
    if image.format != "PNG" or "srgb" in image.info or not isinstance(gamma, float):
        return None
    if not gamma > 0 or abs(gamma - SRGB_GAMMA) <= GAMMA_TOLERANCE:
        return None
    return partial(_by_pixels, lambda pixels: with_gamma(pixels, gamma))


def _by_pixels(convert: Callable[[np.ndarray], np.ndarray], image: Image.Image) -> Image.Image:
    """The image with its colors (H, W, 3) converted; alpha stays."""
    pixels = np.asarray(image)
    return Image.fromarray(np.concatenate([convert(pixels[..., :3]), pixels[..., 3:]], axis=2))


def _by_profile(data: bytes) -> Callable[[Image.Image], Image.Image] | None:
    """Conversion from an ICC profile; None where it is sRGB's, or damaged."""
    try:
        profile = ImageCms.getOpenProfile(io.BytesIO(data))
        if "sRGB" in ImageCms.getProfileDescription(profile):
            return None
    except (ImageCms.PyCMSError, OSError, TypeError, ValueError):
        return None

    def convert(image: Image.Image) -> Image.Image:
        mode = "RGB" if image.mode == "CMYK" else image.mode
        try:
            srgb = ImageCms.createProfile("sRGB")
            converted = ImageCms.profileToProfile(image, profile, srgb, outputMode=mode)
        except ImageCms.PyCMSError:  # a profile of another kind of image
            return image
        return image if converted is None else converted

    return convert


def _cicp(stream: IO[bytes]) -> tuple[int, int] | None:
    """Codes of primaries and transfer in a PNG's cICP chunk, before the pixels; None without, and
    in files of other formats."""
    if stream.read(8) != PNG_SIGNATURE:
        return None
    while len(head := stream.read(8)) == 8:
        length = int.from_bytes(head[:4], "big")
        name = head[4:]
        if name in (b"IDAT", b"IEND"):
            return None
        if name == b"cICP":
            codes = stream.read(4)
            return (codes[0], codes[1]) if len(codes) == 4 else None
        stream.seek(length + 4, 1)
    return None


def _as_uint8(image: Image.Image) -> np.ndarray:
    if image.mode.startswith("I"):  # 16-bit gray; Pillow would clip it at 255
        wide = np.asarray(image)
        if wide.min(initial=0) < 0 or wide.max(initial=0) > 65535:
            raise ValueError("has more than 16 bits a pixel")

        def narrow(band: np.ndarray) -> np.ndarray:
            return (band.astype(np.int64)[..., None] * 255 + 32767) // 65535

        return in_bands(wide, 1, narrow)[..., 0]
    if image.mode == "F":
        raise ValueError("holds floating-point pixels")
    if image.mode in ("L", "LA", "RGB", "RGBA"):
        # A gray or color PNG may still name one value as transparent.
        named = {"L": "LA", "RGB": "RGBA"}.get(image.mode) if "transparency" in image.info else None
        return np.asarray(image.convert(named) if named else image)
    if image.mode == "1":
        return np.asarray(image.convert("L"))
    transparent = image.mode in ("PA", "La", "RGBa")
    transparent |= image.mode == "P" and "transparency" in image.info
    return np.asarray(image.convert("RGBA" if transparent else "RGB"))


def _over(pixels: np.ndarray, background: tuple[int, int, int]) -> np.ndarray:
    if pixels.ndim == 2:
        return np.repeat(pixels[..., None], 3, axis=2)
    if pixels.shape[2] == 3:
        return pixels

    def blend(band: np.ndarray) -> np.ndarray:
        alpha = band[..., -1:].astype(np.uint32)
        behind = np.array(background, np.uint32)
        return (band[..., :-1] * alpha + behind * (255 - alpha) + 127) // 255

    return in_bands(pixels, 3, blend)


def _transparency(pixels: np.ndarray) -> np.ndarray | None:
    if pixels.ndim == 2 or pixels.shape[2] == 3 or (pixels[..., -1] == 255).all():
        return None
    return pixels[..., -1]
