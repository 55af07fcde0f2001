"""The Python interface: what other programs import, kept from version to version.

Other modules may move. Importing this one needs numpy alone; rendering needs numba, training what
the extra `train` of the package brings.

    >>> from PIL import Image
    >>> import stga_addon.api as stga
    >>> splats = stga.read_splats("splats.ply")
    >>> camera = stga.look_at((0, 0, 1), (0, 0, 0), width=640, height=480, focal_length=800)
    >>> image = stga.render(splats, camera, background=(1, 1, 1))
    >>> Image.fromarray(stga.to_uint8(image)).save("splats.png")

Work that takes long is a request, which `perform` carries out, as the command line does:

    >>> settings = stga.make_settings(preset="draft")
    >>> stga.perform(stga.Train("runs/anna", "captures/anna", settings))
    >>> stga.perform(stga.Export("runs/anna", "anna.html", "web"))

Where a Path is expected, a str or another os.PathLike may stand.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .avatar import file as _avatar_file
from .avatar.file import Avatar
from .avatar.splats import Splats
from .capture import open as _capture
from .capture.camera import Camera, camera_from_gl, look_at, turntable
from .capture.model import Capture
from .errors import StgaError
from .export import ply as _ply
from .export import splat_files as _splat_files
from .jobs import perform as _perform
from .jobs.analyze import Analyze, Select
from .jobs.convert_motion import ConvertMotion
from .jobs.export import Export
from .jobs.finished_run import Evaluate, MakeExact, Relight
from .jobs.render import Render
from .jobs.track import MakeAvatar, Track
from .jobs.train import Extend, Refine, Resume, Train
from .progress import Cancelled, Progress, Report
from .schema import takes_paths as _takes_paths
from .training.settings import TrainingSettings, make_settings

if TYPE_CHECKING:
    from .raster.cpu.autograd import render_differentiable
    from .render.render import render, render_avatar, to_uint8

_LOADED_WHEN_USED = {
    "render": "render.render",
    "render_avatar": "render.render",
    "to_uint8": "render.render",
    "render_differentiable": "raster.cpu.autograd",
}
"""Names that need more than numpy -> their modules."""

__all__ = [
    "Analyze",
    "Avatar",
    "Camera",
    "Cancelled",
    "Capture",
    "ConvertMotion",
    "Evaluate",
    "Export",
    "Extend",
    "MakeAvatar",
    "MakeExact",
    "Progress",
    "Refine",
    "Relight",
    "Render",
    "Report",
    "Resume",
    "Select",
    "Splats",
    "StgaError",
    "Track",
    "Train",
    "TrainingSettings",
    "camera_from_gl",
    "look_at",
    "make_settings",
    "open_capture",
    "perform",
    "read_avatar",
    "read_splats",
    "render",
    "render_avatar",
    "render_differentiable",
    "to_uint8",
    "turntable",
    "write_avatar",
    "write_ply",
]

open_capture = _takes_paths(_capture.open_capture)
perform = _takes_paths(_perform.perform)
read_avatar = _takes_paths(_avatar_file.read_avatar)
read_splats = _takes_paths(_splat_files.read_splats)
write_avatar = _takes_paths(_avatar_file.write_avatar)
write_ply = _takes_paths(_ply.write_ply)


def __getattr__(name: str) -> Any:
    if name not in _LOADED_WHEN_USED:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f".{_LOADED_WHEN_USED[name]}", __package__), name)
