"""What a path holds that is no capture, what can be done with it, and by which command."""

import os
import shlex
from collections import Counter
from pathlib import Path
from typing import NamedTuple

from ..files import is_file, is_folder
from .meshes import MESH_SUFFIXES
from .transforms import IMAGE_SUFFIXES, VIDEO_SUFFIXES, transforms_files

MAX_FILES = 20_000
"""Files of a folder that are looked at."""
MAX_DEPTH = 4
"""Levels of folders that are looked at."""
HEAD_BYTES = 1 << 14
"""Bytes of a file that are looked at."""
SPLAT_SUFFIXES = (".ply", ".spz", ".splat")
"""Suffixes of splats that are rendered."""
TABLE_SUFFIXES = (".csv", ".tsv", ".txt", ".json", ".jsonl", ".ndjson")
"""Suffixes of performances."""
GAUSSIAN_FOLDER = "point_cloud"
"""Folder of splats in the output of 3D Gaussian Splatting."""
OTHER_FILES = {
    **dict.fromkeys(
        (".bvh", ".fbx"),
        ("a body's motion", "is not read; export the face's ARKit shapes as .csv"),
    ),
    **dict.fromkeys(
        (".wav", ".mp3", ".m4a", ".flac", ".ogg"),
        ("sound", "is not read; let Audio2Face make a performance (.csv or .json) of it"),
    ),
    ".blend": ("a Blender file", "is opened in Blender"),
    ".pkl": ("a FLAME model or its masks", "is given with --flame, beside a capture"),
    ".npz": ("a motion", "moves an avatar: stga render RUN --motion FILE --video OUT.mp4"),
    **dict.fromkeys(
        (".heic", ".heif", ".dng", ".cr2", ".cr3", ".nef", ".arw"),
        ("a photo", "is not read; convert it to JPEG or PNG"),
    ),
    **dict.fromkeys(
        (".zip", ".7z", ".rar", ".tar", ".gz"), ("an archive", "is not read; unpack it first")
    ),
}
"""Suffix -> what a file is, and what is done with it."""


class OtherInput(NamedTuple):
    """What a path is, as "a folder of 6 photos"; what is done with it; commands for that, the
    likeliest first; whether it holds splats."""

    what: str
    plan: str
    commands: tuple[str, ...] = ()
    is_rendered: bool = False

    @property
    def advice(self) -> str:
        """The end of a sentence that begins with the path."""
        by = f": {' or '.join(self.commands)}" if self.commands else ""
        return f"is {self.what}, which {self.plan}{by}"


def other_input(path: Path) -> OtherInput | None:
    """What a path holds that is no capture; None where nothing is recognized, or nothing is there.
    Reads names and beginnings of files."""
    return _folder(path) if is_folder(path) else _file(path) if is_file(path) else None


def is_gaussian_output(folder: Path) -> bool:
    """Whether a folder is the output of 3D Gaussian Splatting, with folders `iteration_…`."""
    return any((folder / GAUSSIAN_FOLDER).glob("iteration_*"))


def _footage(path: Path, what: str) -> OtherInput:
    name = path.stem if is_file(path) else path.name
    source = shlex.quote(str(path))
    avatar = f"stga avatar {source} --out {shlex.quote(f'{name}_avatar')}"
    track = f"stga track {source} --out {shlex.quote(f'{name}_capture')}"
    return OtherInput(what, "is tracked before it is trained", (avatar, track))


def _rendered(path: Path, what: str) -> OtherInput:
    source = shlex.quote(str(path))
    out = shlex.quote(f"{path.stem}_turntable.mp4")
    command = f"stga render {source} --turntable --video {out}"
    return OtherInput(what, "is rendered, not trained", (command,), is_rendered=True)


def _file(path: Path) -> OtherInput | None:
    suffix = path.suffix.lower()
    source = shlex.quote(str(path))
    if suffix in VIDEO_SUFFIXES:
        return _footage(path, "a video")
    if suffix in IMAGE_SUFFIXES:
        return OtherInput("one image", "is tracked with others, as a folder of photos")
    with path.open("rb") as stream:
        head = stream.read(HEAD_BYTES)
    is_mesh = suffix in MESH_SUFFIXES and (suffix != ".ply" or b"scale_0" not in head)
    if suffix in SPLAT_SUFFIXES and not (is_mesh and b"chunk" not in head):
        return _rendered(path, "a file of splats")
    if is_mesh:
        return OtherInput(
            "a mesh", "is tracked where a folder holds one for each timestep, and cameras"
        )
    if suffix == ".json" and (b'"mesh_path"' in head or b'"flame_param_path"' in head):
        command = f"stga info {shlex.quote(str(path.parent))}"
        return OtherInput("a file of a capture", "is named by its folder", (command,))
    if suffix == ".json" and (b"transform_matrix" in head or b"world_2_cam" in head):
        return _footage(path.parent, "a file of cameras, beside images")
    if suffix == ".json" and b'"rotation"' in head and b'"position"' in head and b'"fx"' in head:
        model = shlex.quote(str(path.parent))
        command = f"stga render {model} --cameras {source} --out pictures"
        return OtherInput(
            "3D Gaussian Splatting's file of cameras", "says what is seen", (command,)
        )
    if suffix in TABLE_SUFFIXES:
        out = shlex.quote(f"{path.stem}.npz")
        moved = f"stga render RUN --motion {source} --video OUT.mp4"
        commands = (moved, f"stga drive {source} --out {out}")
        return OtherInput("a table or text, such as a performance", "moves an avatar", commands)
    found = OTHER_FILES.get(suffix)
    return None if found is None else OtherInput(*found)


def _folder(path: Path) -> OtherInput | None:
    if is_gaussian_output(path):
        return _rendered(path, "the output of 3D Gaussian Splatting")
    run = path / "run"
    if is_file(run / "run.json"):
        inside = shlex.quote(str(run))
        return OtherInput("a folder of `stga avatar`", "holds a run", (f"stga info {inside}",))
    names, calibrations = _names_in(path)
    suffixes = Counter(Path(name).suffix.lower() for name in names)
    images = sum(count for suffix, count in suffixes.items() if suffix in IMAGE_SUFFIXES)
    videos = sum(count for suffix, count in suffixes.items() if suffix in VIDEO_SUFFIXES)
    parts = [f"{images} photos"] if images else []
    parts += [f"{videos} video{'s' if videos > 1 else ''}"] if videos else []
    if parts:
        known = f" with {' and '.join(calibrations)}" if calibrations else ""
        return _footage(path, f"a folder of {' and '.join(parts)}{known}")
    tables = [name for name in names if Path(name).suffix.lower() == ".csv"]
    if tables:
        out = shlex.quote(f"{path.name}.npz")
        command = f"stga drive {shlex.quote(str(path))} --out {out}"
        return OtherInput("the folder of a performance's take", "moves an avatar", (command,))
    splats = [name for name in names if Path(name).suffix.lower() in SPLAT_SUFFIXES]
    if splats:
        first = path / splats[0]
        return OtherInput(
            f"a folder of {len(splats)} PLY or splat files",
            "are looked at one by one",
            (f"stga info {shlex.quote(str(first))}",),
        )
    unread = next((OTHER_FILES[s] for s in suffixes if s in OTHER_FILES), None)
    return None if unread is None else OtherInput(f"a folder with {unread[0]}", unread[1])


def _names_in(root: Path) -> tuple[list[str], list[str]]:
    """Paths of the files below a folder, and what calibrates them."""
    found: list[str] = []
    known = ["a transforms file"] if transforms_files(root) else []
    for folder, names, files in os.walk(root):
        depth = len(Path(folder).relative_to(root).parts)
        names[:] = sorted(n for n in names if not n.startswith(".") and depth < MAX_DEPTH)
        inside = Path(folder).relative_to(root)
        found += [(inside / n).as_posix() for n in sorted(files) if not n.startswith(".")]
        stems = {Path(name).stem for name in files if Path(name).suffix in (".bin", ".txt")}
        if {"cameras", "images"} <= stems:
            known.append("a COLMAP model")
        if "camera_params.json" in files:
            known.append("NeRSemble's camera_params.json")
        if len(found) > MAX_FILES:
            break
    return found, list(dict.fromkeys(known))
