"""The splats that the render engine renders: those of a scene's visible objects, posed at its frame."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from mathutils import Matrix

from ...avatar.embedding import WORLD
from ...avatar.file import Avatar
from ...avatar.splats import SH_C0, Splats
from ...errors import StgaError
from ...raster.posed_splats import PosedSplats
from .. import tags
from ..arrays import mesh_vertices
from ..display import splat_nodes
from ..display.colors import linear_to_srgb
from ..display.splat_attributes import read_splats
from ..display.splat_object import get_input, stored_avatar
from ..vertex_groups import frame_selection


class SplatCache:
    """Avatars and world splats by their meshes, as last read from Blender.

    Reading their attributes takes longer than posing them, and an animated head does not change them.
    """

    def __init__(self) -> None:
        self._by_mesh: dict[Any, Avatar | Splats] = {}

    def discard(self, meshes: set[Any]) -> None:
        """Forget meshes that were edited."""
        for mesh in meshes:
            self._by_mesh.pop(mesh, None)

    def get(self, splat_object: Any) -> Avatar | Splats:
        mesh = splat_object.data
        if mesh not in self._by_mesh:
            is_avatar = tags.CONVENTION in splat_object
            self._by_mesh[mesh] = stored_avatar(splat_object) if is_avatar else read_splats(mesh)
        return self._by_mesh[mesh]


def visible_layers(depsgraph: Any, cache: SplatCache, view: Any = None) -> list[PosedSplats]:
    """The splats of each visible object at the depsgraph's frame, with its display settings applied.

    view: the 3D viewport (a SpaceView3D) to render, None for a final image. Raises StgaError where the head of an
    object is gone or has other triangles than its splats.
    """
    return [
        _layer(visible, matrix, depsgraph, cache)
        for visible, matrix in _visible_objects(depsgraph, view)
        if visible.get(tags.KIND) == tags.SPLATS
    ]


def _visible_objects(depsgraph: Any, view: Any) -> Iterator[tuple[Any, Matrix]]:
    """Objects and their world matrices; members of an instanced collection once per instance."""
    if view is None:
        visible = _rendered_objects(depsgraph.view_layer.layer_collection)
    else:
        visible = [candidate for candidate in depsgraph.view_layer.objects if candidate.visible_get(viewport=view)]
    for each in visible:
        yield from _with_instances(each, depsgraph, Matrix())


def _rendered_objects(layer: Any) -> list[Any]:
    """The objects of a layer collection and its children that final images show, each once."""
    if layer.exclude or layer.collection.hide_render:
        return []
    own = [candidate for candidate in layer.collection.objects if not candidate.hide_render]
    return list(dict.fromkeys([*own, *(each for child in layer.children for each in _rendered_objects(child))]))


def _with_instances(visible: Any, depsgraph: Any, parent_matrix: Matrix) -> Iterator[tuple[Any, Matrix]]:
    matrix = parent_matrix @ visible.evaluated_get(depsgraph).matrix_world
    yield visible, matrix
    collection = visible.instance_collection if visible.instance_type == "COLLECTION" else None
    if collection is not None:
        inside = matrix @ Matrix.Translation(-collection.instance_offset)
        for member in collection.all_objects:
            if not member.hide_render:
                yield from _with_instances(member, depsgraph, inside)


def _layer(splat_object: Any, matrix: Matrix, depsgraph: Any, cache: SplatCache) -> PosedSplats:
    stored = cache.get(splat_object)
    to_world = np.array(matrix, np.float64)
    if isinstance(stored, Splats):
        return PosedSplats(_with_display_settings(splat_object, stored, None, depsgraph), WORLD, to_world)
    head = get_input(splat_object, splat_nodes.HEAD)
    if head is None:
        raise StgaError(f"{splat_object.name}: has no head to follow; choose one in its modifier")
    frames = stored.frames(_head_vertices(splat_object, head, len(stored.faces), depsgraph))
    splats = _with_display_settings(splat_object, stored.splats, head, depsgraph)
    return PosedSplats(splats, frames, to_world, stored.antialiased)


def _head_vertices(splat_object: Any, head: Any, n_faces: int, depsgraph: Any) -> np.ndarray:
    """(V, 3) float64 vertices of the evaluated head in the space of its splats."""
    posed = head.evaluated_get(depsgraph)
    if posed.type != "MESH" or len(posed.data.loops) != 3 * n_faces:
        raise StgaError(
            f"{head.name}: has other triangles than {splat_object.name}, which follows it; check its modifiers"
        )
    to_splats = splat_object.evaluated_get(depsgraph).matrix_world.inverted_safe() @ posed.matrix_world
    matrix = np.array(to_splats, np.float64)
    return mesh_vertices(posed.data) @ matrix[:3, :3].T + matrix[:3, 3]


def _with_display_settings(splat_object: Any, splats: Splats, head: Any, depsgraph: Any) -> Splats:
    """The splats after their object's display settings; head: None for splats in world space."""
    posed = splat_object.evaluated_get(depsgraph)  # its settings may be animated

    def setting(name: str) -> Any:
        return get_input(posed, name)

    visible = 1 / (1 + np.exp(-splats.opacity)) >= setting(splat_nodes.OPACITY_THRESHOLD)
    visible &= np.random.default_rng(0).random(len(splats)) * 100 < setting(splat_nodes.PERCENTAGE)
    show_selection, selected_only = setting(splat_nodes.SHOW_SELECTION), setting(splat_nodes.SELECTED_ONLY)
    selected = frame_selection(head, depsgraph.scene.frame_current) if show_selection or selected_only else None
    if selected is not None:
        frozen = ~selected[splats.face]
        splats = _grayed(splats, frozen) if show_selection else splats
        visible &= ~(frozen & selected_only)
    if splats.sh_degree > 0 and not setting(splat_nodes.VIEW_DEPENDENT):
        splats = replace(splats, sh=splats.sh[:, :1])
    size = setting(splat_nodes.SIZE)
    if size != 1:
        visible &= size > 0
        splats = replace(splats, log_scale=splats.log_scale + np.float32(np.log(max(size, 1e-6))))
    return splats if visible.all() else splats.rows(visible)


def _grayed(splats: Splats, frozen: np.ndarray) -> Splats:
    sh, strain_color = splats.sh.copy(), splats.strain_color.copy()
    sh[frozen] = strain_color[frozen] = 0
    sh[frozen, 0] = (linear_to_srgb(np.array(splat_nodes.FROZEN_COLOR[:3])) - 0.5) / SH_C0
    return replace(splats, sh=sh, strain_color=strain_color)
