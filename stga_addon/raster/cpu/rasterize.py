"""Splats and a camera to an image, and the image's gradient back to the splats, on the CPU."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from ...avatar.embedding import FaceFrames
from ...avatar.splats import no_strain_color
from ...capture.camera import Camera
from .blend import blend_backward, blend_forward
from .layout import PROJECTED, TILE
from .project import compose_frames, project_backward, project_forward
from .threads import PIECES_PER_THREAD, threads
from .tiles import PARTS, compute_offsets, count_pairs, depth_order, fill_pairs, mark_tiles

BLACK_BACKGROUND = np.zeros(3, np.float32)


class Parameters(NamedTuple):
    """What is trained of N splats, in the raw form of `Splats`: numpy float32 arrays, or torch tensors in `autograd`.

    Without `strain_color`, colors do not follow strain.
    """

    xyz: Any
    rotation: Any
    log_scale: Any
    opacity: Any
    sh: Any
    strain_color: Any = None


@dataclass(frozen=True)
class CameraFrames:
    """Face frames seen from a camera: camera point = matrix @ local + origin, float32; strain as in `FaceFrames`."""

    camera: Camera
    origin: np.ndarray
    matrix: np.ndarray
    strain: np.ndarray
    to_world: np.ndarray
    intrinsics: np.ndarray
    size: np.ndarray


@dataclass(frozen=True)
class RenderOutput:
    """An image and what its backward pass needs.

    image (3, H, W) float32 over the background; transmittance (H, W) = 1 − alpha.
    With restricted tiles, pixels of other tiles are undefined.
    visible (M,) int32: the splats that reach a rendered tile. focus (N,) bool: those that need a gradient, or None for
    all; touched (tiles_y, tiles_x) bool: the tiles that they reach.
    """

    image: np.ndarray
    transmittance: np.ndarray
    visible: np.ndarray
    projected: np.ndarray
    rect: np.ndarray
    last: np.ndarray
    first_pair: np.ndarray
    pairs: np.ndarray
    splat_pairs: np.ndarray
    start: np.ndarray
    pair_splat: np.ndarray
    pair_rows: np.ndarray
    tiles: np.ndarray
    focus: np.ndarray | None
    touched: np.ndarray
    background: np.ndarray
    degree: int
    depth_as_color: bool
    antialiased: bool


class BufferPool:
    """Buffers that live on between iterations: fresh large arrays cost more page faults than the work in them."""

    def __init__(self) -> None:
        self._buffers: dict[str, np.ndarray] = {}

    def get(self, name: str, shape: tuple[int, ...], dtype: Any = np.float32) -> np.ndarray:
        """An uninitialized array; the same memory whenever the same name is taken again."""
        size = int(np.prod(shape))
        buffer = self._buffers.get(name)
        if buffer is None or len(buffer) < size:
            # An eighth to spare, so that a count that creeps upwards does not allocate every time.
            buffer = self._buffers[name] = np.empty(size + size // 8, dtype)
        return buffer[:size].reshape(shape)


def frames_in_camera(frames: FaceFrames, camera: Camera) -> CameraFrames:
    """Compose face frames with a camera in float64, so that distance from the origin costs no precision."""
    turn, shift = np.float64(camera.world_to_camera[:3, :3]), np.float64(camera.world_to_camera[:3, 3])
    parts = (frames.origin, frames.rotation, frames.scale, turn, shift)
    origin = np.empty((len(frames.origin), 3), np.float32)
    matrix = np.empty((len(frames.origin), 3, 3), np.float32)
    compose_frames(*(np.ascontiguousarray(part, np.float64) for part in parts), origin, matrix)
    return CameraFrames(
        camera=camera,
        origin=origin,
        matrix=matrix,
        strain=frames.strain,
        to_world=np.ascontiguousarray(turn.T, np.float32),
        intrinsics=np.array([camera.fl_x, camera.fl_y, camera.cx, camera.cy], np.float32),
        size=np.array([camera.width, camera.height], np.int64),
    )


def render_forward(
    splats: Parameters,
    face: np.ndarray,
    frames: CameraFrames,
    degree: int,
    background: np.ndarray = BLACK_BACKGROUND,
    focus: np.ndarray | None = None,
    reach: int = 0,
    depth_as_color: bool = False,
    antialiased: bool = False,
    buffers: "BufferPool | None" = None,
) -> RenderOutput:
    """Render N embedded splats over a background color (3,).

    splats: numpy arrays as in `Splats`; face (N,) int32; degree: spherical harmonics used.
    focus (N,) bool: render only the tiles these splats touch and those at most `reach` pixels away, which is all
    that can influence their gradient; None renders everything.
    depth_as_color: the first channel blends camera depth, the others are zero.
    antialiased: splats narrower than a pixel, which are rendered a pixel wide, lose the opacity that this adds.
    buffers: buffers to reuse; the rendering is then valid until the next one with the same buffers.
    """
    n, camera, splats = len(splats.xyz), frames.camera, with_strain_color(splats)
    array = (buffers or BufferPool()).get
    tiles_x, tiles_y = tile_grid(camera)
    projected, depth = array("projected", (n, PROJECTED)), array("depth", (n,))
    extent_y, rect = array("extent_y", (n,)), array("rect", (n, 4), np.int32)

    def project(rows: np.ndarray, rendered: np.ndarray) -> None:
        project_forward(
            rows, rendered, *splats, degree, face, frames.origin, frames.matrix, frames.strain, frames.to_world,
            frames.intrinsics, frames.size, depth_as_color, antialiased, projected, depth, extent_y, rect,
        )  # fmt: skip

    touched = rendered = np.ones((tiles_y, tiles_x), bool)
    if focus is None:
        project(np.arange(n), rendered)
    else:
        project(np.flatnonzero(focus), rendered)
        touched = np.zeros_like(rendered)
        mark_tiles(rect, np.flatnonzero(focus), touched)
        rendered = _dilate(touched, reach)
        project(np.flatnonzero(~focus), rendered)
    lists = sort_into_tiles(depth, rect, camera, array)
    tiles = interleave_tiles(np.flatnonzero(rendered).astype(np.int32))
    image = array("image", (3, camera.height, camera.width))
    transmittance = array("transmittance", (camera.height, camera.width))
    last = array("last", (camera.height, camera.width), np.int32)
    pair_rows = array("pair_rows", (len(lists.pair_splat), 4), np.uint8)
    background = np.asarray(background, np.float32)
    blend_forward(
        tiles, tiles_x, lists.start, lists.pair_splat, projected, extent_y, background, pair_rows, image, transmittance,
        last,
    )  # fmt: skip
    return RenderOutput(
        image, transmittance, lists.visible, projected, rect, last, lists.first_pair, lists.pairs, lists.splat_pairs,
        lists.start, lists.pair_splat, pair_rows, tiles, focus, touched, background, degree, depth_as_color,
        antialiased,
    )  # fmt: skip


class TileLists(NamedTuple):
    """Which splats touch which tile, as `blend_forward` wants it; visible (M,) int32: those that touch any."""

    visible: np.ndarray
    first_pair: np.ndarray
    pairs: np.ndarray
    splat_pairs: np.ndarray
    start: np.ndarray
    pair_splat: np.ndarray


def sort_into_tiles(
    depth: np.ndarray,
    rect: np.ndarray,
    camera: Camera,
    array: Callable[..., np.ndarray],
) -> TileLists:
    """Projected splats in tiles, front to back; arrays as from `project_forward`, array: a `BufferPool`'s `get`.

    Splats of several projections may stand in the arrays one after the other.
    """
    tiles_x, tiles_y = tile_grid(camera)
    visible = np.flatnonzero(rect[:, 2] > rect[:, 0]).astype(np.int32)
    order = depth_order(depth, visible)
    first_pair, pairs = array("first_pair", depth.shape, np.int32), array("pairs", depth.shape, np.int32)
    counts = array("counts", (PARTS, tiles_x * tiles_y), np.int32)
    count_pairs(rect, order, tiles_x, counts, pairs)
    start = compute_offsets(visible, pairs, counts, first_pair)
    splat_pairs = array("splat_pairs", (start[-1],), np.int32)
    pair_splat = array("pair_splat", (start[-1],), np.int32)
    fill_pairs(rect, order, tiles_x, counts, first_pair, splat_pairs, pair_splat)
    return TileLists(visible, first_pair, pairs, splat_pairs, start, pair_splat)


def render_backward(
    rendering: RenderOutput,
    splats: Parameters,
    face: np.ndarray,
    frames: CameraFrames,
    v_image: np.ndarray,
    gradients: Parameters,
    v_transmittance: np.ndarray | None = None,
    buffers: "BufferPool | None" = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Gradient of a scalar with respect to the splats, from its gradient with respect to the image.

    v_image (3, H, W); v_transmittance (H, W), zero if None. Overwrites those rows of `gradients` that belong to a
    visible splat, one in focus if the rendering has a focus, and leaves all others as they are.
    Returns the rows written (M,) int32, and screen (N,): for those rows, the length of the gradient with respect to
    the projected center in units of half the image.
    """
    n, array = len(splats.xyz), (buffers or BufferPool()).get
    tiles_x, _ = tile_grid(frames.camera)
    tiles, rows = rendering.tiles, rendering.visible
    wanted = np.ones(n, bool)
    if rendering.focus is not None:
        wanted = rendering.focus
        tiles, rows = tiles[rendering.touched.ravel()[tiles]], rows[wanted[rows]]
    pair_gradients = array("pair_gradients", (len(rendering.pair_splat), PROJECTED))
    screen = array("screen", (n,))
    if v_transmittance is None:
        v_transmittance = np.broadcast_to(np.float32(0), rendering.transmittance.shape)
    blend_backward(
        tiles, tiles_x, rendering.start, rendering.pair_splat, rendering.pair_rows, wanted,
        rendering.projected, rendering.background, rendering.transmittance, rendering.last, v_image,
        np.ascontiguousarray(v_transmittance), pair_gradients,
    )  # fmt: skip
    project_backward(
        rows, *with_strain_color(splats), rendering.degree, face, frames.origin, frames.matrix, frames.strain,
        frames.to_world,
        frames.intrinsics, frames.size, rendering.depth_as_color, rendering.antialiased, rendering.projected,
        rendering.first_pair, rendering.pairs, rendering.splat_pairs, pair_gradients, *with_strain_color(gradients),
        screen,
    )  # fmt: skip
    return rows, screen


def with_strain_color(splats: Parameters) -> Parameters:
    """With an empty `strain_color` where there is none, as the kernels want it."""
    if splats.strain_color is not None:
        return splats
    return splats._replace(strain_color=no_strain_color(len(splats.xyz)))


def tile_grid(camera: Camera) -> tuple[int, int]:
    """Columns and rows of tiles."""
    return -(-camera.width // TILE), -(-camera.height // TILE)


def _dilate(tiles: np.ndarray, reach: int) -> np.ndarray:
    """Tiles (rows, columns) bool within `reach` pixels of a marked one."""
    grown = tiles.copy()
    for _ in range(-(-reach // TILE)):
        padded = np.pad(grown, 1)
        rows = padded[:-2] | padded[1:-1] | padded[2:]
        grown = rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]
    return grown


def interleave_tiles(tiles: np.ndarray) -> np.ndarray:
    """Deal tiles out like cards, so that every piece of a thread's work is spread over the whole image."""
    pieces = PIECES_PER_THREAD * threads()
    return np.concatenate([tiles[k::pieces] for k in range(pieces)])
