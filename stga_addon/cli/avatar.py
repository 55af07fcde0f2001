"""Make an avatar from footage: track the head, train, and write a report and a Blender file.

Called again with the same arguments, it continues where it was interrupted.
"""

from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from ..capture.model import Capture
from ..requests.avatar_folder import read_inputs
from ..requests.open_head import OpenHead
from ..requests.values import CAPTURE_FOLDER, RUN_FOLDER, MakeAvatar, Train
from ..training.run.folder import AVATAR, has_run, read_run
from .arguments import usable_path
from .carry_out import carry_out
from .track import add_footage, tracking_request
from .train import add_training, refuse_changes, training_settings

NAME, HELP = "avatar", "make an avatar from footage: track, train, and write a report and a .blend file"
BLEND = "avatar.blend"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    add_footage(parser)
    parser.add_argument("--out", type=usable_path, required=True, metavar="DIR", help="folder of capture, run and file")
    add_training(parser)
    parser.add_argument("--no-blend", action="store_true", help="write no .blend file")


def run(options: Namespace) -> None:
    carry_out(avatar_request(options))
    blend = None if options.no_blend else _write_blend(options.out)
    if blend is not None:
        print(f"blender: {blend}")


def avatar_request(options: Namespace) -> MakeAvatar:
    """Raises StgaError for options that do not go together, or that differ from those that its run began with."""
    settings = training_settings(options)
    capture, run_folder = options.out / CAPTURE_FOLDER, options.out / RUN_FOLDER
    if has_run(run_folder):
        refuse_changes(options, read_run(run_folder))
    train = Train(run_folder, capture, settings, device=options.device)
    return MakeAvatar(tracking_request(options, capture), train)


def _write_blend(out: Path) -> Path | None:
    if find_spec("bpy") is None:
        print("warning: no .blend file: this Python has no bpy (install bpy, or run the command in Blender)")
        return None
    from ..training.run.tracking_file import with_refined_tracking

    return write_blend(out, lambda capture: with_refined_tracking(capture, out / RUN_FOLDER))


def write_blend(out: Path, refine: Callable[[Capture], Capture], finish: Callable[[Any], object] = bool) -> Path:
    """Write the .blend file of what `run` left in `out`; needs bpy, whose open file it replaces.

    refine: gives the capture's heads as training refined them; finish: called with the head before saving.
    Raises StgaError.
    """
    from ..avatar.file import read_avatar
    from ..capture.open import open_capture
    from ..export.playback import playback_fps
    from ..scene.avatar_scene import set_up_head, show_on_head, show_world
    from ..scene.blend_file import empty_file, save_file
    from ..tracking.folder import is_flame

    inputs = read_inputs(out)
    flame = Path(inputs["model"]) if inputs["model"] and is_flame(out / CAPTURE_FOLDER) else None
    capture, avatar = open_capture(out / CAPTURE_FOLDER, flame), read_avatar(out / RUN_FOLDER / AVATAR)
    empty_file()
    head = set_up_head(refine(capture))
    show_on_head(avatar, head, f"//{RUN_FOLDER}/{AVATAR}", playback_fps(capture, numbered=True))
    show_world(out / RUN_FOLDER / AVATAR, head)
    finish(head)
    save_file(out / BLEND)
    return Path(out / BLEND)
