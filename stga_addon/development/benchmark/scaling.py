"""What one iteration's time grows with: splats, pixels, the selected fraction and threads.

    python -m stga_addon.development.benchmark.scaling [--repeats 15]
        [--out docs/pictures/scaling.png]

The bundled head of `iteration`, one thing changed at a time from 60,000 splats at
802×550, all in one process. More splats are smaller ones, as on a real head: their size falls with
the square root of their number. Run it on an idle machine. Prints every figure, with the (splat,
tile) pairs of the view, and draws them.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import matplotlib
import numpy as np

from ...avatar.embedding import face_frames
from ...raster.cpu.layout import Parameters
from ...raster.cpu.rasterize import frames_in_camera, render_forward
from ...raster.cpu.threads import set_threads, threads
from .iteration import bundled_head, front_camera, global_step, median_ms, two_regions

matplotlib.use("Agg")
import matplotlib.pyplot as plt

SPLATS = 60_000
WIDTH = 802
HEIGHT = 550


@dataclass(frozen=True)
class Point:
    """One measurement: what was varied, median ms of an iteration, and (splat, tile) pairs in the
    view."""

    x: float
    ms: float
    pairs: int


def measure(
    x: float, repeats: int, splats: int = SPLATS, zoom: float = 1.0, fraction: float | None = None
) -> Point:
    """An iteration of `splats` splats at `zoom` times the image size; fraction: of the splats,
    selected; None: global."""
    rng = np.random.default_rng(0)
    head, mesh, faces = bundled_head(splats, rng)
    camera = front_camera(round(zoom * WIDTH), round(zoom * HEIGHT))
    target = rng.integers(0, 256, (camera.height, camera.width, 3)).astype(np.uint8)
    step, batch = global_step(head, mesh, faces, camera, target)
    if fraction is not None:
        batch = replace(batch, selected=two_regions(head, mesh, faces, fraction))
    arrays = Parameters(*(getattr(head, name) for name in Parameters._fields))
    frames = frames_in_camera(face_frames(mesh, faces, mesh), camera)
    pairs = len(render_forward(arrays, head.face, frames, 3).lists.pair_splat)
    return Point(x, median_ms(lambda: step.step(batch), repeats), pairs)


def on_threads(count: int, repeats: int) -> Point:
    """An iteration on `count` threads."""
    before = threads()
    set_threads(count)
    try:
        return measure(count, repeats)
    finally:
        set_threads(before)


def series(repeats: int) -> dict[str, list[Point]]:
    """What was varied -> its measurements."""
    counts = (10_000, 30_000, 60_000, 100_000, 200_000, 500_000, 1_000_000)
    plans: dict[str, list[Callable[[], Point]]] = {
        "splats": [
            partial(measure, n, repeats if n < 200_000 else max(3, repeats // 5), n) for n in counts
        ],
        "pixels": [
            partial(measure, z * z * WIDTH * HEIGHT, repeats, zoom=z)
            for z in (0.25, 0.5, 1.0, 1.5, 2.0)
        ],
        "selected fraction": [
            partial(measure, s, repeats, fraction=s) for s in (0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0)
        ],
        "threads": [partial(on_threads, n, repeats) for n in range(1, threads() + 1)],
    }
    found: dict[str, list[Point]] = {}
    for name, measurements in plans.items():
        found[name] = []
        for work in measurements:
            point = work()
            print(f"{name:<16}{point.x:>12g}{point.pairs:>10} pairs{point.ms:>9.2f} ms", flush=True)
            found[name].append(point)
    return found


def draw(found: dict[str, list[Point]], path: Path) -> None:
    figure, axes = plt.subplots(1, 4, figsize=(14, 3.2), constrained_layout=True)
    for axis, (name, points) in zip(axes, found.items(), strict=True):
        by_pairs = name in ("splats", "pixels")
        x = [point.pairs / 1e3 if by_pairs else point.x for point in points]
        axis.plot(x, [point.ms for point in points], "o-")
        axis.set_xlabel("thousand (splat, tile) pairs" if by_pairs else name)
        axis.set_title(f"more {name}" if by_pairs else name, fontsize=10)
        axis.set_ylim(0, 1.1 * max(point.ms for point in points))
        axis.set_xlim(0, 1.15 * max(x))
        for at, point in zip(x, points, strict=True):
            if by_pairs:
                label = {"text": f"{point.x / 1e3:,.0f}k", "fontsize": 7}
                label |= {"xytext": (5, -9), "textcoords": "offset points"}
                axis.annotate(xy=(at, point.ms), **label)
    axes[0].set_ylabel("ms per iteration")
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    found = series(options.repeats)
    if options.out:
        draw(found, options.out)


if __name__ == "__main__":
    main()
