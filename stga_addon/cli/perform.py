"""Carry out the request in a folder, as a worker of Blender's panel or of a render farm does.

The folder holds request.json; status, previews and result are written beside it.
"""

import os
import sys
from argparse import ArgumentParser, Namespace
from importlib.util import find_spec

from ..progress import ignore
from ..requests.open_head import OpenHead
from .arguments import usable_path, whole_number
from .carry_out import ProgressBar

NAME, HELP = "perform", "carry out the request that a folder holds"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    parser.add_argument("folder", type=usable_path, metavar="FOLDER", help="folder that holds request.json")
    parser.add_argument(
        "--resume", action="store_true", help="continue what this request began in its output folder, if it did"
    )
    parser.add_argument(
        "--threads", type=whole_number(1), metavar="N", help="threads to compute on (default: all processors)"
    )


def run(options: Namespace) -> None:
    if options.threads is not None:
        limit_threads(options.threads)
    from ..perform.perform import perform_in_folder

    if not sys.stderr.isatty():  # started by Blender, which reads the status in the folder
        perform_in_folder(options.folder, also=ignore, resume=options.resume)
        return
    with ProgressBar() as bar:
        perform_in_folder(options.folder, bar.say, bar.report, options.resume)


def limit_threads(count: int) -> None:
    """Compute on `count` threads, for a process that has not imported torch yet."""
    os.environ["OMP_NUM_THREADS"] = str(count)
    if find_spec("numba") is None:  # work that needs no kernels
        return
    from ..raster.cpu.threads import set_threads

    set_threads(count)
