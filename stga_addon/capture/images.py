"""Images and masks of a view, decoded with Pillow and checked against the camera."""

import stat
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from ..errors import StgaError
from .camera import MAX_IMAGE_PIXELS
from .model import View

WHITE = (255, 255, 255)
# Pillow opens far more formats than images come in, some by running other programs.
FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP")


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) from the file's header. Raises StgaError where it is no image or has more than 2^27 pixels."""
    try:
        _require_regular(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path, formats=FORMATS) as image:
                width, height = image.size
    except Exception as error:  # Pillow's decoders raise more than they promise.
        raise _unreadable(path, error) from error
    if width * height > MAX_IMAGE_PIXELS:
        raise StgaError(f"{path}: claims {width} x {height} pixels, more than the {MAX_IMAGE_PIXELS} allowed")
    return width, height


def read_image(view: View, background: tuple[int, int, int] = WHITE) -> np.ndarray:
    """The view's image (H, W, 3) uint8 sRGB; transparent pixels are laid over `background` (0–255).

    Grey, palette and 16-bit images are converted. Raises StgaError naming the file where it is missing,
    truncated or not as large as the camera says.
    """
    return _over(_decode(view.image, view, "image"), background)


def read_mask(view: View) -> np.ndarray | None:
    """The view's foreground mask (H, W) uint8, 255 inside; an image's transparency where it has no mask file.

    None where there is neither. Raises StgaError as `read_image` does.
    """
    if view.mask is not None:
        return _grey(_decode(view.mask, view, "mask"))
    return _transparency(_decode(view.image, view, "image"))


def read_view(
    view: View, scale: float = 1.0, background: tuple[int, int, int] = WHITE
) -> tuple[View, np.ndarray, np.ndarray | None]:
    """Image and mask at `scale` in (0, 1]: the view with its camera scaled alike, image and mask as above.

    Every small pixel is the mean over the area it covers, so that coarse training sees no aliasing.
    Raises StgaError as `read_image` does.
    """
    if not 0 < scale <= 1:
        raise ValueError(f"scale {scale} is not in (0, 1]")
    pixels = _decode(view.image, view, "image")
    mask = _transparency(pixels) if view.mask is None else read_mask(view)
    small = view if scale == 1 else replace(view, camera=view.camera.scaled(scale))
    size = small.camera.height, small.camera.width
    return small, area_mean(_over(pixels, background), *size), None if mask is None else area_mean(mask, *size)


def area_mean(pixels: np.ndarray, height: int, width: int) -> np.ndarray:
    """Shrink (H, W) or (H, W, C) uint8 to height x width: exact mean over each new pixel's area, rounded."""
    if pixels.shape[:2] == (height, width):
        return pixels
    mean = _mean_along(_mean_along(pixels.astype(np.float64), height, 0), width, 1)
    return (mean + 0.5).astype(np.uint8)


def _mean_along(pixels: np.ndarray, size: int, axis: int) -> np.ndarray:
    """Integrate along an axis, read the integral at the new pixels' edges, and take differences."""
    lines = np.moveaxis(pixels, axis, 0)
    integral = np.concatenate([np.zeros_like(lines[:1]), np.cumsum(lines, axis=0)])
    edges = np.linspace(0, len(lines), size + 1)
    whole = np.minimum(edges.astype(int), len(lines) - 1)
    part = (edges - whole).reshape(-1, *[1] * (lines.ndim - 1))
    at_edges = integral[whole] + part * lines[whole]
    return np.moveaxis(np.diff(at_edges, axis=0) * (size / len(lines)), 0, axis)


def _decode(path: Path, view: View, kind: str) -> np.ndarray:
    """Pixels (H, W) grey or (H, W, 2 to 4) uint8, the last of an even number of channels alpha."""
    expected = view.camera.width, view.camera.height
    try:
        _require_regular(path)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path, formats=FORMATS) as image:
                # Checked before a single pixel is unpacked: a file cannot claim more memory than its camera does.
                if image.size == expected:
                    return _as_uint8(image)
                size = image.size
    except Exception as error:  # Pillow's decoders raise more than they promise.
        raise _unreadable(path, error) from error
    camera = f"the camera of {view.name} has {expected[0]} x {expected[1]}"
    if kind == "mask":
        camera = f"the image {view.image} and its camera have {expected[0]} x {expected[1]}"
    raise StgaError(f"{path}: the {kind} has {size[0]} x {size[1]} pixels, but {camera}")


def _as_uint8(image: Image.Image) -> np.ndarray:
    if image.mode.startswith("I"):  # 16-bit grey; Pillow itself would cut values off at 255.
        wide = np.asarray(image).astype(np.int64)
        if wide.min(initial=0) < 0 or wide.max(initial=0) > 65535:
            raise ValueError("has more than 16 bits a pixel")
        return ((wide * 255 + 32767) // 65535).astype(np.uint8)
    if image.mode == "F":
        raise ValueError("holds floating-point pixels")
    if image.mode in ("L", "LA", "RGB", "RGBA"):
        # A grey or colour PNG may still name one value as transparent.
        named = {"L": "LA", "RGB": "RGBA"}.get(image.mode) if "transparency" in image.info else None
        return np.asarray(image.convert(named) if named else image)
    if image.mode == "1":
        return np.asarray(image.convert("L"))
    transparent = image.mode in ("P", "PA", "La", "RGBa") and (image.mode != "P" or "transparency" in image.info)
    return np.asarray(image.convert("RGBA" if transparent else "RGB"))


def _over(pixels: np.ndarray, background: tuple[int, int, int]) -> np.ndarray:
    if pixels.ndim == 2:
        return np.repeat(pixels[..., None], 3, axis=2)
    if pixels.shape[2] == 3:
        return pixels
    alpha = pixels[..., -1:].astype(np.uint32)
    blend = pixels[..., :-1] * alpha + np.array(background, np.uint32) * (255 - alpha)
    return ((blend + 127) // 255).astype(np.uint8)


def _grey(pixels: np.ndarray) -> np.ndarray:
    """A mask drawn in colour is grey in all channels; one drawn in transparency only is its alpha."""
    if pixels.ndim == 2:
        return pixels
    alpha = _transparency(pixels)
    return pixels[..., 0] if alpha is None else alpha


def _transparency(pixels: np.ndarray) -> np.ndarray | None:
    if pixels.ndim == 2 or pixels.shape[2] == 3 or (pixels[..., -1] == 255).all():
        return None
    return pixels[..., -1]


def _require_regular(path: Path) -> None:
    """Raise OSError for a pipe or device: reading one need never end."""
    if not stat.S_ISREG(path.stat().st_mode):
        raise OSError("not a regular file")


def _unreadable(path: Path, error: Exception) -> StgaError:
    if isinstance(error, FileNotFoundError):
        return StgaError(f"{path}: does not exist; expected an image")
    return StgaError(f"{path}: is not a readable image ({error})")
