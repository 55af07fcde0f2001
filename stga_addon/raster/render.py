"""Splats and a camera to an image, and the image's gradient back to the splats, on the CPU."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numba
import numpy as np
import torch

from ..avatar.embedding import WORLD, FaceFrames
from ..capture.camera import Camera
from .kernels.bins import count_pairs, depth_order, fill_pairs
from .kernels.blend import PROJECTED, TILE, blend_backward, blend_forward
from .kernels.project import project_backward, project_forward


class Parameters(NamedTuple):
    """What is trained of N splats, in the raw form of `Splats`: numpy float32 arrays, or torch tensors in `render`."""

    xyz: Any
    rotation: Any
    log_scale: Any
    opacity: Any
    sh: Any


@dataclass(frozen=True)
class CameraFrames:
    """Face frames seen from a camera: camera point = matrix @ local + origin, float32."""

    camera: Camera
    origin: np.ndarray
    matrix: np.ndarray
    to_world: np.ndarray
    lens: np.ndarray
    size: np.ndarray


@dataclass(frozen=True)
class Rendering:
    """An image and what its backward pass needs.

    image (3, H, W) float32 premultiplied on black; transmittance (H, W) = 1 − alpha.
    With restricted tiles, pixels of other tiles are undefined.
    visible (M,) int32: the splats that reach a tile.
    """

    image: np.ndarray
    transmittance: np.ndarray
    visible: np.ndarray
    projected: np.ndarray
    extent: np.ndarray
    rect: np.ndarray
    last: np.ndarray
    slot_start: np.ndarray
    slot_count: np.ndarray
    start: np.ndarray
    pair_splat: np.ndarray
    pair_slot: np.ndarray
    tiles: np.ndarray
    degree: int
    depth_as_colour: bool

    def over(self, background: np.ndarray) -> np.ndarray:
        """The image (3, H, W) composited over a background colour (3,)."""
        return np.asarray(self.image + background[:, None, None] * self.transmittance)


def camera_frames(frames: FaceFrames, camera: Camera) -> CameraFrames:
    """Compose face frames with a camera in float64, so that distance from the origin costs no precision."""
    rotation, translation = camera.world_to_camera[:3, :3], camera.world_to_camera[:3, 3]
    return CameraFrames(
        camera=camera,
        origin=(frames.origin @ rotation.T + translation).astype(np.float32),
        matrix=((rotation @ frames.rotation) * frames.scale[:, None, None]).astype(np.float32),
        to_world=np.ascontiguousarray(rotation.T, np.float32),
        lens=np.array([camera.fl_x, camera.fl_y, camera.cx, camera.cy], np.float32),
        size=np.array([camera.width, camera.height], np.int64),
    )


def render_forward(
    splats: Parameters,
    face: np.ndarray,
    seen: CameraFrames,
    degree: int,
    focus: np.ndarray | None = None,
    reach: int = 0,
    depth_as_colour: bool = False,
) -> Rendering:
    """Render N embedded splats.

    splats: numpy arrays as in `Splats`; face (N,) int32; degree: spherical harmonics used.
    focus (N,) bool: render only the tiles these splats touch and those at most `reach` pixels away, which is all
    that can influence their gradient; None renders everything.
    depth_as_colour: the first channel blends camera depth, the others are zero.
    """
    n, camera = len(splats.xyz), seen.camera
    tiles_x, tiles_y = -(-camera.width // TILE), -(-camera.height // TILE)
    projected, depth = np.empty((n, PROJECTED), np.float32), np.empty(n, np.float32)
    extent, rect = np.empty((n, 2), np.float32), np.empty((n, 4), np.int32)
    project_forward(
        *splats, degree, face, seen.origin, seen.matrix, seen.to_world, seen.lens, seen.size, depth_as_colour,
        projected, depth, extent, rect,
    )  # fmt: skip
    visible = np.flatnonzero(rect[:, 2] > rect[:, 0]).astype(np.int32)
    order = depth_order(depth, visible)
    slot_start, slot_count = np.zeros(n, np.int32), np.zeros(n, np.int32)
    start = count_pairs(rect, order, tiles_x, tiles_y, slot_start, slot_count)
    pair_splat, pair_slot = np.empty(start[-1], np.int32), np.empty(start[-1], np.int32)
    bands = max(1, min(tiles_y, numba.get_num_threads()))
    fill_pairs(rect, order, tiles_x, tiles_y, slot_start, start, bands, pair_splat, pair_slot)

    tiles = np.arange(tiles_x * tiles_y, dtype=np.int32)
    if focus is not None:
        tiles = tiles[_near(touched_tiles(rect, focus, tiles_x, tiles_y), reach).ravel()]
    tiles = _deal(tiles, numba.get_num_threads())
    image = np.empty((3, camera.height, camera.width), np.float32)
    transmittance = np.empty((camera.height, camera.width), np.float32)
    last = np.empty((camera.height, camera.width), np.int32)
    blend_forward(tiles, tiles_x, start, pair_splat, projected, extent[:, 1], image, transmittance, last)
    return Rendering(
        image, transmittance, visible, projected, extent, rect, last, slot_start, slot_count, start, pair_splat,
        pair_slot, tiles, degree, depth_as_colour,
    )  # fmt: skip


def render_backward(
    rendering: Rendering,
    splats: Parameters,
    face: np.ndarray,
    seen: CameraFrames,
    v_image: np.ndarray,
    v_transmittance: np.ndarray,
    gradients: Parameters,
    focus: np.ndarray | None = None,
    add: bool = False,
) -> np.ndarray:
    """Gradient of a scalar with respect to the splats, from its gradient with respect to the image.

    v_image (3, H, W), v_transmittance (H, W). focus (N,) bool: splats that need one; None means all.
    Overwrites (or adds to) those rows of `gradients` that belong to a visible, wanted splat and leaves all others
    as they are. Returns the indices (M,) int32 of the rows written.
    """
    camera, n = seen.camera, len(splats.xyz)
    tiles_x, tiles_y = -(-camera.width // TILE), -(-camera.height // TILE)
    tiles, rows = rendering.tiles, rendering.visible
    wanted = np.ones(n, bool) if focus is None else focus
    if focus is not None:
        tiles = tiles[touched_tiles(rendering.rect, focus, tiles_x, tiles_y).ravel()[tiles]]
        rows = rows[focus[rows]]
    pair_gradients = np.empty((len(rendering.pair_slot), PROJECTED), np.float32)
    blend_backward(
        tiles, tiles_x, rendering.start, rendering.pair_splat, rendering.pair_slot, wanted, rendering.projected,
        rendering.extent[:, 1], rendering.transmittance, rendering.last, v_image, -v_transmittance, pair_gradients,
    )  # fmt: skip
    project_backward(
        splats.xyz, splats.rotation, splats.log_scale, splats.sh, rendering.degree, face, seen.origin, seen.matrix,
        seen.to_world, seen.lens, seen.size, rendering.depth_as_colour, rendering.projected, rows,
        rendering.slot_start, rendering.slot_count, pair_gradients, add, *gradients,
    )  # fmt: skip
    return rows


def touched_tiles(rect: np.ndarray, focus: np.ndarray, tiles_x: int, tiles_y: int) -> np.ndarray:
    """(tiles_y, tiles_x) bool: the tiles that a splat of `focus` (N,) bool reaches; rect (N, 4) tile bounds."""
    x0, y0, x1, y1 = rect[focus & (rect[:, 2] > rect[:, 0])].T
    corners = np.zeros((tiles_y + 1, tiles_x + 1), np.int32)
    for y, x, sign in ((y0, x0, 1), (y0, x1, -1), (y1, x0, -1), (y1, x1, 1)):
        np.add.at(corners, (y, x), sign)
    return np.asarray(corners.cumsum(0).cumsum(1)[:-1, :-1] > 0)


def _near(tiles: np.ndarray, reach: int) -> np.ndarray:
    """Tiles (rows, columns) bool within `reach` pixels of a marked one."""
    grown = tiles.copy()
    for _ in range(-(-reach // TILE)):
        padded = np.pad(grown, 1)
        rows = padded[:-2] | padded[1:-1] | padded[2:]
        grown = rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]
    return grown


def _deal(tiles: np.ndarray, threads: int) -> np.ndarray:
    """Deal tiles out like cards, so that every thread's contiguous share is spread over the whole image."""
    return np.concatenate([tiles[k::threads] for k in range(threads)])


def render(
    splats: Parameters, camera: Camera, frames: FaceFrames = WORLD, face: np.ndarray | None = None, degree: int = 3
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Differentiable rendering of float32 torch tensors: the functional door to the kernels.

    Without frames and face the splats are world-space ones. Returns rgb (3, H, W) premultiplied on black,
    alpha (H, W), and depth (H, W) = Σ weight · camera z.
    """
    face = np.zeros(len(splats.xyz), np.int32) if face is None else face
    seen = camera_frames(frames, camera)
    rgb, transmittance = _Blend.apply(seen, face, degree, False, *splats)
    depth, _ = _Blend.apply(seen, face, degree, True, *splats)
    return rgb, 1 - transmittance, depth[0]


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, seen: CameraFrames, face: np.ndarray, degree: int, depth_as_colour: bool, *tensors: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        splats = Parameters(*(t.detach().contiguous().numpy() for t in tensors))
        rendering = render_forward(splats, face, seen, degree, depth_as_colour=depth_as_colour)
        ctx.saved = seen, face, splats, rendering
        return torch.from_numpy(rendering.image), torch.from_numpy(rendering.transmittance)

    @staticmethod
    def backward(ctx: Any, v_image: torch.Tensor, v_transmittance: torch.Tensor) -> Any:  # type: ignore[override]
        seen, face, splats, rendering = ctx.saved
        gradients = Parameters(*(np.zeros_like(a) for a in splats))
        cotangents = (v.contiguous().numpy() for v in (v_image, v_transmittance))
        render_backward(rendering, splats, face, seen, *cotangents, gradients)
        return None, None, None, None, *(torch.from_numpy(g) for g in gradients)
