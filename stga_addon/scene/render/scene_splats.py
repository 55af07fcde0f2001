"""A scene's visible splats, posed, and their relit colors stored for EEVEE and Cycles."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ...avatar.embedding import WORLD, FaceFrames, placed, to_world
from ...avatar.file import UNSEEN_REGION, Avatar
from ...avatar.splats import Splats, at_degree, joined
from ...errors import StgaError
from .. import compat, tags
from ..arrays import flat_floats, mesh_vertices
from ..display import splat_nodes
from ..display.node_builder import VERSION
from ..display.splat_attributes import (
    RELIT_COLOR,
    read_native_splats,
    read_splats,
    with_alpha,
    write_attributes,
)
from ..display.splat_object import (
    display_mode,
    display_settings,
    followed_head,
    is_lit,
    later_modifiers,
    splat_modifier,
    stored_avatar,
    stored_light,
)
from ..evaluation import evaluated, kept_evaluated, require_moved
from ..layers import SceneLayer
from ..light import PosedAvatar, SceneLight, lighting_settings, throws_shadow
from ..objects import objects_of_images
from ..vertex_groups import frame_group, frame_selection

VIEWER = np.array((0.0, -1.0, 0.0))
"""Meters from relit splats to who sees their highlights, where the scene has no camera."""


class SplatCache:
    """Avatars and world splats as last read from meshes, frames of heads' last shapes, and the
    scene's light: reading takes longer than posing. A mesh written anew has a new revision, so that
    neither undo nor a loaded file brings up another state. for_linear_light: avatars are those for
    renderers that blend so."""

    def __init__(self, for_linear_light: bool = False) -> None:
        self._for_linear_light = for_linear_light
        self._stored: dict[tuple[Any, ...], Avatar | Splats] = {}
        self._frames: dict[tuple[Any, ...], tuple[np.ndarray, FaceFrames]] = {}
        self._selections: dict[tuple[int, int, int], np.ndarray | None] = {}
        self._native: dict[tuple[int, ...], Splats | None] = {}
        self.light = SceneLight()

    def scene_changed(self, depsgraph: Any) -> None:
        """Forget meshes that were edited, the selections painted on them, and what throws
        shadows."""
        self.light.forget_casters()
        updates = depsgraph.updates
        changed = [update.id.original for update in updates]
        uids = {each.session_uid for each in changed if isinstance(each, bpy.types.Mesh)}
        moved = {each.id.original.session_uid for each in updates if each.is_updated_geometry}
        self._native = {key: read for key, read in self._native.items() if key[0] not in moved}
        if uids:
            self._keep(lambda key: key[0] not in uids)
        # where a group was removed, the scene's relations are built anew
        if uids or any(isinstance(each, bpy.types.Scene) for each in changed):
            self._selections.clear()

    def frame_changed(self) -> None:
        """Forget what moves by itself: what throws shadows, and native splats of others."""
        self.light.forget_casters()
        self._native.clear()

    def selection(self, head: Any, timestep: int) -> np.ndarray | None:
        """`frame_selection`, which reads all vertices, as last read."""
        group = frame_group(head, timestep)
        if group is None:
            return None
        key = head.data.session_uid, group.index, timestep
        if key not in self._selections:
            self._selections[key] = frame_selection(head, timestep)
        return self._selections[key]

    def get(self, splat_object: Any) -> Avatar | Splats:
        key = _key(splat_object.data)
        if key not in self._stored:
            meshes = _unless_hidden("meshes")
            if meshes is not None:
                current = {_key(mesh) for mesh in meshes}
                self._keep(lambda known: known in current)
            is_avatar = tags.CONVENTION in splat_object
            mesh = splat_object.data
            read = stored_avatar(splat_object) if is_avatar else read_splats(mesh)
            if isinstance(read, Avatar) and self._for_linear_light:
                read = read.for_linear_light
            self._stored[key] = read
        return self._stored[key]

    def native(self, pointcloud: Any) -> Splats | None:
        """`read_native_splats` of an evaluated object, by that and where its data are."""
        key = (
            pointcloud.original.session_uid,
            pointcloud.data.as_pointer(),
            len(pointcloud.data.points),
        )
        if key not in self._native:
            self._native[key] = read_native_splats(pointcloud.data)
        return self._native[key]

    def frames(
        self, splat_object: Any, avatar: Avatar, vertices: np.ndarray
    ) -> tuple[np.ndarray, FaceFrames]:
        """The avatar's frames on a head of this shape (V, 3), and the shape as first given."""
        key = (*_key(splat_object.data), splat_object.session_uid)
        known = self._frames.get(key)
        if known is None or not np.array_equal(known[0], vertices):
            known = self._frames[key] = vertices, avatar.frames(vertices)
        return known

    def _keep(self, is_kept: Callable[[tuple[Any, ...]], bool]) -> None:
        self._stored = {key: stored for key, stored in self._stored.items() if is_kept(key)}
        self._frames = {key: frames for key, frames in self._frames.items() if is_kept(key[:3])}


def _unless_hidden(kind: str) -> Any:
    """Data of the file; None while Blender enables an extension, which may be during a render, and
    hides them."""
    return getattr(bpy.data, kind, None)


def _key(mesh: Any) -> tuple[Any, ...]:
    return mesh.session_uid, mesh.get(tags.REVISION, ""), len(mesh.vertices)


def visible_layers(
    depsgraph: Any,
    cache: SplatCache,
    view: Any = None,
    is_wanted: Callable[[Any], bool] = lambda splat_object: True,
) -> list[SceneLayer]:
    """The splats of each visible object at the depsgraph's frame. view: the SpaceView3D to draw,
    None for a final image, where holdouts count and what the camera does not see is left out.
    Raises StgaError where a head is gone or has other triangles."""
    trees = _unless_hidden("node_groups")
    if trees is not None and not any(VERSION in tree for tree in trees):  # a file without splats
        return []

    def find_visible() -> list[tuple[Any, Matrix]]:
        found = _visible_objects(depsgraph, view, lambda each: True)
        return [(each, matrix) for _, each, matrix in found]

    layers = []
    for owner, each, matrix in _visible_objects(depsgraph, view, _may_show_splats):
        if not tags.is_splats(each) or not is_wanted(each):
            continue
        if view is None and not _is_camera_visible(owner, each, depsgraph):
            continue
        stored = cache.get(each)
        to_world = np.array(matrix, np.float64)
        # From the evaluated object: its settings may be animated.
        settings = display_settings(splat_modifier(each.evaluated_get(depsgraph)))
        holdout = view is None and _is_holdout(owner, each, depsgraph)
        if isinstance(stored, Splats):
            layer = SceneLayer(stored, WORLD, to_world, settings=settings, holdout=holdout)
            layers.append(layer)
            continue
        head = followed_head(each)
        if head is None:
            raise StgaError(f"{each.name}: has no head to follow; choose one in its modifier")
        vertices = _posed_vertices(each, head, stored, depsgraph)
        vertices, frames = cache.frames(each, stored, vertices)
        avatar = PosedAvatar(each, head, stored, vertices, to_world)
        relit = cache.light.relit(avatar, find_visible, depsgraph)
        asks = settings.show_selection or settings.selected_only
        selected = cache.selection(head, depsgraph.scene.frame_current) if asks else None
        frozen = None if selected is None else ~selected
        layers.append(
            SceneLayer(
                splats=stored.splats,
                frames=frames,
                to_world=to_world,
                antialiased=stored.antialiased,
                settings=settings,
                frozen=frozen,
                unseen=stored.regions.get(UNSEEN_REGION),
                relit=relit,
                holdout=holdout,
            )
        )
    return layers


def native_layers(
    depsgraph: Any,
    cache: SplatCache,
    view: Any = None,
    is_wanted: Callable[[Any], bool] = lambda splat_object: False,
) -> list[SceneLayer]:
    """The native splats at the depsgraph's frame that `visible_layers` has not: of others, and in
    instances by nodes; none before Blender 5.3. view: as of `visible_layers`. is_wanted: which of
    those that it has, too."""
    layers = []
    for instance in depsgraph.object_instances if compat.NATIVE_SPLATS else ():
        candidate = instance.object
        owner = instance.parent if instance.is_instance else candidate
        # the data are there until the next instance only
        original = candidate.original
        if candidate.type != "POINTCLOUD":
            continue
        if _in_visible_layers(owner.original, original) and not is_wanted(original):
            continue
        is_hidden = owner.hide_render or not (owner.visible_camera and candidate.visible_camera)
        if view is None and is_hidden:
            continue
        splats = cache.native(candidate)
        if splats is not None:
            to_world = np.array(instance.matrix_world, np.float64)
            holdout = view is None and (owner.is_holdout or candidate.is_holdout)
            layers.append(SceneLayer(splats, WORLD, to_world, holdout=holdout))
    return layers


def _in_visible_layers(owner: Any, pointcloud: Any) -> bool:
    """Whether `visible_layers` has these splats."""
    is_known = owner == pointcloud or owner.instance_type == "COLLECTION"
    return is_known and tags.is_splats(pointcloud)


def all_layers(depsgraph: Any, cache: SplatCache, view: Any = None) -> list[SceneLayer]:
    """Layers of all visible splats: the add-on's (`visible_layers`) and native ones of other
    objects."""
    return visible_layers(depsgraph, cache, view) + native_layers(depsgraph, cache, view)


def evaluated_splats(depsgraph: Any, cache: SplatCache, to_file: np.ndarray) -> Splats:
    """All splats that images of the scene show at the depsgraph's frame, with harmonics of the
    highest degree among them, by a matrix (4, 4) from Blender's axes; native ones as modifiers
    after ours leave them. Raises StgaError as `visible_layers`, and where there are none."""

    def is_changed(candidate: Any) -> bool:
        return bool(later_modifiers(candidate)) and display_mode(candidate) == splat_nodes.NATIVE

    layers = visible_layers(depsgraph, cache, is_wanted=lambda candidate: not is_changed(candidate))
    layers += native_layers(depsgraph, cache, is_wanted=is_changed)
    camera = depsgraph.scene.camera
    eye = None if camera is None else np.array(camera.evaluated_get(depsgraph).matrix_world)[:3, 3]
    parts = []
    for layer in layers:
        if layer.holdout:
            continue
        posed = layer.posed(layer.to_world[:3, 3] + VIEWER if eye is None else eye)
        world = to_world(posed.splats, posed.frames)
        parts.append(placed(world, to_file @ posed.to_world))
    if not sum(map(len, parts)):
        scene = depsgraph.scene
        raise StgaError(f"{scene.name}: shows no splats in frame {scene.frame_current}")
    degree = max(part.sh_degree for part in parts)
    return joined([at_degree(part, degree) for part in parts])


def with_heads(scene: Any) -> list[Any]:
    """The splat objects of the scene and its background, and the heads that they follow, for
    `kept_evaluated`."""
    objects = [each for source in (scene, *_background_scenes(scene)) for each in source.objects]
    splats = list(filter(tags.is_splats, objects))
    return [*splats, *map(followed_head, splats)]


def _posed_vertices(splat_object: Any, head: Any, avatar: Avatar, depsgraph: Any) -> np.ndarray:
    """(V, 3) of the evaluated head in the splat object's space. Raises StgaError where the head has
    not as many triangles and vertices as the avatar."""
    modifier = splat_modifier(splat_object.evaluated_get(depsgraph))
    require_moved(head, modifier, depsgraph)
    posed = evaluated(head, depsgraph)
    wanted = avatar.faces.size, len(avatar.neutral)
    mesh = posed.data if posed.type == "MESH" else None
    if mesh is None or (len(mesh.loops), len(mesh.vertices)) != wanted:
        follower = splat_object.name
        reason = f"has other triangles than {follower}, which follows it; check its modifiers"
        if head.mode == "EDIT":
            reason = f"is in Edit Mode; {follower} is drawn again when you leave it"
        raise StgaError(f"{head.name}: {reason}")
    placed = splat_object.evaluated_get(depsgraph).matrix_world
    to_splats = np.array(placed.inverted_safe() @ posed.matrix_world, np.float64)
    return mesh_vertices(posed.data) @ to_splats[:3, :3].T + to_splats[:3, 3]


def _may_show_splats(candidate: Any) -> bool:
    """Whether the object shows splats or instances a collection, which may hold some."""
    return tags.is_splats(candidate) or candidate.instance_type == "COLLECTION"


def _visible_objects(
    depsgraph: Any, view: Any, is_asked: Callable[[Any], bool]
) -> list[tuple[Any, Any, Matrix]]:
    """The object of the view layer, itself or the instance of it, and its world matrix, of those
    that are visible. is_asked: asked first, because all else takes longer. view: as of
    `visible_layers`."""
    visible = list[Any]()
    for layer in rendered_view_layers(depsgraph):
        if view is None:
            visible += _rendered_objects(layer.layer_collection, depsgraph, is_asked)
        elif layer == depsgraph.view_layer or view.local_view is None:
            how = {"view_layer": layer, "viewport": view}
            visible += [each for each in filter(is_asked, layer.objects) if each.visible_get(**how)]
    return [
        (owner, each, matrix)
        for owner in dict.fromkeys(visible)
        for each, matrix in _with_instances(owner, depsgraph, Matrix(), is_asked)
    ]


def rendered_view_layers(depsgraph: Any) -> list[Any]:
    """The depsgraph's view layer, and that which Blender shows of each background scene."""
    layers = [depsgraph.view_layer]
    for scene in _background_scenes(depsgraph.scene):
        layers.append(next((each for each in scene.view_layers if each.use), scene.view_layers[0]))
    return layers


def _background_scenes(scene: Any) -> list[Any]:
    """The background scene of a scene, that of this one, and so on."""
    found = list[Any]()
    while (scene := scene.background_set) is not None and scene not in found:
        found.append(scene)
    return found


def _rendered_objects(layer: Any, depsgraph: Any, is_asked: Callable[[Any], bool]) -> list[Any]:
    """The objects of a layer collection and its children that final images show, each once."""
    # By evaluated objects: in animations, keyframes do not reach the originals.
    asked = dict.fromkeys(filter(is_asked, objects_of_images(layer)))
    return [each for each in asked if not each.evaluated_get(depsgraph).hide_render]


def _with_instances(
    visible: Any, depsgraph: Any, parent_matrix: Matrix, is_asked: Callable[[Any], bool]
) -> Iterator[tuple[Any, Matrix]]:
    """An object and its world matrix, and the members of an instanced collection."""
    matrix = parent_matrix @ visible.evaluated_get(depsgraph).matrix_world
    yield visible, matrix
    collection = visible.instance_collection if visible.instance_type == "COLLECTION" else None
    if collection is not None:
        inside = matrix @ Matrix.Translation(-collection.instance_offset)
        for member in filter(is_asked, collection.all_objects):
            if not member.evaluated_get(depsgraph).hide_render:
                yield from _with_instances(member, depsgraph, inside, is_asked)


def _is_camera_visible(owner: Any, instance: Any, depsgraph: Any) -> bool:
    """Whether the camera sees an object of a final image, which is an instance of `owner`."""
    layers = rendered_view_layers(depsgraph)
    is_indirect = any(owner.indirect_only_get(view_layer=layer) for layer in layers)
    visible = (each.evaluated_get(depsgraph).visible_camera for each in (owner, instance))
    return not is_indirect and all(visible)


def _is_holdout(owner: Any, instance: Any, depsgraph: Any) -> bool:
    """Whether an object of a final image hides what it covers, by its collections or its own."""
    layers = rendered_view_layers(depsgraph)
    is_masked = any(owner.holdout_get(view_layer=layer) for layer in layers)
    holdouts = (each.evaluated_get(depsgraph).is_holdout for each in (owner, instance))
    return is_masked or any(holdouts)


def relight_frame(splat_object: Any, scene: Any) -> None:
    """Store the splats' colors in the scene's light, at the scene's frame and from its camera.

    Raises StgaError for an avatar that is hidden, that the scene does not light, or whose head is
    gone or has other triangles, and for a scene without a camera."""
    with kept_evaluated(with_heads(scene)):
        depsgraph = bpy.context.evaluated_depsgraph_get()
        only = lambda candidate: candidate == splat_object  # noqa: E731
        layers = visible_layers(depsgraph, SplatCache(), is_wanted=only)
    if not layers:
        raise StgaError(f"{splat_object.name}: is hidden from the camera; show it")
    if layers[0].relit is None:
        raise StgaError(
            f"{splat_object.name}: is lit as recorded; choose Scene or Mix in the panel Lighting"
        )
    if scene.camera is None:
        raise StgaError("The scene has no camera, from which highlights are seen")
    depsgraph = bpy.context.evaluated_depsgraph_get()
    camera = scene.camera.evaluated_get(depsgraph).matrix_world
    eye = layers[0].eye_in_avatar(np.array(camera)[:3, 3])
    relit = layers[0].relit
    color = relit.relighter.radiance(relit.mesh, eye, relit.lighting, relit.casters)
    values = flat_floats(with_alpha(np.maximum(color, 0)))
    write_attributes(splat_object.data, {RELIT_COLOR: ("FLOAT_COLOR", "color", values)}, "POINT")
    splat_object.data[tags.RELIT_FRAME] = scene.frame_current
    splat_object.data.update()


def level_exposure(cache: SplatCache) -> float | None:
    """Stops at which the scene's light makes its avatars as bright as recorded; None without
    light."""
    depsgraph = bpy.context.evaluated_depsgraph_get()
    recorded = 0.0
    lit = 0.0
    for layer in visible_layers(depsgraph, cache):
        if (relit := layer.relit) is not None:
            eye = relit.mesh.mean(0) + np.array((0.0, 0.0, 1.0))
            as_lit = replace(relit.lighting, mode="scene", exposure=0.0)
            lit += relit.relighter.radiance(relit.mesh, eye, as_lit, relit.casters).mean()
            as_recorded = replace(as_lit, mode="recorded")
            recorded += relit.relighter.radiance(relit.mesh, eye, as_recorded).mean()
    return float(np.log2(recorded / lit)) if recorded > 0 and lit > 0 else None


def forget_frame(splat_object: Any) -> bool:
    """Show recorded colors again; whether there were others."""
    attribute = splat_object.data.attributes.get(RELIT_COLOR)
    if attribute is not None:
        splat_object.data.attributes.remove(attribute)
        splat_object.data.pop(tags.RELIT_FRAME, None)
        splat_object.data.update()
    return attribute is not None


def light_hint(scene: Any) -> str | None:
    """A sentence where EEVEE and Cycles render in another light than the scene's, or in a shadow
    that is none, or None."""
    rendered = [each for each in scene.objects if tags.CONVENTION in each and not each.hide_render]
    if any(is_lit(splat_object) and throws_shadow(splat_object) for splat_object in rendered):
        return (
            "The head's mesh darkens its own splats, which throw their shadow without it in Scene "
            "Light: turn Head Shadow off"
        )
    settings = lighting_settings(scene)
    if settings is None or settings.mode == "recorded":
        return None
    for splat_object in rendered:
        if stored_light(splat_object) is None or is_lit(splat_object):
            continue
        frame = (
            splat_object.data.get(tags.RELIT_FRAME)
            if RELIT_COLOR in splat_object.data.attributes
            else None
        )
        if frame != scene.frame_current:
            now = "colors as recorded" if frame is None else f"the light of frame {frame}"
            return (
                f"EEVEE and Cycles render {now}; Relight Frame gives them the light of this frame"
            )
    return None
