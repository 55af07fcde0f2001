"""Time from a person's video to an avatar, step by step.

    python benchmarks/video_to_avatar.py VIDEO [--frames 300] [--budget 5m] [--out FOLDER]

Carries out `stga avatar VIDEO` with its defaults and prints a row in Markdown for each step: what its progress is
called, and seconds of wall time. Below, processor seconds, of helping processes too. --out keeps what is made.
"""

import argparse
import os
import tempfile
from pathlib import Path
from time import perf_counter

from stga_addon.cli import avatar
from stga_addon.perform.perform import perform
from stga_addon.progress import Progress


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("video")
    parser.add_argument("--frames", default="300")
    parser.add_argument("--budget", default="5m")
    parser.add_argument("--out", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        out = str(options.out or Path(folder) / "avatar")
        measure([options.video, "--out", out, "--stop", options.frames, "--budget", options.budget])


def measure(arguments: list[str]) -> None:
    """Make the avatar that `stga avatar` makes of these arguments, and print where the time went."""
    commands = argparse.ArgumentParser()
    avatar.add_arguments(commands, None)
    request = avatar.avatar_request(commands.parse_args(arguments))
    begin = last = perf_counter()
    seconds: dict[str, float] = {}
    stage = "Start"

    def report(progress: Progress) -> bool:
        nonlocal last, stage
        now = perf_counter()
        seconds[stage] = seconds.get(stage, 0.0) + now - last
        last, stage = now, progress.stage
        return False

    perform(request, report)
    report(Progress())
    print("\n| step | s |\n| --- | --- |")
    for name, own in seconds.items():
        print(f"| {name} | {own:.1f} |")
    tracking = sum(own for name, own in seconds.items() if name.startswith("Tracking"))
    print(f"| **all**, of which tracking {tracking:.0f} | **{last - begin:.0f}** |")
    print(f"\n{sum(os.times()[:4]):.0f} s of processor time")


if __name__ == "__main__":
    main()
