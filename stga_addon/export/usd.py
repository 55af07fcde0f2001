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
    Meters, y up; rotations unit quaternions, standard deviations linear, opacity 0 to 1. Splats and
    opacities stay the same. A frame is in the file before the next is taken, so memory does not
    grow with their number. Raises StgaError where USD is not installed, or a file cannot be
    written.
    """
    try:
        import pxr as usd
        import pxr.Sdf
        import pxr.Tf
        import pxr.Usd
        import pxr.UsdGeom
        import pxr.Vt
    except ImportError as error:
        problem = "USD files need the package usd-core, which this Python lacks"
        raise StgaError(f"{path}: {problem}") from error
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
    prim = None
    for number, world in frames:
        if prim is None:
            prim = _define(usd, stage, world, moving_color)
            stage.SetStartTimeCode(number)
        scales = world.scales()
        reach = EXTENT_DEVIATIONS * scales.max(axis=1, keepdims=True)
        extent = np.stack([(world.xyz - reach).min(axis=0), (world.xyz + reach).max(axis=0)])
        xyzw = _rows(world.unit_rotations()[:, [1, 2, 3, 0]])  # as FromNumpy takes them
        values = [
            ("extent", types.Float3Array, vt.Vec3fArray.FromNumpy(extent)),
            ("positions", types.Point3fArray, vt.Vec3fArray.FromNumpy(_rows(world.xyz))),
            ("scales", types.Float3Array, vt.Vec3fArray.FromNumpy(_rows(scales))),
            ("orientations", types.QuatfArray, vt.QuatfArray.FromNumpy(xyzw)),
        ]
        if moving_color:
            half = vt.Vec3hArray.FromNumpy(_rows(world.sh).astype(np.float16))
            values.append((f"{COEFFICIENTS}h", types.Half3Array, half))
        for name, kind, value in values:
            prim.CreateAttribute(name, kind, False).Set(value, number)
        stage.SetEndTimeCode(number)
        layer.Save()


def _define(usd: Any, stage: Any, first: Splats, moving_color: bool) -> Any:
    """The prim with what does not change. By names, not by USD's class of it, which older versions
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
    opacities = usd.Vt.FloatArray.FromNumpy(first.opacities())
    prim.CreateAttribute("opacities", types.FloatArray, False).Set(opacities)
    if not moving_color:
        coefficients = usd.Vt.Vec3fArray.FromNumpy(_rows(first.sh))
        prim.CreateAttribute(COEFFICIENTS, types.Float3Array, False).Set(coefficients)
    return prim


def _rows(array: np.ndarray) -> np.ndarray:
    """As (..., last axis) contiguous rows, as USD's arrays are."""
    return np.ascontiguousarray(array.reshape(-1, array.shape[-1]))
