"""The light of a Blender scene for each of its avatars, and heads' shadows onto the scene."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from ...avatar.file import Avatar
from ...light.harmonics import rotated
from ...light.relight import Relighter
from ...light.values import Caster, Light, Lighting, no_world
from .. import tags
from ..arrays import mesh_vertices, read_values
from ..display import splat_nodes
from ..display.splat_object import get_input
from ..layers import Relit
from .lights import WorldLight, in_avatar_space, is_linked, light_of, split_world, world_light
from .settings import current_settings, lighting_settings

MAX_KEPT = 64
COPIED_SETTINGS = ("mode", "mix", "exposure", "roughness", "specular", "shadows")


class SceneLight:
    """What is kept between redraws, so that nothing is computed while nothing moves."""

    def __init__(self) -> None:
        self.casters = Casters()
        self._relighters: dict[int, Relighter] = {}
        self._relit: dict[tuple[int, bytes], tuple[Any, Relit]] = {}
        self._worlds: dict[WorldLight, tuple[np.ndarray, tuple[Light, ...]]] = {}

    def relit(
        self, splat_object: Any, head: Any, avatar: Avatar, vertices: np.ndarray, to_world: np.ndarray,
        visible: Sequence[tuple[Any, Any]], depsgraph: Any,
    ) -> Relit | None:  # fmt: skip
        """How the scene lights an avatar whose head has vertices (V, 3); None where its colors are
        as recorded.

        The same object as long as all is the same, `vertices` by identity. to_world (4, 4): from
        the avatar's space.
        """
        settings = current_settings(depsgraph)
        if avatar.light is None or settings is None or settings.mode == "recorded":
            return None
        lighting = self.lighting(settings, (splat_object, head), to_world, visible, depsgraph)
        casters = self.casters.of(head, to_world, visible, depsgraph) if lighting.shadows else ()
        uid = splat_object.session_uid
        relighter = self._relighters.get(uid)
        if relighter is None or relighter.avatar is not avatar:
            relighter = self._relighters[uid] = Relighter(avatar)
        key, place = (
            (_key(lighting), id(relighter), id(vertices), id(casters)),
            (uid, to_world.tobytes()),
        )
        known = self._relit.get(place)
        if known is None or known[0] != key:
            if len(self._relit) > MAX_KEPT:  # objects that move leave an entry at each place
                self._relit.clear()
            known = self._relit[place] = key, Relit(relighter, vertices, lighting, casters)
        return known[1]

    def lighting(
        self, settings: Any, receivers: tuple[Any, ...], to_world: np.ndarray, visible: Sequence[tuple[Any, Any]],
        depsgraph: Any,
    ) -> Lighting:  # fmt: skip
        """The scene's light in the space that `to_world` (4, 4) takes to the world, for objects
        `receivers`."""
        chosen = lighting_settings(depsgraph.scene).lights
        lights = []
        for each, matrix in visible:
            if each.type != "LIGHT" or (chosen is not None and each.name not in chosen.all_objects):
                continue
            light = (
                light_of(each.evaluated_get(depsgraph).data, matrix)
                if is_linked(each, receivers)
                else None
            )
            if light is not None:
                lights.append(in_avatar_space(light, to_world))
        white = np.maximum(np.array(settings.white, np.float64), 1e-3)
        red, green, blue = (white / white.mean()).tolist()
        world, suns = self._world(depsgraph, to_world) if settings.world else (no_world(), ())
        return Lighting(
            world=world,
            lights=(*lights, *suns),
            white=(red, green, blue),
            **{name: getattr(settings, name) for name in COPIED_SETTINGS},
        )

    def _world(self, depsgraph: Any, to_world: np.ndarray) -> tuple[np.ndarray, tuple[Light, ...]]:
        """Harmonics (9, 3) and suns in the space that `to_world` takes to the world; black where
        the world's nodes are not understood."""
        light = world_light(depsgraph.scene_eval.world)
        if light is None:
            return no_world(), ()
        if light.image is not None:
            light = light._replace(image=light.image.original)
        if light not in self._worlds:
            self._worlds = {light: split_world(light)}
        world, suns = self._worlds[light]
        if light.image is None:
            return world, suns
        u, _, v = np.linalg.svd(to_world[:3, :3])
        return rotated(world, (u @ v).T), tuple(in_avatar_space(sun, to_world) for sun in suns)


def _key(lighting: Lighting) -> tuple[Any, ...]:
    """Equal for lightings of the same values."""
    values = [value for name, value in vars(lighting).items() if name != "lights"]
    values += [value for light in lighting.lights for value in vars(light).values()]
    return tuple(value.tobytes() if isinstance(value, np.ndarray) else value for value in values)


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
        """Those that throw shadows onto `head`, in the space that `to_world` (4, 4) takes to the
        world; the same objects until the scene changes.

        visible: objects and their matrices, as of `visible_objects`.
        """
        if self._read is None:
            self._read = list(_casters(visible, depsgraph))
        key = head, to_world.tobytes()
        if key not in self._placed:
            to_avatar = np.linalg.inv(to_world)
            self._placed[key] = tuple(
                _moved(caster, to_avatar) for owner, caster in self._read if owner != head
            )
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
                # instances move splats and head together
                placed = each.evaluated_get(depsgraph).matrix_world
                yield head, _read(head, matrix @ placed.inverted_safe() @ local, depsgraph)
        elif each.type == "MESH" and each.visible_shadow and each.get(tags.KIND) != tags.HEAD:
            yield each, _read(each, matrix, depsgraph)


def _read(owner: Any, matrix: Any, depsgraph: Any) -> Caster:
    mesh = owner.evaluated_get(depsgraph).data
    mesh.calc_loop_triangles()
    faces = read_values(mesh.loop_triangles, "vertices", 3, np.int32)
    return _moved(
        Caster(mesh_vertices(mesh).astype(np.float64), faces), np.array(matrix, np.float64)
    )


def _moved(caster: Caster, matrix: np.ndarray) -> Caster:
    return Caster(caster.vertices @ matrix[:3, :3].T + matrix[:3, 3], caster.faces)


HIDDEN_RAYS = ("camera", "diffuse", "glossy", "transmission", "volume_scatter")
"""Rays that do not see a head which only throws shadows."""


def throws_shadow(splat_object: Any) -> bool:
    """Whether the head of a splat object is set up to throw its shadow, and nothing else, in
    images."""
    head = get_input(splat_object, splat_nodes.HEAD)
    return (
        head is not None
        and not head.hide_render
        and not head.visible_camera
        and bool(head.visible_shadow)
    )


def throw_shadow(splat_object: Any, is_on: bool) -> None:
    """Let the head's mesh throw its shadow onto the scene without being seen, or hide it from
    images again."""
    head = get_input(splat_object, splat_nodes.HEAD)
    head.hide_render = not is_on
    head.visible_shadow = True
    for ray in HIDDEN_RAYS:
        setattr(head, f"visible_{ray}", not is_on)
