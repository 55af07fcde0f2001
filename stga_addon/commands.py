"""What each command does; `cli.py` parses, this module works and prints."""

import sys
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from .avatar.embedding import to_world
from .avatar.file import Avatar, read_avatar
from .avatar.ply import read_ply, write_ply
from .capture.model import Capture, View
from .capture.open import open_capture
from .errors import StgaError
from .files import replacing, write_npz
from .selection import SelectionOptions, select_capture


def train(options: Namespace) -> None:
    """Train, or continue, a run."""
    from .training.folder import read_run
    from .training.progress import ProgressBar
    from .training.run import train as train_run

    if not options.capture.is_dir():
        raise StgaError(f"{options.capture}: is not a folder; expected that of a capture")
    if options.resume:
        run = read_run(options.out)
        _refuse_changes(options, run)
    else:
        run = _new_run(options)
        if (options.out / "run.json").exists():
            raise StgaError(f"{options.out}: already holds a run; give --resume to continue it, or another --out")
    capture = open_capture(run.capture, options.flame or run.flame, run.principal_point)
    for warning in capture.warnings:
        print(f"warning: {warning}")
    with ProgressBar() as bar:
        avatar = train_run(capture, options.out, run, resume=options.resume, report=bar.report)
    print(f"avatar: {avatar}")


def job(options: Namespace) -> None:
    """Carry out the training job that Blender wrote into a run's folder; its panel shows the progress."""
    from .job import work

    if not sys.stderr.isatty():  # a worker of Blender's: its folder says it all
        work(options.run)
        return
    from .training.progress import ProgressBar

    with ProgressBar() as bar:
        work(options.run, also=bar.report)


def _refuse_changes(options: Namespace, run: Any) -> None:
    """A resumed run ends where an unbroken one would have: with its own capture and settings."""
    if run.capture != options.capture.resolve():
        raise StgaError(f"{options.out}: this run trains {run.capture}, not {options.capture.resolve()}")
    settings = run.settings
    began_with = {
        "budget": settings.seconds,
        "iterations": settings.iterations,
        "strategy": settings.strategy,
        "schedule": settings.schedule,
        "threshold": settings.selection.threshold,
        "seed": settings.seed,
        "principal_point": run.principal_point,
    }
    for name, value in began_with.items():
        if getattr(options, name) not in (None, value):
            option = "--" + name.replace("_", "-")
            raise StgaError(f"{option}: this run began with {value}, which cannot change; use another --out")


def _new_run(options: Namespace) -> Any:
    from .training.folder import Run
    from .training.settings import make_settings

    changes: dict[str, Any] = {}
    if options.seed is not None:
        changes["seed"] = options.seed
    if options.iterations is not None:
        changes["iterations"] = options.iterations
    else:
        changes["seconds"] = 120.0 if options.budget is None else options.budget
    if options.strategy is not None:
        changes["strategy"] = options.strategy
    if options.threshold is not None:
        changes["selection"] = SelectionOptions(threshold=options.threshold)
    flame = None if options.flame is None else options.flame.resolve()
    settings = make_settings(schedule=options.schedule or "default", **changes)
    return Run(options.capture.resolve(), flame, options.principal_point or "vhap", settings)


def render(options: Namespace) -> None:
    """One PNG per camera entry, named like its file_path."""
    from PIL import Image
    from tqdm import tqdm

    from .capture.transforms import read_transforms
    from .raster.pictures import to_bytes

    draw = _drawer(options)
    frames = read_transforms(options.cameras, options.principal_point or "vhap")
    names = _unique_names([frame.view.name for frame in frames])
    for frame, name in zip(tqdm(frames, desc="rendering", unit="image"), names, strict=True):
        with replacing(options.out / name) as partial:
            Image.fromarray(to_bytes(draw(frame.view))).save(partial, format="PNG")


def _drawer(options: Namespace) -> Callable[[View], np.ndarray]:
    """View -> image (3, H, W), for an avatar with its capture or a plain world-space PLY."""
    from .raster.draw import draw_avatar, draw_splats

    if options.source.suffix.lower() == ".ply":
        splats = read_ply(options.source)
        return lambda view: draw_splats(splats, view.camera, options.background)
    avatar, capture = _avatar_and_capture(options.source, options.capture, options.flame)
    if capture is None:
        raise StgaError(f"{options.source}: an avatar needs the meshes of a capture to follow; give --capture")
    driver = _fitting(capture, avatar)
    return lambda view: draw_avatar(avatar, _mesh(driver, view), view.camera, options.background)


def _mesh(capture: Capture, view: View) -> np.ndarray:
    if view.timestep not in capture.timesteps:
        raise StgaError(f"{capture.root}: has no mesh for timestep {view.timestep}, which {view.name} asks for")
    return np.asarray(capture.mesh(view.timestep))


def _unique_names(paths: list[str]) -> list[str]:
    """File names with the suffix .png; where entries share one, their folders become part of it, then a number."""
    pngs = [PurePosixPath(path).with_suffix(".png") for path in paths]
    names = [png.name for png in pngs]
    if len(set(names)) < len(names):
        names = ["_".join(part for part in png.parts if part not in ("..", "/")) for png in pngs]
    unique: list[str] = []
    for name in names:
        candidates = (name, *(f"{PurePosixPath(name).stem}_{n}.png" for n in range(2, len(names) + 2)))
        unique.append(next(c for c in candidates if c not in unique))
    return unique


def eval(options: Namespace) -> None:
    """Print the quality of a run's avatar on a split, and write it beside the run."""
    from .files import write_json
    from .training.metrics import measure

    if not options.run.is_dir():
        raise StgaError(f"{options.run}: is not a folder; expected that of a run")
    avatar, capture = _avatar_and_capture(options.run, None, None)
    assert capture is not None  # a run names one
    views = capture.views.get(options.split, ())
    if not views:
        raise StgaError(f"{capture.root}: has no views in the split '{options.split}'")
    quality = measure(avatar, capture, options.split, perceptual=True)
    lpips = "not measured (package lpips is not installed)" if quality.lpips is None else f"{quality.lpips:.4f}"
    print(f"{options.split}: {len(views)} views, PSNR {quality.psnr:.3f} dB, SSIM {quality.ssim:.4f}, LPIPS {lpips}")
    write_json(options.run / f"quality_{options.split}.json", {"views": len(views), **quality.as_json()})


def select(options: Namespace) -> None:
    """Print how many triangles each frame selects."""
    capture = open_capture(options.capture, options.flame, options.principal_point or "vhap")
    threshold = SelectionOptions.threshold if options.threshold is None else options.threshold
    selection = select_capture(capture, SelectionOptions(threshold=threshold, zero_pose=options.zero_pose))
    print(f"threshold {1000 * threshold:g} mm, {len(capture.faces)} triangles")
    for timestep, faces in selection.items():
        regions = [name for name, members in capture.regions.items() if members.any() and faces[members].all()]
        print(f"{timestep:5d}  {faces.mean():6.1%}  {', '.join(regions)}")
    if options.out:
        write_npz(options.out, {f"{t:05d}": faces for t, faces in selection.items()}, compressed=True)


def export(options: Namespace) -> None:
    """Write an avatar as GaussianAvatars pair, world PLY or a sequence of them."""
    avatar, capture = _avatar_and_capture(options.avatar, options.capture, options.flame)
    if capture is not None:
        _fitting(capture, avatar)
    export_avatar(avatar, capture, options.format, options.out, options.timestep)


def export_avatar(
    avatar: Avatar, capture: Capture | None, kind: str, out: Path, timestep: int | None = None
) -> list[Path]:
    """Write `avatar` as "ply" (one frame, or the neutral mesh), "ply-sequence" or "gaussian-avatars".

    Returns the files written.
    Raises StgaError where the capture that holds the frames is missing or has not what the format needs.
    """
    if kind == "gaussian-avatars":
        from .avatar.gaussian_avatars import write_gaussian_avatars

        if capture is None or capture.flame is None:
            raise StgaError("the GaussianAvatars format needs the FLAME parameters of a FLAME capture; give --capture")
        write_gaussian_avatars(out, avatar, capture.flame)
        return [out / "point_cloud.ply", out / "flame_param.npz"]
    if kind == "ply" and timestep is None:
        write_ply(out, _baked(avatar, avatar.neutral))
        return [out]
    if capture is None:
        raise StgaError("frames other than the neutral mesh need a capture; give --capture")
    wanted = capture.timesteps if kind == "ply-sequence" else (timestep,)
    files = []
    for number in wanted:
        if number not in capture.timesteps:
            raise StgaError(f"{capture.root}: has no timestep {number}")
        path = out / f"{number:05d}.ply" if kind == "ply-sequence" else out
        write_ply(path, _baked(avatar, capture.mesh(number)))
        files.append(path)
    return files


def _baked(avatar: Avatar, mesh: np.ndarray) -> Any:
    return to_world(avatar.splats, avatar.frames(mesh))


def info(options: Namespace) -> None:
    """Print what a capture holds."""
    from .capture.summary import describe

    lines = describe(open_capture(options.capture, options.flame, options.principal_point or "vhap"))
    width = max(len(label) for label, _ in lines)
    for label, value in lines:
        print(f"{label:<{width}}  {value}")


def demo(options: Namespace) -> None:
    """Make a synthetic capture and take it through training and Blender."""
    from .demo.run import run_demo

    run_demo(options.out, options.budget)


def _avatar_and_capture(source: Path, capture: Path | None, flame: Path | None) -> tuple[Avatar, Capture | None]:
    """The avatar of a run folder or file, and the capture that was given or that the run was trained on."""
    if not source.is_dir():
        return read_avatar(source), None if capture is None else open_capture(capture, flame)
    from .training.folder import read_run

    run = read_run(source)
    return read_avatar(source / "avatar.npz"), open_capture(
        capture or run.capture, flame or run.flame, run.principal_point
    )


def _fitting(capture: Capture, avatar: Avatar) -> Capture:
    if not np.array_equal(capture.faces, avatar.faces):
        raise StgaError(f"{capture.root}: its mesh has other triangles than the one this avatar was trained on")
    return capture
