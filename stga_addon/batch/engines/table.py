"""The engines that there are: a row and a file each."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module

from ..engine import Engine


@dataclass(frozen=True)
class EngineRow:
    """module and name: of the function that makes an engine from an address; what: for the help."""

    module: str
    name: str
    what: str


ENGINES = {
    "local": EngineRow(".local", "make_local", "this machine, as many jobs at once as its processors and memory allow"),
    "ray": EngineRow(".ray", "make_ray", "a Ray cluster at --address, or one started here"),
    "slurm": EngineRow(".slurm", "make_slurm", "a SLURM cluster, as arrays of sbatch"),
}
"""Name on the command line -> engine."""


def make_engine(name: str, address: str = "") -> Engine:
    """Raises StgaError where the engine is not there, or has no use for an address."""
    row = ENGINES[name]
    make: Callable[[str], Engine] = getattr(import_module(row.module, __package__), row.name)
    return make(address)
