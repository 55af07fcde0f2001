"""Carry out the job that Blender's panel wrote into a folder: a tracking, a training, or a video."""

import sys
from argparse import ArgumentParser, Namespace

from ..requests.open_head import OpenHead
from .arguments import usable_path

NAME, HELP = "job", "carry out the job that Blender's panel wrote: a tracking, a training, or a video"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    parser.add_argument("run_folder", type=usable_path, metavar="RUN", help="folder that holds job/job.json")


def run(options: Namespace) -> None:
    from ..requests.tracking_job import is_tracking_job, run_tracking_job
    from ..requests.training_job import run_training_job
    from ..requests.video_job import is_video_job, run_video_job

    if is_video_job(options.run_folder):
        run_video_job(options.run_folder)
        return
    if is_tracking_job(options.run_folder):
        run_tracking_job(options.run_folder)
        return
    if not sys.stderr.isatty():  # started by Blender, which reads the status folder
        run_training_job(options.run_folder)
        return
    from ..training.run.progress_bar import ProgressBar

    with ProgressBar() as bar:
        run_training_job(options.run_folder, also=bar.report)
