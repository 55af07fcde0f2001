"""The evaluations of a run, one line of JSON each in its folder."""

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ...errors import StgaError, shorten
from ...files import file_size, naming, replacing
from ...schema import from_json
from ..evaluate.forecast import Forecast

METRICS = "metrics.jsonl"
"""Name of the file in a run's folder."""
REQUIRED = ("iteration", "seconds", "splats", "evaluation_s", "wall_s")
"""Fields of every line."""
REGION_PSNR = "psnr_region"
"""PSNR of the region that a refinement trains, in its evaluations."""
TRACKING_GAIN = "tracking_gain_db"
"""Field of PSNR that views left out of tracking by the avatar gained by it; NaN where none was."""


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """The lines up to the first that is not JSON: a kill may have cut it off.

    Raises StgaError where the file cannot be read or a line has a missing or malformed field.
    """
    path = folder / METRICS
    lines: list[dict[str, Any]] = []
    if not path.exists():
        return lines
    try:
        file_size(path)
        with naming(path, "read"), path.open("rb") as texts:
            for text in texts:
                lines.append(json.loads(text.decode("utf-8")))
    except (ValueError, RecursionError):
        pass
    for number, line in enumerate(lines, 1):
        fault = _fault(line)
        if fault is not None:
            raise StgaError(f"{path}: line {number}: {fault}")
    return lines


def append_metrics(folder: Path, line: Mapping[str, Any]) -> None:
    path = folder / METRICS
    with naming(path), path.open("a", encoding="utf-8") as out:
        out.write(json.dumps(line) + "\n")


def cut_metrics(folder: Path, count: int) -> list[dict[str, Any]]:
    """Remove the evaluations beyond the first `count`, which a resumed run makes again, or a
    stopped run has made for itself; returns these."""
    kept = read_metrics(folder)[:count]
    with replacing(folder / METRICS) as partial:
        partial.write_text("".join(json.dumps(line) + "\n" for line in kept), encoding="utf-8")
    return kept


def _fault(line: Any) -> str | None:
    """What is wrong with a line, or None. Numbers other than the required need not be finite."""
    if not isinstance(line, dict):
        return "is no object"
    for name in REQUIRED:
        if not _is_number(line.get(name)) or not 0 <= line[name] < math.inf:
            return f"{name} is {shorten(line.get(name))}, expected a number from 0 up"
    for name, value in line.items():
        if name != "forecast" and not _is_number(value):
            return f"{name} is {shorten(value)}, expected a number"
    if type(line["iteration"]) is not int:
        return f"iteration is {shorten(line['iteration'])}, expected a whole number"
    if "psnr" in line and "ssim" not in line:
        return "psnr has no ssim beside it"
    if "forecast" not in line:
        return None
    try:
        from_json(Forecast, line["forecast"], "forecast")
    except StgaError as error:
        return str(error)
    if "psnr" not in line or not math.isfinite(line["psnr"]):
        return "forecast has no psnr beside it"
    return None


def _is_number(value: Any) -> bool:
    return isinstance(value, float) or (type(value) is int and abs(value) < 1 << 63)
