"""The engines that there are: a row and a file each."""

from importlib import import_module
from typing import Any

from ...errors import StgaError
from ..plan import Engine

ENGINES = {
    "local": ("LocalEngine", "this machine, as many jobs as its processors and memory allow"),
    "ray": ("RayEngine", "a Ray cluster at --address, or one started here"),
    "slurm": ("SlurmEngine", "a SLURM cluster, as arrays of sbatch"),
}


def make_engine(name: str, address: str = "") -> Engine:
    """Raises StgaError where the engine is not there; an address is that of a Ray cluster."""
    if address and name != "ray":
        raise StgaError(f"--address: is that of a Ray cluster; expected --engine ray, got {name}")
    make: Any = getattr(import_module(f".{name}", __package__), ENGINES[name][0])
    engine: Engine = make(address) if name == "ray" else make()
    return engine
