"""Effect plan: deciding the effects of a run from its capture."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from ...avatar.offsets.table import OFFSETS
from ...capture.model import Capture
from ...errors import StgaError
from ..effect_catalog import EFFECTS, Effect
from ..effect_decisions import EffectDecision
from ..settings import TrainingSettings
from .facts import CaptureFacts
from .rules import RULES, Verdict

if TYPE_CHECKING:
    from ..run.folder import Run


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
    """The run with the effects that may be `added_later` where all its takes together call for them and the run it
    continues went without. A user's choice stays. capture: of all takes.
    """
    facts, settings = CaptureFacts(capture, run.settings), run.settings
    plan = {decision.effect: decision for decision in run.effect_plan}
    for effect in EFFECTS.values():
        before = plan.get(effect.name)
        if effect.added_later and before is not None and not before.on and before.choice == "auto":
            verdict = RULES[effect.name](facts)
            assert verdict is not None
            plan[effect.name] = replace(before, on=verdict.on, reason=verdict.reason)
            settings = switched(settings, effect, verdict.on)
    return replace(run, settings=settings, effect_plan=tuple(plan.values()))


def plan_effects(
    capture: Capture, settings: TrainingSettings, device: str = "cpu"
) -> tuple[TrainingSettings, tuple[EffectDecision, ...]]:
    """The settings that suit a capture with training views, and the reasons; takes a few seconds.

    Raises StgaError where an image cannot be read, or for a choice in `settings.effects` that cannot work.
    """
    facts, choices = CaptureFacts(capture, settings, device), settings.effects or {}
    decided, plan = settings, []
    for effect in EFFECTS.values():
        choice, verdict = choices.get(effect.name, "auto"), RULES[effect.name](facts)
        if verdict is None:
            if choice == "on":
                raise StgaError(f"--effect {effect.name}=on: {capture.root} has none: {_needs(effect)}")
            continue
        on = _decided(effect, choice, verdict)
        decided = switched(decided, effect, on, verdict.changes)
        plan.append(EffectDecision(effect.name, choice, on, verdict.reason, effect.cost))
    return decided, tuple(plan)


def switched(
    settings: TrainingSettings, effect: Effect, on: bool, changes: Mapping[str, Any] = MappingProxyType({})
) -> TrainingSettings:
    """The settings with an effect on or off; changes: further ones for when it is on."""
    changed = {**effect.on, **changes} if on else dict(effect.off)
    if effect.offset is not None:
        offsets = {*settings.driven_offsets, effect.offset} if on else {*settings.driven_offsets} - {effect.offset}
        changed["driven_offsets"] = tuple(name for name in OFFSETS if name in offsets)
    return replace(settings, **changed)


def _decided(effect: Effect, choice: str, verdict: Verdict) -> bool:
    if choice == "auto":
        return verdict.on
    if verdict.fixed and (choice == "on") != verdict.on:
        raise StgaError(f"--effect {effect.name}={choice}: is not possible, because {verdict.reason}")
    return choice == "on"


def _needs(effect: Effect) -> str:
    return "its mesh has no rows of teeth" if effect.name == "teeth" else "it has no parameters of FLAME"


def describe_effects(plan: Sequence[EffectDecision]) -> list[tuple[str, str]]:
    """(effect, decision and reason) lines."""
    return [(decision.effect, str(decision)) for decision in plan]
