"""Textures of a scene's light on splats, with the shadow maps that are drawn for them."""

from collections.abc import Sequence
from typing import Any

import gpu
import numpy as np

from ...light.lamps import MAP_SIZE
from ..layers import SceneLayer
from . import shaders
from .buffers import texture, triangle_batch
from .packing import RelitScene, ShadowView, relit_scene, surface, with_eye
from .shaders import MAP_COLUMNS

NEAR_PER_SQUARE = 3e-4
"""Meters from a lamp at which its map begins, which throws nothing nearer, over the head's squared
distance: float32 then distinguishes depths 0.2 mm apart."""


class RelitTextures:
    """What the shaders read of light for the layers drawn last."""

    def __init__(self) -> None:
        self._shader = shaders.shadow_map_shader()
        self._surface_of: tuple[Any, ...] = ()
        self._layers: Sequence[SceneLayer] = ()
        self._scene: RelitScene | None = None
        self._atlas: tuple[int, Any, Any, Any] | None = None
        self._batches: dict[tuple[int, int], tuple[Any, Any]] = {}
        self.textures: dict[str, Any] = {}

    def update(self, layers: Sequence[SceneLayer], eye: np.ndarray) -> dict[str, Any]:
        """The textures by name, for a camera at eye (3,); before a framebuffer is bound."""
        relighters = tuple((id(x.splats), x.relit and id(x.relit.relighter)) for x in layers)
        if relighters != self._surface_of:
            self.textures["surface"] = texture(surface(layers))
            self._surface_of = relighters
        known = [layer.relit for layer in self._layers]
        if self._scene is None or known != [layer.relit for layer in layers]:
            self._scene = relit_scene(layers)
            self._layers = tuple(layers)
            self.textures["vertices"] = texture(self._scene.vertices)
            self.textures["shadows"] = self._draw_maps(self._scene.maps)
        self.textures["lights"] = texture(with_eye(self._scene, layers, eye))
        return self.textures

    def _draw_maps(self, maps: Sequence[ShadowView]) -> Any:
        rows = max(1, -(-len(maps) // MAP_COLUMNS))
        if self._atlas is None or self._atlas[0] != rows:
            size = MAP_SIZE * MAP_COLUMNS, MAP_SIZE * rows
            depths = gpu.types.GPUTexture(size, format="R32F")
            tested = gpu.types.GPUTexture(size, format="DEPTH_COMPONENT32F")
            target = gpu.types.GPUFrameBuffer(depth_slot=tested, color_slots=(depths,))
            # a framebuffer does not keep its textures alive
            self._atlas = rows, depths, target, tested
        _, depths, target, _ = self._atlas
        known = self._batches
        self._batches = {}
        shader = self._shader
        with target.bind():
            target.clear(color=(shaders.NOTHING, 0.0, 0.0, 0.0), depth=1.0)
            gpu.state.depth_test_set("LESS_EQUAL")
            gpu.state.depth_mask_set(True)
            gpu.state.blend_set("NONE")
            gpu.state.face_culling_set("NONE")
            for index, (view, meshes) in enumerate(maps):
                x = MAP_SIZE * (index % MAP_COLUMNS)
                y = MAP_SIZE * (index // MAP_COLUMNS)
                gpu.state.viewport_set(x, y, MAP_SIZE, MAP_SIZE)
                shader.bind()
                for name, axis in zip(("row_x", "row_y", "row_z"), view.axes.T, strict=True):
                    shader.uniform_float(name, (*axis, -float(view.origin @ axis)))
                distance = float(((meshes[0][0] - view.origin) @ view.axes[:, 2]).max())
                near = min(max(1e-3, NEAR_PER_SQUARE * distance**2), abs(distance) / 2)
                lens = 2 * view.scale / view.size, float(view.is_parallel), near, 0.0
                shader.uniform_float("lens", lens)
                for mesh in meshes:
                    key = id(mesh[0]), id(mesh[1])
                    if key not in self._batches:
                        batch = known.get(key) or (mesh, triangle_batch("position", *mesh))
                        self._batches[key] = batch
                    self._batches[key][1].draw(shader)
            gpu.state.viewport_set(0, 0, MAP_SIZE * MAP_COLUMNS, MAP_SIZE * rows)
            gpu.state.depth_test_set("NONE")
            gpu.state.depth_mask_set(False)
        return depths
