"""What the GPU display computes on the CPU for one redraw of a viewport.

    python benchmarks/redraw.py [--repeats 20]

A head of 9,976 triangles that moves (playback: its triangles' frames are computed again, and strain where colors follow
it) and one that rests while the view moves, with 65,536 and 200,000 splats. Medians in milliseconds. Needs no GPU:
uploading the results takes it another 0.1 to 1 ms, which `tests/gui` shows. Run it on an idle machine.
"""

import argparse

import numpy as np
from iteration import median_ms

from stga_addon.avatar.file import Avatar
from stga_addon.avatar.splats import Splats
from stga_addon.avatar.strain import STRAIN_COMPONENTS
from stga_addon.capture.camera import look_at
from stga_addon.scene.gpu.packing import StaticSplats, View, drawing_order, frame_block, posed_frames, table
from stga_addon.scene.layers import SceneLayer

GRID = 59, 86
"""Rings and vertices around, of 9,976 triangles, as the FLAME head has."""


def head_mesh(rings: int, around: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) meters and triangles (F, 3) of a closed grid."""
    polar, angle = np.meshgrid(np.linspace(0.1, 3.0, rings), np.arange(around) * 2 * np.pi / around, indexing="ij")
    points = [np.sin(polar) * np.cos(angle), np.cos(polar), np.sin(polar) * np.sin(angle)]
    index = np.arange(rings * around).reshape(rings, around)
    a, b, c, d = (np.roll(index, (-i, -j), (0, 1))[:-1].ravel() for i, j in ((0, 0), (1, 0), (0, 1), (1, 1)))
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    return 0.1 * np.stack([p.ravel() for p in points], 1), faces.astype(np.int32)


def head_avatar(count: int, has_strain: bool = False) -> Avatar:
    vertices, faces = head_mesh(*GRID)
    rng = np.random.default_rng(0)
    splats = Splats(
        xyz=rng.normal(0, 1e-3, (count, 3)).astype(np.float32),
        rotation=rng.normal(size=(count, 4)).astype(np.float32),
        log_scale=np.full((count, 3), -6, np.float32),
        opacity=np.zeros(count, np.float32),
        sh=np.zeros((count, 1, 3), np.float32),
        face=rng.integers(0, len(faces), count).astype(np.int32),
        unbound=np.zeros(count, bool),
        strain_color=np.zeros((count, STRAIN_COMPONENTS if has_strain else 0, 3), np.float32),
    )
    return Avatar(splats, "stga", vertices.astype(np.float32), faces)


def measure(count: int, view: View, repeats: int) -> None:
    avatar, strained = head_avatar(count), head_avatar(count, has_strain=True)
    layer = SceneLayer(avatar.splats, avatar.frames(avatar.neutral), np.eye(4))
    static, block = StaticSplats([layer]), frame_block(layer.frames)

    def moving_view() -> None:
        drawing_order(static, posed_frames([layer], [block], view), view, short_keys=True)
        table(static, [layer], view)

    def playback(of: Avatar) -> None:
        posed = SceneLayer(of.splats, of.frames(of.neutral), np.eye(4))
        drawing_order(static, posed_frames([posed], [frame_block(posed.frames)], view), view, short_keys=True)
        table(static, [posed], view)

    cases = {
        "moving view": moving_view,
        "playback": lambda: playback(avatar),
        "playback, colors follow strain": lambda: playback(strained),
    }
    for name, work in cases.items():
        print(f"{count} splats, {name}: {median_ms(work, repeats):.2f} ms")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=20)
    repeats = parser.parse_args().repeats
    if repeats < 1:
        parser.error(f"--repeats must be at least 1, got {repeats}")
    view = View(look_at((0.1, 0.1, 0.6), (0, 0, 0), 1600, 1000, 1500))
    for count in (65_536, 200_000):
        measure(count, view, repeats)


if __name__ == "__main__":
    main()
