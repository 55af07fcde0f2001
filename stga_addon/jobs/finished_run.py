"""What is added to the avatar of a finished run, light and colors for other renderers, and its
quality on a split."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..avatar.file import Avatar, AvatarLight, read_avatar, write_avatar
from ..capture.camera import central_camera
from ..capture.color import srgb_to_linear
from ..capture.model import Capture
from ..errors import StgaError
from ..export.splat_files import read_splats
from ..files import write_json
from ..light.environment import read_hdr, split_environment
from ..options import like, option
from ..progress import Log, Progress, Report, Written, ignore
from ..training.run import folder as run_folder
from ..training.run.folder import AVATAR, WORLD_FILE

if TYPE_CHECKING:
    from ..light.estimate import Known
    from ..training.evaluate.metrics import Quality


@dataclass(frozen=True)
class Relight:
    """Estimate the light of a run's capture, so that the lights of a scene can take its place."""

    run: Path = option("folder of a run", flag="RUN")
    light: Path | None = option(
        "environment of the studio, instead of an estimate", None, metavar="FILE.hdr"
    )
    card: tuple[float, float, float] | None = option(
        "sRGB in 0…1 of an 18 % gray card at the face that faces the central camera: level and "
        "white balance",
        None,
        0,
        1,
        flag="--gray-card",
        metavar="R,G,B",
    )
    flame: Path | None = option("FLAME model file, if it has moved", None, metavar="FILE")
    capture: Path | None = option("the run's capture, if it has moved", None)

    def check(self) -> None:
        """Raise StgaError where light and card say the same."""
        if self.light is not None and self.card is not None:
            raise StgaError("--gray-card: has no effect with --light, whose level is known")


def relight(request: Relight, report: Report, log: Log) -> Written:
    """Write the light, estimated or known, into the run's avatar file. Raises StgaError."""
    from ..light.estimate import Known

    folder = request.run
    capture = run_folder.open_refined(folder, request.capture, request.flame)
    known = Known()
    if request.light is not None:
        known = Known(radiance=split_environment(read_hdr(request.light), max_suns=0)[0])
    elif request.card is not None:
        card = srgb_to_linear(np.array(request.card))
        if not card.min() > 0:
            raise StgaError(f"--gray-card: expected three numbers above 0, got {request.card}")
        cameras = list({view.camera_index: view.camera for view in capture.all_views}.values())
        if not cameras:
            raise StgaError(f"{capture.root}: has no camera that a gray card could face")
        toward = cameras[central_camera(cameras)].position - capture.neutral.mean(0)
        known = Known(card=card[None], toward=(toward / np.linalg.norm(toward))[None])
    return Written(folder / AVATAR, add_light(folder / AVATAR, capture, known, report))


def add_light(
    avatar_file: Path, capture: Capture, known: "Known | None" = None, report: Report = ignore
) -> tuple[str, ...]:
    """Write the light of a capture into a run's avatar file; what there is to say. Raises
    StgaError, also while another process works on the run."""
    from ..light.estimate import Known, estimate_light
    from ..training.evaluate.metrics import known_exposure
    from ..training.optimize.surface import Surface
    from ..training.optimize.unseen_sides import unseen_sides

    with run_folder.locked(avatar_file.parent):
        avatar = read_avatar(avatar_file)
        exposure = known_exposure(avatar.settings.get("exposure") or (), ())
        known = replace(known or Known(), exposure=exposure)
        has_views = bool(capture.views.get("train"))
        hair = unseen_sides(Surface(capture)).is_hair if has_views else None
        light = estimate_light(capture, known, report, hair)
        write_avatar(avatar_file, replace(avatar, light=light))
    return describe_light(light)


@dataclass(frozen=True)
class MakeExact:
    """Fit a run's avatar to renderers that blend in linear light: its native splats in Cycles and
    EEVEE, and USD; seconds."""

    run: Path = like(Relight, "run")
    flame: Path | None = like(Relight, "flame")
    capture: Path | None = like(Relight, "capture")


def make_exact(request: MakeExact, report: Report, log: Log) -> Written:
    """Write what was fitted into the run's avatar file, beside what was trained. Raises StgaError,
    also while another process works on the run."""
    from ..render.linear_fit import fit_linear

    path = request.run / AVATAR
    capture = run_folder.open_refined(request.run, request.capture, request.flame)
    with run_folder.locked(request.run):
        avatar = read_avatar(path)
        write_avatar(path, replace(avatar, linear_base=fit_linear(avatar, capture, report)))
    return Written(path)


def describe_light(light: AvatarLight) -> tuple[str, ...]:
    """Lines about where a light is from and how well it explains the capture."""
    source = {"file": "from a file", "gray_card": "estimated, level by a gray card"}
    found = f"recorded colors differ from it by {light.residual:.1%}"
    line = f"light: {source.get(light.source, light.source)}; {found}"
    if not light.damping:
        return (line,)
    damped = f"albedo is pulled to its mean by {light.damping:.0%} (docs/light.md)"
    return line, f"warning: the capture's light is too hard to be taken away; {damped}"


@dataclass(frozen=True)
class Evaluate:
    """Measure PSNR, SSIM and LPIPS of a run's avatar on held-out views; its folder keeps them."""

    run: Path = like(Relight, "run")
    split: str = option("views to measure on", "val", choices=("train", "val", "test"))
    flame: Path | None = like(Relight, "flame")
    capture: Path | None = like(Relight, "capture")


def measure_run(
    folder: Path, avatar: Avatar, capture: Capture, split: str, matched: bool | None = None
) -> "tuple[Quality, Quality | None]":
    """Quality of a run's avatar on a split of its capture, as `open_run` opens it, with heads as
    they were tracked; and with those of unseen timesteps fitted by the avatar to the very images
    that it is measured by, None where none of the split's are. matched: as in `evaluate_avatar`.
    Raises StgaError."""
    from ..training.evaluate.metrics import evaluate_avatar

    tracked = run_folder.with_refined_tracking(capture, folder, fitted=False)
    quality = evaluate_avatar(avatar, tracked, split, True, matched)
    fitted = run_folder.with_refined_tracking(tracked, folder)
    if tracked.flame is None or fitted.flame is None:
        return quality, None
    before = tracked.flame.frame
    after = fitted.flame.frame
    timesteps = {view.timestep for view in capture.views[split]}
    if all(np.array_equal(after(t).parameters, before(t).parameters) for t in timesteps):
        return quality, None
    return quality, evaluate_avatar(avatar, fitted, split, True, matched)


def evaluate(request: Evaluate, report: Report, log: Log) -> Written:
    """Measure PSNR, SSIM and LPIPS; also with the heads that the avatar has fitted, where it did.
    Raises StgaError."""
    from ..capture.usable_views import with_usable_views
    from ..training.evaluate.metrics import psnr_recorded, with_fitted_heads

    folder = request.run
    split = request.split
    report(Progress(stage="Evaluating"))
    capture = run_folder.open_run(folder, request.capture, request.flame).capture
    views = capture.views.get(split, ())
    if not views:
        raise StgaError(f"{capture.root}: has no views in the split '{split}'")
    capture, left_out = with_usable_views(capture)
    for sentence in left_out:
        log(f"warning: {sentence}")
    views = capture.views[split]
    if not views:
        raise StgaError(f"{capture.root}: shows nobody in the split '{split}'")
    avatar = read_avatar(folder / AVATAR)
    quality, fitted = measure_run(folder, avatar, capture, split)
    if (folder / WORLD_FILE).is_file():
        world = read_splats(folder / WORLD_FILE)
        tracked = run_folder.with_refined_tracking(capture, folder, fitted=False)
        recorded = psnr_recorded(avatar, world, tracked, split)
        quality = replace(quality, psnr_recorded=recorded)
    path = folder / f"quality_{split}.json"
    figures = with_fitted_heads(quality.as_json(), {} if fitted is None else fitted.as_json())
    write_json(path, {"views": len(views), **figures})
    heads = "" if fitted is None else "heads as tracked, "
    lines = [f"{split}: {len(views)} views, {heads}{_describe(quality)}"]
    if fitted is not None:
        lines.append(f"  heads fitted by the avatar to these images: {_describe(fitted)}")
    for region, name in (("mask", "inside the head mask"), ("moving", "in the moving region")):
        if region in quality.regions:
            lines.append(f"  {name}: {_describe(quality.regions[region])}")
    for psnr, how in (
        (quality.psnr_recorded, "in front of its world, against whole images as recorded"),
        (quality.psnr_unmatched, "exposure of each view fitted inside the mask; without"),
    ):
        if psnr is not None:
            lines.append(f"  {how}: PSNR {psnr:.3f} dB")
    if quality.lpips is None:
        from ..training.evaluate.lpips import MIN_SIDE_PX

        weights = "its weights, whose file STGA_LPIPS names (docs/dependencies.md),"
        lines += [
            f"LPIPS was not measured: it needs {weights}",
            f"and images of at least {MIN_SIDE_PX} x {MIN_SIDE_PX} pixels",
        ]
    return Written(path, tuple(lines))


def _describe(quality: "Quality") -> str:
    lpips = "" if quality.lpips is None else f", LPIPS {quality.lpips:.4f}"
    return f"PSNR {quality.psnr:.3f} dB, SSIM {quality.ssim:.4f}{lpips}"
