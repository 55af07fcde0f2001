"""What Blender spends on a head: import and selection groups (playback: redraw.py).

    python benchmarks/blender.py [--repeats 3]

Needs the module bpy. Medians over repeats, each in an empty file. Run it on an idle machine.
"""

import argparse
import statistics
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np
import trimesh

from stga_addon.capture.model import Capture
from stga_addon.development.demo.head import synthetic_flame
from stga_addon.flame.forward import neutral_frame
from stga_addon.flame.sequence import FlameSequence, neutral_mesh
from stga_addon.scene.blend_file import new_file
from stga_addon.scene.rig.head import import_head
from stga_addon.scene.vertex_groups import read_selection, write_selection


def moving_ball(folder: Path, timesteps: int, subdivisions: int) -> Capture:
    """A mesh capture without cameras: a ball that grows a little every timestep."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=0.1)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces, np.int32)
    meshes = [vertices * (1 + 1e-4 * t) for t in range(timesteps)]
    return Capture(
        folder, "mesh", faces, vertices, {}, tuple(range(timesteps)), {}, meshes.__getitem__, lambda t, zero: meshes[t]
    )


def median_s(work: Callable[[], object], repeats: int) -> float:
    """Median wall time of `work` in seconds, each time in an empty file."""
    times = []
    for _ in range(repeats):
        new_file()
        begin = perf_counter()
        work()
        times.append(perf_counter() - begin)
    return statistics.median(times)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=3)
    repeats = parser.parse_args().repeats
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        frames = moving_ball(folder, 300, 4)
        print(f"import 300 frames of {len(frames.neutral)} vertices: "
              f"{median_s(lambda: import_head(frames), repeats):.2f} s")  # fmt: skip

        model = synthetic_flame(0)
        one = replace(neutral_frame(model), expr=np.full(model.n_expression, 0.1))
        sequence = FlameSequence(model, np.zeros(model.n_identity), None, tuple(range(1000)), lambda timestep: one)
        neutral = neutral_mesh(sequence)
        motion = Capture(folder, "flame", model.faces, neutral, {}, sequence.timesteps, {}, lambda timestep: neutral,
                         lambda timestep, zero_pose: neutral, sequence)  # fmt: skip
        print(f"import 1,000 FLAME frames, {model.n_expression} expressions, {len(model.v_template)} vertices: "
              f"{median_s(lambda: import_head(motion), repeats):.2f} s")  # fmt: skip

        still = moving_ball(folder, 1, 4)
        chosen = dict(enumerate(np.random.default_rng(0).random((1000, len(still.faces))) < 0.1))
        new_file()
        head = import_head(still)
        begin = perf_counter()
        write_selection(head, chosen)
        written = perf_counter()
        read_selection(head)
        print(f"1,000 groups, 10 % of {len(still.faces)} triangles: write {written - begin:.2f} s, "
              f"read {perf_counter() - written:.2f} s")  # fmt: skip


if __name__ == "__main__":
    main()
