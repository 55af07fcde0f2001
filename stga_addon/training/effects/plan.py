"""Effect plan: deciding the effects of a run from its capture."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from ...capture.model import Capture
from ...errors import StgaError
from ..settings import TrainingSettings
from .catalog import EFFECTS, Effect
from .decisions import EffectDecision
from .facts import CaptureFacts
from .rules import RULES, Verdict

if TYPE_CHECKING:
    from ..run.folder import Run

ADDED_LATER = ("strain-color", "strain-position")
"""Effects that a continuation may switch on, in a run that went without."""


def with_effect_plan(run: "Run", capture: Capture, device: str = "cpu") -> "Run":
    """The run with its effects decided; unchanged where it has a plan already or its settings ask for none.

    device: of the training, as `choose_device` returns it.
    Raises StgaError for a choice that cannot work on this capture.
    """
    if run.settings.effects is None or run.effect_plan or not capture.views.get("train"):
        return run
    settings, plan = plan_effects(capture, run.settings, device)
    return replace(run, settings=settings, effect_plan=plan)


def with_effects_of_takes(run: "Run", capture: Capture) -> "Run":
    """The run with colors and positions that follow strain where all its takes together call for it and the run it
    continues went without.

    Splats can be given no other effect later: coefficients of zero leave them as they were. A user's choice stays.
    capture: of all takes.
    """
    facts, settings = CaptureFacts(capture, run.settings), run.settings
    plan = {decision.effect: decision for decision in run.effect_plan}
    for effect in EFFECTS:
        before = plan.get(effect.name)
        if effect.name in ADDED_LATER and before is not None and not before.on and before.choice == "auto":
            verdict = RULES[effect.name](facts)
            assert verdict is not None
            plan[effect.name] = replace(before, on=verdict.on, reason=verdict.reason)
            settings = replace(settings, **(effect.on if verdict.on else effect.off))
    return replace(run, settings=settings, effect_plan=tuple(plan.values()))


def plan_effects(
    capture: Capture, settings: TrainingSettings, device: str = "cpu"
) -> tuple[TrainingSettings, tuple[EffectDecision, ...]]:
    """The settings that suit a capture with training views, and the reasons; takes a few seconds.

    Raises StgaError where an image cannot be read, or for a choice in `settings.effects` that cannot work.
    """
    facts, choices = CaptureFacts(capture, settings, device), settings.effects or {}
    changes: dict[str, object] = {}
    plan = []
    for effect in EFFECTS:
        choice, verdict = choices.get(effect.name, "auto"), RULES[effect.name](facts)
        if verdict is None:
            if choice == "on":
                raise StgaError(f"--effect {effect.name}=on: {capture.root} has none: {_needs(effect)}")
            continue
        on = _decided(effect, choice, verdict)
        changes.update({**effect.on, **verdict.changes} if on else effect.off)
        plan.append(EffectDecision(effect.name, choice, on, verdict.reason, effect.cost))
    return replace(settings, **changes), tuple(plan)  # type: ignore[arg-type]


def _decided(effect: Effect, choice: str, verdict: Verdict) -> bool:
    if choice == "auto":
        return verdict.on
    if verdict.only and (choice == "on") != verdict.on:
        raise StgaError(f"--effect {effect.name}={choice}: is not possible, because {verdict.reason}")
    return choice == "on"


def _needs(effect: Effect) -> str:
    return "its mesh has no rows of teeth" if effect.name == "teeth" else "it has no parameters of FLAME"


def describe_effects(plan: Sequence[EffectDecision]) -> list[tuple[str, str]]:
    """(effect, decision and reason) lines."""
    return [(decision.effect, str(decision)) for decision in plan]
