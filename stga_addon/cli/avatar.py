"""Make an avatar from footage: track the head, train, and write a report and a Blender file.

Called again with the same arguments, it continues where it was interrupted.
"""

import os
from argparse import ArgumentParser, Namespace
from collections.abc import Callable
from dataclasses import fields
from importlib.util import find_spec
from pathlib import Path
from time import perf_counter
from typing import Any

from ..capture.model import Capture
from ..errors import StgaError, shorten
from ..files import read_json, write_json
from ..format import format_duration
from ..requests.open_head import OpenHead
from ..requests.values import Track
from ..training.run.folder import AVATAR, has_run
from .arguments import usable_path
from .carry_out import carry_out
from .track import add_footage, tracking_request
from .train import add_training, training_request, training_settings

NAME, HELP = "avatar", "make an avatar from footage: track, train, and write a report and a .blend file"
INPUTS, CAPTURE, RUN, BLEND = "inputs.json", "capture", "run", "avatar.blend"
"""Files and folders of OUT."""


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    add_footage(parser)
    parser.add_argument("--out", type=usable_path, required=True, metavar="DIR", help="folder of capture, run and file")
    add_training(parser)
    parser.add_argument("--no-blend", action="store_true", help="write no .blend file")


def run(options: Namespace) -> None:
    training_settings(options)  # refuses now what would be refused after the tracking
    begin = perf_counter()
    capture, run_folder = options.out / CAPTURE, options.out / RUN
    _track(options, capture)
    tracked = perf_counter()
    carry_out(training_request(training_options(options, capture, run_folder)))
    trained = perf_counter()
    blend = None if options.no_blend else _write_blend(options.out)
    print()
    for line in summary(options.out, blend):
        print(line)
    times = f"tracking {format_duration(tracked - begin)}, training {format_duration(trained - tracked)}"
    print(f"time: {times}, in all {format_duration(perf_counter() - begin)}")


def training_options(options: Namespace, capture: Path, run_folder: Path) -> Namespace:
    """Those of `stga train` on the tracked capture; a run in the folder is continued."""
    from ..tracking.folder import is_flame

    given = {
        "capture": capture,
        "flame": options.model if is_flame(capture) else None,
        "principal_point": None,
        "head": None,
        "out": run_folder,
        "resume": has_run(run_folder),
    }
    return Namespace(**{**vars(options), **given})


def summary(out: Path, blend: Path | None) -> list[str]:
    """Lines on what `out` holds now."""
    from ..report.run_summary import CURVE, report_run
    from ..tracking.folder import REPORT_FILE, SHEET_FILE

    report = read_json(out / CAPTURE / REPORT_FILE)
    try:
        errors = report["reprojection_px"]
        timesteps = {timestep for by_timestep in errors.values() for timestep in by_timestep} | set(
            map(str, report["interpolated"])
        )
        lines = [f"warning: {warning}" for warning in report["warnings"]]
        lines += [f"footage: cameras {len(errors)}, timesteps {len(timesteps)}"]
        lines += [f"tracking: reprojection error {report['median_reprojection_px']:.2f} px (median)"]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise StgaError(f"{out / CAPTURE / REPORT_FILE}: is not the report of a tracking ({error!s:.100})") from error
    lines += report_run(out / RUN)
    files = [out / CAPTURE / SHEET_FILE, out / CAPTURE / REPORT_FILE, out / RUN / CURVE]
    lines += [f"report: {', '.join(str(path) for path in files if path.exists())}"]
    lines += [f"avatar: {out / RUN / AVATAR}"]
    return lines + ([f"blender: {blend}"] if blend is not None else [])


def _track(options: Namespace, capture: Path) -> None:
    """Track into the folder unless that was done. Raises StgaError where OUT began with other inputs."""
    from ..tracking.folder import is_written

    path, inputs = options.out / INPUTS, _inputs(options)
    if path.exists():
        stored = _read_inputs(options.out)
        before = {name: stored.get(name, getattr(Track, name, None)) for name in inputs}  # an older version noted less
        changed = next((name for name in inputs if before[name] != inputs[name]), None)
        if changed is not None:
            raise StgaError(f"{changed}: {options.out} began with {shorten(before[changed])}; give another --out")
    elif is_written(capture) or (options.out / RUN).exists():
        raise StgaError(f"{options.out}: holds something else ({INPUTS} is missing); give another --out")
    if not is_written(capture):
        new = not options.out.exists()
        write_json(path, inputs)
        try:
            carry_out(tracking_request(options, capture))
        except StgaError:
            if not capture.exists():  # nothing was tracked yet, so that the inputs may be mended
                path.unlink()
                if new:
                    options.out.rmdir()
            raise


def _read_inputs(out: Path) -> dict[str, Any]:
    """Raises StgaError where inputs.json is missing or malformed."""
    values = read_json(out / INPUTS)
    if not isinstance(values, dict) or not isinstance(values.get("model", 0), str | None):
        raise StgaError(f"{out / INPUTS}: has no model; expected what `stga avatar` wrote")
    return values


def _inputs(options: Namespace) -> dict[str, Any]:
    """The options that decide what is tracked, as JSON: the fields of `Track` but its folder; paths are absolute."""
    values = {spec.name: getattr(options, spec.name) for spec in fields(Track) if spec.name != "out"}
    values["offset"] = dict(sorted(options.offset))
    return {name: os.path.abspath(value) if isinstance(value, Path) else value for name, value in values.items()}


def _write_blend(out: Path) -> Path | None:
    if find_spec("bpy") is None:
        print("warning: no .blend file: this Python has no bpy (install bpy, or run the command in Blender)")
        return None
    from ..training.run.tracking_file import with_refined_tracking

    return write_blend(out, lambda capture: with_refined_tracking(capture, out / RUN))


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

    inputs = _read_inputs(out)
    flame = Path(inputs["model"]) if inputs["model"] and is_flame(out / CAPTURE) else None
    capture, avatar = open_capture(out / CAPTURE, flame), read_avatar(out / RUN / AVATAR)
    empty_file()
    head = set_up_head(refine(capture), flame)
    show_on_head(avatar, head, f"//{RUN}/{AVATAR}", playback_fps(capture, numbered=True))
    show_world(out / RUN / AVATAR, head)
    finish(head)
    save_file(out / BLEND)
    return Path(out / BLEND)
