"""Which objects viewports and final images show, with instances of collections."""

from collections.abc import Iterator
from typing import Any

from mathutils import Matrix


def visible_objects(depsgraph: Any, view: Any) -> Iterator[tuple[Any, Matrix]]:
    """Objects and their world matrices; members of an instanced collection once per instance.

    view: the 3D viewport (a SpaceView3D) that shows them, None for a final image.
    """
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
