"""Splats, triangle frames, light and a view as float32 texels (vec4) that the shaders read, in the
order that `shaders.py` documents; numpy only."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from ...avatar.embedding import FaceFrames, points_to_world
from ...capture.camera import Camera
from ...capture.mesh_geometry import vertex_normals
from ...errors import StgaError
from ...flame.quaternions import normalized, to_matrices
from ...light.harmonics import GLOSSY
from ...light.lamps import LightView, head_bounds, light_rows, light_view
from ...raster.posed_splats import PosedSplats
from ..layers import SceneLayer, random_percentage

NEAR_M = 0.01
"""Splats nearer to the camera than this are dropped, as by the rasterizer."""
CLIP_PLANES = 6
"""Largest number of clip planes: that of Blender's `RegionView3D.clip_planes`."""
VIEW_TEXELS = 2 + CLIP_PLANES
"""Texels of the view: focal lengths and principal point; size and number of clip planes; these
planes."""
LAYER_TEXELS = 5
"""Texels of a layer: where its coefficients and splats begin and how many coefficients there are;
antialiasing, size and opacity threshold; rotation to the axes of training, in three."""
MAX_INDEX = 1 << 24
"""float32, in which the shader reads indices, holds whole numbers up to here exactly."""

MAX_SHORT_KEY = (1 << 16) - 1
"""Largest sort key of 16 bits."""
MAX_LONG_KEY = (1 << 24) - (1 << 8)
"""Largest sort key of 24 bits, as many as float32 has, less what rounding may add."""
MAX_RELATIVE_STEP = 1e-5
"""Largest step of depth between short keys as a fraction of the nearest depth: 5 µm at 0.5 m."""


@dataclass(frozen=True)
class View:
    """A camera, and the part of its space in which splats are drawn. far: meters; clip_planes (P,
    4), P ≤ 6, in world space: a splat is drawn where plane · (center, 1) ≥ 0 for all."""

    camera: Camera
    near: float = NEAR_M
    far: float = np.inf
    clip_planes: np.ndarray | None = None


def in_range(posed: PosedSplats, view: View) -> PosedSplats:
    """The splats whose centers lie within the view's near and far ends; the same object where all
    do."""
    world = points_to_world(posed.splats.xyz, posed.frames, posed.splats.face)
    row = (view.camera.world_to_camera @ posed.to_world)[2]
    depth = world @ row[:3] + row[3]
    inside = (depth >= view.near) & (depth <= view.far)
    return posed if inside.all() else replace(posed, splats=posed.splats.rows(inside))


class StaticSplats:
    """What stays while layers show the same splats. positions (3, N): in their triangles; face (N,)
    index into all layers' triangles; texels: name -> (M, 4)."""

    def __init__(self, layers: Sequence[SceneLayer]) -> None:
        self.key = static_key(layers)
        count = sum(len(layer.splats) for layer in layers)
        centers = np.empty((count, 4), np.float32)
        self.face = np.empty(count, np.intp)
        axes = np.empty((count, 3, 4), np.float32)
        colors = []
        self.rows = np.empty((len(layers), 4), np.float32)
        begin = first_face = first_color = 0
        for index, layer in enumerate(layers):
            splats = layer.splats
            rows = slice(begin, begin + len(layer.splats))
            centers[rows, :3] = splats.xyz
            self.face[rows] = splats.face + first_face
            deviation = np.exp(splats.log_scale.astype(np.float64))[:, None]
            turns = to_matrices(normalized(splats.rotation))
            axes[rows, :, :3] = np.swapaxes(turns * deviation, 1, 2)
            with np.errstate(over="ignore"):
                axes[rows, 0, 3] = splats.opacities()
            axes[rows, 1, 3] = random_percentage(len(splats))
            axes[rows, 2, 3] = index
            colors.append(np.pad(splats.sh, ((0, 0), (0, 0), (0, 1))).reshape(-1, 4))
            self.rows[index] = first_color, begin, splats.sh.shape[1], splats.sh_degree
            begin = rows.stop
            first_face = first_face + len(layer.frames.origin)
            first_color += len(colors[-1])
        if max(first_color, 3 * count, 5 * first_face) > MAX_INDEX:
            raise StgaError(f"{count} splats are too many to display as trained; choose Points")
        centers[:, 3] = self.face
        self.positions = np.ascontiguousarray(centers[:, :3].T)
        self.texels = {"centers": centers, "axes": axes.reshape(-1, 4)}
        self.texels["colors"] = np.concatenate(colors)


def static_key(layers: Sequence[SceneLayer]) -> tuple[tuple[int, int], ...]:
    """The identity of a `StaticSplats` of these layers, as long as their splats are alive."""
    return tuple((id(layer.splats), len(layer.frames.origin)) for layer in layers)


def frame_block(frames: FaceFrames) -> np.ndarray:
    """(3, 4·F) float64: the rows of the triangles' affine maps, [scale · rotation | origin]."""
    block = np.empty((3, len(frames.origin), 4))
    for row in range(3):
        for column in range(3):  # a column at a time: numpy is slow where the last axis is short
            np.multiply(frames.rotation[:, row, column], frames.scale, out=block[row, :, column])
    block[..., 3] = frames.origin.T
    return block.reshape(3, -1)


class PosedFrames(NamedTuple):
    """The triangles of all layers as a camera sees them. texels (5, F, 4) float32: three rows of
    the map to camera space, color and 1 where frozen plus 2 where unseen, `Relit.face_color`; the
    last only where there is any. depth_rows (4, F) float32: the third row, less `base` meters,
    which far away would round differences off."""

    texels: np.ndarray
    depth_rows: np.ndarray
    base: float


def posed_frames(
    layers: Sequence[SceneLayer], blocks: Sequence[np.ndarray], view: View
) -> PosedFrames:
    """Compose `frame_block` of each layer with its object and the camera, in float64."""
    count = sum(len(layer.frames.origin) for layer in layers)
    is_relit = any(layer.relit is not None for layer in layers)
    texels = np.zeros((5 if is_relit else 4, count, 4), np.float32)
    depth_rows = np.empty((4, count), np.float32)
    begin = 0
    base = 0.0
    for layer, block in zip(layers, blocks, strict=True):
        to_camera = view.camera.world_to_camera @ layer.to_world
        rows = slice(begin, begin + len(layer.frames.origin))
        part = (to_camera[:3, :3] @ block).reshape(3, -1, 4)
        part[..., 3] += to_camera[:3, 3:]
        texels[:3, rows] = part
        base = base if begin else float(part[2, 0, 3])
        part[2, :, 3] -= base
        depth_rows[:, rows] = part[2].T
        texels[3, rows, : layer.frames.color.shape[1]] = layer.frames.color
        if layer.relit is not None:
            texels[4, rows, : layer.relit.face_color.shape[1]] = layer.relit.face_color
        for value, faces in ((1, layer.frozen), (2, layer.unseen)):
            texels[3, rows, 3] += 0 if faces is None else value * faces
        begin = rows.stop
    return PosedFrames(texels, depth_rows, base)


def drawing_order(
    static: StaticSplats, frames: PosedFrames, view: View, short_keys: bool
) -> np.ndarray:
    """Indices (M,) float32 of the splats within near and far ends, farthest first. short_keys:
    those a few micrometers apart may be swapped, in half the time."""
    depth = np.take(frames.depth_rows[3], static.face, mode="clip")
    product = np.empty(len(depth), np.float32)
    for row, coordinate in zip(frames.depth_rows, static.positions, strict=False):
        np.take(row, static.face, out=product, mode="clip")  # row by row, which is fastest
        product *= coordinate
        depth += product
    near = view.near - frames.base
    far = view.far - frames.base
    chosen = None
    if not (len(depth) and depth.min() >= near and depth.max() <= far):
        chosen = np.flatnonzero((depth >= near) & (depth <= far))
        depth = depth[chosen]
    if not len(depth):
        return np.empty(0, np.float32)
    # By keys of 24 bits in two passes of 8 and 16, for which numpy uses radix sort. Short keys of
    # 16 bits take one, except where they would swap splats farther apart, as in a large scene.
    nearest = float(depth.min())
    span = max(float(depth.max()) - nearest, 1e-30)
    is_short = short_keys and span <= MAX_RELATIVE_STEP * MAX_SHORT_KEY * (nearest + frames.base)
    depth -= np.float32(nearest)
    depth *= np.float32((MAX_SHORT_KEY if is_short else MAX_LONG_KEY) / span)
    if is_short:
        order = np.argsort(depth.astype(np.uint16), kind="stable")
    else:
        key = depth.astype(np.uint32)
        order = np.argsort(key.astype(np.uint8), kind="stable")
        order = order[np.argsort((key >> 8).astype(np.uint16)[order], kind="stable")]
    # Reversed, so that of splats at the same depth the first is in front, as the rasterizer has it.
    return np.asarray(order[::-1] if chosen is None else chosen[order[::-1]], np.float32)


def table(static: StaticSplats, layers: Sequence[SceneLayer], view: View) -> np.ndarray:
    """(VIEW_TEXELS + LAYER_TEXELS · L, 4) float32: the view and each layer."""
    camera = view.camera
    texels = np.zeros((VIEW_TEXELS + LAYER_TEXELS * len(layers), 4), np.float32)
    planes = np.zeros((0, 4)) if view.clip_planes is None else view.clip_planes
    texels[0] = camera.fl_x, camera.fl_y, camera.cx, camera.cy
    texels[1] = camera.width, camera.height, len(planes), 0
    texels[2 : 2 + len(planes)] = planes @ np.linalg.inv(camera.world_to_camera)
    rows = texels[VIEW_TEXELS:].reshape(-1, LAYER_TEXELS, 4)
    for layer, first, row in zip(layers, static.rows, rows, strict=True):
        settings = layer.settings
        row[0] = first if settings.view_dependent else (*first[:3], 0)
        row[1] = layer.antialiased, settings.size, settings.opacity_threshold, 0
        # From directions in camera space to those of training: without scale and reflection.
        u, _, v = np.linalg.svd((camera.world_to_camera @ layer.to_world)[:3, :3])
        row[2:5, :3] = (u @ v).T
        row[2:5, 3] = (
            settings.percentage,
            2 * settings.selected_only or settings.show_selection,
            2 * settings.filmed_only or settings.show_unseen,
        )
    return texels


SURFACE_TEXELS = 4
"""Texels of a splat's surface."""
VERTEX_TEXELS = 3
"""Texels of a vertex."""
LIGHT_TEXELS = 4
"""Texels of a point that stands for a light."""
MAP_TEXELS = 4
"""Texels of a shadow map."""
RELIT_TEXELS = 14
"""Texels of a relit layer: weight and factor of color; roughness, specular, first light and number
of lights; eye, damping; typical albedo; nine harmonics of the world as highlights show them; gain
and weight of the part of recorded colors that is kept (`light.relight`)."""
MAX_MAPS = 16


def surface(layers: Sequence[SceneLayer]) -> np.ndarray:
    """(N · SURFACE_TEXELS, 4): constants of all splats; 0 for those that are not relit."""
    parts = []
    first = 0
    for layer in layers:
        texels = np.zeros((len(layer.splats), SURFACE_TEXELS, 4), np.float32)
        if layer.relit is not None:
            relighter = layer.relit.relighter
            texels[:, 0, :3] = relighter.diffuse_color
            texels[:, 0, 3] = relighter.roughness
            texels[:, 1, :3] = relighter.irradiance
            texels[:, 1, 3] = relighter.occlusion
            texels[:, 2, :3] = relighter.corners + first
            texels[:, 3, :3] = relighter.weights
            first += len(relighter.avatar.neutral)
        parts.append(texels.reshape(-1, 4))
    return np.concatenate(parts)


class ShadowView(NamedTuple):
    """A shadow map to draw: `vertices` (V, 3) and `faces` of the head, then those of casters."""

    view: LightView
    meshes: tuple[tuple[np.ndarray, np.ndarray], ...]


class RelitScene(NamedTuple):
    """What changes with pose or light of relit layers. vertices (V · VERTEX_TEXELS, 4): position,
    normal, irradiance of the world and of skin around. lights (M, 4): as of `with_eye`."""

    vertices: np.ndarray
    lights: np.ndarray
    maps: tuple[ShadowView, ...]


def relit_scene(layers: Sequence[SceneLayer]) -> RelitScene:
    """Pack poses and light of all layers; a fraction of 0: not relit. Lights beyond MAX_MAPS throw
    no shadow."""
    head = np.zeros((len(layers), RELIT_TEXELS, 4), np.float32)
    vertices = [np.zeros((0, 4), np.float32)]
    maps = list[ShadowView]()
    points = list[np.ndarray]()
    map_rows = list[np.ndarray]()
    for block, layer in zip(head, layers, strict=True):
        if layer.relit is None:
            continue
        lighting = layer.relit.lighting
        relighter = layer.relit.relighter
        mesh = layer.relit.mesh
        distant, kept = relighter.distant_in_head(mesh, lighting)
        texels = np.zeros((len(mesh), VERTEX_TEXELS, 4), np.float32)
        texels[:, 0, :3] = mesh
        texels[:, 1, :3] = vertex_normals(mesh, relighter.avatar.faces)
        arriving = np.maximum(relighter.light.transfer @ distant, 0)
        texels[:, 2, :3] = arriving[:, :3] + relighter.bounce.light(arriving[:, 3:])
        vertices.append(texels.reshape(-1, 4))
        block[0, 0] = lighting.mix if lighting.mode == "mix" else 1
        block[0, 1:] = 2**lighting.exposure / np.asarray(lighting.white)
        first = head.size // 4 + LIGHT_TEXELS * sum(map(len, points))
        bounds = head_bounds(mesh)
        casters = *layer.relit.casters, *relighter.lash_casters(mesh, lighting)
        meshes = (mesh, relighter.avatar.faces), *((one.vertices, one.faces) for one in casters)
        count = 0
        for light in lighting.lights:
            number = -1
            if lighting.shadows and light.casts_shadow and len(maps) < MAX_MAPS:
                view = light_view(bounds, light)
                number = len(maps)
                maps.append(ShadowView(view, meshes))
                # The map's rows to the light's axes; scale, whether parallel, meters of a texel.
                row = np.zeros((MAP_TEXELS, 4), np.float32)
                row[:3, :3] = view.axes.T
                row[:3, 3] = -(view.origin @ view.axes)
                row[3] = view.scale, view.is_parallel, view.texel_m, 0
                map_rows.append(row)
            points.append(light_rows(light, bounds.center, number))
            count += len(points[-1])
        block[1] = max(lighting.roughness, 0.05), lighting.specular, first, count
        block[2, 3] = relighter.light.damping
        block[3, :3] = relighter.typical_albedo
        block[4:13, :3] = GLOSSY[:, None] * lighting.world
        block[13] = *kept.gain, kept.fraction
    head[:, 3, 3] = head.size // 4 + LIGHT_TEXELS * sum(map(len, points))
    rows = [head, *points, *map_rows]
    lights = np.concatenate([each.reshape(-1, 4) for each in rows])
    return RelitScene(np.concatenate(vertices), lights, tuple(maps))


def with_eye(scene: RelitScene, layers: Sequence[SceneLayer], eye: np.ndarray) -> np.ndarray:
    """`RelitScene.lights` for a camera at eye (3,)."""
    lights = scene.lights.copy()
    for index, layer in enumerate(layers):
        lights[RELIT_TEXELS * index + 2, :3] = layer.eye_in_avatar(eye)
    return lights
