"""Benchmark of refined tracking: quality and time with and without it, at the same number of iterations.

    python benchmarks/tracking.py CAPTURE --flame FILE [--iterations 500] [--errors 0 0.5 1] [--tracked TRACKED]

CAPTURE should be tracked exactly, as the demo's is. Disturbs the parameters of its training timesteps by random steps
(1: 2 mm, 1° a joint, 0.15 of an expression), trains with the effect and without, and prints a table in Markdown: what
Auto would decide, how far the meshes are from where they should be, the PSNR of the held-out view and of the unseen
timesteps, which are not disturbed, and the time of an iteration, for which the machine should be idle.

With --tracked, a capture that `stga track` made of CAPTURE's images takes the place of the disturbed ones: trained on
CAPTURE's meshes, on its own, and on its own refined. Distances are then those of the vertices of the face.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from effects import trained

from stga_addon.capture.flame_capture import with_sequence
from stga_addon.capture.model import Capture
from stga_addon.capture.open import open_capture
from stga_addon.capture.rigid import Similarity, similarity
from stga_addon.flame.forward import POSE_SIZE, TRANSLATION_SIZE, FlameFrame, frame_of
from stga_addon.training.effects.facts import CaptureFacts
from stga_addon.training.effects.rules import tracking
from stga_addon.training.settings import make_settings

EXPRESSION_ERROR, JOINT_ERROR_RAD, TRANSLATION_ERROR_M = 0.15, 0.0175, 0.002
"""Standard deviations of the random steps at error 1."""


def lose_track(capture: Capture, error: float) -> Capture:
    """The FLAME capture with other parameters in its training timesteps."""
    sequence = capture.flame
    assert sequence is not None
    expressions = sequence.model.n_expression
    sizes = np.repeat(
        [EXPRESSION_ERROR, JOINT_ERROR_RAD, TRANSLATION_ERROR_M], [expressions, POSE_SIZE, TRANSLATION_SIZE]
    )
    disturbed = {view.timestep for view in capture.views["train"]}

    def frame(timestep: int) -> FlameFrame:
        tracked = sequence.frame(timestep)
        if timestep not in disturbed:
            return tracked
        steps = np.random.default_rng(timestep).normal(0, error * sizes)
        return frame_of(tracked.parameters + steps, tracked.dynamic_offset)

    return with_sequence(capture, replace(sequence, frame=frame))


def to_world_of(tracked: Capture, true: Capture) -> Similarity:
    """From the world of the true capture to that of the tracked one, by the places of their cameras."""
    places = [
        {view.camera_index: view.camera.position for views in capture.views.values() for view in views}
        for capture in (true, tracked)
    ]
    both = sorted(places[0].keys() & places[1].keys())
    ours, theirs = (np.array([own[number] for number in both]) for own in places)
    world = similarity(ours, theirs)
    assert np.allclose(world.apply(ours), theirs, atol=1e-3), "the captures number their cameras differently"
    return world


def with_true_meshes(tracked: Capture, true: Capture) -> Capture:
    """The tracked capture's views with the other capture's meshes, in the tracked one's world."""
    world = to_world_of(tracked, true)
    return replace(
        tracked,
        mesh=lambda timestep: world.apply(true.mesh(timestep)),
        neutral=world.scale * true.neutral,
        expression_mesh=lambda timestep, zero_pose: world.scale * true.expression_mesh(timestep, zero_pose),
    )


def millimeters(capture: Capture, true: Capture, vertices: np.ndarray | slice = slice(None)) -> float:
    """Mean distance of vertices between two captures' training timesteps."""
    timesteps = {view.timestep for view in true.views["train"]}
    away = [np.linalg.norm((capture.mesh(t) - true.mesh(t))[vertices], axis=1).mean() for t in timesteps]
    return 1000 * float(np.mean(away))


def compare_tracked(tracked: Capture, true: Capture, flame: Path, iterations: int) -> None:
    """Print a table in Markdown of training on the true meshes, on the tracked ones, and on those refined."""
    assert true.flame is not None
    face, aim = true.flame.model.masks["face"], with_true_meshes(tracked, true)
    scale = to_world_of(tracked, true).scale
    print("| meshes | mm | val | ms an iteration |")
    print("|" + " --- |" * 4)
    for name, capture, choice in (("true", aim, "off"), ("tracked", tracked, "off"), ("refined", tracked, "on")):
        shown, psnr, pace, _ = trained(capture, flame, iterations, {"tracking": choice})
        error = millimeters(shown, aim, face) / scale
        print(f"| {name} | {error:.2f} | {psnr['val']:.2f} | {pace:.1f} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--flame", type=Path, required=True)
    parser.add_argument("--iterations", type=int, default=500)
    parser.add_argument("--errors", type=float, nargs="+", default=[0, 0.5, 1])
    parser.add_argument("--tracked", type=Path)
    options = parser.parse_args()
    true = open_capture(options.capture, options.flame)
    if options.tracked is not None:
        compare_tracked(open_capture(options.tracked, options.flame), true, options.flame, options.iterations)
        return
    print("| error | mesh outside the masks | Auto | tracking | mm | val | unseen | ms an iteration |")
    print("|" + " --- |" * 8)
    for error in options.errors:
        capture = lose_track(true, error)
        facts = CaptureFacts(capture, make_settings(iterations=1))
        decided = tracking(facts)
        auto = "on" if decided is not None and decided.on else "off"
        for choice in ("off", "on"):
            shown, psnr, pace, _ = trained(capture, options.flame, options.iterations, {"tracking": choice})
            print(
                f"| {error:g} | {facts.outside:.2%} | {auto} | {choice} | {millimeters(shown, true):.2f} "
                f"| {psnr['val']:.2f} | {psnr['test']:.2f} | {pace:.1f} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
