"""The picture of a run's accuracy over time, painted with numpy: Blender's Python need not have Pillow."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ..format import format_duration
from ..training.evaluate.forecast import curve_of

SIZE = 256
"""Pixels of a side: Blender's icons are square."""
MARGIN = 6.0
WIDTH = 3.0
PAPER, GRID, LINE, COMING = (0.11, 0.11, 0.11), (0.25, 0.25, 0.25), (0.34, 0.71, 0.91), (0.90, 0.62, 0.0)
BAND = 0.35
"""Opacity of a forecast's error."""
STEPS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
"""dB between two lines of the grid: the first of which at most LINES fit."""
LINES = 6


def curve_image(lines: Sequence[Mapping[str, Any]]) -> tuple[np.ndarray, str] | None:
    """Held-out PSNR over seconds of training, with the last forecast and its error; None before two evaluations.

    lines: of a metrics.jsonl. Returns (SIZE, SIZE, 4) float32 RGBA in 0…1, the lowest row first, and what the axes
    say. The steep beginning is cut off: the lowest point is the curve's at a tenth of the time.
    """
    curve = curve_of(lines)
    if len(curve) < 2:
        return None
    t, psnr = np.array(curve, np.float64).T
    coming = lines[-1].get("forecast")
    ahead = None if coming is None else (coming["seconds"], coming["psnr"], coming["error"])
    end = t[-1] if ahead is None else ahead[0]
    high = psnr.max() if ahead is None else max(psnr.max(), ahead[1] + ahead[2])
    low = min(float(np.interp(end / 10, t, psnr)), psnr[-1])
    step = next((step for step in STEPS if (high - low) / step <= LINES), STEPS[-1])
    low, high = step * np.floor(low / step), step * np.ceil(high / step + 1e-9)
    picture = _Picture((0.0, end), (low, high))
    picture.grid(np.arange(low, high + step / 2, step))
    if ahead is not None:
        x, y, error = np.array([t[-1], ahead[0]]), np.array([psnr[-1], ahead[1]]), np.array([0.0, ahead[2]])
        picture.band(x, y - error, y + error, COMING)
        picture.line(x, y, COMING)
    picture.line(t, psnr, LINE)
    return picture.pixels, f"{low:g} to {high:g} dB, 0 to {format_duration(end)}"


class _Picture:
    """Pixels, and the way from seconds and dB to them."""

    def __init__(self, x: tuple[float, float], y: tuple[float, float]) -> None:
        self.pixels = np.ones((SIZE, SIZE, 4), np.float32)
        self.pixels[..., :3] = PAPER
        self._x, self._y = x, y

    def grid(self, y: np.ndarray) -> None:
        self.pixels[self._rows(y).astype(int), :, :3] = GRID

    def line(self, x: np.ndarray, y: np.ndarray, color: tuple[float, float, float]) -> None:
        """Antialiased by the distance of each pixel's centre to the piece of the line in the pixel's column."""
        across, inside = self._columns(x)
        height = np.interp(across, x, self._rows(y))
        slope = np.gradient(height)
        rows = np.arange(SIZE)[:, None] + 0.5
        distance = np.abs(rows - height) / np.sqrt(1 + slope**2)
        self._blend(np.clip(WIDTH / 2 + 0.5 - distance, 0, 1) * inside, color)

    def band(self, x: np.ndarray, low: np.ndarray, high: np.ndarray, color: tuple[float, float, float]) -> None:
        across, inside = self._columns(x)
        rows = np.arange(SIZE)[:, None] + 0.5
        below, above = (np.interp(across, x, self._rows(edge)) for edge in (low, high))
        self._blend(BAND * ((rows >= below) & (rows <= above) & inside), color)

    def _columns(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Seconds at each column's centre, and whether x reaches there."""
        column = np.arange(SIZE) + 0.5
        across = self._x[0] + (column - MARGIN) / (SIZE - 2 * MARGIN) * (self._x[1] - self._x[0])
        return across, (across >= x[0]) & (across <= x[-1])

    def _rows(self, y: np.ndarray) -> np.ndarray:
        return MARGIN + (y - self._y[0]) / (self._y[1] - self._y[0]) * (SIZE - 2 * MARGIN)

    def _blend(self, opacity: np.ndarray, color: tuple[float, float, float]) -> None:
        self.pixels[..., :3] += opacity[..., None] * (np.array(color, np.float32) - self.pixels[..., :3])
