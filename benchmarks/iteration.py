"""What one training iteration costs, stage by stage, globally and on a part of the splats.

    python benchmarks/iteration.py [--head ellipsoid] [--splats 60000] [--width 802] [--height 550]
        [--repeats 30] [--device gpu] [--opensplat FOLDER] [--processor-time] [--out FILE.json]

Splats of SH degree 3 on the bundled head (23,400 triangles, denser at eyes and mouth, as heads
are), or on an evenly covered ellipsoid, for which a selection costs most. Prints the
instruction set, and medians over repeats in one process; beside each stage the bytes it must at
least move and the time that takes at this machine's measured copy bandwidth, and for the image loss
its arithmetic at the measured rate of multiply-adds. --device: as of `stga train`; of a GPU, whole
iterations only. --opensplat: a checkout of OpenSplat, whose CPU rasterizer is compiled and run on
the same splats, by wall time. Run it on an idle machine, or with --processor-time: instead of time
that passes, that of the processor, of ours divided by its threads.
"""

import argparse
import json
import statistics
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np
import trimesh
from llvmlite.binding import get_host_cpu_name
from numba.core import config
from numba.core.codegen import get_host_cpu_features

from stga_addon.avatar.embedding import face_areas, face_frames
from stga_addon.avatar.splats import Splats
from stga_addon.capture.camera import Camera
from stga_addon.capture.model import Capture, View
from stga_addon.flame.parts import flame_model
from stga_addon.raster.cpu.blend import blend_backward, blend_forward
from stga_addon.raster.cpu.layout import PROJECTED
from stga_addon.raster.cpu.project import project_backward, project_forward
from stga_addon.raster.cpu.rasterize import (
    BufferPool,
    frames_in_camera,
    render_backward,
    render_forward,
    sort_by_depth,
    tile_grid,
)
from stga_addon.raster.cpu.threads import parallel, pieces, threads
from stga_addon.raster.cpu.tiles import (
    SORT_PARTS,
    arrange_tiles,
    count_pairs,
    fill_pairs,
    sum_tiles,
)
from stga_addon.render.device import choose_device
from stga_addon.training.optimize import adam
from stga_addon.training.optimize.cpu_backend import image_gradient, whole_image
from stga_addon.training.optimize.frames import FrameStore
from stga_addon.training.optimize.state import Batch, new_state
from stga_addon.training.optimize.trainer import make_backend
from stga_addon.training.schedule import learning_rates
from stga_addon.training.settings import make_settings

RATES = dict.fromkeys(learning_rates(make_settings(iterations=1).rates, 0), 1e-9)
SSIM_WEIGHT = 0.2
"""Of the image loss."""
LOSS_OPERATIONS = 3 * (14 * 11 + 28 + 12)
"""Additions, multiplications, multiply-adds and the like that the image loss needs of a pixel: in
each channel 14 blurs of 11, SSIM with its derivatives, and the rest.
`tests/raster/test_assembly.py` counts them in the assembly."""

REGIONS = {
    "bundled": ([0.031, 0.036, 0.09], [0.0, -0.034, 0.11]),
    "ellipsoid": ([0.03, -0.04, 0.08], [0.0, 0.06, 0.07]),
}
"""Where each head's selected regions lie: an eye and the mouth."""


def bundled_head(count: int, rng: np.random.Generator) -> tuple[Splats, np.ndarray, np.ndarray]:
    """`count` splats on the bundled head, sized like its triangles; with its vertices (V, 3) and
    faces (F, 3)."""
    model = flame_model(None)
    vertices = model.v_template
    faces = model.faces
    spacing = np.sqrt(2 * face_areas(vertices, faces)) * np.sqrt(len(faces) / count)
    return _splats(count, 0.6 * np.maximum(spacing, 1e-5), rng), vertices, faces


def ellipsoid(count: int, rng: np.random.Generator) -> tuple[Splats, np.ndarray, np.ndarray]:
    """`count` splats of one size on an ellipsoid of about 20,000 triangles; with its vertices and
    faces."""
    sphere = trimesh.creation.icosphere(subdivisions=5)
    vertices = sphere.vertices * [0.08, 0.11, 0.09]
    faces = np.asarray(sphere.faces, np.int32)
    return _splats(count, np.full(len(faces), 0.0012), rng), vertices, faces


def _splats(count: int, size: np.ndarray, rng: np.random.Generator) -> Splats:
    """Splats on random triangles, in the triangles' order, as a lattice has them; size (F,): the
    smallest standard deviation on each, meters.
    """
    face = np.sort(rng.integers(0, len(size), count)).astype(np.int32)
    sigma = size[face][:, None]
    return Splats(
        xyz=(rng.normal(size=(count, 3)) * 0.8 * sigma).astype(np.float32),
        rotation=rng.normal(size=(count, 4)).astype(np.float32),
        log_scale=np.log(sigma * (1 + 0.5 * rng.random((count, 3)))).astype(np.float32),
        opacity=(rng.normal(size=count) + 1).astype(np.float32),
        sh=(rng.normal(size=(count, 16, 3)) * 0.1).astype(np.float32),
        face=face,
        unbound=np.zeros(count, bool),
    )


def front_camera(width: int, height: int) -> Camera:
    """A meter before a head that looks along +z."""
    view = np.diag([1.0, -1.0, -1.0, 1.0])
    view[2, 3] = 1.0
    return Camera(width, height, 2.43 * width, 2.43 * width, width / 2, height / 2, view)


def median_ms(
    work: Callable[[], object], repeats: int, clock: Callable[[], float] = perf_counter
) -> float:
    """Median time of `work` in milliseconds, after two calls that are not counted; clock: returns
    seconds."""
    times = []
    for _ in range(repeats + 2):
        begin = clock()
        work()
        times.append(1e3 * (clock() - begin))
    return statistics.median(times[2:])


def time_of_a_thread() -> float:
    """Seconds of processor time that this process has used, divided by its threads."""
    return process_time() / threads()


def copy_bandwidth() -> float:
    """Bytes a second, read and written, of a copy of 256 MB."""
    source = np.ones(1 << 26, np.float32)
    target = np.empty_like(source)
    return 2 * source.nbytes / (median_ms(lambda: np.copyto(target, source), 5) / 1e3)


MULTIPLY_ADDS = 16
"""Of one value in `multiply_add_rows`, one after the other."""


@parallel(lambda rows: len(rows), piece=16)
def multiply_add_rows(work, rows):
    """Sixteen multiply-adds of each value of rows (R, 256) float32, 100 times over."""
    for first, past in pieces(work):
        for n in range(first, past):
            row = rows[n]
            for _ in range(100):
                for p in range(np.uint64(row.shape[0])):
                    x = row[p]
                    value = x
                    for _ in range(MULTIPLY_ADDS):
                        value = value * x - x
                    row[p] = value


def arithmetic_rate(clock: Callable[[], float]) -> float:
    """Multiply-adds of single floats a second, by all threads, on values that stay in the nearest
    cache."""
    rows = np.full((512, 256), 0.5, np.float32)
    return (
        100
        * MULTIPLY_ADDS
        * rows.size
        / (median_ms(lambda: multiply_add_rows(rows), 5, clock) / 1e3)
    )


def stages(
    splats: Splats, frames, target: np.ndarray, repeats: int, clock: Callable[[], float]
) -> dict[str, tuple[float, int]]:
    """stage -> (median ms, bytes that it must move at least)."""
    n = len(splats)
    (width, height) = frames.size.tolist()
    pixels = width * height
    background = np.ones(3, np.float32)
    tiles_x, tiles_y = tile_grid(width, height)
    state = new_state(splats)
    buffers = BufferPool()
    parameters = state.parameters
    gradients = state.gradients
    face = state.face
    r = render_forward(parameters, face, frames, 3, background, buffers=buffers)
    lists = r.lists
    columns = r.projection.columns
    rect = r.projection.rect
    rows = lists.visible
    everything = np.arange(n)
    everywhere = sum_tiles(np.ones((tiles_y, tiles_x), bool))
    _, order, first_pair, *_ = sort_by_depth(r.projection, BufferPool())
    count = len(lists.pair_splat)
    counts = np.empty((SORT_PARTS, tiles_x * tiles_y), np.int32)
    count_pairs(rect, order, tiles_x, counts)
    places = counts.copy()
    arrange_tiles(places, r.tile_blocks)
    v_image = np.empty_like(r.image)
    screen_gradient = np.empty(n, np.float32)
    bands = whole_image(height, width)
    zero = np.zeros_like(r.transmittance)
    wanted = np.ones(n, bool)
    pair_gradients = np.empty((count, PROJECTED), np.float32)
    work = {
        "project": (
            lambda: project_forward(
                everything, everywhere, parameters, face, frames, 3, False, False, r.projection
            ),
            n * (59 + 16) * 4,
        ),
        "sort by depth": (lambda: sort_by_depth(r.projection, buffers), n * 36 + len(rows) * 44),
        "count pairs": (lambda: count_pairs(rect, order, tiles_x, counts), n * 20),
        "arrange tiles": (lambda: arrange_tiles(counts.copy(), r.tile_blocks), 2 * counts.nbytes),
        "fill pairs": (
            lambda: fill_pairs(
                rect, order, tiles_x, places.copy(), first_pair, lists.splat_pairs, lists.pair_splat
            ),
            count * 8 + n * 24,
        ),
        "blend": (
            lambda: blend_forward(
                r.tiles, tiles_x, r.tile_blocks, lists, r.projection, background, r.blended
            ),
            count * 42 + pixels * 20,
        ),
        "L1 + SSIM, both ways": (
            lambda: image_gradient(r.image, target, bands, SSIM_WEIGHT, v_image),
            pixels * (12 + 3 + 12),
        ),
        "blend backward": (
            lambda: blend_backward(
                r.tiles,
                tiles_x,
                lists,
                r.blended,
                wanted,
                columns,
                background,
                v_image,
                zero,
                pair_gradients,
            ),
            count * (46 + 36) + pixels * 24,
        ),
        "project backward": (
            lambda: project_backward(
                rows,
                parameters,
                face,
                frames,
                3,
                False,
                False,
                columns,
                lists,
                pair_gradients,
                gradients,
                screen_gradient,
            ),
            count * 36 + len(rows) * (59 * 2 + 16) * 4,
        ),
        "Adam": (lambda: adam.step(state, rows, RATES), len(rows) * 59 * 4 * 9),
    }
    return {name: (median_ms(call, repeats, clock), moved) for name, (call, moved) in work.items()}


def global_step(
    splats: Splats,
    mesh: np.ndarray,
    faces: np.ndarray,
    camera: Camera,
    target: np.ndarray,
    device: str = "cpu",
) -> tuple[Any, Batch]:
    """The backend of whole iterations, from the posed mesh's frames on, and their global batch;
    device: one of `choose_device`."""
    poses = lambda timestep: mesh, lambda timestep, zero_pose: mesh
    capture = Capture(Path(), "", faces, mesh, {}, (0,), {}, *poses)
    given = make_settings(iterations=1), FrameStore(capture, "stga"), new_state(splats)
    view = View(0, 0, camera, "benchmark", Path())
    batch = Batch(view, target, None, np.ones(3, np.float32), 3, None, RATES)
    return make_backend(device, *given), batch


def two_regions(
    splats: Splats, mesh: np.ndarray, faces: np.ndarray, share: float, head: str = "bundled"
) -> np.ndarray:
    """(F,) bool: triangles nearest to two points on the front (an eye, the mouth), with `share` of
    the splats."""
    center = mesh[faces].mean(1)
    away = np.minimum(*(np.linalg.norm(center - p, axis=1) for p in REGIONS[head]))
    return np.asarray(away <= np.quantile(away[splats.face], share))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--head", choices=tuple(REGIONS), default="bundled")
    parser.add_argument("--splats", type=int, default=60_000)
    parser.add_argument("--width", type=int, default=802)
    parser.add_argument("--height", type=int, default=550)
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--opensplat", type=Path, metavar="FOLDER")
    parser.add_argument(
        "--processor-time", action="store_true", help="of the CPU, for a loaded machine"
    )
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    make_head = {"bundled": bundled_head, "ellipsoid": ellipsoid}[options.head]
    splats, mesh, faces = make_head(options.splats, rng)
    camera = front_camera(options.width, options.height)
    target = rng.integers(0, 256, (options.height, options.width, 3)).astype(np.uint8)
    device, reason = choose_device(options.device)
    print(reason)
    backend, batch = global_step(splats, mesh, faces, camera, target, device)
    clock = time_of_a_thread if options.processor_time else perf_counter
    frames = frames_in_camera(face_frames(mesh, faces, mesh), camera)
    found = {}
    if device == "cpu":
        found = cpu_table(splats, frames, target, options.repeats, clock)
        print(f"{'sum of stages':<22}{sum(found.values()):8.2f}")
    if options.opensplat:
        compare_opensplat(options.opensplat, splats, frames, target, options.repeats)

    def measure(batch: Batch) -> float:
        # a GPU is at most two iterations behind, so that it is its time, too
        return median_ms(lambda: backend.step(batch), options.repeats, clock)

    whole = measure(batch)
    print(f"{'whole iteration':<22}{whole:8.2f}")
    parts = {}
    for share in (0.05, 0.1, 0.2, 0.4):
        parts[share] = measure(
            replace(batch, selected=two_regions(splats, mesh, faces, share, options.head))
        )
        ratio = parts[share] / whole
        print(f"local, {share:4.0%} selected   {parts[share]:8.2f}   {ratio:.2f} of a global one")
    if options.out:
        result = {"stages_ms": found, "global_ms": whole, "local_ms": parts}
        options.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def instruction_set() -> str:
    """The processor that the kernels are compiled for, as LLVM calls it, and its vector
    instructions."""
    features = get_host_cpu_features().split(",")
    vectors = [f[1:] for f in features if f.startswith(("+avx", "+neon", "+sve", "+fma"))]
    cpu = config.CPU_NAME  # type: ignore[attr-defined]  # read from the environment
    return f"{cpu or get_host_cpu_name()}: {' '.join(vectors)}"


def cpu_table(
    splats: Splats, frames, target: np.ndarray, repeats: int, clock: Callable[[], float]
) -> dict[str, float]:
    """Print the stages beside their floors; returns their times."""
    bandwidth = copy_bandwidth()
    print(f"{threads()} threads, copy {bandwidth / 1e9:.1f} GB/s, {instruction_set()}")
    found = stages(splats, frames, target, repeats, clock)
    print(f"{'stage':<22}{'ms':>8}{'MB':>8}{'floor ms':>10}{'ratio':>7}")
    for name, (ms, moved) in found.items():
        floor = 1e3 * moved / bandwidth
        print(f"{name:<22}{ms:8.2f}{moved / 1e6:8.1f}{floor:10.2f}{ms / floor:7.1f}")
    rate = arithmetic_rate(clock)
    ms = found["L1 + SSIM, both ways"][0]
    floor = 1e3 * target.shape[0] * target.shape[1] * LOSS_OPERATIONS / rate
    print(f"{rate / 1e9:.0f} billion multiply-adds a second:", end=" ")
    print(f"L1 + SSIM at least {floor:.2f} ms, ratio {ms / floor:.1f}")
    return {name: ms for name, (ms, _) in found.items()}


def compare_opensplat(
    folder: Path, splats: Splats, frames, target: np.ndarray, repeats: int
) -> None:
    """Print the wall time of both rasterizers for an image, its loss and the splats' gradients."""
    import opensplat  # needs a C++ compiler

    state = new_state(splats)
    buffers = BufferPool()
    background = np.ones(3, np.float32)
    face = state.face
    gradients = state.gradients
    rectangles = whole_image(*target.shape[:2])
    v_image = np.empty((3, *target.shape[:2]), "f4")

    def forward():
        return render_forward(state.parameters, face, frames, 3, background, buffers=buffers)

    def both_ways():
        output = forward()
        image_gradient(output.image, target, rectangles, SSIM_WEIGHT, v_image)
        render_backward(output, state.parameters, face, frames, v_image, gradients, buffers=buffers)

    output = forward()
    visible = output.lists.visible
    image = output.image.copy()
    theirs = opensplat.both_ways_ms(
        folder, output.projection, visible, image, target, SSIM_WEIGHT, min(repeats, 9)
    )
    for name, run, peer in (("forward", forward, theirs[0]), ("both ways", both_ways, theirs[1])):
        ours = median_ms(run, repeats, perf_counter)
        print(f"OpenSplat {name:<12}{peer:8.2f}   ours, with projection, {ours:.2f}:", end=" ")
        print(f"{peer / ours:.1f} times as fast")


if __name__ == "__main__":
    main()
