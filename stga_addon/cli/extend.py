"""Extend a finished avatar by further takes of the same head, in a run of its own."""

from argparse import ArgumentParser, Namespace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..errors import StgaError
from ..files import write_npz
from ..requests.open_head import OpenHead
from .arguments import real_number, usable_path
from .continuing import add_continued_run, budget_of, continuation_folder, resume_continuation
from .train import train_run

if TYPE_CHECKING:
    from ..training.run.request import Extension

NAME, HELP = "extend", "extend a finished avatar by further takes of the same head"
DEFAULT_SECONDS = 60.0


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    add_continued_run(parser, DEFAULT_SECONDS)
    parser.add_argument("takes", nargs="*", type=usable_path, metavar="CAPTURE", help="captures of the same head")
    parser.add_argument(
        "--growth",
        type=real_number,
        default=0.0,
        metavar="SHARE",
        help="splats to add, as a share of those on the triangles that the takes need",
    )
    parser.add_argument(
        "--select-only",
        type=usable_path,
        metavar="NPZ",
        help="only write which triangles it would train: timestep of the take -> triangles",
    )


def run(options: Namespace) -> None:
    from ..training.effects.plan import with_effects_of_takes
    from ..training.run.continuation import prepare_extension
    from ..training.run.request import Extension

    if options.resume:
        resume_continuation(options)
        return
    if not options.takes:
        raise StgaError("CAPTURE: is missing; expected one or more takes to extend the run by")
    wanted = Extension(options.run_folder, tuple(options.takes), options.growth, **budget_of(options, DEFAULT_SECONDS))
    if options.select_only:
        _write_selection(options.select_only, wanted, options.flame)
        return
    folder, device = continuation_folder(options)
    prepared = prepare_extension(wanted, device, options.flame)
    assert prepared.selection is not None
    share = np.any(list(prepared.selection.values()), axis=0).mean()
    print(f"takes: {1 + len(prepared.run.takes)}; the new ones need {share:.0%} of the triangles")
    run = with_effects_of_takes(prepared.run, prepared.capture)
    for before, now in zip(prepared.run.effect_plan, run.effect_plan, strict=True):
        if now.on != before.on:
            print(f"{now.effect}  {now}")
    train_run(folder, run, prepared.capture, prepared.selection, resume=False, falls_back=options.device == "auto")


def _write_selection(path: Path, wanted: "Extension", flame: Path | None) -> None:
    """Write and print which triangles of each frame of the take would be trained."""
    from ..training.run.continuation import prepare_extension

    if len(wanted.captures) != 1:
        raise StgaError(f"--select-only: expected one CAPTURE, got {len(wanted.captures)}")
    prepared = prepare_extension(wanted, "cpu", flame)
    assert prepared.selection is not None
    start = prepared.run.takes[-1].start
    selection = {timestep - start: faces for timestep, faces in prepared.selection.items()}
    write_npz(path, {f"{timestep:05d}": faces for timestep, faces in selection.items()}, compressed=True)
    for timestep, faces in selection.items():
        print(f"{timestep:5d}  {faces.mean():6.1%}")
