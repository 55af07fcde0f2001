"""How the torso of a tracked take moves, as a capture's tracking.json says it."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from ..errors import StgaError
from ..files import read_json
from ..schema import from_json, setting
from .folder import REPORT_FILE

MOTIONS = {"head": "turns with the head", "still": "keeps its direction", "own": "turns on its own"}
TORSO_KEY = "torso"
"""Of the report; null where the motion could not be told."""


@dataclass(frozen=True)
class TorsoMotion:
    """Which of MOTIONS the torso follows, and what speaks for it.

    misfit    motion -> share of the points below the head, held out from fitting, that images do not explain
    turn_deg  largest angle between torso and head
    shift_mm  largest distance of the torso from where the neck's joint holds it; 0 where a rotation explains enough
    """

    motion: str = setting(choices=MOTIONS)
    misfit: Mapping[str, float] = setting(minimum=0, maximum=1)
    turn_deg: float = setting(minimum=0)
    shift_mm: float = setting(0.0, minimum=0)

    @property
    def description(self) -> str:
        """A clause with the figures that decided."""
        shift = f" and {self.shift_mm:.0f} mm" if self.shift_mm else ""
        apart = "" if self.motion == "head" else f", up to {self.turn_deg:.0f}°{shift} apart from the head"
        shares = {name: f"{self.misfit[name]:.0%}" for name in MOTIONS}
        return (
            f"the torso {MOTIONS[self.motion]}{apart}; images below the head are not explained by {shares['head']} if "
            f"it turned with the head, {shares['still']} still, {shares['own']} on its own"
        )


def read_torso_motion(capture: Path) -> TorsoMotion | None:
    """What the report of a tracked capture says; None where it has no report, or that does not say.

    Raises StgaError where the report is malformed.
    """
    path = capture / REPORT_FILE
    if not path.is_file():
        return None
    report = read_json(path)
    found = report.get(TORSO_KEY) if isinstance(report, dict) else None
    if found is None:
        return None
    try:
        motion: TorsoMotion = from_json(TorsoMotion, found)
        if set(motion.misfit) != set(MOTIONS):
            raise StgaError(f"misfit: expected {', '.join(MOTIONS)}")
    except StgaError as error:
        raise StgaError(f"{path}: {TORSO_KEY}: {error}") from error
    return motion
