"""Light from a file: an environment (.hdr) as harmonics and suns, or lights as text (.toml)."""

import re
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..capture.camera import MAX_IMAGE_PIXELS, UP, is_image_size, turn_about
from ..errors import StgaError
from ..files import read_bytes, read_toml
from ..schema import from_json, setting
from .harmonics import basis, rotated, uniform
from .values import KINDS, SHAPES, SKIN_ROUGHNESS, Light, Lighting

MIN_ROWS = 128
"""Rows to which a larger environment is shrunk."""
MAX_SUNS = 4
"""Suns that are taken out of an environment."""
SUN_CONTRAST = 12.0
"""Brightness, relative to the environment's mean, above which a pixel belongs to a sun."""
SUN_RADIUS = np.radians(12)
"""Angle from the brightest pixel within which bright ones are the same sun."""
HDR_SIZE = re.compile(rb"\n([-+][XY]) +(\d{1,9}) +([-+][XY]) +(\d{1,9})\s")
"""Line of a .hdr picture that says its size and in which order its pixels follow."""
TOP_LEFT_FIRST = (b"-Y", b"+X")
"""The order of pixels that is read: rows from the top, each from the left."""
MAX_RUN_PIXELS = 3
"""Largest number of pixels that together say the length of a run."""
MAX_HDR_HEADER_BYTES = 1 << 16
"""Bytes in which it is searched."""
UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""Rotation from Blender's axes (z up) to those of a capture that is shown upright (y up, face along
z)."""


def read_hdr(path: Path) -> np.ndarray:
    """(H, W, 3) float32 radiance of a .hdr picture, from the top. Raises StgaError."""
    import cv2  # Blender, which reads the pictures of its worlds itself, may have none

    data = read_bytes(path)
    line = HDR_SIZE.search(data[:MAX_HDR_HEADER_BYTES]) if data.startswith(b"#?") else None
    if line is not None:
        size = int(line[2]), int(line[4])
        if not is_image_size(*size):
            raise StgaError(
                f"{path}: claims {size[0]} x {size[1]} pixels; at most {MAX_IMAGE_PIXELS} are "
                "read; scale it down"
            )
        if (line[1], line[3]) != TOP_LEFT_FIRST:
            order = f"{line[1].decode()} {line[3].decode()}"
            problem = f"its pixels follow in the order {order}, expected -Y +X"
            raise StgaError(f"{path}: {problem}; save it again with another program")
        data = data[: line.end()] + _without_old_runs(data[line.end() :], size[0] * size[1])
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH
    try:
        found = None if line is None else cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except (cv2.error, MemoryError):  # empty, or claims too many pixels
        found = None
    if found is None or found.dtype != np.float32:
        raise StgaError(f"{path}: is not a Radiance picture (.hdr), or its pixels are damaged")
    return np.asarray(cv2.cvtColor(found, cv2.COLOR_BGR2RGB, found))


def _without_old_runs(body: bytes, count: int) -> bytes:
    """The pixels of a .hdr picture, in which those that repeat the one before, (1, 1, 1, number),
    are written out, because OpenCV takes them for colors. Other pixels have a larger mantissa;
    scanlines of the newer run-length encoding stay as they are. count: pixels of the picture."""
    if body[:2] == b"\2\2" and body[2:3] < b"\x80":
        return body
    pixels = np.frombuffer(body, np.uint8, len(body) // 4 * 4).reshape(-1, 4)[:count]
    is_run = (pixels[:, :3] == 1).all(axis=1)
    if not is_run.any():
        return body
    rows = np.arange(len(pixels), dtype=np.int32)
    before = np.maximum.accumulate(np.where(is_run, 0, rows))
    place = rows - before - 1  # in a number of several pixels, the lowest first
    lengths = pixels[:, 3].astype(np.int32) << 8 * np.clip(place, 0, MAX_RUN_PIXELS - 1)
    repeats = np.where(is_run, np.minimum(lengths, count), 1)
    used = 1 + np.searchsorted(np.cumsum(repeats, dtype=np.int64), count)
    if is_run[0] or place.max() >= MAX_RUN_PIXELS or used > len(pixels):
        return b""
    return np.repeat(pixels[before[:used]], repeats[:used], axis=0)[:count].tobytes()


def pixel_directions(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors (H, W, 3) of an equirectangular image's pixels, as Blender's (z up, middle +x,
    left quarter +y), and their solid angles (H, 1)."""
    polar = np.pi * (np.arange(height) + 0.5) / height
    turn = 2 * np.pi * (0.5 - (np.arange(width) + 0.5) / width)
    ring = np.sin(polar)[:, None]
    height_of = np.broadcast_to(np.cos(polar)[:, None], (height, width))
    vectors = np.stack([ring * np.cos(turn), ring * np.sin(turn), height_of], axis=-1)
    edges = np.cos(np.pi * np.arange(height + 1) / height)
    return vectors, ((edges[:-1] - edges[1:]) * 2 * np.pi / width)[:, None]


def split_environment(
    image: np.ndarray, rotation: np.ndarray = UPRIGHT, max_suns: int = MAX_SUNS
) -> tuple[np.ndarray, tuple[Light, ...]]:
    """Harmonics (9, 3) of an environment, image (H, W, 3) linear radiance as of `pixel_directions`,
    and its brightest parts as at most `max_suns` suns, which throw shadows; harmonics hold the
    rest. rotation (3, 3): from Blender's axes to those of the result."""
    step = max(1, len(image) // MIN_ROWS)
    image = np.asarray(image, np.float64) if step == 1 else _coarser(image, step)
    vectors, angle = pixel_directions(*image.shape[:2])
    vectors = vectors @ rotation.T
    rest = image.copy()
    level = image.sum(2)
    limit = SUN_CONTRAST * (level * angle).sum() / (angle.sum() * image.shape[1])
    suns: list[Light] = []
    while len(suns) < max_suns and level.max() > limit:
        brightest = vectors.reshape(-1, 3)[level.argmax()]
        near = (vectors @ brightest > np.cos(SUN_RADIUS)) & (level > limit)
        arriving = np.where(near[..., None], rest, 0) * angle[..., None]
        power = arriving.sum((0, 1))
        toward = (arriving.sum(2)[..., None] * vectors).sum((0, 1))
        opening = 2 * np.arccos(1 - (near * angle).sum() / (2 * np.pi))
        suns.append(Light("sun", power, direction=-toward, angle=float(opening)))
        rest[near] = 0
        level = np.where(near, 0, level)
    values = (rest * angle[..., None]).reshape(-1, 3)
    return basis(vectors.reshape(-1, 3)).T @ values, tuple(suns)


def _coarser(image: np.ndarray, step: int) -> np.ndarray:
    """Means (H', W', 3), float64, over squares of about `step` pixels. Where step does not divide
    height or width, pixels on the edge of two squares are shared, so that none is lost."""
    rows, columns = (_fraction_of_pixels(size, size // step) for size in image.shape[:2])
    wide = rows @ image.reshape(len(image), -1)
    return np.einsum("cw,rwk->rck", columns, wide.reshape(len(rows), -1, 3), dtype=np.float64)


def _fraction_of_pixels(size: int, count: int) -> np.ndarray:
    """(count, size) float32: weights of pixels in means over `count` equal parts of them."""
    edges = np.linspace(0, size, count + 1)[:, None]
    place = np.arange(size)
    covered = np.minimum(edges[1:], place + 1) - np.maximum(edges[:-1], place)
    return np.asarray(np.maximum(covered, 0) * count / size, np.float32)


MAX_LIGHTS = 64
MAX_NUMBER = 1e6


@dataclass(frozen=True)
class LightEntry:
    """A table [[lights]] of `values.Light`; `strength` is Blender's: W/m² of a sun, else W."""

    kind: str = setting(choices=KINDS)
    strength: float = setting(minimum=0, maximum=MAX_NUMBER)
    color: tuple[float, float, float] = setting((1.0, 1.0, 1.0), 0, MAX_NUMBER)
    position: tuple[float, float, float] = setting((0.0, 0.0, 0.0), -MAX_NUMBER, MAX_NUMBER)
    direction: tuple[float, float, float] = setting((0.0, 0.0, -1.0), -MAX_NUMBER, MAX_NUMBER)
    radius: float = setting(0.0, 0, MAX_NUMBER)
    angle: float = setting(0.00918, 0, 3.2)
    size: tuple[float, float] = setting((0.5, 0.5), 0, MAX_NUMBER)
    tangent: tuple[float, float, float] = setting((1.0, 0.0, 0.0), -MAX_NUMBER, MAX_NUMBER)
    shape: str = setting("rectangle", choices=SHAPES)
    cone: float = setting(0.785, 0, 3.15)
    blend: float = setting(0.15, 0, 1)
    casts_shadow: bool = True
    diffuse: float = setting(1.0, 0, MAX_NUMBER)
    specular: float = setting(1.0, 0, MAX_NUMBER)


@dataclass(frozen=True)
class LightFile:
    """Lights in meters and axes of the capture (`values.Lighting`). world: radiance everywhere."""

    world: tuple[float, float, float] = setting((0.0, 0.0, 0.0), 0, MAX_NUMBER)
    lights: tuple[LightEntry, ...] = ()
    exposure: float = setting(0.0, -30, 30)
    white: tuple[float, float, float] = setting((1.0, 1.0, 1.0), above=0)
    roughness: float = setting(SKIN_ROUGHNESS, 0.05, 1)
    specular: float = setting(1.0, 0, 100)
    shadows: bool = True

    def check(self) -> None:
        """Raise StgaError for more lights than are drawn."""
        if len(self.lights) > MAX_LIGHTS:
            raise StgaError(f"lights: expected up to {MAX_LIGHTS}, got {len(self.lights)}")


def read_lighting(path: Path) -> Lighting:
    """The lighting of an .hdr environment, as Blender shows it around the head, or a .toml
    `LightFile`."""
    suffix = path.suffix.lower()
    if suffix == ".hdr":
        world, suns = split_environment(read_hdr(path))
        return Lighting(world, suns)
    if suffix != ".toml":
        raise StgaError(
            f"{path}: expected light as an environment (.hdr) or a list of lights (.toml)"
        )
    values = read_toml(path)
    entries = values.get("lights", [])
    if isinstance(entries, list):
        values["lights"] = [_completed(LightEntry, entry) for entry in entries]
    found: LightFile = from_json(LightFile, _completed(LightFile, values), path)
    lights = []
    for entry in found.lights:
        light = {**vars(entry), "color": entry.strength * np.array(entry.color)}
        del light["strength"]
        lights.append(Light(**light))
    return Lighting(**{**vars(found), "world": uniform(found.world), "lights": tuple(lights)})


def _completed(kind: type, values: Any) -> Any:
    """The values of a table with the defaults of those that it leaves out."""
    if not isinstance(values, dict):
        return values
    defaults = {spec.name: spec.default for spec in fields(kind) if spec.default is not MISSING}
    plain = {name: list(v) if isinstance(v, tuple) else v for name, v in defaults.items()}
    return {**plain, **values}


def turned(lighting: Lighting, center: np.ndarray, degrees: float) -> Lighting:
    """The lighting turned about the upward axis (+y) through center (3,)."""
    matrix = turn_about(UP, center, np.radians(degrees))
    lights = tuple(light.transformed(matrix) for light in lighting.lights)
    return replace(lighting, world=rotated(lighting.world, matrix[:3, :3]), lights=lights)
