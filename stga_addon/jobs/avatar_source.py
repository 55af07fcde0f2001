"""What an avatar is posed by: a capture, a motion, or the head of an open .blend file, also as a
folder that another Python reads."""

import logging
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..avatar.file import Avatar, read_avatar
from ..capture.model import Capture
from ..capture.open import open_capture, sequence_capture
from ..capture.transforms import PRINCIPAL_POINTS
from ..driving.open_motion import Motion, MotionOptions, TrainedRange, open_motion, trained_range
from ..errors import StgaError, shorten
from ..files import read_json, read_npz, write_json, write_npz
from ..flame.sequence import motion_of
from ..options import option
from ..progress import Say
from ..schema import from_json, setting, to_json
from ..training.run.folder import AVATAR, open_refined, open_run, read_run, with_refined_tracking


@dataclass(frozen=True)
class Played:
    """What the head of an open .blend file plays in the frames of its scene, however it is
    animated.

    meshes      frame -> (V, 3) meters
    motion      FLAME parameters of these frames, arrays as `motion_of` takes them; None: the head
                has none
    selection   frame -> (F,) bool: what the file's vertex groups train; None without any
    """

    meshes: Mapping[int, np.ndarray]
    motion: Mapping[str, np.ndarray] | None = None
    selection: Mapping[int, np.ndarray] | None = None

    def check(self) -> None:
        """Raise StgaError without any frame."""
        if not self.meshes:
            raise StgaError("played: holds no frame")


Posed = Any
"""A request about a posed avatar, `Render` or `Export`.

source          folder of a run, or avatar file
capture, flame  whose meshes pose it; None: those of the run
played          meshes that stand in for those of the capture
motion          another person's motion, which poses it instead, with `motion_options`; `flame`: its
                model file
"""


def motion_field() -> Any:
    return option(
        "another person's motion at every timestep of it: FLAME parameters (.npz, or a capture), or a performance in "
        "ARKit's shapes (CSV of Live Link Face or Audio2Face, its take folder, JSON, iFacialMocap's text)",
        None, metavar="FILE",
    )  # fmt: skip


def motion_options_field(*needs: str) -> Any:
    return option("motion", default_factory=MotionOptions, needs=needs)


def open_avatar(request: Posed) -> tuple[Avatar, Capture | None]:
    """The avatar of a run folder or file, and the capture that was given or that the run was
    trained on, as an open .blend file's head plays it where the request says so.

    Raises StgaError where the run's own capture has changed, or a given one has other triangles.
    """
    source = request.source
    capture = _run_capture(source, request.capture, request.flame) if source.is_dir() else None
    avatar = read_avatar(avatar_path(source))
    if capture is None and request.capture is not None:
        capture = open_capture(request.capture, request.flame, avatar.principal_point)
        if avatar.settings.get("tracking"):
            what = "was trained on refined meshes, which only its run's folder has"
            logging.getLogger(__name__).warning("warning: %s: %s", source, what)
    if capture is None:
        return avatar, None
    if not np.array_equal(capture.faces, avatar.faces):
        raise StgaError(
            f"{capture.root}: its mesh has other triangles than the one this avatar was trained on"
        )
    return avatar, capture if request.played is None else _as_played(capture, request.played)


def required_capture(capture: Capture | None) -> Capture:
    """Raise StgaError where `open_avatar` found no capture."""
    if capture is None:
        raise StgaError("frames other than the neutral mesh need a capture; give --capture")
    return capture


def timesteps_between(capture: Capture, span: tuple[int, int] | None, say: Say) -> tuple[int, ...]:
    """The capture's timesteps from the first to the last of `span`, inclusive; None: all of them.

    Says so where the span reaches beyond them. Raises StgaError where there is none.
    """
    if span is None:
        return tuple(capture.timesteps)
    first, last = span
    timesteps = tuple(timestep for timestep in capture.timesteps if first <= timestep <= last)
    if not timesteps:
        raise StgaError(f"{capture.root}: has no timestep from {first} to {last}")
    begin, end = min(capture.timesteps), max(capture.timesteps)
    if first < begin or last > end:
        say(f"--frames {first}:{last}: the capture has timesteps {begin} to {end}")
    return timesteps


def avatar_path(source: Path) -> Path:
    """The avatar file that a run folder or an avatar file names."""
    return source / AVATAR if source.is_dir() else source


def _run_capture(folder: Path, given: Path | None, flame: Path | None) -> Capture:
    """The capture of a run, or another one whose meshes are to drive its avatar; with the run's
    refined tracking."""
    if given is None:
        return open_refined(folder, flame=flame)
    run = read_run(folder)
    return with_refined_tracking(
        open_capture(given, flame or run.flame, run.principal_point), folder
    )


def _as_played(capture: Capture, played: Played) -> Capture:
    """The capture with the frames of an open .blend file. Raises StgaError for arrays of another
    head."""
    for name, arrays, shape, kind in (
        ("frame", played.meshes, capture.neutral.shape, "f"),
        ("selection of frame", played.selection or {}, capture.faces.shape[:1], "b"),
    ):
        for frame, array in arrays.items():
            if array.dtype.kind != kind or array.shape != shape or not np.isfinite(array).all():
                expected = f"{'finite numbers' if kind == 'f' else 'bool'} {shape}"
                raise StgaError(
                    f"played: {name} {frame}: expected {expected}, got {array.dtype} {array.shape}"
                )
    flame = None
    if capture.flame is not None and played.motion is not None:
        flame = motion_of(Path("played"), played.motion, capture.flame.model)
        if len(flame.timesteps) != len(played.meshes):
            raise StgaError(
                f"played: motion: expected {len(played.meshes)} frames, got {len(flame.timesteps)}"
            )
    meshes = dict(sorted(played.meshes.items()))
    return replace(capture, timesteps=tuple(meshes), mesh=meshes.__getitem__, flame=flame)


# Motions


def open_avatar_motion(request: Posed, avatar: Avatar, say: Say) -> Motion:
    """The request's motion on its avatar; says how far it is outside the trained range, where that
    is asked for.

    Raises StgaError.
    """
    assert request.motion is not None
    source, options = request.source, request.motion_options
    run = read_run(source) if source.is_dir() else None
    flame = request.flame or (run.flame if run is not None else None)
    trained = None if run is None else _trained(source, request, say)
    if options.stay_trained is not None and trained is None:
        raise StgaError(
            f"--stay-trained: {source} is no run with a FLAME capture, whose motion would be the range"
        )
    motion = open_motion(
        request.motion, flame, avatar.neutral, avatar.faces, options, trained, request.fps
    )
    for line in findings(motion):
        say(line)
    return motion


def motion_capture(request: Posed, motion: Motion, own: Capture | None) -> Capture:
    """The motion as a capture, seen by the cameras of the run's own one."""
    assert request.motion is not None
    views = {} if own is None else own.views
    return replace(
        sequence_capture(request.motion, motion.sequence, request.flame, views), fps=motion.fps
    )


def findings(motion: Motion) -> list[str]:
    """What to say about a motion: rows that were lost, and how far it goes beyond what was
    trained."""
    lines = [f"{motion.lost} rows are missing and were interpolated"] if motion.lost else []
    for part, beyond in motion.outside.items():
        if beyond.any():
            share_outside = 100 * float(np.mean(beyond > 0))
            lines.append(
                f"{part}: {share_outside:.0f} % of the frames are outside the trained range, by up to "
                f"{beyond.max():.1f} of its half width (frame {int(beyond.argmax())})"
            )
    return lines


def _trained(folder: Path, request: Posed, say: Say) -> TrainedRange | None:
    """What the run's capture holds, where the options ask for it; None where it was not tracked
    with FLAME."""
    options = request.motion_options
    if options.neutral == "none" and options.stay_trained is None:
        return None
    try:
        own = open_run(folder, flame=request.flame).capture.flame
    except StgaError as error:
        if options.stay_trained is not None:
            raise
        say(f"{error}; the motion is put on the head without expression, not on its quiet face")
        return None
    return (
        None if own is None else trained_range([own.frame(timestep) for timestep in own.timesteps])
    )


# The head of an open .blend file


FOLDER = "STGA_HEAD"
"""The environment variable that names the folder."""
HEAD, SELECTION, PLAYED = "head.json", "selection.npz", "played.npz"


@dataclass(frozen=True)
class OpenHead:
    """The head of the .blend file that Blender has open: what a command works on where nothing is
    named.

    fps        frames per second of the scene
    selection  what the file's vertex groups train, timestep -> (F,) bool; None without any
    played     what the head plays in the scene's frames
    """

    capture: Path
    flame: Path | None
    principal_point: str
    avatar: Path | None
    fps: float
    selection: Callable[[], Mapping[int, np.ndarray] | None]
    played: Callable[[], Played]


@dataclass(frozen=True)
class _Stored:
    """What head.json holds; fields as of `OpenHead`."""

    capture: Path
    flame: Path | None
    avatar: Path | None
    principal_point: str = setting(choices=PRINCIPAL_POINTS)
    fps: float = setting(above=0)


def write_head(folder: Path, head: OpenHead, played: bool) -> None:
    """Write the head into the folder; `played`: with the meshes that it plays in the scene's
    frames.

    Raises StgaError where the capture cannot be read, or the folder not be written.
    """
    write_json(
        folder / HEAD,
        to_json(_Stored(head.capture, head.flame, head.avatar, head.principal_point, head.fps)),
    )
    selection = head.selection()
    if selection is not None:
        write_npz(
            folder / SELECTION, {str(timestep): faces for timestep, faces in selection.items()}
        )
    if played:
        write_npz(
            folder / PLAYED, {str(frame): mesh for frame, mesh in head.played().meshes.items()}
        )


def read_head(folder: Path) -> OpenHead:
    """The head that `write_head` wrote. Raises StgaError where there is none or it is damaged."""
    path = folder / HEAD
    try:
        stored: _Stored = from_json(_Stored, read_json(path))
    except StgaError as error:
        raise StgaError(f"{path}: is not the head of an open .blend file ({error})") from error

    def selection() -> dict[int, np.ndarray] | None:
        return _read_selection(folder / SELECTION) if (folder / SELECTION).exists() else None

    def played() -> Played:
        return Played(_by_frame(folder / PLAYED), selection=selection())

    return OpenHead(
        stored.capture, stored.flame, stored.principal_point, stored.avatar, stored.fps, selection, played
    )  # fmt: skip


def _read_selection(path: Path) -> dict[int, np.ndarray]:
    """frame -> (F,) bool. Raises StgaError for arrays of another form."""
    selection = _by_frame(path)
    for frame, faces in selection.items():
        if faces.dtype != bool or faces.ndim != 1:
            raise StgaError(
                f"{path}: frame {frame}: expected bool (F,), got {faces.dtype} {faces.shape}"
            )
    return selection


def _by_frame(path: Path) -> dict[int, np.ndarray]:
    """Arrays by the frames that their names are. Raises StgaError for a name that is none."""
    arrays = read_npz(path)
    for name in arrays:
        if not re.fullmatch(r"-?\d{1,9}", name, re.ASCII):
            raise StgaError(f"{path}: expected frames as names, got {shorten(name)}")
    return {int(name): array for name, array in arrays.items()}
