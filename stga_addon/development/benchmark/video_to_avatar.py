"""Time from a person's video to an avatar, step by step.

    python -m stga_addon.development.benchmark.video_to_avatar VIDEO [--frames N]
        [--seconds 300] [--out FOLDER]

Carries out `stga avatar VIDEO` with its defaults and prints a row in Markdown for each step: what
its progress is called, and seconds of wall time. Below, processor seconds, of helping processes
too. --out keeps what is made.
"""

import argparse
import os
import re
import tempfile
from pathlib import Path
from time import perf_counter

from ...jobs.perform import perform
from ...jobs.track import CAPTURE_FOLDER, RUN_FOLDER, MakeAvatar, Track
from ...jobs.train import Train
from ...progress import Progress
from ...training.settings import make_settings


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("video", type=Path)
    parser.add_argument("--frames", type=int, help="first ones that are used (default: all)")
    parser.add_argument("--seconds", type=float, default=300.0, help="of training")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        out = options.out or Path(folder) / "avatar"
        track = Track(options.video.resolve(), None, out / CAPTURE_FOLDER, stop=options.frames)
        settings = make_settings(seconds=options.seconds, effects={})
        measure(MakeAvatar(track, Train(out / RUN_FOLDER, track.out, settings)))


def measure(request: MakeAvatar) -> None:
    """Make the avatar, and print where the time went."""
    begin = last = perf_counter()
    seconds: dict[str, float] = {}
    stage = "Start"

    def report(progress: Progress) -> bool:
        nonlocal last, stage
        now = perf_counter()
        seconds[stage] = seconds.get(stage, 0.0) + now - last
        last = now
        stage = re.sub(r": \d+ of \d+$", "", progress.stage)
        return False

    perform(request, report)
    report(Progress())
    print("\n| step | s |\n| --- | --- |")
    for name, duration in seconds.items():
        print(f"| {name} | {duration:.1f} |")
    tracking = sum(duration for name, duration in seconds.items() if name.startswith("Tracking"))
    print(f"| **all**, of which tracking {tracking:.0f} | **{last - begin:.0f}** |")
    print(f"\n{sum(os.times()[:4]):.0f} s of processor time")


if __name__ == "__main__":
    main()
