"""How well a head looks that is driven by another person's motion, against images of that head in the same poses.

    python benchmarks/driving_images.py RUN CAPTURE OTHER [--pictures FOLDER]

CAPTURE and OTHER are two people tracked with FLAME who do the same, timestep by timestep: both rendered by a path
tracer from the same weights of expressions, then tracked. RUN was trained on CAPTURE. Prints PSNR inside the head mask
of CAPTURE's left-out timesteps (left-out views where it has none), mean over views: driven by its own parameters, and
by OTHER's in several ways, each with CAPTURE's own head pose, and how much that is below its own.
"On a head without expression": not on CAPTURE's own resting face.
"""

import argparse
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

from stga_addon.avatar.file import Avatar, read_avatar
from stga_addon.capture.model import Capture
from stga_addon.capture.open import open_capture
from stga_addon.driving.head_map import head_map
from stga_addon.driving.inverse import arkit_weights
from stga_addon.driving.open_motion import MotionOptions, adapted, frames_of
from stga_addon.driving.performance import Performance
from stga_addon.driving.transfer import PART_FIELDS, trained_range
from stga_addon.flame.forward import FlameFrame
from stga_addon.flame.sequence import sequence_mesh
from stga_addon.render.render import render_avatar
from stga_addon.training.evaluate.evaluation_views import read_evaluation_view
from stga_addon.training.evaluate.metrics import psnr

FIRST = MotionOptions(neutral="first")
BARE = "on a head without expression"
WAYS = {
    "no motion of the face": MotionOptions(strength=0.0),
    "coefficients copied": MotionOptions(),
    "relative to the first frame": FIRST,
    f"relative to the first frame, {BARE}": FIRST,
    "relative to the first frame, half led back": MotionOptions(neutral="first", stay_trained=0.5),
    "relative to the quiet face": MotionOptions(neutral="quiet"),
    "ARKit weights, relative to the first frame": FIRST,
    f"ARKit weights, relative to the first frame, {BARE}": FIRST,
}

Frames = Mapping[int, FlameFrame]


def driven(capture: Capture, other: Capture, way: str) -> Frames:
    """Timestep -> the capture's frame with the other's face, jaw and eyes."""
    own, theirs, options = capture.flame, other.flame, WAYS[way]
    assert own is not None
    assert theirs is not None
    seen = sorted({view.timestep for view in capture.views["train"]})
    trained = None if BARE in way else trained_range([own.frame(timestep) for timestep in seen])
    frames = [theirs.frame(timestep) for timestep in theirs.timesteps]
    if "ARKit" in way:
        relative, _ = adapted(frames, options)
        weights = arkit_weights(relative, head_map(theirs, "other"), theirs)
        performance = Performance(np.arange(len(weights)) / 25.0, weights, None, 25.0)
        frames, _ = frames_of(head_map(own, "own"), performance, options, trained)
    else:
        frames, _ = adapted(frames, options, trained)
    return {
        timestep: replace(own.frame(timestep), **{name: getattr(frame, name) for name in PART_FIELDS.values()})
        for timestep, frame in zip(theirs.timesteps, frames, strict=True)
        if timestep in own.timesteps
    }


def scores(capture: Capture, avatar: Avatar, frames: Frames, pictures: Path | None = None) -> list[float]:
    """PSNR inside the head mask of each left-out view."""
    assert capture.flame is not None
    sequence, found = replace(capture.flame, frame=frames.__getitem__), []
    for view in capture.views.get("test") or capture.views["val"]:
        truth = read_evaluation_view(capture, view)
        image = render_avatar(avatar, sequence_mesh(sequence, view.timestep), view.camera)
        found.append(psnr(image, truth.target, truth.regions["mask"]))
        if pictures is not None:
            pictures.mkdir(parents=True, exist_ok=True)
            pair = np.concatenate([truth.target, np.rint(255 * image.transpose(1, 2, 0)).astype(np.uint8)], axis=1)
            Image.fromarray(pair).save(pictures / f"{view.timestep}_{view.camera_index}.png")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("capture", type=Path)
    parser.add_argument("other", type=Path)
    parser.add_argument("--flame", type=Path, help="FLAME file, where the captures hold none")
    parser.add_argument("--pictures", type=Path)
    options = parser.parse_args()
    capture, other = open_capture(options.capture, options.flame), open_capture(options.other, options.flame)
    avatar = read_avatar(options.run / "avatar.npz")
    assert capture.flame is not None
    own = {timestep: capture.flame.frame(timestep) for timestep in capture.flame.timesteps}
    best = np.mean(scores(capture, avatar, own))
    print(f"| driven by | PSNR dB | below its own |\n|---|---|---|\n| own parameters | {best:.2f} | 0 |", flush=True)
    for number, name in enumerate(WAYS):
        pictures = None if options.pictures is None else options.pictures / f"way_{number}"
        found = np.mean(scores(capture, avatar, driven(capture, other, name), pictures))
        print(f"| {name} | {found:.2f} | {best - found:.2f} |", flush=True)


if __name__ == "__main__":
    main()
