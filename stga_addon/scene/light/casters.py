"""Objects of a scene that throw shadows onto heads."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from ...light.values import Caster
from .. import tags
from ..arrays import mesh_vertices, read_values
from ..display import splat_nodes
from ..display.splat_object import get_input


class Casters:
    """Meshes of a scene in world space, read once until `forget` is called.

    A hidden head throws a shadow where its splats are visible.
    """

    def __init__(self) -> None:
        self._read: list[tuple[Any, Caster]] | None = None
        self._placed: dict[tuple[Any, bytes], tuple[Caster, ...]] = {}

    def forget(self) -> None:
        """The scene has changed."""
        self._read = None
        self._placed.clear()

    def of(
        self, head: Any, to_world: np.ndarray, visible: Iterable[tuple[Any, Any]], depsgraph: Any
    ) -> tuple[Caster, ...]:
        """Those that throw shadows onto `head`, in the space that `to_world` (4, 4) takes to the world; the same
        objects until the scene changes.

        visible: objects and their matrices, as of `visible_objects`.
        """
        if self._read is None:
            self._read = list(_casters(visible, depsgraph))
        key = head, to_world.tobytes()
        if key not in self._placed:
            to_avatar = np.linalg.inv(to_world)
            self._placed[key] = tuple(_moved(caster, to_avatar) for owner, caster in self._read if owner != head)
        return self._placed[key]


def _casters(visible: Iterable[tuple[Any, Any]], depsgraph: Any) -> Iterable[tuple[Any, Caster]]:
    """Each object that throws shadows, and its mesh in world space."""
    heads = set()
    for each, matrix in visible:
        if each.get(tags.KIND) == tags.SPLATS:
            head = get_input(each, splat_nodes.HEAD) if tags.CONVENTION in each else None
            if head is not None and head not in heads:
                heads.add(head)
                local = head.evaluated_get(depsgraph).matrix_world
                placed = each.evaluated_get(depsgraph).matrix_world  # instances move splats and head together
                yield head, _read(head, matrix @ placed.inverted_safe() @ local, depsgraph)
        elif each.type == "MESH" and each.visible_shadow and each.get(tags.KIND) != tags.HEAD:
            yield each, _read(each, matrix, depsgraph)


def _read(owner: Any, matrix: Any, depsgraph: Any) -> Caster:
    mesh = owner.evaluated_get(depsgraph).data
    mesh.calc_loop_triangles()
    faces = read_values(mesh.loop_triangles, "vertices", 3, np.int32)
    return _moved(Caster(mesh_vertices(mesh).astype(np.float64), faces), np.array(matrix, np.float64))


def _moved(caster: Caster, matrix: np.ndarray) -> Caster:
    return Caster(caster.vertices @ matrix[:3, :3].T + matrix[:3, 3], caster.faces)
