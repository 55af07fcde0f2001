"""The capture that several commands name."""

from argparse import Namespace

from ..capture.model import Capture
from ..capture.open import open_capture
from ..capture.transforms import DEFAULT_PRINCIPAL_POINT


def principal_point_of(options: Namespace) -> str:
    """The convention of --principal-point."""
    return options.principal_point or DEFAULT_PRINCIPAL_POINT


def open_named_capture(options: Namespace) -> Capture:
    """The capture of CAPTURE, --flame and --principal-point."""
    return open_capture(options.capture, options.flame, principal_point_of(options))
