"""Show which triangles each frame selects for training."""

from argparse import ArgumentParser, Namespace

from ..errors import StgaError
from ..files import write_npz
from ..requests.open_head import OpenHead
from ..selection import SelectionOptions, select_capture
from .arguments import add_capture, real_number, usable_path
from .inputs import open_named_capture

NAME, HELP = "select", "show which triangles each frame selects for training"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    add_capture(parser, head)
    parser.add_argument(
        "--threshold",
        type=real_number,
        default=SelectionOptions.threshold,
        metavar="METERS",
        help=f"movement from which a triangle is selected (default {SelectionOptions.threshold:g})",
    )
    parser.add_argument(
        "--zero-pose",
        choices=("head", "all"),
        help="FLAME motion that does not count: the head's (default), or the jaw's and the eyes' as well",
    )
    parser.add_argument("--out", type=usable_path, metavar="NPZ", help="also write timestep -> triangles")


def run(options: Namespace) -> None:
    capture = open_named_capture(options)
    if options.zero_pose is not None and capture.flame is None:
        raise StgaError(f"--zero-pose: has no effect on {options.capture}, which was not tracked with FLAME")
    chosen = SelectionOptions(threshold=options.threshold, zero_pose=options.zero_pose or SelectionOptions.zero_pose)
    selection = select_capture(capture, chosen)
    print(f"threshold {1000 * options.threshold:g} mm, {len(capture.faces)} triangles")
    for timestep, faces in selection.items():
        regions = [name for name, members in capture.regions.items() if members.any() and faces[members].all()]
        print(f"{timestep:5d}  {faces.mean():6.1%}  {', '.join(regions)}")
    if options.out:
        write_npz(options.out, {f"{t:05d}": faces for t, faces in selection.items()}, compressed=True)
