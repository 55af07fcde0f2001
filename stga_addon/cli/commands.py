"""What each command does; `cli.py` parses, this module works and prints."""

import json
import sys
from argparse import Namespace
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any

import numpy as np

from ..avatar.embedding import to_world
from ..avatar.file import Avatar, read_avatar
from ..avatar.ply import read_ply, write_ply
from ..capture.model import Capture, View
from ..capture.open import open_capture
from ..errors import StgaError
from ..files import replacing, write_npz
from ..flame.motion import driven
from ..flame.sequence import sequence_mesh
from ..selection import SelectionOptions, select_capture

if TYPE_CHECKING:
    from ..training.evaluate.metrics import Quality


def train(options: Namespace) -> None:
    """Train, or continue, a run."""
    from ..effects.decide import decide, describe_effects
    from ..report.run_summary import CurveDrawer, conclude
    from ..training.optimize.device import choose_device
    from ..training.run.folder import read_run
    from ..training.run.loop import train as train_run
    from ..training.run.progress import Progress
    from ..training.run.progress_bar import ProgressBar

    if not options.capture.is_dir():
        raise StgaError(f"{options.capture}: is not a folder; expected that of a capture")
    device, why = choose_device(options.device)
    print(why)
    if options.resume:
        run = read_run(options.out)
        _refuse_changes(options, run)
        capture = open_capture(run.capture, options.flame or run.flame, run.principal_point)
    else:
        if (options.out / "run.json").exists():
            raise StgaError(f"{options.out}: already holds a run; give --resume to continue it, or another --out")
        capture = open_capture(options.capture, options.flame, options.principal_point or "vhap")
        run = decide(_new_run(options, capture, device), capture, device)
    for warning in capture.warnings:
        print(f"warning: {warning}")
    _print_table(describe_effects(run.effect_plan))
    draw = CurveDrawer(options.out)
    with ProgressBar() as bar:

        def report(progress: Progress) -> bool:
            draw()
            return bar.report(progress)

        selection = None if options.head is None else options.head.selection()
        avatar = train_run(capture, options.out, run, selection, options.resume, report, device)
    for line in conclude(options.out):
        print(line)
    print(f"avatar: {avatar}")
    if run.settings.tracking:
        print(f"its meshes: {options.out / 'tracking.npz'}, in Blender with Apply Motion, Own Offsets")


def job(options: Namespace) -> None:
    """Carry out the training job that Blender wrote into a run's folder; its panel shows the progress."""
    from ..jobs.training_job import run_training_job

    if not sys.stderr.isatty():  # a worker of Blender's: its folder says it all
        run_training_job(options.run)
        return
    from ..training.run.progress_bar import ProgressBar

    with ProgressBar() as bar:
        run_training_job(options.run, also=bar.report)


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
        "preset": settings.preset,
        "target_psnr": settings.target_psnr,
        "stop_when_flat": settings.stop_when_flat,
        "principal_point": run.principal_point,
    }
    for name, value in began_with.items():
        if getattr(options, name) not in (None, value):
            option = "--" + name.replace("_", "-")
            raise StgaError(f"{option}: this run began with {value}, which cannot change; use another --out")
    decided = {decision.effect: decision for decision in run.effect_plan}
    for name, choice in _choices(options).items():
        if name not in decided or choice not in ("auto", "on" if decided[name].on else "off"):
            raise StgaError(f"--effect {name}={choice}: this run has decided otherwise; use another --out")


def _choices(options: Namespace) -> dict[str, str]:
    from ..training.effect_plan import parse_choices

    return parse_choices(options.effect)


def _new_run(options: Namespace, capture: Capture, device: str) -> Any:
    from ..training.run.folder import Run
    from ..training.settings import make_settings

    changes: dict[str, Any] = {"target_psnr": options.target_psnr, "stop_when_flat": bool(options.stop_when_flat)}
    if options.seed is not None:
        changes["seed"] = options.seed
    if options.iterations is not None:
        changes["iterations"] = options.iterations
    elif options.budget is not None:
        changes["seconds"] = options.budget
    else:
        changes["seconds"] = 120.0 if options.preset is None else _planned(capture, options.preset, device)
    if options.strategy is not None:
        changes["strategy"] = options.strategy
    if options.threshold is not None:
        changes["selection"] = SelectionOptions(threshold=options.threshold)
    flame = None if options.flame is None else options.flame.resolve()
    choices = _choices(options)
    if choices or (options.schedule != "paper" and options.strategy != "gaussian-avatars"):
        changes["effects"] = choices
    settings = make_settings(schedule=options.schedule or "default", preset=options.preset, **changes)
    return Run(options.capture.resolve(), flame, options.principal_point or "vhap", settings)


def _planned(capture: Capture, preset: str, device: str) -> float:
    """Seconds that a preset takes on this machine's device, which are printed."""
    from ..report.preset_timing import time_presets
    from ..training.evaluate.forecast import clock

    (plan,) = time_presets(capture, [preset], device=device)
    print(f"{preset}: {plan.iterations} iterations, {clock(plan.seconds)} on this machine")
    return plan.seconds


def render(options: Namespace) -> None:
    """One PNG per camera entry, named like its file_path."""
    from PIL import Image
    from tqdm import tqdm

    from ..capture.transforms import read_transforms
    from ..raster.images import to_bytes

    views = [frame.view for frame in read_transforms(options.cameras, options.principal_point or "vhap")]
    if options.motion is None:
        draw = _drawer(options)
    else:
        draw, views = _reenactment(options, views)
    names = _unique_names([view.name for view in views])
    for view, name in zip(tqdm(views, desc="rendering", unit="image"), names, strict=True):
        with replacing(options.out / name) as partial:
            Image.fromarray(to_bytes(draw(view))).save(partial, format="PNG")


def _drawer(options: Namespace) -> Callable[[View], np.ndarray]:
    """View -> image (3, H, W), for an avatar with its capture or a plain world-space PLY."""
    from ..raster.render import render_avatar, render_splats

    if options.source.suffix.lower() == ".ply":
        splats = read_ply(options.source)
        return lambda view: render_splats(splats, view.camera, options.background)
    avatar, capture = _avatar_and_capture(options.source, options)
    if capture is None:
        raise StgaError(f"{options.source}: an avatar needs the meshes of a capture to follow; give --capture")
    driver = _fitting(capture, avatar)
    return lambda view: render_avatar(avatar, _mesh(driver, view), view.camera, options.background)


def _reenactment(options: Namespace, views: list[View]) -> tuple[Callable[[View], np.ndarray], list[View]]:
    """An avatar moved by another person's FLAME motion; the views of every timestep from each camera's first place."""
    from ..raster.render import render_avatar
    from ..training.run.folder import read_run

    if options.source.suffix.lower() == ".ply":
        raise StgaError(f"{options.source}: is a PLY, whose splats are bound to no mesh that a motion could move")
    is_run = options.source.is_dir()
    flame = options.flame or (read_run(options.source).flame if is_run else None)
    avatar = read_avatar(options.source / "avatar.npz" if is_run else options.source)
    motion = open_capture(options.motion, flame)
    if motion.flame is None:
        raise StgaError(f"{options.motion}: was not tracked with FLAME, so it has no parameters of expression and pose")
    _fitting(motion, avatar)
    sequence = driven(motion.flame, avatar.neutral)
    cameras = {view.camera_index: view for view in reversed(views)}
    placed = [
        replace(cameras[index], timestep=timestep, name=f"{timestep:05d}_{index:02d}")
        for timestep in sequence.timesteps
        for index in sorted(cameras)
    ]
    background = options.background
    return lambda view: render_avatar(avatar, sequence_mesh(sequence, view.timestep), view.camera, background), placed


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
    from ..files import write_json
    from ..training.evaluate.lpips import SMALLEST
    from ..training.evaluate.metrics import measure

    if not options.run.is_dir():
        raise StgaError(f"{options.run}: is not a folder; expected that of a run")
    avatar, capture = _avatar_and_capture(options.run, options)
    assert capture is not None  # a run names one
    views = capture.views.get(options.split, ())
    if not views:
        raise StgaError(f"{capture.root}: has no views in the split '{options.split}'")
    quality = measure(avatar, capture, options.split, perceptual=True)
    print(f"{options.split}: {len(views)} views, {_describe(quality)}")
    for region, name in (("mask", "inside the head mask"), ("selected", "where something moves")):
        if region in quality.regions:
            print(f"  {name}: {_describe(quality.regions[region])}")
    if quality.lpips is None:
        print("LPIPS was not measured: it needs its weights, whose file STGA_LPIPS names (docs/dependencies.md),")
        print(f"and images of {SMALLEST} pixels a side or more")
    write_json(options.run / f"quality_{options.split}.json", {"views": len(views), **quality.as_json()})


def _describe(quality: "Quality") -> str:
    lpips = "" if quality.lpips is None else f", LPIPS {quality.lpips:.4f}"
    return f"PSNR {quality.psnr:.3f} dB, SSIM {quality.ssim:.4f}{lpips}"


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
    avatar, capture = _avatar_and_capture(options.avatar, options)
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
        from ..avatar.gaussian_avatars import write_gaussian_avatars

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
    """Print what a capture holds, and the effects that training on it would compute."""
    from ..capture.summary import describe
    from ..effects.decide import decide_effects, describe_effects
    from ..training.effect_plan import effect_plan_to_json
    from ..training.optimize.device import choose_device
    from ..training.settings import make_settings

    capture = open_capture(options.capture, options.flame, options.principal_point or "vhap")
    plan: tuple[Any, ...] = ()
    if capture.views.get("train"):
        device, _ = choose_device(options.device)
        _, plan = decide_effects(capture, make_settings(iterations=1, effects=_choices(options)), device)
    if options.json:
        found: dict[str, Any] = {"plan": effect_plan_to_json(plan)}
        if options.presets and plan:
            from ..report.preset_timing import time_presets

            found["presets"] = [preset.as_json() for preset in time_presets(capture, device=device)]
        print(json.dumps(found))
        return
    _print_table(describe(capture))
    if plan:
        print()
        _print_table(describe_effects(plan))


def _print_table(lines: Sequence[tuple[str, str]]) -> None:
    width = max((len(label) for label, _ in lines), default=0)
    for label, value in lines:
        print(f"{label:<{width}}  {value}")


def plan(options: Namespace) -> None:
    """Print what each preset is for, and how long it would train on this machine."""
    from ..report.preset_timing import time_presets
    from ..training.evaluate.forecast import clock
    from ..training.optimize.device import choose_device

    capture = open_capture(options.capture, options.flame, options.principal_point or "vhap")
    device, why = choose_device(options.device)
    print(why)
    for plan in time_presets(capture, device=device):
        print(f"{plan.preset:<9} {plan.iterations:6d} iterations  about {clock(plan.seconds):<10}  {plan.purpose}")


def benchmark(options: Namespace) -> None:
    """Train variants for the same time in turns, and print what came of them."""
    from ..development.benchmark.benchmark import run_benchmark
    from ..development.benchmark.variants import KNOBS, MAIN, chosen
    from ..training.run.folder import Run
    from ..training.settings import make_settings

    variants = chosen(KNOBS if options.knobs else MAIN, options.only)
    if options.seeds < 1:
        raise StgaError(f"--seeds: {options.seeds} is not a number of runs")
    settings = make_settings(seconds=options.budget)
    capture = open_capture(options.capture, options.flame, options.principal_point or "vhap")
    for split, purpose in (("train", "train on"), ("val", "measure with")):
        if not capture.views.get(split):
            raise StgaError(f"{capture.root}: has no views to {purpose} (split '{split}')")
    flame = None if options.flame is None else options.flame.resolve()
    run = Run(options.capture.resolve(), flame, options.principal_point or "vhap", settings)
    print(run_benchmark(capture, run, variants, options.budget, options.seeds, options.out.resolve(), _tell))


def _tell(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def demo(options: Namespace) -> None:
    """Make a synthetic capture and take it through training and Blender."""
    from ..development.demo.run import run_demo

    run_demo(options.out, options.budget)


def _avatar_and_capture(source: Path, options: Namespace) -> tuple[Avatar, Capture | None]:
    """The avatar of a run folder or file, and the capture that was given or that the run was trained on.

    Where Blender has a head open and no capture is named, the capture as that head plays it.
    """
    capture, flame = getattr(options, "capture", None), getattr(options, "flame", None)
    if source.is_dir():
        from ..training.optimize.tracking import refined
        from ..training.run.folder import read_run

        run = read_run(source)
        avatar, principal_point = read_avatar(source / "avatar.npz"), run.principal_point
        capture, flame = capture or run.capture, flame or run.flame
    else:
        avatar, principal_point = read_avatar(source), "vhap"
        if capture is not None and avatar.settings.get("tracking"):
            print(f"warning: {source}: was trained on refined meshes, which only its run's folder has", file=sys.stderr)
    opened = None if capture is None else open_capture(capture, flame, principal_point)
    if opened is not None and source.is_dir():
        opened = refined(opened, source)
    return avatar, opened if opened is None or options.head is None else options.head.played(opened)


def _fitting(capture: Capture, avatar: Avatar) -> Capture:
    if not np.array_equal(capture.faces, avatar.faces):
        raise StgaError(f"{capture.root}: its mesh has other triangles than the one this avatar was trained on")
    return capture
