"""Pictures of the head over the footage, shown while it is tracked; and the contact sheet of a
tracked take, with errors of all views and the mesh drawn over the worst."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ..capture.camera import Camera
from ..capture.mesh_geometry import rasterize, vertex_normals
from ..capture.model import evenly_spread
from ..errors import StgaError
from ..files import replacing
from .face_networks import FaceNetworks
from .fit import HeadFit, RecordedTake, TimestepLandmarks, determines_pose, fit_head, posed_mesh
from .footage.model import Footage
from .head_model import HeadModel

SIZE = 256
"""Width and height of a picture in pixels: Blender's icons are square."""
FIRST_CAMERAS = 3
"""Cameras in the picture of the first frame's fit, at most."""
PICTURE_FRAMES = 4
"""Frames of a picture at most, two in each direction."""
COLUMNS = 4
"""Views side by side on the contact sheet."""
ROWS = 5
"""Largest number of rows of views on the contact sheet."""
PICTURE = 200, 250
"""Width and height in pixels of a view; beside it stands the same with the mesh."""
GAP = 8
"""Distance between two tiles, in pixels."""
CAPTION = 18
"""Height of a line of text, in pixels."""
MARGIN = 12
"""Empty border of the contact sheet, and distance of the chart from the tiles, in pixels."""
TILE_SIZE = 2 * PICTURE[0], PICTURE[1] + CAPTION
"""Width and height in pixels of a view without and with the mesh, and their caption."""
NAME_WIDTH = 130
"""Width of the names to the left of the chart, in pixels."""
CELL_HEIGHT = 12
"""Height of a row of the chart, in pixels."""
MAX_CHART_ROWS = 48
"""Largest number of cameras, and of regions, in the chart."""
HEAD_MARGIN = 0.08
"""Margin of the head's box in the image on every side, as a fraction of the head."""
MESH_OPACITY = 0.6
"""Opacity of the mesh over a picture."""
MATTE_COLOR = (0, 150, 60)
"""Color over what lies outside a view's matte, RGB of 255."""
MATTE_OPACITY = 0.75
"""Opacity of MATTE_COLOR."""
BACKGROUND = (24, 26, 30)
"""Color of the contact sheet, RGB of 255."""
TEXT = (225, 228, 232)
"""Color of names and captions, RGB of 255."""
NO_FACE = (70, 74, 80)
"""Color in the chart of timesteps without a face, RGB of 255."""
ERROR_COLORS = np.array([(38, 130, 110), (240, 200, 70), (215, 50, 45)], float)
"""Colors of no error, half of the color scale and its end."""
COLOR_SCALE_END = 3.0
"""End of the color scale, in medians of all errors."""
Errors = Mapping[str, Mapping[int, float]]
"""Camera -> timestep -> reprojection error in pixels; without an entry where no face was found."""


@dataclass(frozen=True)
class PosedHead:
    """The head of a take in the world of its cameras.

    cameras  by name
    mesh     timestep -> vertices (V, 3)
    faces    (F, 3)
    """

    cameras: Mapping[str, Camera]
    mesh: Callable[[int], np.ndarray]
    faces: np.ndarray


def picture_of_first_frame(
    head: HeadModel, footage: Footage, detector: FaceNetworks, take: RecordedTake
) -> dict[str, np.ndarray] | None:
    """The head on the first frame, within seconds; None where no face, or several, are visible.
    take: one whose landmarks are not known yet."""
    timestep = footage.timesteps[0]
    seeing = [camera for camera in footage.cameras if timestep in camera.timesteps]
    seeing = evenly_spread(seeing, FIRST_CAMERAS)
    found = [(camera, detector.find(camera.image(timestep))) for camera in seeing]
    alone = [(camera.camera, faces[0]) for camera, faces in found if len(faces) == 1]
    if not alone:
        return None
    points = np.stack([face for _, face in alone])
    cameras = tuple(camera for camera, _ in alone)
    landmarks = TimestepLandmarks(cameras, points, np.ones(points.shape[:2]))
    neutral = take.places.on(head.model.v_template, head.model.faces)
    if not determines_pose(landmarks, take.reliable, neutral):
        return None
    with suppress(StgaError):  # the whole take may still be tracked, and says what is wrong
        return picture_of_fit(
            fit_head(head, replace(take, landmarks={timestep: landmarks})), footage
        )
    return None


def picture_of_fit(fit: HeadFit, footage: Footage) -> dict[str, np.ndarray]:
    """The head on a few of the frames that it was fitted to, black beyond an image, and its mesh in
    the first of them: `rgb`, `vertices` and `faces`."""
    timesteps = evenly_spread(sorted(fit.parameters), PICTURE_FRAMES)
    columns = 2 if len(timesteps) == PICTURE_FRAMES else 1
    side = SIZE // columns
    faces = fit.head.model.faces
    picture = np.zeros((SIZE, SIZE, 3), np.uint8)
    for number, timestep in enumerate(timesteps[: columns**2]):
        source = next(camera for camera in footage.cameras if timestep in camera.timesteps)
        camera = fit.to_capture.camera(source.camera)
        vertices = posed_mesh(fit, fit.parameters[timestep])
        left, top, right, bottom = _head_box(camera, vertices)
        size = max(right - left, bottom - top)
        left = (left + right - size) // 2
        top = (top + bottom - size) // 2
        cut = _cropped(camera, left, top, size, size, side / size)
        image = Image.fromarray(source.image(timestep))
        cropped = image.crop((left, top, left + size, top + size))
        small = cropped.resize((cut.width, cut.height), Image.Resampling.BILINEAR)
        drawn = with_mesh(np.asarray(small), vertices, faces, cut)
        row = side * (number // columns)
        column = side * (number % columns)
        square = np.asarray(Image.fromarray(drawn).resize((side, side)))
        picture[row : row + side, column : column + side] = square
    vertices = posed_mesh(fit, fit.parameters[timesteps[0]])
    return {"rgb": picture, "vertices": vertices, "faces": faces}


def write_contact_sheet(
    path: Path,
    footage: Footage,
    head: PosedHead,
    errors: Errors,
    misfit: Errors | None = None,
) -> None:
    """Write a PNG: a chart of the errors, cameras down and timesteps across, and the worst views
    with the mesh. What lies outside a view's mask is green.

    misfit: region of the face -> timestep -> fraction of the images that is not explained; it is
    charted below, and counts as much as the reprojection error in which views are the worst. Raises
    StgaError where the file cannot be written or a frame cannot be read.
    """
    misfit = misfit or {}
    every = {(name, t): px for name, by_timestep in errors.items() for t, px in by_timestep.items()}
    unexplained = {
        t: max(by_timestep.get(t, 0.0) for by_timestep in misfit.values())
        for _, t in every
        if misfit
    }
    median = float(np.median(list(every.values()))) if every else 0.0
    typical = float(np.median(list(unexplained.values()))) if unexplained else 0.0

    def rank(view: tuple[str, int]) -> tuple[float, str, int]:
        by_images = unexplained.get(view[1], 0.0) / max(typical, 1e-9)
        return every[view] / max(median, 1e-9) + by_images, *view

    chart = _chart([(errors, median), (misfit, typical)], footage.timesteps)
    drawn = sorted(every, key=rank, reverse=True)[: COLUMNS * ROWS]
    (width, height) = TILE_SIZE
    top = MARGIN + CAPTION + chart.height + MARGIN
    lines = -(-len(drawn) // COLUMNS)
    size = 2 * MARGIN + COLUMNS * (width + GAP) - GAP, top + lines * (height + GAP) + MARGIN
    sheet = Image.new("RGB", size, BACKGROUND)
    red = f"red from {COLOR_SCALE_END * median:.1f} px, gray: no face"
    _write(sheet, (MARGIN, MARGIN), f"Reprojection error, median {median:.2f} px; {red}")
    sheet.paste(chart, (MARGIN, MARGIN + CAPTION))
    by_name = {camera.name: camera for camera in footage.cameras}
    for number, (name, t) in enumerate(drawn):
        image = by_name[name].image(t)
        mask = by_name[name].mask(t)
        if mask is not None:
            opacity = MATTE_OPACITY * (1 - mask[..., None].astype(np.float32) / 255)
            image = (image + opacity * (np.array(MATTE_COLOR) - image) + 0.5).astype(np.uint8)
        caption = f"{name}, timestep {t}: {every[name, t]:.1f} px"
        caption += f", {unexplained[t]:.0%} unexplained" if t in unexplained else ""
        row, column = divmod(number, COLUMNS)
        tile = _tile(image, head.cameras[name], head.mesh(t), head.faces, caption)
        sheet.paste(tile, (MARGIN + column * (width + GAP), top + row * (height + GAP)))
    with replacing(path) as partial:
        sheet.save(partial, format="PNG")


def _chart(groups: Sequence[tuple[Errors, float]], timesteps: tuple[int, ...]) -> Image.Image:
    """A row a camera or region, of many those with the largest errors, and a column a timestep;
    each group of errors in multiples of its median."""
    rows = []
    for errors, median in groups:
        worst = sorted(errors, key=lambda name: -max(errors[name].values(), default=0.0))
        charted = [name for name in errors if name in worst[:MAX_CHART_ROWS]]
        rows += [(name, errors[name], max(median, 1e-9 / COLOR_SCALE_END)) for name in charted]
    width = COLUMNS * (TILE_SIZE[0] + GAP) - GAP
    chart = Image.new("RGB", (width, CELL_HEIGHT * len(rows)), BACKGROUND)
    stops = np.linspace(0, COLOR_SCALE_END, len(ERROR_COLORS))
    for row, (name, by_timestep, median) in enumerate(rows):
        _write(chart, (0, row * CELL_HEIGHT), name[-22:], CELL_HEIGHT - 3)
        cells = np.empty((1, len(timesteps), 3), np.uint8)
        for column, timestep in enumerate(timesteps):
            fraction = by_timestep.get(timestep, 0.0) / median
            color = [np.interp(fraction, stops, channel) for channel in ERROR_COLORS.T]
            cells[0, column] = color if timestep in by_timestep else NO_FACE
        size = width - NAME_WIDTH, CELL_HEIGHT - 1
        strip = Image.fromarray(cells).resize(size, Image.Resampling.NEAREST)
        chart.paste(strip, (NAME_WIDTH, row * CELL_HEIGHT))
    return chart


def _tile(
    image: np.ndarray, camera: Camera, vertices: np.ndarray, faces: np.ndarray, caption: str
) -> Image.Image:
    """The head in the image, beside it the same with the mesh; below, the caption."""
    box = left, top, right, bottom = _head_box(camera, vertices)
    scale = min(PICTURE[0] / (right - left), PICTURE[1] / (bottom - top))
    small = _cropped(camera, left, top, right - left, bottom - top, scale)
    size = small.width, small.height
    picture = Image.fromarray(image).resize(size, Image.Resampling.BICUBIC, box=box)
    over = with_mesh(np.asarray(picture), vertices, faces, small)
    tile = Image.new("RGB", TILE_SIZE, BACKGROUND)
    tile.paste(picture, (0, 0))
    tile.paste(Image.fromarray(over), (PICTURE[0], 0))
    _write(tile, (0, PICTURE[1] + 2), caption)
    return tile


def _cropped(camera: Camera, left: int, top: int, width: int, height: int, scale: float) -> Camera:
    """The camera of a part of its image, scaled."""
    cx = camera.cx - left
    cy = camera.cy - top
    return replace(camera, width=width, height=height, cx=cx, cy=cy).scaled(scale)


def _head_box(camera: Camera, vertices: np.ndarray) -> tuple[int, int, int, int]:
    """Left, top, right, bottom of the head in the image; the whole image where it is outside."""
    pixels, depth = camera.project(vertices)
    whole = 0, 0, camera.width, camera.height
    if not (depth > 0).all():
        return whole
    low = pixels.min(axis=0)
    high = pixels.max(axis=0)
    margin = HEAD_MARGIN * (high - low)
    left, top = np.floor(np.maximum(low - margin, 0)).astype(int).tolist()
    right, bottom = np.ceil(np.minimum(high + margin, whole[2:])).astype(int).tolist()
    return (left, top, right, bottom) if right > left and bottom > top else whole


def with_mesh(
    picture: np.ndarray, vertices: np.ndarray, faces: np.ndarray, camera: Camera
) -> np.ndarray:
    """The mesh over the picture, colored by the direction of its surface."""
    triangle, weights = rasterize(vertices, faces, camera)
    covered = triangle >= 0
    normals = vertex_normals(vertices, faces) @ camera.rotation.T
    smooth = (normals[faces[triangle[covered]]] * weights[covered][..., None]).sum(axis=1)
    colors = 127.5 * (1 + smooth * [1, -1, -1])
    drawn = picture.astype(np.float64)
    drawn[covered] += MESH_OPACITY * (colors - drawn[covered])
    return np.asarray(np.clip(drawn, 0, 255).round(), np.uint8)


def _write(image: Image.Image, position: tuple[int, int], text: str, size: int = 12) -> None:
    font: Any = ImageFont.load_default(size)
    ImageDraw.Draw(image).text(position, text, fill=TEXT, font=font)
