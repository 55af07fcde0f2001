"""Tracking of other footage of a person by the avatar that a run trained."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ...avatar.file import Avatar, read_avatar
from ...capture.camera import Camera
from ...capture.images import read_view
from ...capture.mesh_geometry import Similarity, rasterize
from ...capture.model import Capture, View, cameras_at_once, evenly_spread, views_by_camera
from ...capture.open import open_capture
from ...capture.usable_views import with_usable_views
from ...files import read_json, write_json
from ...flame.forward import joint_positions, moved_pose, shaped_vertices
from ...flame.sequence import FlameSequence, torso_offset, torso_shapes, with_identity
from ...light.harmonics import basis, uniform
from ...render.render import render_avatar, to_uint8
from ...tracking import folder as tracking_folder
from ...tracking.folder import REPORT_FILE, SPLIT_FILES
from ...tracking.known_person import KnownPerson, cameras_of, captured_person
from ...tracking.write_capture import replace_head
from ...worker.helpers import Helpers, Step
from ..optimize.avatar_tracking import (
    AvatarTracking,
    OtherRecording,
    TrainedAvatar,
    normal_images,
    track_by_avatar,
)
from ..optimize.image_preparation import EXPOSURE_SCALE, fit_exposure
from ..settings import TrainingSettings
from .folder import AVATAR, avatar_version, open_refined, open_run, read_run

EXPOSURE_VIEWS = 24
"""Views of a camera, spread over the take, that its exposure is fitted to."""
EXPOSURE_HEIGHT_PX = 160
"""Height of these images."""
CAMERA_WEIGHT = 0.2
"""Weight of the camera's exposure in a view's exposure, relative to the view's number of pixels."""
MIN_COVER = 250
"""Least value of a mask, of 255, at which a pixel shows the person alone."""
SHADING_PRIOR = 0.01
"""Weight of the light that the avatar was trained in as a fraction of the pixels, where that of a
take is fitted."""
SHADING_ITERATIONS = 6
"""Reweighted least squares fits of that light."""
SCALE_TIMESTEPS = 6
"""Spread over the take, that the scale is found from."""
ROUNDS = 2
"""Rounds of tracking, each from the motion that the round before led to, smoothed in takes in
order."""
IDENTITY = Similarity()
"""Similarity that leaves the world of a capture where it is."""
PART_TIMESTEPS = 16
"""Timesteps that a helping process tracks at a time."""
Source = tuple[Path, int, Path, float, int]
"""A run, when its avatar was written, and a capture, once scaled and tracked in rounds."""
HeadColors = tuple[np.ndarray, np.ndarray, np.ndarray]
"""(3, N) colors in 0…1 of the avatar and of an image, and normals, on the head."""
Light = tuple[tuple[tuple[float, ...], ...], np.ndarray]
"""`TrainingSettings.exposure` of a capture that the avatar was not trained on, and harmonics (9, 3)
of its light's ratio to that of the training, by the surface's normal."""


def avatar_person(run: Path) -> tuple[KnownPerson, Path | None]:
    """The person of a run's avatar, and the file of its FLAME model, None of the bundled head.
    Raises StgaError where its capture was not tracked with either."""
    capture = open_refined(run)
    person = captured_person(capture, str(run))
    stored = read_run(run)
    avatar = read_avatar(run / AVATAR)

    def draw(mesh: np.ndarray, camera: Camera) -> np.ndarray:
        return to_uint8(render_avatar(avatar, mesh, camera, stored.settings.background))

    return replace(person, draw=draw), stored.flame


def track_recording(
    run: Path,
    root: Path,
    helpers: Helpers,
    report: Callable[[int, int], None],
    keeps_world: bool = False,
) -> AvatarTracking:
    """Refine the tracking of a capture of the run's person by the avatar, its splats fixed.

    Exposure and white balance of each camera, where they drift of each timestep, are fitted to the
    avatar's colors first, as are the scale of the world and, unless it is kept, how it is turned.
    The timesteps' parameter files are replaced, and the report says what fraction of the images is
    left unexplained. Raises StgaError, and what `report` raises.
    """
    timesteps = open_capture(root, read_run(run).flame).timesteps
    stored = read_json(root / REPORT_FILE)
    total = ROUNDS * len(timesteps)
    report(0, total)
    rotation = None if keeps_world else _fit_rotation(run, root)
    if rotation is not None:
        move_capture(root, read_run(run).flame, 1.0, rotation)
    factor = _fit_scale(run, root, helpers, lambda: report(0, total))
    source = run, (run / AVATAR).stat().st_mtime_ns, root, factor
    light = _light(*_open(*source, 0))
    for number in range(ROUNDS):
        sequence = _open(*source, number)[2].flame
        assert sequence is not None
        starts = range(0, len(timesteps), PART_TIMESTEPS)
        every = [timesteps[first : first + PART_TIMESTEPS] for first in starts]
        parts = [((*source, number), light, some, False) for some in every]

        def count(done: int, before: int = number * len(timesteps)) -> None:
            report(min(before + done, total), total)

        found = helpers.map(_track_part, parts, count, True)
        columns = {name: np.concatenate([part[name] for part in found]) for name in found[0]}
        tracked = AvatarTracking(timesteps, **columns)
        if stored["in_order"]:
            tracked = tracked.smoothed(sequence.model)
        _replace_heads(root, sequence, tracked)
    stored = read_json(root / REPORT_FILE)  # which scaling changes
    fractions = zip(timesteps, tracked.misfit.tolist(), strict=True)
    stored["avatar"] = avatar_version(run)
    misfit = {str(timestep): round(fraction, 3) for timestep, fraction in fractions}
    stored["image_misfit"][tracking_folder.AVATAR_MISFIT] = misfit
    write_json(root / REPORT_FILE, stored)
    return tracked


def _replace_heads(root: Path, sequence: FlameSequence, tracked: AvatarTracking) -> None:
    torso = torso_shapes(sequence.model)
    rows = zip(tracked.timesteps, tracked.parameters, tracked.shift, strict=True)
    for timestep, values, shift in rows:
        offset = torso_offset(torso, shift, sequence.frame(timestep).dynamic_offset)
        replace_head(root, timestep, values, offset)


def _track_part(
    source: Source, light: Light, timesteps: Sequence[int], scales: bool, step: Step
) -> dict[str, np.ndarray]:
    avatar, settings, capture = _open(*source)
    exposure, shading = light
    trained = TrainedAvatar(avatar, replace(settings, exposure=exposure))

    def report(done: int, total: int) -> bool:
        if done:
            step()
        return False

    recording = OtherRecording(scales, shading, is_again=source[-1] > 0)
    found = track_by_avatar(trained, capture, timesteps, None, report, recording)
    step()
    names = ("parameters", "misfit", "shift", "scale", "information")
    return {name: getattr(found, name) for name in names}


def _fit_scale(run: Path, root: Path, helpers: Helpers, report: Callable[[], None]) -> float:
    """Scale the capture's world such that the head is as large as the avatar's; landmarks alone are
    off by some percent. One camera does not see scale. Returns the factor."""
    source = run, (run / AVATAR).stat().st_mtime_ns, root, 1.0, 0
    avatar, settings, capture = _open(*source)
    if cameras_at_once(capture.all_views) < 2:
        return 1.0
    chosen = evenly_spread(capture.timesteps, SCALE_TIMESTEPS)
    light = _light(avatar, settings, capture)
    parts = [(source, light, [timestep], True) for timestep in chosen]
    found = helpers.map(_track_part, parts, lambda done: report(), True)
    factor = 1 / float(np.median([part["scale"] for part in found]))
    move_capture(root, read_run(run).flame, factor, IDENTITY.rotation)
    return factor


def _fit_rotation(run: Path, root: Path) -> np.ndarray | None:
    """The rotation (3, 3) of the capture's world after which its cameras look the ways that the
    avatar's did, so that its colors, which depend on the direction, are those of their light. None
    where there are other cameras, or where the images are explained worse then."""
    stored = read_run(run)
    capture = open_capture(root, stored.flame)
    cameras = cameras_of(capture)
    trained = cameras_of(open_run(run).capture)
    if set(cameras) != set(trained):
        return None
    rotations = [trained[index].rotation.T @ camera.rotation for index, camera in cameras.items()]
    rotation = Rotation.from_matrix(rotations).mean().as_matrix()
    avatar = read_avatar(run / AVATAR)
    errors = []
    for world in (IDENTITY, replace(IDENTITY, rotation=rotation)):
        missed = []
        for _, pixels in _colors_by_camera(avatar, stored.settings, capture, world):
            drawn, observed, _ = (np.concatenate(side, 1) for side in zip(*pixels, strict=True))
            gain, offset = fit_exposure(drawn, observed)[..., None]
            squared = ((observed - gain * drawn - offset) / EXPOSURE_SCALE) ** 2
            missed.append(squared / (1 + squared))
        errors.append(np.concatenate(missed, axis=1).mean())
    return rotation if errors[1] < errors[0] else None


def move_capture(root: Path, flame: Path | None, factor: float, rotation: np.ndarray) -> None:
    """Scale a tracked capture's world about its origin, and turn it by a rotation (3, 3); the heads
    keep their size."""
    capture = open_capture(root, flame)
    assert capture.flame is not None
    person = with_identity(capture.flame).model
    for name in SPLIT_FILES:
        document = read_json(root / name)
        for frame in document["frames"]:
            pose = np.array(frame["transform_matrix"], np.float64)
            pose[:3] = rotation @ pose[:3] * [1, 1, 1, factor]
            frame["transform_matrix"] = pose.tolist()
        write_json(root / name, document)
    for timestep in capture.timesteps:
        frame = capture.flame.frame(timestep)
        shaped = shaped_vertices(person, np.zeros(0), frame.expr, frame.dynamic_offset)
        shift = (factor - 1) * rotation @ capture.mesh(timestep).mean(0)
        root_joint = joint_positions(person, shaped)[0]
        turned, moved = moved_pose(frame.rotation, frame.translation, root_joint, rotation, shift)
        values = replace(frame, rotation=turned, translation=moved).parameters
        replace_head(root, timestep, values)
    torso = tracking_folder.read_torso_points(root)
    if torso is not None:
        at = factor * torso.at @ rotation.T
        tracking_folder.write_torso_points(root, replace(torso, at=at))
    stored = read_json(root / REPORT_FILE)
    stored["meters_per_unit"] *= factor
    write_json(root / REPORT_FILE, stored)


@lru_cache(1)
def _open(
    run: Path, trained_ns: int, root: Path, factor: float, number: int
) -> tuple[Avatar, TrainingSettings, Capture]:
    stored = read_run(run)
    capture, _ = with_usable_views(open_capture(root, stored.flame))
    return read_avatar(run / AVATAR), stored.settings, capture


def _light(avatar: Avatar, settings: TrainingSettings, capture: Capture) -> Light:
    rows = []
    lit = []
    for chosen, pixels in _colors_by_camera(avatar, settings, capture):
        drawn, observed, normals = (np.concatenate(side, 1) for side in zip(*pixels, strict=True))
        overall = fit_exposure(drawn, observed)
        for view, (camera_drawn, camera_observed, _) in zip(chosen, pixels, strict=True):
            exposure = fit_exposure(camera_drawn, camera_observed, overall, CAMERA_WEIGHT)
            scaled = exposure * np.array([[1.0], [255.0]])
            rows.append((float(view.camera_index), *scaled.ravel().tolist(), float(view.timestep)))
        lit.append((drawn, (observed - overall[1][:, None]) / overall[0][:, None], normals))
    return tuple(rows), _fit_shading(*(np.concatenate(side, 1) for side in zip(*lit, strict=True)))


def _fit_shading(drawn: np.ndarray, observed: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Harmonics (9, 3) by the normal (3, N) of a factor from colors (3, N) to those seen."""
    by_normal = basis(normals.T)
    even = uniform(1.0)
    found = even.copy()
    for _ in range(SHADING_ITERATIONS):
        for channel, (x, y) in enumerate(zip(drawn, observed, strict=True)):
            residual = y - x * (by_normal @ found[:, channel])
            weight = (1 + (residual / EXPOSURE_SCALE) ** 2) ** -2.0
            system = by_normal * x[:, None]
            prior = SHADING_PRIOR * (weight @ x**2 + 1e-9)
            matrix = (weight * system.T) @ system + prior * np.eye(len(found))
            right = system.T @ (weight * y) + prior * even[:, channel]
            found[:, channel] = np.linalg.solve(matrix, right)
    return found


def _colors_by_camera(
    avatar: Avatar, settings: TrainingSettings, capture: Capture, world: Similarity = IDENTITY
) -> Iterator[tuple[Sequence[View], list[HeadColors]]]:
    """EXPOSURE_VIEWS of each camera, and their colors on the head; world: the capture's is moved so
    before the avatar is drawn."""
    for views in views_by_camera(capture.all_views).values():
        chosen = evenly_spread(sorted(views, key=lambda view: view.timestep), EXPOSURE_VIEWS)
        yield chosen, [_head_colors(avatar, settings, capture, view, world) for view in chosen]


def _head_colors(
    avatar: Avatar, settings: TrainingSettings, capture: Capture, view: View, world: Similarity
) -> HeadColors:
    scale = min(1.0, EXPOSURE_HEIGHT_PX / view.camera.height)
    view, image, mask = read_view(view, scale, settings.background_levels)
    mesh = world.apply(capture.mesh(view.timestep))
    camera = world.camera(view.camera)
    drawn = render_avatar(avatar, mesh, camera, settings.background)
    rasterized = rasterize(mesh, capture.faces, camera)
    head, normals = normal_images(mesh, capture.faces, rasterized)
    head &= True if mask is None else mask >= MIN_COVER
    return drawn[:, head].astype(np.float64), image[head].T / 255, normals[head].T
