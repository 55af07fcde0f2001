"""Texture of a head's surface points: sampled in image pyramids, averaged without lighting."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from ..capture.camera import Camera

LEVELS_M = (0.0012, 0.0024, 0.0048, 0.0096)
"""Size at the head of the pixels of each level of the pyramid, in meters."""
BLUR_PX = 0.8
"""Standard deviation of the blur, by which differences of neighbors are derivatives."""
DETAIL_PX = 2.5
"""Standard deviation of the neighborhood whose mean is taken off the luma, against lighting."""
COLORS = np.array([[0.299, 0.587, 0.114], [0.8, -0.8, 0.0]], np.float32)
"""Weights of red, green and blue in luma and in redness, in which lips differ from skin."""
CHANNEL_WEIGHTS = np.array([0.5, 1.5, 0.7])
"""Weights of luma, detail and redness."""
NOISE_LEVELS = 6.0
"""Standard deviation, of 255, of skin's pixels from the texture where tracking is exact."""
LIGHT_PRIOR = 0.02
"""Weight of the prior light, as a fraction of that of the points."""
LIGHT_ITERATIONS = 2
"""Reweighted least squares fits of the light."""
TEXTURE_ITERATIONS = 4
"""Reweighted averages of the texture."""
MEAN_ITERATIONS = 3
"""Reweighted averages of a mean."""
ALBEDO_SCALE = 6 * NOISE_LEVELS
"""Difference from skin of one color, in levels, beyond which pixels are outliers."""
TEXTURE_SCALE = 4 * NOISE_LEVELS
"""The same for the difference from the texture while it is being averaged."""
LIGHT_SCALE = 2 * NOISE_LEVELS
"""Difference from what the fitted light predicts, in levels, beyond which pixels are outliers."""
MEAN_SCALE = 3 * NOISE_LEVELS
"""The same for the difference from a mean."""
MIN_SHADING = 0.2
"""Least factor of the light on a texture."""
MAX_SHADING = 4.0
"""Largest factor of the light on a texture."""
ALL_CAMERAS_PRIOR = 6.0
"""Observations by all cameras that weigh as much as a camera's own: skin shines differently to each
side."""
MAX_DEVIATION_LEVELS = 60.0
"""Largest difference, in levels, that counts in a texture's mean deviation."""
MAX_SAMPLES = 1 << 14
"""Samples of an image at a time: OpenCV takes fewer than 2^15."""
POINT_FRACTION = 0.25
"""Weight of a point in a view: neighboring points share pixels."""
OUTLIER_SQUARED = 4.0, 4.0, 16.0, 16.0
"""Squared difference in NOISE_LEVELS at which a point is explained by half, for each level."""
FLOW_LEVEL = 1
"""Level of the pyramid whose images optical flow compares."""
FLOW_POINTS = 2
"""Level of the pyramid whose points optical flow moves."""
FLOW_ITERATIONS = 4
"""Gauss–Newton steps with a flow."""
FLOW_FRACTION = 0.3
"""Weight of a point's flow of 1 pixel."""
FLOW_SCALE_PX = 2.0
"""Distance beyond which a point's flow is an outlier."""
MIN_FLOW_SIDE_PX = 32
"""Side below which an image is too small for the patches of DIS."""
FAR_WEIGHT = 1e-3
"""Weight of the wider neighborhood in a mean over two."""
MIN_NEIGHBORHOOD_PX = 2.0
"""Standard deviation of the smaller neighborhood, in pixels of the image of the means."""
MIN_OBSERVATIONS = 1.0  # Least sum of the views' weights with which a point's texture is known


@dataclass(frozen=True)
class Level:
    """An image: camera, channels (H, W, 3) float32."""

    camera: Camera
    channels: np.ndarray

    @cached_property
    def gradient(self) -> np.ndarray:
        """(2, H, W, 3) float32 derivatives by x and y."""
        import cv2

        along = np.array([[-0.5, 0, 0.5]], np.float32)
        return np.stack([cv2.filter2D(self.channels, -1, kernel) for kernel in (along, along.T)])

    @cached_property
    def luma(self) -> np.ndarray:
        """(H, W) uint8."""
        return np.clip(self.channels[..., 0], 0, 255).astype(np.uint8)


@dataclass(frozen=True)
class PyramidView:
    """One camera's image at a timestep: key and pose of the camera in the capture's world, and
    pyramid."""

    key: bytes
    camera: Camera
    levels: Sequence[Level]


Views = Sequence[PyramidView]  # Of one timestep


@dataclass(frozen=True)
class Sample:
    """What a view shows of N points: its camera's key, by level the channels (N, 3), light basis
    (N, 9) and weight (N,), 0 for what is hidden."""

    camera: bytes
    values: Sequence[np.ndarray]
    basis: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class Texture:
    """Appearance of N points without lighting.

    values  camera's key -> by level the channels (N, 3)
    lights  camera's key -> (9,) mean lighting
    trust   (N,) from 0 to 1: low for what looks different from view to view, as hair, hands and the
            mouth's inside
    """

    values: Mapping[bytes, Sequence[np.ndarray]]
    lights: Mapping[bytes, np.ndarray]
    trust: np.ndarray


def pyramid(
    camera: Camera, image: np.ndarray, center: np.ndarray, sizes: Sequence[float] = LEVELS_M
) -> list[Level]:
    """Levels of an image (H, W, 3) uint8: pixels of `sizes` meters at `center` (3,), or larger."""
    import cv2

    pixel = float(camera.project(center[None])[1][0]) / camera.fl_x
    levels: list[Level] = []
    for size in sizes:
        small = camera.scaled(min(1.0, max(pixel, 1e-9) / size))
        image = cv2.resize(image, (small.width, small.height), interpolation=cv2.INTER_AREA)
        colors = cv2.GaussianBlur(image.astype(np.float32) @ COLORS.T, (0, 0), BLUR_PX)
        brightness, redness = cv2.split(colors)
        detail = brightness - cv2.GaussianBlur(brightness, (0, 0), DETAIL_PX)
        levels.append(Level(small, cv2.merge([brightness, detail, redness])))
    return levels


def sampled(images: Sequence[np.ndarray], pixels: np.ndarray) -> list[np.ndarray]:
    """Values (N, K) of images (H, W, K) float32 of one size, K ≤ 4, at pixels (N, 2), or (N,) of
    images (H, W); those of the border outside."""
    import cv2

    if not len(pixels):
        return [np.zeros((0, *image.shape[2:]), np.float32) for image in images]
    at = np.clip(np.nan_to_num(pixels - 0.5, nan=-1.0), -1, images[0].shape[1::-1])
    split = np.array_split(at.astype(np.float32), max(1, -(-len(at) // MAX_SAMPLES)))
    parts = [(part[None, :, 0], part[None, :, 1]) for part in split]
    border: dict[str, Any] = {"interpolation": cv2.INTER_LINEAR, "borderMode": cv2.BORDER_REPLICATE}
    return [
        np.concatenate([cv2.remap(image, *part, **border)[0] for part in parts]) for image in images
    ]


def box_of(where: np.ndarray, margin: int) -> tuple[slice, slice]:
    """Rows and columns of the pixels (H, W) bool, with a margin around them; none without any."""
    sides = []
    for axis in (1, 0):
        used = np.flatnonzero(where.any(axis))
        first = max(0, used[0] - margin) if len(used) else 0
        sides.append(slice(first, used[-1] + 1 + margin if len(used) else 0))
    return sides[0], sides[1]


def mean_around(
    image: np.ndarray, known: np.ndarray, deviations: Sequence[float], places: np.ndarray
) -> np.ndarray:
    """(N, 3) float32 mean of the known pixels, (H, W) 0 or 1, around places (N, 2), rows and
    columns; the mean of those far away where none is near.

    deviations: standard deviations, in pixels, of the near and the far neighborhood.
    """
    import cv2

    # wide neighborhoods need few pixels
    scale = min(1.0, MIN_NEIGHBORHOOD_PX / deviations[0])
    small = tuple(max(1, round(scale * side)) for side in image.shape[1::-1])
    both = cv2.bitwise_and(image, image, mask=known), 255 * known
    weighted, weight = (reduced(plane, small) for plane in both)
    weighted = weighted.astype(np.float32)
    weight = weight.astype(np.float32) / 255
    total = np.zeros_like(weighted)
    norm = np.full_like(weight, 1e-9)
    for deviation, importance in zip(deviations, (1.0, FAR_WEIGHT), strict=True):
        sigma = max(0.7, scale * deviation)
        total += importance * cv2.GaussianBlur(weighted, (0, 0), sigma)
        norm += importance * cv2.GaussianBlur(weight, (0, 0), sigma)
    at = (places[:, ::-1] + 0.5) * (np.array(small) / image.shape[1::-1])
    return sampled([total / norm[..., None]], at)[0]


def reduced(image: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
    """The image at a smaller size: means over the areas of its pixels, by halves, which is fast."""
    import cv2

    while not any(
        side % 2 or side < 2 * s for side, s in zip(image.shape[1::-1], size, strict=True)
    ):
        half = image.shape[1] // 2, image.shape[0] // 2
        image = cv2.resize(image, half, interpolation=cv2.INTER_AREA)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def inside(camera: Camera, pixels: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """(N,) bool: pixels (N, 2) in the image, a pixel from its border, at a depth (N,) in front
    of the camera."""
    within = (pixels > 1) & (pixels < [camera.width - 1, camera.height - 1])
    return within.all(1) & (depth > 0)


def projection_derivative(camera: Camera, points: np.ndarray) -> np.ndarray:
    """(N, 2, 3): derivatives of the pixels of points (N, 3) by their positions."""
    turn = camera.rotation
    x, y, z = (points @ turn.T + camera.translation).T
    z = np.maximum(z, 1e-6)
    of_x = (camera.fl_x / z)[:, None] * (turn[0] - (x / z)[:, None] * turn[2])
    of_y = (camera.fl_y / z)[:, None] * (turn[1] - (y / z)[:, None] * turn[2])
    return np.stack([of_x, of_y], axis=1)


def flow_targets(at: np.ndarray, before: Views, now: Views) -> Any:
    """(key, camera, pixels (M, 2)) of each camera that saw both timesteps: the pixels to which
    optical flow (DIS, Kroeger et al. 2016) moves points at `at` (M, 3)."""
    import cv2

    opencv: Any = cv2  # whose type stubs lack DIS
    flow = opencv.DISOpticalFlow_create(opencv.DISOPTICAL_FLOW_PRESET_FAST)
    first = {view.key: view.levels[FLOW_LEVEL] for view in before}
    for view in now:
        level = view.levels[FLOW_LEVEL]
        old = first.get(view.key)
        shape = level.channels.shape
        if old is not None and old.channels.shape == shape and min(shape[:2]) >= MIN_FLOW_SIDE_PX:
            pixels, _ = old.camera.project(at)
            motion = flow.calc(old.luma, level.luma, None)
            yield view.key, level.camera, pixels + sampled([motion], pixels)[0]


def light_basis(normals: np.ndarray) -> np.ndarray:
    """(N, 9) spherical harmonics up to order 2 of unit normals (N, 3), unscaled."""
    x, y, z = normals.T
    second = [x * y, y * z, x * z, x * x - y * y, z * z - 1 / 3]
    return np.stack([np.ones(len(x)), x, y, z, *second], axis=1)


def shading(basis: np.ndarray, light: np.ndarray) -> np.ndarray:
    """(N, 1) factor of the texture."""
    return np.clip(basis @ light, MIN_SHADING, MAX_SHADING)[:, None]


def fitted_light(
    values: np.ndarray,
    texture: np.ndarray,
    basis: np.ndarray,
    weight: np.ndarray,
    expected: np.ndarray,
    scale: float = LIGHT_SCALE,
) -> np.ndarray:
    """(9,) lighting with which a texture has a view's luma, each column 0 of (N, 3): values ≈
    texture · (basis @ light).

    basis (N, 9), weight (N,); expected (9,): the prior. Robust beyond `scale` levels.
    """
    design = basis * texture[:, :1]
    target = values[:, 0]
    light = expected
    prior = LIGHT_PRIOR * float((weight * texture[:, 0] ** 2).sum() + 1) * np.eye(len(expected))
    for _ in range(LIGHT_ITERATIONS):
        weighted = design * (weight * robust(target - design @ light, scale))[:, None]
        light = np.linalg.solve(weighted.T @ design + prior, weighted.T @ target + prior @ expected)
    return light


def relit(
    values: np.ndarray,
    texture: np.ndarray,
    basis: np.ndarray,
    weight: np.ndarray,
    expected: np.ndarray,
) -> np.ndarray:
    """The texture (N, 3) in the lighting of a view; arguments as of `fitted_light`."""
    light = fitted_light(values, texture, basis, weight, expected)
    return texture * shading(basis, light)


def robust(residual: np.ndarray, scale: float) -> np.ndarray:
    """Geman-McClure weights."""
    return 1 / (1 + (residual / scale) ** 2) ** 2


def point_weights(residual: np.ndarray, level: int) -> np.ndarray:
    """(M,) weights of points whose channels differ from a view's by (M, 3) NOISE_LEVELS."""
    fraction = residual**2 @ CHANNEL_WEIGHTS / OUTLIER_SQUARED[level]
    return POINT_FRACTION / (1 + fraction) ** 2


def unexplained(
    residual: np.ndarray, level: int, weights: np.ndarray = CHANNEL_WEIGHTS
) -> np.ndarray:
    """(M,) from 0, images explain the points, to 1, for differences (M, 3) in NOISE_LEVELS."""
    squared = residual**2 @ weights
    return squared / (OUTLIER_SQUARED[level] + squared)


def flow_weights(miss: np.ndarray) -> np.ndarray:
    """(M,) weights of points that lie (M, 2) pixels from where optical flow moves them."""
    return FLOW_FRACTION * robust(np.linalg.norm(miss, axis=1), FLOW_SCALE_PX)


def average_texture(samples: Sequence[Sample]) -> Texture:
    """The texture that explains the views best, each under its own lighting.

    Texture and lighting are solved in turns, beginning with skin of one color. Robust against what
    hides the skin.
    """
    weight = np.stack([sample.weight for sample in samples])
    known = weight.sum(0) > MIN_OBSERVATIONS
    first = _robust_mean([sample.values[0] for sample in samples], weight)
    luma = np.tile(np.median(first[known if known.any() else ...], axis=0), (len(first), 1))
    lights = {sample.camera: np.eye(sample.basis.shape[1])[0] for sample in samples}
    lit = [sample.values for sample in samples]
    values = [luma]
    for number in range(TEXTURE_ITERATIONS):
        scale = TEXTURE_SCALE if number else ALBEDO_SCALE
        found = [
            fitted_light(s.values[0], values[0], s.basis, s.weight, lights[s.camera], scale)
            for s in samples
        ]
        for name in lights:
            camera_lights = [
                light for light, s in zip(found, samples, strict=True) if s.camera == name
            ]
            lights[name] = np.median(camera_lights, axis=0)
        factors = [shading(s.basis, light) for s, light in zip(samples, found, strict=True)]
        both = list(zip(samples, factors, strict=True))
        lit = [[level / factor for level in s.values] for s, factor in both]
        values = [
            _robust_mean([levels[level] for levels in lit], weight) for level in range(len(lit[0]))
        ]
    difference = np.abs(np.stack([levels[0] for levels in lit]) - values[0])[..., 1:].max(2)
    deviation = (weight * np.minimum(difference, MAX_DEVIATION_LEVELS)).sum(0)
    deviation = deviation / np.maximum(weight.sum(0), 1e-9)
    trust = np.where(known, 1 / (1 + (deviation / TEXTURE_SCALE) ** 2), 0.0)
    by_camera: dict[bytes, list[np.ndarray]] = {}
    for name in lights:  # what one camera sees, drawn to what all do
        rows = [row for row, sample in enumerate(samples) if sample.camera == name]
        fraction = weight[rows].sum(0)[:, None]
        by_camera[name] = []
        for level, every in enumerate(values):
            mean = _robust_mean([lit[row][level] for row in rows], weight[rows], every)
            mean = (fraction * mean + ALL_CAMERAS_PRIOR * every) / (fraction + ALL_CAMERAS_PRIOR)
            by_camera[name].append(mean)
    return Texture(by_camera, lights, trust)


def _robust_mean(
    values: Sequence[np.ndarray], weight: np.ndarray, start: np.ndarray | None = None
) -> np.ndarray:
    """(N, 3) mean of M values (N, 3) with weights (M, N), starting at the weighted median; outliers
    by detail and redness count less."""
    stacked = np.stack(values)
    mean = start
    if mean is None:
        order = np.argsort(stacked, axis=0)
        ordered = np.take_along_axis(stacked, order, axis=0)
        weights = np.repeat(weight[..., None], stacked.shape[2], 2)
        fraction = np.cumsum(np.take_along_axis(weights, order, axis=0), axis=0)
        middle = np.minimum((fraction < 0.5 * fraction[-1:]).sum(0), len(values) - 1)
        mean = np.take_along_axis(ordered, middle[None], axis=0)[0]
    for _ in range(MEAN_ITERATIONS):
        used = weight * robust(np.abs(stacked - mean)[..., 1:].max(2), MEAN_SCALE)
        total = (used[..., None] * stacked).sum(0)
        mass = used.sum(0)[:, None]
        mean = np.where(mass > 1e-6, total / np.maximum(mass, 1e-6), mean)
    return mean
