"""What is asked of a run that continues another one: a region to refine, or takes to extend it by."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class Refinement:
    """What is asked of a continuation that refines a region.

    parent   folder of the run
    region   name of a region, or region file (`find_region`)
    frames   timesteps from first to last whose images show what is wrong; None: all
    growth   most splats that may be added, as a share of the region's
    seconds, iterations   the budget, one of the two
    """

    parent: Path
    region: str
    frames: tuple[int, int] | None = None
    growth: float = 0.0
    seconds: float | None = None
    iterations: int | None = None
    seed: int = 0


@dataclass(frozen=True)
class Extension:
    """What is asked of a continuation that extends a run by further takes of the same head.

    parent   folder of the run
    captures folders of the takes
    growth   most splats that may be added, as a share of those on the triangles that the takes need
    seconds, iterations   the budget, one of the two
    """

    parent: Path
    captures: tuple[Path, ...]
    growth: float = 0.0
    seconds: float | None = None
    iterations: int | None = None
    seed: int = 0


Request = Refinement | Extension


def request_to_json(wanted: Request | None) -> dict[str, Any] | None:
    """Plain values; `request_from_json` reads them back."""
    if wanted is None:
        return None
    if isinstance(wanted, Refinement):
        return {**asdict(wanted), "parent": str(wanted.parent)}
    return {**asdict(wanted), "parent": str(wanted.parent), "captures": [str(path) for path in wanted.captures]}


def request_from_json(values: Any) -> Request | None:
    """Raises KeyError, TypeError or ValueError for anything but what `request_to_json` gave."""
    if values is None:
        return None
    values = {**values, "parent": Path(values["parent"])}
    for name in ("growth", "seconds", "iterations", "seed"):
        if isinstance(values[name], bool) or not isinstance(values[name], int | float | None):
            raise ValueError(f"{name} is not a number")
    if "captures" in values:
        return Extension(**{**values, "captures": tuple(Path(path) for path in values["captures"])})
    frames = values["frames"]
    if frames is not None:
        first, last = frames
        values["frames"] = int(first), int(last)
    return Refinement(**{**values, "region": str(values["region"])})
