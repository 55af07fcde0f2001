"""Effect plan of a run: what was decided about each effect, and why (`effects.rules` decides)."""

from dataclasses import dataclass

from ..errors import StgaError
from ..schema import complaint
from .effect_catalog import EFFECTS

CHOICES = ("auto", "on", "off")


@dataclass(frozen=True)
class EffectDecision:
    """The decision about one effect.

    effect  one of EFFECTS
    choice  the user's: one of CHOICES
    on      the decision
    reason  with the figure that it rests on
    cost    of the effect while it is on
    """

    effect: str
    choice: str
    on: bool
    reason: str
    cost: str

    def check(self) -> None:
        """Raise StgaError for a choice that is none."""
        if self.choice not in CHOICES:
            raise StgaError(complaint("choice", f"one of {', '.join(CHOICES)}", self.choice))

    def __str__(self) -> str:
        asked = "" if self.choice == "auto" else ", as asked"
        return f"{'on' if self.on else 'off'}{asked}: {self.reason}" + (
            f" [{self.cost}]" if self.on else ""
        )


def parse_choice(text: str) -> tuple[str, str]:
    """Effect and choice, from a text such as "jaw=off". Raises StgaError for anything else."""
    name, _, choice = text.partition("=")
    if name not in EFFECTS or choice not in CHOICES:
        raise StgaError(
            f"'{text}' is not NAME=on, NAME=off or NAME=auto with one of {', '.join(EFFECTS)}"
        )
    return name, choice
