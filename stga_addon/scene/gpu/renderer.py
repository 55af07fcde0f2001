"""Draws layers of splats with Blender's `gpu` module, off-screen, into a viewport or to memory;
needs a GPU context."""

import ctypes
import sys
from collections.abc import Sequence
from functools import cache
from typing import Any

import bpy
import gpu
import numpy as np
from mathutils import Vector

from ...avatar.embedding import FaceFrames
from ...light.lamps import MAP_SIZE
from ...raster.posed_splats import ComposedImage
from ..layers import SceneLayer
from . import packing, shaders, trial
from .packing import RelitScene, ShadowView, StaticSplats, View, relit_scene, surface, with_eye
from .shaders import EXACT, MAP_COLUMNS, PROJECTED_TEXTURES, TEXTURE_WIDTH, texture


@cache
def has_gpu_context() -> bool:
    """Whether Blender can be asked for a GPU context, in vain of which it aborts: with a window, or
    on Linux where EGL initializes its default display or, as Blender tries next, its first
    device."""
    if not bpy.app.background or sys.platform != "linux":
        return not bpy.app.background
    try:
        egl = ctypes.CDLL("libEGL.so.1")
        ctypes.CDLL("libGL.so.1")
    except OSError:
        return False
    pointer = ctypes.c_void_p
    count = ctypes.c_int()
    device = ctypes.c_void_p()
    egl.eglGetDisplay.restype = pointer
    egl.eglGetDisplay.argtypes = [pointer]
    egl.eglInitialize.argtypes = [pointer, pointer, pointer]
    egl.eglGetProcAddress.restype = pointer
    egl.eglGetProcAddress.argtypes = [ctypes.c_char_p]
    if egl.eglInitialize(egl.eglGetDisplay(None), None, None):
        return True
    names = b"eglQueryDevicesEXT", b"eglGetPlatformDisplayEXT"
    query, open_device = map(egl.eglGetProcAddress, names)
    if not query or not open_device:
        return False
    query = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, pointer, pointer)(query)
    if not query(1, ctypes.byref(device), ctypes.byref(count)) or not count.value:
        return False
    open_device = ctypes.CFUNCTYPE(pointer, ctypes.c_uint, pointer, pointer)(open_device)
    display = open_device(0x313F, device, None)  # EGL_PLATFORM_DEVICE_EXT
    return bool(display and egl.eglInitialize(display, None, None))


NEAR_PER_SQUARE = 3e-4
"""Meters from a lamp at which its map begins, which throws nothing nearer, over the head's squared
distance: float32 then tells depths there 0.2 mm apart."""


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
                        batch = known.get(key) or (mesh, _triangles("position", *mesh))
                        self._batches[key] = batch
                    self._batches[key][1].draw(shader)
            gpu.state.viewport_set(0, 0, MAP_SIZE * MAP_COLUMNS, MAP_SIZE * rows)
            gpu.state.depth_test_set("NONE")
            gpu.state.depth_mask_set(False)
        return depths


def _triangles(name: str, vertices: np.ndarray, faces: np.ndarray) -> Any:
    """A batch of triangles (F, 3) with one attribute (V, 2 or 3) of their vertices."""
    layout = gpu.types.GPUVertFormat()
    layout.attr_add(id=name, comp_type="F32", len=vertices.shape[1], fetch_mode="FLOAT")
    buffer = gpu.types.GPUVertBuf(len=len(vertices), format=layout)
    buffer.attr_fill(id=name, data=np.ascontiguousarray(vertices, np.float32))
    indices = gpu.types.GPUIndexBuf(type="TRIS", seq=np.ascontiguousarray(faces, np.uint32))
    return gpu.types.GPUBatch(type="TRIS", buf=buffer, elem=indices)


NO_BONES = np.zeros((0, 2, 4), np.float32)
MAX_SHAPES = 256  # bones looked for in each pixel; those of a larger rig are covered by splats
WIDTH_SHARE = 0.15
MARGIN_PX = 6.0
"""Half the width of a bone as a share of its length, and what is added for outlines."""


def front_bones(space: Any, region: Any, width: int, height: int) -> np.ndarray:
    """(M, 2, 4) float32: two ends of each bone in pixels (x0, y0, x1, y1), from the bottom left,
    and a radius beside three zeros. space, region: the SpaceView3D and its RegionView3D."""
    overlay = space.overlay
    if not (overlay.show_overlays and overlay.show_bones):
        return NO_BONES
    armatures = [each for each in bpy.context.view_layer.objects if each.type == "ARMATURE"]
    rigs = [each for each in armatures if each.show_in_front and each.visible_get(viewport=space)]
    found = list[tuple[Any, Any, float]]()  # head and tail in the world, half the width
    for rig, bone in ((each, bone) for each in rigs for bone in each.pose.bones):
        if bone.bone.hide or getattr(bone, "hide", False):
            continue
        matrix = rig.matrix_world
        size = rig.matrix_world.median_scale
        shape = bone.custom_shape if rig.data.show_bone_custom_shapes else None
        if shape is None:
            radius = size * bone.length * WIDTH_SHARE
            found.append((matrix @ bone.head, matrix @ bone.tail, radius))
            continue
        owner = bone.custom_shape_transform or bone  # a sphere around the shape
        center = matrix @ owner.matrix @ bone.custom_shape_translation
        reach = size * max(Vector(corner).length for corner in shape.bound_box)
        reach *= max(map(abs, bone.custom_shape_scale_xyz))
        reach *= bone.length if bone.use_custom_shape_bone_size else 1.0
        found.append((center, center, reach))
    if not found:
        return NO_BONES
    ends = np.array([[(*point, 1.0) for point in bone[:2]] for bone in found[:MAX_SHAPES]])
    radius = np.array([bone[2] for bone in found[:MAX_SHAPES]])
    clip = ends @ np.array(region.perspective_matrix, np.float64).T
    before = (clip[..., 3] > 0).all(1)  # the camera; a bone with an end behind it is left out
    clip = clip[before]
    radius = radius[before]
    half = np.array([width, height]) / 2
    shapes = np.zeros((len(clip), 2, 4), np.float32)
    shapes[:, 0] = ((clip[..., :2] / clip[..., 3:] + 1) * half).reshape(-1, 4)
    scale = np.abs(np.array(region.window_matrix[1][1])) * half[1] / clip[..., 3].min(1)
    shapes[:, 1, 0] = radius * scale + MARGIN_PX
    return shapes


CLEAR = (0.0, 0.0, 0.0, 0.0)
OUTSIDE = 0
NEAR_BONES = 1
BEHIND = 2
"""Parts of what `SplatRenderer.composite` draws, as `composite_shader` numbers them."""
COMPACT = "RGBA16F"  # format of the color target, beside EXACT
DEPTH_FORMAT = "RG32F"
SOFTWARE_RENDERERS = ("llvmpipe", "softpipe", "swiftshader", "basic render")
"""Parts of the names, in lower case, of OpenGL and Vulkan drivers that compute on the CPU."""
_problems: dict[str, str] = {}
"""Format of the color target -> what was wrong with the first picture, "" where nothing was."""


class SplatRenderer:
    """Shaders, the textures of the layers drawn last, and the targets they were drawn to.
    color_format: EXACT or COMPACT; short_keys: as of `packing.drawing_order`, for viewports. Raises
    WrongPicture where splats are drawn wrong here."""

    def __init__(self, color_format: str = EXACT, short_keys: bool = False) -> None:
        self._projection_shader = shaders.projection_shader()
        self._splat_shader = shaders.splat_shader()
        self._composite_shader = shaders.composite_shader()
        self._relit: tuple[RelitTextures, Any] | None = None
        self._screen = _rectangles(1)
        self._splat_rectangles = _rectangles(shaders.BLOCK_SPLATS)
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
            device = f"{gpu.platform.backend_type_get()}, {gpu.platform.renderer_get()}"
            return f"Blender {bpy.app.version_string} draws splats wrong ({device}): {error}"
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
        color = _pixels(self._color, 4)[::-1]
        depth = _pixels(self._depth, 2)[::-1]
        alpha = np.ascontiguousarray(color[..., 3])
        rgb = np.ascontiguousarray(color[..., :3].transpose(2, 0, 1))
        return ComposedImage(rgb, alpha, depth[..., 0] / np.maximum(alpha, 1e-30))

    def composite(
        self,
        corner: tuple[int, int],
        to_depth: tuple[float, ...],
        behind: tuple[float, ...] | None = None,
        test_depth: bool = True,
        bones: np.ndarray = NO_BONES,
        scene: Any = None,
        has_background: bool = False,
    ) -> None:
        """Put what was drawn last into the active framebuffer, which blends linearly and has the
        scene's depth.

        corner: pixel of the framebuffer for the image's bottom left. to_depth (a, b, c, d): depth
        in −1…1 is (a + b·z) / (c + d·z) at z meters along the view axis. behind: sRGB expected
        behind the splats, if known.
        test_depth: whether objects in front hide splats; not where the framebuffer lacks the
        scene's depth.
        bones: as of `front_bones`. Near them, splats are put into `scene`, the framebuffer that a
        viewport shows below the active one. Of that, if it has drawn its background there
        (`has_background`), what they cover is taken out.
        """
        bones = bones if scene is not None else NO_BONES
        texels = np.ascontiguousarray(bones if len(bones) else np.zeros((1, 2, 4)), np.float32)
        pixels = gpu.types.Buffer("FLOAT", texels.size, texels.reshape(-1))
        bone_image = gpu.types.GPUTexture((2, len(texels)), format=EXACT, data=pixels)
        shader = self._composite_shader

        def draw(part: int, behind: tuple[float, ...] | None) -> None:
            gpu.state.blend_set("SUBTRACT" if part == BEHIND else "ALPHA_PREMULT")
            gpu.state.depth_mask_set(False)
            gpu.state.depth_test_set("LESS_EQUAL" if test_depth else "NONE")
            shader.bind()
            shader.uniform_sampler("color_image", self._color)
            shader.uniform_sampler("depth_image", self._depth)
            shader.uniform_sampler("bones", bone_image)
            shader.uniform_float("part", (part, len(bones), 0.0, 0.0))
            shader.uniform_float("corner_px", (*corner, 0.0, 0.0))
            shader.uniform_float("to_depth", to_depth)
            shader.uniform_float("behind", CLEAR if behind is None else (*behind, 1.0))
            self._screen.draw(shader)
            gpu.state.depth_test_set("NONE")
            gpu.state.blend_set("NONE")

        draw(OUTSIDE, behind)
        if len(bones):
            if behind is not None and has_background:
                draw(BEHIND, behind)
            with scene.bind():
                draw(NEAR_BONES, None)

    def _project(self, layers: Sequence[SceneLayer], view: View) -> int:
        """Fill the projected textures with the splats, farthest first; how many there are."""
        if self._static is None or self._static.key != packing.static_key(layers):
            self._static = StaticSplats(layers)
            texels = self._static.texels.items()
            self._static_textures = {name: texture(values) for name, values in texels}
            size = TEXTURE_WIDTH, shaders.texture_rows(len(self._static.face))
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


def _rectangles(count: int) -> Any:
    """`count` rectangles in one batch, each with its own four vertices at ±1."""
    corners = np.tile([[-1, -1], [1, -1], [-1, 1], [1, 1]], (count, 1))
    triangles = 4 * np.arange(count)[:, None, None] + np.array([[0, 1, 2], [2, 1, 3]])
    return _triangles("corner", corners, triangles.reshape(-1, 3))


def _pixels(texture: Any, channels: int) -> np.ndarray:
    """(H, W, channels) float32, bottom row first."""
    buffer = texture.read()
    # Of several axes, a buffer tells numpy wrong strides in some versions; copied while it lives.
    buffer.dimensions = (texture.height * texture.width * channels,)
    return np.array(buffer, np.float32).reshape(texture.height, texture.width, channels)
