"""Line charts drawn with Pillow, which training needs anyway: accuracy against time."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ..training.evaluate.forecast import Curve, curve_of

SIZE = (900, 540)
FINE = 2
"""Drawn so many times larger and shrunk, which smooths the lines."""
MARGIN = (64, 40, 200, 52)
"""Left, top, right (for the names), bottom, in pixels."""
INK, GRID, PAPER = (40, 40, 40), (225, 225, 225), (255, 255, 255)
COLOURS = (
    (0, 114, 178), (213, 94, 0), (0, 158, 115), (204, 121, 167), (230, 159, 0), (86, 180, 233), (120, 94, 60),
    (90, 90, 90),
)  # fmt: skip
"""Okabe and Ito's, which people with any colour vision can tell apart; they repeat after eight."""


@dataclass(frozen=True)
class Line:
    """A curve (x, y), the band around it or None, and where it is drawn bold."""

    name: str
    x: np.ndarray
    y: np.ndarray
    band: tuple[np.ndarray, np.ndarray] | None = None
    bold: tuple[tuple[float, float], ...] = ()


def run_chart(metrics: Sequence[Mapping[str, Any]], size: tuple[int, int] = SIZE) -> Image.Image:
    """The curve of one run so far, in the whole image, the head mask and what moves, with its last forecast."""
    lines = []
    for name, key in (("whole image", "psnr"), ("head", "psnr_mask"), ("what moves", "psnr_selected")):
        curve = curve_of([{**line, "psnr": line[key]} for line in metrics if key in line])
        if curve:
            lines.append(_line(name, curve))
    if metrics and "forecast" in metrics[-1]:
        coming = metrics[-1]["forecast"]
        x = np.array([metrics[-1]["seconds"], coming["seconds"]])
        y, error = np.array([metrics[-1]["psnr"], coming["psnr"]]), np.array([0, coming["error"]])
        lines.append(Line("forecast", x, y, (y - error, y + error)))
    return chart(lines, "PSNR on held-out views", size)


def chart(lines: Sequence[Line], title: str, size: tuple[int, int] = SIZE) -> Image.Image:
    """PSNR in dB over seconds. The steep beginning is cut off: the lowest point shown is a curve's at a tenth of the
    time."""
    canvas = _Canvas(lines, size)
    canvas.grid(title)
    for number, line in enumerate(lines):
        canvas.band(line, COLOURS[number % len(COLOURS)])
    for number, line in enumerate(lines):
        canvas.line(line, COLOURS[number % len(COLOURS)])
        canvas.name(number, line.name, COLOURS[number % len(COLOURS)])
    return canvas.image.resize(size, Image.Resampling.LANCZOS)


def _line(name: str, curve: Curve) -> Line:
    x, y = np.array(curve).T
    return Line(name, x, y)


class _Canvas:
    """A picture and the way from seconds and dB to its pixels."""

    def __init__(self, lines: Sequence[Line], size: tuple[int, int]) -> None:
        self.image = Image.new("RGB", (size[0] * FINE, size[1] * FINE), PAPER)
        self._draw = ImageDraw.Draw(self.image)
        self._font = ImageFont.load_default(13 * FINE)
        left, top, right, bottom = (FINE * m for m in MARGIN)
        self._box = left, top, self.image.width - right, self.image.height - bottom
        self._x = 0.0, max([float(line.x[-1]) for line in lines], default=1.0)
        lowest = [float(np.interp(self._x[1] / 10, line.x, line.y)) for line in lines]
        highest = [float(line.y.max() if line.band is None else line.band[1].max()) for line in lines]
        low, high = min(lowest, default=0.0), max(highest, default=1.0)
        self._y = low - 0.04 * (high - low) - 1e-3, high + 0.04 * (high - low) + 1e-3

    def grid(self, title: str) -> None:
        left, top, right, bottom = self._box
        for value in _ticks(*self._x):
            ((x, _),) = self._place([value], [self._y[0]])
            self._draw.line([x, top, x, bottom], GRID, FINE)
            self._text((x, bottom + 8 * FINE), f"{value:g}", "ma")
        for value in _ticks(*self._y):
            ((_, y),) = self._place([0.0], [value])
            self._draw.line([left, y, right, y], GRID, FINE)
            self._text((left - 8 * FINE, y), f"{value:g}", "rm")
        self._draw.rectangle(self._box, outline=INK, width=FINE)
        self._text((left, top - 14 * FINE), title, "ls")
        self._text(((left + right) / 2, self.image.height - 8 * FINE), "seconds of training", "ms")
        self._text((left - 8 * FINE, top - 14 * FINE), "dB", "rs")

    def band(self, line: Line, colour: tuple[int, int, int]) -> None:
        if line.band is None:
            return
        edge = self._place(line.x, line.band[0]) + self._place(line.x, line.band[1])[::-1]
        mask = Image.new("L", self.image.size)
        ImageDraw.Draw(mask).polygon(edge, fill=45)
        self.image.paste(Image.new("RGB", self.image.size, colour), mask=self._inside(mask))

    def line(self, line: Line, colour: tuple[int, int, int]) -> None:
        mask = Image.new("L", self.image.size)
        draw = ImageDraw.Draw(mask)
        draw.line(self._place(line.x, line.y), 255, 2 * FINE, joint="curve")
        for start, end in line.bold:
            on = (line.x >= start) & (line.x <= end)
            draw.line(self._place(line.x[on], line.y[on]), 255, 5 * FINE, joint="curve")
        if len(line.x) == 1:
            ((x, y),) = self._place(line.x, line.y)
            draw.ellipse([x - 3 * FINE, y - 3 * FINE, x + 3 * FINE, y + 3 * FINE], 255)
        self.image.paste(Image.new("RGB", self.image.size, colour), mask=self._inside(mask))

    def name(self, number: int, name: str, colour: tuple[int, int, int]) -> None:
        x, y = self._box[2] + 14 * FINE, self._box[1] + (10 + 20 * number) * FINE
        self._draw.line([x, y, x + 18 * FINE, y], colour, 4 * FINE)
        self._text((x + 26 * FINE, y), name, "lm")

    def _place(self, x: Sequence[float] | np.ndarray, y: Sequence[float] | np.ndarray) -> list[tuple[float, float]]:
        left, top, right, bottom = self._box
        across = left + (np.asarray(x) - self._x[0]) / (self._x[1] - self._x[0]) * (right - left)
        down = bottom - (np.asarray(y) - self._y[0]) / (self._y[1] - self._y[0]) * (bottom - top)
        return list(zip(across.tolist(), down.tolist(), strict=True))

    def _inside(self, mask: Image.Image) -> Image.Image:
        """The mask without what lies outside the axes."""
        cut = Image.new("L", mask.size)
        cut.paste(mask.crop(self._box), self._box)
        return cut

    def _text(self, at: tuple[float, float], text: str, anchor: str) -> None:
        self._draw.text(at, text, INK, self._font, anchor)


def _ticks(low: float, high: float) -> list[float]:
    """About six round numbers between two."""
    rough = (high - low) / 6
    power = 10 ** np.floor(np.log10(rough))
    step = float(power * min((1, 2, 5, 10), key=lambda factor: abs(factor * power - rough)))
    return [round(n * step, 10) for n in range(int(np.ceil(low / step)), int(np.floor(high / step)) + 1)]
