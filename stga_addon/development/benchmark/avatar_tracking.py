"""Time that a finished avatar takes to track its person, by timestep and camera.

    python -m stga_addon.development.benchmark.avatar_tracking RUN [--timesteps 16]

Tracks timesteps of the run's capture, from where landmarks and dense tracking left them: as
training does, and as the two rounds of `stga track --avatar` do, of which the first begins in small
images. Prints a row in Markdown for each: processor seconds, and seconds of wall time, by timestep
and camera, in one process, without reading the avatar and compiling kernels. On two processors that
have nothing else to do, wall time is about half of the processor seconds.
"""

import argparse
from pathlib import Path
from time import perf_counter, process_time

import numpy as np

from ...avatar.file import read_avatar
from ...capture.model import evenly_spread
from ...training.optimize.avatar_tracking import (
    OtherRecording,
    TrainedAvatar,
    track_by_avatar,
)
from ...training.run.folder import AVATAR, open_run


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("run", type=Path)
    parser.add_argument("--timesteps", type=int, default=16)
    options = parser.parse_args()
    opened = open_run(options.run)
    trained = TrainedAvatar(read_avatar(options.run / AVATAR), opened.run.settings)
    capture = opened.capture
    chosen = evenly_spread(capture.timesteps, options.timesteps)
    views = capture.all_views
    count = sum(view.timestep in chosen for view in views)
    track_by_avatar(trained, capture, chosen[:1])  # compiles
    size = f"{views[0].camera.width}x{views[0].camera.height}"
    print("| images | tracked | processor s | s | unexplained |\n| --- | --- | --- | --- | --- |")
    first = OtherRecording()
    again = OtherRecording(is_again=True)
    for how, way in {"in training": None, "a recording": first, "again": again}.items():
        begin = perf_counter()
        busy = process_time()
        found = track_by_avatar(trained, capture, chosen, recording=way)
        busy = (process_time() - busy) / count
        taken = (perf_counter() - begin) / count
        missed = "" if np.isnan(found.misfit).any() else f"{np.median(found.misfit):.0%}"
        print(f"| {size} | {how} | {busy:.2f} | {taken:.2f} | {missed} |")


if __name__ == "__main__":
    main()
