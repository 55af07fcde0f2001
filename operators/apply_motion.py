"""Applies a FLAME motion or a face performance to the head as keyframes."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ..stga_addon.capture.open import open_capture
from ..stga_addon.driving import open_motion
from ..stga_addon.driving.head_map import head_turns
from ..stga_addon.driving.open_motion import MotionOptions, TrainedRange
from ..stga_addon.driving.performance import EXCHANGEABLE, amplified
from ..stga_addon.driving.performers import READ_SUFFIXES, is_performance, read_performance
from ..stga_addon.errors import StgaError
from ..stga_addon.flame.forward import FlameFrame
from ..stga_addon.flame.sequence import PARTS, FlameSequence, retimed
from ..stga_addon.scene import tags
from ..stga_addon.scene.objects import frames_per_second
from ..stga_addon.scene.record import stored_path
from ..stga_addon.scene.rig import motion as rig_motion
from ..stga_addon.scene.rig.keyframes import (
    Placement,
    apply_weights,
    checked_shape_keys,
    has_shapes,
)
from ..stga_addon.scene.tags import is_head
from . import common, options
from .common import Edit, FileImport, file_path, head_of, recorded_motion
from .options import ONCE

LAST_FRAME = 1_048_574
"""Blender's maximum frame number."""
PART_OF_SHAPES = {"face": "expression", "jaw": "jaw", "eyes": "eyes", "head": "neck"}
"""Part of a face performance -> that of the head which it moves."""
FIRST_OPTIONS = ("start", "strength", "neutral", "place")
"""First options of the dialog; the others unfold."""
NEUTRAL_LABELS = {"none": "As Recorded", "quiet": "Quiet Face", "first": "First Frame"}


def _part_property(name: str, what: str) -> Any:
    return options.boolean(name, f"Apply {what}", default=True, options=ONCE)


def _gain_property(part: str, what: str) -> Any:
    about = f"Of a face performance: factor of {what}"
    limits = {"min": 0.0, "max": 10.0}
    return options.number(f"{part} Gain", about, default=1.0, soft_max=2.0, options=ONCE, **limits)


def _exchange_property(pair: str) -> Any:
    """Whether left and right of a pair of shapes (`EXCHANGEABLE`) are exchanged."""
    what = f"exchange {pair}Left and {pair}Right, which some senders exchange"
    name = f"Exchange {pair.capitalize()} Sides"
    return options.boolean(name, f"Of a face performance: {what}", options=ONCE)


class MotionProperties:
    """Mixin: the `MotionOptions` that files, takes and live sources have in Blender."""

    strength: options.field(MotionOptions, "strength", soft_max=2.0, options=ONCE)
    stay_trained: options.number(
        "Stay Trained",
        "Lead expression, jaw and eyes softly back to the range of the head's own recording; "
        "1: fully",
        min=0.0,
        max=1.0,
        options=ONCE,
    )
    smoothing: options.field(MotionOptions, "smoothing", soft_max=0.2, options=ONCE)
    mirror: options.field(MotionOptions, "mirror", options=ONCE)
    exchange_jaw: _exchange_property("jaw")
    exchange_mouth: _exchange_property("mouth")

    def motion_options(self: Any, neutral: str, **more: Any) -> MotionOptions:
        pairs = tuple(pair for pair in EXCHANGEABLE if getattr(self, f"exchange_{pair}"))
        chosen = {name: getattr(self, name) for name in TAKEN_OVER}
        return MotionOptions(neutral=neutral, exchange=pairs, **chosen, **more)


TAKEN_OVER = ("strength", "stay_trained", "smoothing", "mirror")
"""Options of driving live that its takes are applied with; their sides are exchanged already."""


def measured_range(head: Any, motion: FlameSequence) -> TrainedRange:
    """Measure and store the range of the motion that a head was trained on."""
    trained = open_motion.trained_range([motion.frame(timestep) for timestep in motion.timesteps])
    rig_motion.store_range(head, trained)
    return trained


def _performer(settings: Any, name: str) -> Any:
    """The object of a name that is to perform, the panel's where it has that, rather than the head
    itself: linked objects may have the name of others."""
    named = [thing for thing in bpy.data.objects if thing.name == name]
    if settings.motion_source in named:
        return settings.motion_source
    return next((thing for thing in named if thing != settings.head), next(iter(named), None))


class ApplyMotion(Edit, bpy.types.Operator, FileImport, MotionProperties):
    """Animate this head with the expressions and pose of another person; its earlier animation is
    kept"""

    needs = (common.needs_rig_or_shapes,)

    filepath: options.path(
        "File",
        "FLAME parameters (.npz), the folder of a capture tracked with FLAME, or a face "
        "performance: CSV of Live Link Face or Audio2Face, its take folder, JSON of named "
        "weights, iFacialMocap's text",
        options=ONCE,
    )
    source: options.text(
        "Source",
        "Another imported head instead of a file: its motion in the scene's frame range",
        options=ONCE,
    )
    expression: _part_property("Expression", "the expression")
    jaw: _part_property("Jaw", "the rotation of the jaw")
    eyes: _part_property("Eyes", "the rotation of the eyes")
    neck: _part_property("Neck", "the rotation of the neck")
    head: _part_property("Head", "the rotation and translation of the whole head")
    own_offsets: options.boolean(
        "Own Offsets",
        "The motion is this head's own, refined by training: keep its tracked "
        "per-frame offsets, if any",
        options=ONCE,
    )
    start: options.integer(
        "Start Frame", "Frame of the first keyframe", default=1, min=0, options=ONCE
    )
    neutral: options.field(MotionOptions, "neutral", labels=NEUTRAL_LABELS, options=ONCE)
    face_gain: _gain_property("Face Shapes", "the face's shapes")
    jaw_gain: _gain_property("Jaw", "the jaw's shapes")
    eyes_gain: _gain_property("Eyes", "the gaze")
    head_gain: _gain_property("Head", "the head's rotation, which turns the neck")
    shape_gains: options.text(
        "Shape Gains",
        "Of a face performance: factors of single shapes, which take the place of "
        "their part's, such as jawOpen=0.8 cheekPuff=0",
        options=ONCE,
    )
    sliders: options.boolean(
        "Face Sliders",
        "Of a face performance: keyframe the sliders that are named as its shapes, "
        "where the head has them, in place of expressions, jaw and eyes; easier to edit, and a "
        "little less exact",
        options=ONCE,
    )
    fps: options.number(
        "Recorded At",
        "Frames per second of the recording; 0: one timestep for each frame of the "
        "scene. Of a face performance: where its file has no times",
        min=0.0,
        max=1000.0,
        options=ONCE,
    )
    speed: options.number(
        "Speed",
        "2: twice as fast; 0.5: half as fast",
        default=1.0,
        min=0.01,
        max=100.0,
        options=ONCE,
    )
    place: options.choice(
        "As",
        "Where the keyframes go; the earlier animation is kept in the file",
        ("action", "New Action", "A copy of the head's action with the chosen parts replaced"),
        ("strip", "NLA Strip", "A strip over the head's own animation, which plays around it"),
        options=ONCE,
    )
    blend: options.number(
        "Blend",
        "Of an NLA strip: frames over which it passes into strips that it overlaps, or into the "
        "head's own animation, at both ends",
        default=8.0,
        min=0.0,
        soft_max=60.0,
        options=ONCE,
    )
    fit_range: options.boolean(
        "Extend Frame Range",
        "Extend the scene's frame range to the end of the motion",
        default=True,
        options=ONCE,
    )
    filter_glob: options.file_filter(".npz", *READ_SUFFIXES)
    is_open: options.boolean(
        "More", "Parts, timing, and what face performances need", options={*ONCE, "HIDDEN"}
    )

    def draw(self, context: Any) -> None:
        column = self.layout.column()
        column.use_property_split = True
        names = list(ApplyMotion.__annotations__)
        shared = MotionProperties.__annotations__
        others = [*shared, *names[names.index("expression") : names.index("filter_glob")]]
        for name in FIRST_OPTIONS:
            column.prop(self, name)
        arrow = "DISCLOSURE_TRI_DOWN" if self.is_open else "DISCLOSURE_TRI_RIGHT"
        row = self.layout.row()
        row.alignment = "LEFT"
        row.prop(self, "is_open", icon=arrow, emboss=False)
        column = self.layout.column()
        column.use_property_split = True
        for name in others if self.is_open else ():
            if name not in FIRST_OPTIONS:
                column.prop(self, name)

    @classmethod
    def description(cls, context: Any, properties: Any) -> str:
        if properties.own_offsets:
            return "Animate this head with its tracking as refined by training; the earlier is kept"
        return ""  # that of the class

    def invoke(self, context: Any, event: Any) -> set[str]:
        return self.execute(context) if self.source else super().invoke(context, event)

    def run(self, context: Any) -> None:
        head = head_of(context)
        scene = context.scene
        parts = [part for part in PARTS if getattr(self, part)]
        if not parts:
            chosen = "choose expression, jaw, eyes, neck or head"
            raise StgaError(f"Apply Motion: no part is chosen; {chosen}")
        path = None if self.source else file_path(self.filepath, "motion")
        if path is not None:
            open_motion.check_motion(path)
        if path is not None and is_performance(path):
            name, count = self._apply_performance(context, head, path, parts)
        else:
            name, count = self._apply_frames(context, head, path, parts)
        end = self.start + count - 1
        if self.fit_range:
            scene.frame_end = max(scene.frame_end, end)
        scene.frame_set(scene.frame_current)
        self.inform(f"{name}: frames {self.start} to {end}")

    def _apply_frames(
        self, context: Any, head: Any, path: Path | None, parts: list[str]
    ) -> tuple[str, int]:
        """Apply a FLAME motion: of the file, read with this head's model, because expressions mean
        the same in both, or of another head. Returns its name and the number of frames."""
        render = context.scene.render
        other = _performer(context.scene.stga, self.source)
        if path is not None:
            model = common.flame_model_path(context, stored_path(head, tags.FLAME_MODEL))
            name = path.stem
            motion = open_capture(path, model).flame_motion()
            for sentence in motion.warnings:
                self.warn(sentence)
        elif not is_head(other):
            raise StgaError(f"{self.source}: is not an imported head")
        elif other == head:
            raise StgaError(f"{self.source}: is this head itself; choose another one, or a file")
        else:
            name = other.name
            sampled = common.scene_frames(context.scene)
            motion = rig_motion.sample_motion(other, recorded_motion(other), sampled, self.warn)
        rate = self.fps * render.fps_base / render.fps if self.fps else 1.0
        step = float(self.speed * rate)  # timesteps of the recording in a frame of the scene
        frames = retimed(motion, step)
        self._check_end(len(frames))
        frames, beyond = open_motion.adapted(frames, self._options(), self._trained(head))
        self._report_range(beyond)
        tracked = None
        if self.own_offsets:  # what the head was imported from, and where its timesteps come to lie
            recorded = recorded_motion(head)
            first = recorded.timesteps[0]
            tracked = recorded, [self.start + (each - first) / step for each in recorded.timesteps]
        placement = self._placement(name, parts)
        rig_motion.apply_motion(head, frames, placement, tracked, warn=self.warn)
        return name, len(frames)

    def _apply_performance(
        self, context: Any, head: Any, path: Path, parts: list[str]
    ) -> tuple[str, int]:
        """Apply a face performance to expressions and bones, or to shape keys of its names. Returns
        its name and the number of frames."""
        performance = read_performance(path, recorded_fps=self.fps or None)
        options = self._options()
        name = path.stem
        rate = frames_per_second(context.scene) / self.speed
        self._check_end(int(performance.times[-1] * rate) + 1)
        for sentence in performance.warnings:
            self.warn(sentence)
        if performance.lost:
            self.warn(f"{path.name}: {performance.lost} rows are missing and were interpolated")
        rig = common.rig_or_shapes(head)
        if rig is not None and not (self.sliders and has_shapes(head)):
            recorded = recorded_motion(head)
            trained = self._trained(head)
            motion = open_motion.performed(performance, recorded, head.name, options, trained, rate)
            frames = [motion.sequence.frame(timestep) for timestep in motion.sequence.timesteps]
            self._report_range(motion.outside)
            placement = self._placement(name, parts)
            rig_motion.apply_motion(head, frames, placement, warn=self.warn)
            return name, len(frames)
        kept = {part: float(shape_part in parts) for part, shape_part in PART_OF_SHAPES.items()}
        performance = open_motion.prepared_performance(amplified(performance, kept), options, rate)
        weights = np.clip(performance.weights, *rig_motion.WEIGHT_RANGE)
        if rig is None:
            placement = self._placement(name, parts)
            apply_weights(head.data.shape_keys, checked_shape_keys(head), weights, placement)
            return name, len(weights)
        still = np.zeros(3)
        turns = head_turns(performance.head)
        frames = [FlameFrame(np.zeros(0), still, turn, still, still, np.zeros(6)) for turn in turns]
        # on the expression the sliders would act
        placement = self._placement(name, list({*parts, "expression"}))
        rig_motion.apply_motion(head, frames, placement, weights=weights, warn=self.warn)
        return name, len(frames)

    def _placement(self, name: str, parts: list[str]) -> Placement:
        return Placement(self.start, name, parts, self.place == "strip", self.blend)

    def _options(self) -> MotionOptions:
        gains = {part: getattr(self, f"{part}_gain") for part in PART_OF_SHAPES}
        given = self.shape_gains.replace(",", " ").split()
        gains |= dict(map(open_motion.parsed_gain, given))
        return self.motion_options(self.neutral, gains=gains)

    def _trained(self, head: Any) -> TrainedRange | None:
        """The range of the head's own recording, where it is asked for."""
        if not self.stay_trained and self.neutral == "none":
            return None
        try:
            return measured_range(head, recorded_motion(head))
        except StgaError as error:
            if self.stay_trained:
                raise
            remedy = "the motion is put on the head without expression, not on its quiet face"
            self.warn(f"{error}; {remedy}")
            return rig_motion.stored_range(head)

    def _check_end(self, count: int) -> None:
        end = self.start + count - 1
        if end > LAST_FRAME:
            problem = f"would end at frame {end}; Blender's last frame is {LAST_FRAME}"
            raise StgaError(f"Apply Motion: {problem}")

    def _report_range(self, beyond: Mapping[str, np.ndarray]) -> None:
        for part, values in beyond.items():
            if values.any():
                fraction = f"{100 * float((values > 0).mean()):.0f} % of the frames"
                self.inform(f"{part}: {fraction} were outside the head's own recording")
