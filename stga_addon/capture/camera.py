"""Calibrated pinhole cameras, and orbits around a head, as far as its cameras saw it."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..flame.quaternions import from_axis_angle, to_matrices, unit

MAX_IMAGE_PIXELS = 1 << 26
"""Pixels of the largest machine-vision sensors; a small file that claims more could fill the
memory."""
MAX_FOCAL_PIXELS = 1e7
"""Largest focal length."""
MAX_COORDINATE_M = 1e5
"""Bound of camera positions and vertices: generous even for a scene in millimeters, and no product
of them with focal lengths overflows an integer pixel position."""
MIN_PROJECTION_DEPTH = 1e-6
"""Meters: points that are nearer, or behind the camera, are projected as if at this depth."""
# Camera axes: OpenGL and Blender (x right, y up, looks along -z) to OpenCV (x right, y down, looks
# along +z).
GL_TO_CV = np.diag([1.0, -1.0, -1.0, 1.0])
TURNTABLE_S = 6.0  # Duration of a turntable, unless the motion is longer
UP = (0.0, 1.0, 0.0)  # Captures are y-up
MAX_GAP_RAD = np.radians(100)  # Angle without a camera above which a side counts as unseen


def is_image_size(width: float, height: float) -> bool:
    """Whether an image may have this size: whole numbers from one pixel up, within the limit."""
    whole = width % 1 == 0 and height % 1 == 0
    return bool(whole and min(width, height) >= 1) and width * height <= MAX_IMAGE_PIXELS


@dataclass(frozen=True)
class Camera:
    """Intrinsics in pixels and pose.

    width, height  image size
    fl_x, fl_y     focal lengths
    cx, cy         principal point from the top-left corner of the image (OpenCV; pixel centers lie
                   at .5)
    world_to_camera  (4, 4) float64, meters, OpenCV camera axes
    """

    width: int
    height: int
    fl_x: float
    fl_y: float
    cx: float
    cy: float
    world_to_camera: np.ndarray

    @property
    def intrinsics(self) -> tuple[int, int, float, float, float, float]:
        """width, height, fl_x, fl_y, cx, cy."""
        return self.width, self.height, self.fl_x, self.fl_y, self.cx, self.cy

    @property
    def rotation(self) -> np.ndarray:
        """(3, 3) from the world's axes to the camera's."""
        return self.world_to_camera[:3, :3]

    @property
    def translation(self) -> np.ndarray:
        """(3,) of the world's origin in the camera's axes, meters."""
        return self.world_to_camera[:3, 3]

    @property
    def position(self) -> np.ndarray:
        """Camera center (3,) in world meters."""
        return -self.rotation.T @ self.translation

    @property
    def camera_to_world_gl(self) -> np.ndarray:
        """(4, 4) pose with OpenGL camera axes: what `transform_matrix` and a Blender camera
        hold."""
        return np.linalg.inv(self.world_to_camera) @ GL_TO_CV

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Pixel positions (N, 2) and depths (N,) in meters of world points (N, 3) meters. Positions
        count from the top-left corner of the image, pixel centers lie at .5. Depth is the distance
        along the viewing axis, negative behind the camera; positions of such points mean
        nothing."""
        local = points @ self.rotation.T + self.translation
        depth = local[:, 2]
        flat = local[:, :2] / np.maximum(depth, MIN_PROJECTION_DEPTH)[:, None]
        return flat * [self.fl_x, self.fl_y] + [self.cx, self.cy], depth

    def at_depth_one(self, pixels: np.ndarray) -> np.ndarray:
        """Where the rays of pixels (N, 2) are 1 m in front of the camera: (N, 2) in its axes."""
        return (pixels - [self.cx, self.cy]) / [self.fl_x, self.fl_y]

    def unproject(self, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
        """World points (N, 3) in meters of pixel positions (N, 2) at depths (N,), both as `project`
        returns them."""
        flat = self.at_depth_one(pixels)
        local = np.concatenate([flat, np.ones((len(flat), 1))], axis=1) * depth[:, None]
        return (local - self.translation) @ self.rotation

    def scaled(self, factor: float) -> "Camera":
        """The camera with an image `factor` times as large (sizes rounded, at least one pixel)."""
        width = max(1, round(self.width * factor))
        height = max(1, round(self.height * factor))
        x = width / self.width
        y = height / self.height
        intrinsics = self.fl_x * x, self.fl_y * y, self.cx * x, self.cy * y
        return Camera(width, height, *intrinsics, self.world_to_camera)


def scaled_to(camera: Camera, size: tuple[int, int]) -> Camera | None:
    """The camera with images of another size (width, height), which has its shape but for the
    rounding of a pixel of the smaller; None for another shape."""
    x = size[0] / camera.width
    y = size[1] / camera.height
    if abs(x - y) * min(camera.width, camera.height) > max(x, y, 1.0):
        return None
    intrinsics = camera.fl_x * x, camera.fl_y * y, camera.cx * x, camera.cy * y
    return Camera(*size, *intrinsics, camera.world_to_camera)


def turn_about(axis: Sequence[float], center: np.ndarray, angle: float) -> np.ndarray:
    """(4, 4) that turns points by `angle` radians, counterclockwise seen against the `axis` (3,),
    about it through `center` (3,)."""
    turn = np.eye(4)
    turn[:3, :3] = to_matrices(from_axis_angle(angle * unit(np.asarray(axis, np.float64))))
    turn[:3, 3] = center - turn[:3, :3] @ center
    return turn


def orbited(camera: Camera, center: np.ndarray, up: Sequence[float], angle: float) -> Camera:
    """The camera turned by `angle` radians, counterclockwise seen from above, about the axis `up`
    (3,) through `center` (3,) in world meters: it sees the center at the same place of the image
    from another side."""
    back = turn_about(up, center, -angle)
    return replace(camera, world_to_camera=camera.world_to_camera @ back)


def central_camera(cameras: Sequence[Camera]) -> int:
    """Index of the camera that looks most nearly in the mean viewing direction; for a head captured
    from the front and both sides, the one that sees the face."""
    return most_central(np.array([camera.world_to_camera[2, :3] for camera in cameras]))


def most_central(directions: np.ndarray) -> int:
    """Index of the unit vector (N, 3) that is nearest to the mean."""
    return int((directions @ directions.mean(0)).argmax())


def camera_from_gl(
    camera_to_world: np.ndarray,
    size: tuple[int, int],
    focal: tuple[float, float],
    center: tuple[float, float],
) -> Camera:
    """Camera from an OpenGL camera-to-world matrix (4, 4); size: width and height, focal: fl_x and
    fl_y, center: cx and cy, as in `Camera`."""
    world_to_camera = GL_TO_CV @ np.linalg.inv(np.asarray(camera_to_world, np.float64))
    return Camera(*size, *focal, *center, world_to_camera)


def look_at(
    eye: Sequence[float],
    target: Sequence[float],
    width: int,
    height: int,
    focal_length: float,
    up: Sequence[float] = UP,
) -> Camera:
    """Camera at `eye` that looks at `target`, both (3,) in world meters; the principal point is the
    image's center. width, height, focal_length in pixels. up: the world direction that points up in
    the image. Raises ValueError where it is parallel to the viewing direction, or that is none."""
    forward = np.asarray(target, np.float64) - np.asarray(eye, np.float64)
    right = np.cross(forward, np.asarray(up, np.float64))
    if not np.linalg.norm(right):
        raise ValueError(f"the viewing direction {forward} is parallel to up {up}")
    forward = forward / np.linalg.norm(forward)
    right = right / np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = right, np.cross(forward, right), forward
    pose[:3, 3] = -pose[:3, :3] @ np.asarray(eye, np.float64)
    return Camera(width, height, focal_length, focal_length, width / 2, height / 2, pose)


def turntable(
    start: Camera,
    center: np.ndarray,
    count: int,
    angles: tuple[float, float],
    up: Sequence[float] = UP,
) -> list[Camera]:
    """`count` cameras that orbit the vertical axis through `center` (3,), from where `start` is.
    angles: radians from `start`, from `covered_angles`; a full turn goes around once, less swings
    to both sides."""
    low, high = angles
    fractions = np.arange(count) / count
    if high - low >= 2 * np.pi:
        turns = 2 * np.pi * fractions
    else:
        turns = (low + high) / 2 + (high - low) / 2 * np.sin(2 * np.pi * fractions)
    return [orbited(start, center, up, turn) for turn in turns]


def covered_angles(
    cameras: Sequence[Camera], start: Camera, center: np.ndarray, up: Sequence[float] = UP
) -> tuple[float, float]:
    """The angles about the vertical axis through `center` (3,), in radians from `start`, that the
    cameras cover. Of what no camera saw, training has nothing to show. A full turn where they leave
    no gap of MAX_GAP_RAD."""
    axis = unit(np.asarray(up, np.float64))
    arms = np.array([camera.position for camera in (start, *cameras)]) - center
    first = arms[0] - arms[0] @ axis * axis
    azimuths = np.arctan2(arms[1:] @ np.cross(axis, first), arms[1:] @ first)
    angles = np.sort(np.append(azimuths, 0.0))
    gaps = np.diff(np.append(angles, angles[0] + 2 * np.pi))
    if gaps.max() < MAX_GAP_RAD:
        return -np.pi, np.pi
    widest = int(gaps.argmax())
    low = angles[(widest + 1) % len(angles)]
    high = angles[widest]
    return (low - 2 * np.pi if low > 0 else low), (high + 2 * np.pi if high < 0 else high)


def to_and_fro(timesteps: Sequence[int], count: int) -> list[int]:
    """`count` timesteps that play a motion forward and back, as often as it fits."""
    there_and_back = [*timesteps, *timesteps[-2:0:-1]]
    return [there_and_back[index % len(there_and_back)] for index in range(count)]
