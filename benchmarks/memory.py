"""Benchmark of memory: peak of a training run, for a short sequence and a long one.

    python benchmarks/memory.py [--timesteps 12 1200] [--views 15] [--width 802] [--height 550] [--iterations 400]

A mesh capture of a head-shaped ellipsoid is written to a temporary folder; all timesteps share a few image and mesh
files on disk, which are read and decoded for each timestep. Every run is a process of its own, whose peak
(VmHWM) is read at its end.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from stga_addon.capture.camera import look_at

RUN = """
import sys
from pathlib import Path
from stga_addon.capture.open import open_capture
from stga_addon.training.run.folder import Run
from stga_addon.training.evaluate.metrics import peak_memory_mb
from stga_addon.training.run.loop import train
from stga_addon.training.settings import make_settings
root, iterations = Path(sys.argv[1]), int(sys.argv[2])
capture = open_capture(root)
settings = make_settings(iterations=iterations, lattice=1, hull_points=False)
train(capture, root / "run", Run(root, None, "vhap", settings))
print(peak_memory_mb())
"""


def write_capture(root: Path, timesteps: int, views: int, width: int, height: int) -> None:
    """A mesh capture whose every timestep links to the same `views` images and to one of twelve meshes."""
    head = trimesh.creation.icosphere(subdivisions=5)
    vertices, faces = head.vertices * [0.08, 0.11, 0.09], head.faces
    (root / "images").mkdir()
    (root / "meshes").mkdir()
    rng = np.random.default_rng(0)
    for camera in range(views):
        coarse = rng.integers(0, 256, (height // 8 + 1, width // 8 + 1, 3), np.uint8)
        Image.fromarray(coarse).resize((width, height), Image.Resampling.BICUBIC).save(root / f"images/{camera}.png")
    for n in range(12):
        moved = vertices + 0.001 * n * (vertices[:, 1:2] < 0) * [0, -1, 0]
        trimesh.Trimesh(moved, faces, process=False).export(root / f"meshes/{n}.obj")
    angles = [2 * math.pi * camera / views for camera in range(views)]
    eyes = [(math.sin(angle), 0.0, math.cos(angle)) for angle in angles]
    poses = [look_at(eye, (0, 0, 0), width, height, 2.43 * width).camera_to_world_gl for eye in eyes]
    entries = []
    for timestep in range(timesteps):
        mesh = f"meshes/{timestep:05d}.obj"
        os.link(root / f"meshes/{timestep % 12}.obj", root / mesh)
        for camera in range(views):
            image = f"images/{timestep:05d}_{camera:02d}.png"
            os.link(root / f"images/{camera}.png", root / image)
            entries.append(
                {
                    "timestep_index": timestep,
                    "camera_index": camera,
                    "camera_id": str(camera),
                    "file_path": image,
                    "mesh_path": mesh,
                    "transform_matrix": poses[camera].tolist(),
                }
            )
    lens = {"fl_x": 2.43 * width, "fl_y": 2.43 * width, "cx": width / 2, "cy": height / 2, "w": width, "h": height}
    shared = {**lens, "canonical_mesh_path": "meshes/0.obj"}
    (root / "transforms_train.json").write_text(json.dumps({**shared, "frames": entries}), encoding="utf-8")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--timesteps", type=int, nargs="+", default=[12, 1200])
    parser.add_argument("--views", type=int, default=15)
    parser.add_argument("--width", type=int, default=802)
    parser.add_argument("--height", type=int, default=550)
    parser.add_argument("--iterations", type=int, default=400)
    options = parser.parse_args()
    for timesteps in options.timesteps:
        with tempfile.TemporaryDirectory() as folder:
            write_capture(Path(folder), timesteps, options.views, options.width, options.height)
            command = [sys.executable, "-c", RUN, folder, str(options.iterations)]
            done = subprocess.run(command, capture_output=True, text=True, check=True)
        print(f"{timesteps:6d} timesteps of {options.views} views: {done.stdout.split()[-1]} MiB")


if __name__ == "__main__":
    main()
