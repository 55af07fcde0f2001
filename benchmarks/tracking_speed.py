"""Time and memory of `stga track` on synthetic footage: landmarks, fit and smoothing of a long take.

    python benchmarks/tracking_speed.py [--timesteps 300] [--cameras 16] [--size 550x802] [--landmarks]

Renders a few pictures of the demo's head per camera, which are shown again and again, tracks them, and prints the time
of each stage and the peak memory; with --landmarks, exact landmarks take the detector's place, so that only fit,
contact sheet and files are measured. Run it on a quiet machine. Of a further timestep, landmarks and points
are kept, about 0.5 MB for 16 cameras; images are not.
"""

import argparse
import os
import tempfile
from pathlib import Path
from time import perf_counter

import numpy as np
from PIL import Image

from stga_addon.capture.camera import Camera, look_at
from stga_addon.capture.transforms import camera_entry
from stga_addon.development.demo.head import synthetic_flame, write_flame
from stga_addon.files import write_json, write_npz
from stga_addon.flame.forward import FlameFrame, flame_forward
from stga_addon.flame.model import FlameModel
from stga_addon.tracking.correspondence import nearest_points
from stga_addon.tracking.folder import PLACES_FILE
from stga_addon.tracking.footage.open import open_footage
from stga_addon.tracking.landmarks import write_places
from stga_addon.tracking.mesh_image import shaded_image
from stga_addon.tracking.track import track
from stga_addon.training.evaluate.metrics import peak_memory_mb

CYCLE = 12
"""Different pictures of each camera."""
LANDMARKS = 478


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--timesteps", type=int, default=300)
    parser.add_argument("--cameras", type=int, default=16)
    parser.add_argument("--size", default="550x802")
    parser.add_argument("--landmarks", action="store_true")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        measure(Path(name), options)


def measure(folder: Path, options: argparse.Namespace) -> None:
    """Make the footage, track it, and print a row in Markdown for each stage."""
    model = synthetic_flame(0)
    write_flame(model, folder / "head.npz")
    meshes = [flame_forward(model, np.zeros(model.n_identity), frame_at(model, t)) for t in range(CYCLE)]
    cameras = rig(options.cameras, *map(int, options.size.split("x")))
    write_footage(folder / "footage", cameras, meshes, model.faces, options.timesteps)
    if options.landmarks:
        write_exact_landmarks(folder / "points", cameras, meshes, model, options.timesteps)
    footage, stages = open_footage(folder / "footage"), Stages()
    points = folder / "points" if options.landmarks else None
    track(footage, folder / "head.npz", folder / "out", points, mattes=False, report=stages.report)
    stages.end()
    print("| stage | seconds |\n| --- | --- |")
    for stage, seconds in stages.seconds.items():
        print(f"| {stage} | {seconds:.1f} |")
    total = sum(stages.seconds.values())
    print(f"\n{options.timesteps} timesteps x {len(cameras)} cameras at {options.size}: {total:.0f} s, ", end="")
    print(f"{os.cpu_count()} processors, peak memory {peak_memory_mb():,.0f} MB")


class Stages:
    """Adds up the seconds of each stage of `track`."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._stage, self._since = "Opening", perf_counter()

    def report(self, stage: str, done: int, total: int) -> None:
        if stage != self._stage:
            self.end()
            self._stage = stage

    def end(self) -> None:
        now = perf_counter()
        self.seconds[self._stage] = self.seconds.get(self._stage, 0.0) + now - self._since
        self._since = now


def frame_at(model: FlameModel, timestep: int) -> FlameFrame:
    """A head that nods and opens its mouth, once in a cycle."""
    phase, zero = 2 * np.pi * timestep / CYCLE, np.zeros(3)
    jaw, turn = np.array([0.1 - 0.1 * np.cos(phase), 0, 0]), np.array([0.05 * np.sin(phase), 0.1 * np.cos(phase), 0])
    return FlameFrame(np.zeros(model.n_expression), turn, zero, jaw, zero, np.zeros(6))


def rig(count: int, width: int, height: int) -> list[Camera]:
    """Cameras on an arc in front of the head."""
    eyes = [(np.sin(a), 0.1 * (-1) ** k, np.cos(a)) for k, a in enumerate(np.linspace(-0.9, 0.9, count))]
    return [look_at(eye, (0, -0.02, 0), width, height, 2.6 * width) for eye in eyes]


def write_footage(
    folder: Path, cameras: list[Camera], meshes: list[np.ndarray], faces: np.ndarray, timesteps: int
) -> None:
    """transforms.json and PNGs; the pictures of later cycles are links to those of the first."""
    frames = []
    for number, camera in enumerate(cameras):
        pictures = [folder / f"images/{number:02d}_{t:05d}.png" for t in range(timesteps)]
        pictures[0].parent.mkdir(parents=True, exist_ok=True)
        for timestep, path in enumerate(pictures):
            if timestep < CYCLE:
                Image.fromarray(shaded_image(meshes[timestep], faces, camera)).save(path, compress_level=1)
            else:
                os.link(pictures[timestep % CYCLE], path)
            frames.append(
                {
                    "file_path": path.relative_to(folder).as_posix(),
                    "timestep_index": timestep,
                    "camera_id": f"cam{number}",
                    **camera_entry(camera),
                }
            )
    write_json(folder / "transforms.json", {"frames": frames})


def write_exact_landmarks(
    folder: Path, cameras: list[Camera], meshes: list[np.ndarray], model: FlameModel, timesteps: int
) -> None:
    """Landmark files of random points on the front of the head."""
    front = model.v_template[model.v_template[:, 2] > 0.04]
    chosen = front[np.random.default_rng(0).choice(len(front), LANDMARKS)]
    places, _ = nearest_points(model.v_template, model.faces, chosen)
    write_places(folder / PLACES_FILE, places, np.ones(LANDMARKS, bool))
    for number, camera in enumerate(cameras):
        cycle = [camera.project(places.on(mesh, model.faces))[0] for mesh in meshes]
        points = np.stack([cycle[t % CYCLE] for t in range(timesteps)])
        write_npz(folder / f"cam{number}.npz", {"timesteps": np.arange(timesteps), "points": points})


if __name__ == "__main__":
    main()
