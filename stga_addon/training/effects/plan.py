"""Effect plan: rules that decide the effects of a run from measurements of its capture."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from ...avatar.offsets import OFFSETS
from ...capture.camera import Camera
from ...capture.model import Capture
from ...capture.usable_views import NAMED_TIMESTEPS, with_training_views
from ...errors import StgaError, listed
from ...flame.parts import PARTS
from ...flame.sequence import MIN_JOINT_ANGLE_DEG
from ...tracking.folder import is_tracked, read_torso_motion
from ..effect_catalog import EFFECTS, Effect, EffectDecision
from ..settings import TrainingSettings
from .evidence import MIN_EXPOSURE_LEVELS, camera_evidence, linear_evidence, scattered_folds
from .facts import CaptureFacts

MIN_CAMERAS_FOR_VIEW_COLOR = 4
"""With fewer, view-dependent color is not constrained between the cameras."""
MIN_VIEW_DEPENDENCE_LEVELS = 1.0
"""Gain in levels of 255 from which color depends on the direction of view."""
MAX_VIEW_ERROR_RATIO = 4.0
"""Errors above this multiple of the median come from lids, lips and teeth, not from the view."""
MIN_STRAIN_GAIN_DB = 0.35
"""Mean gain of sampled colors, in frames and in cameras that are left out, from which splats follow
deformation: with less, trainings with and without differ by no more than their noise."""
MIN_TRACKED_STRAIN_GAIN_DB = -0.35
"""The same for a capture by `stga track`, whose mesh is so far from the true surface that colors
sampled there do not show what trainings gain."""
MIN_TIMESTEPS_FOR_STRAIN = 4
"""With fewer, leaving out one and its neighbors leaves no two to fit a dependence to."""
MIN_SIGNAL_CHANGE = 1e-5
"""Least change of strain or a unit normal; smaller ones are rounding errors."""
MIN_TURN_DEG = 2.0
"""Root mean square over frames and triangles, from which colors follow where skin faces."""
MAX_PIXEL_WIDTH_RATIO = 1.25
"""Largest ratio of pixel widths at the head; above it, splats narrower than a pixel look different
to each camera."""
FINE_SPLAT_PIXELS = 4.0
"""Median pixels per splat below which the screen-space low-pass filter changes how splats look."""
MAX_BACKGROUND_SPREAD_LEVELS = 6.0
"""Root mean square deviation of a uniform background, in levels of 255."""
BACKGROUND_TOLERANCE_LEVELS = 3.0
"""Largest difference, in levels of 255, between the background and the color in the settings."""
MESH_AS_MASK = (
    "what the head's mesh does not cover, hair included, is left out (`stga track --mattes auto` "
    "makes masks)"
)
"""Treatment of images without a mask."""
MIN_UNCOVERED_FRACTION = 0.003
"""Fraction of the foreground that the mesh does not cover, from which splats are added for it."""
MIN_PIXELS_PER_SPLAT = 0.5
"""90th percentile over triangles, below which further splats have no detail to show."""
MIN_LIP_GAP_MM = 1.5
"""Gap between the lips above which the inside of the mouth is visible."""
MIN_JAW_ANGLE_DEG = 3.0
"""Rotation of the jaw above which it is visible."""
MAX_OUTSIDE_FRACTION = 0.001
"""Fraction of the mesh outside of the masks above which the tracking is inaccurate."""


@dataclass(frozen=True)
class Verdict:
    """What a rule decided: whether the capture calls for the effect, and a clause with the figure
    that decided. fixed: no other choice can work, an override is refused with the reason; changes:
    further settings for when the effect is on."""

    on: bool
    reason: str
    fixed: bool = False
    changes: Mapping[str, Any] = field(default_factory=dict)


Rule = Callable[[CaptureFacts], Verdict | None]
"""Decides one effect; None where the effect does not apply to the capture."""


def occlusions(facts: CaptureFacts) -> Verdict:
    """On where something covers the head of a single camera's recording for a while."""
    if not facts.has_one_camera:
        reason = "several cameras show at a time what one of them does not"
        return Verdict(False, reason, fixed=True)
    covered = facts.covered_views
    if not covered:
        return Verdict(False, "nothing covers the head for a while", fixed=True)
    timesteps = sorted({view.timestep for view in covered})
    rows = tuple((view.camera_index, view.timestep) for view in covered)
    count = f"{len(covered)} of {len(facts.views)} training views"
    where = f"timestep{'s' if len(timesteps) > 1 else ''} {listed(timesteps, NAMED_TIMESTEPS)}"
    reason = f"something covers the head in {count}, which are left out ({where})"
    return Verdict(True, reason, changes={"covered": rows})


def view_color(facts: CaptureFacts) -> Verdict:
    if facts.cameras == 1:
        return Verdict(False, "a single camera sees everything from one direction", fixed=True)
    if facts.cameras < MIN_CAMERAS_FOR_VIEW_COLOR:
        reason = f"{facts.cameras} cameras are too few to show how color depends on the view"
        return Verdict(False, reason)
    direction = facts.samples.direction
    folds = scattered_folds(np.arange(len(direction)))
    found = linear_evidence(facts.matched_colors, direction, folds, MAX_VIEW_ERROR_RATIO)
    variance = f"({found.fraction:.1%} of the variance)"
    reason = f"colors depend on the view by {found.gain:.1f} of 255 levels {variance}"
    return Verdict(found.gain >= MIN_VIEW_DEPENDENCE_LEVELS, reason)


def exposure(facts: CaptureFacts) -> Verdict:
    if facts.cameras == 1 and facts.timesteps == 1:
        return Verdict(False, "a single image has no other to differ from", fixed=True)
    colors = facts.camera_colors
    samples = facts.samples
    table = np.column_stack([colors.camera, colors.gain, colors.offset])
    found = camera_evidence(samples, facts.stable_colors).gain
    drift = facts.drifts.gain
    reason = f"{facts.cameras} cameras show the same colors {found:.1f} of 255 levels apart"
    if drift >= MIN_EXPOSURE_LEVELS or facts.cameras == 1:
        values = table[np.searchsorted(colors.camera, samples.camera)]
        values[:, 1:4] *= facts.drift
        table = np.column_stack([values, samples.timestep])
        found = max(found, drift)
        reason = f"a camera shows the same colors {drift:.1f} of 255 levels apart over time"
    rows = tuple(map(tuple, table.tolist()))
    return Verdict(found >= MIN_EXPOSURE_LEVELS, reason, changes={"exposure": rows})


def antialiasing(facts: CaptureFacts) -> Verdict:
    if facts.settings.scale < 1:
        return Verdict(True, "images are trained at a smaller size than they are rendered at")
    widths = facts.samples.pixel_width[~np.isnan(facts.samples.pixel_width)]
    widest = float(widths.max() / widths.min()) if len(widths) else 1.0
    if widest > MAX_PIXEL_WIDTH_RATIO:
        return Verdict(True, f"the widest pixel at the head is {widest:.2f} times the narrowest")
    pixels = facts.pixels_per_splat(50)
    width = "pixels have the same width at the head"
    reason = f"{width}, and half of the splats cover less than {pixels:.1f}"
    return Verdict(pixels < FINE_SPLAT_PIXELS, reason)


def background(facts: CaptureFacts) -> Verdict:
    samples = facts.samples
    if facts.shows_backdrop:
        unmasked = int(np.isnan(samples.foreground).sum())
        count = f"{unmasked} of {len(samples.white)} sampled images have no mask"
        reason = f"{count}, and show more than white behind the head: {MESH_AS_MASK}"
        return Verdict(True, reason, changes={"backdrop": "mesh"})
    spread = facts.backdrop_spread
    every = "every image has a mask"
    if spread is None:
        reason = "not every image has a mask or transparency that shows where the head ends"
        return Verdict(False, reason, fixed=True)
    if spread > MAX_BACKGROUND_SPREAD_LEVELS:
        varies = f"varies by {spread:.0f} of 255 levels"
        reason = f"{every}; what lies outside, which {varies}, is replaced"
        return Verdict(True, reason, changes={"backdrop": "masked"})
    color = samples.background[~np.isnan(samples.background_spread)].mean(0)
    differs = abs(color - 255 * np.array(facts.settings.background)).max()
    is_named = differs < BACKGROUND_TOLERANCE_LEVELS
    changes = {} if is_named else {"background": tuple((color / 255).round(4).tolist())}
    red, green, blue = color.round().astype(int).tolist()
    reason = f"{every}, and one color behind the head ({red}, {green}, {blue})"
    return Verdict(True, reason, changes=changes)


def hull_points(facts: CaptureFacts) -> Verdict:
    if facts.shows_backdrop:
        reason = "without masks, it is not known what beside the mesh belongs to the head"
        return Verdict(False, reason, fixed=True)
    samples = facts.samples
    if np.isnan(samples.foreground).any():
        reason = "without masks, it is not known how much lies beside the mesh"
        return Verdict(facts.settings.hull_points, reason)
    uncovered = float(samples.uncovered.sum() / max(samples.foreground.sum(), 1))
    reason = f"{uncovered:.1%} of the foreground lies beside the mesh"
    if facts.has_one_camera:
        reason += "; a single camera does not show how far away, so that it becomes a flat layer"
    return Verdict(uncovered > MIN_UNCOVERED_FRACTION, reason)


def depth_limits(facts: CaptureFacts) -> Verdict:
    reason = "a single camera does not show how far in front of or behind the mesh a splat is"
    if not facts.has_one_camera:
        reason = f"{facts.cameras} cameras show how far away a splat is"
    return Verdict(facts.has_one_camera, reason)


def density(facts: CaptureFacts) -> Verdict:
    pixels = facts.pixels_per_splat(90)
    reason = f"triangles show up to {pixels:.1f} pixels a splat"
    return Verdict(pixels > MIN_PIXELS_PER_SPLAT, reason)


def selection(facts: CaptureFacts) -> Verdict:
    threshold = 1000 * facts.settings.selection.threshold
    if facts.selected_fraction == 0:
        count = len(facts.sampled_timesteps)
        total = len(facts.capture.timesteps)
        reason = f"no triangle moves by more than {threshold:g} mm in any of {count} frames"
        return Verdict(False, reason, fixed=count == total)
    fraction = f"{facts.selected_fraction:.0%}"
    asked = facts.settings.strategy == "selective"
    reason = f"a frame moves {fraction} of the triangles by more than {threshold:g} mm"
    return Verdict(asked, reason + ("" if asked else ", but training all of them measured best"))


def strain(facts: CaptureFacts) -> Verdict:
    """On where colors that follow strain gain enough in the mean of frames and cameras that were
    left out: of what a head shows, unseen expressions and unseen views count alike."""
    if facts.signal_change("smoothed_strain") < MIN_SIGNAL_CHANGE:
        return Verdict(False, "the mesh has the same shape in every training frame", fixed=True)
    if facts.timesteps < MIN_TIMESTEPS_FOR_STRAIN:
        reason = f"{facts.timesteps} frames are too few to show what follows deformation"
        return Verdict(False, reason)
    left_out = facts.strain_dependence
    gains = {f"left-out {kind}": found.decibels for kind, found in left_out.items()}
    figures = " and ".join(f"{gain:+.2f} dB in {kind}" for kind, gain in gains.items())
    reason = f"colors that follow deformation bring {figures}"
    least = MIN_STRAIN_GAIN_DB
    if is_tracked(facts.capture.root):
        least = MIN_TRACKED_STRAIN_GAIN_DB
        reason += "; a training gains more than they show of a capture by `stga track`"
    return Verdict(sum(gains.values()) / len(gains) >= least, reason)


def normal_color(facts: CaptureFacts) -> Verdict:
    """On where skin turns enough in a light that stays. What left-out frames show of it in sampled
    colors is less than what trainings gain."""
    change = facts.signal_change("normal")
    turn = np.degrees(3**0.5 * change)  # by component before
    reason = f"triangles turn by {turn:.1f}° (root mean square over frames)"
    return Verdict(bool(turn > MIN_TURN_DEG), reason, fixed=change < MIN_SIGNAL_CHANGE)


def relight(facts: CaptureFacts) -> Verdict:
    lit = "the lights of a scene that has any light the avatar"
    return Verdict(True, f"{lit}; elsewhere colors stay as recorded")


def world(facts: CaptureFacts) -> Verdict:
    spread = facts.backdrop_spread
    if spread is None:
        reason = "not every image has a mask that shows where the person ends"
        return Verdict(False, reason, fixed=True)
    if spread <= MAX_BACKGROUND_SPREAD_LEVELS:
        return Verdict(False, "what lies behind the person is of one color", fixed=True)
    # which have another pose or lens in some view than in their first
    first: dict[int, Camera] = {}
    moving = set()
    for view in facts.views:
        known = first.setdefault(view.camera_index, view.camera)
        first_numbers, numbers = (
            np.array([*camera.intrinsics, *camera.world_to_camera.ravel()])
            for camera in (known, view.camera)
        )
        if not np.allclose(first_numbers, numbers, atol=1e-6):
            moving.add(view.camera_index)
    if moving:
        return Verdict(False, f"{len(moving)} of {facts.cameras} cameras move", fixed=True)
    return Verdict(False, "kept only where it is asked for; no export has it but its own file")


def in_mouth(facts: CaptureFacts, part: str) -> Verdict | None:
    """On where lips or jaw open enough to show what is behind them."""
    if part not in facts.parts:
        return None
    jaw = facts.joint_angle("jaw")
    lips = facts.lip_gap_mm
    reason = f"the jaw opens by {jaw:.0f}°, the lips by {lips:.1f} mm"
    return Verdict(jaw > MIN_JAW_ANGLE_DEG or lips > MIN_LIP_GAP_MM, reason)


def torso(facts: CaptureFacts) -> Verdict | None:
    if not facts.frames:
        return None
    found = read_torso_motion(facts.capture.root)
    if found is None:
        where = "in the images, as `stga track` does where they have masks"
        return Verdict(False, f"the torso was not followed {where}")
    return Verdict(found.motion != "head", found.description)


def turning(facts: CaptureFacts, joints: Sequence[str]) -> Verdict | None:
    """On where one of these of `JOINTS` turns."""
    if not facts.frames:
        return None
    turn = facts.joint_angle(*joints)
    return Verdict(turn > MIN_JOINT_ANGLE_DEG, f"turns by up to {turn:.1f}°")


def dynamic_offsets(facts: CaptureFacts) -> Verdict | None:
    if not facts.frames:
        return None
    count = sum(frame.dynamic_offset is not None for frame in facts.frames)
    have = f"{count} of {len(facts.frames)} frames have some, and the tracked mesh with them"
    return Verdict(bool(count), have if count else "no frame has any", fixed=True)


def tracking(facts: CaptureFacts) -> Verdict | None:
    if not facts.frames:
        return None
    if facts.device != "cpu" or facts.timesteps == 1:
        reason = "the splats of a single frame follow its images without it"
        if facts.device != "cpu":
            reason = f"FLAME's parameters are refined on the CPU only, not on {facts.device}"
        return Verdict(False, reason, fixed=True)
    replaced = (facts.settings.effects or {}).get("background") != "off"
    if facts.shows_backdrop and replaced:
        reason = "images without a mask are cut by the very mesh that would be tracked"
        return Verdict(False, f"{reason} (`stga track --mattes auto` makes masks)", fixed=True)
    if is_tracked(facts.capture.root):
        sharper = "splats see motion more sharply than landmarks do"
        return Verdict(True, f"the capture is from `stga track`: {sharper}")
    # by two pixels or more
    outside = float(facts.samples.outside.sum() / max(facts.samples.mesh.sum(), 1))
    if np.isnan(outside):
        return Verdict(False, "without masks, the mesh cannot be compared with the images")
    reason = f"{outside:.2%} of the mesh sticks out of the masks"
    return Verdict(outside > MAX_OUTSIDE_FRACTION, reason)


RULES: dict[str, Rule] = {
    "occlusions": occlusions,
    "view-color": view_color,
    "exposure": exposure,
    "antialiasing": antialiasing,
    "background": background,
    "hull-points": hull_points,
    "depth-limits": depth_limits,
    "density": density,
    "selection": selection,
    "strain-color": strain,
    "normal-color": normal_color,
    "strain-position": strain,
    "relight": relight,
    "world": world,
    **{name: partial(in_mouth, part=name) for name in PARTS},
    "torso": torso,
    "neck": partial(turning, joints=["neck"]),
    "jaw": partial(turning, joints=["jaw"]),
    "eyes": partial(turning, joints=["left_eye", "right_eye"]),
    "dynamic-offsets": dynamic_offsets,
    "tracking": tracking,
}
"""Effect -> its rule."""
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
    capture, _ = with_training_views(capture)
    facts = CaptureFacts(capture, settings, device)
    choices = settings.effects
    decided = settings
    plan = []
    for effect in EFFECTS.values():
        choice = choices.get(effect.name, "auto")
        verdict = RULES[effect.name](facts)
        flag = f"--effect {effect.name}={choice}"
        if verdict is None:
            if choice == "on":
                lacks = "it has no parameters of FLAME"
                if effect.name in PARTS:
                    lacks = f"its mesh has no {PARTS[effect.name].kind}"
                raise StgaError(f"{flag}: {capture.root} has none: {lacks}")
            continue
        on = verdict.on if choice == "auto" else choice == "on"
        if verdict.fixed and on != verdict.on:
            raise StgaError(f"{flag}: is not possible, because {verdict.reason}")
        decided = _switched(decided, effect, on, verdict)
        if on and "covered" in verdict.changes:  # no other effect is for views that are left out
            facts = facts.without(decided.covered)
        plan.append(EffectDecision(effect.name, choice, on, verdict.reason, effect.cost))
    return decided, tuple(plan)


def add_effects(
    capture: Capture, settings: TrainingSettings, before: Plan
) -> tuple[TrainingSettings, Plan]:
    """Settings and plan with the effects that may be `added_later` where the capture, of all takes,
    calls for them and the run that is continued went without. A user's choice stays."""
    capture, _ = with_training_views(capture)
    facts = CaptureFacts(capture, settings)
    plan = {each.effect: each for each in before}
    for effect in EFFECTS.values():
        decision = plan.get(effect.name)
        if not effect.added_later or decision is None or decision.on:
            continue
        verdict = RULES[effect.name](facts) if decision.choice == "auto" else None
        if verdict is not None:
            plan[effect.name] = replace(decision, on=verdict.on, reason=verdict.reason)
            settings = _switched(settings, effect, verdict.on, verdict)
    return settings, tuple(plan.values())


def _switched(
    settings: TrainingSettings, effect: Effect, on: bool, verdict: Verdict
) -> TrainingSettings:
    changed = {**effect.on, **verdict.changes} if on else dict(effect.off)
    if effect.switch:
        changed[effect.switch] = on
    if effect.offsets:
        offsets = {*settings.driven_offsets} - {*effect.offsets} | {*(effect.offsets if on else ())}
        changed["driven_offsets"] = tuple(name for name in OFFSETS if name in offsets)
    return replace(settings, **changed)


def describe_effects(plan: Sequence[EffectDecision]) -> list[tuple[str, str]]:
    """(effect, decision and reason) lines."""
    return [(decision.effect, str(decision)) for decision in plan]
