"""Focal length of a single camera, from a head's landmarks and a prior; and cameras of a rig that
see the head larger or smaller than the others do."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..capture.camera import Camera
from ..capture.mesh_geometry import Similarity
from ..capture.model import evenly_spread
from ..flame.forward import RIGID_SIZE, TRANSLATION_SIZE
from ..worker.helpers import Step
from . import fit as head_fit
from .fit import HeadFit, RecordedTake, TimestepLandmarks
from .head_model import HeadModel
from .landmark_bias import LandmarkBias, bias_in
from .posed_points import PosedPoints, SurfacePoints, head_rotation, split
from .solve import LANDMARK_SIGMA_M, Observation, person, residuals, solve_identity

CANDIDATES = 64
"""Timesteps, spread over the take, among which the most differently turned ones are looked for."""
TIMESTEPS = 12
"""Timesteps whose landmarks are compared."""
LANDMARKS = 80
"""Landmarks that are compared, spread over the reliable ones."""
PLACE_SIGMA_M = 0.002
"""Standard deviation of what a person's landmark misses the head by in all timesteps alike."""
NOISE_SIGMA_M = 0.0006
"""Standard deviation of what a landmark misses the head by beyond that in one timestep."""
RATIOS = np.geomspace(0.5, 6.0, 7)
"""Focal lengths that the head is fitted for, relative to a phone's: 104° to 12° of diagonal."""
FINE_RATIOS = np.geomspace(0.5, 6.0, 400)
"""Focal lengths between which the posterior is read."""
ROUNDS = 2
"""Fits of the head for each focal length, as its depth is that of the fit before."""
MAX_OFF_AXIS_DEG = 40.0
"""Largest angle between the direction that a face looks in and the camera, at which its landmarks
are compared: the networks' bias beyond it differs from person to person."""
CAMERA_ASPECTS = (16 / 9, 4 / 3, 3 / 2)
"""Longer over shorter side of images as cameras record them; others were cropped."""
ASPECT_TOLERANCE = 0.005
"""Relative difference up to which an image has one of these."""
PHONE_WEIGHT = 0.3
"""Prior probability that a phone recorded whole images whose files do not name a lens, as those of
phones do."""
PHONE_SIGMA = 0.35
"""Standard deviation of the logarithm of a phone's focal length."""
PORTRAIT_RATIO = 4.0
"""Focal length of a portrait lens relative to a phone's: 135 mm on 24 x 36 mm, about the longest
that people are filmed with, as too long is better than too short."""
PORTRAIT_SIGMA = 0.5
"""Standard deviation of its logarithm."""
CROPPED_SIGMA = 1.2
"""Standard deviation of the logarithm of a focal length, about a phone's, where images were
cropped, which makes them narrower."""
DISTANCE_M = 1.2
"""Median distance of a camera from a face."""
DISTANCE_SIGMA = 0.5
"""Standard deviation of the distance's logarithm: a phone in the hand is nearer, portraits are
taken from farther away."""
CROPPED_DISTANCE_SIGMA = 0.4
"""The same where images were cropped, as those of interviews are."""
DATA_WEIGHT = 0.5
"""Weight of the landmarks' likelihood: their errors are not independent."""
CHOSEN_QUANTILE = 0.65
"""Quantile of the posterior. A focal length that is too long by half costs little in views from the
side; one that is too short by half makes another person."""
INTERVAL = (0.05, 0.95)
"""Quantiles of the posterior that are reported."""
MAX_SCALE_DIFFERENCE = 0.043
"""Largest relative difference between a camera's scale and the median of all cameras. A 5 % error
of focal length is found."""
MAX_SIDE_DEG = 60.0
"""Largest angle between the direction that the head faces and a camera whose landmarks are
compared: on the path-traced head, scales of single views have a standard deviation of 0.01 up to
here, and of 0.03 beyond, with a mean of −0.02."""
MIN_CAMERAS = 4
"""Least number of cameras for which scales are compared."""
MIN_VISIBILITY = 0.1
"""Least squared cosine of the angle between a landmark's normal and a camera that may use it."""
MAX_COMPARED_TIMESTEPS = 40
"""Largest number of timesteps in which cameras are compared."""
SCALE_ITERATIONS = 8
"""Iterations in which the scale between points is solved with fewer and fewer outliers."""
OUTLIER_SCALE = 1.5
"""Distance, in medians, at which a point keeps a quarter of its weight."""
HERE = Similarity()
"""The camera's world, in meters, in which the head is fitted."""


@dataclass(frozen=True)
class FocalEstimate:
    """Focal length in pixels of a camera without calibration, the ends of the interval that holds
    it with a probability of 90 %, and the largest angle between two poses of the head."""

    pixels: float
    low: float
    high: float
    turn_deg: float


@dataclass(frozen=True)
class _View:
    """Landmarks of a timestep in the only camera, which is taken for a phone's, and their bias;
    None for those of another detector."""

    landmarks: TimestepLandmarks
    bias: LandmarkBias | None

    def at_ratio(self, ratio: float) -> TimestepLandmarks:
        """The same for a camera whose focal length is so many times as long: it is that much
        farther away."""
        (camera,) = self.landmarks.cameras
        longer = replace(camera, fl_x=camera.fl_x * ratio, fl_y=camera.fl_y * ratio)
        points = self.landmarks.points
        if self.bias is not None:
            points = points - self.bias.beyond_offset(self.bias.distance_m * ratio)
        return replace(self.landmarks, cameras=(longer,), points=points)


def estimated_focal(
    head: HeadModel, take: RecordedTake, step: Step = lambda: None
) -> FocalEstimate:
    """Focal length of the only camera of `take`, whose own is that of a phone
    (`open.typical_focal`).

    A quantile of its posterior. The likelihood is that of landmarks of the most differently turned
    timesteps, under the best fit of the head for each focal length; the prior knows the angle of
    view of cameras and the distance at which people are filmed. Where the face is never within
    MAX_OFF_AXIS_DEG, the prior decides. step: follows each of RATIOS.
    """
    from scipy.interpolate import CubicSpline

    rows = np.array(evenly_spread(np.flatnonzero(take.reliable).tolist(), LANDMARKS))
    whole = [(landmarks.confidence[:, rows] > 0).sum() for landmarks in take.landmarks.values()]
    enough = max(whole) / 2
    compared = {
        t: replace(
            landmarks,
            points=landmarks.points[:, rows],
            confidence=landmarks.confidence[:, rows],
        )
        for (t, landmarks), count in zip(take.landmarks.items(), whole, strict=True)
        if count >= enough
    }
    free_head, free_places = _with_free_places(head, take.places[rows])
    chosen = _turned(free_head, free_places, compared)
    neutral = take.places.on(head.model.v_template, head.model.faces)
    views = [_View(compared[t], _bias(take, t, neutral, rows)) for t in chosen.timesteps]
    slopes, distances = _fits(free_head, free_places, views, step)
    tried = np.log(RATIOS)
    fine = np.log(FINE_RATIOS)
    (camera,) = views[0].landmarks.cameras
    cost = _prior_cost(camera, fine, np.interp(fine, tried, np.log(distances)))
    if chosen.are_frontal:
        cost += DATA_WEIGHT * CubicSpline(tried, slopes).antiderivative()(fine)
    density = np.exp(cost.min() - cost)
    below = np.cumsum(density) / density.sum()
    quantiles = np.interp((CHOSEN_QUANTILE, *INTERVAL), below, fine)
    pixels, low, high = (camera.fl_x * np.exp(quantiles)).tolist()
    return FocalEstimate(pixels, low, high, chosen.turn_deg)


def _prior_cost(camera: Camera, ratio: np.ndarray, distance: np.ndarray) -> np.ndarray:
    """Negative logarithm of the prior (K,), but for a constant, of logarithms of the focal length
    relative to a phone's and of the head's distance in meters."""
    sides = max(camera.width, camera.height), min(camera.width, camera.height)
    aspect = sides[0] / sides[1]
    if any(abs(aspect / known - 1) < ASPECT_TOLERANCE for known in CAMERA_ASPECTS):
        phone = PHONE_WEIGHT * _normal(ratio, 0.0, PHONE_SIGMA)
        portrait = (1 - PHONE_WEIGHT) * _normal(ratio, np.log(PORTRAIT_RATIO), PORTRAIT_SIGMA)
        lens = phone + portrait
        distance_sigma = DISTANCE_SIGMA
    else:
        lens = _normal(ratio, 0.0, CROPPED_SIGMA)
        distance_sigma = CROPPED_DISTANCE_SIGMA
    return np.asarray(-np.log(lens * _normal(distance, np.log(DISTANCE_M), distance_sigma)))


def _normal(values: np.ndarray, mean: float, sigma: float) -> np.ndarray:
    """The normal density, times the root of 2π."""
    return np.asarray(np.exp(-(((values - mean) / sigma) ** 2) / 2) / sigma)


def _bias(
    take: RecordedTake, timestep: int, neutral: np.ndarray, rows: np.ndarray
) -> LandmarkBias | None:
    """Bias of a timestep's landmarks of these rows."""
    landmarks = take.landmarks[timestep]
    reliable = take.reliable & (landmarks.confidence[0] > 0)
    bias = bias_in(landmarks.points[0], landmarks.cameras[0], neutral, reliable)
    return None if bias is None else bias.of_rows(rows)


def _with_free_places(head: HeadModel, places: SurfacePoints) -> tuple[HeadModel, SurfacePoints]:
    """The head at its landmarks alone, and an identity that moves each by PLACE_SIGMA_M."""
    model = head.model
    count = len(places)
    corners = model.faces[places.face].ravel()
    own = PLACE_SIGMA_M * np.eye(3 * count).reshape(count, 1, 3, 3 * count).repeat(3, axis=1)
    template = model.v_template[corners]
    known = model.n_identity
    dirs = np.split(model.shapedirs[corners], [known], axis=2)
    small = replace(
        model,
        v_template=template,
        shapedirs=np.concatenate([dirs[0], own.reshape(3 * count, 3, 3 * count), dirs[1]], axis=2),
        n_identity=known + 3 * count,
        posedirs=model.posedirs[corners],
        j_regressor=model.j_regressor @ model.v_template @ np.linalg.pinv(template),
        weights=model.weights[corners],
        faces=np.arange(3 * count, dtype=np.int32).reshape(count, 3),
    )
    return replace(head, model=small), SurfacePoints(np.arange(count), places.barycentric)


@dataclass(frozen=True)
class _Turned:
    """Timesteps at which the head is turned most differently.

    are_frontal  whether the face is within MAX_OFF_AXIS_DEG at these; else it never is
    turn_deg     largest angle between two poses of the take
    """

    timesteps: list[int]
    are_frontal: bool
    turn_deg: float


def _turned(
    head: HeadModel, places: SurfacePoints, take: Mapping[int, TimestepLandmarks]
) -> _Turned:
    """Up to TIMESTEPS of a take's timesteps whose face is within MAX_OFF_AXIS_DEG; of all where no
    face is."""
    timesteps = evenly_spread(sorted(take), CANDIDATES)
    starts = _observed(head, places, [take[t] for t in timesteps])[1]
    turns = np.stack([head_rotation(start) for start in starts])
    eye = take[timesteps[0]].cameras[0].position
    away = eye - starts[:, -TRANSLATION_SIZE:]
    ahead = np.einsum("ti,ti->t", turns[:, :, 2], away) / np.linalg.norm(away, axis=1)
    frontal = np.flatnonzero(ahead > np.cos(np.radians(MAX_OFF_AXIS_DEG)))
    rows = frontal if len(frontal) else np.arange(len(timesteps))
    cosine = (np.einsum("aij,bij->ab", turns, turns) - 1) / 2
    apart = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    among = apart[np.ix_(rows, rows)]
    chosen = [int(among.max(axis=0).argmax())]
    while len(chosen) < min(TIMESTEPS, len(rows)):
        chosen.append(int(among[chosen].min(axis=0).argmax()))
    found = sorted({timesteps[rows[number]] for number in chosen})
    return _Turned(found, len(frontal) > 0, float(apart.max()))


def _observed(
    head: HeadModel, places: SurfacePoints, views: Sequence[TimestepLandmarks]
) -> tuple[list[Observation], np.ndarray]:
    """Landmarks in the camera's world at the head's depth, and the poses (T, 18) that place the
    head there."""
    neutral = places.on(head.model.v_template, head.model.faces)
    used = np.ones(len(places), bool)
    points = (head_fit.triangulated(view, used, neutral, 1.0) for view in views)
    found = [head_fit.observed_landmarks(point, HERE, used) for point in points]
    return found, np.stack([head_fit.rigid_start(neutral, own) for own in found])


def _fits(
    head: HeadModel, places: SurfacePoints, views: Sequence[_View], step: Step
) -> tuple[np.ndarray, np.ndarray]:
    """For each of RATIOS the derivative of the negative log-likelihood by the logarithm of the
    focal length, and the head's median distance in meters."""
    shape = np.zeros(head.model.n_identity)
    frames = np.zeros(0)
    slopes = []
    distances = []
    before = 1.0
    for ratio in RATIOS:
        trials = [view.at_ratio(ratio) for view in views]
        if len(frames):  # as large in the image as before
            frames[:, -TRANSLATION_SIZE:] *= ratio / before
        before = ratio
        for _ in range(ROUNDS if len(frames) else ROUNDS + 1):
            subject = person(head, shape)
            observed, starts = _observed(subject, places, trials)
            if not len(frames):
                frames = np.pad(starts, ((0, 0), (head.model.n_expression, 0)))
            visibility = head_fit.LandmarkVisibility(subject, places)
            factor = LANDMARK_SIGMA_M / NOISE_SIGMA_M
            weighted = []
            for view, own, values in zip(trials, observed, frames, strict=True):
                weight = own.weight * visibility.weighted(view, values, HERE).confidence[0]
                weighted.append(replace(own, root=own.root * factor, weight=weight))
            identity = solve_identity(head, places, weighted, frames, metric=True, shape=shape)
            shape = identity.shape
            frames = identity.frames
        subject = person(head, shape)
        slopes.append(_slope(subject, places, trials, weighted, frames))
        distances.append(float(np.median(-frames[:, -1])))
        step()
    return np.array(slopes), np.array(distances)


def _slope(
    subject: HeadModel,
    places: SurfacePoints,
    views: Sequence[TimestepLandmarks],
    observed: Sequence[Observation],
    frames: np.ndarray,
) -> float:
    """Derivative of the negative log-likelihood by the logarithm of the focal length at the best
    fit. There, it equals the derivative with a fixed head whose image grows about the principal
    point."""
    points = PosedPoints(subject.model, places)
    total = 0.0
    for view, own, values in zip(views, observed, frames, strict=True):
        camera = view.cameras[0]
        at = points.positions(*split(values))
        residual, _ = residuals(points, values, own)
        eye = camera.position
        grown = at - eye
        axis = camera.world_to_camera[2, :3]
        depth = grown @ axis
        across = grown - depth[:, None] * axis  # its image moves away from the axis by this
        along = np.linalg.norm(own.position - eye, axis=1) / np.linalg.norm(grown, axis=1)
        moved = np.einsum("nij,nj->ni", own.root, across * along[:, None]) / LANDMARK_SIGMA_M
        weight = own.weight / np.sqrt(1 + (residual**2).sum(1))
        total += float((weight * (residual * moved).sum(1)).sum())
    return total


def scale_warnings(fit: HeadFit, take: RecordedTake) -> tuple[str, ...]:
    """One sentence for each camera whose landmarks differ in size from the fitted head's: the sign
    of a wrong focal length. Faces seen from the side do not count."""
    visibility = head_fit.LandmarkVisibility(fit.head, take.places)
    used = take.reliable
    timesteps = sorted(fit.parameters)[:: 1 + len(fit.parameters) // MAX_COMPARED_TIMESTEPS]
    scales: dict[str, dict[int, float]] = {}
    for timestep in timesteps:
        parameters = fit.parameters[timestep]
        seen = take.landmarks[timestep]
        cameras = [fit.to_capture.camera(camera) for camera in seen.cameras]
        eyes = np.stack([camera.position for camera in cameras])
        at, squared = visibility.seen(parameters, eyes)
        for row, (name, camera) in enumerate(zip(seen.names, cameras, strict=True)):
            away = (camera.position - at[used].mean(0)) @ head_rotation(parameters)
            if away[2] < np.cos(np.radians(MAX_SIDE_DEG)) * np.linalg.norm(away):
                continue
            use = used & (seen.confidence[row] > 0) & (squared[row] > MIN_VISIBILITY)
            if use.sum() > RIGID_SIZE:
                scale = _scale(camera.project(at[use])[0], seen.points[row][use], squared[row][use])
                scales.setdefault(name, {})[timestep] = scale
    if len(scales) < MIN_CAMERAS:
        return ()
    medians = {name: float(np.median(list(own.values()))) for name, own in scales.items()}
    median = float(np.median(list(medians.values())))
    warnings = []
    for name, value in medians.items():
        difference = value / median - 1
        if abs(difference) > MAX_SCALE_DIFFERENCE:
            worst = max(scales[name], key=lambda t: abs(scales[name][t] / median - 1))
            size = "larger" if difference > 0 else "smaller"
            warnings.append(
                f"camera {name}: shows the head {abs(difference):.1%} {size} than the other "
                f"cameras do, most at timestep {worst}; check its focal length and position"
            )
    return tuple(warnings)


def _scale(source: np.ndarray, target: np.ndarray, weights: np.ndarray) -> float:
    """The scale from points (N, 2) to others, after the mean shift; outliers count little."""
    scale = 1.0
    used = weights
    for _ in range(SCALE_ITERATIONS):
        a = source - (used[:, None] * source).sum(0) / used.sum()
        b = target - (used[:, None] * target).sum(0) / used.sum()
        scale = float((used * (a * b).sum(1)).sum() / (used * (a**2).sum(1)).sum())
        distance = np.linalg.norm(b - scale * a, axis=1)
        typical = max(OUTLIER_SCALE * float(np.median(distance)), 1e-9)
        used = weights / (1 + (distance / typical) ** 2) ** 2
    return scale
