"""Changes of the splats between steps: density control and stray resets (STGA, training), pruning
outside of the masks, and colors of sides of the head that no training view shows.

A needle beside the hair, which a few images call for and many others push back, would survive the
training. And nothing but what shines through the front trains a hidden side, which gives it any
color.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from ...avatar.embedding import FaceFrames, points_to_world
from ...avatar.splats import SH_C0, joined
from ...capture.camera import Camera, look_at
from ...capture.images import area_mean, read_mask
from ...capture.mesh_geometry import connected_parts, rasterize
from ...capture.model import Capture, evenly_spread
from ...flame.quaternions import to_matrices
from .initial_splats import mean_colors, mirror_images, pixels_of
from .state import TrainState, join, keep_rows, new_state

MIN_OPACITY = 0.02
"""Splats with a lower opacity are pruned."""
SPLIT_SCALE = 1.6
"""By which both halves of a split splat are narrower along the axis it is split on."""
MAX_OUTLINES = 16
MAX_OUTLINE_HEIGHT_PX = 400
"""Masks higher than this are shrunk to it."""
TOLERANCE_SHARE = 0.01
"""Error of masks and tracking, as a share of the image height."""
MAX_OUTSIDE_SHARE = 0.5
"""Share of the outlines in whose image a point lies, that it may lie outside of."""
SIDE_VIEWS = 48
"""Training views that are looked at, spread over all."""
MIN_COSINE = -0.1
SOURCE_COSINE = 0.5
"""Of the angle between a triangle and a camera: below the first, it faces away so far that not even
its hair stands in the outline; below the second, others do not take its color, which a matte's edge
may be in."""
SOURCE_TRIANGLES = 100
"""Of whose colors a hidden triangle has the median."""
OUTSIDE_CAMERAS = 18
OUTSIDE_DISTANCE = 4.0
"""Cameras that tell the neutral head's outside from its inside; their distance, in its radius."""


def control_density(
    state: TrainState,
    budget: int,
    rng: np.random.Generator,
    max_share: float,
    region: np.ndarray | None = None,
) -> TrainState:
    """Split the splats with the largest mean screen gradient and prune those of low opacity.

    budget: how many splats may be added; max_share: largest share of the splats that is split;
    region (F,) bool: the triangles whose splats may change, None for all. Every triangle with bound
    splats keeps one. Children, on either side of the parent's center along its longest axis,
    inherit triangle, binding and unseen share, lie within the parent's Gaussian in local units, and
    keep Adam's second moment and step count, without which their first steps would all be as long
    as the rate.
    """
    gradient = state.screen_gradient / np.maximum(state.gradient_count, 1)
    within = np.ones(len(state), bool) if region is None else region[state.face]
    gradient[~within] = 0.0
    count = max(0, min(budget, int(max_share * within.sum())))
    split = np.argsort(-gradient, kind="stable")[:count]
    split = split[gradient[split] > 0]
    kept = keep_rows(state, split)
    parents = kept.splats()
    pairs = join(kept, kept)
    n = np.arange(len(split))
    longest = np.argmax(parents.log_scale, axis=1)
    length = np.exp(parents.log_scale[n, longest])[:, None]
    offset = to_matrices(parents.rotation)[n, :, longest] * length * 0.5
    jitter = 1 + 0.1 * rng.standard_normal((len(parents), 1))
    parents.log_scale[n, longest] -= np.log(SPLIT_SCALE)
    # of two Gaussians beside each other, so much narrower, that cover as much as one
    opacity = np.maximum(SPLIT_SCALE / 2 * _sigmoid(parents.opacity), 2 * MIN_OPACITY)
    parents.opacity[:] = np.log(opacity / (1 - opacity))
    sides = [(parents.xyz + side * offset * jitter).astype(np.float32) for side in (-1, 1)]
    halves = joined([replace(parents, xyz=xyz) for xyz in sides])
    children = new_state(halves, pairs.unseen_share)
    children.second = pairs.second
    children.steps = pairs.steps
    faint = _sigmoid(state.parameters.opacity) < MIN_OPACITY
    keep = ~prunable(state, faint & within)
    keep[split] = False
    state = join(keep_rows(state, keep), children)
    zero = np.zeros(len(state), np.float32)
    return replace(state, screen_gradient=zero, gradient_count=zero.copy())


def reset_strays(state: TrainState, limit: np.ndarray, share: float) -> int:
    """Move bound splats farther than `limit` from their triangle's origin back to `share` of it;
    returns how many.

    limit (F,) in local units, infinite where none is moved. Works in place. (STGA, training, which
    moves them onto the origin: share = 0.) Adam's first moment of the position is reset. The second
    moment is kept: with it at zero and the step count of the row, which all its parameters share,
    in the thousands, the bias correction would make the next step 3.2 times as long as the learning
    rate (0.1 / √0.001).
    """
    distance = np.linalg.norm(state.parameters.xyz, axis=1)
    allowed = limit[state.face]
    strays = np.flatnonzero(~state.unbound & (distance > allowed))
    # Rounding must not leave them just beyond the limit, or they would be strays again.
    factor = (share * (1 - 1e-6) * allowed[strays] / distance[strays])[:, None]
    state.parameters.xyz[strays] = np.where(factor > 0, factor * state.parameters.xyz[strays], 0)
    state.first.xyz[strays] = 0
    state.average.xyz[strays] = state.parameters.xyz[strays]
    return len(strays)


def prunable(state: TrainState, unwanted: np.ndarray) -> np.ndarray:
    """(N,) bool: the unwanted splats (N,); a triangle that would lose all bound ones keeps the most
    opaque."""
    face = state.face
    bound = np.flatnonzero(~state.unbound)
    order = bound[np.lexsort((-state.parameters.opacity[bound], unwanted[bound], face[bound]))]
    first = np.ones(len(order), bool)
    first[1:] = face[order][1:] != face[order][:-1]
    prunable = unwanted.copy()
    prunable[order[first]] = False
    return prunable


def _sigmoid(x: np.ndarray) -> np.ndarray:
    """In float64."""
    return np.asarray(1 / (1 + np.exp(-x.astype(np.float64))))


@dataclass(frozen=True)
class Outline:
    """What a mask leaves clear, with a margin, (H, W) bool; camera: of that size."""

    timestep: int
    camera: Camera
    clear: np.ndarray


def read_outlines(capture: Capture, seed: int) -> list[Outline]:
    """Of MAX_OUTLINES training views drawn by `seed`, those with a mask. Raises StgaError."""
    views = capture.views["train"]
    outlines = []
    for n in np.random.default_rng(seed).permutation(len(views))[:MAX_OUTLINES]:
        view = views[n]
        mask = read_mask(views[n])
        if mask is None:
            continue
        camera = view.camera.scaled(min(1.0, MAX_OUTLINE_HEIGHT_PX / view.camera.height))
        margin = max(1, round(TOLERANCE_SHARE * camera.height))
        covered = area_mean(mask, camera.height, camera.width) > 127
        outlines.append(
            Outline(view.timestep, camera, ~binary_dilation(covered, iterations=margin))
        )
    return outlines


def prune_outside(
    state: TrainState,
    frames: Callable[[int], FaceFrames],
    outlines: Sequence[Outline],
    region: np.ndarray | None = None,
) -> TrainState:
    """Prune the splats whose center lies outside of most of the outlines in whose image it lies.

    frames: timestep -> the frames of the triangles; region (F,) bool: the triangles whose splats
    may change, None for all. Every triangle with bound splats keeps one.
    """
    seen, outside = np.zeros((2, len(state)), np.int32)
    rows = np.arange(len(state))
    for n, outline in enumerate(outlines):
        left = len(outlines) - n  # without those that all of these could not make a stray
        rows = rows[outside[rows] + left > MAX_OUTSIDE_SHARE * (seen[rows] + left)]
        face = state.face[rows]
        frame = frames(outline.timestep)
        x, y, shown = pixels_of(
            points_to_world(state.parameters.xyz[rows], frame, face), outline.camera
        )
        seen[rows] += shown
        outside[rows] += shown & outline.clear[y, x]
    stray = outside > MAX_OUTSIDE_SHARE * seen
    if region is not None:
        stray &= region[state.face]
    return keep_rows(state, ~prunable(state, stray))


@dataclass(frozen=True)
class UnseenSides:
    """Triangles (F,) bool of the outside that no view shows; the color (F, 3) in 0…1 they keep."""

    triangles: np.ndarray
    color: np.ndarray

    def restore(self, state: TrainState) -> TrainState:
        """Give bound splats there their color, from everywhere and in every expression."""
        rows = self.triangles[state.face] & ~state.unbound
        flat = (self.color[state.face[rows]] - 0.5) / SH_C0
        for kept in (state.parameters, state.average, state.first, state.second):
            kept.sh[rows] = 0
        state.parameters.sh[rows, 0] = state.average.sh[rows, 0] = flat
        return state


def unseen_sides(capture: Capture) -> UnseenSides:
    """Colored as mirror images that are shown, else as the nearest connected triangles."""
    views = evenly_spread(capture.views["train"], SIDE_VIEWS)
    cosine = np.full(len(capture.faces), -1.0)  # with the camera that a triangle faces most
    for view in views:
        a, b, c = np.asarray(capture.mesh(view.timestep))[capture.faces].swapaxes(0, 1)
        normal = np.cross(b - a, c - a)
        towards = view.camera.position - (a + b + c) / 3
        length = np.linalg.norm(normal, axis=1) * np.linalg.norm(towards, axis=1)
        cosine = np.maximum(cosine, (normal * towards).sum(1) / np.maximum(length, 1e-20))
    outside = _outside(capture)
    (color, shown) = mean_colors(capture, views)
    sources = np.flatnonzero(shown & outside & (cosine > SOURCE_COSINE))
    unseen = outside & (cosine < MIN_COSINE)
    if not len(sources):
        return UnseenSides(np.zeros_like(unseen), color)
    centers = np.asarray(capture.neutral)[capture.faces].mean(1)
    part = connected_parts(len(capture.neutral), capture.faces)[capture.faces[:, 0]]
    for number in np.unique(part[unseen]):
        rows = np.flatnonzero(unseen & (part == number))
        own = sources[part[sources] == number] if (part[sources] == number).any() else sources
        _, near = cKDTree(centers[own]).query(centers[rows], min(SOURCE_TRIANGLES, len(own)))
        color[rows] = np.median(color[own[near.reshape(len(rows), -1)]], axis=1)
    hidden, partner = mirror_images(capture, unseen, shown & (cosine > SOURCE_COSINE))
    color[hidden] = color[partner]
    return UnseenSides(unseen, color)


def _outside(capture: Capture) -> np.ndarray:
    """(F,) bool: triangles of the neutral mesh that some camera around it sees."""
    neutral = np.asarray(capture.neutral, np.float64)
    center = neutral.mean(0)
    radius = max(float(np.linalg.norm(neutral - center, axis=1).max()), 1e-9)
    seen = np.zeros(len(capture.faces), bool)
    for number in range(OUTSIDE_CAMERAS):
        angle = 2 * np.pi * number / OUTSIDE_CAMERAS
        height = (-0.5, 0.2, 0.9)[number % 3]
        eye = center + OUTSIDE_DISTANCE * radius * np.array([np.sin(angle), height, np.cos(angle)])
        camera = look_at(eye, center, 400, 400, focal_length=400 * OUTSIDE_DISTANCE / 2.2)
        triangle, _ = rasterize(neutral, capture.faces, camera)
        seen[np.unique(triangle[triangle >= 0])] = True
    return seen
