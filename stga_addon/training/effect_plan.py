"""What was decided about a run's effects, and why (`effects.rules` decides)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ..errors import StgaError

CHOICES = ("auto", "on", "off")
EFFECTS = (
    "view-color",
    "exposure",
    "antialiasing",
    "background",
    "hull-points",
    "density",
    "selection",
    "strain-color",
    "teeth",
    "neck",
    "jaw",
    "eyes",
    "dynamic-offsets",
    "tracking",
)
"""Names of what `effects.rules` decides."""
TRACKING = "tracking.npz"
"""Name of the file in a run's folder that holds its refined parameters (`tracking`, which needs torch)."""


@dataclass(frozen=True)
class EffectDecision:
    """One effect of a run.

    effect  its name, as in `--effect NAME=on`
    choice  what was asked for: one of CHOICES
    on      what came of it
    reason  why, with the figure that says so
    cost    what it costs while it is on
    """

    effect: str
    choice: str
    on: bool
    reason: str
    cost: str

    def __str__(self) -> str:
        asked = "" if self.choice == "auto" else ", as asked"
        return f"{'on' if self.on else 'off'}{asked}: {self.reason}" + (f" [{self.cost}]" if self.on else "")


def parse_choices(texts: Sequence[str]) -> dict[str, str]:
    """Effect -> choice, from texts such as "jaw=off". Raises StgaError for anything else."""
    choices = {}
    for text in texts:
        name, _, choice = text.partition("=")
        if name not in EFFECTS or choice not in CHOICES:
            raise StgaError(
                f"--effect: '{text}' is not NAME=on, NAME=off or NAME=auto with one of {', '.join(EFFECTS)}"
            )
        choices[name] = choice
    return choices


def effect_plan_to_json(plan: Sequence[EffectDecision]) -> list[dict[str, Any]]:
    return [dict(vars(decision)) for decision in plan]


def effect_plan_from_json(values: Any) -> tuple[EffectDecision, ...]:
    """Raises TypeError or ValueError for anything but what `effect_plan_to_json` gave."""
    if not isinstance(values, list):
        raise TypeError("plan is no list")
    plan = tuple(EffectDecision(**value) for value in values)
    for decision in plan:
        texts = (decision.effect, decision.choice, decision.reason, decision.cost)
        if not all(isinstance(text, str) for text in texts) or not isinstance(decision.on, bool):
            raise TypeError(f"plan holds {decision!r}")
        if decision.choice not in CHOICES:
            raise ValueError(f"plan: choice is {decision.choice!r}")
    return plan
