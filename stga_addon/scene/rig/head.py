"""The tracked head as an animated mesh, and meshes with shape keys as head models. The mesh of a
FLAME head equals FLAME's forward pass, for any pose: expression coefficients are shape keys, joint
rotations pose bones, pose correctives shape keys driven by the bones, skinning is the armature
modifier. The first identity components are shape keys relative to the tracked person. FLAME
regresses its joints from the *shaped* vertices, so sliders displace a joint's center of rotation by
d = D·sliders, which a bone's rest position cannot follow. Such a joint's bone is therefore the
child of a hidden bone `<name>_joint`, driven to d, and the parent of a hidden bone `<name>_deform`,
driven to -d, which the vertices follow. All drivers are arithmetic, which Blender evaluates without
Python."""

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix, Vector

from ...capture.model import Capture
from ...errors import StgaError
from ...flame.forward import FlameFrame, joint_positions, shaped_vertices
from ...flame.model import JOINTS, FlameModel
from ...flame.sequence import MIN_JOINT_ANGLE_DEG, FlameSequence, joint_angles
from .. import arrays, tags
from ..arrays import Z_UP_TO_Y_UP, add_driver, flat_floats, key_points
from ..kept_animation import (
    KeptAnimation,
    give_added_curves,
    give_animation,
    is_unused_import,
    keep_animation,
    mark_imported,
)
from ..objects import (
    Warn,
    capture_root,
    leave_edit_mode,
    log_warning,
    mover_of,
    place,
    remove,
    reset,
)
from ..record import capture_of
from . import keyframes
from .drivers import give_drivers, keep_drivers
from .keyframes import MAX_SLIDER, key_value_path, location_path, property_path, rotation_path


def import_head(capture: Capture, warn: Warn = log_warning, correctives: str = "all") -> Any:
    """The capture's head as a mesh object, animated so that Blender's frame is the capture's
    timestep. A FLAME capture becomes a rig (see `add_rig`, also for `correctives`); any other gets
    a shape key per timestep, `t00012`, which is 1 at its own frame. Object coordinates are the
    capture's (meters, y up). Regions become boolean face attributes. Importing the same source
    again replaces the last import; performances and actions made by hand stay, and, if the
    triangles are the same, vertex groups, materials and other shape keys.
    `warn` receives one sentence per problem. Raises StgaError where a timestep cannot be read, and
    leaves the scene."""
    sequence = capture.flame
    frames = [] if sequence is None else sequence.frames()
    meshes = []
    if sequence is None:
        meshes = [flat_floats(capture.mesh(timestep)) for timestep in capture.timesteps]
    before = _imported_before(capture)
    if before is not None:
        check_editable(before)
        _check_parent(before)
        if not arrays.has_triangles(before.data, capture.faces):
            gone = "shape keys, vertex groups and materials of before are gone"
            warn(f"{before.name}: the capture has other triangles, so {gone}")
    owners = _animated(before)
    kept = [keep_animation(each) for each in owners]
    drivers = [keep_drivers(each) for each in owners]
    others = _other_keys(before, capture)
    head = _place_head(capture)
    if sequence is not None:
        rig = add_rig(head, sequence, frames, warn, correctives)
        mark_imported(rig)
    else:
        _add_timesteps(head, capture.timesteps, meshes)
    _add_keys(head, others)
    mark_imported(head.data.shape_keys)
    for owner, animation, driven in zip(_animated(head), kept, drivers, strict=True):
        if owner is not None:
            give_added_curves(owner, animation)
            _give_back(owner, animation)
            if names := ", ".join(animation.lost):
                gone = "transitions and meta strips are gone, but not their clips"
                warn(f"{owner.name}: {gone}: {names}")
            give_drivers(owner, driven, warn)
    left = {each for each in bpy.data.actions if is_unused_import(each) and not each.users}
    bpy.data.batch_remove(left)
    return head


def _imported_before(capture: Capture) -> Any | None:
    """The head that another import replaces: of several of one capture the panel's."""
    heads = tags.find(tags.HEAD, capture.root)
    chosen = getattr(getattr(bpy.context.scene, "stga", None), "head", None)
    return chosen if chosen in heads else next(iter(heads), None)


def _animated(head: Any) -> tuple[Any, Any, Any]:
    """The data-blocks of a head that may be animated: its shape keys, its rig, and itself."""
    if head is None:
        return None, None, None
    return head.data.shape_keys, next(iter(_rigs(head)), None), head


def follow_moved_capture(
    heads: Iterable[Any], capture: Capture, log: Callable[[str], object]
) -> None:
    """Let a head, with all that was imported with it, be that of a capture that is its own, moved:
    where the folder of before is gone, and triangles, timesteps and neutral mesh are the same."""
    for head in heads:
        is_gone = head.library is None and not capture_of(head).exists()
        if not (is_gone and arrays.has_triangles(head.data, capture.faces)):
            continue
        is_same = list(head.get(tags.TIMESTEPS, ())) == list(capture.timesteps)
        off = np.abs(arrays.mesh_vertices(head.data) - capture.neutral).max()
        if not (is_same and off < MAX_DIFFERENCE_M):
            continue
        before = head[tags.CAPTURE]
        for each in bpy.data.objects:
            if each.library is None and each.get(tags.CAPTURE) == before:
                each[tags.CAPTURE] = str(capture.root.resolve())
        log(f"{head.name}: its capture was moved from {before}")


MAX_DIFFERENCE_M = 1e-4
"""Distance of a neutral mesh's vertices, up to which two captures are of one tracking."""


def _give_back(owner: Any, kept: KeptAnimation) -> None:
    if kept.tracks:
        keyframes.push_down_motion(owner, kept.blend)
    if kept.held:
        keyframes.hold_beside_strips(owner, kept.held)
    give_animation(owner, kept)


def _add_timesteps(head: Any, timesteps: Sequence[int], meshes: Sequence[np.ndarray]) -> None:
    """A shape key for each timestep, and no rig of an earlier import."""
    rigs = _rigs(head)
    _remove_bone_groups(head, rigs)
    for modifier in list(head.modifiers):
        if modifier.type == "ARMATURE" and modifier.object in rigs:
            head.modifiers.remove(modifier)
    remove(rigs)
    names = [f"t{timestep:05d}" for timestep in timesteps]
    for name, mesh in zip(names, meshes, strict=True):
        head.shape_key_add(name=name, from_mix=False).points.foreach_set("co", mesh)
    keys = head.data.shape_keys
    arrays.write_triangle_curves(keys, [key_value_path(name) for name in names], timesteps)


TIMESTEP_KEY = re.compile(r"t\d{5,}")
"""Name of a shape key that the import of a mesh capture makes."""
FLAME_KEY = re.compile(r"(expr_|identity_|offset_t)\d+|pose_\w+_\d\d")
"""Name of a shape key that the import of a FLAME capture makes."""
KEY_FIELDS = ("slider_min", "slider_max", "value", "mute", "vertex_group")
"""Fields of a shape key that are kept beside its shape, in an order in which they can be set."""
OtherKey = tuple[np.ndarray, dict[str, Any]]


def _other_keys(head: Any, capture: Capture) -> dict[str, OtherKey]:
    """Displacements (V, 3) and `KEY_FIELDS` of the shape keys that no import made, such as ARKit's
    of a mesh without FLAME; none where the triangles change."""
    keys = head.data.shape_keys if head is not None else None
    if keys is None or not arrays.has_triangles(head.data, capture.faces):
        return {}
    pattern = TIMESTEP_KEY if find_rig(head) is None else FLAME_KEY
    made = set(head.get(keyframes.EXPRESSION_NAMES, "").split(","))
    made |= keyframes.added_shapes(head)
    others = [key for key in keys.key_blocks[1:] if not pattern.fullmatch(key.name)]
    return {
        each.name: (
            key_points(each) - key_points(each.relative_key),
            {field: getattr(each, field) for field in KEY_FIELDS},
        )
        for each in others
        if each.name not in made
    }


def _add_keys(head: Any, keys: Mapping[str, OtherKey]) -> None:
    basis = key_points(head.data.shape_keys.reference_key)
    for name, (displacement, fields) in keys.items():
        key = head.shape_key_add(name=name, from_mix=False)
        key.points.foreach_set("co", flat_floats(basis + displacement))
        for field, value in fields.items():
            setattr(key, field, value)


def _place_head(capture: Capture) -> Any:
    root = capture_root(capture.root)
    head = _imported_before(capture)
    if head is not None and arrays.has_triangles(head.data, capture.faces):
        # Into the same mesh, which keeps materials, vertex groups and painted attributes.
        reset(head)
        mesh = head.data
        mesh.vertices.foreach_set("co", flat_floats(capture.neutral))
        mesh.update()
        for name in mesh.attributes.keys():  # noqa: SIM118
            if name.startswith(tags.REGION_PREFIX):
                mesh.attributes.remove(mesh.attributes[name])
        # last first: removing a group renumbers those after it
        for group in reversed(list(head.vertex_groups)):
            timestep = tags.group_timestep(group.name)
            if timestep is not None and timestep not in capture.timesteps:
                head.vertex_groups.remove(group)
    else:
        title = f"{root.name} head"
        mesh = arrays.triangle_mesh(title, capture.neutral, capture.faces)
        head = place(root, tags.HEAD, title, mesh, head)
    for region, members in capture.regions.items():
        attribute = head.data.attributes.new(tags.REGION_PREFIX + region, "BOOLEAN", "FACE")
        attribute.data.foreach_set("value", np.ascontiguousarray(members, bool))
    head[tags.TIMESTEPS] = [int(timestep) for timestep in capture.timesteps]
    head.shape_key_add(name="Basis", from_mix=False)
    return head


def has_shape_keys(thing: Any) -> bool:
    """Whether an object (or None) is a mesh with shape keys besides the basis."""
    keys = thing.data.shape_keys if thing is not None and thing.type == "MESH" else None
    return keys is not None and len(keys.key_blocks) > 1


def shape_key_model(thing: Any) -> tuple[np.ndarray, np.ndarray, tuple[str, ...], np.ndarray]:
    """Basis (V, 3) in meters, y up, triangles (F, 3), names and displacements (V, 3, K) of the
    other shape keys, in world space turned from Blender's axes; without modifiers, values and
    drivers. Raises StgaError for an object without shape keys."""
    if not has_shape_keys(thing):
        raise StgaError(f"{thing.name}: has no shape keys; a head model needs some")
    turn = Z_UP_TO_Y_UP @ np.array(thing.matrix_world)
    basis = thing.data.shape_keys.reference_key
    mean = key_points(basis) @ turn[:3, :3].T + turn[:3, 3]
    others = [block for block in thing.data.shape_keys.key_blocks if block != basis]
    moved = np.stack([key_points(each) - key_points(each.relative_key) for each in others], axis=2)
    shapes = np.einsum("ab,vbk->vak", turn[:3, :3], moved)
    thing.data.calc_loop_triangles()
    faces = arrays.read_values(thing.data.loop_triangles, "vertices", 3, np.int32)
    return mean, faces, tuple(block.name for block in others), shapes


RIG_BONES = {
    name
    for joint in JOINTS
    for name in (joint, keyframes.parent_bone(joint), keyframes.deform_bone(joint))
}
"""Names of the bones that an import makes."""
BONE_SHAPE = "STGA Bone"
BONE_LENGTH = 0.03  # meters; only how long the bones are displayed
NEGLIGIBLE_DISPLACEMENT = 1e-6  # meters along an axis, with all sliders at their limits
SQUARED_NORM = "(w*w+x*x+y*y+z*z)"  # keyed quaternions are interpolated without normalization
# (rotation - identity) / 2 as quadratic forms of the quaternion, row by row.
ROTATION_MINUS_IDENTITY = (
    ("-y*y-z*z", "x*y-w*z", "x*z+w*y"),
    ("x*y+w*z", "-x*x-z*z", "y*z-w*x"),
    ("x*z-w*y", "y*z+w*x", "-x*x-y*y"),
)
VARIABLES = "abcdfghijklmnopqrs"  # of a driver, whose expression has at most 255 characters


def add_rig(
    head: Any, sequence: FlameSequence, frames: Sequence[FlameFrame], warn: Warn, correctives: str
) -> Any:
    """Rig and animate `head`, the sequence's neutral mesh with a "Basis" key; returns the armature
    object. The evaluated mesh equals `flame_forward` within 1e-5 m. Vertex offsets that change by
    frame become a shape key per timestep; `warn` reports coefficients beyond ±10.
    correctives: "all", or "moving": of joints only that turn in the frames."""
    model = sequence.model
    no_expression = np.zeros(model.n_expression)
    basis = shaped_vertices(model, sequence.shape, no_expression, sequence.static_offset)
    sliders = keyframes.slider_components(model)
    # (5, 3, K): how far each component of the shape moves each joint.
    shapes = model.shapedirs[:, :, list(sliders.values())]
    directions = np.einsum("jv,vck->jck", model.j_regressor, shapes)
    has_offsets = any(frame.dynamic_offset is not None for frame in frames)
    displaced = [has_offsets or any(_significant_terms(direction)) for direction in directions]
    moved = zip(JOINTS, displaced, strict=True)
    deformed = [keyframes.deform_bone(name) if moves else name for name, moves in moved]
    _remove_bone_groups(head, _rigs(head))
    rig = _place_armature(head, joint_positions(model, basis), model.parents, deformed)
    _skin(head, rig, deformed, model.weights)
    _draw_at_skin(rig, basis, model.weights, joint_positions(model, basis))
    head.pop(keyframes.ARKIT_MAP, None)  # of shape keys that an earlier import had
    if model.expression_names:
        head[keyframes.EXPRESSION_NAMES] = ",".join(model.expression_names)
    for name, component in sliders.items():
        shape = basis + model.shapedirs[:, :, component]
        _new_shape_key(head, name, shape, *keyframes.slider_range(name))
    corrected = np.array(correctives == "all") | (joint_angles(frames) > MIN_JOINT_ANGLE_DEG)
    _add_correctives(head, rig, model, basis, corrected)
    keyframes.key_motion(head, rig, np.array(sequence.timesteps), frames, warn=warn)
    if has_offsets:
        for timestep, frame in zip(sequence.timesteps, frames, strict=True):
            offset = 0 if frame.dynamic_offset is None else frame.dynamic_offset
            _new_shape_key(head, keyframes.offset_key(timestep), basis + offset, 0.0, 1.0)
        for name in JOINTS:
            rig[keyframes.offset_property(name)] = [0.0] * 3
        keyframes.key_tracked_offsets(head, rig, sequence, sequence.timesteps)
    for joint in np.flatnonzero(displaced).tolist():
        _drive_joint(head, rig, JOINTS[joint], list(sliders), directions[joint])
    return rig


def _skin(head: Any, rig: Any, bones: Sequence[str], weights: np.ndarray) -> None:
    """Let the head's mesh follow the bones by the weights (V, 5)."""
    for name, column in zip(bones, weights.T, strict=True):
        group = head.vertex_groups.new(name=name)
        for vertex in np.flatnonzero(column).tolist():
            group.add([vertex], column[vertex], "REPLACE")
    modifiers = (old for old in head.modifiers if old.type == "ARMATURE" and old.object == rig)
    modifier = next(modifiers, None) or head.modifiers.new(rig.name, "ARMATURE")
    modifier.object = rig
    modifier.use_vertex_groups = True
    modifier.use_bone_envelopes = False
    modifier.use_deform_preserve_volume = False


def _add_correctives(
    head: Any, rig: Any, model: FlameModel, basis: np.ndarray, corrected: np.ndarray
) -> None:
    """Shape keys of the `corrected` joints (5,), nine per joint, each driven by one entry of the
    joint's rotation minus identity."""
    for feature in range(model.posedirs.shape[2]):
        joint = 1 + feature // 9
        row = feature % 9 // 3
        column = feature % 3
        if not corrected[joint] or not model.posedirs[:, :, feature].any():
            continue
        name = f"pose_{JOINTS[joint]}_{row}{column}"
        path = rotation_path(JOINTS[joint])
        _new_shape_key(head, name, basis + model.posedirs[:, :, feature], -2.0, 2.0)
        expression = f"2*({ROTATION_MINUS_IDENTITY[row][column]})/{SQUARED_NORM}"
        rotation = {letter: (rig, f"{path}[{k}]") for k, letter in enumerate("wxyz")}
        add_driver(head.data.shape_keys, key_value_path(name), -1, expression, rotation)


def find_rig(head: Any) -> Any:
    """The armature object that moves `head`; None where it has no FLAME rig."""
    for modifier in head.modifiers:
        rig = modifier.object if modifier.type == "ARMATURE" else None
        if rig is not None and rig.get(tags.KIND) == tags.RIG:
            return rig
    return None


def rig_of(head: Any) -> Any:
    """The armature object that moves `head`, to read its pose. Raises StgaError where it has no
    FLAME rig, or one that lacks joints or shape keys."""
    rig = find_rig(head)
    if rig is None:
        raise StgaError(
            f"{head.name}: has no FLAME rig, because it was not imported from FLAME parameters; "
            "its splats follow whatever moves its mesh (shape keys, modifiers, a mesh cache)"
        )
    missing = [name for name in JOINTS if name not in rig.pose.bones]
    if missing:
        names = ", ".join(missing)
        raise StgaError(f"{rig.name}: has no bone {names}; give renamed bones their names again")
    if head.data.shape_keys is None:
        raise StgaError(f"{head.name}: has lost its shape keys; import its capture again")
    return rig


LINKED = "is linked from another file: open that file, or make the head local"


def check_local(head: Any) -> None:
    """Raise StgaError where a head is linked; it may be overridden."""
    if head.library is not None:
        raise StgaError(f"{head.name}: {LINKED}")


def check_editable(head: Any) -> None:
    """Raise StgaError where a head is linked or overridden: shape keys, vertex groups and
    properties that are added to a library override are gone after reopening."""
    blocks = (head, head.data)
    if any(block.library is not None for block in blocks):
        raise StgaError(f"{head.name}: {LINKED}")
    if any(block.override_library is not None for block in blocks):
        problem = "is overridden, and Blender would not save what this adds"
        raise StgaError(f"{head.name}: {problem}; open its file, or make the head local")


def _check_parent(part: Any) -> None:
    if mover_of(part) is part:
        problem = "has no parent" if part.parent is None else f"has the parent {part.parent.name}"
        raise StgaError(f"{part.name}: {problem}; parent it again to the Empty of its capture")


def usable_rig(head: Any, with_sliders: bool = True) -> Any:
    """The armature object of a head that can be posed here. with_sliders: and its shape keys, which
    a library override cannot change. Raises StgaError that says why not."""
    check_local(head)
    if with_sliders and head.data.library is not None:
        raise StgaError(
            f"{head.name}: is overridden, but its sliders are in another file: {REMEDY}"
        )
    rig = rig_of(head)
    override = rig.override_library
    if rig.library is not None or (override is not None and override.is_system_override):
        raise StgaError(f"{rig.name}: {LINKED}")
    for part in (head, rig):
        _check_parent(part)
    if rig.data.pose_position == "REST":
        raise StgaError(f"{rig.name}: is in Rest Position; choose Pose Position")
    for name in JOINTS:
        if rig.pose.bones[name].rotation_mode != "QUATERNION":
            raise StgaError(f"{rig.name}: the rotation mode of bone {name} must be Quaternion")
    return rig


REMEDY = "open that file, or make the head's mesh local"


def _remove_bone_groups(head: Any, rigs: Sequence[Any]) -> None:
    bones = {bone.name for rig in rigs for bone in rig.data.bones} & RIG_BONES
    for group in reversed([group for group in head.vertex_groups if group.name in bones]):
        head.vertex_groups.remove(group)


def _rigs(head: Any) -> list[Any]:
    children = head.parent.children if head.parent is not None else ()
    return [child for child in children if child.get(tags.KIND) == tags.RIG]


def _place_armature(
    head: Any, joints: np.ndarray, parents: np.ndarray, deformed: Sequence[str]
) -> Any:
    """The rig's object with bones at joints (5, 3); deformed: the bones that vertices follow. Bones
    that an artist added to an earlier import's stay, with their parents."""
    title = f"{head.parent.name} rig"
    existing = next(iter(_rigs(head)), None)
    armature = bpy.data.armatures.new(title) if existing is None else existing.data.copy()
    temporary = bpy.data.objects.new(title, armature)  # edit mode needs an object that is visible
    layer = bpy.context.view_layer
    active = layer.objects.active
    leave_edit_mode()
    bpy.context.scene.collection.objects.link(temporary)
    layer.objects.active = temporary
    is_mirrored = armature.use_mirror_x
    armature.use_mirror_x = False  # of left and right eye, the one would move the other
    bpy.ops.object.mode_set(mode="EDIT")
    held = _remove_joints(armature)
    for name, last, parent, (x, y, z) in zip(
        JOINTS, deformed, parents.tolist(), joints.tolist(), strict=True
    ):
        above = deformed[parent] if parent >= 0 else None
        for link in [name] if last == name else [keyframes.parent_bone(name), name, last]:
            edited = armature.edit_bones.new(link)
            # Along +Y without roll, its rest orientation is the identity: its rotation is FLAME's.
            edited.head = (x, y, z)
            edited.tail = (x, y + BONE_LENGTH, z)
            edited.roll = 0.0
            edited.parent = armature.edit_bones[above] if above else None
            above = link
    _give_parents(armature, held)
    bpy.ops.object.mode_set(mode="OBJECT")
    armature.use_mirror_x = is_mirrored
    layer.objects.active = active
    bpy.data.objects.remove(temporary)
    _collect_bones(armature)
    rig = place(head.parent, tags.RIG, title, armature, existing)
    rig.show_in_front = True
    layer.update()  # creates the pose bones
    for bone in rig.pose.bones:
        if bone.name in RIG_BONES:
            bone.matrix_basis = Matrix()
    for joint, name in enumerate(JOINTS):
        bone = rig.pose.bones[name]
        bone.rotation_mode = "QUATERNION"
        bone.lock_location = [joint > 0] * 3
        for earlier in (keyframes.sum_property(name), keyframes.offset_property(name)):
            rig.pop(earlier, None)
    return rig


def _remove_joints(armature: Any) -> dict[str, tuple[str, bool]]:
    """Remove the bones of an earlier import from an armature in Edit mode. Returns what is between
    them and bones that an artist added: bone -> its parent, and whether it is connected to that."""
    bones = armature.edit_bones
    held = {
        bone.name: (bone.parent.name, bone.use_connect)
        for bone in bones
        if bone.parent is not None and (bone.name in RIG_BONES) != (bone.parent.name in RIG_BONES)
    }
    for bone in [bone for bone in bones if bone.name in RIG_BONES]:
        bones.remove(bone)
    return held


def _give_parents(armature: Any, held: Mapping[str, tuple[str, bool]]) -> None:
    """Give bones the parents that `_remove_joints` found, but joints those of the model."""
    bones = armature.edit_bones
    for name, (parent, is_connected) in held.items():
        # removed bones have left their children to their own parents
        if name not in RIG_BONES or (name in bones and bones[name].parent is None):
            bones[name].parent = bones.get(parent)
            bones[name].use_connect = is_connected


def _collect_bones(armature: Any) -> None:
    """Put joints into a bone collection, and the bones that move with them into a hidden one."""
    known = armature.collections_all
    visible = known.get("Joints") or armature.collections.new("Joints")
    hidden = known.get("Helpers")
    if hidden is None:
        hidden = armature.collections.new("Helpers")
        hidden.is_visible = False
    for made in armature.bones:
        if made.name in RIG_BONES:
            (visible if made.name in JOINTS else hidden).assign(made)


def _draw_at_skin(rig: Any, basis: np.ndarray, weights: np.ndarray, joints: np.ndarray) -> None:
    """Draw jaw and eyes, unless an artist draws them otherwise, from their joints to the skin in
    front; as bones they point up, FLAME's rest."""
    shape = bpy.data.objects.get(BONE_SHAPE)
    if shape is None:
        mesh = bpy.data.meshes.new(BONE_SHAPE)
        ring = [(0.1, 0.1, 0), (0, 0.1, 0.1), (-0.1, 0.1, 0), (0, 0.1, -0.1)]
        sides = [(end, 2 + k, 2 + (k + 1) % 4) for end in (0, 1) for k in range(4)]
        mesh.from_pydata([(0, 0, 0), (0, 1, 0), *ring], [], sides)
        shape = bpy.data.objects.new(BONE_SHAPE, mesh)  # in no collection
        shape.hide_viewport = shape.hide_render = True
    for name in ("jaw", "left_eye", "right_eye"):
        joint = JOINTS.index(name)
        bone = rig.pose.bones[name]
        moved = basis[weights[:, joint] > 0.5] - joints[joint]
        rig.data.bones[name].hide = not len(moved)  # a jaw that a shape moves
        is_ours = bone.custom_shape is None or bone.custom_shape in bone_shapes(rig)
        if len(moved) and is_ours:
            tip = Vector(moved[(moved[:, 2] - np.abs(moved[:, 0])).argmax()])
            bone.custom_shape = shape
            bone.use_custom_shape_bone_size = False
            bone.custom_shape_scale_xyz = (tip.length,) * 3
            bone.custom_shape_rotation_euler = tip.to_track_quat("Y", "Z").to_euler()


def bone_shapes(rig: Any) -> list[Any]:
    """The objects that the bones of an armature object are drawn by, as far as `add_rig` made
    them."""
    bones = rig.pose.bones if rig.pose is not None else ()
    drawn = {bone.custom_shape for bone in bones} - {None}
    made = [each for each in drawn if each.data is not None]  # an artist may choose an Empty
    return [each for each in made if each.data.name.startswith(BONE_SHAPE)]


def _new_shape_key(
    head: Any, name: str, vertices: np.ndarray, lowest: float, highest: float
) -> None:
    key = head.shape_key_add(name=name, from_mix=False)
    key.points.foreach_set("co", flat_floats(vertices))
    key.slider_min = lowest
    key.slider_max = highest
    key.value = 0.0  # a key made from a script starts at 1


def _significant_terms(directions: np.ndarray) -> list[list[int]]:
    """Per axis, the columns of directions (3, K) that displace the joint, less the smallest, which
    together stay negligible with the sliders at their limits."""
    kept = []
    for coefficients in np.abs(directions):
        order = np.argsort(coefficients)
        displacement = np.cumsum(coefficients[order]) * MAX_SLIDER
        kept.append(sorted(order[displacement > NEGLIGIBLE_DISPLACEMENT].tolist()))
    return kept


def _drive_joint(
    head: Any, rig: Any, joint: str, sliders: Sequence[str], directions: np.ndarray
) -> None:
    """Drive a joint's helper bones by directions (3, K) · sliders and the per-frame offset, by way
    of partial sums in a property of the rig: Blender limits an expression's length."""
    parts = [
        (axis, terms[start : start + len(VARIABLES)])
        for axis, terms in enumerate(_significant_terms(directions))
        for start in range(0, len(terms), len(VARIABLES))
    ]
    sums = keyframes.sum_property(joint)
    offset = keyframes.offset_property(joint)
    if parts:
        rig[sums] = [0.0] * len(parts)
    summands: list[list[str]] = [[], [], []]
    for slot, (axis, terms) in enumerate(parts):
        weighted = zip(directions[axis, terms], VARIABLES, strict=False)
        expression = "".join(f"{weight:+.5e}*{letter}" for weight, letter in weighted)
        sources = [(head.data.shape_keys, key_value_path(sliders[k])) for k in terms]
        variables = dict(zip(VARIABLES, sources, strict=False))
        add_driver(rig, property_path(sums), slot, expression, variables)
        summands[axis].append(f"{property_path(sums)}[{slot}]")
    for axis, paths in enumerate(summands):
        paths += [f"{property_path(offset)}[{axis}]"] if offset in rig else []
        if paths:
            variables = dict(zip(VARIABLES, ((rig, path) for path in paths), strict=False))
            total = "+".join(variables)
            moved = keyframes.parent_bone(joint)
            deform = keyframes.deform_bone(joint)
            add_driver(rig, location_path(moved), axis, total, variables)
            add_driver(rig, location_path(deform), axis, f"-({total})", variables)
