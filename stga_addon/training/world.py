"""Splats of what stands still behind the person: blocks of clean plates on a shell, trained."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import binary_dilation, gaussian_filter, zoom

from ..avatar.embedding import face_frames, to_local, to_world
from ..avatar.splats import SH_C0, Splats, in_world, joined
from ..capture.camera import Camera
from ..capture.images import read_view
from ..capture.mesh_geometry import pixels_of
from ..capture.model import Capture, View, evenly_spread, views_by_camera
from ..flame.quaternions import from_matrices, unit
from ..progress import Progress, Report, counted, ignore
from .optimize.image_preparation import Correction, exposure_correction
from .optimize.state import new_state
from .optimize.trainer import Start, Trainer
from .settings import Rates, TrainingSettings

MAX_PLATE_VIEWS = 24
"""Views of a camera that its plate is the median of."""
MAX_PLATE_PIXELS = 500_000
"""Larger images are read smaller."""
MATTE_MARGIN_FRACTION = 0.008
"""Width of the zone around the person where a matte is uncertain, as a fraction of the image's
height."""
PERSON = 256
"""Value above every level of a pixel, so that it is sorted behind them."""
RADII = 24
"""Shells that are tried."""
NEAREST_RADIUS = 0.3
"""Radius of the smallest shell, in distances of the cameras from the person."""
FARTHEST_RADIUS = 12.0
"""Radius of the largest shell, in the same unit."""
DEFAULT_RADIUS = 3.0
"""Radius where the plates do not determine it, because a wall has one color or a single camera sees
it."""
SAMPLED_POINTS = 4000
"""Pixels of each plate by which shells are compared."""
MIN_SHARED = 0.1
"""Fraction of the sampled pixels that another plate must contain for a shell to show the world's
distance."""
MIN_SIMILARITY = 0.3
"""Correlation of what both plates show there at least."""
DETAIL_FRACTIONS = 0.003, 0.03
"""Filters between which lie the details that plates are compared by; of the image's height."""
LARGEST_BLOCK = 16
"""Side of the largest block of the image that one splat stands for, in pixels."""
SMALLEST_BLOCK = 2
"""Side of the smallest one, in pixels."""
FLAT_LEVELS = 1.5
"""Standard deviation of a block's colors, of 255, up to which one splat stands for it."""
MAX_FIRST_SPLATS = 60_000
"""Splats that training begins with at most; above, FLAT_LEVELS is doubled until they fit."""
SAME_LEVELS = 8.0
"""A block is left out whose color another plate shows there, to so many of 255 levels."""
BLOCK_WIDTH = 0.8
"""Standard deviation of a block's splat, in sides of the block."""
THICKNESS_FRACTION = 0.2
"""Thickness of a splat as a fraction of its block's side."""
START_OPACITY = 5.0
"""Logit of the opacity that splats begin with."""
MIN_STEPS = 200
"""Optimization steps at least."""
STEPS_PER_CAMERA = 25
"""Optimization steps for each camera."""
RATES = Rates(
    xyz=1e-6, rotation=1e-3, log_scale=0.01, opacity=0.02, sh=0.02, sh_rest=0.004, end=0.1
)
"""Learning rates; positions hardly move, because blocks begin where they belong."""
TRIANGLE = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [0.0, 1.0, 0.0]])
"""Meters: what the splats are bound to, around the person."""
SH_DEGREE = 1
"""Walls shine a little, and cameras differ."""


@dataclass(frozen=True)
class CleanPlate:
    """A camera, and what it shows without the person.

    image     (H, W, 3) float32 in 0…1
    observed  (H, W) bool: pixels that some view shows; the others are filled from around
    """

    camera: Camera
    image: np.ndarray
    observed: np.ndarray


def clean_plates(capture: Capture, correct: Correction | None = None) -> list[CleanPlate]:
    """A clean plate of each camera with masks, from training views; correct: their exposure. Raises
    StgaError."""
    masked = [view for view in capture.views.get("train", ()) if view.mask is not None]
    plates = []
    for _, views in sorted(views_by_camera(masked).items()):
        camera = views[0].camera
        stack = []
        scale = min(1.0, (MAX_PLATE_PIXELS / (camera.width * camera.height)) ** 0.5)
        for full_size in evenly_spread(views, MAX_PLATE_VIEWS):
            view, image, mask = read_view(full_size, scale)
            if correct is not None:
                image = correct(view, image, None)
            assert mask is not None
            margin = max(1, round(MATTE_MARGIN_FRACTION * len(mask)))
            person = binary_dilation(mask > 0, iterations=margin)
            stack.append(np.where(person[..., None], PERSON, image).astype(np.uint16))
        levels = np.sort(np.stack(stack, axis=-1), axis=-1)
        count = (levels[:, :, 0] < PERSON).sum(axis=-1)
        middle = np.maximum(count - 1, 0)[..., None, None] // 2
        middle = np.broadcast_to(middle, (*count.shape, 3, 1))
        image = np.take_along_axis(levels, middle, axis=-1)[..., 0].astype(np.float32) / 255
        plates.append(CleanPlate(view.camera, filled(image, count > 0), count > 0))
    return plates


def filled(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The image (H, W, 3) float32 with smooth colors where `mask` (H, W) bool is not set: those of
    the image at half the size, whose pixels are means of those that have one (push and pull)."""
    if mask.all() or not mask.any():
        return image
    height, width = mask.shape
    weighted = np.zeros((height + height % 2, width + width % 2, 4), np.float32)
    weighted[:height, :width, :3] = image * mask[..., None]
    weighted[:height, :width, 3] = mask
    half = weighted.reshape(len(weighted) // 2, 2, -1, 2, 4).mean(axis=(1, 3))
    known = half[..., 3] > 0
    smaller = filled(half[..., :3] / np.maximum(half[..., 3:], 1e-6), known)
    larger = zoom(smaller, (2, 2, 1), order=1, mode="nearest", grid_mode=True)
    return np.where(mask[..., None], image, larger[:height, :width])


def world_of(capture: Capture, settings: TrainingSettings, report: Report) -> Splats:
    """Splats, in world space, of what stands still behind the person of a capture that has masks.

    settings: of the avatar's training; images are corrected for their exposure as there. Raises
    StgaError where a file cannot be read.
    """
    report(Progress(stage="World"))
    plates = clean_plates(capture, exposure_correction(settings))
    center = np.asarray(capture.mesh(capture.timesteps[0])).mean(axis=0)
    return trained_on(plates, center, report)


def trained_on(plates: Sequence[CleanPlate], center: np.ndarray, report: Report = ignore) -> Splats:
    """In world space, meters, that show plates from their cameras; center: (3,) of the person."""
    start = first_splats(plates, center)
    steps = max(MIN_STEPS, STEPS_PER_CAMERA * len(plates))
    # a capture of one timestep, whose views are the plates' and whose mesh is one triangle
    mesh = center + TRIANGLE
    faces = np.arange(3, dtype=np.int32)[None]
    cameras = enumerate(plate.camera for plate in plates)
    views = tuple(View(0, n, camera, f"plate {n}", Path()) for n, camera in cameras)
    capture = Capture(
        Path(), "world", faces, mesh, {"train": views}, (0,), {}, lambda _: mesh, lambda *_: mesh
    )
    mean = np.mean([plate.image.mean((0, 1)) for plate in plates], axis=0)
    settings = TrainingSettings(
        iterations=steps,
        rates=RATES,
        ema_share=0.1,
        sh_degree=SH_DEGREE,
        sh_steps=(0.3,),
        hull_points=False,
        density_interval=0,
        stray_reset_interval=0,
        unseen_opacity_weight=0.0,
        unbound_scale_limit=1e3,
        background=tuple(mean.tolist()),
        random_background=False,
    )
    frames = face_frames(mesh, faces, mesh)
    face = np.zeros(len(start), np.int32)
    trainer = Trainer(capture, settings, {}, Start(new_state(to_local(start, frames, face))))
    trainer.hooks.clear()  # what stands still has neither floaters around it nor unseen sides
    targets = [np.rint(255 * plate.image).astype(np.uint8) for plate in plates]
    for target in targets:
        # as in training: Numba would compile again for writable arrays
        target.setflags(write=False)
    turns = -(-steps // len(plates))
    rng = np.random.default_rng(0)
    order = np.concatenate([rng.permutation(len(plates)) for _ in range(turns)])[:steps]
    for number in counted(order, steps, report, "World", "Step"):
        trainer.step(views[number], targets[number], trainer.iteration / steps)
    return replace(to_world(trainer.state.splats(averaged=True), frames), face=face)


def shell_radius(plates: Sequence[CleanPlate], center: np.ndarray) -> float:
    """Meters from the person's center (3,) to the shell on which plates look most alike."""
    details = []  # without coarse colors, which light and exposure change, and without noise
    for plate in plates:
        sizes = [
            np.array([fraction, fraction, 0.0]) * len(plate.image) for fraction in DETAIL_FRACTIONS
        ]
        fine, coarse = (gaussian_filter(plate.image, size) for size in sizes)
        details.append(fine - coarse)
    distance = np.median([np.linalg.norm(plate.camera.position - center) for plate in plates])
    radii = distance * np.geomspace(NEAREST_RADIUS, FARTHEST_RADIUS, RADII)
    similarity = [_similarity(plates, details, center, radius) for radius in radii]
    best = int(np.argmax(similarity))
    return float(radii[best] if similarity[best] > MIN_SIMILARITY else DEFAULT_RADIUS * distance)


def _similarity(
    plates: Sequence[CleanPlate], details: Sequence[np.ndarray], center: np.ndarray, radius: float
) -> float:
    """Correlation of plates at the same points of a shell; 0 where they share too few."""
    mine = []
    theirs = []
    rng = np.random.default_rng(0)
    for plate, detail in zip(plates, details, strict=True):
        rows, columns = np.nonzero(plate.observed)
        chosen = rng.choice(len(rows), min(SAMPLED_POINTS, len(rows)), replace=False)
        rows = rows[chosen]
        columns = columns[chosen]
        points = on_shell(plate.camera, np.stack([columns, rows], 1) + 0.5, center, radius)
        for other, detail_there in zip(plates, details, strict=True):
            if other is not plate:
                x, y, inside = pixels_of(points, other.camera)
                inside &= other.observed[y, x]
                mine.append(detail[rows[inside], columns[inside]].ravel())
                theirs.append(detail_there[y[inside], x[inside]].ravel())
    one = np.concatenate([np.zeros(0), *mine])
    two = np.concatenate([np.zeros(0), *theirs])
    if len(one) < 3 * MIN_SHARED * SAMPLED_POINTS * len(plates):
        return 0.0
    return float((one * two).sum() / max(np.sqrt((one**2).sum() * (two**2).sum()), 1e-12))


def on_shell(camera: Camera, pixels: np.ndarray, center: np.ndarray, radius: float) -> np.ndarray:
    """World points (N, 3) where the rays of pixels (N, 2) meet a sphere behind its center; rays
    that pass beside the sphere end where they are nearest to the center, and half a radius
    farther."""
    origin = camera.position
    toward = unit(camera.unproject(pixels, np.ones(len(pixels))) - origin)
    nearest = toward @ (center - origin)
    miss = np.linalg.norm(origin + nearest[:, None] * toward - center, axis=1)
    beyond = np.sqrt(np.maximum(radius**2 - miss**2, radius**2 / 4))
    return origin + (np.maximum(nearest, 0) + beyond)[:, None] * toward


def first_splats(plates: Sequence[CleanPlate], center: np.ndarray) -> Splats:
    """A splat in world space for each block of the plates; of many plates more than
    MAX_FIRST_SPLATS, where blocks are as large as they may be."""
    radius = shell_radius(plates, center)
    levels = FLAT_LEVELS
    while True:
        parts = []
        for number, plate in enumerate(plates):
            camera = plate.camera
            middles, sides, colors = blocks(plate.image, levels)
            points = on_shell(camera, middles, center, radius)
            new = np.ones(len(points), bool)
            for other in plates[:number]:
                x, y, inside = pixels_of(points, other.camera)
                alike = abs(other.image[y, x] - colors).max(axis=1) < SAME_LEVELS / 255
                new &= ~(inside & alike)
            # flat, facing the camera
            points = points[new]
            count = int(new.sum())
            width = BLOCK_WIDTH * sides[new] * camera.project(points)[1] / camera.fl_x
            log_scale = np.log(np.stack([width, width, THICKNESS_FRACTION * width], axis=1))
            turn = from_matrices(camera.world_to_camera[None, :3, :3].transpose(0, 2, 1))
            sh = np.zeros((count, (SH_DEGREE + 1) ** 2, 3), np.float32)
            sh[:, 0] = (colors[new] - 0.5) / SH_C0
            rotation = np.repeat(turn, count, axis=0)
            opacity = np.full(count, START_OPACITY)
            parts.append(in_world(points, rotation, log_scale, opacity, sh, is_free=True))
        found = joined(parts)
        if len(found) <= MAX_FIRST_SPLATS or levels >= 255:
            return found
        levels *= 2


def blocks(image: np.ndarray, levels: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Squares of an image (H, W, 3) float32 whose colors deviate by less than so many of 255
    levels, also a little beyond its edge: their middles (N, 2) in pixels, sides (N,) and mean
    colors (N, 3)."""
    height, width = image.shape[:2]
    ends = [(LARGEST_BLOCK, LARGEST_BLOCK + -side % LARGEST_BLOCK) for side in (height, width)]
    padded = np.pad(image, [*ends, (0, 0)], mode="edge")
    found = []
    side = LARGEST_BLOCK
    open_ = np.ones((padded.shape[0] // side, padded.shape[1] // side), bool)
    while side >= SMALLEST_BLOCK:
        squares = padded.reshape(padded.shape[0] // side, side, padded.shape[1] // side, side, 3)
        mean = squares.mean(axis=(1, 3))
        deviation = squares.std(axis=(1, 3)).max(axis=-1)
        taken = open_ & ((deviation < levels / 255) | (side == SMALLEST_BLOCK))
        y, x = np.nonzero(taken)
        middles = side * (np.stack([x, y], 1) + 0.5) - LARGEST_BLOCK
        found.append((middles, np.full(len(x), side), mean[taken]))
        open_ = np.repeat(np.repeat(open_ & ~taken, 2, 0), 2, 1)
        side = side // 2
    middles, sides, colors = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return middles, sides.astype(np.float32), colors
