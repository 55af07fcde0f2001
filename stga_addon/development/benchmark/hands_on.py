"""What posing, playing and rendering the demo's avatar take in Blender.

    python -m stga_addon.development.benchmark.hands_on out/demo [--splats 60000] [--repeats 30]
        [--processor-time]

The folder is that of `stga demo`; splats are copied at random places beside themselves until there
are so many. Prints medians in ms. Posing and playing end where the splats' geometry is computed and
sorted for an image of 1080p; drawing by a graphics card is left out. Run it on an idle machine, or
with --processor-time: that of all threads together.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import bpy
import numpy as np

from ...avatar.file import Avatar, read_avatar
from ...avatar.splats import joined
from ...capture.open import open_capture
from ...driving.demo_speech import demo_speech
from ...driving.open_motion import MotionOptions, performed
from ...scene import tags
from ...scene.cameras import render_camera
from ...scene.display.splat_object import show_avatar
from ...scene.gpu import packing
from ...scene.render import engine
from ...scene.render.scene_splats import SplatCache, all_layers
from ...scene.render.viewport_display import ENGINE
from ...scene.rig.head import usable_rig
from ...scene.rig.keyframes import Placement
from ...scene.rig.motion import apply_motion
from ..demo.in_blender import open_file, registered

SIZE_PX = 1920, 1080
"""Width and height of the images."""
JITTER_M = 1e-3
"""Standard deviation of a copied splat's place from its original's, in its triangle's units."""
MAX_IMAGES = 5
FRAMES = 60


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("demo", type=Path)
    parser.add_argument("--splats", type=int, default=60_000)
    parser.add_argument("--repeats", type=int, default=30)
    parser.add_argument("--processor-time", action="store_true")
    options = parser.parse_args()
    clock = process_time if options.processor_time else perf_counter
    with registered():
        for name, (act, repeats) in _acts(options.demo, options.splats, options.repeats).items():
            act(0)
            times = []
            for number in range(1, repeats + 1):
                begin = clock()
                act(number)
                times.append(1e3 * (clock() - begin))
            print(f"{name:<24}{np.median(times):8.1f}")


def _acts(demo: Path, splats: int, repeats: int) -> dict[str, tuple[Callable[[int], object], int]]:
    """Name -> what is measured, by the number of the repeat, and how often."""
    open_file(demo / "demo.blend")
    scene = bpy.context.scene
    head = tags.heads_of(scene)[0]
    for old in list(filter(tags.is_splats, scene.objects)):
        bpy.data.objects.remove(old)
    show_avatar(_with_copies(read_avatar(demo / "avatar.npz"), splats), head)
    rig = usable_rig(head)
    neck = rig.pose.bones["neck"]
    jaw = head.data.shape_keys.key_blocks["jawOpen"]
    person = open_capture(demo / "capture").flame_motion()
    motion = performed(demo_speech(), person, head.name, MotionOptions(), fps=24.0)
    apply_motion(head, motion.sequence.frames(), Placement(1, "speech", as_strip=True))
    update = _Viewport(scene)
    still = FRAMES + 200  # past the performance: nothing else moves

    def pose(number: int) -> None:
        neck.rotation_quaternion = 1.0, 0.02 * np.sin(number), 0.0, 0.0
        update()

    def slide(number: int) -> None:
        jaw.value = 0.3 + 0.2 * np.sin(number)
        update()

    def play(number: int) -> None:
        scene.frame_set(1 + number % FRAMES)
        update()

    def render(number: int) -> None:
        scene.frame_set(1 + number)
        bpy.ops.render.render()

    scene.render.engine = ENGINE
    scene.render.resolution_x, scene.render.resolution_y = SIZE_PX
    scene.render.resolution_percentage = 100
    scene.frame_set(still)
    images = min(repeats, MAX_IMAGES)
    return {
        "posing a bone": (pose, repeats),
        "moving a slider": (slide, repeats),
        "playing a frame": (play, repeats),
        "F12, 1920x1080": (render, images),
    }


def _with_copies(avatar: Avatar, splats: int) -> Avatar:
    """The avatar with so many splats."""
    rng = np.random.default_rng(0)
    rows = rng.integers(0, len(avatar.splats), max(splats - len(avatar.splats), 0))
    copies = avatar.splats.rows(rows)
    moved = copies.xyz + rng.normal(0, JITTER_M, copies.xyz.shape).astype(np.float32)
    every = joined([avatar.splats, replace(copies, xyz=moved)])
    return replace(avatar, splats=every.rows(np.argsort(every.face, kind="stable")))


class _Viewport:
    """What a viewport computes between a change and the draw calls."""

    def __init__(self, scene: Any) -> None:
        self._scene = scene
        self._cache = SplatCache()
        self._static: packing.StaticSplats | None = None

    def __call__(self) -> None:
        bpy.context.view_layer.update()
        depsgraph = bpy.context.evaluated_depsgraph_get()
        layers = all_layers(depsgraph, self._cache)
        camera = self._scene.camera.evaluated_get(depsgraph)
        image_camera = render_camera(camera, depsgraph, *SIZE_PX, (0, 0, *SIZE_PX))
        view = engine.camera_view(image_camera, camera)
        if self._static is None or self._static.key != packing.static_key(layers):
            self._static = packing.StaticSplats(layers)
        blocks = [packing.frame_block(layer.frames) for layer in layers]
        frames = packing.posed_frames(layers, blocks, view)
        packing.drawing_order(self._static, frames, view, short_keys=True)


if __name__ == "__main__":
    main()
