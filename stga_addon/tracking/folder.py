"""Files of a tracked capture's folder, and what they report of the torso."""

import shutil
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ..capture.open import CANONICAL_NAME
from ..errors import StgaError
from ..files import read_json, read_npz, write_npz
from ..schema import from_json, setting

REPORT_FILE = "tracking.json"
"""File with what tracking reports: errors, warnings, focal length, motion of the torso."""
SHEET_FILE = "contact_sheet.png"
"""Picture of the errors of all views, and of the worst views with the mesh."""
MATTES_FILE = "mattes.json"
"""File that describes the footage from which mattes were made."""
LANDMARKS_FOLDER = "landmarks"
"""Folder with the landmarks of each camera, from which a correction starts."""
PLACES_FILE = "head_model.npz"
"""File in LANDMARKS_FOLDER with the places of the landmarks on the head model."""
FOOTAGE_FILE = f"{LANDMARKS_FOLDER}/footage.json"
"""File that describes the footage in which the landmarks were found."""
KEPT_FOLDER = "unfinished"
"""Folder with results of parts, with which an interrupted tracking goes on; removed at its end."""
LOCK_FILE = "tracking.lock"
"""Held while the capture is written."""
SPLIT_FILES = ("transforms_train.json", "transforms_val.json", "transforms_test.json")
"""Files with the frames to train on, to validate with and to test with."""
MOTIONS = {"head": "turns with the head", "still": "keeps its direction", "own": "turns on its own"}
"""Motion of a torso -> its description."""
TORSO_KEY = "torso"
"""Key of the report; null where the torso's motion could not be determined."""
FOCAL_KEYS = {
    "pixels": "focal_length_px",
    "source": "focal_length_from",
    "interval_px": "focal_length_interval_px",
}
"""Fields of `FocalLength` -> their keys in the report."""
FOCAL_SOURCES = {
    "given": "as given",
    "file": "as the file says",
    "usual": "that of a phone",
    "solved": "solved from the turns of the head",
    "estimated": "estimated from the head's landmarks",
    "avatar": "that of the avatar's camera",
}
"""Origin of the focal length of a camera without calibration (`Footage.focal`; "usual" and "solved"
in captures of earlier versions) -> its description."""
POINTS_FILE = "torso_points.npz"
"""File with visible points of the torso (`TorsoPoints`)."""
AVATAR_MISFIT = "avatar"
"""Entry beside the regions of the face in the report's `image_misfit`: what the avatar that tracked
does not explain."""


def image_name(timestep: int, camera: int, suffix: str = ".png") -> str:
    """Path of a view's image below the capture; camera: its number."""
    return f"images/{timestep:05d}_{camera:02d}{suffix}"


def mask_name(timestep: int, camera: int) -> str:
    """Path of a view's mask below the capture; camera: its number."""
    return f"fg_masks/{timestep:05d}_{camera:02d}.png"


def is_written(out: Path) -> bool:
    """Whether a folder holds a whole capture; tracking that was interrupted leaves none."""
    files = (SPLIT_FILES[0], "transforms.json")
    return any((out / name).exists() for name in files) and not (out / KEPT_FOLDER).exists()


def is_begun(out: Path) -> bool:
    """Whether a folder holds anything but its lock."""
    return out.is_dir() and bool(_content(out))


def clear(out: Path) -> None:
    """Remove all but its lock from a folder, and the folder where it has none."""
    for path in _content(out):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink()
    with suppress(OSError):  # the lock is in it, whose holder removes both
        out.rmdir()


def _content(out: Path) -> list[Path]:
    return [path for path in out.iterdir() if not path.name.startswith(LOCK_FILE)]


def _read_report(capture: Path) -> dict[str, Any]:
    """The report of a tracked capture; empty where it has none."""
    path = capture / REPORT_FILE
    report = read_json(path) if path.is_file() else None
    return report if isinstance(report, dict) else {}


def is_in_order(out: Path) -> bool | None:
    """Whether the timesteps of a tracked capture follow each other in time; None where no report
    says so."""
    return _read_report(out).get("in_order")


def is_flame(out: Path) -> bool:
    """Whether the tracked capture has FLAME's layout, and needs the model file to be opened."""
    return (out / CANONICAL_NAME).exists()


def is_tracked(out: Path) -> bool:
    """Whether a capture has what its correction starts from."""
    return (out / LANDMARKS_FOLDER / PLACES_FILE).is_file() and (out / REPORT_FILE).is_file()


def rounded(values: Mapping[str, Mapping[int, float]]) -> dict[str, dict[str, float]]:
    """Values by camera or region, and timestep, rounded for the report."""
    return {
        name: {str(t): round(v, 3) for t, v in by_timestep.items()}
        for name, by_timestep in values.items()
    }


@dataclass(frozen=True)
class TorsoMotion:
    """The motion of MOTIONS that the torso follows, and the evidence for it.

    misfit    motion -> fraction of the points below the head, held out from fitting, that images do
              not explain
    turn_deg  largest angle between torso and head
    shift_mm  largest distance of the torso from where the neck's joint holds it; 0 where a rotation
              explains enough
    bend_mm   largest distance of its cloth from where a rigid torso has it; 0 where that explains
              enough
    """

    motion: str = setting(choices=MOTIONS)
    misfit: Mapping[str, float] = setting(minimum=0, maximum=1)
    turn_deg: float = setting(minimum=0)
    shift_mm: float = setting(0.0, minimum=0)
    bend_mm: float = setting(0.0, minimum=0)

    def check(self) -> None:
        """Raise StgaError where a motion's misfit is missing."""
        if set(self.misfit) != set(MOTIONS):
            raise StgaError(f"misfit: expected {', '.join(MOTIONS)}")

    @property
    def description(self) -> str:
        """A clause with the figures that decided."""
        shift = f" and {self.shift_mm:.0f} mm" if self.shift_mm else ""
        bend = f", its cloth bends by up to {self.bend_mm:.0f} mm" if self.bend_mm else ""
        apart = f", up to {self.turn_deg:.0f}°{shift} apart from the head{bend}"
        head, still, independent = (f"{self.misfit[name]:.0%}" for name in MOTIONS)
        return (
            f"the torso {MOTIONS[self.motion]}{'' if self.motion == 'head' else apart}; "
            f"images below the head are not explained by {head} if it turned with the head, "
            f"{still} still, {independent} on its own"
        )


def read_torso_motion(capture: Path) -> TorsoMotion | None:
    """What the report of a tracked capture says; None where it has no report, or that does not say.

    Raises StgaError where the report is malformed.
    """
    path = capture / REPORT_FILE
    found = _read_report(capture).get(TORSO_KEY)
    if found is None:
        return None
    if isinstance(found, dict):
        # of a capture that was tracked before there were any
        found = {"shift_mm": 0.0, "bend_mm": 0.0, **found}
    return from_json(TorsoMotion, found, f"{path}: {TORSO_KEY}")


@dataclass(frozen=True)
class FocalLength:
    """Focal length of a single camera without calibration, in pixels.

    source       which of FOCAL_SOURCES it is from
    interval_px  the interval that holds it with a probability of 90 %; None where it was not
                 estimated
    """

    pixels: float = setting(above=0)
    source: str = setting(choices=FOCAL_SOURCES)
    interval_px: tuple[float, float] | None = setting(None, above=0)

    @property
    def description(self) -> str:
        text = f"{self.pixels:.0f} px, {FOCAL_SOURCES[self.source]}"
        if self.interval_px is None:
            return text
        low, high = self.interval_px
        return f"{text}; {low:.0f} to {high:.0f} px with a probability of 90 %"


def describe_focal_length(capture: Path) -> str:
    """`FocalLength.description` of what the report of a tracked capture says; "" where it has no
    report, or where it is from a calibration. Raises StgaError where the report is malformed."""
    report = _read_report(capture)
    if report.get(FOCAL_KEYS["pixels"]) is None:
        return ""
    values = {name: report.get(key) for name, key in FOCAL_KEYS.items()}
    found: FocalLength = from_json(FocalLength, values, str(capture / REPORT_FILE))
    return found.description


@dataclass(frozen=True)
class TorsoPoints:
    """Visible points of the torso's surface at a timestep: (N, 3) meters in the capture's world."""

    timestep: int
    at: np.ndarray


def write_torso_points(capture: Path, points: TorsoPoints) -> None:
    """Write the points into a capture's folder."""
    arrays = {"timestep": np.array(points.timestep), "points": points.at.astype(np.float32)}
    write_npz(capture / POINTS_FILE, arrays)


def read_torso_points(capture: Path) -> TorsoPoints | None:
    """The points in a capture's folder; None without. Raises StgaError where damaged."""
    path = capture / POINTS_FILE
    if not path.is_file():
        return None
    arrays = read_npz(path)
    timestep = arrays.get("timestep", np.zeros(0))
    at = arrays.get("points", np.zeros(0))
    if timestep.shape != () or timestep.dtype.kind not in "iu":
        raise StgaError(f"{path}: timestep: expected a whole number")
    if at.ndim != 2 or at.shape[1] != 3 or at.dtype.kind != "f" or not np.isfinite(at).all():
        raise StgaError(f"{path}: points: expected (points, 3) finite numbers")
    return TorsoPoints(int(timestep), at.astype(np.float64))
