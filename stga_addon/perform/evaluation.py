"""Evaluation of a finished run on a split."""

from dataclasses import replace

from ..avatar.file import read_avatar
from ..errors import StgaError
from ..export.ply import read_ply
from ..files import write_json
from ..progress import Progress, Report, Say
from ..requests.results import Written
from ..requests.values import Evaluate
from ..training.evaluate.lpips import MIN_SIDE_PX
from ..training.evaluate.metrics import Quality, evaluate_avatar, psnr_recorded
from ..training.run.folder import AVATAR, WORLD_FILE
from ..training.run.open_run import open_run
from ..training.run.tracking_file import with_refined_tracking


def evaluate_run(request: Evaluate, report: Report, say: Say) -> Written:
    """Measure PSNR, SSIM and LPIPS, and write them into the run's folder; of timesteps without training views, also
    with the heads as they were before the avatar tracked them. Raises StgaError."""
    folder, split = request.run, request.split
    report(Progress(stage="Evaluating"))
    tracked = open_run(folder, request.capture, request.flame).capture
    capture = with_refined_tracking(tracked, folder)
    views = capture.views.get(split, ())
    if not views:
        raise StgaError(f"{capture.root}: has no views in the split '{split}'")
    avatar = read_avatar(folder / AVATAR)
    quality = evaluate_avatar(avatar, capture, split, perceptual=True)
    if (folder / WORLD_FILE).is_file():
        recorded = psnr_recorded(avatar, read_ply(folder / WORLD_FILE), capture, split)
        quality = replace(quality, psnr_recorded=recorded)
    path = folder / f"quality_{split}.json"
    write_json(path, {"views": len(views), **quality.as_json()})
    lines = [f"{split}: {len(views)} views, {_describe(quality)}", *_details(quality)]
    unseen = {view.timestep for view in views} - {view.timestep for view in capture.views.get("train", ())}
    if unseen and capture is not tracked:
        before = _describe(evaluate_avatar(avatar, tracked, split))
        lines.insert(1, f"  with heads tracked by the avatar, its splats fixed; as tracked before: {before}")
    return Written(path, tuple(lines))


def _details(quality: Quality) -> list[str]:
    lines = [
        f"  {name}: {_describe(quality.regions[region])}"
        for region, name in (("mask", "inside the head mask"), ("moving", "in the moving region"))
        if region in quality.regions
    ]
    if quality.psnr_recorded is not None:
        lines.append(f"  in front of its world, against whole images as recorded: PSNR {quality.psnr_recorded:.3f} dB")
    if quality.psnr_unmatched is not None:
        lines.append(f"  exposure of each view fitted inside the mask; without: PSNR {quality.psnr_unmatched:.3f} dB")
    if quality.lpips is None:
        weights = "its weights, whose file STGA_LPIPS names (docs/dependencies.md),"
        lines += [
            f"LPIPS was not measured: it needs {weights}",
            f"and images of at least {MIN_SIDE_PX} x {MIN_SIDE_PX} pixels",
        ]
    return lines


def _describe(quality: Quality) -> str:
    lpips = "" if quality.lpips is None else f", LPIPS {quality.lpips:.4f}"
    return f"PSNR {quality.psnr:.3f} dB, SSIM {quality.ssim:.4f}{lpips}"
