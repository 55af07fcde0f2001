"""The accuracy curve in the panel: its image, and when it is updated."""

import json
import re
from types import SimpleNamespace

import bpy
import numpy as np
import pytest

from stga_addon.report import CURVE_COLOR, DETAIL_COLOR, FORECAST_COLOR, MARGIN, SIZE, curve_image

SECONDS = np.array([2.0, 10.0, 20.0, 40.0, 60.0, 80.0])
PSNR = np.array([20.0, 28.0, 30.5, 32.0, 31.0, 33.2])
AHEAD = {"seconds": 100.0, "psnr": 34.0, "error": 0.5, "ahead": 20.0, "gain": 0.8}
OTHERS = {"ssim": 0.9, "splats": 1, "evaluation_s": 1.0, "wall_s": 1.0}


def lines(count: int = 6, forecast: bool = True) -> list[dict[str, object]]:
    made: list[dict[str, object]] = [
        {"iteration": 10 * row, "seconds": float(SECONDS[row]), "psnr": float(PSNR[row]), **OTHERS}
        for row in range(count)
    ]
    if forecast:
        made[-1]["forecast"] = AHEAD
    return made


def test_curve_agrees_with_its_axes():
    """Catches a curve upside down, mirrored or stretched, and a misplaced forecast."""
    pixels, axes, detail = curve_image(lines())
    assert detail == ""
    low, high = map(float, re.fullmatch(r"(\S+) to (\S+) dB, 0 to 1.7 min", axes).groups())
    inner = SIZE - 2 * MARGIN
    for second, color in [(second, CURVE_COLOR) for second in (15, 30, 50, 75)] + [
        (90, FORECAST_COLOR)
    ]:
        column = int(MARGIN + second / 100 * inner)
        at = (column + 0.5 - MARGIN) / inner * 100
        like = np.abs(pixels[:, column, :3] - np.array(color)).sum(-1)
        expected = np.interp(at, [*SECONDS, 100.0], [*PSNR, 34.0])
        found = low + (np.flatnonzero(like < 0.05).mean() + 0.5 - MARGIN) / inner * (high - low)
        assert found == pytest.approx(expected, abs=2 * (high - low) / inner)


def test_short_and_constant_curves():
    """Catches a division by zero before the second evaluation, and for a constant PSNR."""
    assert curve_image([]) is None
    assert curve_image(lines(1, forecast=False)) is None
    flat = [{"iteration": row, "seconds": 1.0 + row, "psnr": 30.0} for row in range(3)]
    pixels, axes, _ = curve_image(flat)
    assert np.isfinite(pixels).all()
    assert axes == "30 to 30.1 dB, 0 to 3 s"


def test_detail_difference_is_drawn_with_the_best_at_the_top():
    """Catches the measure that keeps avatars left out, upside down, or out of range."""
    measured = [
        {**line, "detail_difference": 0.08 - 0.01 * row}
        for row, line in enumerate(lines(forecast=False))
    ]
    pixels, _, text = curve_image(measured)
    worst, best = map(
        float, re.fullmatch(r"Detail difference (\S+) to (\S+) \(green\)", text).groups()
    )
    assert (worst, best) == (0.072, 0.03)  # a tenth of the time is 8 s
    rows, columns = np.nonzero(np.abs(pixels[..., :3] - np.array(DETAIL_COLOR)).sum(-1) < 0.05)
    assert rows[columns > columns.max() - 5].mean() > rows[columns < columns.mean()].mean() + 30
    assert rows.max() > SIZE - 2 * MARGIN


def test_preview_follows_the_evaluations(extension, tmp_path):
    """Catches an image that is not updated, one of an empty curve, a panel that fails on a damaged
    file, and images that are saved in the .blend file."""
    curve, monitor = extension.ui.sidebar, extension.operators.monitor
    drawn = []
    layout = SimpleNamespace(
        column=lambda **_: SimpleNamespace(
            template_icon=lambda *_, **__: None, label=lambda text: drawn.append(text)
        )
    )

    def draw() -> list[str]:
        """Read evaluations as the training monitor does, and draw; the texts below."""
        drawn.clear()
        monitor.curves[tmp_path] = monitor._read_curve(tmp_path, None)
        curve.draw_curve(layout, tmp_path)
        return list(drawn)

    assert draw() == []
    file = tmp_path / "metrics.jsonl"
    seen = []
    for count in (1, 3, 6):
        file.write_text("".join(json.dumps(line) + "\n" for line in lines(count)))
        seen.append(draw())
    assert [len(texts) for texts in seen] == [0, 1, 1]
    painted = np.array(curve._previews[str(tmp_path)].image_pixels_float[:]).reshape(SIZE, SIZE, 4)
    np.testing.assert_allclose(painted, curve_image(lines())[0], atol=1 / 255)
    file.write_text(
        '{"iteration": 1, "seconds": "x", "psnr": 1}\n'
        '{"iteration": 2, "seconds": 2, "psnr": null}\n'
    )
    assert draw() == []
    assert len(bpy.data.images) == 0
