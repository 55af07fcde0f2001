"""Convert between motions of FLAME heads and performances in ARKit's 52 blend shapes."""

from argparse import ArgumentParser, Namespace
from pathlib import Path

import numpy as np

from ..capture.flame_capture import flame_model
from ..capture.open import open_capture
from ..driving.head_map import person_of
from ..driving.inverse import captured_performance, write_performance
from ..driving.open_motion import NEEDS_FLAME, MotionOptions, performed, prepared_performance
from ..driving.read_performance import is_performance, read_performance
from ..errors import StgaError
from ..export.playback import playback_fps
from ..files import write_npz
from ..flame.sequence import FRAME_FIELDS, FlameSequence
from ..perform.motion import findings
from ..requests.open_head import OpenHead
from .arguments import frame_rate, usable_path
from .motion import add_motion_options, motion_options

NAME, HELP = "drive", "convert a face performance (ARKit's 52 shapes) to a FLAME motion, or a motion to a CSV of shapes"
SUFFIXES = (".csv", ".npz")


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    parser.add_argument(
        "source",
        type=usable_path,
        metavar="MOTION",
        help="a performance (CSV, JSON, text, take folder), FLAME parameters (.npz), or a capture tracked with FLAME",
    )
    parser.add_argument(
        "--out",
        type=usable_path,
        required=True,
        metavar="FILE",
        help="ARKit's shapes (.csv) or FLAME parameters (.npz)",
    )
    parser.add_argument("--flame", type=usable_path, help="FLAME model file of the head")
    parser.add_argument(
        "--head", type=usable_path, metavar="CAPTURE", dest="of", help="whose identity (default: average)"
    )
    parser.add_argument("--fps", type=frame_rate, help="frames per second of the result (default: as recorded)")
    add_motion_options(parser)


def run(options: Namespace) -> None:
    suffix = options.out.suffix.lower()
    if suffix not in SUFFIXES:
        raise StgaError(f"{options.out}: expected a name that ends in {' or '.join(SUFFIXES)}")
    chosen = motion_options(options)
    if options.stay_trained is not None:
        raise StgaError("--stay-trained: has no effect here, where there is no avatar")
    if not is_performance(options.source):
        _write_shapes(options, chosen)
        return
    performance = read_performance(options.source)
    if suffix == ".csv":
        write_performance(options.out, prepared_performance(performance, chosen, options.fps))
        return
    motion = performed(performance, _person(options), str(options.flame), chosen, fps=options.fps)
    for line in findings(motion):
        print(line)
    write_motion(options.out, motion.sequence)
    print(f"{options.out}: {len(motion.sequence.timesteps)} timesteps at {motion.fps:g} frames per second")


def _write_shapes(options: Namespace, chosen: MotionOptions) -> None:
    """The CSV of a FLAME motion or capture."""
    if options.out.suffix.lower() != ".csv":
        raise StgaError(f"{options.source}: holds FLAME parameters already; --out takes a .csv of ARKit's shapes")
    if options.of is not None:
        raise StgaError(f"--head: has no effect on {options.source}, which has its own identity")
    capture = open_capture(options.source, options.flame)
    if capture.flame is None:
        raise StgaError(f"{options.source}: was not tracked with FLAME, so it has no parameters of expression and pose")
    performance = captured_performance(capture.flame, str(options.source), playback_fps(capture, numbered=True))
    write_performance(options.out, prepared_performance(performance, chosen, options.fps))


def _person(options: Namespace) -> FlameSequence:
    """The head of --head, or the model's average one."""
    if options.of is not None:
        capture = open_capture(options.of, options.flame)
        if capture.flame is None:
            raise StgaError(f"{options.of}: was not tracked with FLAME, so it has no identity")
        return capture.flame
    if options.flame is None:
        raise StgaError(f"{options.source}: {NEEDS_FLAME}; give it with --flame")
    model = flame_model(options.flame)
    return person_of(model, model.v_template)


def write_motion(path: Path, sequence: FlameSequence) -> None:
    """Write a sequence as FLAME parameters that `read_motion` takes."""
    frames = [sequence.frame(timestep) for timestep in sequence.timesteps]
    arrays = {name: np.stack([getattr(frame, name) for frame in frames]).astype(np.float32) for name in FRAME_FIELDS}
    write_npz(path, {**arrays, "shape": sequence.shape, "timesteps": np.array(sequence.timesteps)}, compressed=True)
