"""The splats of a scene's visible objects, posed at its frame, and their relit colors stored for
EEVEE and Cycles."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix

from ...avatar.embedding import WORLD, FaceFrames
from ...avatar.file import Avatar
from ...avatar.splats import Splats
from ...errors import StgaError
from .. import tags
from ..arrays import flat_floats, mesh_vertices
from ..display import splat_nodes
from ..display.splat_attributes import RELIT_COLOR, read_splats, write_attributes
from ..display.splat_object import (
    display_settings,
    get_input,
    splat_modifier,
    stored_avatar,
    stored_light,
)
from ..layers import SceneLayer
from ..light.scene_light import SceneLight
from ..light.settings import lighting_settings
from ..vertex_groups import frame_selection


class SplatCache:
    """Avatars and world splats as last read from Blender's meshes, and avatars' frames on their
    heads' last shapes.

    Reading attributes takes longer than posing splats, and an animated head does not change them.
    `write_splats` gives a mesh a new revision, so that neither undo nor a loaded file brings up
    what another state of the mesh held.

    light  of the scene, as last read
    """

    def __init__(self) -> None:
        self._stored: dict[tuple[Any, ...], Avatar | Splats] = {}
        self._frames: dict[tuple[Any, ...], tuple[np.ndarray, FaceFrames]] = {}
        self.light = SceneLight()

    def discard(self, meshes: set[Any]) -> None:
        """Forget meshes that were edited."""
        uids = {mesh.session_uid for mesh in meshes}
        self._keep(lambda key: key[0] not in uids)

    def get(self, splat_object: Any) -> Avatar | Splats:
        key = _key(splat_object.data)
        if key not in self._stored:
            current = {_key(mesh) for mesh in bpy.data.meshes}
            self._keep(lambda known: known in current)
            is_avatar = tags.CONVENTION in splat_object
            stored = stored_avatar(splat_object) if is_avatar else read_splats(splat_object.data)
            self._stored[key] = stored
        return self._stored[key]

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


def _key(mesh: Any) -> tuple[Any, ...]:
    return mesh.session_uid, mesh.get(tags.REVISION, ""), len(mesh.vertices)


def visible_layers(
    depsgraph: Any,
    cache: SplatCache,
    view: Any = None,
    is_wanted: Callable[[Any], bool] = lambda splat_object: True,
) -> list[SceneLayer]:
    """The splats of each visible object at the depsgraph's frame.

    view: the 3D viewport (a SpaceView3D) to draw, None for a final image. is_wanted: chooses among
    splat objects. Raises StgaError where the head of an object is gone or has other triangles than
    its splats.
    """
    if view is None:
        visible = _rendered_objects(depsgraph.view_layer.layer_collection, depsgraph)
    else:
        visible = [
            candidate
            for candidate in depsgraph.view_layer.objects
            if candidate.visible_get(viewport=view)
        ]
    shown = [found for each in visible for found in _with_instances(each, depsgraph, Matrix())]
    return [
        _layer(visible, matrix, depsgraph, cache, shown)
        for visible, matrix in shown
        if visible.get(tags.KIND) == tags.SPLATS and is_wanted(visible)
    ]


def _rendered_objects(layer: Any, depsgraph: Any) -> list[Any]:
    """The objects of a layer collection and its children that final images show, each once."""
    if layer.exclude or layer.collection.hide_render:
        return []
    own = [
        candidate for candidate in layer.collection.objects if _is_rendered(candidate, depsgraph)
    ]
    inside = (each for child in layer.children for each in _rendered_objects(child, depsgraph))
    return list(dict.fromkeys([*own, *inside]))


def _is_rendered(candidate: Any, depsgraph: Any) -> bool:
    """By the evaluated object: while an animation is rendered, keyframes do not reach the
    original."""
    return not candidate.evaluated_get(depsgraph).hide_render


def _with_instances(
    visible: Any, depsgraph: Any, parent_matrix: Matrix
) -> Iterator[tuple[Any, Matrix]]:
    """An object and its world matrix; of an instanced collection also its members, once per
    instance."""
    matrix = parent_matrix @ visible.evaluated_get(depsgraph).matrix_world
    yield visible, matrix
    collection = visible.instance_collection if visible.instance_type == "COLLECTION" else None
    if collection is not None:
        inside = matrix @ Matrix.Translation(-collection.instance_offset)
        for member in collection.all_objects:
            if _is_rendered(member, depsgraph):
                yield from _with_instances(member, depsgraph, inside)


def _layer(
    splat_object: Any,
    matrix: Matrix,
    depsgraph: Any,
    cache: SplatCache,
    shown: Sequence[tuple[Any, Matrix]],
) -> SceneLayer:
    stored = cache.get(splat_object)
    to_world = np.array(matrix, np.float64)
    # From the evaluated object: its settings may be animated.
    settings = display_settings(splat_modifier(splat_object.evaluated_get(depsgraph)))
    if isinstance(stored, Splats):
        return SceneLayer(stored, WORLD, to_world, settings=settings)
    head = get_input(splat_object, splat_nodes.HEAD)
    if head is None:
        raise StgaError(f"{splat_object.name}: has no head to follow; choose one in its modifier")
    vertices = _head_vertices(splat_object, head, len(stored.faces), depsgraph)
    vertices, frames = cache.frames(splat_object, stored, vertices)
    relit = cache.light.relit(splat_object, head, stored, vertices, to_world, shown, depsgraph)
    selected = None
    if settings.show_selection or settings.selected_only:
        selected = frame_selection(head, depsgraph.scene.frame_current)
    frozen = None if selected is None else ~selected
    return SceneLayer(stored.splats, frames, to_world, stored.antialiased, settings, frozen, relit)


def _head_vertices(splat_object: Any, head: Any, n_faces: int, depsgraph: Any) -> np.ndarray:
    """(V, 3) float64 vertices of the evaluated head in the space of its splats."""
    posed = head.evaluated_get(depsgraph)
    if posed.type != "MESH" or len(posed.data.loops) != 3 * n_faces:
        if head.mode == "EDIT":
            raise StgaError(
                f"{head.name}: is in Edit Mode; {splat_object.name} is drawn again when you leave it"
            )
        raise StgaError(
            f"{head.name}: has other triangles than {splat_object.name}, which follows it; check its modifiers"
        )
    to_splats = (
        splat_object.evaluated_get(depsgraph).matrix_world.inverted_safe() @ posed.matrix_world
    )
    matrix = np.array(to_splats, np.float64)
    return mesh_vertices(posed.data) @ matrix[:3, :3].T + matrix[:3, 3]


def relight_frame(splat_object: Any, scene: Any) -> None:
    """Store the splats' scene-linear colors in the scene's light, at its frame and from its camera.

    Raises StgaError where the lighting is as recorded, or the avatar does not know its light.
    """
    depsgraph = bpy.context.evaluated_depsgraph_get()
    layers = visible_layers(depsgraph, SplatCache(), is_wanted=lambda shown: shown == splat_object)
    if not layers or layers[0].relit is None:
        raise StgaError(
            f"{splat_object.name}: is lit as recorded; choose Scene or Mix in the panel Lighting"
        )
    if scene.camera is None:
        raise StgaError("The scene has no camera, from which highlights are seen")
    eye = layers[0].eye_in_avatar(
        np.array(scene.camera.evaluated_get(depsgraph).matrix_world)[:3, 3]
    )
    relit = layers[0].relit
    color = relit.relighter.radiance(relit.mesh, eye, relit.lighting, relit.casters)
    values = flat_floats(np.concatenate([np.maximum(color, 0), np.ones((len(color), 1))], axis=1))
    write_attributes(splat_object.data, {RELIT_COLOR: ("FLOAT_COLOR", "color", values)}, "POINT")
    splat_object.data[tags.RELIT_FRAME] = scene.frame_current
    splat_object.data.update()


def forget_frame(splat_object: Any) -> bool:
    """Show recorded colors again; whether there were others."""
    attribute = splat_object.data.attributes.get(RELIT_COLOR)
    if attribute is not None:
        splat_object.data.attributes.remove(attribute)
        splat_object.data.pop(tags.RELIT_FRAME, None)
        splat_object.data.update()
    return attribute is not None


def light_hint(scene: Any) -> str | None:
    """A sentence where EEVEE and Cycles show splats in another light than the scene's at its frame,
    else None."""
    settings = lighting_settings(scene)
    if settings is None or settings.mode == "recorded":
        return None
    for shown in scene.objects:
        if tags.CONVENTION not in shown or shown.hide_render or stored_light(shown) is None:
            continue
        frame = shown.data.get(tags.RELIT_FRAME) if RELIT_COLOR in shown.data.attributes else None
        if frame != scene.frame_current:
            now = "colors as recorded" if frame is None else f"the light of frame {frame}"
            return (
                f"EEVEE and Cycles render {now}; Relight Frame gives them the light of this frame"
            )
    return None
