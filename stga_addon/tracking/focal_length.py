"""Focal length of a single camera, from landmarks of a head that turns: a near head changes its
shape in the image; and cameras of a rig that see the head larger or smaller than the others do."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ..capture.mesh_geometry import Similarity
from ..capture.model import evenly_spread
from ..flame.forward import RIGID_SIZE
from . import fit as head_fit
from .fit import HeadFit, RecordedTake, TimestepLandmarks
from .head_model import HeadModel
from .posed_points import PosedPoints, SurfacePoints, head_rotation, split
from .solve import LANDMARK_SIGMA_M, Observation, person, solve_identity

CANDIDATES = 64
TIMESTEPS = 12
LANDMARKS = 80
"""Timesteps of which the most differently turned are chosen, and how many; landmarks used."""
MIN_TURN_DEG = (
    20.0  # Between two timesteps; below it, what is near cannot be told from what is large
)
USUAL_SIGMA = 0.35  # Standard deviation of the inverse focal length about that of a phone, relative
NEAREST = 2.0
FARTHEST = 0.2
"""Largest and smallest inverse, relative to that of a phone: 104° and 15° over the diagonal."""
OWN_SIGMA_M = LANDMARK_SIGMA_M
NOISE_SIGMA_M = 0.0006
"""Standard deviations of what a landmark misses the head by in all timesteps alike, which says
nothing of focal lengths, and beyond that in one of them."""
SOLVES = 6
ROUNDS = 2
CONVERGED = 0.01
"""Inverse focal lengths that are tried; fits of the head for each, as its depth is that of the fit
before; and the relative change after which no more are tried."""
MAX_SCALE_DIFFERENCE = 0.043  # Of a camera from the median of all; 5 % of focal length show
MAX_SIDE_DEG = 60.0
"""Between the way the head faces and a camera, beyond which its landmarks are not compared: on the
path-traced head, scales of single views have a standard deviation of 0.01 up to here, and of 0.03
beyond, with a mean of −0.02."""
MIN_CAMERAS = 4
MIN_VISIBILITY = 0.1
"""Squared cosine of the angle between a landmark's surface and a camera that may use it."""
MAX_COMPARED_TIMESTEPS = 40
SCALE_ITERATIONS = 8
OUTLIER_SCALE = 1.5
HERE = Similarity(
    1.0, np.eye(3), np.zeros(3)
)  # The camera's own world, in meters, in which the head is fitted


def solved_focal(head: HeadModel, take: RecordedTake) -> float | None:
    """Focal length in pixels of the only camera of `take`, whose own is that of a phone
    (`open.usual_focal`).

    The maximum of its posterior, by the secant method; the inverse has a normal prior about the
    camera's own. None where the head turns too little, or where landmarks say less of it than the
    prior.
    """
    rows = np.array(evenly_spread(np.flatnonzero(take.reliable).tolist(), LANDMARKS))
    seen = {
        t: replace(own, points=own.points[:, rows], confidence=own.confidence[:, rows])
        for t, own in take.landmarks.items()
        if (own.confidence[:, rows] > 0).all()
    }
    own_head, own_places = _with_own_places(head, take.places[rows])
    timesteps = _turned(own_head, own_places, seen)
    if not timesteps:
        return None
    views = [seen[t] for t in timesteps]

    def slope(inverse: float) -> float:
        return _slope(own_head, own_places, views, inverse) + (inverse - 1) / USUAL_SIGMA**2

    tried = [1.0, 0.6]
    slopes = [slope(inverse) for inverse in tried]
    rise = (slopes[1] - slopes[0]) / (tried[1] - tried[0])
    while len(tried) < SOLVES and rise > 0:
        inverse = float(np.clip(tried[-1] - slopes[-1] / rise, FARTHEST, NEAREST))
        if abs(inverse - tried[-1]) < CONVERGED:
            break
        tried.append(inverse)
        slopes.append(slope(inverse))
        rise = (slopes[-1] - slopes[-2]) / (tried[-1] - tried[-2])
    by_landmarks = rise - 1 / USUAL_SIGMA**2
    return views[0].cameras[0].fl_x / tried[-1] if by_landmarks > 1 / USUAL_SIGMA**2 else None


def _with_own_places(head: HeadModel, places: SurfacePoints) -> tuple[HeadModel, SurfacePoints]:
    """The head at its landmarks alone, and an identity that moves each by OWN_SIGMA_M."""
    model = head.model
    count = len(places)
    corners = model.faces[places.face].ravel()
    own = OWN_SIGMA_M * np.eye(3 * count).reshape(count, 1, 3, 3 * count).repeat(3, axis=1)
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


def _turned(
    head: HeadModel, places: SurfacePoints, take: Mapping[int, TimestepLandmarks]
) -> list[int]:
    """Timesteps at which the head is turned most differently; none where it does not turn."""
    timesteps = evenly_spread(sorted(take), CANDIDATES)
    if len(timesteps) < 2:
        return []
    starts = _observed(head, places, [take[t] for t in timesteps])[1]
    turns = np.stack([head_rotation(start) for start in starts])
    cosine = (np.einsum("aij,bij->ab", turns, turns) - 1) / 2
    apart = np.arccos(np.clip(cosine, -1, 1))
    if np.degrees(apart.max()) < MIN_TURN_DEG:
        return []
    chosen = [int(number) for number in np.unravel_index(apart.argmax(), apart.shape)]
    while len(chosen) < min(TIMESTEPS, len(timesteps)):
        chosen.append(int(apart[chosen].min(axis=0).argmax()))
    return sorted({timesteps[number] for number in chosen})


def _observed(
    head: HeadModel, places: SurfacePoints, views: Sequence[TimestepLandmarks]
) -> tuple[list[Observation], np.ndarray]:
    """Landmarks in the camera's world at the head's depth, and poses (T, 18) that lead there."""
    neutral = places.on(head.model.v_template, head.model.faces)
    used = np.ones(len(places), bool)
    points = (head_fit.triangulated(view, used, neutral, 1.0) for view in views)
    found = [head_fit.observed_landmarks(own, HERE, used) for own in points]
    return found, np.stack([head_fit.rigid_start(neutral, own) for own in found])


def _slope(
    head: HeadModel, places: SurfacePoints, views: Sequence[TimestepLandmarks], inverse: float
) -> float:
    """Derivative of the negative log-likelihood by the inverse focal length; both are relative to
    the cameras' own.

    At the best fit of the head it is that with a head that stays: rays turn away from its points.
    """
    camera = views[0].cameras[0]
    trial = replace(camera, fl_x=camera.fl_x / inverse, fl_y=camera.fl_y / inverse)
    views = [replace(view, cameras=(trial,)) for view in views]
    subject = person(head, np.zeros(head.model.n_identity))
    frames = np.zeros(0)
    observed: list[Observation] = []
    for _ in range(ROUNDS):
        seen, starts = _observed(subject, places, views)
        frames = frames if len(frames) else np.pad(starts, ((0, 0), (head.model.n_expression, 0)))
        visibility = head_fit.LandmarkVisibility(subject, places)
        observed = []
        factor = LANDMARK_SIGMA_M / NOISE_SIGMA_M
        for view, own, values in zip(views, seen, frames, strict=True):
            weight = own.weight * visibility.weighted(view, values, HERE).confidence[0]
            observed.append(replace(own, root=own.root * factor, weight=weight))
        identity = solve_identity(head, places, observed, starts, metric=True)
        subject = person(head, identity.shape)
        frames = identity.frames
    points = PosedPoints(subject.model, places)
    total = 0.0
    rotation = camera.world_to_camera[:3, :3]
    for view, own, values in zip(views, observed, frames, strict=True):
        at = points.positions(*split(values))
        residual = np.einsum("nij,nj->ni", own.root, at - own.position) / LANDMARK_SIGMA_M
        _, depth = camera.project(at)
        flat = (view.points[0] - [camera.cx, camera.cy]) / [camera.fl_x, camera.fl_y]
        flat = flat * depth[:, None]
        away = np.einsum("nij,nj->ni", own.root, flat @ rotation[:2]) / LANDMARK_SIGMA_M
        weight = own.weight / np.sqrt(1 + (residual**2).sum(1))
        total -= float((weight * (residual * away).sum(1)).sum())
    return total


def scale_warnings(fit: HeadFit, take: RecordedTake) -> tuple[str, ...]:
    """One sentence for each camera whose landmarks are of another size than the fitted head is
    there: the sign of a wrong focal length. Faces seen from the side do not count."""
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
    usual = float(np.median(list(medians.values())))
    warnings = []
    for name, value in medians.items():
        difference = value / usual - 1
        if abs(difference) > MAX_SCALE_DIFFERENCE:
            worst = max(scales[name], key=lambda t: abs(scales[name][t] / usual - 1))
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
        usual = max(OUTLIER_SCALE * float(np.median(distance)), 1e-9)
        used = weights / (1 + (distance / usual) ** 2) ** 2
    return scale
