"""The commands: the dataclasses whose fields are their options, what they do with them, and the
progress of that on a terminal."""

import os
import sys
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field, make_dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ..avatar.file import read_avatar
from ..avatar.observed import observed_sides
from ..capture.coverage import capture_coverage
from ..capture.model import Capture, summarize_capture
from ..capture.open import has_mesh_files, is_capture, needs_no_flame, open_capture
from ..capture.other_input import other_input
from ..capture.selection import SelectionOptions
from ..errors import StgaError, printable
from ..export.formats import FORMATS
from ..export.splat_files import is_splats, read_splats
from ..files import is_file, open_npz, write_npz
from ..format import describe_figures, describe_left, format_table
from ..jobs.analyze import Analyze, Select, TimePresets, holds_avatar
from ..jobs.avatar_source import OpenHead, avatar_path
from ..jobs.convert_motion import ConvertMotion
from ..jobs.export import Export
from ..jobs.finished_run import Evaluate, MakeExact, Relight
from ..jobs.render import Render
from ..jobs.table import Request, Result
from ..jobs.track import (
    CAPTURE_FOLDER,
    QUICK,
    QUICK_S,
    RUN_FOLDER,
    MakeAvatar,
    Track,
    read_inputs,
)
from ..jobs.train import Extend, Refine, Resume, Selected, Train
from ..options import (
    add_options,
    flag_of,
    given_options,
    like,
    option,
    option_fields,
    refuse_useless,
    serves,
)
from ..progress import Clock, Progress, ignore
from ..tracking.folder import describe_focal_length
from ..training.run.folder import AVATAR, Run, claimed_folder, has_run, open_run, read_run
from ..training.settings import TrainingSettings, make_settings
from .batch import BatchOptions, EngineOptions, run_batch_command

if TYPE_CHECKING:
    from tqdm import tqdm

BLEND = "avatar.blend"
# Budgets where none is given
TRAIN_SECONDS = 120.0
REFINE_SECONDS = 20.0
EXTEND_SECONDS = 60.0


LAYOUT = "{desc}{percentage:3.0f}%|{bar}| {elapsed}{postfix}"


def carry_out(request: Request, with_bar: bool = True) -> Result:
    """Carry out the request with a progress bar, and print what it says; raises as `perform`."""
    from ..jobs.perform import perform

    with ProgressBar() as bar:
        result = perform(request, bar.report if with_bar else ignore, bar.log)
    for line in getattr(result, "lines", ()):
        print(printable(line))
    return result


class ProgressBar(ExitStack[None]):
    """A bar on stderr with stage and figures; what is said or logged goes above it."""

    _bar: "tqdm[Any] | None" = None
    _clock: Clock
    _stage = ""

    def __exit__(self, *details: Any) -> None:
        if self._bar is not None:
            # a bar of work that failed before it began would stand above the reason
            self._bar.leave = self._bar.n > 0
        super().__exit__(*details)

    def report(self, progress: Progress) -> bool:
        if self._bar is None:
            from tqdm import tqdm
            from tqdm.contrib.logging import logging_redirect_tqdm

            bar = tqdm(total=1.0, bar_format=LAYOUT, mininterval=0.5, dynamic_ncols=True)
            self._bar = self.enter_context(bar)
            self._clock = Clock()
            self.enter_context(logging_redirect_tqdm())
        self._bar.set_description(progress.stage, refresh=progress.stage != self._stage)
        self._stage = progress.stage
        figures = self._clock.reported(progress)
        parts = [describe_left(figures), *describe_figures(figures), printable(progress.detail)]
        self._bar.set_postfix_str("; ".join(filter(None, parts)), refresh=False)
        self._bar.update(progress.fraction - self._bar.n)
        return False

    def log(self, line: str) -> None:
        """Print a line above the bar."""
        line = printable(line)
        if self._bar is None:
            print(line)
            return
        self._bar.clear()
        print(line, flush=True)
        sys.stderr.flush()


@dataclass(frozen=True)
class Command:
    """A command.

    about      what it does; the first sentence is its line in the list of commands
    run        carries it out, with the head of the open .blend file where it stands in for what is
               not named
    options    dataclasses whose fields are its options; a tuple: and which of them
    may_lack   fields without a default that need not be given
    uses_head  whether the open file's capture and avatar stand in for those that are not named
    leaves     option -> those that have an effect beside it; others are refused
    """

    about: str
    run: Callable[[Namespace, OpenHead | None], object]
    options: tuple[Any, ...]
    may_lack: tuple[str, ...] = ()
    uses_head: bool = False
    leaves: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def kinds(self) -> list[Any]:
        """The dataclasses whose fields are options."""
        return [item[0] if isinstance(item, tuple) else item for item in self.options]

    def add_arguments(self, parser: ArgumentParser, head: OpenHead | None) -> None:
        may_lack = [*self.may_lack]
        if self.uses_head and head is not None:
            may_lack += ["capture"] if head.avatar is None else ["capture", "source"]
        for item in self.options:
            kind, *names = item if isinstance(item, tuple) else (item,)
            add_options(parser, kind, *names, may_lack=may_lack)

    def carry_out(self, options: Namespace, head: OpenHead | None) -> None:
        """Run it. Where a head is open, what it holds stands in for what is not named."""
        head = head if self.uses_head else None
        if head is not None and getattr(options, "source", "") is None:
            options.source = head.avatar
        self.refuse_useless(options)
        if head is not None and options.capture is not None:
            head = None
        elif head is not None:
            if serves(options, "capture", *self.kinds):
                options.capture = head.capture
            if options.flame is None and serves(options, "flame", *self.kinds):
                options.flame = head.flame
            if "source" not in options:  # of an avatar's cameras: as in its training
                options.principal_point = options.principal_point or head.principal_point
        self.run(options, head)

    def refuse_useless(self, options: Namespace) -> None:
        """Raise StgaError for the first option that is given without effect."""
        specs = {spec.name: spec for kind in self.kinds for spec in option_fields(kind)}
        for mode, left in self.leaves.items():
            if getattr(options, mode) is None:
                continue
            for name, spec in specs.items():
                if name not in (mode, *left) and getattr(options, name, None) not in (None, []):
                    problem = f"has no effect with {flag_of(specs[mode])}"
                    raise StgaError(f"{flag_of(spec)}: {problem}")
        refuse_useless(options, *self.kinds)
        # none of the request's needs: Blender's preferences give each capture a model
        flame, capture, motion = (
            getattr(options, name, None) for name in ("flame", "capture", "motion")
        )
        if flame and capture and motion is None and needs_no_flame(capture):
            raise StgaError(f"--flame: has no effect on {capture}, which is read without a model")
        if getattr(options, "zero_pose", None) and capture and has_mesh_files(capture):
            raise StgaError(f"--zero-pose: has no effect on {capture}, whose meshes have no pose")


def _about(kind: Any) -> str:
    """A request's docstring without its fields."""
    return str(kind.__doc__).partition("\n\n")[0]


def _asking(kind: Any, with_bar: bool = True, **more: Any) -> Command:
    """A command that makes a request of a kind from its options, and carries it out."""
    missing = dict.fromkeys(more.get("may_lack", ()))

    def run(options: Namespace, head: OpenHead | None) -> None:
        carry_out(kind(**{**missing, **given_options(options, kind)}), with_bar)

    return Command(_about(kind), run, (kind,), **more)


def _lone(name: str, kind: Any, help: str, default: Any, metavar: str = "") -> Any:
    """A dataclass of one option that no request has."""
    return make_dataclass("Lone", [(name, kind, option(help, default, metavar=metavar))])


def _train(options: Namespace, head: OpenHead | None) -> None:
    given = given_options(options, Train)
    given["selection"] = None if head is None else head.selection()
    if options.resume:
        _refuse_changes(options, read_run(options.run))
        carry_out(Resume(**given))
    else:
        carry_out(Train(settings=_settings(options), **given))


def _settings(options: Namespace) -> TrainingSettings:
    """The settings of a new run. Raises StgaError for options that do not go together."""
    given = given_options(options, TrainingSettings)
    paper = given.get("schedule") == "paper"
    other_method = given.get("strategy") == "gaussian-avatars"
    for named, is_replaced, by in (
        ("--schedule paper", paper and other_method, "--strategy gaussian-avatars"),
        ("--preset", "preset" in given and paper, "--schedule paper"),
        ("--preset", "preset" in given and other_method, "--strategy gaussian-avatars"),
    ):
        if is_replaced:
            raise StgaError(f"{named}: cannot be combined with {by}, which has settings of its own")
    if not {"iterations", "seconds", "preset"} & given.keys():
        given["seconds"] = TRAIN_SECONDS
    if not (paper or other_method):
        given.setdefault("effects", {})
    settings = make_settings(**given)
    selection = given_options(options, SelectionOptions)
    if selection and settings.strategy != "selective":
        raise StgaError(
            "--threshold: has no effect without --strategy selective, or --schedule paper"
        )
    return replace(settings, selection=replace(settings.selection, **selection))


def _refuse_changes(options: Namespace, run: Run) -> None:
    """Raise StgaError for an option that differs from what the run to be resumed began with."""
    for began_with in (run.settings, run.settings.selection):
        for spec in option_fields(type(began_with)):
            value = getattr(began_with, spec.name)
            given = getattr(options, spec.name, None)
            if given not in (None, value) and spec.name != "effects":
                problem = f"this run began with {value}, which cannot change; use another --out"
                raise StgaError(f"{flag_of(spec)}: {problem}")
    decided = {decision.effect: "on" if decision.on else "off" for decision in run.effect_plan}
    for name, choice in options.effects or ():
        if name not in decided or choice not in ("auto", decided[name]):
            problem = "differs from what was decided for this run; use another --out"
            raise StgaError(f"--effect {name}={choice}: {problem}")


@dataclass(frozen=True)
class AvatarOptions:
    footage: tuple[Path, ...] = option(
        "a video, or a folder of images or videos; several, or a folder that holds several, are "
        "takes of one person",
        flag="FOOTAGE",
    )
    out: Path = option("folder of capture, run and file", flag="--out", metavar="DIR")
    quick: bool = option(
        f"a first look: at most {QUICK['most']} frames at half size, half a minute of training",
        False,
    )
    no_blend: bool = option("write no .blend file", False)


def _avatar(options: Namespace, head: OpenHead | None) -> None:
    first, *takes = _takes(options)
    options.footage = first
    tracked = {"model": None, **(QUICK if options.quick else {}), **given_options(options, Track)}
    if options.quick and not {options.seconds, options.iterations, options.preset} - {None}:
        options.seconds = QUICK_S
    settings = _settings(options)
    out = options.out
    run = options.out / RUN_FOLDER
    if has_run(run):
        _refuse_changes(options, read_run(run))
    track = Track(**{**tracked, "out": out / CAPTURE_FOLDER})
    device = {} if options.device is None else {"device": options.device}
    carry_out(MakeAvatar(track, Train(run, track.out, settings, **device), tuple(takes)))
    if options.no_blend:
        return
    if find_spec("bpy") is None:
        print(
            "warning: no .blend file: this Python has no bpy (install bpy, or run the command "
            "in Blender)"
        )
        return
    from ..training.run.folder import with_refined_tracking

    print(f"blender: {write_blend(out, lambda capture: with_refined_tracking(capture, run))}")


def _takes(options: Namespace) -> list[Path]:
    """The takes that are given, or that lie in the only folder which is."""
    given: list[Path] = options.footage
    if len(given) > 1 or options.cameras is not None:
        return given
    from ..tracking.footage.takes import takes_in

    return takes_in(given[0])


def write_blend(
    out: Path, refine: Callable[[Capture], Capture], finish: Callable[[Any], object] = bool
) -> Path:
    """Write the .blend file of what `stga avatar` left in `out`; needs bpy, whose open file it
    replaces.

    refine: gives the capture's heads as training refined them; finish: called with the head before
    saving. Raises StgaError.
    """
    from ..export.playback import playback_fps
    from ..scene.avatar_scene import set_up_head, show_on_head, show_world
    from ..scene.objects import empty_file, save_file
    from ..tracking.folder import is_flame

    inputs = read_inputs(out)
    run = out / RUN_FOLDER
    flame = Path(inputs["model"]) if inputs["model"] and is_flame(out / CAPTURE_FOLDER) else None
    capture = open_capture(out / CAPTURE_FOLDER, flame)
    avatar = read_avatar(run / AVATAR)
    empty_file()
    head = set_up_head(refine(capture))
    show_on_head(avatar, head, f"//{RUN_FOLDER}/{AVATAR}", playback_fps(capture, numbered=True))
    show_world(run / AVATAR, head)
    finish(head)
    save_file(out / BLEND)
    return Path(out / BLEND)


# Continuing a finished run


def _continuing(kind: Any, seconds: float) -> Command:
    """A command that continues a finished run in one of its own, or resumes such a run."""

    def run(options: Namespace, head: OpenHead | None) -> None:
        given = given_options(options, kind)
        if options.resume:
            if read_run(given["parent"]).continuation is None:
                problem = "does not continue another run; resume it with `stga train --resume`"
                raise StgaError(f"{given['parent']}: {problem}")
            same = {name: given[name] for name in ("flame", "device") if name in given}
            carry_out(Resume(given["parent"], **same))
        else:
            if not {"seconds", "iterations"} & given.keys():
                given["seconds"] = seconds
            with ExitStack() as claimed:
                if "run" not in given:
                    read_run(options.parent)  # before anything is made beside it
                    given["run"] = claimed.enter_context(claimed_folder(options.parent))
                carry_out(kind(**given))

    resume = _lone("resume", bool, "RUN was stopped: continue it", False)
    leaves = {"resume": ("parent", "flame", "device")}
    return Command(_about(kind), run, (kind, resume), may_lack=("run", "captures"), leaves=leaves)


def _write_selection(request: Select, path: Path | None) -> None:
    """Carry out the request; write timestep -> triangles into an .npz where asked to."""
    found = carry_out(request, with_bar=False)
    assert isinstance(found, Selected)
    if path is not None:
        faces = {f"{timestep:05d}": faces for timestep, faces in found.selection.items()}
        write_npz(path, faces, compressed=True)


def _is_motion(path: Path) -> bool:
    """Whether an .npz is no avatar. Raises StgaError for a damaged one."""
    if path.suffix != ".npz" or not is_file(path):
        return False
    with open_npz(path) as file:
        return "header" not in file.entries


def _info(options: Namespace, head: OpenHead | None) -> None:
    path = options.capture
    if holds_avatar(path) and not _is_motion(path):
        from ..jobs.finished_run import describe_light

        avatar = read_avatar(avatar_path(path))
        light: tuple[str, ...] = ("light: unknown; `stga relight RUN` estimates it",)
        if avatar.light:
            light = describe_light(avatar.light)
        rows = [("splats", f"{len(avatar.splats)}, {len(avatar.faces)} triangles")]
        sides = observed_sides(avatar)
        rows += [("sides", sides)] if sides else []
        rows += _coverage_by_take(path, options.flame)
        rows += [(name, text.strip()) for name, _, text in (line.partition(":") for line in light)]
        print(*format_table(rows), sep="\n")
        return
    other = None if is_capture(path) else other_input(path)
    if other is not None:
        rows = [("path", str(path)), ("what", other.what), ("next", f"it {other.plan}")]
        if other.is_rendered:
            rows.insert(2, ("splats", str(len(read_splats(path)))))
        rows += [
            ("command" if n == 0 else "or", command) for n, command in enumerate(other.commands[:2])
        ]
        print(*format_table(rows), sep="\n")
        return
    request = Analyze(**given_options(options, Analyze))
    found: Any = carry_out(request, with_bar=False)
    capture = open_capture(path, request.flame, request.principal_point)
    rows = summarize_capture(capture)
    rows.append(("filmed", capture_coverage(capture).text))
    lens = describe_focal_length(capture.root)
    rows += [("focal length", lens)] if lens else []
    print(*format_table(rows), sep="\n")
    if found.plan:
        from ..training.effects.plan import describe_effects

        print("", *format_table(describe_effects(found.plan)), sep="\n")


def _coverage_by_take(run: Path, flame: Path | None) -> list[tuple[str, str]]:
    """What each take of a run filmed; nothing of an avatar file, or where a capture has gone."""
    if not has_run(run):
        return []
    try:
        takes = open_run(run, flame=flame).takes
    except StgaError as error:
        return [("takes", f"unknown ({error})")]
    names = [f"take {number + 1}" if len(takes) > 1 else "filmed" for number in range(len(takes))]
    return [
        (name, f"{take.root.name}: {capture_coverage(take).text}")
        for name, take in zip(names, takes, strict=True)
    ]


@dataclass(frozen=True)
class RenderOutput:
    out: Path | None = option(
        "folder for PNGs; required without --video", None, metavar="DIR", group="output"
    )
    video: Path | None = option(
        "every timestep from one camera, as MP4", None, metavar="FILE.mp4", group="output"
    )


def _render(options: Namespace, head: OpenHead | None) -> None:
    output = options.video or options.out
    if output is None:
        raise StgaError("--out: is missing; expected it, or --video")
    given = {**given_options(options, Render), "output": output, "video": options.video is not None}
    if head is not None and options.motion is None and not is_splats(options.source):
        given["played"] = head.played()
    carry_out(Render(**given))


def _export(options: Namespace, head: OpenHead | None) -> None:
    given = given_options(options, Export)
    if head is not None:
        if serves(options, "fps", Export):
            given.setdefault("fps", head.fps)
        moves = FORMATS[options.file_format].source != "frame" or options.timestep is not None
        if options.motion is None and moves:
            given["played"] = head.played()
    carry_out(Export(**given))


@dataclass(frozen=True)
class PerformOptions:
    folder: Path = option("folder that holds request.json", flag="FOLDER")
    resume: bool = option("continue what this request began in its output folder, if it did", False)
    threads: int | None = like(
        EngineOptions, "threads", help="threads to compute on (default: all processors)"
    )


def _perform(options: Namespace, head: OpenHead | None) -> None:
    if options.threads is not None:
        os.environ["OMP_NUM_THREADS"] = str(options.threads)  # for torch, which is not imported yet
        if find_spec("numba") is not None:  # else it is work that needs no kernels
            import_module("..raster.cpu.threads", __package__).set_threads(options.threads)
    from ..jobs.perform import perform_in_folder

    # without a terminal started by Blender, which reads the status in the folder
    with ProgressBar() as bar:
        report = bar.report if sys.stderr.isatty() else ignore
        perform_in_folder(options.folder, bar.log, report, bool(options.resume))


TRACKED_AS = [s.name for s in option_fields(Track) if s.name not in ("footage", "out", "avatar")]
"""Options of `stga track` that `stga avatar` takes."""
COMMANDS = {
    "avatar": Command(
        "Make an avatar from footage: track, train, and write a report and a .blend file. Called "
        "again with the same arguments, it continues where it was interrupted.",
        _avatar,
        (
            AvatarOptions,
            (Track, *TRACKED_AS),
            TrainingSettings,
            (SelectionOptions, "threshold"),
            (Train, "device"),
        ),
        may_lack=("model",),
    ),
    "track": _asking(Track, may_lack=("model",)),
    "train": Command(
        _about(Train),
        _train,
        (
            Train,
            TrainingSettings,
            (SelectionOptions, "threshold"),
            _lone("resume", bool, "continue the run in the folder", False),
        ),
        uses_head=True,
    ),
    "refine": _continuing(Refine, REFINE_SECONDS),
    "extend": _continuing(Extend, EXTEND_SECONDS),
    "relight": _asking(Relight),
    "exact": _asking(MakeExact),
    "perform": Command(
        "Carry out the request that a folder holds, as a worker of Blender's panel or of a render "
        "farm does. The folder holds request.json; status, previews and result are written beside "
        "it.",
        _perform,
        (PerformOptions,),
    ),
    "batch": Command(
        "Carry out a plan of many jobs, or train many captures, on this machine or on the engine "
        "that is there.",
        run_batch_command,
        (BatchOptions, EngineOptions),
    ),
    "render": Command(_about(Render), _render, (RenderOutput, Render), uses_head=True),
    "eval": _asking(Evaluate, with_bar=False),
    "select": Command(
        _about(Select),
        lambda options, _: _write_selection(Select(**given_options(options, Select)), options.out),
        (Select, _lone("out", Path | None, "also write timestep -> triangles", None, "NPZ")),
        uses_head=True,
    ),
    "export": Command(_about(Export), _export, (Export,), uses_head=True),
    "drive": _asking(ConvertMotion),
    "info": Command(
        _about(Analyze),
        _info,
        (Analyze,),
        uses_head=True,
    ),
    "presets": _asking(TimePresets, with_bar=False, uses_head=True),
}
