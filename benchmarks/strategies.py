"""Strategies compared at equal training time: what selection costs and brings.

    python benchmarks/strategies.py CAPTURE [--flame FILE] [--budget 60] [--seeds 1] [--only NAME ...] [--out FILE.json]

Trains every strategy for the same wall time (evaluation not counted, kernels compiled before), one after the other,
and prints the held-out view (val), unseen expressions (test), and both on the pixels of the splats that the default
rule selects in that frame. Run it on an idle machine.
"""

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from stga_addon.avatar.embedding import face_frames
from stga_addon.avatar.file import Avatar, read_avatar
from stga_addon.capture.images import read_image
from stga_addon.capture.model import Capture, View
from stga_addon.capture.open import open_capture
from stga_addon.raster.draw import draw_avatar
from stga_addon.raster.render import Parameters, camera_frames, render_forward
from stga_addon.selection import SelectionOptions, select_capture
from stga_addon.training.folder import Run, read_metrics
from stga_addon.training.metrics import psnr
from stga_addon.training.run import train
from stga_addon.training.settings import make_settings

VARIANTS: dict[str, dict[str, Any]] = {
    "global": {"strategy": "global"},
    "global, fixed background": {"strategy": "global", "any_background": False},
    "global, frame batches": {"strategy": "global", "views_per_visit": 0},
    "selective": {"strategy": "selective"},
    "selective, no warm-up": {"strategy": "selective", "warm_up": 0.0},
    "selective, every 4th global": {"strategy": "selective", "global_every": 3},
    "selective, last 40 %": {"strategy": "selective", "warm_up": 0.6, "global_every": 1},
    "selective, 5 mm": {"strategy": "selective", "selection": SelectionOptions(threshold=0.005)},
    "paper": {"strategy": "selective", "schedule": "paper"},
    "gaussian-avatars": {"strategy": "gaussian-avatars"},
}


def selected_pixels(avatar: Avatar, mesh: np.ndarray, view: View, faces: np.ndarray) -> np.ndarray:
    """(H, W) bool: where the splats of the selected triangles, seen alone, cover more than half."""
    part = avatar.splats.rows(faces[avatar.splats.face])
    frames = face_frames(mesh, avatar.faces, avatar.neutral, avatar.convention)
    arrays = Parameters(*(np.ascontiguousarray(getattr(part, name)) for name in Parameters._fields))
    rendering = render_forward(arrays, part.face, camera_frames(frames, view.camera), 0)
    return rendering.transmittance < 0.5


def quality(capture: Capture, avatar: Avatar, split: str, selection: dict[int, np.ndarray]) -> tuple[float, float]:
    """Mean PSNR over the split's views: whole image, and selected pixels (of the views that have any)."""
    whole, part = [], []
    for view in capture.views[split]:
        mesh, target = capture.mesh(view.timestep), read_image(view)
        image = draw_avatar(avatar, mesh, view.camera, avatar.background)
        whole.append(psnr(image, target))
        faces = selection[view.timestep]
        if faces.any():
            where = selected_pixels(avatar, mesh, view, faces)
            if where.sum() > 50:
                part.append(psnr(image, target, where))
    return float(np.mean(whole)), float(np.mean(part)) if part else float("nan")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--flame", type=Path)
    parser.add_argument("--budget", type=float, default=60.0)
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--only", nargs="+", choices=list(VARIANTS), default=list(VARIANTS))
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    capture = open_capture(options.capture, options.flame)
    selection = select_capture(capture, SelectionOptions())
    rows = []
    print(f"{'variant':<28}{'seed':>5}{'iter':>7}{'splats':>8}{'val':>8}{'sel':>8}{'test':>8}{'sel':>8}", flush=True)
    for seed in range(options.seeds):
        for name in options.only:
            settings = make_settings(**{"seconds": options.budget, "seed": seed, **VARIANTS[name]})
            with tempfile.TemporaryDirectory() as folder:
                run = Run(capture.root, options.flame, "vhap", settings)
                avatar = read_avatar(train(capture, Path(folder), run))
                last = read_metrics(Path(folder))[-1]
            val = quality(capture, avatar, "val", selection)
            test = quality(capture, avatar, "test", selection) if capture.views["test"] else (np.nan, np.nan)
            rows.append({"variant": name, "seed": seed, "iterations": last["iteration"], "val": val, "test": test})
            figures = "".join(f"{value:8.2f}" for value in (*val, *test))
            print(f"{name:<28}{seed:>5}{last['iteration']:>7}{len(avatar.splats):>8}{figures}", flush=True)
    if options.out:
        options.out.write_text(json.dumps({"budget_s": options.budget, "rows": rows}, indent=1) + "\n", "utf-8")


if __name__ == "__main__":
    main()
