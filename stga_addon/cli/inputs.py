"""Inputs that several commands name: a capture, and the network of the face detector."""

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import Any

from ..capture.model import Capture
from ..capture.open import open_capture
from ..capture.transforms import DEFAULT_PRINCIPAL_POINT
from ..errors import StgaError
from .arguments import usable_path

CAN_DOWNLOAD = Path(__file__).parents[1].joinpath("tracking/detector_file.py").exists()
"""Whether this edition can download the detector: some are built without."""


def principal_point_of(options: Namespace) -> str:
    """The convention of --principal-point."""
    return options.principal_point or DEFAULT_PRINCIPAL_POINT


def open_named_capture(options: Namespace) -> Capture:
    """The capture of CAPTURE, --flame and --principal-point."""
    return open_capture(options.capture, options.flame, principal_point_of(options))


def add_detector(parser: ArgumentParser, group: Any = None) -> None:
    """--detector, in `group` where it excludes other options, and --download-detector."""
    (group or parser).add_argument(
        "--detector", type=usable_path, metavar="TASK", help="MediaPipe's face_landmarker.task"
    )
    if CAN_DOWNLOAD:
        parser.add_argument(
            "--download-detector",
            action="store_true",
            help="download Google's face_landmarker.task (4 MB) to the file of --detector, where there is none",
        )


def provide_detector(options: Namespace) -> None:
    """Download the network where that is asked for. Raises StgaError where it has no file, or cannot be downloaded."""
    if not CAN_DOWNLOAD or not options.download_detector:
        return
    from ..tracking.detector_file import download_task

    if options.detector is None:
        raise StgaError("--download-detector: give the file to write with --detector")
    download_task(options.detector)
