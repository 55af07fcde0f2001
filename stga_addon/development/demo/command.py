"""The command `demo`."""

from argparse import Namespace
from dataclasses import dataclass
from pathlib import Path

from ...cli.commands import Command
from ...jobs.train import Train
from ...options import given_options, like, option
from ...training.settings import TrainingSettings

SECONDS = 12.0
"""Of a training; with it, the demo takes less than a minute on two cores that have compiled nothing
yet."""


@dataclass(frozen=True)
class DemoOptions:
    out: Path = option("folder of what is made", Path("out/demo"), metavar="DIR")
    seconds: float | None = like(TrainingSettings, "seconds", help="training time (default 12s)")
    iterations: int | None = like(
        TrainingSettings, "iterations", help="number of iterations instead, of the first training"
    )
    device: str = like(Train, "device")
    footage: bool = option("make an avatar from the capture's images alone as well", False)


def run(options: Namespace, head: object) -> None:
    from ...render.device import choose_device
    from .run import avatar_from_footage, run_demo

    given = DemoOptions(**given_options(options, DemoOptions))
    device, why = choose_device(given.device)
    print(why)
    seconds = given.seconds or SECONDS
    budget = {"seconds": seconds} if given.iterations is None else {"iterations": given.iterations}
    run_demo(given.out, budget, device=device)
    if given.footage:
        avatar_from_footage(given.out, seconds, given.device)


COMMAND = Command(
    "Train an avatar on a capture of a generated person and show it in Blender.",
    run,
    (DemoOptions,),
)
