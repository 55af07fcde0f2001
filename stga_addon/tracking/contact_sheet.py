"""Contact sheet of a tracked take: errors of all views, and the mesh drawn over the worst."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ..capture.camera import Camera
from ..capture.mesh_geometry import rasterize, vertex_normals
from ..files import replacing
from .footage.model import Footage, FootageCamera

COLUMNS, ROWS = 4, 5
PICTURE = 200, 250
"""Width and height in pixels of a view; beside it stands the same with the mesh."""
GAP, CAPTION, MARGIN = 8, 18, 12
NAME_WIDTH, CELL_HEIGHT, MAX_CHART_ROWS = 130, 12, 48
HEAD_MARGIN = 0.08
"""Of the head's box in the image, on every side."""
MESH_OPACITY = 0.6
MATTE_COLOR, MATTE_OPACITY = (0, 150, 60), 0.75
"""Drawn over what lies outside a view's matte."""
BACKGROUND, TEXT, NO_FACE = (24, 26, 30), (225, 228, 232), (70, 74, 80)
ERROR_COLORS = np.array([(38, 130, 110), (240, 200, 70), (215, 50, 45)], float)
"""Of no error, half of the color scale and its end."""
COLOR_SCALE_END = 3.0
"""In medians of all errors."""

Errors = Mapping[str, Mapping[int, float]]
"""Camera -> timestep -> reprojection error in pixels; without an entry where no face was found."""


def write_contact_sheet(
    path: Path,
    footage: Footage,
    cameras: Mapping[str, Camera],
    mesh: Callable[[int], np.ndarray],
    faces: np.ndarray,
    errors: Errors,
    misfit: Errors | None = None,
) -> None:
    """Write a PNG: a chart of the errors, cameras down and timesteps across, and the worst views
    with the mesh. What lies outside a view's mask is green.

    cameras: name -> camera in the mesh's world. mesh: timestep -> (V, 3) vertices. faces (F, 3).
    misfit: region of the face -> timestep -> share of the images that is not explained; it is
    charted below, and counts as much as the reprojection error in which views are the worst. Raises
    StgaError where the file cannot be written or a frame cannot be read.
    """
    misfit = misfit or {}
    every = {(name, t): px for name, own in errors.items() for t, px in own.items()}
    unexplained = (
        {t: max(own.get(t, 0.0) for own in misfit.values()) for _, t in every} if misfit else {}
    )
    median = float(np.median(list(every.values()))) if every else 0.0
    usual = float(np.median(list(unexplained.values()))) if unexplained else 0.0

    def rank(view: tuple[str, int]) -> tuple[float, str, int]:
        return every[view] / max(median, 1e-9) + unexplained.get(view[1], 0.0) / max(
            usual, 1e-9
        ), *view

    shown = sorted(every, key=rank, reverse=True)[: COLUMNS * ROWS]
    by_name = {camera.name: camera for camera in footage.cameras}

    def picture(camera: FootageCamera, timestep: int) -> np.ndarray:
        return _without_outside(camera.image(timestep), camera.mask(timestep))

    tiles = [
        _tile(
            picture(by_name[name], t),
            cameras[name],
            mesh(t),
            faces,
            _caption(name, t, every, unexplained),
        )
        for name, t in shown
    ]
    rows = [(errors, median), (misfit, usual)] if misfit else [(errors, median)]
    with replacing(path) as partial:
        _sheet(_chart(rows, footage.timesteps), tiles, median).save(partial, format="PNG")


def _caption(
    name: str, timestep: int, errors: Mapping[tuple[str, int], float], misfit: Mapping[int, float]
) -> str:
    text = f"{name}, timestep {timestep}: {errors[name, timestep]:.1f} px"
    return f"{text}, {misfit[timestep]:.0%} unexplained" if timestep in misfit else text


def _sheet(chart: Image.Image, tiles: list[Image.Image], median: float) -> Image.Image:
    width, height = _tile_size()
    rows = -(-len(tiles) // COLUMNS)
    top = MARGIN + CAPTION + chart.height + MARGIN
    size = 2 * MARGIN + COLUMNS * (width + GAP) - GAP, top + rows * (height + GAP) + MARGIN
    sheet = Image.new("RGB", size, BACKGROUND)
    title = f"Reprojection error, median {median:.2f} px; red from {COLOR_SCALE_END * median:.1f} px, gray: no face"
    _write(sheet, (MARGIN, MARGIN), title)
    sheet.paste(chart, (MARGIN, MARGIN + CAPTION))
    for number, tile in enumerate(tiles):
        row, column = divmod(number, COLUMNS)
        sheet.paste(tile, (MARGIN + column * (width + GAP), top + row * (height + GAP)))
    return sheet


def _tile_size() -> tuple[int, int]:
    return 2 * PICTURE[0], PICTURE[1] + CAPTION


# Chart


def _chart(groups: Sequence[tuple[Errors, float]], timesteps: tuple[int, ...]) -> Image.Image:
    """A row a camera or region (of many, those with the largest errors), and a column a timestep;
    groups: errors and their median."""
    rows = [(name, own[name], median) for own, median in groups for name in _worst_rows(own)]
    width = COLUMNS * (_tile_size()[0] + GAP) - GAP
    chart = Image.new("RGB", (width, CELL_HEIGHT * len(rows)), BACKGROUND)
    for row, (name, errors, median) in enumerate(rows):
        _write(chart, (0, row * CELL_HEIGHT), name[-22:], CELL_HEIGHT - 3)
        cells = np.array([_error_color(errors.get(t), median) for t in timesteps], np.uint8)[None]
        strip = Image.fromarray(cells).resize(
            (width - NAME_WIDTH, CELL_HEIGHT - 1), Image.Resampling.NEAREST
        )
        chart.paste(strip, (NAME_WIDTH, row * CELL_HEIGHT))
    return chart


def _worst_rows(errors: Errors) -> list[str]:
    worst = {name: max(own.values(), default=0.0) for name, own in errors.items()}
    return sorted(
        sorted(worst, key=lambda name: -worst[name])[:MAX_CHART_ROWS], key=list(errors).index
    )


def _error_color(error: float | None, median: float) -> np.ndarray:
    if error is None:
        return np.array(NO_FACE)
    place = min(error / max(COLOR_SCALE_END * median, 1e-9), 1.0) * (len(ERROR_COLORS) - 1)
    return np.array(
        [np.interp(place, range(len(ERROR_COLORS)), channel) for channel in ERROR_COLORS.T]
    )


# Views


def _tile(
    image: np.ndarray, camera: Camera, vertices: np.ndarray, faces: np.ndarray, caption: str
) -> Image.Image:
    """The head in the image, beside it the same with the mesh; below, the caption."""
    left, top, right, bottom = head_box(camera, vertices)
    scale = min(PICTURE[0] / (right - left), PICTURE[1] / (bottom - top))
    cropped = replace(
        camera, width=right - left, height=bottom - top, cx=camera.cx - left, cy=camera.cy - top
    )
    small = cropped.scaled(scale)
    size, box = (small.width, small.height), (left, top, right, bottom)
    picture = Image.fromarray(image).resize(size, Image.Resampling.BICUBIC, box=box)
    tile = Image.new("RGB", _tile_size(), BACKGROUND)
    tile.paste(picture, (0, 0))
    tile.paste(
        Image.fromarray(with_mesh(np.asarray(picture), vertices, faces, small)), (PICTURE[0], 0)
    )
    _write(tile, (0, PICTURE[1] + 2), caption)
    return tile


def _without_outside(image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """The image (H, W, 3) uint8 with MATTE_COLOR over what lies outside the mask (H, W) uint8."""
    if mask is None:
        return image
    opacity = MATTE_OPACITY * (1 - mask[..., None].astype(np.float32) / 255)
    return np.asarray(image + opacity * (np.array(MATTE_COLOR) - image) + 0.5).astype(np.uint8)


def head_box(camera: Camera, vertices: np.ndarray) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of the head in the image; the whole image where it lies
    outside."""
    pixels, depth = camera.project(vertices)
    whole = 0, 0, camera.width, camera.height
    if not (depth > 0).all():
        return whole
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    margin = HEAD_MARGIN * (high - low)
    left, top = np.floor(np.maximum(low - margin, 0)).astype(int).tolist()
    right, bottom = (
        np.ceil(np.minimum(high + margin, [camera.width, camera.height])).astype(int).tolist()
    )
    return (left, top, right, bottom) if right > left and bottom > top else whole


def with_mesh(
    picture: np.ndarray, vertices: np.ndarray, faces: np.ndarray, camera: Camera
) -> np.ndarray:
    """The mesh over the picture, colored by the direction of its surface."""
    triangle, weights = rasterize(vertices, faces, camera)
    seen = triangle >= 0
    normals = vertex_normals(vertices, faces) @ camera.world_to_camera[:3, :3].T
    smooth = (normals[faces[triangle[seen]]] * weights[seen][..., None]).sum(axis=1)
    colors = 127.5 * (1 + smooth * [1, -1, -1])
    drawn = picture.astype(np.float64)
    drawn[seen] += MESH_OPACITY * (colors - drawn[seen])
    return np.asarray(np.clip(drawn, 0, 255).round(), np.uint8)


def _write(image: Image.Image, position: tuple[int, int], text: str, size: int = 12) -> None:
    font: Any = ImageFont.load_default(size)
    ImageDraw.Draw(image).text(position, text, fill=TEXT, font=font)
