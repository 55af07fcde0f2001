"""Draws layers of splats with Blender's `gpu` module, off-screen, into a viewport or to memory;
needs a GPU context."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import bpy
import gpu
import numpy as np

from ...avatar.embedding import FaceFrames
from ...raster.posed_splats import ComposedImage
from ..layers import SceneLayer
from . import packing, shaders, trial
from .buffers import EXACT, TEXTURE_WIDTH, read_pixels, rectangle_batch, texture, texture_rows
from .front_bones import NO_BONES
from .packing import StaticSplats, View
from .relit_textures import RelitTextures
from .shaders import PROJECTED_TEXTURES

CLEAR = (0.0, 0.0, 0.0, 0.0)
"""Premultiplied RGBA of an image without splats."""
OUTSIDE = 0
"""Part of the composite that is not near bones, as `composite_shader` numbers it."""
NEAR_BONES = 1
"""Part near bones, which are in front of the splats."""
BEHIND = 2
"""The background near bones, which is subtracted."""
COMPACT = "RGBA16F"
"""Format of the color target, beside EXACT."""
DEPTH_FORMAT = "RG32F"
"""Format of the depth target: depth · alpha, and alpha."""
_problems: dict[str, str] = {}
"""Format of the color target -> what was wrong with the first picture, "" where nothing was."""


class CompositeTarget(NamedTuple):
    """How a picture is put into the active framebuffer, which blends linearly and has the scene's
    depth.

    corner  pixel of the framebuffer for the image's bottom left
    to_depth  (a, b, c, d): depth in −1…1 is (a + b·z) / (c + d·z) at z meters along the view axis
    behind  sRGB expected behind the splats; None: not known
    test_depth  whether objects in front hide splats; not where the framebuffer lacks their depth
    bones  as of `front_bones`; near them, splats are put into `scene`
    scene  the framebuffer that a viewport shows below the active one; None: bones are ignored
    has_background  whether `behind` is in `scene`, of which what splats cover is then taken out
    """

    corner: tuple[int, int]
    to_depth: tuple[float, ...]
    behind: tuple[float, ...] | None = None
    test_depth: bool = True
    bones: np.ndarray = NO_BONES
    scene: Any = None
    has_background: bool = False


class SplatRenderer:
    """Shaders, the textures of the layers drawn last, and the targets they were drawn to.
    color_format: EXACT or COMPACT; short_keys: as of `packing.drawing_order`, for viewports. Raises
    WrongPicture where splats are drawn wrong here."""

    def __init__(self, color_format: str = EXACT, short_keys: bool = False) -> None:
        self._projection_shader = shaders.projection_shader()
        self._splat_shader = shaders.splat_shader()
        self._composite_shader = shaders.composite_shader()
        self._relit: tuple[RelitTextures, Any] | None = None
        self._screen = rectangle_batch(1)
        self._splat_rectangles = rectangle_batch(shaders.BLOCK_SPLATS)
        self._color_format = color_format
        self._short_keys = short_keys
        self._static: StaticSplats | None = None
        self._static_textures: dict[str, Any] = {}
        self._layers: Sequence[SceneLayer] = ()
        self._blocks: dict[int, tuple[FaceFrames, np.ndarray]] = {}
        self._size = (0, 0)
        self._color = self._depth = self._target = None
        self._projected: dict[str, Any] = {}
        self._projected_target: Any = None
        if color_format not in _problems:
            _problems[color_format] = self._problem()
        if _problems[color_format]:
            raise trial.WrongPicture(_problems[color_format])

    def _problem(self) -> str:
        """Try the shaders; one sentence where they draw splats wrong."""

        def drawn(layers: Sequence[SceneLayer], view: View) -> ComposedImage:
            self.draw(layers, view)
            return self.read()

        try:
            trial.check(drawn, hidden=shaders.BLOCK_SPLATS)
        except trial.WrongPicture as error:
            return (
                f"Blender {bpy.app.version_string} draws splats wrong "
                f"({gpu.platform.backend_type_get()}, {gpu.platform.renderer_get()}): {error}"
            )
        return ""

    def draw(self, layers: Sequence[SceneLayer], view: View) -> None:
        """Draw layers, sorted together, to this renderer's own targets: the first pass projects and
        colors each splat into the projected textures, the second draws them from far to near."""
        size = view.camera.width, view.camera.height
        if self._size != size:
            self._size, self._color = size, gpu.types.GPUTexture(size, format=self._color_format)
            self._depth = gpu.types.GPUTexture(size, format=DEPTH_FORMAT)
            self._target = gpu.types.GPUFrameBuffer(color_slots=(self._color, self._depth))
        gpu.state.depth_test_set("NONE")
        gpu.state.depth_mask_set(False)
        count = self._project(layers, view) if layers else 0
        with self._target.bind():  # type: ignore[attr-defined]
            gpu.state.active_framebuffer_get().clear(color=CLEAR)
            if not count:
                return
            gpu.state.blend_set("ALPHA_PREMULT")
            shader = self._splat_shader
            blocks = -(-count // shaders.BLOCK_SPLATS)
            shader.bind()
            for name in PROJECTED_TEXTURES:
                shader.uniform_sampler(name, self._projected[name])
            shader.uniform_int("first_block", 0)  # after the samplers: see `splat_shader`
            rectangles = self._splat_rectangles
            rectangles.draw_instanced(shader, instance_start=0, instance_count=blocks)
            gpu.state.blend_set("NONE")

    def read(self) -> ComposedImage:
        """What was drawn last, in memory."""
        color = read_pixels(self._color, 4)[::-1]
        depth = read_pixels(self._depth, 2)[::-1]
        alpha = np.ascontiguousarray(color[..., 3])
        rgb = np.ascontiguousarray(color[..., :3].transpose(2, 0, 1))
        return ComposedImage(rgb, alpha, depth[..., 0] / np.maximum(alpha, 1e-30))

    def composite(self, into: CompositeTarget) -> None:
        """Put what was drawn last into the active framebuffer."""
        bones = into.bones if into.scene is not None else NO_BONES
        texels = np.ascontiguousarray(bones if len(bones) else np.zeros((1, 2, 4)), np.float32)
        pixels = gpu.types.Buffer("FLOAT", texels.size, texels.reshape(-1))
        bone_image = gpu.types.GPUTexture((2, len(texels)), format=EXACT, data=pixels)
        shader = self._composite_shader

        def draw(part: int, behind: tuple[float, ...] | None) -> None:
            gpu.state.blend_set("SUBTRACT" if part == BEHIND else "ALPHA_PREMULT")
            gpu.state.depth_mask_set(False)
            gpu.state.depth_test_set("LESS_EQUAL" if into.test_depth else "NONE")
            shader.bind()
            shader.uniform_sampler("color_image", self._color)
            shader.uniform_sampler("depth_image", self._depth)
            shader.uniform_sampler("bones", bone_image)
            shader.uniform_float("part", (part, len(bones), 0.0, 0.0))
            shader.uniform_float("corner_px", (*into.corner, 0.0, 0.0))
            shader.uniform_float("to_depth", into.to_depth)
            shader.uniform_float("behind", CLEAR if behind is None else (*behind, 1.0))
            self._screen.draw(shader)
            gpu.state.depth_test_set("NONE")
            gpu.state.blend_set("NONE")

        draw(OUTSIDE, into.behind)
        if len(bones):
            if into.behind is not None and into.has_background:
                draw(BEHIND, into.behind)
            with into.scene.bind():
                draw(NEAR_BONES, None)

    def _project(self, layers: Sequence[SceneLayer], view: View) -> int:
        """Fill the projected textures with the splats, farthest first; how many there are."""
        if self._static is None or self._static.key != packing.static_key(layers):
            self._static = StaticSplats(layers)
            texels = self._static.texels.items()
            self._static_textures = {name: texture(values) for name, values in texels}
            size = TEXTURE_WIDTH, texture_rows(len(self._static.face))
            made = [gpu.types.GPUTexture(size, format=EXACT) for _ in PROJECTED_TEXTURES]
            self._projected = dict(zip(PROJECTED_TEXTURES, made, strict=True))
            self._projected_target = gpu.types.GPUFrameBuffer(color_slots=tuple(made))
        self._layers = layers  # keeps the splats alive by whose identity `static_key` knows them
        static = self._static
        known = self._blocks
        self._blocks = {}
        for each in (layer.frames for layer in layers):  # computed again only where they are new
            self._blocks[id(each)] = known.get(id(each)) or (each, packing.frame_block(each))
        blocks = [self._blocks[id(layer.frames)][1] for layer in layers]
        frames = packing.posed_frames(layers, blocks, view)
        order = packing.drawing_order(static, frames, view, self._short_keys)
        if not len(order):
            return 0
        shader = self._projection_shader
        relit = dict[str, Any]()
        if any(layer.relit is not None for layer in layers):
            self._relit = self._relit or (RelitTextures(), shaders.projection_shader(relit=True))
            relit = self._relit[0].update(layers, view.camera.position)
            shader = self._relit[1]
        textures = self._static_textures | relit
        textures["orders"] = texture(order[:, None], "R32F")
        textures["frames"] = texture(frames.texels.reshape(-1, 4))
        textures["table"] = texture(packing.table(static, layers, view))
        with self._projected_target.bind():
            gpu.state.blend_set("NONE")
            shader.bind()
            for name, read in textures.items():
                shader.uniform_sampler(name, read)
            shader.uniform_int("faces", frames.texels.shape[1])
            shader.uniform_int("count", len(order))
            self._screen.draw(shader)
        return len(order)
