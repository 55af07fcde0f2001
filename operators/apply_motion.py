"""Applies a FLAME motion or a face performance to the head as keyframes."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

import bpy
import numpy as np

from ..stga_addon.capture.open import open_capture
from ..stga_addon.driving.head_map import head_turns
from ..stga_addon.driving.open_motion import (
    MotionOptions,
    TrainedRange,
    adapted,
    parsed_gain,
    performed,
    prepared_performance,
    trained_range,
)
from ..stga_addon.driving.performance import EXCHANGEABLE, parts_kept
from ..stga_addon.driving.read_performance import is_performance, read_performance
from ..stga_addon.errors import StgaError
from ..stga_addon.flame.forward import FlameFrame
from ..stga_addon.flame.sequence import PARTS, FlameSequence, retimed
from ..stga_addon.scene import tags
from ..stga_addon.scene.rig.keyframes import apply_weights, checked_shape_keys, has_shapes
from ..stga_addon.scene.rig.motion import (
    WEIGHT_RANGE,
    apply_motion,
    sample_motion,
    store_range,
    stored_range,
)
from . import ids
from .common import (
    FileImport,
    capture_of,
    file_filter,
    file_path,
    flame_model_path,
    flame_of,
    head_of,
    is_head,
    needs_rig_or_shapes,
    path_property,
    reporting,
    rig_or_none,
    tell,
)
from .options import option_property

LAST_FRAME = 1_048_574
"""Blender's maximum frame number."""
NEUTRAL_LABELS = {"none": "As Recorded", "quiet": "Quiet Face", "first": "First Frame"}


def _part_property(name: str, description: str) -> Any:
    return bpy.props.BoolProperty(
        name=name, description=description, default=True, options={"SKIP_SAVE"}
    )


def _gain_property(name: str, what: str) -> Any:
    return bpy.props.FloatProperty(
        name=name,
        description=f"Of a face performance: factor of {what}",
        default=1.0,
        min=0.0,
        soft_max=2.0,
        max=10.0,
        options={"SKIP_SAVE"},
    )


def exchange_property(pair: str) -> Any:
    """Whether left and right of a pair of shapes (`EXCHANGEABLE`) are exchanged."""
    return bpy.props.BoolProperty(
        name=f"Exchange {pair.capitalize()} Sides",
        description=f"Of a face performance: exchange {pair}Left and {pair}Right, which some "
        "senders exchange",
        options={"SKIP_SAVE"},
    )


class ApplyMotion(bpy.types.Operator, FileImport):
    """Animate this head with the expressions and pose of another person; its earlier animation is
    kept"""

    bl_idname = ids.APPLY_MOTION
    bl_label = "Apply Motion"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    filepath: path_property(
        "File",
        "FLAME parameters (.npz), the folder of a capture tracked with FLAME, or a face "
        "performance: CSV of Live Link Face or Audio2Face, its take folder, JSON of named "
        "weights, iFacialMocap's text",
        options={"SKIP_SAVE"},
    )
    source: bpy.props.StringProperty(
        name="Source",
        description="Another imported head instead of a file: its motion in the scene's frame "
        "range",
        options={"SKIP_SAVE"},
    )
    expression: _part_property("Expression", "Apply the expression")
    jaw: _part_property("Jaw", "Apply the rotation of the jaw")
    eyes: _part_property("Eyes", "Apply the rotation of the eyes")
    neck: _part_property("Neck", "Apply the rotation of the neck")
    head: _part_property("Head", "Apply the rotation and translation of the whole head")
    strength: option_property(MotionOptions, "strength", soft_max=2.0, options={"SKIP_SAVE"})
    own_offsets: bpy.props.BoolProperty(
        name="Own Offsets",
        description="The motion is this head's own, refined by training: keep its tracked "
        "per-frame offsets, if any",
        options={"SKIP_SAVE"},
    )
    start: bpy.props.IntProperty(
        name="Start Frame", description="Frame of the first keyframe", default=1, min=0,
        options={"SKIP_SAVE"},
    )  # fmt: skip
    neutral: option_property(MotionOptions, "neutral", labels=NEUTRAL_LABELS, options={"SKIP_SAVE"})
    stay_trained: bpy.props.FloatProperty(
        name="Stay Trained",
        description="Lead expression, jaw and eyes softly back to the range of the head's own "
        "recording; 1: fully",
        min=0.0, max=1.0, options={"SKIP_SAVE"},
    )  # fmt: skip
    smoothing: option_property(MotionOptions, "smoothing", soft_max=0.2, options={"SKIP_SAVE"})
    mirror: option_property(MotionOptions, "mirror", options={"SKIP_SAVE"})
    face_gain: _gain_property("Face Gain", "the face's shapes")
    jaw_gain: _gain_property("Jaw Gain", "the jaw's shapes")
    eyes_gain: _gain_property("Eyes Gain", "the gaze")
    head_gain: _gain_property("Head Gain", "the head's rotation, which turns the neck")
    shape_gains: bpy.props.StringProperty(
        name="Shape Gains",
        description="Of a face performance: factors of single shapes, which take the place of "
        "their part's, such as jawOpen=0.8 cheekPuff=0",
        options={"SKIP_SAVE"},
    )
    exchange_jaw: exchange_property("jaw")
    exchange_mouth: exchange_property("mouth")
    sliders: bpy.props.BoolProperty(
        name="Face Sliders",
        description="Of a face performance: keyframe the sliders that are named as its shapes, "
        "where the head has them, in place of expressions, jaw and eyes; easier to edit, and a "
        "little less exact",
        options={"SKIP_SAVE"},
    )
    fps: bpy.props.FloatProperty(
        name="Recorded At",
        description="Frames per second of the recording; 0: one timestep for each frame of the "
        "scene. A face performance has its own times",
        min=0.0, max=1000.0, options={"SKIP_SAVE"},
    )  # fmt: skip
    speed: bpy.props.FloatProperty(
        name="Speed", description="2: twice as fast; 0.5: half as fast", default=1.0, min=0.01,
        max=100.0, options={"SKIP_SAVE"},
    )  # fmt: skip
    place: bpy.props.EnumProperty(
        name="As", description="Where the keyframes go; the earlier animation is kept in the file",
        items=(
            ("action", "New Action", "A copy of the head's action with the chosen parts replaced"),
            (
                "strip",
                "NLA Strip",
                "A strip over the head's own animation, which plays before and after it",
            ),
        ),
        options={"SKIP_SAVE"},
    )  # fmt: skip
    fit_range: bpy.props.BoolProperty(
        name="Extend Frame Range",
        description="Extend the scene's frame range to the end of the motion", default=True,
        options={"SKIP_SAVE"},
    )  # fmt: skip
    filename_ext = ".npz"
    filter_glob: file_filter(".npz", ".csv", ".json", ".txt")

    @classmethod
    def description(cls, context: Any, properties: Any) -> str:
        if properties.own_offsets:
            return "Animate this head with its tracking as refined by training; the earlier is kept"
        return ""  # that of the class

    poll = classmethod(needs_rig_or_shapes)

    def invoke(self, context: Any, event: Any) -> set[str]:
        return self.execute(context) if self.source else super().invoke(context, event)

    @reporting
    def execute(self, context: Any) -> set[str]:
        head = head_of(context)
        parts = [part for part in PARTS if getattr(self, part)]
        if not parts:
            raise StgaError(
                "Apply Motion: no part is chosen; choose expression, jaw, eyes, neck or head"
            )
        path = None if self.source else file_path(self.filepath, "motion")
        if path is not None and is_performance(path):
            name, count = path.stem, self._apply_performance(context.scene, head, path, parts)
        else:
            name, count = self._apply_frames(context, head, parts)
        end = self.start + count - 1
        if self.fit_range:
            context.scene.frame_end = max(context.scene.frame_end, end)
        context.scene.frame_set(context.scene.frame_current)
        self.report({"INFO"}, f"{name}: frames {self.start} to {end}")
        return {"FINISHED"}

    def _apply_frames(self, context: Any, head: Any, parts: list[str]) -> tuple[str, int]:
        """Apply a FLAME motion; returns its name and number of frames."""
        name, motion = self._motion(context, head)
        step = self._step(context.scene)
        frames = retimed(motion, step)
        self._check_end(len(frames))
        frames, beyond = adapted(frames, self._options(), self._trained(head))
        self._report_range(beyond)
        tracked = self._tracked(head, step) if self.own_offsets else None
        apply_motion(
            head, frames, self.start, name, parts, self.place == "strip", self._warn, tracked
        )
        return name, len(frames)

    def _apply_performance(self, scene: Any, head: Any, path: Path, parts: list[str]) -> int:
        """Apply a face performance to expressions and bones, or to shape keys of its names; returns
        the number of frames."""
        performance, options = read_performance(path), self._options()
        rate = scene.render.fps / scene.render.fps_base / self.speed
        self._check_end(int(performance.times[-1] * rate) + 1)
        if performance.lost:
            self._warn(f"{path.name}: {performance.lost} rows are missing and were interpolated")
        rig, as_strip = rig_or_none(head), self.place == "strip"
        if rig is not None and not (self.sliders and has_shapes(head)):
            motion = performed(
                performance,
                flame_of(capture_of(head), head.name),
                head.name,
                options,
                self._trained(head),
                rate,
            )
            frames = [motion.sequence.frame(timestep) for timestep in motion.sequence.timesteps]
            self._report_range(motion.outside)
            apply_motion(head, frames, self.start, path.stem, parts, as_strip, self._warn)
            return len(frames)
        chosen = {"face": self.expression, "jaw": self.jaw, "eyes": self.eyes, "head": self.neck}
        kept = parts_kept(performance, tuple(part for part in chosen if chosen[part]))
        prepared = prepared_performance(kept, options, rate)
        weights = np.clip(prepared.weights, *WEIGHT_RANGE)
        if rig is None:
            paths = checked_shape_keys(head)
            apply_weights(head.data.shape_keys, paths, weights, self.start, path.stem, as_strip)
            return len(weights)
        still, turns = np.zeros(3), np.zeros((len(weights), 3))
        turns = turns if prepared.head is None else head_turns(prepared.head)
        frames = [FlameFrame(np.zeros(0), still, turn, still, still, np.zeros(6)) for turn in turns]
        parts = list({*parts, "expression"})  # on which the sliders would act
        apply_motion(
            head, frames, self.start, path.stem, parts, as_strip, self._warn, weights=weights
        )
        return len(weights)

    def _options(self) -> MotionOptions:
        gains = {
            "face": self.face_gain,
            "jaw": self.jaw_gain,
            "eyes": self.eyes_gain,
            "head": self.head_gain,
        }
        gains |= dict(parsed_gain(text) for text in self.shape_gains.replace(",", " ").split())
        exchange = tuple(pair for pair in EXCHANGEABLE if getattr(self, f"exchange_{pair}"))
        return MotionOptions(
            self.strength,
            self.neutral,
            self.smoothing,
            self.mirror,
            gains,
            self.stay_trained,
            exchange,
        )

    def _trained(self, head: Any) -> TrainedRange | None:
        """The range of the head's own recording, where it is asked for."""
        if not self.stay_trained and self.neutral == "none":
            return None
        try:
            own = flame_of(capture_of(head), head.name)
        except StgaError as error:
            if self.stay_trained:
                raise
            self._warn(
                f"{error}; the motion is put on the head without expression, not on its quiet face"
            )
            return stored_range(head)
        trained = trained_range([own.frame(timestep) for timestep in own.timesteps])
        store_range(head, trained)
        return trained

    def _check_end(self, count: int) -> None:
        end = self.start + count - 1
        if end > LAST_FRAME:
            raise StgaError(
                f"Apply Motion: would end at frame {end}; Blender's last frame is {LAST_FRAME}"
            )

    def _report_range(self, beyond: Mapping[str, np.ndarray]) -> None:
        for part, values in beyond.items():
            if values.any():
                share = 100 * float((values > 0).mean())
                self.report(
                    {"INFO"},
                    f"{part}: {share:.0f} % of the frames were outside the head's own recording",
                )

    def _motion(self, context: Any, head: Any) -> tuple[str, FlameSequence]:
        if not self.source:
            path = file_path(self.filepath, "motion")
            return path.stem, _recorded(context, path, head)
        other = bpy.data.objects.get(self.source)
        if not is_head(other):
            raise StgaError(f"{self.source}: is not an imported head")
        if other == head:
            raise StgaError(f"{self.source}: is this head itself; choose another one, or a file")
        numbers = range(context.scene.frame_start, context.scene.frame_end + 1)
        return other.name, sample_motion(
            other, flame_of(capture_of(other), other.name), numbers, self._warn
        )

    def _tracked(self, head: Any, step: float) -> tuple[FlameSequence, list[float]]:
        """What the head was imported from, and where its timesteps come to lie."""
        own = flame_of(capture_of(head), head.name)
        return own, [
            self.start + (timestep - own.timesteps[0]) / step for timestep in own.timesteps
        ]

    def _step(self, scene: Any) -> float:
        """Timesteps of the recording that a frame of the scene takes."""
        return float(
            self.speed * (self.fps * scene.render.fps_base / scene.render.fps if self.fps else 1.0)
        )

    def _warn(self, sentence: str) -> None:
        tell(self, "WARNING", sentence)


def _recorded(context: Any, path: Path, head: Any) -> FlameSequence:
    """The motion of a file or a capture, read with this head's model: expressions mean the same in
    both."""
    model = flame_model_path(context, head.get(tags.FLAME_MODEL, ""))
    return flame_of(open_capture(path, flame=model), str(path))
