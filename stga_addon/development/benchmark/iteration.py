"""What one training iteration costs, stage by stage, globally and on a part of the splats.

    python -m stga_addon.development.benchmark.iteration [--head ellipsoid] [--splats 60000]
        [--width 802] [--height 550] [--repeats 30] [--device gpu] [--opensplat FOLDER]
        [--processor-time]

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
import statistics
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np
import trimesh
from llvmlite.binding import get_host_cpu_name
from numba.core import config
from numba.core.codegen import get_host_cpu_features

from ...avatar.embedding import face_areas, face_frames
from ...avatar.splats import Splats
from ...capture.camera import Camera
from ...capture.model import Capture, View
from ...flame.parts import flame_model
from ...raster.cpu.blend import blend_backward, blend_forward
from ...raster.cpu.layout import PROJECTED, CameraFrames
from ...raster.cpu.project import project_backward, project_forward
from ...raster.cpu.rasterize import (
    BufferPool,
    RenderOutput,
    frames_in_camera,
    render_backward,
    render_forward,
    sort_into_tiles,
    tile_grid,
)
from ...raster.cpu.threads import call_helpers, parallel, pieces, threads
from ...raster.cpu.tiles import sum_tiles
from ...raster.devices import choose_device
from ...training.optimize import adam
from ...training.optimize.backend import Batch, RenderOptions
from ...training.optimize.frames import FrameStore
from ...training.optimize.image_loss import image_gradient, whole_image
from ...training.optimize.make_backend import make_backend
from ...training.optimize.state import TrainState, new_state
from ...training.schedule import learning_rates
from ...training.settings import make_settings

RATES = dict.fromkeys(learning_rates(make_settings(iterations=1).rates, 0), 1e-9)
"""Learning rates, so small that the splats do not change while they are timed."""
SSIM_WEIGHT = 0.2
"""Weight of SSIM in the image loss."""
LOSS_STAGE = "L1 + SSIM, both ways"
"""Name of the image loss in the table."""
LOSS_OPERATIONS = 3 * (14 * 11 + 28 + 12)
"""Arithmetic operations of the image loss per pixel: in each channel, 14 blurs of 11 values, SSIM
with its derivatives, and the rest. `tests/raster/test_assembly.py` counts them in the assembly."""

REGIONS = {
    "bundled": ([0.031, 0.036, 0.09], [0.0, -0.034, 0.11]),
    "ellipsoid": ([0.03, -0.04, 0.08], [0.0, 0.06, 0.07]),
}
"""Head -> centers of its selected regions: an eye and the mouth."""


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
"""Multiply-adds in sequence of each value in `multiply_add_rows`."""


@parallel(lambda rows: len(rows), piece=16)
def multiply_add_rows(work, rows):
    """Sixteen multiply-adds of each value of rows (R, 256) float32, 100 times over."""
    call_helpers(work)
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


Stage = tuple[Callable[[], object], int]
"""A stage's function, and the least number of bytes that it must move."""
BACKGROUND = np.ones(3, np.float32)


@dataclass(frozen=True)
class Rendered:
    """An image that was rendered, of which each stage can be repeated."""

    state: TrainState
    frames: CameraFrames
    output: RenderOutput
    buffers: BufferPool

    @property
    def pairs(self) -> int:
        return len(self.output.lists.pair_splat)


def rendered(splats: Splats, frames: CameraFrames) -> Rendered:
    state = new_state(splats)
    buffers = BufferPool()
    output = render_forward(state.parameters, state.face, frames, 3, BACKGROUND, buffers=buffers)
    return Rendered(state, frames, output, buffers)


def listing_stages(image: Rendered) -> dict[str, Stage]:
    """The stages until every tile has its list of splats."""
    state = image.state
    frames = image.frames
    output = image.output
    n = len(state.face)
    tiles_x, tiles_y = tile_grid(*frames.size.tolist())
    everything = np.ones(n, bool)
    everywhere = sum_tiles(np.ones((tiles_y, tiles_x), bool))

    def project() -> object:
        return project_forward(
            everything,
            everywhere,
            state.parameters,
            state.face,
            frames,
            3,
            False,
            False,
            output.projection,
        )

    def sort() -> object:
        return sort_into_tiles(output.projection, tiles_x, output.tile_blocks, image.buffers)

    sorted_bytes = n * 80 + len(output.lists.visible) * 44 + image.pairs * 8
    return {
        "project": (project, n * (59 + 16) * 4),
        "sort into tiles": (sort, sorted_bytes),
    }


def pixel_stages(image: Rendered, target: np.ndarray, v_image: np.ndarray) -> dict[str, Stage]:
    """Blending, and the image loss, which writes its gradient into `v_image`."""
    output = image.output
    width, height = image.frames.size.tolist()
    tiles_x, _ = tile_grid(width, height)
    pixels = width * height
    bands = whole_image(height, width)

    def blend() -> object:
        return blend_forward(
            output.tiles,
            tiles_x,
            output.tile_blocks,
            output.lists,
            output.projection,
            BACKGROUND,
            output.blended,
        )

    return {
        "blend": (blend, image.pairs * 42 + pixels * 20),
        LOSS_STAGE: (
            lambda: image_gradient(output.image, target, bands, SSIM_WEIGHT, v_image),
            pixels * (12 + 3 + 12),
        ),
    }


def gradient_stages(image: Rendered, v_image: np.ndarray) -> dict[str, Stage]:
    """From the image's gradient to the splats' step."""
    state = image.state
    output = image.output
    rows = output.lists.visible
    columns = output.projection.columns
    width, height = image.frames.size.tolist()
    tiles_x, _ = tile_grid(width, height)
    zero = np.zeros_like(output.transmittance)
    wanted = np.ones(len(state.face), bool)
    pair_gradients = np.empty((image.pairs, PROJECTED), np.float32)
    screen_gradient = np.empty(len(state.face), np.float32)

    def blend() -> object:
        return blend_backward(
            output.tiles,
            tiles_x,
            output.lists,
            output.blended,
            wanted,
            columns,
            BACKGROUND,
            v_image,
            zero,
            pair_gradients,
        )

    def project() -> object:
        return project_backward(
            rows,
            state.parameters,
            state.face,
            image.frames,
            3,
            False,
            False,
            columns,
            output.lists,
            pair_gradients,
            state.gradients,
            screen_gradient,
            adam.color_step(state, RATES),
        )

    return {
        "blend backward": (blend, image.pairs * (46 + 36) + width * height * 24),
        "project backward, colors' Adam": (
            project,
            image.pairs * 36 + len(rows) * (11 * 2 + 48 * 8 + 16) * 4,
        ),
        "Adam of the rest": (lambda: adam.step(state, rows, RATES), len(rows) * 11 * 4 * 9),
    }


def stages(
    splats: Splats,
    frames: CameraFrames,
    target: np.ndarray,
    repeats: int,
    clock: Callable[[], float],
) -> dict[str, tuple[float, int]]:
    """stage -> (median ms, bytes that it must move at least)."""
    image = rendered(splats, frames)
    v_image = np.empty_like(image.output.image)
    work = {
        **listing_stages(image),
        **pixel_stages(image, target, v_image),
        **gradient_stages(image, v_image),
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
    capture = Capture(Path(), "", faces, mesh, {"train": ()}, (0,), {}, *poses)
    given = make_settings(iterations=1), FrameStore(capture, "stga"), new_state(splats)
    view = View(0, 0, camera, "benchmark", Path())
    batch = Batch(view, target, None, RenderOptions(np.ones(3, np.float32), 3), None, RATES)
    return make_backend(device, *given), batch


def two_regions(
    splats: Splats, mesh: np.ndarray, faces: np.ndarray, fraction: float, head: str = "bundled"
) -> np.ndarray:
    """(F,) bool: triangles nearest to two points on the front (an eye, the mouth), with `fraction`
    of the splats."""
    center = mesh[faces].mean(1)
    away = np.minimum(*(np.linalg.norm(center - p, axis=1) for p in REGIONS[head]))
    return np.asarray(away <= np.quantile(away[splats.face], fraction))


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
    if device == "cpu":
        print_stages(splats, frames, target, options.repeats, clock)
    if options.opensplat:
        compare_opensplat(options.opensplat, splats, frames, target, options.repeats)

    def measure(batch: Batch) -> float:
        # a GPU is at most two iterations behind, so that it is its time, too
        return median_ms(lambda: backend.step(batch), options.repeats, clock)

    whole = measure(batch)
    print(f"{'whole iteration':<31}{whole:8.2f}")
    for fraction in (0.05, 0.1, 0.2, 0.4):
        selected = two_regions(splats, mesh, faces, fraction, options.head)
        part = measure(replace(batch, selected=selected))
        name = f"local, {fraction:4.0%} selected"
        print(f"{name:<31}{part:8.2f}   {part / whole:.2f} of a global one")


def instruction_set() -> str:
    """The processor that the kernels are compiled for, as LLVM calls it, and its vector
    instructions."""
    features = get_host_cpu_features().split(",")
    vectors = [f[1:] for f in features if f.startswith(("+avx", "+neon", "+sve", "+fma"))]
    cpu = config.CPU_NAME  # type: ignore[attr-defined]  # read from the environment
    return f"{cpu or get_host_cpu_name()}: {' '.join(vectors)}"


def print_stages(
    splats: Splats,
    frames: CameraFrames,
    target: np.ndarray,
    repeats: int,
    clock: Callable[[], float],
) -> None:
    """Print the stages beside their floors, and their sum."""
    bandwidth = copy_bandwidth()
    print(f"{threads()} threads, copy {bandwidth / 1e9:.1f} GB/s, {instruction_set()}")
    found = stages(splats, frames, target, repeats, clock)
    print(f"{'stage':<31}{'ms':>8}{'MB':>8}{'floor ms':>10}{'ratio':>7}")
    for name, (ms, moved) in found.items():
        floor = 1e3 * moved / bandwidth
        print(f"{name:<31}{ms:8.2f}{moved / 1e6:8.1f}{floor:10.2f}{ms / floor:7.1f}")
    rate = arithmetic_rate(clock)
    ms = found[LOSS_STAGE][0]
    floor = 1e3 * target.shape[0] * target.shape[1] * LOSS_OPERATIONS / rate
    print(f"{rate / 1e9:.0f} billion multiply-adds a second:", end=" ")
    print(f"L1 + SSIM at least {floor:.2f} ms, ratio {ms / floor:.1f}")
    print(f"{'sum of stages':<31}{sum(ms for ms, _ in found.values()):8.2f}")


def compare_opensplat(
    folder: Path, splats: Splats, frames: CameraFrames, target: np.ndarray, repeats: int
) -> None:
    """Print the wall time of both rasterizers for an image, its loss and the splats' gradients."""
    from . import opensplat  # needs a C++ compiler

    state = new_state(splats)
    buffers = BufferPool()
    face = state.face
    gradients = state.gradients
    rectangles = whole_image(*target.shape[:2])
    v_image = np.empty((3, *target.shape[:2]), "f4")

    def forward():
        return render_forward(state.parameters, face, frames, 3, BACKGROUND, buffers=buffers)

    def both_ways():
        output = forward()
        image_gradient(output.image, target, rectangles, SSIM_WEIGHT, v_image)
        render_backward(output, state.parameters, face, frames, v_image, gradients, buffers=buffers)

    theirs = opensplat.both_ways_ms(folder, forward(), target, SSIM_WEIGHT, min(repeats, 9))
    for name, run, peer in (("forward", forward, theirs[0]), ("both ways", both_ways, theirs[1])):
        ours = median_ms(run, repeats, perf_counter)
        print(f"OpenSplat {name:<12}{peer:8.2f}   ours, with projection, {ours:.2f}:", end=" ")
        print(f"{peer / ours:.1f} times as fast")


if __name__ == "__main__":
    main()
