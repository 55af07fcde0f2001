"""Another person's FLAME motion → this head's keyframes."""

from pathlib import Path
from typing import Any, ClassVar

import bpy

from ..stga_addon.capture.open import open_capture
from ..stga_addon.errors import StgaError
from ..stga_addon.flame.motion import PARTS, retimed, strengthened
from ..stga_addon.flame.sequence import FlameSequence
from ..stga_addon.scene import tags
from ..stga_addon.scene.compat import PATH_OPTIONS
from ..stga_addon.scene.rig.motion import apply_motion, sample_motion
from . import ids
from .common import capture_of, file_path, flame_model_path, flame_of, head_of, is_head, needs_rig, reporting

LAST_FRAME = 1_048_574  # that Blender counts to


class ApplyMotion(bpy.types.Operator):
    """Animate this head by another person's expressions and pose; what animated it before is kept"""

    bl_idname = ids.APPLY_MOTION
    bl_label = "Apply Motion"
    bl_options: ClassVar[set[str]] = {"REGISTER", "UNDO"}

    filepath: bpy.props.StringProperty(
        name="File",
        description="FLAME parameters (.npz), or the folder of a capture tracked with FLAME",
        subtype="FILE_PATH",
        options=PATH_OPTIONS,
    )
    source: bpy.props.StringProperty(
        name="Source",
        description="Another imported head instead of a file: its motion as it plays in the scene's frame range",
    )
    expression: bpy.props.BoolProperty(name="Expression", description="Take the expression", default=True)
    jaw: bpy.props.BoolProperty(name="Jaw", description="Take the rotation of the jaw", default=True)
    eyes: bpy.props.BoolProperty(name="Eyes", description="Take the rotation of the eyes", default=True)
    neck: bpy.props.BoolProperty(name="Neck", description="Take the rotation of the neck", default=True)
    head: bpy.props.BoolProperty(
        name="Head", description="Take the rotation and translation of the whole head", default=True
    )
    strength: bpy.props.FloatProperty(
        name="Strength",
        description="1 as recorded, more to exaggerate; the whole head moves more or less about where it begins",
        default=1.0,
        min=0.0,
        soft_max=2.0,
        max=10.0,
    )
    own_offsets: bpy.props.BoolProperty(
        name="Own Offsets",
        description="The motion is this head's own, refined: its tracked per-frame offsets, if it has any, play along",
    )
    start: bpy.props.IntProperty(name="Start Frame", description="Frame of the first keyframe", default=1, min=0)
    fps: bpy.props.FloatProperty(
        name="Recorded At",
        description="Frames per second of the recording; 0: one timestep a frame of the scene",
        min=0.0,
        max=1000.0,
    )
    speed: bpy.props.FloatProperty(
        name="Speed", description="2 plays twice as fast, 0.5 half as fast", default=1.0, min=0.01, max=100.0
    )
    place: bpy.props.EnumProperty(
        name="As",
        description="Where the keyframes go; the animation that was there is kept in the file",
        items=(
            ("action", "New Action", "A copy of the head's action with the chosen parts exchanged"),
            ("strip", "NLA Strip", "A strip over the head's own animation, which plays on before and after it"),
        ),
    )
    fit_range: bpy.props.BoolProperty(
        name="Extend Frame Range", description="Let the scene play as long as the motion lasts", default=True
    )
    filter_glob: bpy.props.StringProperty(default="*.npz", options={"HIDDEN"})

    @classmethod
    def description(cls, context: Any, properties: Any) -> str:
        if properties.own_offsets:
            return "Put this head on its tracking as training refined it; what animated it before is kept"
        return ""  # the class' own

    @classmethod
    def poll(cls, context: Any) -> bool:
        return needs_rig(cls, context)

    def invoke(self, context: Any, event: Any) -> set[str]:
        if self.source:
            return self.execute(context)
        context.window_manager.fileselect_add(self)
        return {"RUNNING_MODAL"}

    @reporting
    def execute(self, context: Any) -> set[str]:
        head = head_of(context)
        parts = [part for part in PARTS if getattr(self, part)]
        if not parts:
            raise StgaError("apply motion: no part is chosen; take the expression, jaw, eyes, neck or head")
        name, motion = self._motion(context, head)
        step = self._step(context.scene)
        frames = retimed(motion, step)
        end = self.start + len(frames) - 1
        if end > LAST_FRAME:
            raise StgaError(f"apply motion: would end in frame {end}, Blender counts to {LAST_FRAME}")
        if self.strength != 1.0:
            frames = strengthened(frames, self.strength)
        tracked = self._tracked(head, step) if self.own_offsets else None
        apply_motion(head, frames, self.start, name, parts, self.place == "strip", self._warn, tracked)
        if self.fit_range:
            context.scene.frame_end = max(context.scene.frame_end, end)
        context.scene.frame_set(context.scene.frame_current)
        self.report({"INFO"}, f"{name}: frames {self.start} to {end}")
        return {"FINISHED"}

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
        return other.name, sample_motion(other, flame_of(capture_of(other), other.name), numbers, self._warn)

    def _tracked(self, head: Any, step: float) -> tuple[FlameSequence, list[float]]:
        """What the head was imported from, and where its timesteps come to lie."""
        own = flame_of(capture_of(head), head.name)
        return own, [self.start + (timestep - own.timesteps[0]) / step for timestep in own.timesteps]

    def _step(self, scene: Any) -> float:
        """Timesteps of the recording that a frame of the scene takes."""
        return float(self.speed * (self.fps * scene.render.fps_base / scene.render.fps if self.fps else 1.0))

    def _warn(self, sentence: str) -> None:
        self.report({"WARNING"}, sentence)


def _recorded(context: Any, path: Path, head: Any) -> FlameSequence:
    """The motion of a file or a capture, read with this head's model: expressions mean the same in both."""
    model = flame_model_path(context, head.get(tags.FLAME_MODEL, ""))
    return flame_of(open_capture(path, flame=model), str(path))
