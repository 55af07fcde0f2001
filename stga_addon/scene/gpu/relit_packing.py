"""Relit layers as the float32 arrays that the shaders read; numpy only. `relit_shaders.py` documents the textures."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from ...light.harmonics import GLOSSY
from ...light.lamps import LightView, head_bounds, light_rows, light_view, texel_meters
from ...light.relight import Kept, Relighter
from ..layers import Relit, SceneLayer

SURFACE_TEXELS, VERTEX_TEXELS, LIGHT_TEXELS, MAP_TEXELS = 4, 3, 4, 4
"""Of a splat, of a vertex, of a point that stands for a light, and of a shadow map."""
RELIT_TEXELS = 14
"""Of a layer: share and factor of color; roughness, specular, first light and number of lights; eye, damping; typical
albedo; nine harmonics of the world as highlights show them; gain and share of what is kept of recorded colors
(`light.relight`)."""
MAX_MAPS = 16


def surface(layers: Sequence[SceneLayer]) -> np.ndarray:
    """(N · SURFACE_TEXELS, 4): what does not change of all splats; 0 for those of layers that are not relit."""
    parts, first = [], 0
    for layer in layers:
        texels = np.zeros((len(layer.splats), SURFACE_TEXELS, 4), np.float32)
        if layer.relit is not None:
            relighter = layer.relit.relighter
            texels[:, 0, :3], texels[:, 0, 3] = relighter.diffuse_color, relighter.roughness
            texels[:, 1, :3], texels[:, 1, 3] = relighter.irradiance, relighter.occlusion
            texels[:, 2, :3], texels[:, 3, :3] = relighter.corners + first, relighter.weights
            first += len(relighter.avatar.neutral)
        parts.append(texels.reshape(-1, 4))
    return np.concatenate(parts)


@dataclass(frozen=True, eq=False)
class ShadowView:
    """A shadow map to draw: `vertices` (V, 3) and `faces` of the head, then those of casters."""

    view: LightView
    meshes: tuple[tuple[np.ndarray, np.ndarray], ...]


@dataclass(frozen=True, eq=False)
class RelitScene:
    """What changes with pose or light, for layers that are relit.

    vertices (V · VERTEX_TEXELS, 4): position, normal, irradiance of the world and of skin around. lights (M, 4): as of
    `with_eye`. maps: the shadow maps, in order.
    """

    vertices: np.ndarray
    lights: np.ndarray
    maps: tuple[ShadowView, ...]


def relit_scene(layers: Sequence[SceneLayer]) -> RelitScene:
    """Pack poses and light of all layers; those that are not relit have a share of 0."""
    vertices, maps, rows = [np.zeros((0, 4), np.float32)], list[ShadowView](), list[np.ndarray]()
    head = np.zeros((len(layers), RELIT_TEXELS, 4), np.float32)
    first = head.shape[0] * RELIT_TEXELS
    map_rows: list[np.ndarray] = []
    for block, layer in zip(head, layers, strict=True):
        relit = layer.relit
        if relit is None:
            continue
        distant, kept = relit.relighter.distant_in_head(relit.mesh, relit.lighting)
        vertices.append(_vertices(relit, distant))
        points = _lights(relit, maps, map_rows)
        _fill(block, relit, kept, first + sum(map(len, rows)), len(points) // LIGHT_TEXELS)
        rows.append(points)
    first_map = first + sum(map(len, rows))
    lights = np.concatenate([head.reshape(-1, 4), *rows, *map_rows])
    head_rows = lights[: len(layers) * RELIT_TEXELS].reshape(-1, RELIT_TEXELS, 4)
    head_rows[:, 3, 3] = first_map
    return RelitScene(np.concatenate(vertices), lights, tuple(maps))


def with_eye(scene: RelitScene, layers: Sequence[SceneLayer], eye: np.ndarray) -> np.ndarray:
    """`RelitScene.lights` for a camera at eye (3,)."""
    lights = scene.lights.copy()
    for block, layer in zip(lights[: len(layers) * RELIT_TEXELS].reshape(-1, RELIT_TEXELS, 4), layers, strict=True):
        block[2, :3] = layer.eye_in_avatar(eye)
    return lights


def _fill(block: np.ndarray, relit: Relit, kept: Kept, first: int, count: int) -> None:
    lighting, relighter = relit.lighting, relit.relighter
    block[0, 0] = lighting.mix if lighting.mode == "mix" else 1
    block[0, 1:] = 2**lighting.exposure / np.asarray(lighting.white)
    block[1] = max(lighting.roughness, 0.05), lighting.specular, first, count
    block[2, 3], block[3, :3] = relighter.light.damping, relighter.typical_albedo
    block[4:13, :3] = GLOSSY[:, None] * lighting.world
    block[13] = *kept.gain, kept.share


def _lights(relit: Relit, maps: list[ShadowView], map_rows: list[np.ndarray]) -> np.ndarray:
    """(points · LIGHT_TEXELS, 4); adds the shadow maps that they need. Lights beyond MAX_MAPS throw no shadow."""
    bounds = head_bounds(relit.mesh)
    faces = relit.relighter.avatar.faces
    casters = *relit.casters, *relit.relighter.lash_casters(relit.mesh, relit.lighting)
    found = [np.zeros((0, 16), np.float32)]
    for light in relit.lighting.lights:
        shadowed = relit.lighting.shadows and light.casts_shadow and len(maps) < MAX_MAPS
        if shadowed:
            view = light_view(bounds, light)
            meshes = (relit.mesh, faces), *((caster.vertices, caster.faces) for caster in casters)
            maps.append(ShadowView(view, meshes))
            map_rows.append(_map_row(view, texel_meters(bounds)))
        found.append(light_rows(light, bounds.center, len(maps) - 1 if shadowed else -1))
    return np.concatenate(found).reshape(-1, 4)


def _map_row(view: LightView, texel_m: float) -> np.ndarray:
    """(MAP_TEXELS, 4): the rows of the map to the light's axes; scale, whether parallel, meters of a texel."""
    row = np.zeros((MAP_TEXELS, 4), np.float32)
    row[:3, :3], row[:3, 3] = view.axes.T, -(view.origin @ view.axes)
    row[3] = view.scale, view.is_parallel, texel_m, 0
    return row


def _vertices(relit: Relit, distant: np.ndarray) -> np.ndarray:
    """distant (9, 6): as of `Relighter.distant_in_head`."""
    relighter, mesh = relit.relighter, relit.mesh
    texels = np.zeros((len(mesh), VERTEX_TEXELS, 4), np.float32)
    texels[:, 0, :3], texels[:, 1, :3] = mesh, _normals(relighter)(mesh)
    arriving = np.maximum(relighter.light.transfer @ distant, 0)
    texels[:, 2, :3] = arriving[:, :3] + relighter.bounce.light(arriving[:, 3:])
    return texels.reshape(-1, 4)


class _Normals:
    """`surface.vertex_normals` for one mesh, in a fraction of the time."""

    def __init__(self, faces: np.ndarray, vertices: int) -> None:
        self._corners = [np.ascontiguousarray(corner) for corner in faces.T]
        order = np.argsort(faces.ravel(), kind="stable")
        self._face = order // 3
        self._used, self._first = np.unique(faces.ravel()[order], return_index=True)
        self._shape = vertices, 3

    def __call__(self, mesh: np.ndarray) -> np.ndarray:
        rows = [np.ascontiguousarray(row, np.float32) for row in mesh.T]
        a, b, c = ([row[corner] for row in rows] for corner in self._corners)
        u, v = [q - p for p, q in zip(a, b, strict=True)], [q - p for p, q in zip(a, c, strict=True)]
        total = [
            np.add.reduceat((u[k - 2] * v[k - 1] - u[k - 1] * v[k - 2])[self._face], self._first) for k in range(3)
        ]
        scale = 1 / np.maximum(np.sqrt(sum(row * row for row in total)), 1e-20)
        found = np.zeros(self._shape, np.float32)
        for k, row in enumerate(total):
            found[self._used, k] = row * scale
        return found


@lru_cache(maxsize=8)
def _normals(relighter: Relighter) -> _Normals:
    return _Normals(relighter.avatar.faces, len(relighter.avatar.neutral))
