"""A run's accuracy curve as an image, drawn with numpy: Blender's Python need not have matplotlib or Pillow."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..format import format_duration
from ..training.evaluate.forecast import DETAIL, UNMATCHED, curve_of, detail_curve

SIZE = 256
"""Width and height in pixels: Blender's icons are square."""
MARGIN = 6.0
LINE_WIDTH = 3.0
BACKGROUND_COLOR, GRID_COLOR = (0.11, 0.11, 0.11), (0.25, 0.25, 0.25)
CURVE_COLOR, FORECAST_COLOR, DETAIL_COLOR = (0.34, 0.71, 0.91), (0.90, 0.62, 0.0), (0.0, 0.62, 0.45)
BAND_OPACITY = 0.35
"""Of the band that shows a forecast's error."""
GRID_STEPS_DB = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
"""The first step is used that gives at most MAX_GRID_STEPS."""
MAX_GRID_STEPS = 6

Color = tuple[float, float, float]


def curve_image(lines: Sequence[Mapping[str, Any]]) -> tuple[np.ndarray, str, str] | None:
    """Held-out PSNR over training time, with the last forecast and its error; None before two evaluations.

    The detail difference, by which the avatar is kept, is drawn in green over the whole height, the best at the top.
    lines: of a metrics.jsonl. Returns (SIZE, SIZE, 4) float32 RGBA in 0…1, the bottom row first, and as texts the
    ranges of the axes and of the detail difference (empty if it was not measured). The steep beginning is cut off: the
    vertical axis starts at the PSNR of a tenth of the time.
    """
    curve = curve_of(lines)
    if len(curve) < 2:
        return None
    seconds, psnr = np.array(curve, np.float64).T
    forecast = lines[-1].get("forecast")
    end, high = seconds[-1], psnr.max()
    if forecast is not None:
        end, high = forecast["seconds"], max(high, forecast["psnr"] + forecast["error"])
    low = min(float(np.interp(end / 10, seconds, psnr)), psnr[-1])
    step = next((step for step in GRID_STEPS_DB if (high - low) / step <= MAX_GRID_STEPS), GRID_STEPS_DB[-1])
    low, high = step * np.floor(low / step), step * np.ceil(high / step + 1e-9)
    plot = _Plot((0.0, end), (low, high))
    plot.grid(np.arange(low, high + step / 2, step))
    if forecast is not None:
        x, y = np.array([seconds[-1], end]), np.array([psnr[-1], forecast["psnr"]])
        error = np.array([0.0, forecast["error"]])
        plot.band(x, y - error, y + error, FORECAST_COLOR)
        plot.line(x, y, FORECAST_COLOR)
    detail_range = _draw_detail(plot, lines, (low, high))
    plot.line(seconds, psnr, CURVE_COLOR)
    unmatched = lines[-1].get(UNMATCHED)
    fitted = "" if unmatched is None else f" (exposure fitted; {unmatched:.1f} without)"
    return plot.pixels, f"{low:g} to {high:g} dB{fitted}, 0 to {format_duration(end)}", detail_range


def _draw_detail(plot: "_Plot", lines: Sequence[Mapping[str, Any]], height: tuple[float, float]) -> str:
    """Draw the detail difference, scaled to the height in dB from a tenth of the time on; returns its range as text."""
    seconds, detail = np.array(detail_curve(lines), np.float64).reshape(-1, 2).T
    if len(detail) < 2:
        return ""
    lowest, highest = float(np.interp(seconds[-1] / 10, seconds, detail)), float(detail.max())
    lowest = min(lowest, float(detail[-1]))
    share = (detail - lowest) / max(highest - lowest, 1e-9)
    plot.line(seconds, height[0] + share * (height[1] - height[0]), DETAIL_COLOR)
    worst, best = 10 ** (-lowest / 20), min(value for _, value in curve_of(lines, DETAIL))
    return f"Detail difference {worst:.3f} to {best:.3f} (green)"


class _Plot:
    """An image with axes: x and y are the ranges of seconds and dB inside its margins."""

    def __init__(self, x: tuple[float, float], y: tuple[float, float]) -> None:
        self.pixels = np.ones((SIZE, SIZE, 4), np.float32)
        self.pixels[..., :3] = BACKGROUND_COLOR
        self._x, self._y = x, y

    def grid(self, y: np.ndarray) -> None:
        self.pixels[self._rows(y).astype(int), :, :3] = GRID_COLOR

    def line(self, x: np.ndarray, y: np.ndarray, color: Color) -> None:
        """Antialiased by the distance of each pixel's center to the line segment in the pixel's column."""
        seconds, inside = self._columns(x)
        height = np.interp(seconds, x, self._rows(y))
        slope = np.gradient(height)
        rows = np.arange(SIZE)[:, None] + 0.5
        distance = np.abs(rows - height) / np.sqrt(1 + slope**2)
        self._blend(np.clip(LINE_WIDTH / 2 + 0.5 - distance, 0, 1) * inside, color)

    def band(self, x: np.ndarray, low: np.ndarray, high: np.ndarray, color: Color) -> None:
        seconds, inside = self._columns(x)
        rows = np.arange(SIZE)[:, None] + 0.5
        bottom, top = (np.interp(seconds, x, self._rows(edge)) for edge in (low, high))
        self._blend(BAND_OPACITY * ((rows >= bottom) & (rows <= top) & inside), color)

    def _columns(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Seconds at each column's center, and whether they are in the range of x."""
        columns = np.arange(SIZE) + 0.5
        seconds = self._x[0] + (columns - MARGIN) / (SIZE - 2 * MARGIN) * (self._x[1] - self._x[0])
        return seconds, (seconds >= x[0]) & (seconds <= x[-1])

    def _rows(self, y: np.ndarray) -> np.ndarray:
        return MARGIN + (y - self._y[0]) / (self._y[1] - self._y[0]) * (SIZE - 2 * MARGIN)

    def _blend(self, opacity: np.ndarray, color: Color) -> None:
        self.pixels[..., :3] += opacity[..., None] * (np.array(color, np.float32) - self.pixels[..., :3])
