"""Writing of an avatar as an animated OpenUSD particle field of Gaussian splats, in this
interpreter or, where it lacks USD, by another."""

import errno
import os
import sys
import zipfile
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, cast

import numpy as np

from ..avatar.splats import Splats
from ..errors import StgaError
from ..files import replacing
from ..schema import check_encodable
from ..worker.helpers import claim_stdout
from ..worker.launch import start_piped
from ..worker.messages import receive, send
from ..worker.training_python import this_python
from .ply import SplatFrames

PRIM_TYPE = "ParticleField3DGaussianSplat"
"""USD's type of a prim that holds 3D Gaussians."""
COEFFICIENTS = "radiance:sphericalHarmonicsCoefficients"
"""Attribute of the spherical harmonics in float32; with an "h" behind it, in float16."""

EXTENT_DEVIATIONS = 3.0
"""Standard deviations that count as a splat's extent, as for USD's Gaussian kernel."""

HAS_USD = "has usd"
"""Key of the writing process's first message: whether its interpreter has USD."""
NUMBER = "number"
"""Key of a frame's message: its time code."""
ERROR = "error"
"""Key of the writing process's last message: why the file could not be written."""


def write_usd(
    path: Path,
    frames: SplatFrames,
    fps: float,
    moving_color: bool,
    python: str,
) -> None:
    """Write numbered world-space splats as the time samples of one prim, atomically.

    path          .usdc, or .usdz, a package of the same
    frames        at least one pair of a time code and splats, time codes ascending
    fps           time codes per second
    moving_color  whether the spherical harmonics differ between frames: written for each of them,
                  in half precision
    python        the interpreter that writes the file where this one lacks USD; "": none
    Meters, y up; rotations unit quaternions, standard deviations linear, opacity 0 to 1. What stays
    the same is written once; splats may come and go. A frame is in the file before the next is
    taken, so memory does not grow with their number. Raises StgaError where USD is not installed,
    or a file cannot be written, also one whose path is not UTF-8.
    """
    check_encodable(path)
    usd = find_usd()
    if usd is None and not python:
        raise _lacks_usd(path, f"{this_python()} lacks")
    with replacing(path) as partial:
        if usd is not None:
            _write_file(usd, partial, path, frames, fps, moving_color)
        else:
            _write_elsewhere(python, partial, path, frames, fps, moving_color)


def find_usd() -> Any:
    """The package `pxr` with the modules used here; None where USD is not installed."""
    try:
        import pxr
        import pxr.Sdf
        import pxr.Tf
        import pxr.Usd
        import pxr.UsdGeom
        import pxr.Vt
    except ImportError:
        return None
    return pxr


def _lacks_usd(path: Path, who: str) -> StgaError:
    return StgaError(
        f"{path}: USD files need the package usd-core, which {who}; install it in the Python that "
        "trains"
    )


def _write_file(
    usd: Any,
    file: Path,
    path: Path,
    frames: SplatFrames,
    fps: float,
    moving_color: bool,
) -> None:
    """Write a file that is renamed to `path` afterwards. Raises OSError."""
    is_package = path.suffix.lower() == ".usdz"
    layer = file.with_name(f".layer{file.name}") if is_package else file
    try:
        _write_layer(usd, layer, frames, fps, moving_color)
        if is_package:
            # there before USD 26
            writer = getattr(usd.Sdf, "ZipFileWriter", None) or usd.Usd.ZipFileWriter
            with writer.CreateNew(str(file)) as archive:
                archive.AddFile(str(layer), f"{path.stem}.usdc")
            if not zipfile.is_zipfile(file):  # no error is reported on a full disk
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    except usd.Tf.ErrorException as error:
        # "Error occurred writing file: No space left on device"
        raise OSError(error.args[0].commentary.rpartition(": ")[2]) from error
    finally:
        if is_package:
            layer.unlink(missing_ok=True)


def _write_elsewhere(
    python: str,
    file: Path,
    path: Path,
    frames: SplatFrames,
    fps: float,
    moving_color: bool,
) -> None:
    """As `_write_file`, by another interpreter, which takes a frame at a time. Raises StgaError
    where it lacks USD or ends early."""
    arguments = [str(file), str(path), repr(fps), "moving" if moving_color else "constant"]
    with start_piped(python, ["stga_addon.export.usd", *arguments]) as process:
        stdin = cast(BinaryIO, process.stdin)
        stdout = cast(BinaryIO, process.stdout)
        try:
            if not _answer(python, stdout)[HAS_USD]:
                raise _lacks_usd(path, f"neither {this_python()} nor {python} has")
            with suppress(BrokenPipeError):  # it has ended, and said why
                for number, world in frames:
                    send(stdin, {NUMBER: number, **vars(world)})
                send(stdin, {})
            _answer(python, stdout)
        except BaseException:
            process.kill()
            file.with_name(f".layer{file.name}").unlink(missing_ok=True)
            raise


def _answer(python: str, stream: BinaryIO) -> dict[str, np.ndarray]:
    """The next message of the writing process. Raises OSError with what it could not write."""
    try:
        answer = receive(stream)
    except (EOFError, ValueError) as error:
        raise StgaError(f"{python}: exited unexpectedly while it wrote a USD file") from error
    if ERROR in answer:
        raise OSError(str(answer[ERROR]))
    return answer


def serve(requests: BinaryIO, answers: BinaryIO, file: Path, path: Path, *settings: Any) -> None:
    """Write the frames that are requested; answer whether USD is installed, and at the end.

    settings: fps and moving_color, as `write_usd` takes them
    """
    usd = find_usd()
    send(answers, {HAS_USD: usd is not None})
    if usd is None:
        return

    def frames() -> SplatFrames:
        while arrays := receive(requests):
            number = int(arrays.pop(NUMBER))
            yield number, Splats(**arrays)

    try:
        _write_file(usd, file, path, frames(), *settings)
    except OSError as error:
        send(answers, {ERROR: error.strerror or str(error)})
    else:
        send(answers, {})


def usd_bytes(splats: Splats, frames: int, moving_color: bool) -> int:
    """Size of the binary file: poses, and moving colors, per frame, the rest once."""
    coefficients = 3 * splats.sh.shape[1]
    once, each = (4, 40 + 2 * coefficients) if moving_color else (4 + 4 * coefficients, 40)
    return len(splats) * (once + each * frames)


def _write_layer(usd: Any, file: Path, frames: SplatFrames, fps: float, moving_color: bool) -> None:
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


if __name__ == "__main__":
    answers = claim_stdout()
    file, path, fps, color = sys.argv[1:]
    serve(sys.stdin.buffer, answers, Path(file), Path(path), float(fps), color == "moving")
