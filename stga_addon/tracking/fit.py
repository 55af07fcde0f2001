"""From landmarks of all cameras and timesteps to a head in meters: scale, identity, expression and
pose."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..capture.camera import Camera
from ..capture.mesh_geometry import Similarity, similarity, vertex_normals
from ..capture.model import evenly_spread
from ..flame.forward import POSE_SIZE, RIGID_SIZE, flame_forward, frame_of, moved_pose
from ..flame.quaternions import unit
from ..worker.helpers import Step
from .head_model import HeadModel
from .posed_points import PosedPoints, SurfacePoints, head_rotation, split
from .solve import (
    ROUGH_TAKE_ITERATIONS,
    TAKE_ITERATIONS,
    Observation,
    in_order,
    person,
    solve_identity,
    solve_take,
)

Pictures = Sequence[tuple[Camera, np.ndarray]]
"""Cameras and their images (H, W, 3) or masks (H, W), uint8."""
Images = Callable[..., Pictures]
"""Pictures of a timestep, with cameras in the footage's world; a second argument: at most so many,
spread over the rig."""

ITERATIONS = 15
"""Reweighted least squares fits of a landmark's position."""
OUTLIER_SCALE = 1.5
"""Distance from a ray, in the landmark's medians, at which its weight is a quarter."""
MIN_DISTANCE_FRACTION = 1e-5
"""Least scale of outliers as a fraction of the distance to the cameras; below is rounding."""
RANK_GUARD = 1e-9
"""Weight of the first guess: a single ray leaves the position along it open."""
IDENTITY_TIMESTEPS = 12
"""Timesteps, spread over the take, that identity is solved from."""
ROUNDS = 3
"""Alternations between the solution of identity and of the take."""
MAX_HEAD_SCALE = 1.25
"""Size of a head, or its inverse, relative to the average one, beyond which the cameras' world is
not in meters."""
MIN_VISIBILITY = 1e-3
"""Weight of a landmark that a camera cannot see; what no camera sees is still better guessed than
left open."""
RESIDUAL_SCALE_M = 0.004
"""Landmarks whose rays miss each other by much more are not used."""
MAX_RESIDUALS = 25.0
"""Residual in RESIDUAL_SCALE_M beyond which a landmark's weight no longer falls: it would vanish
below the smallest number."""
MIN_LANDMARKS = 4  # Least number of landmarks that determine a pose
MIN_FACE_M = 0.01  # Extent of the landmarks on the head below which they are one point
POSIT_ITERATIONS = 20


@dataclass(frozen=True)
class Triangulation:
    """N landmarks of one timestep from its cameras, in the units of the cameras' world.

    position     (N, 3) the best point; for a single ray, one on that ray; without a ray, the center
                 of the cameras
    information  (N, 3, 3) weighted mean over the rays of I − d dᵀ: (x − position)ᵀ information (x −
                 position) is the mean squared distance of x from the rays, up to a constant
    residual     (N,) median distance of the rays from `position`, 0 where there is none
    observed     (N,) bool: by two cameras at least, or by the only one
    eye          (3,) position of the only camera; None of several
    """

    position: np.ndarray
    information: np.ndarray
    residual: np.ndarray
    observed: np.ndarray
    eye: np.ndarray | None = None


def rays(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origin (3,) and unit directions (N, 3) in the world of pixels (N, 2)."""
    local = np.column_stack([camera.at_depth_one(points), np.ones(len(points))])
    return camera.position, unit(local @ camera.rotation)


def triangulate(
    cameras: Sequence[Camera], points: np.ndarray, confidence: np.ndarray
) -> Triangulation:
    """Landmarks (C, N, 2) pixels with confidence (C, N) ≥ 0, 0 for not seen, of C cameras at one
    timestep.

    Iteratively reweighted least squares with Geman-McClure weights; scale per landmark is its
    median residual.
    """
    pairs = [rays(camera, pixels) for camera, pixels in zip(cameras, points, strict=True)]
    origins, directions = map(np.stack, zip(*pairs, strict=True))
    across = np.eye(3) - directions[..., :, None] * directions[..., None, :]  # (C, N, 3, 3)
    offsets = np.einsum("cnij,cj->cni", across, origins)
    guess = origins.mean(0) + (directions * confidence[..., None]).sum(0)
    weights = confidence.astype(np.float64)
    position = guess
    distance = np.zeros(confidence.shape)
    for _ in range(ITERATIONS):
        total = weights.sum(0)
        fraction = weights / np.where(total > 0, total, 1.0)
        information = np.einsum("cn,cnij->nij", fraction, across)
        right = np.einsum("cn,cni->ni", fraction, offsets)
        guard = RANK_GUARD * np.eye(3)  # a single ray leaves the position along it open
        position = np.linalg.solve(information + guard, (right + guess @ guard)[..., None])[..., 0]
        to_point = position[None] - origins[:, None]
        distance = np.linalg.norm(np.cross(to_point, directions), axis=2)
        scale = OUTLIER_SCALE * _median(distance, confidence > 0)
        floor = MIN_DISTANCE_FRACTION * np.linalg.norm(to_point, axis=2)
        # a point without a ray may lie in a camera, at distance 0 from its ray
        typical = np.maximum(np.maximum(scale, floor), np.finfo(np.float64).tiny)
        weights = confidence / (1 + (distance / typical) ** 2) ** 2
    observed = (confidence > 0).sum(0) >= min(2, len(cameras))
    return Triangulation(position, information, _median(distance, confidence > 0), observed)


def _median(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Lower median (N,) of the valid ones of values (C, N); 0 where none is."""
    ordered = np.sort(np.where(valid, values, np.inf), axis=0)
    middle = np.maximum(valid.sum(0) - 1, 0) // 2
    return np.where(valid.any(0), np.take_along_axis(ordered, middle[None], axis=0)[0], 0.0)


@dataclass(frozen=True)
class TimestepLandmarks:
    """Landmarks of one timestep from the cameras that found a face: points (C, N, 2) pixels and
    confidence (C, N); the cameras' names, where these are asked for."""

    cameras: tuple[Camera, ...]
    points: np.ndarray
    confidence: np.ndarray
    names: tuple[str, ...] = ()


def no_pictures(*_: int | None) -> Pictures:
    """The masks of footage without any."""
    return ()


@dataclass(frozen=True)
class RecordedTake:
    """A recording: places of landmarks on the head, which of them are reliable, landmarks by
    timestep, images, masks, and whether the world of the cameras is in meters."""

    places: SurfacePoints
    reliable: np.ndarray
    landmarks: Mapping[int, TimestepLandmarks]
    images: Images = no_pictures
    masks: Images = no_pictures
    metric: bool = False


def without_cameras(take: RecordedTake, names: Collection[str]) -> RecordedTake:
    """The take without the landmarks of cameras that do not see everything the others see."""
    landmarks = {}
    for timestep, at_timestep in take.landmarks.items():
        kept = [row for row, name in enumerate(at_timestep.names) if name not in names]
        landmarks[timestep] = TimestepLandmarks(
            tuple(at_timestep.cameras[row] for row in kept),
            at_timestep.points[kept],
            at_timestep.confidence[kept],
            tuple(at_timestep.names[row] for row in kept),
        )
    return replace(take, landmarks=landmarks)


@dataclass(frozen=True)
class HeadFit:
    """A head tracked through a take.

    head        the person: identity and static offset in the template
    shape       (I,) its coefficients
    parameters  timestep -> (E + 18,) expression, pose of five joints, translation
    to_capture  from the world of the cameras
    static_offset  (V, 3) meters, part of the template beside the identity; None: none
    ordered     whether timesteps follow each other in time (`in_order`)
    """

    head: HeadModel
    shape: np.ndarray
    parameters: Mapping[int, np.ndarray]
    to_capture: Similarity
    static_offset: np.ndarray | None = None
    ordered: bool = True


def posed_mesh(
    fit: HeadFit, parameters: np.ndarray, offset: np.ndarray | None = None
) -> np.ndarray:
    """Vertices (V, 3) in the capture's world, in meters; offset (V, 3): of this timestep."""
    return flame_forward(fit.head.model, np.zeros(0), frame_of(parameters, offset))


def excerpt(
    fit: HeadFit, take: RecordedTake, timesteps: Sequence[int]
) -> tuple[HeadFit, RecordedTake]:
    """The fit and the take at some timesteps."""
    excerpted = replace(fit, parameters={t: fit.parameters[t] for t in timesteps})
    return excerpted, replace(take, landmarks={t: take.landmarks[t] for t in timesteps})


def in_cameras_world(fit: HeadFit) -> HeadFit:
    """The same fit with the cameras at their recorded positions: only the scale of their world
    changes, about its origin."""
    model = fit.head.model
    world = fit.to_capture
    moved = {}
    for timestep, parameters in fit.parameters.items():
        expression, rigid = split(parameters.copy())
        root = model.j_regressor[0] @ (model.v_template + model.shapedirs @ expression)
        turn = world.rotation.T
        rigid[:3], rigid[POSE_SIZE:] = moved_pose(
            rigid[:3], rigid[POSE_SIZE:], root, turn, -turn @ world.translation
        )
        moved[timestep] = np.concatenate([expression, rigid])
    return replace(fit, parameters=moved, to_capture=Similarity(world.scale))


def scaled_down(world: Similarity, factor: float) -> Similarity:
    """The similarity to a world that is so many times smaller."""
    return replace(world, scale=world.scale / factor, translation=world.translation / factor)


def determines_pose(
    landmarks: TimestepLandmarks, reliable: np.ndarray, neutral: np.ndarray
) -> bool:
    """Whether `fit_head` can use the timestep: enough reliable landmarks are seen by two cameras,
    or by the only one.

    neutral (N, 3) meters: the landmarks' places on the neutral head.
    """
    observed = (landmarks.confidence > 0).sum(0) >= min(2, len(landmarks.cameras))
    use = observed & reliable
    return use.sum() >= MIN_LANDMARKS and bool(np.ptp(neutral[use], axis=0).max() >= MIN_FACE_M)


def fit_head(head: HeadModel, recorded: RecordedTake, step: Step = lambda: None) -> HeadFit:
    """Fit the model to the landmarks of a take's timesteps, each of which `determines_pose`.

    Rounds of triangulation, identity and scale from timesteps spread over the take, then all
    timesteps; from the second round on, a camera's landmarks count by the angle at which it sees
    the surface. Where the world of the cameras is metric, the size of the head is the person's.
    step: follows each of ROUNDS.
    """
    places = recorded.places
    reliable = recorded.reliable
    take = recorded.landmarks
    timesteps = sorted(take)
    several = [t for t in timesteps if len(take[t].cameras) > 1]
    spread = evenly_spread(several or timesteps, IDENTITY_TIMESTEPS)
    aligned = _alignments(head, recorded, spread, recorded.metric)
    size = float(np.median([one.scale for one in aligned]))
    u, _, vt = np.linalg.svd(np.sum([one.rotation for one in aligned], axis=0))
    centers = [-one.rotation.T @ one.translation / one.scale for one in aligned]
    world = Similarity(size, u @ vt, -size * u @ vt @ np.median(centers, axis=0))
    weighted = dict(take)
    subject = head
    shape = np.zeros(head.model.n_identity)
    solved = np.zeros((len(timesteps), head.model.n_expression + RIGID_SIZE))
    ordered = True
    parameters: dict[int, np.ndarray] = {}
    for number in range(ROUNDS):
        iterations = ROUGH_TAKE_ITERATIONS if number < ROUNDS - 1 else TAKE_ITERATIONS
        at = places.on(subject.model.v_template, subject.model.faces)
        found = {t: triangulated(weighted[t], reliable, at, world.scale) for t in timesteps}
        observed = [observed_landmarks(found[t], world, reliable) for t in spread]
        starts = np.stack([rigid_start(at, observation) for observation in observed])
        # Of one camera's rays, a head shrunk into the camera itself misses all by the least.
        sized = recorded.metric or not several
        if not several:  # timesteps count as one: a detector misses a face alike in all of them
            count = len(observed)
            observed = [
                replace(observation, weight=observation.weight / count) for observation in observed
            ]
        identity = solve_identity(head, places, observed, starts, sized)
        world = scaled_down(world, identity.scale)
        shape = identity.shape
        subject = person(head, identity.shape)
        at = places.on(subject.model.v_template, subject.model.faces)
        take_observed = [observed_landmarks(found[t], world, reliable) for t in timesteps]
        if not number:
            solved[:, -RIGID_SIZE:] = [
                rigid_start(at, observation) for observation in take_observed
            ]
            alone = solve_take(
                subject, places, take_observed, solved, ordered=False, iterations=iterations
            )
            ordered = in_order(subject, places, take_observed, alone)
        solved = solve_take(subject, places, take_observed, solved, ordered, iterations)
        visibility = LandmarkVisibility(subject, places)
        parameters = dict(zip(timesteps, solved, strict=True))
        weighted = {
            t: visibility.weighted(take[t], values, world) for t, values in parameters.items()
        }
        step()
    return HeadFit(subject, shape, parameters, world, ordered=ordered)


def is_metric(head: HeadModel, take: RecordedTake) -> bool:
    """Whether the face has a person's size in meters in the cameras' world; True for one camera,
    which cannot show size."""
    several = [t for t in sorted(take.landmarks) if len(take.landmarks[t].cameras) > 1]
    spread = evenly_spread(several, IDENTITY_TIMESTEPS)
    scales = [one.scale for one in _alignments(head, take, spread, metric=False)]
    return not scales or 1 / MAX_HEAD_SCALE <= float(np.median(scales)) <= MAX_HEAD_SCALE


def pose_from_one_camera(camera: Camera, pixels: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (N, 3) of a rigid object in the camera's world, from where they are seen: pixels (N,
    2).

    POSIT (DeMenthon and Davis 1995): scaled orthographic pose, corrected for perspective until it
    no longer changes.
    """
    directions = camera.at_depth_one(pixels)
    center = points.mean(0)
    system = np.column_stack([points - center, np.ones(len(points))])
    solve = np.linalg.pinv(system, len(system) * np.finfo(np.float64).eps)
    stretch = np.ones(len(points))
    rotation = np.eye(3)
    place = np.zeros(3)
    for _ in range(POSIT_ITERATIONS):
        rows = (solve @ (directions * stretch[:, None])).T  # (2, 4)
        size = float(np.sqrt(np.linalg.norm(rows[0, :3]) * np.linalg.norm(rows[1, :3])))
        u, _, vt = np.linalg.svd(rows[:, :3] / size, full_matrices=False)
        across = u @ vt
        rotation = np.stack([*across, np.cross(*across)])
        place = np.array([*rows[:, 3], 1.0]) / size
        stretch = 1 + (points - center) @ rotation[2] / place[2]
    local = (points - center) @ rotation.T + place
    return (local - camera.translation) @ camera.rotation


def triangulated(
    landmarks: TimestepLandmarks, reliable: np.ndarray, head: np.ndarray, scale: float
) -> Triangulation:
    """The landmarks in the cameras' world. For a single camera, `head` (N, 3) meters and `scale`
    give their distance."""
    if len(landmarks.cameras) > 1:
        return triangulate(landmarks.cameras, landmarks.points, landmarks.confidence * reliable)
    camera = landmarks.cameras[0]
    pixels = landmarks.points[0]
    observed = landmarks.confidence[0] * reliable > 0
    origin, directions = rays(camera, pixels)
    guess = np.tile(origin, (len(head), 1))
    guess[observed] = pose_from_one_camera(camera, pixels[observed], head[observed] / scale)
    depth = ((guess - origin) * directions).sum(1, keepdims=True)
    across = observed[:, None, None] * (np.eye(3) - directions[:, :, None] * directions[:, None])
    return Triangulation(origin + depth * directions, across, np.zeros(len(head)), observed, origin)


def observed_landmarks(
    found: Triangulation, world: Similarity, reliable: np.ndarray
) -> Observation:
    """The triangulation in the capture's world."""
    values, vectors = np.linalg.eigh(world.rotation @ found.information @ world.rotation.T)
    root = (vectors * np.sqrt(np.maximum(values, 0))[:, None, :]) @ vectors.swapaxes(1, 2)
    residuals = np.minimum(found.residual * world.scale / RESIDUAL_SCALE_M, MAX_RESIDUALS)
    weight = np.where(found.observed & reliable, np.exp(-(residuals**2)), 0.0)
    eye = None if found.eye is None else world.apply(found.eye)
    return Observation(world.apply(found.position), root, weight, eye)


def landmarks_in_capture(
    landmarks: TimestepLandmarks, take: RecordedTake, fit: HeadFit
) -> Observation:
    """The landmarks of a timestep of the take, triangulated in the world of the fit."""
    at = take.places.on(fit.head.model.v_template, fit.head.model.faces)
    found = triangulated(landmarks, take.reliable, at, fit.to_capture.scale)
    return observed_landmarks(found, fit.to_capture, take.reliable)


def _alignments(
    head: HeadModel, take: RecordedTake, timesteps: Sequence[int], metric: bool
) -> list[Similarity]:
    """Similarities from each timestep's landmarks to the neutral head. Without several cameras, the
    head's size gives their scale."""
    neutral = take.places.on(head.model.v_template, head.model.faces)
    found = [triangulated(take.landmarks[t], take.reliable, neutral, 1.0) for t in timesteps]
    used = [one.observed & take.reliable for one in found]
    pairs = zip(found, used, strict=True)
    return [similarity(one.position[use], neutral[use], metric) for one, use in pairs]


def rigid_start(neutral: np.ndarray, observed: Observation) -> np.ndarray:
    """(18,) pose that brings a neutral head's landmarks (N, 3) onto the observed ones."""
    from scipy.spatial.transform import Rotation

    use = observed.weight > np.exp(-(MAX_RESIDUALS**2))
    # no cameras agree: all of them, and the fit will show by how much they do not
    if use.sum() < MIN_LANDMARKS:
        use = observed.weight > 0
    moved = similarity(neutral[use], observed.position[use], metric=True)
    turn = Rotation.from_matrix(moved.rotation).as_rotvec()
    return np.concatenate([turn, np.zeros(POSE_SIZE - 3), moved.translation])


class LandmarkVisibility:
    """How squarely cameras see the surface of a person's head at the places of its landmarks."""

    def __init__(self, subject: HeadModel, places: SurfacePoints) -> None:
        model = subject.model
        self._points = PosedPoints(model, places)
        self._normals = places.on(vertex_normals(model.v_template, model.faces), model.faces)

    def weighted(
        self, landmarks: TimestepLandmarks, parameters: np.ndarray, world: Similarity
    ) -> TimestepLandmarks:
        """Confidence falls with the angle at which a camera sees the surface, to MIN_VISIBILITY
        where it faces away."""
        eyes = np.stack([world.apply(camera.position) for camera in landmarks.cameras])
        _, squared = self.seen(parameters, eyes)
        return replace(landmarks, confidence=landmarks.confidence * (squared + MIN_VISIBILITY))

    def seen(self, parameters: np.ndarray, eyes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions (N, 3) of the landmarks, and squared cosines (C, N) of the angles between their
        normals and cameras at `eyes` (C, 3), in the head's world; 0 where the surface faces
        away."""
        at = self._points.positions(*split(parameters))
        normals = self._normals @ head_rotation(parameters).T
        towards = eyes[:, None] - at
        length = np.linalg.norm(towards, axis=2) * np.maximum(np.linalg.norm(normals, axis=1), 1e-9)
        return at, np.clip((normals * towards).sum(2) / length, 0, 1) ** 2
