"""Folder of `MakeAvatar`: the capture, the run, and what was asked for when they began, which alone continues."""

import os
from dataclasses import fields
from pathlib import Path
from typing import Any

from ..errors import StgaError, shorten
from ..files import read_json, write_json
from ..tracking.folder import is_written
from .values import RUN_FOLDER, Track

INPUTS = "inputs.json"


def check_inputs(track: Track) -> None:
    """Raise StgaError where the folder began with other inputs, or holds something else."""
    out, inputs = track.out.parent, _inputs(track)
    if (out / INPUTS).exists():
        stored = read_inputs(out)
        before = {name: stored.get(name, getattr(Track, name, None)) for name in inputs}  # an older version noted less
        changed = next((name for name in inputs if before[name] != inputs[name]), None)
        if changed is not None:
            raise StgaError(f"{changed}: {out} began with {shorten(before[changed])}; give another --out")
    elif is_written(track.out) or (out / RUN_FOLDER).exists():
        raise StgaError(f"{out}: holds something else ({INPUTS} is missing); give another --out")


def write_inputs(track: Track) -> None:
    write_json(track.out.parent / INPUTS, _inputs(track))


def read_inputs(out: Path) -> dict[str, Any]:
    """Raises StgaError where inputs.json is missing or malformed."""
    values = read_json(out / INPUTS)
    if not isinstance(values, dict) or not isinstance(values.get("model", 0), str | None):
        raise StgaError(f"{out / INPUTS}: has no model; expected what `stga avatar` wrote")
    return values


def _inputs(track: Track) -> dict[str, Any]:
    """What decides how it is tracked, as JSON: the fields of `Track` but its folder; paths are absolute."""
    values = {spec.name: getattr(track, spec.name) for spec in fields(Track) if spec.name != "out"}
    values["offset"] = dict(sorted((track.offset or {}).items()))
    return {name: os.path.abspath(value) if isinstance(value, Path) else value for name, value in values.items()}
