"""Carry out the request in a folder, as a worker of Blender's panel or of a render farm does.

The folder holds request.json; status, previews and result are written beside it.
"""

import sys
from argparse import ArgumentParser, Namespace

from ..progress import ignore
from ..requests.open_head import OpenHead
from .arguments import usable_path
from .carry_out import ProgressBar

NAME, HELP = "perform", "carry out the request that a folder holds"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    parser.add_argument("folder", type=usable_path, metavar="FOLDER", help="folder that holds request.json")


def run(options: Namespace) -> None:
    from ..perform.perform import perform_in_folder

    if not sys.stderr.isatty():  # started by Blender, which reads the status in the folder
        perform_in_folder(options.folder, also=ignore)
        return
    with ProgressBar() as bar:
        perform_in_folder(options.folder, bar.say, bar.report)
