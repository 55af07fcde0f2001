"""Benchmark of refined tracking: quality and time with and without it, at the same number of iterations.

    python benchmarks/tracking.py CAPTURE --flame FILE [--iterations 500] [--errors 0 0.5 1]

CAPTURE should be tracked exactly, as the demo's is. Disturbs the parameters of its training timesteps by random steps
(1: 2 mm, 1° a joint, 0.15 of an expression), trains with the effect and without, and prints a table in Markdown: what
Auto would decide, how far the meshes are from where they should be, the PSNR of the held-out view and of the unseen
timesteps, which are not disturbed, and the time of an iteration, for which the machine should be idle.
"""

import argparse
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from stga_addon.avatar.file import read_avatar
from stga_addon.capture.flame_capture import with_sequence
from stga_addon.capture.model import Capture
from stga_addon.capture.open import open_capture
from stga_addon.effects.facts import CaptureFacts
from stga_addon.effects.plan import plan_effects
from stga_addon.effects.rules import tracking
from stga_addon.flame.forward import FlameFrame
from stga_addon.training.evaluate.metrics import evaluate_avatar
from stga_addon.training.optimize.tracking import (
    POSE_SIZE,
    TRANSLATION_SIZE,
    parameters_of,
    with_parameters,
    with_refined_tracking,
)
from stga_addon.training.run.folder import Run
from stga_addon.training.run.loop import train
from stga_addon.training.run.metrics_log import read_metrics
from stga_addon.training.settings import make_settings

COEFFICIENT, RADIAN, METRE = 0.15, 0.0175, 0.002


def lose_track(capture: Capture, error: float) -> Capture:
    """The FLAME capture with other parameters in its training timesteps."""
    sequence = capture.flame
    assert sequence is not None
    expressions = sequence.model.n_expression
    sizes = np.repeat([COEFFICIENT, RADIAN, METRE], [expressions, POSE_SIZE, TRANSLATION_SIZE])
    disturbed = {view.timestep for view in capture.views["train"]}

    def frame(timestep: int) -> FlameFrame:
        tracked = sequence.frame(timestep)
        if timestep not in disturbed:
            return tracked
        steps = np.random.default_rng(timestep).normal(0, error * sizes)
        return with_parameters(tracked, parameters_of(tracked) + steps)

    return with_sequence(capture, replace(sequence, frame=frame))


def millimeters(capture: Capture, true: Capture) -> float:
    """Mean distance of vertices between two captures' training timesteps."""
    timesteps = {view.timestep for view in true.views["train"]}
    return 1000 * float(np.mean([np.linalg.norm(capture.mesh(t) - true.mesh(t), axis=1).mean() for t in timesteps]))


def trained(capture: Capture, flame: Path, iterations: int, choice: str) -> tuple[Capture, Mapping[str, float], float]:
    """The capture as it was refined, the PSNR by split, and the seconds of an iteration."""
    settings, plan = plan_effects(capture, make_settings(iterations=iterations, effects={"tracking": choice}))
    with tempfile.TemporaryDirectory() as folder:
        avatar = read_avatar(train(capture, Path(folder), Run(capture.root, flame, "vhap", settings, plan)))
        shown, last = with_refined_tracking(capture, Path(folder)), read_metrics(Path(folder))[-1]
    quality = {split: evaluate_avatar(avatar, shown, split).psnr for split in ("val", "test")}
    return shown, quality, last["seconds"] / last["iteration"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--flame", type=Path, required=True)
    parser.add_argument("--iterations", type=int, default=500)
    parser.add_argument("--errors", type=float, nargs="+", default=[0, 0.5, 1])
    options = parser.parse_args()
    true = open_capture(options.capture, options.flame)
    print("| error | mesh outside the masks | Auto | tracking | mm | val | unseen | ms an iteration |")
    print("|" + " --- |" * 8)
    for error in options.errors:
        capture = lose_track(true, error)
        facts = CaptureFacts(capture, make_settings(iterations=1))
        decided = tracking(facts)
        auto = "on" if decided is not None and decided.on else "off"
        for choice in ("off", "on"):
            shown, psnr, pace = trained(capture, options.flame, options.iterations, choice)
            print(
                f"| {error:g} | {facts.outside:.2%} | {auto} | {choice} | {millimeters(shown, true):.2f} "
                f"| {psnr['val']:.2f} | {psnr['test']:.2f} | {1000 * pace:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
