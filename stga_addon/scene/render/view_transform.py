"""Scene-linear colors of splats: the inverse of a view transform, measured by a picture of a grid
of colors; and what lies behind splats."""

import tempfile
import threading
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import Any

import bpy
import numpy as np

from ...capture.color import linear_to_srgb, srgb_to_linear
from ..compat import REC709, choose_format, working_space
from ..light import world_light

DATA_VIEWS = ("Raw", "False Color", "Log", "Filmic Log")
"""View transforms that show data instead of colors; they are left alone."""
GRID = 41
"""Samples along an axis of the table measured."""
INVERSE_GRID = 25
"""Samples along an axis of its inverse."""
DARKEST = -14.0
"""Log2 of the darkest scene-linear sample after 0."""
BRIGHTEST = 6.0
"""Log2 of the brightest one."""
RAMP = 1024
"""Grays that are measured first, evenly spread in log2, to place the samples between them."""
STEP_WEIGHT = 0.5
"""Weight of steps of the shown gray against steps in log2 where samples are placed."""
INVERSE_STEPS = 15
"""Damped Gauss-Newton steps to a color of the inverse."""
MAX_STEP = 4
"""Longest of these steps, in samples."""
DAMPING = 1e-3
"""Damping of these steps where colors hardly change."""
CHUNK = 1 << 16  # pixels converted at a time, which bounds the memory
MAIN_THREAD_TIMEOUT_S = 10.0
MAX_MEASURED = 8  # inverses that are kept, of a megabyte each

_measured: dict[tuple[Any, ...], "InverseView"] = {}


class InverseView:
    """The inverse of a view transform. displayed: (G, G, G, 3) sRGB 0…1 of the scene-linear colors
    whose red, green and blue are `axis` (G,)."""

    def __init__(self, axis: np.ndarray, displayed: np.ndarray) -> None:
        self._axis = axis
        self._displayed = displayed
        nodes = np.linspace(0, 1, INVERSE_GRID) ** 2  # denser in the dark
        target = np.stack(np.meshgrid(nodes, nodes, nodes, indexing="ij"), -1).reshape(-1, 3)
        # Places in samples that show `target` best, by damped Gauss-Newton steps.
        last = len(axis) - 1
        grays = np.maximum.accumulate(np.einsum("iiic->ci", displayed), axis=1)
        by_channel = zip(target.T, grays, strict=True)
        place = np.stack([np.interp(t, gray, np.arange(last + 1)) for t, gray in by_channel], 1)
        slopes = np.stack(np.gradient(displayed, axis=(0, 1, 2)), -1).reshape(
            *displayed.shape[:3], 9
        )
        for _ in range(INVERSE_STEPS):
            rest = interpolate(displayed, place) - target
            jacobian = interpolate(slopes, place).reshape(-1, 3, 3)
            transposed = jacobian.transpose(0, 2, 1)
            normal = transposed @ jacobian + DAMPING * np.eye(3)
            step = np.linalg.solve(normal, transposed @ rest[..., None])[..., 0]
            place = np.clip(place - np.clip(step, -MAX_STEP, MAX_STEP), 0, last)
        self._inverse = place.reshape(*(INVERSE_GRID,) * 3, 3)

    def show(self, linear: np.ndarray) -> np.ndarray:
        """sRGB (…, 3) that the view transform shows of scene-linear colors."""
        place = np.interp(linear, self._axis, np.arange(len(self._axis)))
        return interpolate(self._displayed, place.reshape(-1, 3)).reshape(linear.shape)

    def to_linear(self, srgb: np.ndarray) -> np.ndarray:
        """Scene-linear colors (…, 3) float32 that are shown as `srgb`, or most nearly so."""
        flat = np.sqrt(np.clip(srgb, 0, 1)).reshape(-1, 3) * (INVERSE_GRID - 1)
        linear = np.empty(flat.shape, np.float32)
        for begin in range(0, len(flat), CHUNK):
            place = interpolate(self._inverse, flat[begin : begin + CHUNK])
            linear[begin : begin + CHUNK] = np.interp(place, np.arange(len(self._axis)), self._axis)
        return linear.reshape(srgb.shape)


def interpolate(table: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Values (M, C) of a table (G, G, G, C) at places (M, 3) in samples, trilinearly."""
    size = len(table)
    low = np.minimum(place.astype(np.int64), size - 2)
    part = place - low
    values = np.zeros((len(place), table.shape[3]))
    for corner in product((0, 1), repeat=3):
        weight = np.prod(np.where(corner, part, 1 - part), axis=1)
        values += weight[:, None] * table[tuple((low + corner).T)]
    return values


def keeps_colors(scene: Any) -> bool:
    """Whether the scene's color management shows scene-linear Rec. 709 as sRGB."""
    view = scene.view_settings
    plain = view.view_transform == "Standard" and view.look == "None" and not view.use_curve_mapping
    balanced = not getattr(view, "use_white_balance", False)  # from Blender 4.3 on
    even = view.exposure == 0 and view.gamma == 1
    return bool(plain and balanced and even and working_space() == REC709)


def needs_inverse(scene: Any) -> bool:
    """Whether the scene's color management changes colors, and shows colors at all."""
    return not keeps_colors(scene) and scene.view_settings.view_transform not in DATA_VIEWS


def inverse_view(scene: Any) -> InverseView | None:
    """The inverse of the scene's view transform as `measure` found it, None where it did not."""
    return _measured.get(_settings(scene))


def measure(scene: Any) -> None:
    """Find `inverse_view` if it is needed, before rendering: in Blender's render thread, which
    waits for the main thread, as only that may change data; not once the engine has the GPU."""
    key = _settings(scene)
    if key in _measured:
        _keep(key, _measured[key])
    if key in _measured or not needs_inverse(scene):
        return
    measured = threading.Event()

    def work() -> None:
        try:
            _keep(key, _inverse(scene))
        finally:
            measured.set()

    if threading.current_thread() is threading.main_thread():
        work()
    else:
        bpy.app.timers.register(work)
        measured.wait(MAIN_THREAD_TIMEOUT_S)


def _keep(key: tuple[Any, ...], view: InverseView) -> None:
    """Keep the newest few: an animated exposure would pile them up."""
    global _measured
    kept = {other: value for other, value in _measured.items() if other != key}
    # Another thread may be reading the dictionary, which is therefore replaced as a whole.
    _measured = dict([*kept.items(), (key, view)][-MAX_MEASURED:])


def _settings(scene: Any) -> tuple[Any, ...]:
    """What the view transform depends on, less the display device."""
    view = scene.view_settings
    settings = _scalars(view)
    if view.use_curve_mapping:
        curves = view.curve_mapping
        settings += [*_scalars(curves), *curves.black_level, *curves.white_level]
        points = [point for curve in curves.curves for point in curve.points]
        settings += [(*point.location, point.handle_type) for point in points]
    return working_space(), *settings


def _scalars(data: Any) -> list[Any]:
    """The values of its properties that are one number, switch or name."""
    every = [each for each in data.bl_rna.properties if each.type in {"BOOLEAN", "FLOAT", "ENUM"}]
    names = [each.identifier for each in every if not getattr(each, "is_array", False)]
    return [getattr(data, name) for name in names]


def _inverse(scene: Any) -> InverseView:
    axis = _axis(scene)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    displayed = _displayed(scene, grid.reshape(GRID**2, GRID, 3))
    return InverseView(axis, displayed.reshape(grid.shape))


def _axis(scene: Any) -> np.ndarray:
    """(GRID,) scene-linear samples, ascending from 0: denser where grays are shown that differ
    more, as just above the black level of curves."""
    stops = np.linspace(DARKEST, BRIGHTEST, RAMP - 1) - scene.view_settings.exposure
    ramp = np.append(0, 2**stops)
    displayed = _displayed(scene, np.repeat(ramp[None, :, None], 3, axis=2))[0]
    steps = np.abs(np.diff(displayed, axis=0)).max(axis=1)
    even = np.full(len(steps), 1 / len(steps))
    total = np.cumsum(even + STEP_WEIGHT * steps / max(steps.sum(), 1e-12))
    place = np.interp(np.linspace(0, total[-1], GRID), np.append(0, total), np.arange(RAMP))
    return np.interp(place, np.arange(RAMP), ramp)


def _displayed(scene: Any, linear: np.ndarray) -> np.ndarray:
    """(H, W, 3) sRGB 0…1 that an sRGB display shows of scene-linear colors (H, W, 3)."""
    height, width, _ = linear.shape
    pixels = np.ones((height, width, 4), np.float32)
    pixels[..., :3] = linear
    copy = scene.copy()
    settings = copy.render.image_settings
    images = [bpy.data.images.new("view transform", width, height, float_buffer=True)]
    try:
        images[0].colorspace_settings.name = working_space()
        images[0].pixels.foreach_set(pixels.ravel())
        settings.color_management = "FOLLOW_SCENE"
        copy.display_settings.display_device = "sRGB"
        for name in ("view_transform", "look"):  # which the display may have changed
            with suppress(TypeError):  # there is no such one for this display
                setattr(copy.view_settings, name, getattr(scene.view_settings, name))
        choose_format(settings, "IMAGE", "PNG")
        settings.color_mode = "RGB"
        settings.color_depth = "16"
        copy.render.dither_intensity = 0
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "shown.png"
            images[0].save_render(str(path), scene=copy)
            images.append(bpy.data.images.load(str(path)))
            images[1].colorspace_settings.name = "Non-Color"
            images[1].pixels.foreach_get(pixels.ravel())
        return pixels[..., :3]
    finally:
        for image in images:
            bpy.data.images.remove(image)
        bpy.data.scenes.remove(copy)


MIN_VISIBLE = 1e-6
"""Fraction of a pixel below which its color does not matter."""


def combined(
    rgb: np.ndarray,
    alpha: np.ndarray,
    background: tuple[float, ...] | None,
    view: InverseView | None = None,
    hidden: np.ndarray | float = 0.0,
) -> np.ndarray:
    """(H, W, 4) scene-linear RGBA, premultiplied, of splats rendered on black: sRGB rgb (3, H, W),
    alpha (H, W). Splats are blended in sRGB, so `background`, scene-linear (3,), is added as the
    sRGB that it is shown as; None: transparent, colors as if they covered their pixels. view: None
    where the view transform shows sRGB as it is. hidden (H, W): the part of alpha that black
    holdouts have, whose pixels are transparent."""
    to_linear = srgb_to_linear if view is None else view.to_linear
    image = np.zeros((*alpha.shape, 4), np.float32)
    covered = alpha > 0
    color = rgb[:, covered].T
    fraction = alpha[covered][:, None]
    held_out = np.broadcast_to(hidden, alpha.shape)
    visible = 1 - held_out[covered][:, None]
    if background is None:
        visible = fraction - held_out[covered][:, None]
        image[..., 3] = alpha - held_out
    else:
        linear = np.array(background, np.float32)
        behind = linear_to_srgb(np.clip(linear, 0, 1)) if view is None else view.show(linear)
        image[...] = *background, 1
        color = np.clip(color + (1 - fraction) * behind, 0, 1)
        image[..., 3] = 1 - held_out
    image[covered, :3] = to_linear(color / np.maximum(visible, MIN_VISIBLE)) * visible
    return image


def srgb(linear: Any) -> tuple[float, float, float]:
    """sRGB 0…1 of a scene-linear color."""
    red, green, blue = linear_to_srgb(np.clip(np.array(linear, np.float64), 0, 1)).tolist()
    return red, green, blue


def srgb_background(scene: Any) -> tuple[float, float, float] | None:
    """Color behind the splats as in `scene_background`, in sRGB 0…1."""
    linear = scene_background(scene)
    return None if linear is None else srgb(linear)


def scene_background(scene: Any) -> tuple[float, ...] | None:
    """Scene-linear color behind the splats: the world's; None where the film is transparent."""
    if scene.render.film_transparent:
        return None
    color = world_color(scene)
    return tuple(scene.world.color) if color is None else color


def world_color(scene: Any) -> tuple[float, ...] | None:
    """Scene-linear color of the world; None where it is not one color; black without one."""
    light = world_light(scene.world)
    return None if light is None or light.image is not None else light.color
