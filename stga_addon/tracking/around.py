"""Takes that one camera filmed around a still head: how they are recognized, and their footage with
the cameras that structure from motion finds."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from time import monotonic

import numpy as np

from ..capture.camera import Camera
from ..capture.lens import Lens, undistortion
from ..capture.mesh_geometry import weighted_procrustes
from ..capture.model import evenly_spread
from ..errors import StgaError, listed
from ..flame.parts import flame_model
from ..worker.helpers import Step
from ..worker.machine import processors
from . import folder
from .face_networks import FaceNetworks, PersonNetwork
from .fit import pose_from_one_camera
from .footage.model import Footage, FootageCamera, ImageFrames
from .footage.open import typical_focal
from .footage.video import VideoFrames
from .landmarks import read_places
from .opened import check_place, file_state
from .recorded import BUNDLED_PLACES
from .sharp_frames import choose_frames, reduced_to
from .stages import Stage, Workers
from .structure_from_motion import SearchOptions, Structure, find_structure

MAX_PHOTOS = 60
"""Images up to which all are used; of more, the sharpest ones of FRAMES stretches."""
FRAMES = 40
"""Frames of a video that get a camera: some 5° apart in half a circle."""
MIN_IMAGES = 8
"""Images with a camera, below which the take is not one of many cameras."""
MIN_IMAGES_FRACTION = 0.5
"""Least fraction of the chosen images that get a camera."""
MIN_ON_HEAD = 30
"""Points on the face, below which it was the room alone whose structure was found."""
TIME_LIMIT_S = 900.0
"""Longest time of structure from motion."""
MAX_THREADS = 8
"""Largest number of threads of COLMAP: each takes up to 300 MB."""
REMEDY = (
    "film in even light and without blur, in steps of at most 15° around a head that keeps still, "
    "in a room with detail"
)
"""Advice at the end of errors in structure from motion."""

# Recognition
SAMPLES = 8
"""Number of frames in which the head's pose is looked at."""
MORE_SAMPLES = 24
"""Number of such frames where half of SAMPLES show no face."""
SAMPLE_SIDE_PX = 720
"""Longer side of these frames."""
MIN_TURN_DEG = 30.0
"""Largest angle between two poses of the head relative to the camera, below which nobody walked
around it."""
MAX_AXIS_COSINE = -0.1
"""Largest cosine between the head's axes up and ahead and the camera's axes down and ahead, of a
face that is visible."""
PAIR_S = 0.5
"""Time between the two frames of a video in which the room is compared."""
TYPICAL_FPS = 30.0
"""Frames per second for a take without a rate."""
MAX_HALVINGS = 3
"""How often PAIR_S is halved if the head turns too far relative to the camera in that time."""
PAIR_TURN_DEG = 1.0, 25.0
"""Turns of the head between two frames that are compared."""
MIN_MATCHES = 8
"""Least number of the room's points in both frames that shows whether the room moves."""
MIN_PAIRS = 3
"""Least number of pairs of frames that show it."""
MIN_CONTRAST = 0.01
"""Contrast of a room's features, a quarter of OpenCV's: a papered wall has little."""
MATCH_RATIO = 0.75
"""Lowe's ratio test."""
MAX_LIP_CHANGE = 0.08
"""Largest `Recognition.lip_change` of a still face in photos without a room: three still people,
seen from 85° around, have .004, .016 and .022, a talking one .21."""
INNER_LIPS = 13, 14
"""Landmarks of the middle of the upper and the lower lip, where they meet."""
EYE_CORNERS = 33, 263
"""Landmarks of the outer corners of the eyes."""
FACE_MARGIN = 0.6
"""Margin around the face that does not belong to the room, in sizes of the face."""
PERSON_PROBABILITY = 0.3
"""Probability of a person above which a pixel does not belong to the room."""
MIN_PARALLAX = 0.2
"""Radians that the room moves behind the head for each radian by which the head turns relative to
the camera; 0 of a camera that stands still, 1 − (distance of the head / distance of the room) of
one that goes around."""
MIN_CORRELATION = 0.6
"""Correlation of the room's motion with the head's turns below which a hand shook the camera."""


class CamerasNotFound(StgaError):
    """Structure from motion gives no cameras; the message names the reason and what helps."""


@dataclass(frozen=True)
class Recognition:
    """What frames of a single camera show about the take.

    turn_deg     largest angle between two poses of the head relative to the camera
    parallax     as MIN_PARALLAX; NaN where too little of a room is seen
    correlation  of the room's motion with the head's turns
    lip_change   by how much the gap between the lips differs, in distances of eyes and mouth
    """

    turn_deg: float
    parallax: float
    correlation: float
    lip_change: float

    @property
    def turns(self) -> bool:
        """Whether the camera saw the head from sides."""
        return self.turn_deg >= MIN_TURN_DEG

    @property
    def is_around(self) -> bool:
        """Whether the room turned with the head."""
        moves = self.parallax >= MIN_PARALLAX and self.correlation >= MIN_CORRELATION
        return self.turns and moves


def with_found_cameras(
    footage: Footage,
    out: Path,
    take: str,
    workers: Workers,
    known: tuple[str, str] | None = None,
) -> tuple[Footage, tuple[str, ...]]:
    """The footage of a single camera without a calibration and, if it was filmed around a still
    head, with a camera for each image; and sentences about that.

    out: folder of the capture, in which what an interruption leaves is kept. take: "auto",
    "around" or "talk". known: what `take_of` found. Raises StgaError for a folder that is no place
    for a capture, and CamerasNotFound for a take that is said to be one around a head.
    """
    if take == "talk":
        return footage, ()
    check_place(footage, out)
    (camera,) = footage.cameras
    count = len(camera.timesteps)
    if take == "around":
        if count < MIN_IMAGES:
            raise CamerasNotFound(
                f"{footage.root}: --take around: has {count} images, expected at least {MIN_IMAGES}"
            )
        found, line = _with_cameras(footage, out, workers)
        return found, (f"take: around a still head, as given; {line}",)
    kind, why = known or take_of(footage, workers)
    if kind == "talk":
        return footage, (
            f"take: a head that moves in front of a camera ({why}; else give --take around)",
        )
    try:
        found, line = _with_cameras(footage, out, workers)
    except StgaError as error:
        warning = (
            f"take: looks like one around a still head, but {error}. It is tracked as one of a "
            "head that turns in front of a camera"
        )
        return replace(footage, warnings=(*footage.warnings, warning)), ()
    return found, (f"take: around a still head ({why}; else give --take talk); {line}",)


def take_of(footage: Footage, workers: Workers) -> tuple[str, str]:
    """The kind of take, "around" a still head or else "talk"; and the reason, in a clause."""
    if footage.focal == "calibration":
        several = len(footage.cameras) >= MIN_IMAGES
        return "around" if several else "talk", f"{len(footage.cameras)} calibrated cameras"
    (camera,) = footage.cameras
    count = len(camera.timesteps)
    if count < MIN_IMAGES:
        return "talk", f"{count} images"
    motion = _recognized(footage, camera, workers)
    photos = isinstance(camera.frames, ImageFrames) and count <= MAX_PHOTOS
    is_plain = photos and motion.turns and bool(np.isnan(motion.parallax))
    plain_photos = is_plain and motion.lip_change <= MAX_LIP_CHANGE
    why = f"the camera sees it from directions {motion.turn_deg:.0f}° apart"
    if plain_photos:
        return "around", why
    if motion.is_around:
        return "around", f"{why}, and the room moves with it"
    if is_plain:
        return "talk", f"{why}, but the mouth moves"
    return "talk", why + (", but the room does not move with it" if motion.turns else "")


def _with_cameras(footage: Footage, out: Path, workers: Workers) -> tuple[Footage, str]:
    """The footage with a camera for each image, and a line on these. Raises CamerasNotFound."""
    (camera,) = footage.cameras
    if find_spec("pycolmap") is None:
        raise CamerasNotFound(
            f"{footage.root}: finding cameras needs the package pycolmap, which this Python lacks; "
            "install it, or give --cameras"
        )
    timesteps = _chosen(camera, workers)
    given = footage.focal != "usual"
    focal = camera.camera.fl_x if given else None
    threads = min(processors(), MAX_THREADS)
    in_order = isinstance(camera.frames, VideoFrames) or len(camera.timesteps) > MAX_PHOTOS
    keeps_focal = footage.focal == "given"
    options = SearchOptions(focal, keeps_focal, in_order, threads, MIN_IMAGES, MIN_ON_HEAD)
    scratch = out / folder.KEPT_FOLDER / f"structure-{file_state(camera.frames.files)}"
    part = (camera, timesteps, options, scratch)
    stages = [(stage, len(timesteps)) for stage in _SEARCH_STAGES]
    report = _Stages(workers, stages, footage)
    found = workers.helpers.run(find_structure, part, report, keep=True, apart=True)
    structure = Structure.of_arrays(found)
    _require_cameras(footage, structure, len(timesteps))
    cameras = _cameras(camera, structure)
    count = f"{len(cameras)} of {len(timesteps)} images"
    fraction = structure.on_head / structure.points
    lens = f"focal length {structure.focal_px:.0f} px"
    lens += f", distortion {structure.distortion:.3f}" if structure.distortion else ""
    line = (
        f"cameras of {count} found, {lens}, {structure.error_px:.2f} px; {fraction:.0%} of "
        f"{structure.points} points are on the face"
    )
    line += "; the room was left out, as it did not turn with the person" * structure.masked
    found_timesteps = set(structure.timesteps.tolist())
    lost = [camera.source(t) for t in timesteps if t not in found_timesteps]
    lost_text = (f"no camera was found of {listed(lost)}; left out",) if lost else ()
    warnings = (*footage.warnings, *lost_text)
    known = replace(footage, cameras=cameras, fps=None, focal="calibration", warnings=warnings)
    return replace(known, finds_cameras=True), line


_SEARCH_STAGES = (Stage.FEATURES, Stage.MATCHES, Stage.CAMERAS)


class _Stages:
    """Reports the steps of work that has several stages, as (stage, steps), one after another.
    Raises CamerasNotFound beyond TIME_LIMIT_S."""

    def __init__(
        self, workers: Workers, stages: Sequence[tuple[Stage, int]], footage: Footage
    ) -> None:
        self._workers = workers
        self._stages = stages
        self._root = footage.root
        self._end = monotonic() + TIME_LIMIT_S

    def __call__(self, steps: int) -> None:
        if monotonic() > self._end:
            raise CamerasNotFound(
                f"{self._root}: structure from motion has taken {TIME_LIMIT_S / 60:.0f} minutes; "
                "use fewer or smaller images"
            )
        for stage, total in self._stages[:-1]:
            if steps < total:
                self._workers.report(stage, steps, total)
                return
            steps -= total
        stage, total = self._stages[-1]
        self._workers.report(stage, min(steps, total), total)


def _chosen(camera: FootageCamera, workers: Workers) -> list[int]:
    """Timesteps whose images get a camera."""
    timesteps = list(camera.timesteps)
    limit = MAX_PHOTOS if isinstance(camera.frames, ImageFrames) else FRAMES
    if len(timesteps) <= limit:
        return timesteps
    total = len(timesteps)
    found = workers.helpers.run(
        choose_frames,
        (camera, timesteps, FRAMES),
        lambda steps: workers.report(Stage.FRAMES, steps, total),
    )
    chosen: list[int] = found["timesteps"].tolist()
    return chosen


def _require_cameras(footage: Footage, structure: Structure, count: int) -> None:
    """Raise CamerasNotFound where there are too few cameras, or where they show the room alone."""
    found = len(structure.timesteps)
    least = max(MIN_IMAGES, round(MIN_IMAGES_FRACTION * count))
    if found < least:
        raise CamerasNotFound(
            f"{footage.root}: structure from motion places {found} of {count} images, expected at "
            f"least {least}; {REMEDY}"
        )
    if structure.on_head < MIN_ON_HEAD:
        raise CamerasNotFound(
            f"{footage.root}: structure from motion finds {structure.points} points, but "
            f"{structure.on_head} on the face, expected at least {MIN_ON_HEAD}: the head moved, or "
            f"it is blurred; {REMEDY}"
        )


def _cameras(camera: FootageCamera, structure: Structure) -> tuple[FootageCamera, ...]:
    """A camera for each image that has a pose, all at one timestep."""
    width = camera.camera.width
    height = camera.camera.height
    lens = Lens(radial=(structure.distortion,)) if structure.distortion else Lens()
    digits = len(str(max(camera.timesteps)))
    cameras = []
    stems = set[str]()
    for timestep, pose in zip(structure.timesteps.tolist(), structure.poses, strict=True):
        focal = structure.focal_px
        world_to_camera = np.vstack([pose, [0.0, 0.0, 0.0, 1.0]])
        recorded = Camera(width, height, focal, focal, width / 2, height / 2, world_to_camera)
        frames = camera.frames
        if isinstance(frames, VideoFrames):
            masks = frames.masks and {0: frames.masks[timestep]}
            frames = VideoFrames(frames.video, {0: frames.numbers[timestep]}, masks)
            name = f"{timestep:0{digits}d}"
        else:
            view = frames.views[timestep]
            frames = ImageFrames({0: replace(view, timestep=0, camera=recorded)})
            name = view.image.name if view.image.stem in stems else view.image.stem
            stems.add(view.image.stem)
        resampled = undistortion(recorded, lens, camera.source(timestep))
        ideal = recorded if resampled is None else resampled.camera
        cameras.append(FootageCamera(name, ideal, frames, resampled))
    return tuple(cameras)


# Recognition


def _recognized(footage: Footage, camera: FootageCamera, workers: Workers) -> Recognition:
    """`Recognition` from some of the frames."""

    def report(steps: int) -> None:
        total = SAMPLES if steps <= SAMPLES else SAMPLES + MORE_SAMPLES
        workers.report(Stage.OPENING, steps, total)

    found = workers.helpers.run(recognize, (camera, footage.fps), report)
    return Recognition(*found["recognition"].tolist())


def recognize(camera: FootageCamera, fps: float | None, step: Step) -> dict[str, np.ndarray]:
    """`Recognition` of a take as (4,)."""
    timesteps = list(camera.timesteps)
    look = _Look(camera)
    looks: dict[int, _Sample | None] = {}
    samples: dict[int, _Sample] = {}
    for count in (SAMPLES, MORE_SAMPLES):  # a camera that goes all around sees few faces
        for number in evenly_spread(range(len(timesteps)), count):
            if number not in looks:
                looks[number] = look.at(timesteps[number])
            step()
        samples = {number: found for number, found in sorted(looks.items()) if found is not None}
        if len(samples) > SAMPLES / 2:
            break
    turn = max(
        (_angle_deg(a.rotation, b.rotation) for a in samples.values() for b in samples.values()),
        default=0.0,
    )
    pairs = []
    if turn >= MIN_TURN_DEG:
        photos = isinstance(camera.frames, ImageFrames) and len(timesteps) <= MAX_PHOTOS
        ahead = 1 if photos else max(1, round(PAIR_S * (fps or TYPICAL_FPS)))
        for number, sample in samples.items():
            later = look.later_sample(sample, timesteps[number + 1 : number + 1 + ahead])
            pairs += [(sample, later)] if later is not None else []
        if photos:  # whose names may have no order
            row = {id(sample): sample for pair in pairs for sample in pair}
            row |= {id(sample): sample for sample in samples.values()}
            pairs += pairwise(sorted(row.values(), key=lambda sample: sample.yaw))
    parallax, correlation = _parallax(pairs)
    gaps = [sample.lip_gap for sample in samples.values()]
    lip_change = float(np.ptp(gaps)) if gaps else 0.0
    return {"recognition": np.array([turn, parallax, correlation, lip_change])}


@dataclass(frozen=True)
class _Sample:
    """A frame in which a face was found.

    rotation   (3, 3) of the head, to the camera's axes
    center     (2,) the head's middle, in units of the focal length
    points     (K, 2) features of the room, in units of the focal length
    described  (K, 128) what they look like
    lip_gap    between the lips, in distances of eyes and mouth
    """

    rotation: np.ndarray
    center: np.ndarray
    points: np.ndarray
    described: np.ndarray
    lip_gap: float

    @property
    def yaw(self) -> float:
        """Radians by which the head looks to the side."""
        return float(np.arctan2(self.rotation[0, 2], -self.rotation[2, 2]))


class _Look:
    """Finds, in frames of a camera, a head's pose and features of the room behind it."""

    def __init__(self, camera: FootageCamera) -> None:
        import cv2

        model = flame_model(None)
        places, reliable = read_places(BUNDLED_PLACES, len(model.faces))
        self._rows = np.flatnonzero(reliable)
        self._neutral = places.on(model.v_template, model.faces)[self._rows]
        self._middle = model.v_template.mean(0)
        self._faces = FaceNetworks()
        self._person = PersonNetwork()
        self._features = cv2.SIFT.create(1000, contrastThreshold=MIN_CONTRAST)
        self._camera = camera
        self._near: np.ndarray | None = None

    def at(self, timestep: int) -> _Sample | None:
        """None where the frame shows no face."""
        import cv2

        image = reduced_to(self._camera.image(timestep), SAMPLE_SIDE_PX)
        faces = self._faces.find(image, self._near)
        if not faces:
            return None
        face = self._near = faces[0]
        height, width = image.shape[:2]
        focal = typical_focal(width, height)
        size = width, height
        lens = Camera(*size, focal, focal, width / 2, height / 2, np.eye(4))
        posed = pose_from_one_camera(lens, face[self._rows], self._neutral)
        rotation, shift = weighted_procrustes(self._neutral, posed, np.ones(len(posed)))
        # upright, and towards the camera; else it is none, or its pose was mirrored
        if max(rotation[1, 1], rotation[2, 2]) > MAX_AXIS_COSINE:
            return None
        middle = rotation @ self._middle + shift
        room = 255 * (self._person.probability(image) < PERSON_PROBABILITY).astype(np.uint8)
        margin = FACE_MARGIN * np.ptp(face, axis=0)
        low = np.maximum(face.min(0) - margin, 0).astype(int)
        high = np.maximum(face.max(0) + margin, 0).astype(int)
        room[low[1] : high[1], low[0] : high[0]] = 0
        gray = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        points, described = self._features.detectAndCompute(gray, room)
        pixels = np.array([point.pt for point in points]).reshape(-1, 2)
        described = np.zeros((0, 128), np.float32) if described is None else described
        at = lens.at_depth_one(pixels)
        return _Sample(rotation, middle[:2] / middle[2], at, described, _lip_gap(face))

    def later_sample(self, sample: _Sample, timesteps: Sequence[int]) -> _Sample | None:
        """A frame to compare a sample with: the last of the timesteps that follow it. If that shows
        no face, or one that has turned by more than PAIR_TURN_DEG, the one at half of the way, and
        so on up to MAX_HALVINGS. The nearest one if all have turned too far; None without a face.
        """
        found = None
        for count in (len(timesteps) >> halvings for halvings in range(MAX_HALVINGS + 1)):
            later = self.at(timesteps[count - 1]) if count else None
            if later is None:
                continue
            found = later
            if _angle_deg(sample.rotation, found.rotation) <= PAIR_TURN_DEG[1]:
                break
        return found


def _lip_gap(face: np.ndarray) -> float:
    """`_Sample.lip_gap` of landmarks (N, 2)."""
    upper, lower = face[list(INNER_LIPS)]
    height = float(np.linalg.norm(face[list(EYE_CORNERS)].mean(0) - (upper + lower) / 2))
    return float(np.linalg.norm(upper - lower) / max(height, 1e-9))


def _parallax(pairs: Sequence[tuple[_Sample, _Sample]]) -> tuple[float, float]:
    """`Recognition.parallax` and its correlation, from pairs of frames between which the head turns
    a little."""
    turns = []
    moves = []
    for first, second in pairs:
        angle = _angle_deg(first.rotation, second.rotation)
        flow = _room_flow(first, second)
        if flow is None or not PAIR_TURN_DEG[0] <= angle <= PAIR_TURN_DEG[1]:
            continue
        # where the head looks, in the image: x right and y down
        turned = second.rotation[:2, 2] - first.rotation[:2, 2]
        turns.append(turned)
        moves.append(flow - (second.center - first.center))
    if len(turns) < MIN_PAIRS:
        return float("nan"), 0.0
    turned = np.ravel(turns)
    moved = -np.ravel(moves)  # the room moves to the other side than the face
    product = float(turned @ moved)
    size = float(np.sqrt((turned @ turned) * (moved @ moved)))
    return product / float(turned @ turned), product / max(size, 1e-12)


def _room_flow(first: _Sample, second: _Sample) -> np.ndarray | None:
    """(2,) median motion of the room's features; None where too few are found again."""
    import cv2

    if min(len(first.points), len(second.points)) < MIN_MATCHES:
        return None
    found = cv2.BFMatcher().knnMatch(first.described, second.described, k=2)
    rows = [(m.queryIdx, m.trainIdx) for m, n in found if m.distance < MATCH_RATIO * n.distance]
    if len(rows) < MIN_MATCHES:
        return None
    before, after = np.array(rows).T
    flow: np.ndarray = np.median(second.points[after] - first.points[before], axis=0)
    return flow


def _angle_deg(first: np.ndarray, second: np.ndarray) -> float:
    cosine = (np.sum(first * second) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
