"""The choice of the Python that trains."""

from functools import lru_cache
from pathlib import Path
from typing import Any

import bpy

from ..stga_addon.errors import StgaError
from ..stga_addon.requests.monitor_state import Kind
from ..stga_addon.worker.environment import find_training_python
from ..stga_addon.worker.status import WorkerState
from . import monitor
from .common import environment_folder, preferences


def training_python(context: Any, given: str = "") -> str:
    """The interpreter that trains: the one given, else that of `find_training_python`.

    Raises StgaError where none of them can.
    """
    return bpy.path.abspath(given) if given else find_training_python(environment_folder(), preferred_python(context))


def has_training_python(context: Any) -> bool:
    """Whether `training_python` finds one, for panels: looked up when the environment's worker changes its state."""
    state = monitor.state_of(context.scene, Kind.ENVIRONMENT).snapshot.state
    return bool(_lookup(environment_folder(), preferred_python(context), state))


@lru_cache(maxsize=1)
def _lookup(folder: Path, preferred: str, state: WorkerState) -> str:
    try:
        return find_training_python(folder, preferred)
    except StgaError:
        return ""


def preferred_python(context: Any) -> str:
    """The Python in the preferences; "" where none is."""
    stored = preferences(context)
    return bpy.path.abspath(stored.training_python) if stored and stored.training_python else ""
