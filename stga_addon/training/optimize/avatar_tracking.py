"""Tracking by a finished avatar: finds the pose and expression at which the avatar, with its splats
fixed, looks like the images.

Landmarks and dense tracking know a face in general; an avatar knows its person, with hair and
teeth. The gradient is that of the training's own loss, passed from the splats to the head's
parameters. L-BFGS follows it in coordinates in which the Gauss-Newton matrix of points of the
surface is the identity, so that few renderings are enough.
"""

from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from time import perf_counter
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.ndimage import binary_erosion
from scipy.optimize import minimize

from ...avatar.file import Avatar
from ...capture.camera import Camera
from ...capture.images import read_view
from ...capture.loader import Preparation
from ...capture.mesh_geometry import ArrayPair, facing, rasterize, silhouette, vertex_normals
from ...capture.model import Capture, View, evenly_spread, views_by_timestep
from ...capture.open import with_sequence
from ...errors import StgaError
from ...flame.forward import (
    RIGID_SIZE,
    TRANSLATION_SIZE,
    FlameFrame,
    change_between,
    changed_by,
    flame_forward,
    frame_of,
    parameters_gradient,
)
from ...flame.model import JOINTS, FlameModel
from ...flame.quaternions import unit
from ...flame.sequence import SHIFT_SIZE, sequence_mesh, torso_offset, torso_shapes, with_identity
from ...light.harmonics import basis
from ...progress import Cancelled
from ...render.render import render_avatar, to_uint8
from ...tracking import appearance, solve
from ...tracking.appearance import NOISE_LEVELS, POINT_FRACTION
from ...tracking.head_model import HeadModel
from ...tracking.observed_surface import in_sight, surface_points
from ...tracking.posed_points import PosedPoints
from ..schedule import sh_degree
from ..settings import TrainingSettings
from .backend import RenderOptions
from .cpu_backend import CpuBackend
from .frames import FrameStore
from .image_preparation import MAX_GAIN, image_preparation
from .outlines import TOLERANCE_FRACTION
from .state import state_of_avatar

RENDERINGS = 7
"""Renderings of each view when a timestep is tracked for the first time."""
RENDERINGS_AGAIN = 3
"""Renderings of each view when it was tracked before; more hardly help."""
MAX_VIEWS = 4
"""Cameras, spread over the rig, whose images are compared."""
MAX_HEIGHT_PX = 400
"""Height of the compared images; larger ones are shrunk."""
PYRAMID_PX = (50, 100, 200)
"""Heights of the images in which the first timestep of another recording is tracked before: a
pattern on clothes misleads by more than its width."""
PYRAMID_RENDERINGS = 20
"""Renderings at each height of the pyramid."""
TRACKED_FRACTION = 0.2
"""Images that the avatar tracks its head in while it trains, as a fraction of the run's iterations:
a long take must not track for longer than it trains."""
MIN_TRACKED_TIMESTEPS = 12
"""Timesteps that are tracked however few iterations there are."""
CACHED_TIMESTEPS = 12
"""FLAME frames kept in memory, with their dynamic offsets."""
POINTS = 6000
"""Points sampled on the surface."""
MIN_COSINE = 0.15
"""Cosine between normal and direction to the camera below which a point does not count."""
MESH_IMAGE_SIDE_PX = 160
"""Larger side of the mesh's images, which give hidden points, the head's pixels and the light."""
EXPRESSION_SIGMA = 0.3
"""Standard deviation of an expression coefficient from its start."""
JOINT_SIGMA_RAD = 0.2
"""Standard deviation of a joint's rotation from its start."""
TRANSLATION_SIGMA_M = 0.02
"""Standard deviation of the head's position from its start."""
SCALE_SIGMA = 0.02
"""Standard deviation of the head's relative size from its start."""
LEAST_GAIN = 1e-3
"""Fraction of the loss by which a step has to lower it; one that does not is the last, but not
where the first timestep of another recording is sought: it leads all others."""
FIRST_STEP = 0.01
"""Length of the first step, as a fraction of the one down a loss as steep as the points say."""
MAX_MOVE_M = 0.05
"""Mean distance of the mesh's vertices by which an avatar may move a tracked head at one timestep:
2.5 standard deviations of its place. Farther, the image does not show the head that was trained."""
MISS_LEVELS = 24
"""Mean over the channels, of 255, by which a pixel's color is missed that is not explained."""


@dataclass(frozen=True)
class AvatarTracking:
    """Parameters (T, E + 18) of timesteps; (T,) the fraction of the head's pixels whose colors the
    avatar misses by more than MISS_LEVELS, NaN where it tracks for the first time; (T, 3) the
    torso's shift, see `torso_shapes`; (T,) the head's scale, where it was solved for; and (T, P, P)
    inverse covariances of the solved parameters: expressions, the torso's shift, scale, pose; (T,
    0, 0) for the recording that the avatar was trained on."""

    timesteps: tuple[int, ...]
    parameters: np.ndarray
    misfit: np.ndarray
    shift: np.ndarray
    scale: np.ndarray
    information: np.ndarray

    def at(self, timesteps: Container[int]) -> "AvatarTracking":
        """Some of the timesteps."""
        kept = [row for row, timestep in enumerate(self.timesteps) if timestep in timesteps]
        arrays = {name: array for name, array in vars(self).items() if name != "timesteps"}
        count = len(self.timesteps)
        arrays = {n: array[kept] if len(array) == count else array for n, array in arrays.items()}
        return AvatarTracking(tuple(self.timesteps[row] for row in kept), **arrays)

    def smoothed(self, model: FlameModel) -> "AvatarTracking":
        """The motion, smoothed over time, most where the images determine it least.

        model: the person's head model. Must not be called if the scale was fitted.
        """
        count = model.n_expression
        shift = np.full(SHIFT_SIZE, solve.TRANSLATION_ACCELERATION_M**-2)
        stiffness = np.insert(solve.acceleration_precision(model), count, shift)
        parts = self.parameters[:, :count], self.shift, self.parameters[:, count:]
        values = solve.smoothed(np.concatenate(parts, axis=1), self.information, stiffness)
        expression, shift, pose = np.split(values, [count, count + SHIFT_SIZE], axis=1)
        return replace(self, parameters=np.concatenate([expression, pose], axis=1), shift=shift)


class RefinedTracking:
    """The motion of a head that its avatar tracks while it is trained: meshes in place of the
    capture's.

    tracked     (T, P) the capture's parameters
    parameters  (T, P + 3) those of now, and a shift of the torso (`torso_shapes`)
    rounds      how often the avatar has tracked
    """

    def __init__(self, capture: Capture, convention: str) -> None:
        """Raises StgaError for a capture without parameters or a convention without gradients."""
        if convention != "stga":
            needs = f"needs the embedding convention 'stga', got '{convention}'"
            raise StgaError(f"--effect tracking=on: {needs}")
        if capture.flame is None:
            cannot = "so --effect tracking=on cannot refine its parameters"
            raise StgaError(f"{capture.root}: is not tracked with FLAME, {cannot}")
        self.sequence = capture.flame
        frames = map(self.sequence.frame, self.sequence.timesteps)
        self.tracked = np.stack([frame.parameters for frame in frames])
        self.parameters = np.pad(self.tracked, ((0, 0), (0, SHIFT_SIZE)))
        self.rounds = 0
        self._row = {timestep: row for row, timestep in enumerate(self.sequence.timesteps)}
        self._source = lru_cache(CACHED_TIMESTEPS)(self.sequence.frame)
        self._person = replace(with_identity(self.sequence), frame=self.frame)
        self._torso = torso_shapes(self._person.model)

    @property
    def has_moved(self) -> bool:
        """Whether parameters differ from the capture's."""
        return not np.array_equal(self.parameters[:, :-SHIFT_SIZE], self.tracked)

    def frame(self, timestep: int) -> FlameFrame:
        values = self.parameters[self._row[timestep]]
        source = self._source(timestep)
        offset = torso_offset(self._torso, values[-SHIFT_SIZE:], source.dynamic_offset)
        return frame_of(values[:-SHIFT_SIZE], offset)

    def mesh(self, timestep: int) -> np.ndarray | None:
        """(V, 3) meters; None where the timestep is not tracked."""
        return sequence_mesh(self._person, timestep) if timestep in self._row else None

    def refined(self, capture: Capture) -> Capture:
        """The capture with the parameters of now."""
        return with_sequence(capture, replace(self.sequence, frame=self.frame))

    def take(self, found: AvatarTracking, timesteps: Sequence[int]) -> list[int]:
        """Apply tracked parameters at some timesteps; the timesteps between them change as their
        neighbors do.

        Returns the timesteps that stay as they were, because their head went farther than tracking
        can be wrong.
        """
        rows, at = ([self._row[t] for t in chosen] for chosen in (timesteps, found.timesteps))
        old = self.parameters
        start = old[at]
        moved = np.concatenate([found.parameters, found.shift], axis=1)
        meshes = [sequence_mesh(self._person, timestep) for timestep in found.timesteps]
        self.parameters = old.copy()
        self.parameters[at] = moved
        is_far = np.array(
            [
                np.linalg.norm(sequence_mesh(self._person, timestep) - mesh, axis=1).mean()
                > MAX_MOVE_M
                for timestep, mesh in zip(found.timesteps, meshes, strict=True)
            ]
        )
        moved[is_far] = start[is_far]
        before, shift = np.split(start, [-SHIFT_SIZE], axis=1)
        after, shifted = np.split(moved, [-SHIFT_SIZE], axis=1)
        parts = change_between(before, after), shifted - shift
        columns = np.concatenate(parts, axis=1).T
        change = np.stack([np.interp(rows, at, column) for column in columns], axis=1)
        values = old[rows]
        by = change[:, :-SHIFT_SIZE]
        added = change[:, -SHIFT_SIZE:]
        self.parameters = old.copy()
        self.parameters[rows, :-SHIFT_SIZE] = changed_by(values[:, :-SHIFT_SIZE], by)
        self.parameters[rows, -SHIFT_SIZE:] += added
        return [timestep for timestep, far in zip(found.timesteps, is_far, strict=True) if far]


@dataclass(frozen=True)
class OtherRecording:
    """How a recording is tracked that the avatar was not trained on.

    scales    whether the head's size is sought too
    shading   harmonics (9, 3) of a factor by the surface's normal, by which the light differs
    is_again  the starts are what the avatar has tracked. Otherwise they are some way off: the first
              timestep is sought in small images first
    """

    scales: bool = False
    shading: np.ndarray | None = None
    is_again: bool = False


class TrainedAvatar(NamedTuple):
    """An avatar, and the settings that it was trained with, whose background and exposures the
    images have that it is compared with."""

    avatar: Avatar
    settings: TrainingSettings


def tracked_timesteps(
    settings: TrainingSettings, capture: Capture, timesteps: Sequence[int]
) -> list[int]:
    """Timesteps, evenly spread, that an avatar tracks while it is trained for a number of
    iterations: as many as TRACKED_FRACTION allows. With a budget in seconds, all: time decides."""
    if settings.iterations is None:
        return list(timesteps)
    wanted = set(timesteps)
    view_count = sum(view.timestep in wanted for view in capture.all_views)
    views = min(MAX_VIEWS, max(1.0, view_count / max(1, len(timesteps))))
    most = int(TRACKED_FRACTION * settings.iterations / views)
    return evenly_spread(timesteps, max(MIN_TRACKED_TIMESTEPS, most))


def not_moved(timesteps: Sequence[int]) -> str:
    """The sentence about timesteps that `RefinedTracking.take` did not move."""
    listed = ", ".join(map(str, timesteps))
    return (
        f"the head would move by more than {100 * MAX_MOVE_M:.0f} cm at timesteps {listed}, "
        "which stay as the capture has them; do their images and masks show it?"
    )


def track_by_avatar(
    trained: TrainedAvatar,
    capture: Capture,
    timesteps: Sequence[int] | None = None,
    seconds: float | None = None,
    report: Callable[[int, int], bool] = lambda done, total: False,
    recording: OtherRecording | None = None,
) -> AvatarTracking:
    """Refine the parameters of a tracked capture of the avatar's person, from where they are.

    timesteps: None: all; as many of them, evenly spread, as `seconds` allow, but at least two.
    report: how many are done; returns whether to stop. recording: None: the avatar was trained on
    the capture; covariances are left out. Each timestep begins where the one before has led. Raises
    StgaError where the capture has no parameters or is of another head, and Cancelled.
    """
    tracker = _Tracker(trained, capture, recording)
    left = list(capture.timesteps if timesteps is None else timesteps)
    begin = perf_counter()
    done = list[int]()
    found = []
    first_s = 0.0
    while left:
        if report(len(done), len(done) + len(left)):
            raise Cancelled
        values, information, misfit = tracker.solve(left[0])
        if recording is None:
            information = np.zeros((0, 0))
        found.append((values, information.astype(np.float32), misfit))
        done.append(left.pop(0))
        if seconds is None:
            continue
        spent_s = perf_counter() - begin
        # the first one has a single start, and so costs less than those after it
        first_s = first_s or spent_s
        each_s = (spent_s - first_s) / (len(done) - 1) if len(done) > 1 else first_s
        most = max(int((seconds - spent_s) / max(each_s, 1e-9)), int(len(done) == 1))
        left = evenly_spread(left[::-1], most)[::-1] if most > 0 else []
    parameters, known, missed = map(np.stack, zip(*found, strict=True))
    scales = recording is not None and recording.scales
    added = np.s_[-RIGID_SIZE - SHIFT_SIZE - scales : -RIGID_SIZE]
    shift, scale = np.split(parameters[:, added], [SHIFT_SIZE], axis=1)
    rows = np.delete(parameters, added, axis=1)
    scale = 1 + scale.ravel()
    return AvatarTracking(tuple(done), rows, missed, shift, scale, known)


def normal_images(mesh: np.ndarray, faces: np.ndarray, rasterized: ArrayPair) -> ArrayPair:
    """Pixels (H, W) bool that show a mesh, and the surface's unit normals there (H, W, 3);
    rasterized: `rasterize` of the mesh."""
    triangles, fraction = rasterized
    covered = triangles >= 0
    found = np.zeros((*triangles.shape, 3))
    corners = vertex_normals(mesh, faces)[faces[triangles[covered]]]
    normals = np.einsum("nk,nkc->nc", fraction[covered], corners)
    found[covered] = unit(normals)
    return covered, found


def read_small(
    view: View, height_px: int, settings: TrainingSettings, prepare: Preparation | None
) -> tuple[View, np.ndarray]:
    """A view with a camera of at most that height, and its image (H, W, 3) uint8 as training with
    the settings sees it; prepare: their `image_preparation`."""
    scale = min(1.0, height_px / view.camera.height)
    view, image, mask = read_view(view, scale, settings.background_levels)
    return view, image if prepare is None else prepare(view, image, mask)[0]


Shots = Sequence[tuple[View, np.ndarray]]
"""Views of one timestep, and their images (H, W, 3) uint8."""


class _Effort(NamedTuple):
    """Largest number of renderings of each view; fraction of the loss by which a step has to lower
    it."""

    renderings: int
    least_gain: float


class _Tracker:
    def __init__(
        self, trained: TrainedAvatar, capture: Capture, recording: OtherRecording | None
    ) -> None:
        avatar, settings = trained
        sequence = capture.flame
        if sequence is None:
            raise StgaError(f"{capture.root}: is not tracked with FLAME or the bundled head")
        if not np.array_equal(avatar.faces, capture.faces):
            raise StgaError(f"{capture.root}: is of another head than the avatar")
        other = OtherRecording() if recording is None else recording
        self._avatar = avatar
        self._capture = capture
        self._settings = settings
        self._sequence = sequence
        self._views = views_by_timestep(capture.all_views)
        self._cuts = settings.backdrop == "mesh"
        whole = replace(settings, backdrop="masked") if self._cuts else settings
        self._prepare = image_preparation(capture, whole)
        person = with_identity(sequence).model
        root = person.j_regressor[JOINTS.index("root")] @ person.v_template
        grown = (person.v_template - root)[:, :, None][:, :, : int(other.scales)]
        # what is sought beside the expressions, as if they were some
        shapes = [person.shapedirs, torso_shapes(person), grown]
        person = replace(person, shapedirs=np.concatenate(shapes, axis=2))
        self._is_again = other.is_again
        self._is_far = recording is not None and not other.is_again
        self._added = SHIFT_SIZE + other.scales
        self._shading = other.shading
        self._change: np.ndarray | None = None
        self._shown: list[ArrayPair] = []  # `rasterize` of the timestep's views, as tracked
        self._head = HeadModel(person, "flame")
        self._points = surface_points(self._head, POINTS)
        self._posed_points = PosedPoints(person, self._points)
        self._values = np.zeros(0)  # parameters that are being tried
        background = np.array(settings.background, np.float32)
        self._options = RenderOptions(background, sh_degree(settings, 1.0))
        state = state_of_avatar(avatar)
        self._frames = FrameStore(
            capture, settings.convention, settings.follows_strain, self._mesh, avatar.strain_range
        )
        self._backend = CpuBackend(settings, self._frames, state)

    def _mesh(self, timestep: int) -> np.ndarray:
        """(V, 3) of the parameters that are being tried."""
        offset = self._sequence.frame(timestep).dynamic_offset
        return flame_forward(self._head.model, np.zeros(0), frame_of(self._values, offset))

    def solve(self, timestep: int) -> tuple[np.ndarray, np.ndarray, float]:
        """Parameters (E + 18,) with the torso's shift, and the scale where it is sought, after the
        expressions; their inverse covariance; and the misfit. As tracked where no view shows the
        timestep."""
        frame = self._sequence.frame(timestep).parameters
        tracked = np.insert(frame, len(frame) - RIGID_SIZE, np.zeros(self._added))
        views = evenly_spread(self._views.get(timestep, []), MAX_VIEWS)
        if not views:
            return tracked, np.diag(self._precision()), 0.0
        mesh = self._capture.mesh(timestep)
        faces = self._capture.faces
        self._shown = [rasterize(mesh, faces, _small(view.camera)) for view in views]
        shots = self._read(views, MAX_HEIGHT_PX)
        effort = _Effort(RENDERINGS_AGAIN if self._is_again else RENDERINGS, LEAST_GAIN)
        found = tracked
        first = None
        if self._change is not None and not self._is_again:
            starts = tracked, changed_by(tracked, self._change)
            losses = [self._loss(start, shots) for start in starts]
            best = min((0, 1), key=lambda number: losses[number][0])
            found = starts[best]
            first = losses[best]
        elif self._is_far:
            effort = _Effort(PYRAMID_RENDERINGS, 0.0)
            for height in PYRAMID_PX:
                found, _ = self._minimize(self._read(views, height), tracked, found, effort)
        found, known = self._minimize(shots, tracked, found, effort, first)
        self._change = change_between(tracked, found)
        misfit = self._misfit(found, shots) if self._is_again else np.nan
        return found, known, misfit

    def _minimize(
        self,
        shots: Shots,
        tracked: np.ndarray,
        start: np.ndarray,
        effort: _Effort,
        first: tuple[float, np.ndarray] | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Parameters after minimization from `start`, and their inverse covariance; first: the
        start's `_loss`, if known."""
        precision = self._precision()  # of the change from those that were tracked
        known = self._gauss_newton(start, shots) + np.diag(precision)
        root = np.linalg.cholesky(known)

        def energy(
            whitened: np.ndarray, known: tuple[float, np.ndarray] | None = None
        ) -> tuple[float, np.ndarray]:
            values = start + solve_triangular(root, whitened, lower=True, trans=1)
            loss, gradient = known or self._loss(values, shots)
            change = values - tracked
            excess = self._excess(values)
            gradient = gradient + precision * change + excess / solve.WEIGHT_EXCESS_SIGMA**2
            prior = precision @ change**2 + (excess**2).sum() / solve.WEIGHT_EXCESS_SIGMA**2
            return loss + prior / 2, solve_triangular(root, gradient, lower=True)

        zero = np.zeros(len(tracked))
        before, slope = energy(zero, first)
        scale = FIRST_STEP * max(float(np.linalg.norm(slope)), 1e-9)

        def scaled(values: np.ndarray) -> tuple[float, np.ndarray]:
            found, gradient = (before, slope) if not values.any() else energy(scale * values)
            return found, scale * gradient

        most = effort.renderings
        options = {"maxfun": most, "maxiter": most, "ftol": effort.least_gain}
        best = minimize(scaled, zero, jac=True, method="L-BFGS-B", options=options)
        change = solve_triangular(root, scale * best.x, lower=True, trans=1)
        return start + change, known

    def _misfit(self, values: np.ndarray, shots: Shots) -> float:
        self._values = values
        mesh = self._mesh(shots[0][0].timestep)
        missed = 0
        count = 0
        for (view, image), (triangles, _) in zip(shots, self._shown, strict=True):
            head = _enlarged(triangles >= 0, image) > 0.5
            drawn = render_avatar(self._avatar, mesh, view.camera, self._settings.background)
            away = np.abs(255 * drawn.transpose(1, 2, 0) - image).mean(2)
            missed = missed + int((away[head] > MISS_LEVELS).sum())
            count = count + int(head.sum())
        return missed / max(count, 1)

    def _read(self, views: Sequence[View], height: int) -> Shots:
        shots = []
        for whole, rasterized in zip(views, self._shown, strict=True):
            view, image = read_small(whole, height, self._settings, self._prepare)
            if self._shading is not None:
                mesh = self._capture.mesh(view.timestep)
                head, normals = normal_images(mesh, self._capture.faces, rasterized)
                ratio = np.ones((*head.shape, 3))
                ratio[head] = np.clip(basis(normals[head]) @ self._shading, 1 / MAX_GAIN, MAX_GAIN)
                image = np.clip(image / _enlarged(ratio, image) + 0.5, 0, 255).astype(np.uint8)
            image = np.ascontiguousarray(image).view()
            image.setflags(write=False)  # like the loader's: Numba compiles for one type only
            shots.append((view, image))
        return shots

    def _cut(self, view: View, image: np.ndarray) -> np.ndarray:
        """The image (H, W, 3) uint8. Where no mask shows the background, pixels beyond the mesh
        that is being tried are replaced by the avatar's, so that the unknown background has no
        gradient. If the tracked mesh cut the image, the image would show that the head has not
        moved."""
        if not self._cuts or view.mask is not None:
            return image
        margin = max(1, round(TOLERANCE_FRACTION * len(image)))
        inside = silhouette(self._mesh(view.timestep), self._capture.faces, view.camera)
        inside = binary_erosion(inside, iterations=margin)
        drawn = to_uint8(self._backend.render(view, self._options))
        cut = np.where(inside[..., None], image, drawn)
        cut.setflags(write=False)
        return cut

    def _precision(self) -> np.ndarray:
        """(E + 18,) inverse variances of the change; joints that the model lacks do not turn."""
        count = self._head.model.n_expression
        sigma = np.repeat(
            (EXPRESSION_SIGMA, JOINT_SIGMA_RAD, TRANSLATION_SIGMA_M),
            (count, RIGID_SIZE - TRANSLATION_SIZE, TRANSLATION_SIZE),
        )
        absent = np.repeat(~np.array(self._head.joints), 3)
        first = count - self._added
        sigma[first:count] = (*(TRANSLATION_SIGMA_M,) * SHIFT_SIZE, SCALE_SIGMA)[: self._added]
        precision = sigma**-2.0
        rigid = slice(count, count + len(absent))
        precision[rigid] = np.where(
            absent, solve.parameter_precision(self._head)[rigid], precision[rigid]
        )
        return precision

    def _excess(self, values: np.ndarray) -> np.ndarray:
        """(E + 18,) by which weights leave 0 to 1."""
        found = np.zeros(len(values))
        if self._head.model.expression_names:
            count = len(values) - RIGID_SIZE - self._added
            found[:count] = values[:count] - np.clip(values[:count], 0, 1)
        return found

    def _loss(self, values: np.ndarray, shots: Shots) -> tuple[float, np.ndarray]:
        """The images' loss in the points' units, and its gradient (E + 18,)."""
        self._values = values
        self._frames.clear()
        shots = [(view, self._cut(view, image)) for view, image in shots]
        weights = [POINT_FRACTION * image.size / 3 / (NOISE_LEVELS / 255) for _, image in shots]
        total, by_vertex = self._backend.mesh_gradient(shots, weights, self._options)
        offset = self._sequence.frame(shots[0][0].timestep).dynamic_offset
        return total, parameters_gradient(self._head.model, frame_of(values, offset), by_vertex)

    def _gauss_newton(self, values: np.ndarray, shots: Shots) -> np.ndarray:
        """(E + 18, E + 18): how parameters change what images show at points of the surface."""
        self._values = values
        mesh = self._mesh(shots[0][0].timestep)
        faces = self._capture.faces
        at = self._points.on(mesh, faces)
        normals = unit(self._points.on(vertex_normals(mesh, faces), faces))
        curvature = np.zeros((len(at), 3, 3))
        for view, image in shots:
            camera = view.camera
            level = appearance.pyramid(camera, image, at.mean(0), appearance.LEVELS_M[:1])[0]
            pixels, depth = level.camera.project(at)
            cosine = facing(camera, at, normals)
            visible = (cosine > MIN_COSINE) & in_sight(_small(camera), mesh, faces, at)
            visible &= appearance.inside(level.camera, pixels, depth)
            # (N, 3 channels, 2)
            slopes = np.stack(appearance.sampled(list(level.gradient), pixels), -1)
            moved = slopes @ appearance.projection_derivative(level.camera, at) / NOISE_LEVELS
            weight = POINT_FRACTION * (cosine * visible)[:, None] * appearance.CHANNEL_WEIGHTS
            curvature += np.einsum("nc,ncx,ncy->nxy", weight, moved, moved)
        _, jacobian = self._posed_points.linearized(values[:-RIGID_SIZE], values[-RIGID_SIZE:])
        flat = jacobian.reshape(-1, jacobian.shape[2])
        return np.asarray(flat.T @ (curvature @ jacobian).reshape(flat.shape))


def _small(camera: Camera) -> Camera:
    return camera.scaled(min(1.0, MESH_IMAGE_SIDE_PX / max(camera.width, camera.height)))


def _enlarged(values: np.ndarray, image: np.ndarray) -> np.ndarray:
    """What a `_small` camera shows, (h, w) or (h, w, C), in an image's size (H, W, 3); float32."""
    import cv2

    small = values.astype(np.float32)
    return np.asarray(cv2.resize(small, image.shape[1::-1], interpolation=cv2.INTER_LINEAR))
