"""Writing of an avatar as an animated OpenUSD particle field of Gaussian splats."""

import errno
import os
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from ..avatar.splats import Splats
from ..errors import StgaError
from ..files import replacing

PRIM_TYPE = "ParticleField3DGaussianSplat"
COEFFICIENTS = "radiance:sphericalHarmonicsCoefficients"

EXTENT_DEVIATIONS = 3.0
"""Standard deviations that count as a splat's extent, as for USD's Gaussian kernel."""


def write_usd(
    path: Path, frames: Iterable[tuple[int, Splats]], fps: float, moving_color: bool = False
) -> None:
    """Write numbered world-space splats as the time samples of one prim, atomically.

    path          .usdc, or .usdz, a package of the same
    frames        at least one pair of a time code and splats, time codes ascending
    fps           time codes per second
    moving_color  whether the spherical harmonics differ between frames: written for each of them,
                  in half precision
    Meters, y up; rotations unit quaternions, standard deviations linear, opacity 0 to 1. What stays
    the same is written once; splats may come and go. A frame is in the file before the next is
    taken, so memory does not grow with their number. Raises StgaError where USD is not installed,
    or a file cannot be written.
    """
    try:
        import pxr as usd
        import pxr.Sdf
        import pxr.Tf
        import pxr.Usd
        import pxr.UsdGeom
        import pxr.Vt
    except ImportError as error:
        raise StgaError(
            f"{path}: USD files need the package usd-core, which this Python lacks"
        ) from error
    is_package = path.suffix.lower() == ".usdz"
    with replacing(path) as partial:
        layer = partial.with_name(f".layer{partial.name}") if is_package else partial
        try:
            _write_layer(usd, layer, frames, fps, moving_color)
            if is_package:
                # there before USD 26
                writer = getattr(usd.Sdf, "ZipFileWriter", None) or usd.Usd.ZipFileWriter
                with writer.CreateNew(str(partial)) as archive:
                    archive.AddFile(str(layer), f"{path.stem}.usdc")
                if not zipfile.is_zipfile(partial):  # no error is reported on a full disk
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        except usd.Tf.ErrorException as error:
            # "Error occurred writing file: No space left on device"
            raise OSError(error.args[0].commentary.rpartition(": ")[2]) from error
        finally:
            if is_package:
                layer.unlink(missing_ok=True)


def usd_bytes(splats: Splats, frames: int, moving_color: bool) -> int:
    """Size of the binary file: poses, and moving colors, per frame, the rest once."""
    coefficients = 3 * splats.sh.shape[1]
    once, each = (4, 40 + 2 * coefficients) if moving_color else (4 + 4 * coefficients, 40)
    return len(splats) * (once + each * frames)


def _write_layer(
    usd: Any, file: Path, frames: Iterable[tuple[int, Splats]], fps: float, moving_color: bool
) -> None:
    layer = usd.Sdf.Layer.New(usd.Sdf.FileFormat.FindById("usdc"), str(file))
    stage = usd.Usd.Stage.Open(layer)
    usd.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    usd.UsdGeom.SetStageUpAxis(stage, usd.UsdGeom.Tokens.y)
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    types = usd.Sdf.ValueTypeNames
    vt = usd.Vt
    samples = None
    for number, world in frames:
        if samples is None:
            samples = _Samples(_define(usd, stage, world))
            stage.SetStartTimeCode(number)
        samples.begin_frame(number)
        scales = world.scales()
        reach = EXTENT_DEVIATIONS * scales.max(axis=1, keepdims=True)
        extent = np.stack([(world.xyz - reach).min(axis=0), (world.xyz + reach).max(axis=0)])
        xyzw = _rows(world.unit_rotations()[:, [1, 2, 3, 0]])  # as FromNumpy takes them
        vectors = vt.Vec3fArray
        samples.put("extent", types.Float3Array, vectors, extent)
        samples.put("positions", types.Point3fArray, vectors, _rows(world.xyz))
        samples.put("scales", types.Float3Array, vectors, _rows(scales))
        samples.put("orientations", types.QuatfArray, vt.QuatfArray, xyzw)
        samples.put("opacities", types.FloatArray, vt.FloatArray, world.opacities(), True)
        sh = _rows(world.sh)
        if moving_color:
            half = sh.astype(np.float16)
            samples.put(f"{COEFFICIENTS}h", types.Half3Array, vt.Vec3hArray, half)
        else:
            samples.put(COEFFICIENTS, types.Float3Array, vectors, sh, True)
        stage.SetEndTimeCode(number)
        layer.Save()


class _Samples:
    """Attributes of a prim over time, with a time sample where they change. One at the frame before
    keeps what was there from being interpolated."""

    def __init__(self, prim: Any) -> None:
        self._prim = prim
        self._values: dict[str, tuple[np.ndarray, int | None]] = {}
        self._before: int | None = None
        self._number: int | None = None

    def begin_frame(self, number: int) -> None:
        self._before = self._number
        self._number = number

    def put(
        self, name: str, kind: Any, array: Any, values: np.ndarray, is_default: bool = False
    ) -> None:
        """The values of this frame. array: USD's kind of it; is_default: the first ones are the
        default, which holds at all times."""
        before, sampled = self._values.get(name, (None, None))
        if before is not None and np.array_equal(before, values):
            return
        attribute = self._prim.CreateAttribute(name, kind, False)
        if before is not None and sampled != self._before:
            attribute.Set(array.FromNumpy(before), self._before)
        if before is None and is_default:
            attribute.Set(array.FromNumpy(values))
            self._values[name] = values, None
        else:
            attribute.Set(array.FromNumpy(values), self._number)
            self._values[name] = values, self._number


def _define(usd: Any, stage: Any, first: Splats) -> Any:
    """The prim with what never changes. By names, not by USD's class of it, which older versions
    lack."""
    types = usd.Sdf.ValueTypeNames
    uniform = usd.Sdf.VariabilityUniform
    root = stage.DefinePrim("/Avatar", "Xform")
    stage.SetDefaultPrim(root)
    prim = stage.DefinePrim("/Avatar/Splats", PRIM_TYPE)
    for name, kind, value in (
        ("projectionModeHint", types.Token, "perspective"),
        ("sortingModeHint", types.Token, "zDepth"),
        ("radiance:sphericalHarmonicsDegree", types.Int, first.sh_degree),
    ):
        prim.CreateAttribute(name, kind, False, uniform).Set(value)
    return prim


def _rows(array: np.ndarray) -> np.ndarray:
    """As (..., last axis) contiguous rows, as USD's arrays are."""
    return np.ascontiguousarray(array.reshape(-1, array.shape[-1]))
