"""What training views show of a head's surface: which triangles face a camera, where something
stands above them, where the mesh ends."""

from functools import cached_property

import numpy as np
from scipy.ndimage import binary_dilation
from scipy.spatial import cKDTree

from ...avatar.embedding import FaceFrames, face_areas, face_frames
from ...avatar.lattice import NORMAL_AXIS
from ...capture.camera import look_at
from ...capture.image_colors import SAMPLED_HEIGHT_PIXELS, mirrored
from ...capture.images import read_view
from ...capture.mesh_geometry import (
    connected_parts,
    facing,
    pixels_of,
    rasterize,
    silhouette,
    triangle_normals,
)
from ...capture.model import Capture, View, evenly_spread, views_by_timestep
from ...capture.visual_hull import FEW_CAMERAS, voxel_size
from ...errors import StgaError
from ...flame.model import torso_faces
from ...flame.quaternions import unit
from ...flame.teeth import lip_gap_m, lip_pairs
from ...tracking.solve import lid_fractions
from .outlines import TOLERANCE_FRACTION, clear_of
from .semantic_regions import (
    EYES_TO_MIDDLE,
    JAW_LEVEL,
    TORSO_HEIGHT,
    HeadCoordinates,
    HeadRegions,
    Region,
    head_coordinates,
    head_regions,
    nearest_rows,
    teeth_of,
)

FACING_TIMESTEPS = 300
"""Timesteps of the training views that are examined, spread over all: half a second of a turned
head counts in a recording of minutes."""
FACING_MESHES = 48
"""The same where each mesh is a file, which takes long to read."""
UNSEEN_COSINE = -0.1
"""Cosine between a triangle and the camera that it faces most below which not even hair stands in
an outline."""
HIDDEN_COSINE = 0.0
"""Cosine below which a triangle is hidden."""
GRAZING_COSINE = 0.2
"""Cosine below which a triangle fills little of any image, and may lie in the mesh's outline; many
outlines show its shape."""
OUTLINE_VIEWS = 16
"""Views, spread over all, whose outlines are measured."""
OUTSIDE_CAMERAS = 15
"""Cameras that distinguish the neutral head's outside from its inside."""
OUTSIDE_DISTANCE = 4.0
"""Their distance from the head's center, in its radius."""
OUTSIDE_WIDTH = 2.2
"""Width of their images, in the head's radius."""
OUTSIDE_PIXEL_FRACTION = 0.7
"""Side of their pixels, in sides of a square as large as the median triangle."""
OUTSIDE_SIDES_PX = (240, 2000)
"""Least and largest side of their images, however far a torso reaches."""
STEPS_PER_VOXEL = 4
"""Heights above a triangle that are tried in each voxel."""
MAX_HEIGHT_VOXELS = 10
"""Largest height that is tried."""
HEIGHTS = 4
"""Steps between a scalp's hair and its skin at which hair is compared with masks."""
OUTLINE_VOXELS = 1.5
"""Height within which a triangle must come out of the mesh's silhouette."""
AROUND = 30
"""Measured triangles of whose heights one that is in no outline has the median."""
BLINKS = ("eyeBlinkLeft", "eyeBlinkRight")
"""Expressions that pull lids out of their folds."""
LID_STRETCH = 1.8
"""Factor by which these lengthen a lid's triangle at least."""
CLOSED_FRACTION = 0.6
"""Weight of these expressions at which tracked eyes count as closed."""
OPEN_MOUTH_M = 0.012
"""Distance between the lips at which the mouth counts as open."""
OPEN_QUANTILE = 0.98
"""Quantile of that distance over a take's timesteps, a few of which may be tracked wrongly."""
MIN_SQUARED_AREA = 1e-28
"""Squared area in m⁴ below which a triangle has none."""
NECK_LEVELS = (-1.4, -1.2, -1.0, -0.8)
"""Heights over the eyes, in their distance from the mouth, at which nothing but long hair is wide:
shoulders are lower, ears higher."""
BELOW_NECK_LEVELS = (-1.6, -1.8, -2.0, -2.2)
"""Heights over the eyes, in their distance from the mouth, at which long hair may end."""
LONG_HAIR_WIDTH = 1.2
"""Least distance of long hair's edge from the middle plane, in distances of the eyes from the
mouth: that of ears."""
WIDTHS = (0.5, 3.0)
"""Distances from the middle plane between which a mask's edge is looked for."""
WIDTH_STEP = 0.05
"""Step between the distances that are tried."""
MAX_APART_DEG = 8.0
"""Largest angle between the directions in which one camera sees a triangle, and their mean."""
MAX_BESIDE_FRACTION = 0.1
"""Fraction of the masks in whose image a point lies, that it may lie outside of."""
MAX_STICKING_FRACTION = 0.05
"""Largest fraction of a torso's triangles that lie outside masks where images show a body."""
STANDING_VOXELS = 1.5
"""Height from which hair or a collar stands out."""
STANDING_REACH_VOXELS = 4
"""Distance from it within which a surface is not known to be flat."""


class Surface:
    """The triangles (F,) of a capture, each property found out when it is asked for first.

    neutral   (V, 3) the capture's, float64; centers (F, 3) and areas (F,) of its triangles
    voxel     meters between visual-hull points
    """

    def __init__(self, capture: Capture) -> None:
        self.capture = capture
        self.neutral = np.asarray(capture.neutral, np.float64)
        self.centers = self.neutral[capture.faces].mean(1)
        self.areas = face_areas(self.neutral, capture.faces)
        self.voxel = voxel_size(self.neutral)

    @cached_property
    def at(self) -> HeadCoordinates | None:
        """Where on the head the triangles are; None where that is not known."""
        return head_coordinates(self.capture)

    @cached_property
    def regions(self) -> HeadRegions:
        """The parts of the head that the triangles belong to."""
        return head_regions(self.capture)

    @cached_property
    def facing(self) -> np.ndarray:
        """(F,) cosine of the angle between each triangle's normal and the camera of the training
        views that it faces most."""
        return self._observed[0]

    @cached_property
    def _observed(self) -> tuple[np.ndarray, np.ndarray]:
        """`facing`, and (F,) bool: triangles whose centers lie in the image of a training view."""
        capture = self.capture
        by_timestep = views_by_timestep(capture.views["train"])
        limit = FACING_TIMESTEPS if capture.flame is not None else FACING_MESHES
        cosine = np.full(len(capture.faces), -1.0)
        within = np.zeros(len(capture.faces), bool)
        for timestep in evenly_spread(list(by_timestep), limit):
            center, normal = _centers_and_normals(capture, timestep)
            for view in by_timestep[timestep]:
                np.maximum(cosine, facing(view.camera, center, normal), out=cosine)
                others = np.flatnonzero(~within)
                within[others] = pixels_of(center[others], view.camera)[2]
        return cosine, within

    @cached_property
    def outside(self) -> np.ndarray:
        """(F,) bool: triangles of the neutral mesh that some camera around it sees; no teeth, which
        a slit between lips may show."""
        visible = np.zeros(len(self.capture.faces), bool)
        for number in range(OUTSIDE_CAMERAS):
            angle = 2 * np.pi * number / OUTSIDE_CAMERAS
            height = (-0.5, 0.2, 0.9)[number % 3]
            visible |= self.visible_from(np.array([np.sin(angle), height, np.cos(angle)]))[0]
        return visible & ~teeth_of(self.capture)

    def visible_from(self, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(F,) bool: triangles of the neutral mesh that a camera in this direction (3,) from its
        middle sees; (F,) cosine of the angle at which they face it."""
        neutral = self.neutral
        center = neutral.mean(0)
        radius = max(float(np.linalg.norm(neutral - center, axis=1).max()), 1e-9)
        corners = neutral[self.capture.faces]
        normal = triangle_normals(corners)
        square = np.sqrt(np.median(np.linalg.norm(normal, axis=1)) / 2)
        wanted = OUTSIDE_WIDTH * radius / max(OUTSIDE_PIXEL_FRACTION * square, 1e-9)
        side = int(np.clip(wanted, *OUTSIDE_SIDES_PX))
        eye = center + OUTSIDE_DISTANCE * radius * direction
        focal_length = side * OUTSIDE_DISTANCE / OUTSIDE_WIDTH
        camera = look_at(eye, center, side, side, focal_length=focal_length)
        triangle, _ = rasterize(neutral, self.capture.faces, camera)
        visible = np.zeros(len(self.capture.faces), bool)
        visible[np.unique(triangle[triangle >= 0])] = True
        normal = unit(normal, 1e-20)
        return visible, facing(camera, corners.mean(1), normal)

    @cached_property
    def filmed_along(self) -> np.ndarray | None:
        """(F, 3) float32: mean unit direction, world axes, in which training views see each
        triangle; None where most of them differ from it by more than MAX_APART_DEG."""
        directions = []
        for view in evenly_spread(self.capture.views["train"], OUTLINE_VIEWS):
            center, _ = _centers_and_normals(self.capture, view.timestep)
            directions.append(unit(center - view.camera.position, 1e-20))
        mean = unit(np.mean(directions, axis=0), 1e-20)
        cosine = (np.array(directions) * mean).sum(2)
        apart = np.degrees(np.arccos(np.clip(cosine, -1, 1))).max(0)
        return mean.astype(np.float32) if np.median(apart) < MAX_APART_DEG else None

    @cached_property
    def has_few_cameras(self) -> bool:
        cameras = {view.camera_index for view in self.capture.views["train"]}
        return len(cameras) <= FEW_CAMERAS

    @cached_property
    def turned_away(self) -> np.ndarray:
        """(F,) in 0…1, by how training views face a triangle: 1 where it faces away and its shape
        is unknown, 0 where no view grazes it."""
        return self.turned_from(GRAZING_COSINE)

    def turned_from(self, cosine: float, away: float = UNSEEN_COSINE) -> np.ndarray:
        """(F,) 1 where a triangle faces all cameras by less than the cosine `away`; it falls to 0
        at the other cosine. With many cameras, whose outlines show the shape, only 1 or 0."""
        if not self.has_few_cameras:
            return np.asarray(self.facing <= UNSEEN_COSINE, float)
        return np.asarray(np.interp(self.facing, (away, cosine), (1, 0)))

    @cached_property
    def hidden(self) -> np.ndarray:
        """(F,) bool: triangles of the outside that face away from all cameras, or lie beyond the
        edges of all images."""
        limit = HIDDEN_COSINE if self.has_few_cameras else UNSEEN_COSINE
        return np.asarray(self.outside & ((self.facing < limit) | ~self._observed[1]))

    @cached_property
    def closed(self) -> np.ndarray:
        """(F,) bool: hidden triangles that an opaque layer closes, so that no view shows the
        inside: all except those that stick out."""
        return np.asarray(self.hidden & ~self.sticks_out)

    @cached_property
    def sticks_out(self) -> np.ndarray:
        """(F,) bool: triangles outside of some masks, or next to such a triangle, as an ear of a
        head that was tracked with too much turn: they must be as transparent as images show."""
        every = np.arange(len(self.outside))
        touched = np.zeros(len(self.capture.neutral), bool)
        touched[self.capture.faces[self.beside_masks(every, np.zeros((1, 3)))[:, 0]]] = True
        return np.asarray(touched[self.capture.faces].any(1))

    def beside_masks(
        self,
        rows: np.ndarray,
        offsets: np.ndarray,
        margin_fraction: float = TOLERANCE_FRACTION,
    ) -> np.ndarray:
        """(N, K) bool: whether K points at each of the triangles `rows` (N,) lie outside of more
        than MAX_BESIDE_FRACTION of the masks in whose image they lie.

        offsets       (N, K, 3) or (K, 3) of the points from the triangles' origins, meters along
                      the axes of their frames
        margin_fraction  of the masks' height, which still counts as inside; negative: as outside
        """
        offsets = np.broadcast_to(offsets, (len(rows), *offsets.shape[-2:]))
        inside, beside = np.zeros((2, *offsets.shape[:2]), int)
        for (view, mask), frames in zip(self.masks, self._mask_frames, strict=True):
            points = np.einsum("nij,nkj->nki", frames.rotation[rows], offsets)
            points += frames.origin[rows, None]
            column, row, within = pixels_of(points.reshape(-1, 3), view.camera)
            inside += within.reshape(inside.shape)
            beside += (within & clear_of(mask > 127, margin_fraction)[row, column]).reshape(
                inside.shape
            )
        return np.asarray(beside > MAX_BESIDE_FRACTION * np.maximum(inside, 1))

    @cached_property
    def masks(self) -> list[tuple[View, np.ndarray]]:
        """Views, made small, whose outlines are measured, and their masks (H, W) uint8."""
        found = []
        for view in evenly_spread(self.capture.views["train"], OUTLINE_VIEWS):
            scale = min(1.0, SAMPLED_HEIGHT_PIXELS / view.camera.height)
            small, _, mask = read_view(view, scale)
            if mask is not None:
                found.append((small, mask))
        return found

    @cached_property
    def _mask_frames(self) -> list[FaceFrames]:
        """The triangles' frames in the meshes that the views of `masks` show."""
        found = []
        for view, _ in self.masks:
            mesh = np.asarray(self.capture.mesh(view.timestep), np.float64)
            found.append(face_frames(mesh, self.capture.faces, mesh, "stga"))
        return found

    @cached_property
    def lids(self) -> np.ndarray:
        """(F,) bool: triangles that a blink pulls out of a fold, in heads whose expressions have
        ARKit's names."""
        return np.any([np.zeros(len(self.capture.faces), bool), *self._lids.values()], axis=0)

    @cached_property
    def folded_lids(self) -> np.ndarray:
        """(F,) bool: the lids of eyes that no training view shows closed."""
        found = np.zeros(len(self.capture.faces), bool)
        flame = self.capture.flame
        if flame is None or not self._lids:
            return found
        timesteps = views_by_timestep(self.capture.views["train"])
        weights = np.array([flame.frame(timestep).expr for timestep in timesteps])
        for blink, lid in self._lids.items():
            columns, fractions = lid_fractions(flame.model, blink.removeprefix("eyeBlink"))
            if (weights[:, columns] @ fractions).max() < CLOSED_FRACTION:
                found |= lid
        return found

    @cached_property
    def shut_mouth(self) -> np.ndarray:
        """(F,) bool: the mouth of a take of few cameras that does not open it. None where the lips
        of the head model are not known."""
        none = np.zeros(len(self.capture.faces), bool)
        if self.capture.flame is None or not self.has_few_cameras:
            return none
        try:
            lips = lip_pairs(self.capture.flame.model)
        except StgaError:
            return none
        timesteps = list(views_by_timestep(self.capture.views["train"]))
        gaps = [
            lip_gap_m(lips, np.asarray(self.capture.mesh(timestep)))
            for timestep in evenly_spread(timesteps, FACING_TIMESTEPS)
        ]
        is_shut = np.quantile(gaps, OPEN_QUANTILE) < OPEN_MOUTH_M
        return self.regions.within(Region.MOUTH) if is_shut else none

    @cached_property
    def _lids(self) -> dict[str, np.ndarray]:
        """The lids (F,) bool that each of BLINKS closes."""
        found = dict[str, np.ndarray]()
        if self.capture.flame is None:
            return found
        model = self.capture.flame.model
        neutral = self.neutral
        for name in BLINKS:
            if name not in model.expression_names:
                continue
            number = model.n_identity + model.expression_names.index(name)
            moved = np.asarray(model.shapedirs)[:, :, number]
            rows = np.flatnonzero(moved.any(1)[self.capture.faces].any(1))
            corners = self.capture.faces[rows]
            found[name] = np.zeros(len(self.capture.faces), bool)
            found[name][rows] = (
                _largest_stretch(neutral[corners], (neutral + moved)[corners]) > LID_STRETCH
            )
        return found

    @cached_property
    def border(self) -> np.ndarray:
        """(F,) bool: triangles at the longest edge of the mesh, where a bust ends. None for a
        torso, whose end is outside the images."""
        faces = self.capture.faces
        count = len(self.capture.neutral)
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        edges, uses = np.unique(edges, axis=0, return_counts=True)
        edges = edges[uses == 1]
        if not len(edges):
            return np.zeros(len(faces), bool)
        ends = np.asarray(self.capture.neutral)[edges]
        length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
        part = connected_parts(count, edges)
        longest = np.bincount(part[edges[:, 0]], length).argmax()
        is_border = np.zeros(count, bool)
        is_border[edges[part[edges[:, 0]] == longest]] = True
        border = is_border[faces].any(1)
        if self.at is not None:
            level = self.at.level[border]
            if level.max() < JAW_LEVEL and np.ptp(level) > TORSO_HEIGHT:
                return np.zeros(len(faces), bool)
        return np.asarray(border)

    @cached_property
    def hair_height(self) -> np.ndarray:
        """(F,) meters of hair above the scalp's triangles, 0 elsewhere: as measured, else as
        measured in the neighborhood, equal on both sides of the head, but within masks."""
        height = np.zeros(len(self.outside))
        scalp = np.flatnonzero(self._scalp)
        measured = scalp[self._is_measured[scalp]] if len(scalp) else scalp
        if not len(measured):
            return height
        center = self.centers
        sources = np.concatenate([center[measured], mirrored(center)[measured]])
        near = measured[nearest_rows(sources, center[scalp], AROUND) % len(measured)]
        height[scalp] = np.median(self._measured_height[near], axis=1)
        # one side's hair may be higher than the other's, which it is mirrored from
        offsets = np.zeros((len(scalp), HEIGHTS + 1, 3))
        offsets[:, :, NORMAL_AXIS["stga"]] = height[scalp, None] * np.linspace(1, 0, HEIGHTS + 1)
        fits = ~self.beside_masks(scalp, offsets)
        fits[:, -1] = True
        height[scalp] = offsets[np.arange(len(scalp)), fits.argmax(1), NORMAL_AXIS["stga"]]
        return height

    @cached_property
    def is_flat(self) -> np.ndarray:
        """(F,) bool: hidden triangles and, with few cameras, skin and clothes above which no
        outline shows anything. The torso is left out where parts of it stick out of masks: hands
        and arms that images show there are elsewhere."""
        if self.at is None or not self.has_few_cameras:
            return self.hidden
        bare = self.outside & ~self._scalp
        stands = self._is_measured & (self._measured_height > STANDING_VOXELS * self.voxel)
        if stands.any():
            distance, _ = cKDTree(self.centers[stands]).query(self.centers)
            bare &= distance > STANDING_REACH_VOXELS * self.voxel
        if self.capture.flame is not None:
            torso = torso_faces(self.capture.flame.model)
            sticking = np.count_nonzero(self.sticks_out & torso)
            bare &= ~(torso & (sticking > MAX_STICKING_FRACTION * np.count_nonzero(torso)))
        return np.asarray(bare | self.hidden)

    @cached_property
    def kinds(self) -> dict[str, np.ndarray]:
        """Kind -> (F,) bool of the outside: "scalp", which includes what long hair hides, and
        "body", neck and shoulders. Unseen parts of each kind look like visible ones of it."""
        scalp = self.outside & self.regions.within(Region.SCALP)
        if self.at is not None and self.has_long_hair:
            under_hair = self.regions.within(Region.SIDE, Region.NAPE)
            scalp |= self.outside & under_hair & (self.at.level > self._hair_end)
        body = self.outside & ~scalp & self.regions.within(Region.NAPE, Region.BODY)
        return {"scalp": scalp, "body": body}

    @cached_property
    def has_long_hair(self) -> bool:
        """Whether masks are as wide on both sides of the neck, where no collar reaches, as they are
        at the ears; not where they are cut off."""
        if self.at is None or not self.regions.within(Region.SCALP).any():
            return False
        widths = self.widths(np.array(NECK_LEVELS))
        return bool(widths.min() >= LONG_HAIR_WIDTH and widths.max() < WIDTHS[1] - WIDTH_STEP)

    @cached_property
    def _hair_end(self) -> float:
        """Height over the eyes, in their distance from the mouth, above which long hair hangs; −∞
        where no gap separates it from the shoulders."""
        levels = np.array(BELOW_NECK_LEVELS)
        is_gap = self.widths(levels).mean(0) < LONG_HAIR_WIDTH
        return float(levels[is_gap.argmax()]) if is_gap.any() else -np.inf

    def widths(self, levels: np.ndarray) -> np.ndarray:
        """Distance (2, L) from the middle plane at which masks end to the right and to the left of
        the ears, at these heights over the eyes (L,); all in distances of the eyes from the mouth.
        The upper end of WIDTHS where no mask ends."""
        at = self.at
        assert at is not None
        across, up, ahead = at.axes
        tried = np.arange(*WIDTHS, WIDTH_STEP)
        sideways = np.multiply.outer([-1, 1], np.outer(tried, across))
        points = sideways[:, None] + levels[:, None, None] * up - EYES_TO_MIDDLE * ahead
        points = at.eyes + at.unit * points.reshape(-1, 3)
        scalp = np.flatnonzero(self.regions.within(Region.SCALP))
        rows = scalp[nearest_rows(self.centers[scalp], points, 1)[:, 0]]
        frames = face_frames(self.neutral, self.capture.faces, self.neutral, "stga")
        offsets = np.einsum("nji,nj->ni", frames.rotation[rows], points - frames.origin[rows])
        beside = self.beside_masks(rows, offsets[:, None]).reshape(2, len(levels), len(tried))
        beside[..., -1] = True
        return np.asarray(tried[beside.argmax(2)])

    @property
    def _scalp(self) -> np.ndarray:
        return self.kinds["scalp"]

    @property
    def _is_measured(self) -> np.ndarray:
        return self._outlines[1] > 0

    @property
    def _measured_height(self) -> np.ndarray:
        total, count = self._outlines
        return np.asarray(total / np.maximum(count, 1))

    @cached_property
    def _outlines(self) -> tuple[np.ndarray, np.ndarray]:
        """Sum (F,) of the heights, and in how many masks' outlines each triangle lies."""
        total, count = np.zeros((2, len(self.outside)))
        for view, mask in self.masks:
            rows, height = self._heights_in(view, mask)
            total[rows] += height
            count[rows] += 1
        return total, count

    def _heights_in(self, view: View, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Triangles in the outline of one view, and how high its mask reaches above them."""
        capture = self.capture
        center, normal = _centers_and_normals(capture, view.timestep)
        cosine = facing(view.camera, center, normal)
        rows = np.flatnonzero(self.outside & (np.abs(cosine) < GRAZING_COSINE))
        if not len(rows):
            return np.zeros(0, int), np.zeros(0)
        heights = np.arange(MAX_HEIGHT_VOXELS * STEPS_PER_VOXEL + 1) * self.voxel / STEPS_PER_VOXEL
        points = center[rows, None] + heights[:, None] * normal[rows, None]
        camera = view.camera
        column, row, within = pixels_of(points.reshape(-1, 3), camera)
        shape = len(rows), len(heights)
        covered = silhouette(capture.mesh(view.timestep), capture.faces[cosine > 0], camera)
        beside = (within & ~binary_dilation(covered)[row, column]).reshape(shape)
        is_outline = beside[:, heights <= OUTLINE_VOXELS * self.voxel].any(1) & beside[:, -1]
        is_outline &= within.reshape(shape).all(1)
        is_foreground = (within & (mask > 127)[row, column]).reshape(shape)
        steps = np.maximum(np.cumprod(is_foreground, axis=1).sum(1) - 1, 0)
        return rows[is_outline], heights[steps[is_outline]]


def _centers_and_normals(capture: Capture, timestep: int) -> tuple[np.ndarray, np.ndarray]:
    corners = np.asarray(capture.mesh(timestep), np.float64)[capture.faces]
    return corners.mean(1), unit(triangle_normals(corners), 1e-20)


def _largest_stretch(rest: np.ndarray, posed: np.ndarray) -> np.ndarray:
    """(F,) how much longer the direction in each triangle (F, 3, 3) has become that did most."""
    p, q, r = _edges_products(rest)
    area = p * r - q**2 + MIN_SQUARED_AREA
    a, b, c = _edges_products(posed)
    half = (a * r + c * p - 2 * b * q) / (2 * area)
    ratio = (a * c - b**2) / area
    return np.asarray(np.sqrt(half + np.sqrt(np.maximum(half**2 - ratio, 0))))


def _edges_products(corners: np.ndarray) -> np.ndarray:
    """Dot products (3, F) of two edges of triangles (F, 3, 3): of the first with itself, with the
    second, and of the second with itself."""
    first = corners[:, 1] - corners[:, 0]
    second = corners[:, 2] - corners[:, 0]
    pairs = (first, first), (first, second), (second, second)
    return np.stack([np.einsum("fi,fi->f", *pair) for pair in pairs])
