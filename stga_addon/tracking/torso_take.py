"""The frames of a tracked take in which the torso is followed, and the head's parameters with any
orientation of it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import binary_dilation

from ..capture.camera import Camera
from ..capture.mesh_geometry import silhouette
from ..flame.forward import RIGID_SIZE, axis_angle_matrices
from ..flame.model import JOINTS, MIN_TORSO_WEIGHT
from ..flame.quaternions import from_matrices, to_axis_angle
from ..worker.helpers import Helpers
from .appearance import pyramid
from .dense_terms import PyramidView, inside
from .fit import HeadFit
from .footage.model import FootageCamera
from .landmarks import Report
from .write_capture import posed_mesh

ROOT, NECK = JOINTS.index("root"), JOINTS.index("neck")
HEAD_MARGIN = 0.03
"""Around the head's silhouette, where hair and chin may be; share of the image's height."""
PLAIN_LEVEL = 128
"""Gray that stands for everything outside the mask."""
OFFSET_STEPS = 6
"""After which offsets, which move joints, which move vertices, are those wanted."""
EVIDENCE_LEVEL = 1
"""Level of the pyramid in which motions are compared."""


@dataclass(frozen=True)
class PosedTorso:
    """Parameters (E + 18,) of a head with its torso.

    shift  (3,) meters, from where the neck's joint holds the torso, which is rigid then; None: the
           model's weights blend it with the neck
    """

    parameters: np.ndarray
    shift: np.ndarray | None = None


@dataclass(frozen=True)
class TorsoPose:
    """Orientation (3, 3) of the torso in the world, and its shift (3,) in meters, 0 where it is
    only turned."""

    turn: np.ndarray
    shift: np.ndarray


@dataclass(frozen=True)
class TorsoShot:
    """A timestep: by number of the camera its image, its mask (H, W) uint8, and the pixels (H, W)
    bool of the head at EVIDENCE_LEVEL."""

    views: Mapping[int, PyramidView]
    masks: Mapping[int, np.ndarray]
    heads: Mapping[int, np.ndarray]

    def shows(self, number: int, at: np.ndarray) -> np.ndarray:
        """(N,) bool: points (N, 3) that lie in the camera's image, and not behind or before the
        head."""
        camera, head = self.views[number].levels[EVIDENCE_LEVEL].camera, self.heads[number]
        x, y = np.clip(
            camera.project(at)[0].astype(int), 0, [camera.width - 1, camera.height - 1]
        ).T
        return np.asarray(inside(camera, *camera.project(at)) & ~head[y, x])


class TorsoTake:
    """The tracked take: images by timestep, and the head's parameters with any orientation of the
    torso."""

    def __init__(
        self,
        fit: HeadFit,
        parameters: Mapping[int, np.ndarray],
        cameras: Sequence[FootageCamera],
        torso: np.ndarray,
    ) -> None:
        self.model, self.parameters, self.cameras, self.torso = (
            fit.head.model,
            parameters,
            cameras,
            torso,
        )
        self._fit = fit
        regressor = self.model.j_regressor[[ROOT, NECK]]
        self._joints = regressor @ self.model.v_template
        self._joint_dirs = np.einsum("jv,vak->jak", regressor, self.model.shapedirs)
        self._center = posed_mesh(fit, next(iter(parameters.values()))).mean(0)

    def with_torso(self, timestep: int, pose: TorsoPose, rigid: bool) -> PosedTorso:
        """The timestep's head, where it is, on the torso; rigid: which may be shifted as well."""
        root, neck = self._unposed_joints(timestep)
        parameters = with_root(self.parameters[timestep], pose.turn, neck - root)
        return PosedTorso(parameters, pose.shift if rigid else None)

    def motion(self, poses: Mapping[int, TorsoPose], rigid: bool) -> dict[int, PosedTorso]:
        """The torso posed at each timestep."""
        return {
            timestep: self.with_torso(timestep, pose, rigid) for timestep, pose in poses.items()
        }

    def rigid(self, parameters: np.ndarray, vertices: np.ndarray) -> np.ndarray:
        """(N, 3) where the root joint alone carries some vertices (N,)."""
        expr, rigid = parameters[:-RIGID_SIZE], parameters[-RIGID_SIZE:]
        root = self._joints[0] + self._joint_dirs[0] @ expr
        rest = self.model.v_template[vertices] + self.model.shapedirs[vertices] @ expr
        return np.asarray(
            (rest - root) @ axis_angle_matrices(rigid[None, :3])[0].T + root + rigid[-3:]
        )

    def with_offset(
        self, torso: PosedTorso, bend: np.ndarray | float = 0.0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Parameters (E + 18,) and vertex offsets (V, 3) by which a torso is rigid and shifted, and
        bent.

        bend (V, 3): offsets in meters, in the torso's axes, which the root joint turns. Offsets
        move the joints as well, which FLAME finds from vertices; the translation undoes that for
        the head.
        """
        assert torso.shift is not None
        model, parameters, offset = (
            self.model,
            torso.parameters.copy(),
            np.zeros_like(self.model.v_template),
        )
        share = np.minimum(model.weights[:, ROOT] / MIN_TORSO_WEIGHT, 1)
        moved = np.flatnonzero(share)
        before = posed_mesh(self._fit, parameters)[moved]
        wanted = before + share[moved, None] * (
            self.rigid(parameters, moved) + torso.shift - before
        )
        root = axis_angle_matrices(joint_rotation(parameters, ROOT)[None])[0]
        wanted += np.broadcast_to(bend, offset.shape)[moved] @ root.T
        turns = axis_angle_matrices(parameters[-RIGID_SIZE:-3].reshape(-1, 3))
        for joint, parent in enumerate(model.parents.tolist()):
            turns[joint] = turns[parent] @ turns[joint] if parent >= 0 else turns[joint]
        skin = np.einsum("vj,jab->vab", model.weights[moved], turns)
        for _ in range(OFFSET_STEPS):
            missed = wanted - posed_mesh(self._fit, parameters, offset)[moved]
            offset[moved] += np.linalg.solve(skin, missed[..., None])[..., 0]
            root, neck = model.j_regressor[[ROOT, NECK]] @ offset
            by_offset = root + turns[ROOT] @ (neck - root) - turns[NECK] @ neck
            parameters[-3:] = torso.parameters[-3:] - by_offset
        return parameters, offset

    def base(self, parameters: np.ndarray) -> np.ndarray:
        """(3,) the root joint, inside the base of the neck."""
        return np.asarray(
            self._joints[0] + self._joint_dirs[0] @ parameters[:-RIGID_SIZE] + parameters[-3:]
        )

    def pivot(self, timestep: int) -> np.ndarray:
        """(3,) what the torso turns about: the joint of the neck."""
        parameters, (root, neck) = self.parameters[timestep], self._unposed_joints(timestep)
        turn = axis_angle_matrices(joint_rotation(parameters, ROOT)[None])[0]
        return np.asarray(root + turn @ (neck - root) + parameters[-3:])

    def _unposed_joints(self, timestep: int) -> np.ndarray:
        return np.asarray(self._joints + self._joint_dirs @ self.parameters[timestep][:-RIGID_SIZE])

    def mesh(self, parameters: np.ndarray) -> np.ndarray:
        """(V, 3) of the head with these parameters."""
        return posed_mesh(self._fit, parameters)

    def shot(self, timestep: int) -> TorsoShot:
        """Read a timestep; images are of constant size, as optical flow needs them."""
        mesh = self.mesh(self.parameters[timestep])
        views, masks, heads = {}, {}, {}
        for number, source in enumerate(self.cameras):
            mask = source.mask(timestep) if timestep in source.timesteps else None
            if mask is not None:
                camera = self._fit.to_capture.camera(source.camera)
                levels = pyramid(camera, _masked(source.image(timestep), mask), self._center)
                views[number] = PyramidView(bytes([number]), camera, levels)
                heads[number], masks[number] = (
                    self.head_pixels(mesh, levels[EVIDENCE_LEVEL].camera),
                    mask,
                )
        return TorsoShot(views, masks, heads)

    def head_pixels(self, mesh: np.ndarray, camera: Camera) -> np.ndarray:
        """(H, W) bool: the head without its torso, and what is beside it."""
        return grown(silhouette(mesh, self.model.faces[~self.torso], camera), HEAD_MARGIN)


class BothWays:
    """Work along a take, from one timestep to both ends, on which each timestep's result begins
    with that before: by helping processes, each on a way."""

    def __init__(self, helpers: Helpers, report: Report, total: int) -> None:
        self._helpers, self._report, self._done, self._total = helpers, report, 0, total

    def along(
        self,
        work: Callable[..., dict[str, np.ndarray]],
        parts: Sequence[tuple],
        first: int,
        timesteps: Sequence[int],
    ) -> list[dict[int, dict[str, np.ndarray]]]:
        """For each part, by timestep, the rows of the arrays that work(*part, way, step) gives for
        both ways."""
        later = [first, *(t for t in timesteps if t > first)]
        earlier = [first, *(t for t in reversed(timesteps) if t < first)]
        every, done = [(*part, way) for part in parts for way in (later, earlier)], self._done
        found = self._helpers.map(
            work, every, lambda n: self._report("Torso", done + n, self._total), keep=True
        )
        self._done += len(parts) * (len(later) + len(earlier) - 2)
        rows = [
            {t: {name: array[row] for name, array in own.items()} for row, t in enumerate(way)}
            for (*_, way), own in zip(every, found, strict=True)
        ]
        return [
            dict(sorted({**a, **b}.items())) for a, b in zip(rows[::2], rows[1::2], strict=True)
        ]


def with_root(parameters: np.ndarray, rotation: np.ndarray, arm: np.ndarray) -> np.ndarray:
    """Parameters (E + 18,) with the root joint in another orientation (3, 3), and the head in its
    place.

    arm (3,): from the root joint to the neck's, before posing.
    """
    before, neck = axis_angle_matrices(
        np.stack([joint_rotation(parameters, joint) for joint in (ROOT, NECK)])
    )
    changed = parameters.copy()
    rigid = changed[-RIGID_SIZE:]
    rigid[3 * ROOT : 3 * ROOT + 3] = axis_angle(rotation)
    rigid[3 * NECK : 3 * NECK + 3] = axis_angle(rotation.T @ before @ neck)
    rigid[-3:] += (before - rotation) @ arm
    return changed


def head_turn(parameters: np.ndarray) -> np.ndarray:
    """(3, 3) orientation of the head in the world."""
    root, neck = axis_angle_matrices(
        np.stack([joint_rotation(parameters, joint) for joint in (ROOT, NECK)])
    )
    return np.asarray(root @ neck)


def joint_rotation(parameters: np.ndarray, joint: int) -> np.ndarray:
    """(3,) axis-angle of a joint in (E + 18,) parameters."""
    return np.asarray(parameters[-RIGID_SIZE:][3 * joint : 3 * joint + 3])


def axis_angle(rotation: np.ndarray) -> np.ndarray:
    """(3,) of a rotation (3, 3)."""
    return np.asarray(to_axis_angle(from_matrices(rotation[None]))[0])


def grown(where: np.ndarray, share: float) -> np.ndarray:
    """The pixels (H, W) bool with those around them, as far as a share of the image's height."""
    return np.asarray(binary_dilation(where, iterations=max(1, round(share * len(where)))))


def _masked(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """The image (H, W, 3) uint8 over plain gray."""
    laid, edge = image.copy(), (mask > 0) & (mask < 255)
    share = mask[edge][:, None].astype(np.float32) / 255
    laid[edge] = image[edge] * share + PLAIN_LEVEL * (1 - share) + 0.5
    laid[mask == 0] = PLAIN_LEVEL
    return laid
