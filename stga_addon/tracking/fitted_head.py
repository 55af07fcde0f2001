"""From landmarks to a head on its torso: fitted to the landmarks, then to the images."""

from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from ..capture.mesh_geometry import silhouette
from ..capture.model import evenly_spread
from ..errors import listed
from ..flame.forward import parameters_at
from . import fit as head_fit
from .dense import DenseFit, fit_dense
from .dense_head import REGIONS
from .fit import HeadFit, Pictures, RecordedTake, posed_mesh, without_cameras
from .focal_length import FocalEstimate, scale_warnings
from .footage.model import Footage, FootageCamera
from .gaze import with_gaze
from .head_model import HeadModel
from .mattes import with_mattes
from .opened import file_state
from .pictures import picture_of_fit
from .recorded import RecordedFootage
from .reprojection import (
    Errors,
    check_cameras,
    median_px,
    misread_cameras,
    reprojection_errors,
)
from .stages import Stage, Workers
from .surface import fit_surface
from .torso import FollowedTorso, follow_torso
from .visual_hull import cut_to_visual_hull

ENOUGH_TURN_DEG = 30.0
"""Largest angle between two poses of a head, beyond which turning determines a lens little
better."""
LONG_TAKE = 50
"""Timesteps from which on the fit gets a helping process: threads slow its small matrices."""

Misfits = dict[str, dict[int, float]]
"""Region of the face -> timestep -> how badly images are explained (`Misfit`)."""


@dataclass(frozen=True)
class FittedHead:
    """A head that footage shows, in the capture's world.

    misfits   empty before it is fitted to images, and of takes too short for dense tracking
    warnings  of the fit, one sentence each
    """

    recorded: RecordedFootage
    fit: HeadFit
    misfits: Misfits
    warnings: tuple[str, ...] = ()

    @property
    def errors(self) -> Errors:
        return reprojection_errors(self.fit, self.recorded.take, self.recorded.footage)

    def show(self, workers: Workers, errors: Errors) -> None:
        """Draw the head over the footage, with figures of how well it fits."""
        quality = {"error_px": median_px(errors)}
        fractions = [fraction for misfit in self.misfits.values() for fraction in misfit.values()]
        quality |= {"unexplained": float(np.mean(fractions))} if fractions else {}
        workers.show(partial(picture_of_fit, self.fit, self.recorded.footage), quality)


@dataclass(frozen=True)
class TrackedHead:
    """All data from which a capture is written.

    footage   with its mattes
    warnings  one sentence each
    """

    fitted: FittedHead
    errors: Errors
    footage: Footage
    torso: FollowedTorso
    warnings: tuple[str, ...]


def fit_landmarks(recorded: RecordedFootage, workers: Workers) -> FittedHead:
    """The head fitted to landmarks. Raises StgaError for cameras that do not see one head."""
    head = recorded.opened.head
    take = recorded.take

    def count(rounds: int) -> None:
        workers.report(Stage.FIT, rounds, head_fit.ROUNDS)

    count(0)
    fit: HeadFit = (
        workers.helpers.map(head_fit.fit_head, [(head, take)], count)[0]
        if len(take.landmarks) < LONG_TAKE
        else workers.helpers.run(head_fit.fit_head, (head, take), count)
    )
    fitted = FittedHead(recorded, fit, {})
    errors = fitted.errors
    misread = misread_cameras(errors) if recorded.footage.finds_cameras else []
    if misread:  # the images agree with each other, so that the landmarks are wrong
        unused = f"landmarks are misread, and not used, in images of: {', '.join(misread)}"
        footage = recorded.footage
        footage = replace(footage, warnings=(*footage.warnings, unused))
        opened = replace(recorded.opened, footage=footage)
        recorded = replace(recorded, opened=opened, take=without_cameras(take, misread))
        return fit_landmarks(recorded, workers)
    check_cameras(errors)
    fitted.show(workers, errors)
    return fitted


def fit_skin(fitted: FittedHead, workers: Workers) -> FittedHead:
    """The head of a person who is seen for the first time, fitted to images."""
    fitted = _with_images(fitted)
    recorded = fitted.recorded
    fit, misfits = by_images(recorded.opened.head, fitted.fit, recorded.take, workers)
    fit, warnings = with_gaze(fit, recorded.take, is_stranger=True)
    return _in_world(replace(fitted, fit=fit, misfits=misfits, warnings=warnings))


def fit_expressions(fitted: FittedHead, person: HeadFit, workers: Workers) -> FittedHead:
    """The head of a known person, whose surface need not be sought, posed as images show it."""
    fitted = _with_images(fitted)
    dense = fit_dense(fitted.fit, fitted.recorded.take, workers)
    fit = fitted.fit if dense is None else dense.fit
    fit = replace(fit, shape=person.shape, static_offset=person.static_offset)
    fit, _ = with_gaze(fit, fitted.recorded.take, is_stranger=False)
    return _in_world(replace(fitted, fit=fit, misfits=_misfits(dense)))


def with_torso(fitted: FittedHead, workers: Workers, bends: bool) -> TrackedHead:
    """The head on its torso, whose cloth may bend, in footage with mattes."""
    errors = fitted.errors
    fitted.show(workers, errors)
    recorded = fitted.recorded
    opened = recorded.opened
    footage = opened.footage
    parameters = interpolated(fitted.fit.parameters, footage.timesteps)
    warnings = _warnings(fitted) + scale_warnings(fitted.fit, recorded.take)
    if opened.options.mattes:
        plates = [camera.plate for camera in footage.cameras if camera.plate is not None]
        source = {**opened.source, "plates": [list(map(str, plates)), file_state(plates)]}
        pixels = partial(_head_pixels, fitted.fit, parameters)
        footage, unseen = with_mattes(footage, pixels, opened.out, source, workers)
        warnings += unseen
        mesh = posed_mesh(fitted.fit, parameters[footage.timesteps[0]])
        warnings += cut_to_visual_hull(footage, fitted.fit.to_capture.camera, mesh)
    torso = follow_torso(fitted.fit, parameters, footage, workers, bends)
    return TrackedHead(fitted, errors, footage, torso, warnings)


def by_images(
    head: HeadModel, fit: HeadFit, take: RecordedTake, workers: Workers
) -> tuple[HeadFit, Misfits]:
    """The fit moved onto what the images show, and how badly they are explained. `fit` is what
    `fit_head` returns for `head`."""
    dense = fit_dense(fit, take, workers)
    if dense is None:
        return fit_surface(head, fit, take, workers), {}
    take = replace(take, landmarks=dense.landmarks)
    fit = fit_surface(head, dense.fit, take, workers, dense=True)
    if fit is dense.fit:  # again, from where it is, would move it by hundredths of a millimeter
        return fit, _misfits(dense)
    dense = fit_dense(fit, take, workers, settled=True)
    assert dense is not None
    return dense.fit, _misfits(dense)


def interpolated(
    parameters: Mapping[int, np.ndarray], timesteps: tuple[int, ...]
) -> dict[int, np.ndarray]:
    """Parameters of all timesteps: between the known ones, constant before and after."""
    known = np.array(sorted(parameters))
    values = np.stack([parameters[timestep] for timestep in known.tolist()])
    found = parameters_at(np.array(timesteps), known, values)
    return dict(zip(timesteps, found, strict=True))


def _misfits(dense: DenseFit | None) -> Misfits:
    if dense is None:
        return {}
    fractions = {t: by_region.tolist() for t, by_region in dense.misfit.items()}
    return {
        name: {t: by_region[n] for t, by_region in fractions.items()}
        for n, name in enumerate(REGIONS)
    }


def _with_images(fitted: FittedHead) -> FittedHead:
    """With the pictures that work on images asks the take for."""
    recorded = fitted.recorded
    images, masks = (
        partial(_pictures, recorded.footage, of) for of in (FootageCamera.image, FootageCamera.mask)
    )
    take = replace(recorded.take, images=images, masks=masks)
    return replace(fitted, recorded=replace(recorded, take=take))


def _in_world(fitted: FittedHead) -> FittedHead:
    """The head in the world of its cameras, where that is kept."""
    keeps = fitted.recorded.opened.keeps_world
    return replace(fitted, fit=head_fit.in_cameras_world(fitted.fit)) if keeps else fitted


def _pictures(
    footage: Footage,
    picture: Callable[[FootageCamera, int], np.ndarray | None],
    timestep: int,
    most: int | None = None,
) -> Pictures:
    """The cameras that recorded a timestep, at most so many of them, with their pictures."""
    cameras = [camera for camera in footage.cameras if timestep in camera.timesteps]
    cameras = cameras if most is None else evenly_spread(cameras, most)
    with ThreadPoolExecutor() as pool:  # decoding of a camera's images needs no lock of Python's
        pictures = list(pool.map(lambda camera: picture(camera, timestep), cameras))
    pairs = zip(cameras, pictures, strict=True)
    return [(camera.camera, image) for camera, image in pairs if image is not None]


def _head_pixels(
    fit: HeadFit, parameters: Mapping[int, np.ndarray], timestep: int, camera: FootageCamera
) -> np.ndarray:
    """The pixels of the tracked head in a camera's frame; see `mattes.HeadPixels`."""
    mesh = posed_mesh(fit, parameters[timestep])
    faces = fit.head.model.faces
    return silhouette(mesh, faces, fit.to_capture.camera(camera.camera))


def _warnings(fitted: FittedHead) -> tuple[str, ...]:
    recorded = fitted.recorded
    footage = recorded.footage
    fit = fitted.fit
    missing = [timestep for timestep in footage.timesteps if timestep not in fit.parameters]
    fraction = f"{len(missing)} of {len(footage.timesteps)} timesteps"
    blind = recorded.blind_cameras
    single = len(footage.cameras) == 1
    scale = f"{fit.to_capture.scale:.4g}"
    is_scaled = recorded.opened.keeps_world and not recorded.take.metric
    found = {
        f"no face at {fraction}, interpolated: {listed(missing, 20)}": bool(missing),
        f"no face in any frame of: {', '.join(blind)}": bool(blind),
        "one camera: size and distance of the head, and its depth, are those of the average "
        "head": single and recorded.opened.options.person is None,
        "the images do not show the skin's surface sharply enough: the head is fitted to "
        "landmarks alone": not single and fit.static_offset is None,
        "the cameras' world is kept but for its scale: in meters, the head would be more than "
        f"{head_fit.MAX_HEAD_SCALE - 1:.0%} off people's; positions are multiplied by "
        f"{scale}": is_scaled,
    }
    warnings = *footage.warnings, *fitted.warnings
    warnings += tuple(text for text, holds in found.items() if holds)
    return warnings if recorded.focal is None else (*warnings, _focal_warning(recorded.focal))


def _focal_warning(estimate: FocalEstimate) -> str:
    """A sentence about how well the focal length is known, and what would determine it."""
    turn = "" if estimate.turn_deg > ENOUGH_TURN_DEG else "a head that turns by 30°, "
    return (
        f"the focal length is an estimate: {estimate.low:.0f} to {estimate.high:.0f} px with a "
        f"probability of 90 %; {turn}--focal, or a photo with EXIF data gives more"
    )
