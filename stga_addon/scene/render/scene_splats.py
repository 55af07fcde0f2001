"""What the render engine draws: the splats of a scene's visible objects, read back from Blender."""

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
from ..arrays import mesh_triangles, mesh_vertices, read_values
from ..display import splat_nodes
from ..display.color_nodes import FACE, SH, STRAIN_COLOR
from ..display.colors import linear_to_srgb
from ..display.materials import OPACITY
from ..display.splat_object import get_input
from ..vertex_groups import frame_selection


class SplatCache:
    """Avatars and world splats as they were last read from Blender, by mesh.

    Reading tens of attributes costs more than posing the splats, and a moving head does not change them.
    """

    def __init__(self) -> None:
        self._read: dict[Any, Avatar | Splats] = {}

    def forget(self, meshes: set[Any]) -> None:
        """Read these meshes again when they are next drawn."""
        for mesh in meshes:
            self._read.pop(mesh, None)

    def take(self, shown: Any) -> Avatar | Splats:
        if shown.data not in self._read:
            self._read[shown.data] = stored_avatar(shown) if tags.CONVENTION in shown else stored_splats(shown.data)
        return self._read[shown.data]


def visible_layers(depsgraph: Any, stock: SplatCache, view: Any = None) -> list[PosedSplats]:
    """The splats that a depsgraph shows, at its frame, each with its object's display settings.

    view: the 3D viewport (a SpaceView3D) that is looked through; None where a final image is made. Raises StgaError
    where the head of an object is gone or has other triangles than its splats.
    """
    return [
        _layer(shown, place, depsgraph, stock)
        for shown, place in _visible_objects(depsgraph, view)
        if shown.get(tags.KIND) == tags.SPLATS
    ]


def _visible_objects(depsgraph: Any, view: Any) -> Iterator[tuple[Any, Matrix]]:
    """Objects and where they stand in the world; those of an instanced collection stand where the instance does."""
    if view is None:
        things = _rendered(depsgraph.view_layer.layer_collection)
    else:
        things = [thing for thing in depsgraph.view_layer.objects if thing.visible_get(viewport=view)]
    for thing in things:
        yield from _instances(thing, depsgraph, Matrix())


def _rendered(layer: Any) -> list[Any]:
    """The objects of a layer collection and those below it that final images show, each once."""
    if layer.exclude or layer.collection.hide_render:
        return []
    things = [thing for thing in layer.collection.objects if not thing.hide_render]
    return list(dict.fromkeys([*things, *(thing for child in layer.children for thing in _rendered(child))]))


def _instances(thing: Any, depsgraph: Any, above: Matrix) -> Iterator[tuple[Any, Matrix]]:
    place = above @ thing.evaluated_get(depsgraph).matrix_world
    yield thing, place
    collection = thing.instance_collection if thing.instance_type == "COLLECTION" else None
    if collection is not None:
        inside = place @ Matrix.Translation(-collection.instance_offset)
        for member in collection.all_objects:
            if not member.hide_render:
                yield from _instances(member, depsgraph, inside)


def _layer(shown: Any, place: Matrix, depsgraph: Any, stock: SplatCache) -> PosedSplats:
    source = stock.take(shown)
    to_world = np.array(place, np.float64)
    if isinstance(source, Splats):
        return PosedSplats(_as_displayed(shown, source, None, depsgraph), WORLD, to_world)
    head = get_input(shown, splat_nodes.HEAD)
    if head is None:
        raise StgaError(f"{shown.name}: has no head to follow; choose one in its modifier")
    frames = source.frames(_head_vertices(shown, head, len(source.faces), depsgraph))
    return PosedSplats(_as_displayed(shown, source.splats, head, depsgraph), frames, to_world, source.antialiased)


def _head_vertices(shown: Any, head: Any, faces: int, depsgraph: Any) -> np.ndarray:
    """(V, 3) float64 vertices of the evaluated head in the space of its splats."""
    posed = head.evaluated_get(depsgraph)
    if posed.type != "MESH" or len(posed.data.loops) != 3 * faces:
        raise StgaError(f"{head.name}: has other triangles than {shown.name}, which follows it; look at its modifiers")
    between = np.array(shown.evaluated_get(depsgraph).matrix_world.inverted_safe() @ posed.matrix_world, np.float64)
    return mesh_vertices(posed.data) @ between[:3, :3].T + between[:3, 3]


def _as_displayed(shown: Any, splats: Splats, head: Any, depsgraph: Any) -> Splats:
    """The splats after their object's display settings; head: None for splats in world space."""
    posed = shown.evaluated_get(depsgraph)  # its settings may be animated

    def setting(name: str) -> Any:
        return get_input(posed, name)

    kept = 1 / (1 + np.exp(-splats.opacity)) >= setting(splat_nodes.OPACITY_THRESHOLD)
    kept &= np.random.default_rng(0).random(len(splats)) * 100 < setting(splat_nodes.PERCENTAGE)
    greyed, only = setting(splat_nodes.SHOW_SELECTION), setting(splat_nodes.SELECTED_ONLY)
    selected = frame_selection(head, depsgraph.scene.frame_current) if greyed or only else None
    if selected is not None:
        frozen = ~selected[splats.face]
        splats = _greyed(splats, frozen) if greyed else splats
        kept &= ~(frozen & only)
    if splats.sh_degree > 0 and not setting(splat_nodes.VIEW_DEPENDENT):
        splats = replace(splats, sh=splats.sh[:, :1])
    size = setting(splat_nodes.SIZE)
    if size != 1:
        kept &= size > 0
        splats = replace(splats, log_scale=splats.log_scale + np.float32(np.log(max(size, 1e-6))))
    return splats if kept.all() else splats.rows(kept)


def _greyed(splats: Splats, frozen: np.ndarray) -> Splats:
    sh, strain_color = splats.sh.copy(), splats.strain_color.copy()
    sh[frozen] = strain_color[frozen] = 0
    sh[frozen, 0] = (linear_to_srgb(np.array(splat_nodes.FROZEN_GREY[:3])) - 0.5) / SH_C0
    return replace(splats, sh=sh, strain_color=strain_color)


def stored_avatar(shown: Any) -> Avatar:
    """The avatar that `show_avatar` made a splat object of, with rotations of length one and without regions."""
    neutral = get_input(shown, splat_nodes.NEUTRAL)
    if neutral is None:
        raise StgaError(f"{shown.name}: its neutral mesh is missing; show the avatar again")
    return Avatar(
        splats=stored_splats(shown.data),
        convention=shown[tags.CONVENTION],
        neutral=mesh_vertices(neutral.data),
        faces=mesh_triangles(neutral.data),
        antialiased=bool(shown[tags.ANTIALIASED]),
    )


def stored_splats(mesh: Any) -> Splats:
    """The splats that are stored as attributes of a splat object's mesh; none of them counts as unbound."""
    attributes = mesh.attributes
    count = len(mesh.vertices)

    def coefficients(name: str) -> np.ndarray:
        found: list[np.ndarray] = []
        while name.format(len(found)) in attributes:
            found.append(read_values(attributes[name.format(len(found))].data, "vector", 3))
        return np.stack(found, 1) if found else np.zeros((count, 0, 3), np.float32)

    opacity = read_values(attributes[OPACITY].data, "value", 1)[:, 0].astype(np.float64)
    scale = read_values(attributes[splat_nodes.SCALE].data, "vector", 3).astype(np.float64)
    embedded = FACE in attributes
    with np.errstate(divide="ignore"):  # opacities of 0 and 1 are logits of −∞ and ∞, which the kernels know
        return Splats(
            xyz=read_values(attributes[splat_nodes.XYZ].data, "vector", 3),
            rotation=read_values(attributes[splat_nodes.ROTATION].data, "value", 4),
            log_scale=np.log(scale).astype(np.float32),
            opacity=np.log(opacity / (1 - opacity)).astype(np.float32),
            sh=coefficients(SH),
            face=read_values(attributes[FACE].data, "value", 1, np.int32)[:, 0]
            if embedded
            else np.zeros(count, np.int32),
            unbound=np.zeros(count, bool),
            strain_color=coefficients(STRAIN_COLOR),
        )
