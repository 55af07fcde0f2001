"""Making an avatar from footage, as requests ask for it: tracking, then training."""

import math
from dataclasses import replace
from time import perf_counter

from ..errors import StgaError
from ..files import read_json
from ..format import format_duration
from ..progress import Progress, Report, Say
from ..report.run_summary import CURVE
from ..requests.avatar_folder import INPUTS, check_inputs, write_inputs
from ..requests.results import Written
from ..requests.values import MakeAvatar, Resume, Track
from ..tracking.folder import REPORT_FILE, SHEET_FILE, is_flame, is_written
from ..training.run.folder import AVATAR, has_run
from .tracking import perform_tracking
from .training import perform_training

TRACKING_SHARE = 0.5
"""Of the progress."""


def make_avatar(request: MakeAvatar, report: Report, say: Say) -> Written:
    """Track unless that was done, and train or continue the run. Raises StgaError where the folder began with other
    inputs, and as both do."""

    def report_tracking(progress: Progress) -> bool:
        share, stage = TRACKING_SHARE * progress.share, f"Tracking: {progress.stage}"
        figures = dict(progress.figures())
        figures["left_s"] = figures.get("left_s", math.nan) + (request.train.settings.seconds or 0.0)
        return report(replace(progress, share=share, stage=stage, figures=lambda: figures))

    def report_training(progress: Progress) -> bool:
        return report(replace(progress, share=TRACKING_SHARE + (1 - TRACKING_SHARE) * progress.share))

    begin = perf_counter()
    _track(request.track, report_tracking, say)
    tracked = perf_counter()
    flame = request.track.model if is_flame(request.track.out) else None
    train = replace(request.train, flame=flame)
    resumed = Resume(train.run, train.capture, flame, train.principal_point, train.device, train.selection)
    wanted = resumed if has_run(train.run) else train
    trained = perform_training(wanted, report_training, say)
    end = perf_counter()
    times = f"tracking {format_duration(tracked - begin)}, training {format_duration(end - tracked)}"
    lines = ["", *_tracking_lines(request), *trained.lines, f"time: {times}, in all {format_duration(end - begin)}"]
    return Written(request.train.run / AVATAR, tuple(lines))


def _track(track: Track, report: Report, say: Say) -> None:
    check_inputs(track)
    if is_written(track.out):
        return
    out = track.out.parent
    new = not out.exists()
    write_inputs(track)
    try:
        for line in perform_tracking(track, report, say).lines:
            say(line)
    except StgaError:
        if not track.out.exists():  # nothing was tracked yet, so that the inputs may be mended
            (out / INPUTS).unlink()
            if new:
                out.rmdir()
        raise


def _tracking_lines(request: MakeAvatar) -> list[str]:
    """What the capture's report says. Raises StgaError where it is another file."""
    capture = request.track.out
    report = read_json(capture / REPORT_FILE)
    try:
        errors = report["reprojection_px"]
        timesteps = {timestep for by_timestep in errors.values() for timestep in by_timestep} | set(
            map(str, report["interpolated"])
        )
        lines = [f"warning: {warning}" for warning in report["warnings"]]
        lines += [f"footage: cameras {len(errors)}, timesteps {len(timesteps)}"]
        lines += [f"tracking: reprojection error {report['median_reprojection_px']:.2f} px (median)"]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise StgaError(f"{capture / REPORT_FILE}: is not the report of a tracking ({error!s:.100})") from error
    files = [capture / SHEET_FILE, capture / REPORT_FILE, request.train.run / CURVE]
    return [*lines, f"report: {', '.join(str(path) for path in files if path.exists())}"]
