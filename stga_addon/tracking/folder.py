"""Files of a tracked capture's folder."""

from pathlib import Path

from ..capture.open import CANONICAL_NAME

REPORT_FILE, SHEET_FILE, LANDMARKS_FOLDER, PLACES_FILE, MATTES_FILE = (
    "tracking.json",
    "contact_sheet.png",
    "landmarks",
    "head_model.npz",
    "mattes.json",
)
KEPT_FOLDER = "unfinished"
"""Of results of parts, with which an interrupted tracking goes on; removed once the capture is
written."""
SPLIT_FILES = ("transforms_train.json", "transforms_val.json", "transforms_test.json")


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


def is_flame(out: Path) -> bool:
    """Whether the tracked capture has FLAME's layout, and needs the model file to be opened."""
    return (out / CANONICAL_NAME).exists()


def is_tracked(out: Path) -> bool:
    """Whether a capture has what its correction starts from."""
    return (out / LANDMARKS_FOLDER / PLACES_FILE).is_file() and (out / REPORT_FILE).is_file()
