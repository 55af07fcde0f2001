"""What one iteration's time grows with: splats, pixels, the selected share and threads.

    python benchmarks/scaling.py [--repeats 15] [--out docs/pictures/scaling.png] [--model]
    [--splats 60000]

The bundled head of benchmarks/iteration.py, one thing changed at a time from 60,000 splats at
802×550, all in one process. More splats are smaller ones, as on a real head: their size falls with
the square root of their number. Run it on an idle machine. Prints every figure, with the (splat,
tile) pairs of the view, and draws them.

--model: instead, what more threads than this machine has would bring. The pieces that an iteration
is cut into are timed one after the other (time of the thread, median of repeats; many short ones a
few at a time) and given to N threads as `threads.py` does: the calling thread unpacks the arguments
and begins, each of the others joins later by as much as two threads measurably need to meet in a
kernel, one after the other, and each takes the next piece when it is free. Added is what lies
between the kernels. Cores are taken to be alike and memory to keep up: the last column is the
bandwidth that this needs.
"""

import argparse
import heapq
import statistics
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from time import perf_counter, thread_time
from typing import Any
from unittest.mock import patch

import matplotlib
import numpy as np
from iteration import bundled_head, front_camera, global_step, median_ms, two_regions

from stga_addon.avatar.embedding import face_frames
from stga_addon.raster.cpu import threads as kernel_threads
from stga_addon.raster.cpu.elementary import fetch_add
from stga_addon.raster.cpu.layout import Parameters
from stga_addon.raster.cpu.rasterize import frames_in_camera, render_forward
from stga_addon.raster.cpu.threads import parallel, pieces, set_threads, threads

matplotlib.use("Agg")
import matplotlib.pyplot as plt

SPLATS, WIDTH, HEIGHT = 60_000, 802, 550
MODELLED_THREADS = (1, 2, 4, 8, 16)
TIMED_PIECES = 64
"""Pieces of a kernel that are timed one by one, if it has no more: calling it takes time too."""
BYTES_PER_SPLAT, BYTES_PER_PAIR, BYTES_PER_PIXEL = 3_100, 140, 71
"""What an iteration at least reads and writes, by the table of benchmarks/iteration.py."""


@dataclass(frozen=True)
class Point:
    """One measurement: what was varied, median ms of an iteration, and (splat, tile) pairs in the
    view."""

    x: float
    ms: float
    pairs: int


def measure(
    x: float, repeats: int, splats: int = SPLATS, zoom: float = 1.0, share: float | None = None
) -> Point:
    """An iteration of `splats` splats at `zoom` times the image size; share: of the splats,
    selected; None: global."""
    rng = np.random.default_rng(0)
    head, mesh, faces = bundled_head(splats, rng)
    camera = front_camera(round(zoom * WIDTH), round(zoom * HEIGHT))
    target = rng.integers(0, 256, (camera.height, camera.width, 3)).astype(np.uint8)
    step, batch = global_step(head, mesh, faces, camera, target)
    if share is not None:
        batch = replace(batch, selected=two_regions(head, mesh, faces, share))
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
        "selected share": [
            partial(measure, s, repeats, share=s) for s in (0.02, 0.05, 0.1, 0.2, 0.4, 0.7, 1.0)
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


@dataclass(frozen=True)
class Kernel:
    """A kernel, in milliseconds: its pieces, what it takes to call it, and the time since the
    kernel before."""

    name: str
    pieces: list[float]
    call: float
    pause: float


def kernels_of(step: Callable[[], object]) -> tuple[list[Kernel], float]:
    """Runs an iteration on this thread, cut as for the threads that are set. Returns its kernels,
    in order, and what lies between them, in milliseconds of this thread.
    """
    found: list[Kernel] = []
    last = aside = 0.0

    def one_by_one(kernel: Any, units: int, piece: int, arguments: tuple[Any, ...]) -> None:
        nonlocal aside, last
        begin = thread_time()
        together = piece * -(-units // (piece * TIMED_PIECES))
        spans = [(first, min(first + together, units)) for first in range(0, units, together)]
        times = []
        for first, past in spans:
            before = thread_time()
            kernel(np.array([first, past, piece]), *arguments)
            times.append(1e3 * (thread_time() - before))
        before = thread_time()
        for _ in range(3):
            kernel(np.array([0, 0, piece]), *arguments)
        call = 1e3 * (thread_time() - before) / 3
        taken = [-(-(past - first) // piece) for first, past in spans]
        each = [
            max(0.0, ms - call) / count
            for ms, count in zip(times, taken, strict=True)
            for _ in range(count)
        ]
        found.append(Kernel(kernel.__name__, each, call, 1e3 * (begin - last)))
        last = thread_time()
        aside += 1e3 * (last - begin)

    with patch.object(kernel_threads, "_run", one_by_one):
        last = before = thread_time()
        step()
        whole = 1e3 * (thread_time() - before)
    return found, whole - aside


@dataclass(frozen=True)
class Latency:
    """Milliseconds that a thread joins a kernel later than its caller begins it, and what every
    further one takes on top."""

    first: float
    further: float

    def of(self, helpers: int) -> list[float]:
        return [self.first + n * self.further for n in range(helpers)]


def spans_ms(kernels: list[Kernel], count: int, latency: Latency) -> list[float]:
    """How long each kernel of an iteration takes `count` threads, of which each takes the next
    piece when it is free."""
    spans = []
    for kernel in kernels:
        late = latency.of(min(count, len(kernel.pieces)) - 1)
        free = [kernel.call, *(kernel.call + ms for ms in late)]
        heapq.heapify(free)
        end = kernel.call
        for ms in kernel.pieces:
            end = max(end, free[0] + ms)
            heapq.heapreplace(free, free[0] + ms)
        spans.append(end)
    return spans


@parallel(lambda met, *_: len(met) - 1)
def meet(work, met, patience):
    """Each thread takes one unit and waits until met[0], how many have, is all of them: together,
    if that many came."""
    for _ in pieces(work):
        fetch_add(met, 0, 1)
        for _ in range(patience):
            if fetch_add(met, 0, 0) == len(met) - 1:
                break


@parallel(lambda count: count)
def take(work, count):
    """Takes all pieces and does nothing with them."""
    for _ in pieces(work):
        pass


def measure_latency(repeats: int) -> Latency:
    """Measured on two threads, of the repeats the fastest tenth: on a loaded machine a thread may
    lack a core."""
    units = 100_000

    def meet_ms() -> float:
        """A whole kernel in which the two meet."""
        times = []
        for _ in range(repeats):
            take(10 * units)  # long enough for the system to give each thread a core
            met = np.zeros(3, np.int64)
            begin = perf_counter()
            meet(met, 1_000_000)
            times.append(1e3 * (perf_counter() - begin))
        return statistics.quantiles(times, n=10)[0]

    before = threads()
    set_threads(2)
    try:
        first = meet_ms()
        further = median_ms(lambda: take(units), 5) / units
    finally:
        set_threads(before)
    return Latency(first, further)


def model(splats: int, repeats: int) -> None:
    """Print what an iteration would take on more threads, and of the most threads each kernel's
    part."""
    rng = np.random.default_rng(0)
    head, mesh, faces = bundled_head(splats, rng)
    camera = front_camera(WIDTH, HEIGHT)
    target = rng.integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    backend, batch = global_step(head, mesh, faces, camera, target)
    arrays = Parameters(*(getattr(head, name) for name in Parameters._fields))
    pairs = len(
        render_forward(
            arrays, head.face, frames_in_camera(face_frames(mesh, faces, mesh), camera), 3
        ).lists.pair_splat
    )
    moved = splats * BYTES_PER_SPLAT + pairs * BYTES_PER_PAIR + WIDTH * HEIGHT * BYTES_PER_PIXEL
    latency = measure_latency(20 * repeats)
    print(
        f"a thread joins after {1e3 * latency.first:.1f} µs, each further one "
        f"{1e3 * latency.further:.2f} µs later"
    )
    runs: dict[int, list[tuple[list[Kernel], float]]] = {count: [] for count in MODELLED_THREADS}
    for _ in range(repeats + 2):
        for count in runs:  # in turn, because the machine's speed changes
            set_threads(count)
            runs[count].append(kernels_of(lambda: backend.step(batch)))
    print(f"{'threads':>7}{'work':>8}{'between':>9}{'ms':>8}{'efficiency':>12}{'GB/s':>7}")
    single = 0.0
    for count, measured in runs.items():
        kernels = [
            median_kernel(calls) for calls in zip(*(run[0] for run in measured[2:]), strict=True)
        ]
        between = statistics.median(run[1] for run in measured[2:])
        spans = spans_ms(kernels, count, latency)
        work, ms = sum(sum(kernel.pieces) for kernel in kernels), sum(spans) + between
        single = single or ms
        efficiency, bandwidth = single / ms / count, moved / ms / 1e6
        print(
            f"{count:>7}{work:>8.2f}{between:>9.2f}{ms:>8.2f}{efficiency:>12.2f}{bandwidth:>7.0f}"
        )
    for kernel, span in zip(kernels, spans, strict=True):
        share = sum(kernel.pieces) / span / count
        print(
            f"    {kernel.name:<24}{span:>8.2f} ms on {count} threads, busy for {share:.2f} of it"
        )


def median_kernel(calls: tuple[Kernel, ...]) -> Kernel:
    """Several runs of the same call as one."""
    pieces = [
        statistics.median(times) for times in zip(*(call.pieces for call in calls), strict=True)
    ]
    call, pause = (
        statistics.median(getattr(kernel, name) for kernel in calls) for name in ("call", "pause")
    )
    return Kernel(calls[0].name, pieces, call, pause)


def draw(found: dict[str, list[Point]], path: Path) -> None:
    figure, axes = plt.subplots(1, 4, figsize=(14, 3.2), constrained_layout=True)
    for axis, (name, points) in zip(axes, found.items(), strict=True):
        by_pairs = name in ("splats", "pixels")
        x = [point.pairs / 1e3 if by_pairs else point.x for point in points]
        axis.plot(x, [point.ms for point in points], "o-")
        axis.set_xlabel("thousand (splat, tile) pairs" if by_pairs else name)
        axis.set_title(f"more {name}" if by_pairs else name, fontsize=10)
        axis.set_ylim(0)
        axis.set_xlim(0)
        for at, point in zip(x, points, strict=True):
            label = f"{point.x / 1e3:g}k" if by_pairs else ""
            axis.annotate(
                label,
                (at, point.ms),
                textcoords="offset points",
                xytext=(-4, 5),
                fontsize=7,
                ha="right",
            )
    axes[0].set_ylabel("ms per iteration")
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--model", action="store_true")
    parser.add_argument("--splats", type=int, default=SPLATS, help="of the model")
    options = parser.parse_args()
    if options.model:
        model(options.splats, options.repeats)
        return
    found = series(options.repeats)
    if options.out:
        draw(found, options.out)


if __name__ == "__main__":
    main()
