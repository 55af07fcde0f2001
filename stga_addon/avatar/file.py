"""Reading and writing avatar files: one npz with all that is needed to pose and render an
avatar."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary

import numpy as np

from ..capture.transforms import DEFAULT_PRINCIPAL_POINT, PRINCIPAL_POINTS
from ..errors import StgaError, shorten
from ..files import check_version, converted, open_npz, parse_json, write_npz
from .embedding import CONVENTIONS, FaceFrames, face_areas, face_frames
from .offsets import (
    COLOR,
    OFFSETS,
    POSITION,
    SCALE,
    SIGNALS,
    limited_enlargement,
    moved_frames,
    offset_of,
)
from .splats import ARRAYS, SH_C0, Splats, sh_color
from .strain import STRAIN_COMPONENTS, TRAINED_RANGE, StrainBasis, at_rest, strain_basis

FORMAT = "stga-avatar"
"""`format` in the header, which tells an avatar from other .npz files."""
VERSION = 3
"""`version` in the header: the only one that is read and written."""
MAX_HEADER_BYTES = 16 << 20
"""Largest header that is parsed."""

_HEADER = {
    "convention": str,
    "background": list,
    "antialiased": bool,
    "principal_point": str,
    "regions": list,
    "settings": dict,
}
"""Field of the avatar -> what JSON holds of it; of the regions their names."""

SOURCES = "estimated", "gray_card", "file"
"""Origins of an avatar's light."""
_LIGHT_ARRAYS = {
    "radiance": (9, 3),
    "transfer": (-1, 9),
    "occlusion": (-1,),
    "irradiance": (-1, 3),
    "roughness": (-1,),
}
"""Array of a light -> its shape, -1: vertices."""
_PREFIX = "light_"
"""Prefix of the names that the arrays of a light have in the file."""
_OPTIONAL_ARRAYS = "strain_range", "linear_base", "filmed_along"
"""Arrays that are stored only where the avatar has them."""

MIN_COLOR_CHANGE = 1 / 255
"""Offsets of colors that never change them by as much are not stored."""
MIN_SHIFT_M = 2e-4
"""The same for positions."""
MIN_SCALE_CHANGE = 0.02
"""The same for scales, relative."""


UNSEEN_REGION = "unseen"
"""Region of the outside's triangles that no training view looked at: they are plausible only."""


@dataclass(frozen=True)
class AvatarLight:
    """Estimated once per run (`light.estimate`), by vertex of the neutral mesh.

    radiance    (9, 3) float32: light of the capture, spherical harmonics of linear radiance
                (`light.harmonics.basis`) in the axes of the capture
    transfer    (V, 9) float32: irradiance is transfer @ radiance; with the head's own shadow
                (`light.surface`)
    occlusion   (V,) float32, 0…1: cosine-weighted fraction of the sky that the head leaves open
    irradiance  (V, 3) float32: of the capture, with light that the head reflects onto itself, mean
                over its timesteps; an albedo is π times linear color over this
    roughness   (V,) float32: of highlights; 1: hair; 0: skin, whose roughness the lighting has
    residual    how far recorded colors are from what `radiance` explains, as a fraction of them
                (robust deviation)
    damping     0…1 by which albedo is pulled to its mean, because the light is too hard to take
                away
    source      one of SOURCES: where the light, or its level, is from
    """

    radiance: np.ndarray
    transfer: np.ndarray
    occlusion: np.ndarray
    irradiance: np.ndarray
    roughness: np.ndarray
    residual: float
    damping: float = 0.0
    source: str = SOURCES[0]


@dataclass(frozen=True)
class Avatar:
    """A trained head.

    splats      in the local frames of `faces`
    convention  of those frames: "stga" or "gaussian_avatars"
    neutral     (V, 3) float32 meters, the canonical mesh
    faces       (F, 3) int32
    settings    how it was trained; anything that JSON holds
    regions     name -> (F,) bool
    background  red, green, blue in 0 to 1 that it was trained against
    antialiased  whether it was trained with opacity compensation (`render_forward`), and is
                 rendered so
    principal_point  convention of the capture that it was trained on (`read_transforms`)
    strain_range  (F, 2, 6) float32 lowest and highest deformation of each triangle that colors and
                  positions follow (`avatar.strain`); None: the same for all
    driven_offsets  name -> (F, 3, 3) float32 of `offsets.OFFSETS`: change of a triangle's splats by
                    each of three components of a signal
    light       what relighting needs, None where it was not estimated
    filmed_along  (F, 3) float32: unit direction in which the only camera sees each triangle, world
                  axes; what harmonics add off-axis is plausible only (`colored_off_axis`). None: of
                  several cameras, or of trained harmonics
    linear_base  (N, 4) float32: constant coefficients and logit of each splat with which renderers
                 that blend in linear light come nearest to it (`render.linear_fit`); None: those
                 of `splats`
    """

    splats: Splats
    convention: str
    neutral: np.ndarray
    faces: np.ndarray
    settings: Mapping[str, Any] = field(default_factory=dict)
    regions: Mapping[str, np.ndarray] = field(default_factory=dict)
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    antialiased: bool = False
    principal_point: str = DEFAULT_PRINCIPAL_POINT
    strain_range: np.ndarray | None = None
    driven_offsets: Mapping[str, np.ndarray] = field(default_factory=dict)
    light: AvatarLight | None = None
    filmed_along: np.ndarray | None = None
    linear_base: np.ndarray | None = None

    @property
    def as_trained(self) -> "Avatar":
        """With the colors that the camera saw in all directions."""
        if self.filmed_along is None:
            return self
        color = sh_color(self.splats.sh, self.filmed_along[self.splats.face])
        sh = ((color - 0.5) / SH_C0)[:, None].astype(np.float32)
        splats = replace(self.splats, sh=sh)
        return replace(self, splats=splats, filmed_along=None, linear_base=None)

    @property
    def for_linear_light(self) -> "Avatar":
        """With the splats for renderers that blend in linear light."""
        if self.linear_base is None:
            return self
        sh = self.splats.sh.copy()
        sh[:, 0] = self.linear_base[:, :3]
        splats = replace(self.splats, sh=sh, opacity=self.linear_base[:, 3].copy())
        return replace(self, splats=splats, linear_base=None)

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """Those of a file, by name, but for regions and light."""
        optional = {name: getattr(self, name) for name in _OPTIONAL_ARRAYS}
        given = {name: array for name, array in optional.items() if array is not None}
        splats = {name: getattr(self.splats, name) for name in ARRAYS}
        mesh = {"neutral": self.neutral, "faces": self.faces}
        return {**splats, **mesh, **given, **self.driven_offsets}

    @property
    def follows_strain(self) -> bool:
        """Whether colors or positions depend on the deformation of the mesh."""
        return bool(self.driven_offsets)

    @cached_property
    def without_light(self) -> "Avatar":
        """Without what is the capture's light in it (`DrivenOffset.of_light`)."""
        kept = {n: each for n, each in self.driven_offsets.items() if not OFFSETS[n].of_light}
        return self if len(kept) == len(self.driven_offsets) else replace(self, driven_offsets=kept)

    @property
    def with_limited_offsets(self) -> "Avatar":
        """With coefficients of 0 where they do not change a triangle's splats by MIN_COLOR_CHANGE,
        MIN_SHIFT_M or a fraction of MIN_SCALE_CHANGE anywhere in `strain_range`, and with smaller
        ones where they would blow splats up somewhere in it (`limited_enlargement`)."""
        basis = self._strain
        kept = {}
        if basis is None:
            return self
        rest = at_rest(basis.range)
        farthest = rest + np.abs(basis.range - rest[:, None]).max(1)
        plain = face_frames(self.neutral, self.faces, self.neutral, self.convention)
        frames = replace(plain, deformation=farthest)
        shift = MIN_SHIFT_M / frames.scale
        least = {COLOR: MIN_COLOR_CHANGE, SCALE: MIN_SCALE_CHANGE, POSITION: shift}
        size = np.zeros(len(self.faces))
        largest = np.exp(self.splats.log_scale.max(axis=1))
        np.maximum.at(size, self.splats.face, largest * plain.scale[self.splats.face])
        ends = [replace(plain, deformation=basis.range[:, end]) for end in (0, 1)]
        for name, coefficients in self.driven_offsets.items():
            offset = OFFSETS[name]
            if offset.target == SCALE:
                signals = np.stack([SIGNALS[offset.signal](basis, end) for end in ends])
                coefficients = limited_enlargement(coefficients, signals, size)
            signal = np.abs(SIGNALS[offset.signal](basis, frames))
            change = offset_of(np.abs(coefficients), signal).max(1)
            if not signal.any():  # it does not come from the deformation
                change[:] = np.inf
            shows = (change >= least[offset.target])[:, None, None]
            kept[name] = np.where(shows, coefficients, np.float32(0))
        return replace(self, driven_offsets=kept)

    def frames(self, mesh: np.ndarray) -> FaceFrames:
        """The triangles' local frames on a posed mesh (V, 3), moved and colored by the driven
        offsets."""
        basis = self._strain
        offsets = self.driven_offsets
        frames = face_frames(mesh, self.faces, self.neutral, self.convention, basis, self._areas)
        if basis is None:
            return frames
        return moved_frames(frames, offsets, lambda name: SIGNALS[name](basis, frames))

    @cached_property
    def _areas(self) -> np.ndarray:
        return face_areas(self.neutral, self.faces)

    @cached_property
    def _strain(self) -> StrainBasis | None:
        known = self.neutral, self.faces, self.strain_range
        return strain_basis(*known) if self.follows_strain else None


def write_avatar(path: Path, avatar: Avatar) -> None:
    """Write an avatar file (npz without pickle), atomically.

    Raises StgaError where the avatar would not be read back: wrong shapes, NaN, splats on missing
    triangles.
    """
    check_avatar(path, avatar)
    header: dict[str, Any] = {"format": FORMAT, "version": VERSION}
    header |= {name: kind(getattr(avatar, name)) for name, kind in _HEADER.items()}
    masks = np.array(list(avatar.regions.values()), bool).reshape(-1, len(avatar.faces))
    arrays = avatar.arrays | {"region_faces": masks}
    if avatar.light is not None:
        light_arrays, header["light"] = _light_parts(avatar.light)
        arrays |= light_arrays
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    write_npz(path, arrays)


def read_avatar(path: Path) -> Avatar:
    """Read an avatar file. Raises StgaError naming the file and the field that is missing or
    malformed; names, types and shapes are looked at before anything is unpacked.

    While somebody holds the avatar of a file that has not changed since, it is that one, which
    nobody may write into.
    """
    try:
        state = path.stat()
    except (OSError, ValueError):  # which reading it names
        return _read_avatar(path)
    key = path.absolute(), state.st_ino, state.st_mtime_ns, state.st_size
    found = _HELD.get(key)
    if found is None:
        found = _HELD[key] = _read_avatar(path)
    return found


_HELD: WeakValueDictionary[tuple[Path, int, int, int], Avatar] = WeakValueDictionary()
"""Avatars that were read and are in use, by path and state of the file."""


def _read_avatar(path: Path) -> Avatar:
    needed = (*ARRAYS, "neutral", "faces", "region_faces")
    optional = (*_OPTIONAL_ARRAYS, *OFFSETS, *(_PREFIX + name for name in _LIGHT_ARRAYS))
    with open_npz(path) as file:
        outlines = file.outlines()
        if outlines.get("header", np.zeros(0)).size > MAX_HEADER_BYTES:
            raise StgaError(f"{path}: header has more than {MAX_HEADER_BYTES} bytes")
        header = _read_header(path, file.arrays(("header",)))
        missing = [name for name in needed if name not in outlines]
        if missing:
            raise StgaError(f"{path}: avatar file has no array {missing[0]!r}")
        _check_shapes(path, _avatar_of(path, header, outlines))
        if "light" in header:
            _check_light_shapes(path, outlines)
        arrays = file.arrays((*needed, *optional))
    avatar = _avatar_of(path, header, arrays)
    check_avatar(path, avatar)
    light = _light(path, arrays, header["light"]) if "light" in header else None
    return replace(avatar, light=light)


def _avatar_of(path: Path, header: dict[str, Any], arrays: Mapping[str, np.ndarray]) -> Avatar:
    """The avatar of a file's arrays, or of their outlines, without light."""
    names = header["regions"]
    masks = arrays["region_faces"]
    if masks.ndim != 2 or len(masks) != len(names):
        expected = f"expected ({len(names)}, faces)"
        raise StgaError(f"{path}: region_faces has shape {masks.shape}, {expected}")
    values = {name: header[name] for name in _HEADER}
    values["regions"] = dict(zip(names, masks, strict=True))
    values["background"] = tuple(header["background"])
    return Avatar(
        splats=Splats(**{name: arrays[name] for name in ARRAYS}),
        neutral=arrays["neutral"],
        faces=arrays["faces"],
        **values,
        strain_range=arrays.get("strain_range"),
        driven_offsets={name: arrays[name] for name in OFFSETS if name in arrays},
        linear_base=arrays.get("linear_base"),
        filmed_along=arrays.get("filmed_along"),
    )


def _read_header(path: Path, arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
    if "header" not in arrays or arrays["header"].dtype != np.uint8:
        raise StgaError(f"{path}: is not an avatar file (it has no header)")
    try:
        header = parse_json(arrays["header"].tobytes())
    except (ValueError, RecursionError) as error:
        raise StgaError(f"{path}: header is not valid JSON ({error})") from error
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise StgaError(f"{path}: is not an avatar file (header's format is not {FORMAT!r})")
    check_version(path, "avatar", header.get("version"), VERSION)
    for name, kind in _HEADER.items():
        if not isinstance(header.get(name), kind):
            raise StgaError(f"{path}: header field {name!r} is missing or not a {kind.__name__}")
    if not all(isinstance(name, str) for name in header["regions"]):
        raise StgaError(f"{path}: header field 'regions' holds something that is not a name")
    return header


def check_avatar(path: Path, avatar: Avatar) -> None:
    """Raise StgaError where the parts of an avatar do not fit each other."""
    _check_shapes(path, avatar)
    for name, array in avatar.arrays.items():
        _check_finite(path, name, array)
    _check_index(path, "faces", avatar.faces, len(avatar.neutral), "vertices")
    _check_index(path, "face", avatar.splats.face, len(avatar.faces), "faces")
    if avatar.light is not None:
        arrays, rest = _light_parts(avatar.light)
        _check_light_shapes(path, {"neutral": avatar.neutral, **arrays})
        _light(path, arrays, rest)


def _check_shapes(path: Path, avatar: Avatar) -> None:
    """Raise StgaError where types and shapes do not fit each other, or the header's fields are of
    no known kind. Looks at no array's contents."""
    for name, known in (("convention", CONVENTIONS), ("principal_point", PRINCIPAL_POINTS)):
        if getattr(avatar, name) not in known:
            found = shorten(getattr(avatar, name))
            raise StgaError(f"{path}: {name} is {found}, expected one of {', '.join(known)}")
    count = len(avatar.splats.xyz) if avatar.splats.xyz.ndim else 0
    faces = len(avatar.faces) if avatar.faces.ndim else 0
    kinds = {name: (kind.dtype, (count, *kind.shape)) for name, kind in ARRAYS.items()}
    kinds |= dict.fromkeys(OFFSETS, ("float32", (faces, STRAIN_COMPONENTS, 3)))
    kinds |= {
        "neutral": ("float32", (-1, 3)),
        "faces": ("int32", (-1, 3)),
        "strain_range": ("float32", (faces, *TRAINED_RANGE.shape)),
        "linear_base": ("float32", (count, 4)),
        "filmed_along": ("float32", (faces, 3)),
    }
    for name, array in avatar.arrays.items():
        _check_shape(path, name, array, *kinds[name])
    sizes = ARRAYS["sh"].sizes
    if avatar.splats.sh.shape[1] not in sizes:
        found = f"{avatar.splats.sh.shape[1]} coefficients"
        raise StgaError(f"{path}: sh has {found}, expected one of {sizes}")
    color = avatar.background
    for name, mask in avatar.regions.items():
        _check_shape(path, f"region {name!r}", mask, "bool", (faces,))
    if len(color) != 3 or not all(isinstance(c, (int, float)) and 0 <= c <= 1 for c in color):
        expected = "expected three numbers between 0 and 1"
        raise StgaError(f"{path}: background is {shorten(color)}, {expected}")


def check_array(
    path: Path, name: str, array: np.ndarray, dtype: str, shape: tuple[int, ...]
) -> None:
    """Raise StgaError unless dtype and shape (-1: any) are as expected and every number is
    finite."""
    _check_shape(path, name, array, dtype, shape)
    _check_finite(path, name, array)


def _check_shape(
    path: Path, name: str, array: np.ndarray, dtype: str, shape: tuple[int, ...]
) -> None:
    sizes = zip(shape, array.shape, strict=False)
    fits = array.ndim == len(shape) and all(want in (-1, have) for want, have in sizes)
    if not fits or array.dtype != dtype:
        expected = ", ".join("any" if size < 0 else str(size) for size in shape)
        found = f"{array.dtype} {array.shape}"
        raise StgaError(f"{path}: {name} is {found}, expected {dtype} ({expected})")


def _check_finite(path: Path, name: str, array: np.ndarray) -> None:
    if not np.isfinite(array).all():
        raise StgaError(f"{path}: {name} holds a value that is not finite")


def _check_index(path: Path, name: str, index: np.ndarray, count: int, of: str) -> None:
    if index.size and (index.min() < 0 or index.max() >= count):
        refers = f"{name} refers to {index.min()}…{index.max()}"
        raise StgaError(f"{path}: {refers}, but there are {count} {of}")


def _check_light_shapes(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    for name, shape in _LIGHT_ARRAYS.items():
        array = arrays.get(_PREFIX + name, np.zeros(0))
        sizes = tuple(len(arrays["neutral"]) if size < 0 else size for size in shape)
        _check_shape(path, _PREFIX + name, array, "float16", sizes)


def _light_parts(light: AvatarLight) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays of a light, in half precision (30 bytes a vertex), and what the header holds."""
    rest = dict(vars(light))
    arrays = {_PREFIX + name: converted(rest.pop(name), np.float16) for name in _LIGHT_ARRAYS}
    return arrays, rest


def _light(path: Path, arrays: Mapping[str, np.ndarray], rest: object) -> AvatarLight:
    """As the header states. Raises StgaError naming the file and what is wrong."""
    values: dict[str, Any] = {}
    for name in _LIGHT_ARRAYS:
        array = arrays[_PREFIX + name]
        _check_finite(path, _PREFIX + name, array)
        values[name] = array.astype(np.float32)
    match rest:
        case {
            "residual": int() | float() as residual,
            "damping": int() | float() as damping,
            "source": str() as source,
        } if source in SOURCES and min(residual, damping) >= 0:
            return AvatarLight(**values, residual=residual, damping=damping, source=source)
    expected = "expected residual and damping, numbers from 0 on, and source"
    raise StgaError(f"{path}: header field 'light' is {shorten(rest)}, {expected}")
