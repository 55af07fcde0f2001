"""Effect plan: deciding the effects of a run from its capture."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from ...avatar.offsets import OFFSETS
from ...capture.model import Capture
from ...errors import StgaError
from ..effect_catalog import EFFECTS, Effect
from ..effect_decisions import EffectDecision
from ..settings import TrainingSettings
from .facts import CaptureFacts
from .rules import RULES

Plan = tuple[EffectDecision, ...]


def plan_effects(
    capture: Capture, settings: TrainingSettings, device: str = "cpu"
) -> tuple[TrainingSettings, Plan]:
    """The settings that suit a capture, and the reasons; takes a few seconds. The same settings and
    no reasons where they ask for none, or the capture has no training views.

    device: of the training, as `choose_device` returns it.
    Raises StgaError where an image cannot be read, or for a choice in `settings.effects` that
    cannot work.
    """
    if settings.effects is None or not capture.views.get("train"):
        return settings, ()
    facts, choices = CaptureFacts(capture, settings, device), settings.effects
    decided, plan = settings, []
    for effect in EFFECTS.values():
        choice, verdict = choices.get(effect.name, "auto"), RULES[effect.name](facts)
        flag = f"--effect {effect.name}={choice}"
        if verdict is None:
            if choice == "on":
                lacks = "it has no parameters of FLAME"
                if effect.name == "teeth":
                    lacks = "its mesh has no rows of teeth"
                raise StgaError(f"{flag}: {capture.root} has none: {lacks}")
            continue
        on = verdict.on if choice == "auto" else choice == "on"
        if verdict.fixed and on != verdict.on:
            raise StgaError(f"{flag}: is not possible, because {verdict.reason}")
        decided = switched(decided, effect, on, verdict.changes)
        plan.append(EffectDecision(effect.name, choice, on, verdict.reason, effect.cost))
    return decided, tuple(plan)


def add_effects(
    capture: Capture, settings: TrainingSettings, before: Plan
) -> tuple[TrainingSettings, Plan]:
    """Settings and plan with the effects that may be `added_later` where the capture, of all takes,
    calls for them and the run that is continued went without. A user's choice stays."""
    facts, plan = CaptureFacts(capture, settings), {each.effect: each for each in before}
    for effect in EFFECTS.values():
        decision = plan.get(effect.name)
        is_open = decision is not None and not decision.on and decision.choice == "auto"
        if effect.added_later and is_open:
            verdict = RULES[effect.name](facts)
            assert verdict is not None
            assert decision is not None
            plan[effect.name] = replace(decision, on=verdict.on, reason=verdict.reason)
            settings = switched(settings, effect, verdict.on)
    return settings, tuple(plan.values())


def switched(
    settings: TrainingSettings,
    effect: Effect,
    on: bool,
    changes: Mapping[str, Any] = MappingProxyType({}),
) -> TrainingSettings:
    """The settings with an effect on or off; changes: further ones for when it is on."""
    changed = {**effect.on, **changes} if on else dict(effect.off)
    if effect.offset is not None:
        offsets = {*settings.driven_offsets} - {effect.offset} | ({effect.offset} if on else set())
        changed["driven_offsets"] = tuple(name for name in OFFSETS if name in offsets)
    return replace(settings, **changed)


def describe_effects(plan: Sequence[EffectDecision]) -> list[tuple[str, str]]:
    """(effect, decision and reason) lines."""
    return [(decision.effect, str(decision)) for decision in plan]
