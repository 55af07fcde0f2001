"""Relighting against path-traced truth: one avatar trained under light A, shown under lights that
it never saw.

    python -m stga_addon.development.benchmark.relight FOLDER [FOLDER …] [--train 150s]
        [--folder out/relight] [--pictures]

Each FOLDER holds `capture_A` (a capture under light A whose head never turns), `truth_A` …
`truth_E` (captures of the same head and cameras with split "train": held-out views under each
light) and `lights.json`, which says what the lights are (`lighting`). Light A is not given; its
level is, as the colors of a gray ball. LPIPS needs STGA_LPIPS. Prints PSNR inside the mask / LPIPS
/ PSNR of eyes and mouth, and with --pictures writes pictures into the run.
"""

import argparse
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from ...avatar.file import Avatar, read_avatar
from ...capture.images import read_image, read_mask
from ...capture.mesh_geometry import rasterize
from ...capture.model import Capture, View
from ...capture.open import open_capture
from ...light.estimate import Known, estimate_light
from ...light.harmonics import basis, even_directions, uniform
from ...light.lamps import Lamps
from ...light.relight import Relighter
from ...light.values import Light, Lighting
from ...render.render import posed_avatar, render_avatar, render_layers
from ...training.evaluate.lpips import load_network
from ...training.evaluate.metrics import psnr

LIGHTS = "ABCDE"
SMALL_PARTS = "left_eye", "right_eye", "mouth"
CARD_REFLECTANCE = 0.18


def lighting(spec: dict, **options: object) -> Lighting:
    """Values of an entry of lights.json.

    area: rows of azimuth and elevation in degrees, power in W, side in meters, color; squares 1.2 m
    from the origin that face it. sun: azimuth, elevation, strength in W/m², angle in radians,
    color. world: steps of height from 0 (down, -y) to 1 and radiance, linear between.
    """
    lights = []
    for azimuth, elevation, power, side, color in spec["area"]:
        toward = direction(azimuth, elevation)
        tangent = np.cross((0, 1, 0), toward)
        lights.append(
            Light(
                "area",
                power * np.array(color),
                1.2 * toward,
                -toward,
                size=(side, side),
                tangent=tangent,
            )
        )
    for azimuth, elevation, strength, angle, color in spec["sun"]:
        lights.append(
            Light(
                "sun",
                strength * np.array(color),
                direction=-direction(azimuth, elevation),
                angle=angle,
            )
        )
    sky = even_directions(600)
    world = basis(sky).T @ world_radiance(spec, sky) * (4 * np.pi / len(sky))
    return Lighting(world, tuple(lights), **options)  # type: ignore[arg-type]


def world_radiance(spec: dict, directions: np.ndarray) -> np.ndarray:
    """(N, 3) radiance of the world in directions (N, 3)."""
    steps, colors = zip(*spec["world"], strict=True)
    height = directions[:, 1] / 2 + 0.5
    return np.stack(
        [np.interp(height, steps, channel) for channel in zip(*colors, strict=True)], axis=-1
    )


def direction(azimuth: float, elevation: float) -> np.ndarray:
    """(3,) unit vector towards a light; degrees, azimuth 0 is +z, 90 is +x."""
    a, e = np.radians([azimuth, elevation])
    return np.array([np.sin(a) * np.cos(e), np.sin(e), np.cos(a) * np.cos(e)])


BALL = np.array(
    [direction(azimuth, elevation) for azimuth in (-50, 0, 50) for elevation in (-30, 0, 30)]
)
"""(9, 3) normals of the gray ball that says how light the capture is."""


def gray_ball(spec: dict) -> np.ndarray:
    """(9, 3) linear colors of a gray ball at the origin under a light, where its normals are
    BALL."""
    values = lighting(spec, shadows=False)
    far = np.array([[-0.1, -0.1, -0.1], [0.1, 0.1, 0.1]])  # says only where the head is
    lamps = Lamps(values, far, np.zeros((0, 3), np.int32))
    sky = even_directions(600)
    cosine = np.maximum(BALL @ sky.T, 0) * 4 * np.pi / len(sky)
    arriving = lamps.irradiance(np.zeros_like(BALL), BALL) + cosine @ world_radiance(spec, sky)
    return np.asarray(CARD_REFLECTANCE * arriving / np.pi)


class Bench:
    """One head: its avatar, and truth under each light."""

    def __init__(self, folder: Path, avatar: Avatar) -> None:
        self.avatar = avatar
        self.specs = json.loads((folder / "lights.json").read_text())
        self.truth = {
            name: open_capture(folder / f"truth_{name}")
            for name in LIGHTS
            if (folder / f"truth_{name}").is_dir()
        }
        self.network = load_network()

    def images(self, name: str, relighter: Relighter | None, **options: object):  # type: ignore[no-untyped-def]
        """(view, picture) of each view of a light's truth; without a relighter, as trained."""
        capture = self.truth[name]
        values = lighting(self.specs[name], **options)
        for view in capture.views["train"]:
            mesh = capture.mesh(view.timestep)
            if relighter is None:
                yield view, render_avatar(self.avatar, mesh, view.camera)
            else:
                colors = relighter.colors(mesh, view.camera.position, values)
                yield view, render_layers([posed_avatar(self.avatar, mesh, colors)], view.camera)

    def score(
        self,
        name: str,
        relighter: Relighter | None,
        pictures: Path | None = None,
        **options: object,
    ) -> tuple[float, ...]:
        """Mean PSNR in the mask, LPIPS, PSNR of eyes and mouth."""
        found = []
        for view, image in self.images(name, relighter, **options):
            target = read_image(view)
            levels = read_mask(view)
            assert levels is not None
            mask = levels > 127
            distance = np.nan
            if self.network is not None:
                distance = self.network.distance(image, target.transpose(2, 0, 1) / np.float32(255))
            small = small_parts(self.truth[name], view) & mask
            found.append((psnr(image, target, mask), distance, psnr(image, target, small)))
            if pictures is not None:
                pair = np.concatenate(
                    [target, np.rint(255 * image.transpose(1, 2, 0)).astype(np.uint8)], axis=1
                )
                pictures.mkdir(parents=True, exist_ok=True)
                Image.fromarray(pair).save(
                    pictures / f"{name}_{view.timestep}_{view.camera_index}.png"
                )
        return tuple(np.mean(found, axis=0))


def small_parts(capture: Capture, view: View) -> np.ndarray:
    """(H, W) bool: pixels of eyes and mouth."""
    triangle, _ = rasterize(capture.mesh(view.timestep), capture.faces, view.camera)
    parts = np.logical_or.reduce([capture.regions[name] for name in SMALL_PARTS])
    return np.asarray((triangle >= 0) & parts[np.maximum(triangle, 0)])


def trained(capture: Path, run: Path, seconds: str) -> Avatar:
    """The avatar of a run, which is trained where it is missing."""
    if not (run / "avatar.npz").exists():
        command = [
            sys.executable,
            "-m",
            "stga_addon",
            "train",
            str(capture),
            "--out",
            str(run),
            "--budget",
            seconds,
        ]
        subprocess.run(command, check=True)
    return read_avatar(run / "avatar.npz")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", nargs="+", type=Path, metavar="FOLDER", help="a head's captures")
    parser.add_argument("--train", default="150s", help="budget of the training under light A")
    parser.add_argument(
        "--folder", type=Path, default=Path("out/relight"), help="receives a run for each head"
    )
    parser.add_argument("--pictures", action="store_true", help="truth beside each relit image")
    options = parser.parse_args()
    for folder in options.folders:
        run = options.folder / folder.name
        measure(folder, run, options.train, run / "pictures" if options.pictures else None)


def measure(folder: Path, run: Path, seconds: str, pictures: Path | None) -> None:
    """Print a table for one head: an avatar trained under light A, in the other lights.

    folder: with captures of each light; run: of the avatar, trained for `seconds` if it is missing;
    pictures: a folder for the truth beside each relit image, None for no pictures.
    """
    capture = open_capture(folder / "capture_A")
    avatar = trained(folder / "capture_A", run, seconds)
    bench = Bench(folder, avatar)
    ball = gray_ball(bench.specs["A"])
    light = estimate_light(capture, Known(card=ball, toward=BALL))
    even = estimate_light(capture, Known(radiance=uniform(ball.mean(0) / CARD_REFLECTANCE)))
    print(f"{folder.name}: {len(avatar.splats)} splats;", end=" ")
    print(f"residual {light.residual:.3f}, damping {light.damping:.2f}")
    relighter = Relighter(replace(avatar, light=light))
    rows: dict[str, tuple[Relighter | None, dict[str, Any]]] = {
        "as trained": (None, {}),
        "studio taken as even": (Relighter(replace(avatar, light=even)), {}),
        "  undamped": (Relighter(replace(avatar, light=replace(even, damping=0.0))), {}),
        "relit": (relighter, {}),
        "  without shadows": (relighter, {"shadows": False}),
        "  without highlights": (relighter, {"specular": 0.0}),
    }
    for label, (used, values) in rows.items():
        cells = [
            bench.score(name, used, pictures if label == "relit" else None, **values)
            for name in bench.truth
        ]
        parts = (
            f"{name} {a:5.2f}/{b:.3f}/{c:5.2f}"
            for name, (a, b, c) in zip(bench.truth, cells, strict=True)
        )
        print(f"{label:22s}", "  ".join(parts), flush=True)


if __name__ == "__main__":
    main()
