"""Carry out the training job that Blender's panel wrote into a run's folder."""

import sys
from argparse import ArgumentParser, Namespace

from ..jobs.delegate import OpenHead
from .arguments import usable_path

NAME, HELP = "job", "carry out the training job that Blender's panel wrote into a run's folder"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    parser.add_argument("run_folder", type=usable_path, metavar="RUN")


def run(options: Namespace) -> None:
    from ..jobs.training_job import run_training_job

    if not sys.stderr.isatty():  # started by Blender, which reads the status folder
        run_training_job(options.run_folder)
        return
    from ..training.run.progress_bar import ProgressBar

    with ProgressBar() as bar:
        run_training_job(options.run_folder, also=bar.report)
