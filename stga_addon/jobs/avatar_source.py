"""What poses an avatar: a capture, a motion, or the head of an open .blend file, or its folder."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..avatar.file import Avatar, read_avatar
from ..capture.model import Capture
from ..capture.open import open_capture, sequence_capture
from ..capture.other_input import SPLAT_SUFFIXES
from ..capture.transforms import PRINCIPAL_POINTS
from ..driving.open_motion import Motion, MotionOptions, check_faces, open_motion, trained_range
from ..errors import StgaError
from ..export.ply import READ_FILES
from ..files import read_json, read_npz, write_json, write_npz
from ..flame.sequence import motion_of
from ..options import Need, option
from ..progress import Log, warn
from ..schema import Arrays, from_json, setting, to_json
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


def motion_field(*needs: Need) -> Any:
    return option(
        "another person's motion at every timestep of it: FLAME parameters (.npz, or a capture), "
        "or a performance in ARKit's shapes (CSV of Live Link Face or Audio2Face, its take folder, "
        "JSON, iFacialMocap's text)",
        None,
        metavar="FILE",
        needs=needs,
    )


def motion_options_field(*needs: Need) -> Any:
    return option("motion", default_factory=MotionOptions, needs=needs)


def open_avatar(request: Posed) -> tuple[Avatar, Capture | None]:
    """The avatar of a run folder or file, and the capture given or trained on, or what an open head
    plays. Raises StgaError for a capture that has changed, or of other triangles."""
    source = request.source
    given = request.capture
    capture = None
    if source.is_dir() and given is None:
        capture = open_refined(source, flame=request.flame)
    elif source.is_dir():  # another capture's meshes
        run = read_run(source)
        capture = open_capture(given, request.flame or run.flame, run.principal_point)
        capture = with_refined_tracking(capture, source)
    avatar = read_avatar(avatar_path(source))
    if capture is None and given is not None:
        capture = open_capture(given, request.flame, avatar.principal_point)
        if avatar.settings.get("tracking"):
            warn(f"{source}: was trained on refined meshes, which only its run's folder has")
    if capture is None:
        return avatar, None
    check_faces(capture.root, capture.faces, avatar.faces)
    return avatar, capture if request.played is None else _as_played(capture, request.played)


def required_capture(capture: Capture | None) -> Capture:
    """Raise StgaError where `open_avatar` found no capture."""
    if capture is None:
        raise StgaError("frames other than the neutral mesh need a capture; give --capture")
    return capture


def timesteps_between(capture: Capture, span: tuple[int, int] | None, log: Log) -> tuple[int, ...]:
    """The capture's timesteps within `span`, inclusive; says so where it reaches beyond. Raises
    StgaError for none."""
    if span is None:
        return tuple(capture.timesteps)
    first, last = span
    timesteps = tuple(timestep for timestep in capture.timesteps if first <= timestep <= last)
    if not timesteps:
        raise StgaError(f"{capture.root}: has no timestep from {first} to {last}")
    begin = min(capture.timesteps)
    end = max(capture.timesteps)
    if first < begin or last > end:
        log(f"--frames {first}:{last}: the capture has timesteps {begin} to {end}")
    return timesteps


def avatar_path(source: Path) -> Path:
    """The avatar file that a run folder or an avatar file names. Raises StgaError for a file of
    another kind."""
    if source.is_file() and source.suffix.lower() in SPLAT_SUFFIXES:
        alone = "holds splats, which render alone takes"
        raise StgaError(f"{source}: {alone}; expected the folder of a run, or an avatar (.npz)")
    if source.is_file() and source.suffix.lower() != ".npz":
        raise StgaError(f"{source}: is no avatar; expected {READ_FILES}")
    return source / AVATAR if source.is_dir() else source


def _as_played(capture: Capture, played: Played) -> Capture:
    """With the frames of an open .blend file. Raises StgaError for arrays of another head."""
    for name, arrays, shape, kind, expected in (
        ("frame", played.meshes, capture.neutral.shape, "f", "finite numbers"),
        ("selection of frame", played.selection or {}, capture.faces.shape[:1], "b", "bool"),
    ):
        for frame, array in arrays.items():
            if array.dtype.kind != kind or array.shape != shape or not np.isfinite(array).all():
                raise StgaError(
                    f"played: {name} {frame}: expected {expected} {shape}, got {array.dtype} "
                    f"{array.shape}"
                )
    flame = None
    count = len(played.meshes)
    if capture.flame is not None and played.motion is not None:
        flame = motion_of(Path("played"), played.motion, capture.flame.model)
        if len(flame.timesteps) != count:
            got = len(flame.timesteps)
            raise StgaError(f"played: motion: expected {count} frames, got {got}")
    meshes = dict(sorted(played.meshes.items()))
    return replace(capture, timesteps=tuple(meshes), mesh=meshes.__getitem__, flame=flame)


# Motions


def open_avatar_motion(request: Posed, avatar: Avatar, log: Log) -> Motion:
    """The request's motion on its avatar; says how far it is outside the trained range, where that
    is asked for. Raises StgaError."""
    assert request.motion is not None
    source = request.source
    options = request.motion_options
    trained = None
    run = read_run(source) if source.is_dir() else None
    flame = request.flame or (run.flame if run is not None else None)
    if run is not None and (options.neutral != "none" or options.stay_trained is not None):
        try:
            recorded = open_run(source, flame=request.flame).capture.flame
            if recorded is not None:
                trained = trained_range(recorded.frames())
        except StgaError as error:
            if options.stay_trained is not None:
                raise
            log(f"{error}; the motion is put on the head without expression, not its quiet face")
    if options.stay_trained is not None and trained is None:
        raise StgaError(
            f"--stay-trained: {source} is no run with a FLAME capture, whose motion would be "
            "the range"
        )
    head = avatar.neutral, avatar.faces
    motion = open_motion(request.motion, flame, head, options, trained, request.fps)
    for line in findings(motion):
        log(line)
    return motion


def motion_capture(request: Posed, avatar: Avatar, recorded: Capture | None, log: Log) -> Capture:
    """The motion as a capture, seen by the cameras of the run's own one."""
    motion = open_avatar_motion(request, avatar, log)
    views = {} if recorded is None else recorded.views
    capture = sequence_capture(request.motion, motion.sequence, request.flame, views)
    return replace(capture, fps=motion.fps)


def findings(motion: Motion) -> list[str]:
    """What to say about a motion: guesses, lost rows, and how far it goes beyond what was
    trained."""
    lines = [f"warning: {sentence}" for sentence in motion.warnings]
    if motion.lost:
        lines.append(f"{motion.lost} rows are missing and were interpolated")
    for part, beyond in motion.outside.items():
        if beyond.any():
            fraction = float(np.mean(beyond > 0))
            frame = int(beyond.argmax())
            lines.append(
                f"{part}: {100 * fraction:.0f} % of the frames are outside the trained range, "
                f"by up to {beyond.max():.1f} of its half width (frame {frame})"
            )
    return lines


# The head of an open .blend file


FOLDER = "STGA_HEAD"  # The environment variable that names the folder
HEAD = "head.json"
ARRAYS = "head.npz"


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
    """What head.json and head.npz hold; fields as of `OpenHead`."""

    capture: Path
    flame: Path | None
    avatar: Path | None
    selection: Mapping[int, np.ndarray] | None
    played: Played | None
    principal_point: str = setting(choices=PRINCIPAL_POINTS)
    fps: float = setting(above=0)


def write_head(folder: Path, head: OpenHead, played: bool) -> None:
    """Write the head into the folder; `played`: with the meshes of the scene's frames. Raises
    StgaError."""
    arrays: Arrays = {}
    stored = _Stored(
        head.capture,
        head.flame,
        head.avatar,
        head.selection(),
        head.played() if played else None,
        head.principal_point,
        head.fps,
    )
    write_json(folder / HEAD, to_json(stored, arrays))
    write_npz(folder / ARRAYS, arrays)


def read_head(folder: Path) -> OpenHead:
    """The head that `write_head` wrote. Raises StgaError where there is none or it is damaged."""
    path = folder / HEAD
    try:
        stored: _Stored = from_json(_Stored, read_json(path), "", read_npz(folder / ARRAYS))
    except StgaError as error:
        raise StgaError(f"{path}: is not the head of an open .blend file ({error})") from error
    given = {**vars(stored), "played": lambda: stored.played or Played({})}
    return OpenHead(**{**given, "selection": lambda: stored.selection})
