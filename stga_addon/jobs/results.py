"""Results of requests, as plain values."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..training.effect_catalog import EffectDecision


@dataclass(frozen=True)
class Written:
    """The request has written a file or a folder. lines: what there is to say about it."""

    path: Path
    lines: tuple[str, ...] = ()


@dataclass(frozen=True)
class Selected:
    """timestep -> (F,) bool: triangles."""

    selection: Mapping[int, np.ndarray]


@dataclass(frozen=True)
class Analyzed:
    """Effects that a capture calls for. seconds: preset -> training time on this machine."""

    plan: tuple[EffectDecision, ...]
    seconds: Mapping[str, float]


Result = Written | Selected | Analyzed
