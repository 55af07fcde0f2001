"""Textures by which the projection pass lights splats, made again only where pose or light have changed."""

from collections.abc import Sequence
from typing import Any

import gpu
import numpy as np
from gpu.types import GPUBatch, GPUFrameBuffer, GPUIndexBuf, GPUTexture, GPUVertBuf, GPUVertFormat

from ...light.lamps import MAP_SIZE
from ..layers import SceneLayer
from .relit_packing import RelitScene, ShadowView, relit_scene, surface, with_eye
from .relit_shaders import MAP_COLUMNS, NOTHING, shadow_map_shader
from .textures import texture

NEAR_PER_SQUARE = 3e-4
"""Meters from a lamp at which its map begins, over the squared distance of the head: float32 then tells depths there
0.2 mm apart, and less where the map begins nearer. What is nearer throws no shadow."""


class RelitTextures:
    """What `relit_shaders` reads for the layers drawn last."""

    def __init__(self) -> None:
        self._shader = shadow_map_shader()
        self._surface_of: tuple[Any, ...] = ()
        self._scene_of: tuple[Any, ...] = ()
        self._kept: tuple[Any, ...] = ()
        self._scene: RelitScene | None = None
        self._atlas: tuple[int, Any, Any, Any] | None = None
        self._batches: dict[tuple[int, int], tuple[Any, Any]] = {}
        self.textures: dict[str, Any] = {}

    def update(self, layers: Sequence[SceneLayer], eye: np.ndarray) -> dict[str, Any]:
        """The textures by name, for a camera at eye (3,); must be called before a framebuffer is bound."""
        relighters = tuple((id(layer.splats), layer.relit and id(layer.relit.relighter)) for layer in layers)
        if relighters != self._surface_of:
            self.textures["surface"], self._surface_of = texture(surface(layers)), relighters
        scene_of = tuple(id(layer.relit) for layer in layers)
        if self._scene is None or scene_of != self._scene_of:
            self._scene = relit_scene(layers)
            self.textures["vertices"] = texture(self._scene.vertices)
            self.textures["shadows"] = self._draw_maps(self._scene.maps)
            self._scene_of = scene_of
            self._kept = tuple(layers)  # whose identity was compared
        self.textures["lights"] = texture(with_eye(self._scene, layers, eye))
        return self.textures

    def _draw_maps(self, maps: Sequence[ShadowView]) -> Any:
        rows = max(1, -(-len(maps) // MAP_COLUMNS))
        if self._atlas is None or self._atlas[0] != rows:
            size = MAP_SIZE * MAP_COLUMNS, MAP_SIZE * rows
            depths, tested = GPUTexture(size, format="R32F"), GPUTexture(size, format="DEPTH_COMPONENT32F")
            target = GPUFrameBuffer(depth_slot=tested, color_slots=(depths,))
            self._atlas = rows, depths, target, tested  # a framebuffer does not keep its textures alive
        _, depths, target, _ = self._atlas
        known, self._batches = self._batches, {}
        with target.bind():
            target.clear(color=(NOTHING, 0.0, 0.0, 0.0), depth=1.0)
            gpu.state.depth_test_set("LESS_EQUAL")
            gpu.state.depth_mask_set(True)
            gpu.state.blend_set("NONE")
            gpu.state.face_culling_set("NONE")
            for index, drawn in enumerate(maps):
                x, y = MAP_SIZE * (index % MAP_COLUMNS), MAP_SIZE * (index // MAP_COLUMNS)
                gpu.state.viewport_set(x, y, MAP_SIZE, MAP_SIZE)
                self._draw_map(drawn, known)
            gpu.state.viewport_set(0, 0, MAP_SIZE * MAP_COLUMNS, MAP_SIZE * rows)
            gpu.state.depth_test_set("NONE")
            gpu.state.depth_mask_set(False)
        return depths

    def _draw_map(self, drawn: ShadowView, known: dict[tuple[int, int], tuple[Any, Any]]) -> None:
        shader, view = self._shader, drawn.view
        shader.bind()
        for name, axis in zip(("row_x", "row_y", "row_z"), view.axes.T, strict=True):
            shader.uniform_float(name, (*axis, -float(view.origin @ axis)))
        distance = float(((drawn.meshes[0][0] - view.origin) @ view.axes[:, 2]).max())
        near = min(max(1e-3, NEAR_PER_SQUARE * distance**2), abs(distance) / 2)
        shader.uniform_float("lens", (2 * view.scale / view.size, float(view.is_parallel), near, 0.0))
        for mesh in drawn.meshes:
            key = id(mesh[0]), id(mesh[1])
            if key not in self._batches:
                self._batches[key] = known.get(key) or (mesh, _triangles(*mesh))
            self._batches[key][1].draw(shader)


def _triangles(vertices: np.ndarray, faces: np.ndarray) -> Any:
    layout = GPUVertFormat()
    layout.attr_add(id="position", comp_type="F32", len=3, fetch_mode="FLOAT")
    buffer = GPUVertBuf(len=len(vertices), format=layout)
    buffer.attr_fill(id="position", data=np.ascontiguousarray(vertices, np.float32))
    indices = GPUIndexBuf(type="TRIS", seq=np.ascontiguousarray(faces, np.uint32))
    return GPUBatch(type="TRIS", buf=buffer, elem=indices)
