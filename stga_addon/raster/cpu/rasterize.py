"""Rendering on the CPU: splats and a camera to an image, and the image's gradient back to the
splats."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from math import prod
from typing import Any

import numpy as np

from ...avatar import offsets
from ...avatar.embedding import FaceFrames
from ...capture.camera import Camera
from . import tiles as tiling
from .blend import blend_backward, blend_forward
from .layout import PROJECTED, RED, TILE, Blended, CameraFrames, Parameters, Projection, TileLists
from .optimizer import AdamOptions, AdamTables, ColorStep
from .project import compose_frames, move_frames, project_backward, project_forward

LINE_BYTES = 64
"""Bytes of a cache line: buffers in a chunk begin at a multiple of it."""
CHUNK_BYTES = 1 << 22
"""Least size of an allocation. From this size on, NumPy requests huge pages, except for arrays of
zeros; with small pages, random access costs more time in page lookups than in reading."""
BLACK_BACKGROUND = np.zeros(3, np.float32)


@dataclass(frozen=True)
class RenderOutput:
    """An image and what its backward pass needs; the tuples are those of `layout.py`.

    tiles (T,) int32: the rendered tiles, tile_blocks (tiles,) uint16: their blocks that are, see
    `find_needed_blocks`; all other pixels are undefined. focus (N,) bool: the splats that need a
    gradient, or None for all; touched (tiles_y, tiles_x) bool: the tiles that they reach.
    """

    blended: Blended
    projection: Projection
    lists: TileLists
    tiles: np.ndarray
    tile_blocks: np.ndarray
    focus: np.ndarray | None
    touched: np.ndarray
    background: np.ndarray
    degree: int
    depth_as_color: bool
    antialiased: bool

    @property
    def image(self) -> np.ndarray:
        """(3, H, W) over the background."""
        return self.blended.image

    @property
    def transmittance(self) -> np.ndarray:
        """(H, W), 1 − alpha."""
        return self.blended.transmittance


class BufferPool:
    """Buffers that are reused between iterations: fresh large arrays cost more page faults than the
    work in them."""

    def __init__(self) -> None:
        self._buffers: dict[str, np.ndarray] = {}
        self._kept: dict[str, tuple[tuple[int, ...], np.ndarray]] = {}
        self._chunk = np.empty(0, np.uint8)

    def get(self, name: str, shape: tuple[int, ...], dtype: Any = np.float32) -> np.ndarray:
        """An array to be written; the same memory whenever the same name is asked for again."""
        size = prod(shape)
        buffer = self._buffers.get(name)
        if buffer is None or len(buffer) < size:
            # An eighth to spare, so that a slowly growing count does not allocate every time.
            buffer = self._buffers[name] = self._zeros(size + size // 8, np.dtype(dtype))
        return buffer[:size].reshape(shape)

    def _zeros(self, size: int, dtype: np.dtype) -> np.ndarray:
        """New memory; not what it held: where a local iteration does not render, nothing may be
        infinite or NaN."""
        used = -(-size * dtype.itemsize // LINE_BYTES) * LINE_BYTES
        if used > len(self._chunk):
            self._chunk = np.empty(max(used, CHUNK_BYTES), np.uint8)
        part = self._chunk[:used]
        part.fill(0)
        self._chunk = self._chunk[used:]
        return part[: size * dtype.itemsize].view(dtype)

    def room(self, name: str) -> int:
        """How many values the name's array has had room for."""
        return len(self._buffers.get(name, ()))

    def kept(self, name: str, key: tuple[int, ...], make: Callable[..., np.ndarray]) -> np.ndarray:
        """make(*key), which nobody writes to; the same array as long as the key is the same."""
        if name not in self._kept or self._kept[name][0] != key:
            self._kept[name] = key, make(*key)
        return self._kept[name][1]


def frames_in_camera(
    frames: FaceFrames, camera: Camera, buffers: BufferPool | None = None
) -> CameraFrames:
    """Compose face frames with a camera in float64, so that distance from the origin costs no
    precision. buffers: as of `render_forward`."""
    buffers = buffers or BufferPool()
    rotation = np.float64(camera.world_to_camera[:3, :3])
    translation = np.float64(camera.world_to_camera[:3, 3])
    parts = (frames.origin, frames.rotation, frames.scale, rotation, translation)
    origin = buffers.get("origin", (len(frames.origin), 3))
    matrix = buffers.get("matrix", (len(frames.origin), 3, 3))
    compose_frames(*(np.ascontiguousarray(part, np.float64) for part in parts), origin, matrix)
    return CameraFrames(
        origin=origin,
        matrix=matrix,
        color=frames.color,
        to_world=np.ascontiguousarray(rotation.T, np.float32),
        intrinsics=np.array([camera.fl_x, camera.fl_y, camera.cx, camera.cy], np.float32),
        size=np.array([camera.width, camera.height], np.int64),
    )


def moved_frames(
    frames: FaceFrames, coefficients: Mapping[str, np.ndarray], signal: Callable[[str], np.ndarray]
) -> FaceFrames:
    """`avatar.offsets.moved_frames` by a kernel."""
    if not coefficients:
        return frames
    color = np.zeros((len(frames.scale), 3), np.float32)
    moved = frames.origin.copy(), frames.scale.copy(), color
    targets = set()
    for name, values in coefficients.items():
        offset = offsets.OFFSETS[name]
        targets.add(offset.target)
        target = offsets.TARGETS.index(offset.target)
        move_frames(values, signal(offset.signal), target, frames.rotation, frames.scale, moved)
    found = replace(frames, origin=moved[0], scale=moved[1])
    return replace(found, color=color) if offsets.COLOR in targets else found


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
    buffers: BufferPool | None = None,
) -> RenderOutput:
    """Render N embedded splats over a background color (3,).

    splats: numpy arrays; face (N,) int32; degree: of the spherical harmonics used.
    focus (N,) bool: render only the tiles that these splats touch and what is at most `reach`
    pixels away from the splats, which is all that can influence their gradient; None renders
    everything.
    depth_as_color: the first channel blends camera depth, the others are zero.
    antialiased: splats narrower than a pixel, which are rendered a pixel wide, lose the opacity
    that this adds.
    buffers: memory to reuse; the output is then valid until the next one with the same buffers.
    """
    buffers = buffers or BufferPool()
    width, height = frames.size.tolist()
    tiles_x, tiles_y = tile_grid(width, height)
    projection = new_projection(len(splats.xyz), buffers)

    def project(wanted: np.ndarray, covered: np.ndarray) -> None:
        options = degree, depth_as_color, antialiased
        project_forward(wanted, covered, splats, face, frames, *options, projection)

    touched = buffers.kept("all_tiles", (tiles_y, tiles_x), lambda *shape: np.ones(shape, bool))
    everywhere = buffers.kept(
        "everywhere", (tiles_y, tiles_x), lambda *shape: tiling.sum_tiles(np.ones(shape, bool))
    )
    if focus is None:
        project(_every_splat(len(splats.xyz), buffers), everywhere)
        tile_blocks = buffers.kept("whole_tiles", (tiles_x * tiles_y,), tiling.whole_tiles)
    else:
        project(focus, everywhere)
        touched, covered, tile_blocks = tiling.find_needed_blocks(
            projection, np.flatnonzero(focus), np.float32(reach), tiles_x, tiles_y
        )
        project(np.logical_not(focus, buffers.get("others", focus.shape, bool)), covered)
    lists, tiles = sort_into_tiles(projection, tiles_x, tile_blocks, buffers)
    background = np.asarray(background, np.float32)
    blended = new_image(width, height, lists, buffers)
    blend_forward(tiles, tiles_x, tile_blocks, lists, projection, background, blended)
    results = (blended, projection, lists, tiles, tile_blocks, focus, touched)
    return RenderOutput(*results, background, degree, depth_as_color, antialiased)


def render_backward(
    output: RenderOutput,
    splats: Parameters,
    face: np.ndarray,
    frames: CameraFrames,
    v_image: np.ndarray,
    gradients: Parameters,
    v_transmittance: np.ndarray | None = None,
    buffers: BufferPool | None = None,
    color: ColorStep | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Gradient of a scalar with respect to the splats, from its gradient with respect to the image.

    v_image (3, H, W); v_transmittance (H, W), zero if None. Overwrites those rows of `gradients`
    that belong to a visible splat, one in focus if the output has a focus, and leaves all others
    and coefficients above the degree in use unchanged. color: steps the coefficients instead, and
    only the first harmonic's gradient is written. Returns the rows written (M,) int32, and
    screen_gradient (N,): for those rows, the length of the gradient with respect to the projected
    center in units of half the image.
    """
    n = len(splats.xyz)
    buffers = buffers or BufferPool()
    lists = output.lists
    columns = output.projection.columns
    tiles, rows, wanted = _in_focus(output, n, buffers)
    pair_gradients = buffers.get("pair_gradients", (len(lists.pair_splat), PROJECTED))
    screen_gradient = buffers.get("screen_gradient", (n,))
    if v_transmittance is None:
        shape = output.transmittance.shape
        v_transmittance = buffers.kept(
            "v_transmittance", shape, lambda *shape: np.zeros(shape, np.float32)
        )
    blend_backward(
        tiles,
        tile_grid(*frames.size)[0],
        lists,
        output.blended,
        wanted,
        columns,
        output.background,
        v_image,
        np.ascontiguousarray(v_transmittance),
        pair_gradients,
    )
    project_backward(
        rows,
        splats,
        face,
        frames,
        output.degree,
        output.depth_as_color,
        output.antialiased,
        columns,
        lists,
        pair_gradients,
        gradients,
        screen_gradient,
        color or _no_step(splats.sh, gradients.sh),
    )
    return rows, screen_gradient


def _no_step(sh: np.ndarray, v_sh: np.ndarray) -> ColorStep:
    """A step of no coefficients, whose gradients are written instead."""
    arrays = [array.reshape(len(array), prod(array.shape[1:])) for array in (sh, *[v_sh] * 4)]
    tables = AdamTables._make([*arrays, np.empty(0, np.float32)])
    return ColorStep(np.empty(0, np.int32), tables, AdamOptions(*[np.float32(0)] * 5))


def blend_weights(output: RenderOutput, buffers: BufferPool) -> np.ndarray:
    """How many pixels each splat fills: the sum of its blend weights over the image, (N,) float64.

    output: of the whole image. A color's gradient, where the image's is 1, is this sum.
    """
    n = len(output.projection.depth)
    lists = output.lists
    ones = np.zeros_like(output.image)
    ones[0] = 1
    pair_gradients = buffers.get("pair_gradients", (len(lists.pair_splat), PROJECTED))
    blend_backward(
        output.tiles,
        tile_grid(*output.image.shape[:0:-1])[0],
        lists,
        output.blended,
        np.ones(n, bool),
        output.projection.columns,
        BLACK_BACKGROUND,
        ones,
        np.zeros(output.transmittance.shape, np.float32),
        pair_gradients,
    )
    return np.bincount(lists.pair_splat, pair_gradients[:, RED], n)


def _in_focus(
    output: RenderOutput, n: int, buffers: BufferPool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The tiles and the visible splats that the backward pass looks at, and whether each of the n
    splats is wanted."""
    if output.focus is None:
        return output.tiles, output.lists.visible, _every_splat(n, buffers)
    tiles = output.tiles[output.touched.ravel()[output.tiles]]
    return tiles, tiling.listed_rows(output.lists.visible, output.focus), output.focus


def _every_splat(n: int, buffers: BufferPool) -> np.ndarray:
    """(N,) bool: all are wanted."""
    return buffers.kept("every_splat", (n,), lambda n: np.ones(n, bool))


def new_projection(n: int, buffers: BufferPool) -> Projection:
    """Room for n projected splats."""
    return Projection(
        columns=buffers.get("columns", (n, PROJECTED)),
        depth=buffers.get("depth", (n,)),
        extent_y=buffers.get("extent_y", (n,)),
        rect=buffers.get("rect", (n, 4), np.int32),
    )


def new_image(width: int, height: int, lists: TileLists, buffers: BufferPool) -> Blended:
    """Room for an image made of the listed pairs."""
    return Blended(
        image=buffers.get("image", (3, height, width)),
        transmittance=buffers.get("transmittance", (height, width)),
        last=buffers.get("last", (height, width), np.int32),
        pair_blocks=buffers.get("pair_blocks", lists.pair_splat.shape, np.uint16),
    )


def sort_into_tiles(
    projection: Projection, tiles_x: int, tile_blocks: np.ndarray, buffers: BufferPool
) -> tuple[TileLists, np.ndarray]:
    """Which projected splats reach which tile, front to back; rows of several projections may
    follow each other.

    tile_blocks (tiles,): see `find_needed_blocks`. Returns the lists, and the tiles (T,) int32 with
    a needed block in the order in which they are rendered.
    """
    (n,) = projection.depth.shape
    found, visible, order, moved, first_pair, pairs = (
        buffers.get(name, (n,), np.int32)
        for name in ("found", "visible", "order", "moved", "first_pair", "pairs")
    )
    keys, moved_keys = (buffers.get(name, (n,), np.uint32) for name in ("keys", "moved_keys"))
    parts = tiling.parts_of(n)
    totals = np.zeros(5, np.int64)
    sorting = tiling.Sorting(
        parts=buffers.get("parts", (parts, 4), np.int64),
        found=found,
        keys=keys,
        order=order,
        moved_keys=moved_keys,
        moved=moved,
        digits=buffers.get("digits", (parts, tiling.DIGITS), np.int32),
        counts=buffers.get("counts", (tiling.SORT_PARTS, len(tile_blocks)), np.int32),
        totals=totals,
    )
    start = np.zeros(len(tile_blocks) + 1, np.int64)
    tiles = np.empty(len(tile_blocks), np.int32)
    room = buffers.room("pair_splat")
    while True:
        splat_pairs, pair_splat = (
            buffers.get(name, (room,), np.int32) for name in ("splat_pairs", "pair_splat")
        )
        lists = TileLists(visible, first_pair, pairs, splat_pairs, start, pair_splat)
        tiling.list_pairs(projection, tiles_x, tile_blocks, lists, tiles, sorting)
        splats, found_pairs = totals[:2].tolist()
        if found_pairs <= room:
            break
        room = found_pairs
    lists = lists._replace(
        visible=visible[:splats],
        splat_pairs=splat_pairs[:found_pairs],
        pair_splat=pair_splat[:found_pairs],
    )
    return lists, tiles[: totals[tiling.RENDERED]]


def tile_grid(width: int, height: int) -> tuple[int, int]:
    """Columns and rows of tiles of an image of width × height pixels."""
    return -(-width // TILE), -(-height // TILE)
