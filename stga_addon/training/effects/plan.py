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
from .rules import RULES, Verdict

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
        if verdict is None:
            if choice == "on":
                raise StgaError(
                    f"--effect {effect.name}=on: {capture.root} has none: {_needs(effect)}"
                )
            continue
        on = _decided(effect, choice, verdict)
        decided = switched(decided, effect, on, verdict.changes)
        plan.append(EffectDecision(effect.name, choice, on, verdict.reason, effect.cost))
    return decided, tuple(plan)


def add_effects(
    capture: Capture, settings: TrainingSettings, before: Plan
) -> tuple[TrainingSettings, Plan]:
    """Settings and plan with the effects that may be `added_later` where the capture, of all takes,
    calls for them and the run that is continued went without. A user's choice stays."""
    facts, plan = (
        CaptureFacts(capture, settings),
        {decision.effect: decision for decision in before},
    )
    for effect in EFFECTS.values():
        decision = plan.get(effect.name)
        if (
            effect.added_later
            and decision is not None
            and not decision.on
            and decision.choice == "auto"
        ):
            verdict = RULES[effect.name](facts)
            assert verdict is not None
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
        offsets = (
            {*settings.driven_offsets, effect.offset}
            if on
            else {*settings.driven_offsets} - {effect.offset}
        )
        changed["driven_offsets"] = tuple(name for name in OFFSETS if name in offsets)
    return replace(settings, **changed)


def _decided(effect: Effect, choice: str, verdict: Verdict) -> bool:
    if choice == "auto":
        return verdict.on
    if verdict.fixed and (choice == "on") != verdict.on:
        raise StgaError(
            f"--effect {effect.name}={choice}: is not possible, because {verdict.reason}"
        )
    return choice == "on"


def _needs(effect: Effect) -> str:
    return (
        "its mesh has no rows of teeth"
        if effect.name == "teeth"
        else "it has no parameters of FLAME"
    )


def describe_effects(plan: Sequence[EffectDecision]) -> list[tuple[str, str]]:
    """(effect, decision and reason) lines."""
    return [(decision.effect, str(decision)) for decision in plan]
