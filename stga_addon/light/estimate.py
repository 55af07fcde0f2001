"""The light of a capture, from its images and meshes."""

from dataclasses import dataclass

import numpy as np

from ..avatar.file import AvatarLight
from ..capture.color import srgb_to_linear
from ..capture.images import read_view
from ..capture.mesh_geometry import connected_parts, facing, pixels_of, triangle_normals
from ..capture.model import Capture, View, ViewExposure, evenly_spread, views_by_timestep
from ..errors import StgaError
from ..flame.quaternions import unit
from ..progress import Progress, Report, ignore
from .harmonics import COUNT, DARK, LAMBERT, basis, least_squares, uniform
from .lamps import ShadowMap
from .surface import Bounce, transfer_of
from .values import HAIR_ROUGHNESS, Light

MAX_TIMESTEPS = 10
"""Timesteps, evenly spread, whose images are read."""
MAX_CAMERAS = 12
"""Cameras, evenly spread, whose images are read."""
MAX_SIDE_PX = 800
"""Size that larger images are reduced to."""
MIN_FACING = 0.35
"""Least cosine between a triangle's normal and the direction to the camera."""
HIDDEN_M = 0.003
"""A triangle is hidden by what is nearer to the camera by as much."""
POINTS = (np.eye(3) + 1 / 3) / 2
"""(3, 3) barycentric coordinates of the points of a triangle whose pixels are read."""
SATURATED_LEVEL = 252
"""Level of 255 from which a channel holds no information."""
DARK_LEVEL = 4
"""Level of 255 up to which it holds none."""


def observe(
    capture: Capture, times: dict[int, list[View]], exposure: ViewExposure, report: Report
) -> tuple[np.ndarray, np.ndarray]:
    """Mean linear color (T, F, 3) of triangles in the darker half of the cameras that face them
    (fewest highlights), NaN where none does; and how many (T, F) do. times: the views of each."""
    colors = []
    cameras = []
    for n, (time, views) in enumerate(times.items()):
        report(Progress(n / (len(times) + ITERATIONS), "Estimating the light"))
        mesh = np.asarray(capture.mesh(time), np.float64)
        view_colors = np.stack(
            [_view_colors(capture, mesh, view, exposure(view)) for view in views]
        )
        ordered = np.sort(view_colors, axis=0)  # NaN comes last
        count = np.isfinite(view_colors[..., :1]).sum(0)
        taken = np.arange(len(view_colors))[:, None, None] < (count + 1) // 2
        total = np.where(taken, np.nan_to_num(ordered), 0).sum(0)
        colors.append(np.where(count > 0, total / np.maximum((count + 1) // 2, 1), np.nan))
        cameras.append(np.isfinite(view_colors[..., 0]).sum(0))
    return np.stack(colors), np.stack(cameras)


def _view_colors(
    capture: Capture, mesh: np.ndarray, view: View, exposure: np.ndarray | None
) -> np.ndarray:
    """(F, 3) mean linear color of triangles, exposure undone; NaN where hidden or aslant."""
    gain, offset = np.eye(2)[:, :1] if exposure is None else exposure
    scale = min(1.0, MAX_SIDE_PX / max(view.camera.width, view.camera.height))
    view, image, mask = read_view(view, scale)
    level = image.max(2)
    usable = (level < SATURATED_LEVEL) & (level > DARK_LEVEL)
    if mask is not None:
        # without pixels within two of the mask's border
        inside = np.pad(mask > 127, 2)
        (height, width) = mask.shape
        for y, x in ((0, 2), (4, 2), (2, 0), (2, 4), (1, 1), (1, 3), (3, 1), (3, 3)):
            usable &= inside[y : y + height, x : x + width]
    corners = mesh[capture.faces]
    middle = corners.mean(1)
    visible = facing(view.camera, middle, unit(triangle_normals(corners), 1e-20)) > MIN_FACING
    depths = ShadowMap(mesh, capture.faces, Light("point", np.ones(3), view.camera.position))
    visible &= depths.lit(middle, HIDDEN_M, step=0) > 0.5
    total = np.zeros((len(visible), 3))
    count = np.zeros((len(visible), 1))
    for weights in POINTS:
        points = np.einsum("k,fkc->fc", weights, corners)
        column, row, inside = pixels_of(points, view.camera)
        inside &= visible & usable[row, column]
        color = np.clip((image[row, column] - offset) / gain, 0, 255)
        total += np.where(inside[:, None], srgb_to_linear(color / 255), 0)
        count += inside[:, None]
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


ITERATIONS = 40
"""Reweighted least squares fits of light and albedo."""
PRIOR = 0.7
"""Weight of alike albedos, in observations of a triangle at every timestep."""
POSED_DIRECTIONS = 96
"""Directions by which the transfer of a posed mesh is found, at each timestep."""
UNSEEN_WEIGHT = 1e-3
"""Weight of a timestep at which no camera observes a vertex, where each camera counts 1."""
MIN_OPEN_TRANSFER = 0.35 * np.pi * 0.28209479177387814
"""Transfer of the constant harmonic below which a triangle lies in its shadow."""
LOSS_SCALE = 3.0
"""Residual at which an observation's weight has halved, in medians."""
RIDGE = 1e-4
"""Ridge of the light's least squares, as a fraction (`harmonics.least_squares`)."""

MIN_ARRIVING = 0.02
"""Least irradiance that a color is divided by, as a fraction of the mean."""
TYPICAL_ALBEDO = 0.36
"""Albedo of skin (green): the level of an estimated light, until it is corrected."""
HARD_RESIDUAL = 0.12
"""Residual from which the light is too hard to be removed."""
VERY_HARD_RESIDUAL = 0.25
"""Residual from which albedo is damped most."""
MAX_DAMPING = 0.6
"""Damping of albedo, 0 to 1, at VERY_HARD_RESIDUAL and above."""
CARD_REFLECTANCE = 0.18
"""Reflectance of photographers' gray card."""

HAIR_BRIGHTNESS = 1 / 3
"""Albedo, as a fraction of the nose's, below which triangles show hair, brows or dark cloth."""
EYE_ROUGHNESS = 0.2
"""Roughness of eyes, whose highlights are as sharp as splats of half a millimeter can show."""
MIN_RADIUS_M = 0.007
"""Least radius of an eyeball."""
MAX_RADIUS_M = 0.017
"""Largest radius of an eyeball."""
MAX_DEVIATION = 0.12
"""Fraction of the radius by which the vertices of an eyeball may leave the sphere, on average."""
MIN_VERTICES = 24


@dataclass(frozen=True)
class Known:
    """What is known of a capture's light and cameras.

    radiance   (9, 3) harmonics in the capture's axes; None: estimated
    card       (K, 3) linear colors of a gray card of 18 % at the face that faces `toward`, or of a
               gray ball where that is its normal; None: the level is unknown
    toward     (K, 3) unit vectors
    exposure   gain and offset of images
    """

    radiance: np.ndarray | None = None
    card: np.ndarray | None = None
    toward: np.ndarray | None = None
    exposure: ViewExposure = lambda view: None


def estimate_light(
    capture: Capture,
    known: Known = Known(),
    report: Report = ignore,
    hair: np.ndarray | None = None,
) -> AvatarLight:
    """The light of the capture and how its head receives it. hair (F,) bool: triangles with hair,
    beside those that are as dark; None: unknown. Raises StgaError without views."""
    by_time = views_by_timestep(capture.views.get("train", ()))
    if not by_time:
        raise StgaError(
            f"{capture.root}: has no training views, from which its light could be estimated"
        )
    chosen = evenly_spread(sorted(by_time), MAX_TIMESTEPS)
    faces = capture.faces
    times = {time: evenly_spread(by_time[time], MAX_CAMERAS) for time in chosen}
    transfer, occlusion = transfer_of(capture.neutral, faces)
    color, cameras = observe(capture, times, known.exposure, report)
    posed = np.stack([transfer_of(capture.mesh(t), faces, POSED_DIRECTIONS)[0] for t in times])
    radiance, residual = fit_light(color, posed[:, faces].mean(2), known.radiance)
    source = "estimated"
    if known.radiance is not None:
        source = "file"
    elif known.card is not None:
        assert known.toward is not None
        # At the level and white balance at which gray that faces `toward` shows the card's colors.
        arriving = np.maximum((basis(known.toward) * LAMBERT @ radiance).mean(0), 1e-6)
        radiance = radiance * (np.pi * known.card.mean(0) / CARD_REFLECTANCE / arriving)
        source = "gray_card"
    bounce = Bounce(capture.neutral, faces, occlusion)
    direct = np.maximum(posed @ radiance, DARK)
    irradiance = recorded_irradiance(direct, cameras, faces, bounce)
    hardness = (residual - HARD_RESIDUAL) / (VERY_HARD_RESIDUAL - HARD_RESIDUAL)
    damping = MAX_DAMPING * float(np.clip(hardness, 0, 1))
    dark = dark_triangles(color, irradiance[faces].mean(1), capture.regions.get("nose"))
    return AvatarLight(
        radiance=radiance.astype(np.float32),
        transfer=transfer,
        occlusion=occlusion,
        irradiance=irradiance.astype(np.float32),
        roughness=roughness_of(capture.neutral, faces, dark if hair is None else dark | hair),
        residual=residual,
        damping=round(damping, 3),
        source=source,
    )


def recorded_irradiance(
    direct: np.ndarray, cameras: np.ndarray, faces: np.ndarray, bounce: Bounce
) -> np.ndarray:
    """(V, 3): mean of direct (T, V, 3) and of skin around; each timestep counts as many times as
    cameras (T, F) see the vertex: teeth in an open mouth."""
    total = np.zeros(direct.shape[1:])
    count = np.zeros((direct.shape[1], 1))
    for arriving, observed in zip(direct, cameras, strict=True):
        views = np.bincount(faces.ravel(), np.repeat(observed, 3), len(arriving))
        weight = views[:, None] + UNSEEN_WEIGHT
        total += weight * (arriving + bounce.light(arriving))
        count += weight
    return total / count


def fit_light(
    color: np.ndarray, received: np.ndarray, given: np.ndarray | None = None
) -> tuple[np.ndarray, float]:
    """Radiance (9, 3) and residual, by linear colors (T, F, 3) of triangles, NaN where they are not
    seen; received (T, F, 9): transfer of the posed triangles. given: only the residual is new.
    Minimizes Σ w (color − albedo · transfer · radiance)², alternating between light and albedo,
    which is drawn to the median; w are the Cauchy loss's. The median albedo is TYPICAL_ALBEDO in an
    even, white light: mean irradiance is the same in all channels."""
    times, faces = color.shape[:2]
    usable = np.isfinite(color[..., 0]) & (received[..., 0] > MIN_OPEN_TRANSFER)
    if usable.sum() < 10 * COUNT:
        raise StgaError("light: too few triangles are seen in the images to estimate it")
    color = color[usable]
    received = received[usable].astype(np.float64)
    face = np.broadcast_to(np.arange(faces), usable.shape)[usable]
    radiance = np.array(uniform(np.ones(3) / np.pi) if given is None else given)
    typical = np.empty(3)
    error = np.empty_like(color)
    for k, observed in enumerate(color.T):
        weight = np.ones_like(observed)
        for _ in range(ITERATIONS):
            arriving = received @ radiance[:, k]
            arriving = np.maximum(arriving, max(MIN_ARRIVING * arriving.mean(), DARK))
            typical[k] = max(np.median(observed / arriving), DARK)
            prior = PRIOR * times * (arriving**2).mean()
            upper = np.bincount(face, weight * observed * arriving, faces) + prior * typical[k]
            albedo = (upper / (np.bincount(face, weight * arriving**2, faces) + prior))[face]
            error[:, k] = np.abs(observed - albedo * arriving)
            scale = LOSS_SCALE * np.median(error[:, k]) + 1e-9
            weight = 1 / (1 + (error[:, k] / scale) ** 2)
            if given is None:
                root = np.sqrt(weight)
                rows = received * (albedo * root)[:, None]
                radiance[:, k] = least_squares(rows, observed * root, RIDGE)
    residual = float(1.4826 * np.median(error / np.maximum(color, 1e-3)))
    if given is None:
        mean = (received @ radiance).mean(0)
        radiance = radiance / np.maximum(mean, DARK) * (typical * mean)[1] * np.pi / TYPICAL_ALBEDO
    return radiance, residual


def dark_triangles(
    color: np.ndarray, irradiance: np.ndarray, nose: np.ndarray | None
) -> np.ndarray:
    """(F,) bool: triangles darker than HAIR_BRIGHTNESS, by linear colors (T, F, 3), NaN where they
    are not seen, and the light that they received (F, 3); none where no nose (F,) bool is."""
    observed = np.isfinite(color[..., :1])
    mean = np.where(observed, color, 0).sum(0) / np.maximum(observed.sum(0), 1)
    albedo = np.where(observed.any(0), mean / np.maximum(irradiance, DARK), np.nan).mean(1)
    if nose is None or not np.isfinite(albedo[nose]).any():
        return np.zeros(len(albedo), bool)
    return np.asarray(albedo < HAIR_BRIGHTNESS * np.nanmedian(albedo[nose]))


def roughness_of(
    neutral: np.ndarray, faces: np.ndarray, hair: np.ndarray | None = None
) -> np.ndarray:
    """(V,) float32: EYE_ROUGHNESS on eyeballs: parts that are nearly spheres of an eye's size;
    HAIR_ROUGHNESS within the triangles of hair (F,) bool; else 0."""
    part = connected_parts(len(neutral), faces)
    found = np.zeros(len(neutral), np.float32)
    if hair is not None:
        found[faces[hair]] = HAIR_ROUGHNESS
        found[faces[~hair]] = 0
    used = np.zeros(len(neutral), bool)
    used[faces] = True
    for label in np.unique(part[used]):
        members = used & (part == label)
        if members.sum() < MIN_VERTICES:
            continue
        points = neutral[members].astype(np.float64)  # on a sphere with the least squared error
        rows = np.concatenate([2 * points, np.ones((len(points), 1))], axis=1)
        *center, rest = np.linalg.lstsq(rows, (points**2).sum(1), rcond=None)[0]
        radius = np.sqrt(max(rest + np.dot(center, center), 0))
        deviation = np.abs(np.linalg.norm(points - center, axis=1) - radius).mean()
        if MIN_RADIUS_M < radius < MAX_RADIUS_M and deviation < MAX_DEVIATION * radius:
            found[members] = EYE_ROUGHNESS
    return found
