"""Track a head through footage of one or more cameras, and write a capture."""

import re
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..errors import StgaError
from ..requests.open_head import OpenHead
from .arguments import real_number, usable_path, whole_number

if TYPE_CHECKING:
    from ..tracking.track import TrackingReport

NAME, HELP = "track", "track a head through footage, and write a capture"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    add_footage(parser)
    parser.add_argument("--out", type=usable_path, required=True, metavar="CAPTURE", help="folder of the capture")


def add_footage(parser: ArgumentParser) -> None:
    """FOOTAGE, --model, and how both are read."""
    parser.add_argument("footage", type=usable_path, metavar="FOOTAGE", help="folder of images or videos, or a video")
    parser.add_argument(
        "--model",
        type=usable_path,
        required=True,
        metavar="HEAD",
        help="FLAME (.pkl, .npz), linear model (.npz) or morph targets (.glb)",
    )
    parser.add_argument("--cameras", type=usable_path, metavar="FILE", help="calibration that is not in FOOTAGE")
    points = parser.add_mutually_exclusive_group()
    points.add_argument("--landmarks", type=usable_path, metavar="FOLDER", help="landmark files of another detector")
    points.add_argument("--detector", type=usable_path, metavar="TASK", help="MediaPipe's face_landmarker.task")
    parser.add_argument(
        "--download-detector",
        action="store_true",
        help="download Google's face_landmarker.task (4 MB) to the file of --detector, where there is none",
    )
    parser.add_argument("--focal", type=real_number, metavar="PIXELS", help="focal length of a single camera")
    parser.add_argument("--start", type=whole_number(0), default=0, help="first timestep")
    parser.add_argument("--stop", type=whole_number(1), help="timestep to stop before")
    parser.add_argument("--step", type=whole_number(1), default=1, help="use every nth timestep")
    parser.add_argument(
        "--offset",
        type=_offset,
        action="append",
        default=[],
        metavar="CAMERA=FRAMES",
        help="frames by which a camera's recording is later; may be repeated",
    )
    parser.add_argument("--meshes", action="store_true", help="write an OBJ per timestep as well")


def run(options: Namespace) -> None:
    result = track_footage(options, options.out)
    for warning in result.warnings:
        print(f"warning: {warning}")
    print(f"reprojection error: {result.median_px:.2f} px (median); by camera and timestep in tracking.json")
    print(f"capture: {options.out}")


def track_footage(options: Namespace, out: Path) -> "TrackingReport":
    """Track what `add_footage`'s options name into the folder `out`, with a bar for each stage. Raises StgaError."""
    from ..tracking.footage.open import open_footage
    from ..tracking.footage.sequences import FrameRange
    from ..tracking.track import track

    if options.download_detector:
        from ..tracking.detector_file import download_task

        if options.detector is None:
            raise StgaError("--download-detector: give the file to write with --detector")
        download_task(options.detector)
    frames = FrameRange(options.start, options.stop, options.step, dict(options.offset))
    footage = open_footage(options.footage, options.cameras, frames, options.focal)
    with _Bar() as bar:
        return track(footage, options.model, out, options.landmarks, options.detector, options.meshes, bar.report)


def _offset(text: str) -> tuple[str, int]:
    name, separator, frames = text.rpartition("=")
    if not separator or not re.fullmatch(r"-?\d{1,9}", frames):
        raise ArgumentTypeError(f"expected a camera and a number of frames, as in left=-3, not {text!r}")
    return name, int(frames)


class _Bar:
    """A bar for each stage."""

    def __enter__(self) -> "_Bar":
        self._stage = ""
        self._bar: Any = None
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

    def report(self, stage: str, done: int, total: int) -> None:
        if stage != self._stage:
            self._close()
            self._stage = stage
            from tqdm import tqdm

            self._bar = tqdm(desc=stage, total=total, dynamic_ncols=True)
        if self._bar is not None:
            self._bar.update(done - self._bar.n)

    def _close(self) -> None:
        if self._bar is not None:
            self._bar.close()
