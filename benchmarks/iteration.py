"""What one training iteration costs, stage by stage, globally and on a part of the splats.

    python benchmarks/iteration.py [--splats 60000] [--width 802] [--height 550] [--repeats 30] [--out FILE.json]

A head-shaped ellipsoid of embedded splats, SH degree 3. Medians over repeats in one process; beside each stage the
bytes it must at least move and the time that takes at this machine's measured copy bandwidth. Run it on an idle
machine.
"""

import argparse
import json
import statistics
from collections.abc import Callable
from pathlib import Path
from time import perf_counter

import numba
import numpy as np
import trimesh

from stga_addon.avatar.embedding import face_frames
from stga_addon.avatar.splats import Splats
from stga_addon.capture.camera import Camera
from stga_addon.raster.kernels.bins import count_pairs, depth_order, fill_pairs
from stga_addon.raster.kernels.blend import blend_backward, blend_forward
from stga_addon.raster.kernels.project import project_backward, project_forward
from stga_addon.raster.render import Parameters, Scratch, camera_frames, render_backward, render_forward, touched_tiles
from stga_addon.training import adam
from stga_addon.training.losses import REACH, image_gradient, tile_rectangles, whole_image
from stga_addon.training.state import new_state

RATES = {"xyz": 1e-9, "rotation": 1e-9, "log_scale": 1e-9, "opacity": 1e-9, "sh": 1e-9, "sh_rest": 1e-9}


def head(count: int, rng: np.random.Generator) -> tuple[Splats, np.ndarray, np.ndarray]:
    """`count` splats on an ellipsoid of about 20,000 triangles; with its vertices (V, 3) and faces (F, 3)."""
    sphere = trimesh.creation.icosphere(subdivisions=5)
    vertices, faces = sphere.vertices * [0.08, 0.11, 0.09], np.asarray(sphere.faces, np.int32)
    face = rng.integers(0, len(faces), count).astype(np.int32)
    splats = Splats(
        xyz=(rng.normal(size=(count, 3)) * 0.001).astype(np.float32),
        rotation=rng.normal(size=(count, 4)).astype(np.float32),
        log_scale=np.log(0.0012 + 0.0006 * rng.random((count, 3))).astype(np.float32),
        opacity=(rng.normal(size=count) + 1).astype(np.float32),
        sh=(rng.normal(size=(count, 16, 3)) * 0.1).astype(np.float32),
        face=face,
        loose=np.zeros(count, bool),
    )
    return splats, vertices, faces


def median_ms(work: Callable[[], object], repeats: int) -> float:
    """Median wall time of `work` in milliseconds, after two calls that are not counted."""
    times = []
    for _ in range(repeats + 2):
        begin = perf_counter()
        work()
        times.append(1e3 * (perf_counter() - begin))
    return statistics.median(times[2:])


def copy_bandwidth() -> float:
    """Bytes a second, read and written, of a copy of 256 MB."""
    source = np.ones(1 << 26, np.float32)
    target = np.empty_like(source)
    return 2 * source.nbytes / (median_ms(lambda: np.copyto(target, source), 5) / 1e3)


def stages(splats: Splats, seen, target: np.ndarray, repeats: int) -> dict[str, tuple[float, int]]:
    """stage -> (median ms, bytes that it must move at least)."""
    n, camera = len(splats), seen.camera
    pixels, background = camera.width * camera.height, np.ones(3, np.float32)
    tiles_x, tiles_y = -(-camera.width // 16), -(-camera.height // 16)
    state, scratch = new_state(splats), Scratch()
    arrays, face = state.arrays(), state.face.numpy()
    gradients = Parameters(*(g.numpy() for g in state.gradients))
    r = render_forward(arrays, face, seen, 3, background, scratch=scratch)
    projected, depth = np.empty_like(r.projected), np.empty(n, np.float32)
    extent_y, rect = np.empty(n, np.float32), np.empty((n, 4), np.int32)
    project = (
        *arrays, 3, face, seen.origin, seen.matrix, seen.to_world, seen.lens, seen.size, False,
        projected, depth, extent_y, rect,
    )  # fmt: skip
    project_forward(*project)
    order = depth_order(depth, r.visible)
    pairs = len(r.pair_slot)
    v_image, screen = np.empty_like(r.image), np.empty(n, np.float32)
    bands = whole_image(camera.height, camera.width)
    zero, wanted = np.zeros_like(r.transmittance), np.ones(n, bool)
    pair_gradients = np.empty((pairs, 9), np.float32)
    rows = r.visible
    work = {
        "project": (lambda: project_forward(*project), n * (59 + 16) * 4),
        "sort by depth": (lambda: depth_order(depth, r.visible), len(rows) * 6 * 8),
        "count pairs": (lambda: count_pairs(rect, order, tiles_x, tiles_y, r.slot_start, r.slot_count), n * 24),
        "fill pairs": (
            lambda: fill_pairs(rect, order, tiles_x, tiles_y, r.slot_start, r.start, 2, r.pair_splat, r.pair_slot),
            pairs * 8 + n * 20,
        ),
        "blend": (
            lambda: blend_forward(
                r.tiles, tiles_x, r.start, r.pair_splat, r.projected, r.extent_y, background, r.image,
                r.transmittance, r.last,
            ),
            pairs * 44 + pixels * 20,
        ),
        "L1 + SSIM, both ways": (
            lambda: image_gradient(r.image, target, bands, 0.2, v_image),
            pixels * (12 + 3 + 12),
        ),
        "blend backward": (
            lambda: blend_backward(
                r.tiles, tiles_x, r.start, r.pair_splat, r.pair_slot, wanted, r.projected, r.extent_y, background,
                r.transmittance, r.last, v_image, zero, pair_gradients,
            ),
            pairs * (48 + 36) + pixels * 24,
        ),
        "project backward": (
            lambda: project_backward(
                *arrays, 3, face, seen.origin, seen.matrix,
                seen.to_world, seen.lens, seen.size, False, r.projected, rows, r.slot_start, r.slot_count,
                pair_gradients, False, *gradients, screen,
            ),
            pairs * 36 + len(rows) * (59 * 2 + 16) * 4,
        ),
        "Adam": (lambda: adam.step(state, rows, RATES), len(rows) * 59 * 4 * 7),
    }  # fmt: skip
    return {name: (median_ms(call, repeats), moved) for name, (call, moved) in work.items()}


def iteration(splats: Splats, mesh: np.ndarray, faces: np.ndarray, camera: Camera, target: np.ndarray):
    """A function that runs one whole iteration, from the posed mesh's frames on; `focus` as in `render_forward`."""
    frames = face_frames(mesh, faces, mesh)
    state, scratch = new_state(splats), Scratch()
    gradients = Parameters(*(g.numpy() for g in state.gradients))
    background = np.ones(3, np.float32)

    def run(focus: np.ndarray | None = None) -> None:
        seen = camera_frames(frames, camera)
        arrays, face = state.arrays(), state.face.numpy()
        r = render_forward(arrays, face, seen, 3, background, focus, REACH, scratch=scratch)
        rectangles = whole_image(camera.height, camera.width)
        if focus is not None:
            tiles = touched_tiles(r, focus)
            rectangles = tile_rectangles(tiles, camera.height, camera.width)
        v_image = scratch.take("v_image", r.image.shape)
        image_gradient(r.image, target, rectangles, 0.2, v_image)
        rows, _ = render_backward(r, arrays, face, seen, v_image, gradients, focus=focus, scratch=scratch)
        adam.step(state, rows, RATES)

    return run


def two_regions(splats: Splats, mesh: np.ndarray, faces: np.ndarray, share: float) -> np.ndarray:
    """(N,) bool: the splats nearest to two points on the front (an eye and the mouth, say) that make up `share`."""
    centre = mesh[faces].mean(1)[splats.face]
    away = np.minimum(*(np.linalg.norm(centre - p, axis=1) for p in ([0.03, -0.04, -0.08], [0.0, 0.06, -0.07])))
    return away <= np.quantile(away, share)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--splats", type=int, default=60_000)
    parser.add_argument("--width", type=int, default=802)
    parser.add_argument("--height", type=int, default=550)
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    rng = np.random.default_rng(0)
    splats, mesh, faces = head(options.splats, rng)
    view = np.eye(4)
    view[2, 3] = 1.0
    size = options.width, options.height
    camera = Camera(*size, 2.43 * size[0], 2.43 * size[0], size[0] / 2, size[1] / 2, view)
    target = rng.integers(0, 256, (options.height, options.width, 3)).astype(np.uint8)
    seen = camera_frames(face_frames(mesh, faces, mesh), camera)

    bandwidth = copy_bandwidth()
    print(f"{numba.get_num_threads()} threads, copy {bandwidth / 1e9:.1f} GB/s")
    found = stages(splats, seen, target, options.repeats)
    print(f"{'stage':<22}{'ms':>8}{'MB':>8}{'floor ms':>10}{'ratio':>7}")
    for name, (ms, moved) in found.items():
        floor = 1e3 * moved / bandwidth
        print(f"{name:<22}{ms:8.2f}{moved / 1e6:8.1f}{floor:10.2f}{ms / floor:7.1f}")
    run = iteration(splats, mesh, faces, camera, target)
    whole = median_ms(run, options.repeats)
    print(f"{'sum of stages':<22}{sum(ms for ms, _ in found.values()):8.2f}")
    print(f"{'whole iteration':<22}{whole:8.2f}")
    parts = {}
    for share in (0.05, 0.1, 0.2, 0.4):
        focus = two_regions(splats, mesh, faces, share)
        parts[share] = median_ms(lambda focus=focus: run(focus), options.repeats)
        print(f"local, {share:4.0%} selected   {parts[share]:8.2f}   {parts[share] / whole:.2f} of a global one")
    if options.out:
        result = {"stages_ms": {k: v[0] for k, v in found.items()}, "global_ms": whole, "local_ms": parts}
        options.out.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
