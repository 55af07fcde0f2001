"""Variants that a benchmark compares: presets and strategies, or single settings."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ...capture.selection import SelectionOptions
from ...errors import StgaError
from ...jobs.train import Train
from ...options import like, option
from ...schema import setting
from ...training.settings import PRESETS, STRATEGIES, TrainingSettings, make_settings


@dataclass(frozen=True)
class Benchmark:
    """Train variants of the settings in turns, so that other load on the machine slows all of them
    alike, and measure their avatars.

    out             folder; each variant's run is in a folder of its name
    seconds         of training for each variant
    only            names of some of the variants; empty: all
    """

    out: Path
    capture: Path = like(Train, "capture")
    seconds: float = setting(above=0)
    flame: Path | None = like(Train, "flame")
    principal_point: str = like(Train, "principal_point")
    seed: int = setting(0, 0)
    knobs: bool = option("compare single settings instead of presets and strategies", False)
    only: tuple[str, ...] = ()


Changes = dict[str, Any]
"""Arguments of `make_settings`."""

STANDARD = "standard"
"""The variant that the others are compared with."""

MAIN_VARIANTS: dict[str, Changes] = {
    **{preset: {"preset": preset} for preset in PRESETS},
    **{strategy: {"strategy": strategy} for strategy in STRATEGIES if strategy != "global"},
    "paper": {"schedule": "paper"},
}
"""Presets, which all train globally, the other strategies, and the paper settings."""

SETTING_VARIANTS: dict[str, Changes] = {
    STANDARD: {},
    "scale-0.5": {"scale": 0.5},
    "full-size": {"coarse_share": 0.0},
    "whole-lattice": {"coarse_lattice": False},
    "splats-3": {"lattice": 1},
    "splats-10": {"lattice": 3},
    "splats-15": {"lattice": 4},
    "sh-0": {"sh_degree": 0, "sh_steps": ()},
    "sh-1": {"sh_degree": 1, "sh_steps": (0.3,)},
    "no-dssim": {"ssim_weight": 0.0},
    "no-density": {"density_interval": 0},
    "density-x2": {"growth": 0.5},
    "no-outlier-reset": {"stray_reset_interval": 0},
    "frame-batches": {"views_per_visit": 0},
    "selective": {"strategy": "selective"},
    "selective-every-2": {"strategy": "selective", "global_interval": 2},
    "selective-every-20": {"strategy": "selective", "global_interval": 20},
    "selective-warm-30%": {"strategy": "selective", "warm_up_share": 0.3},
    "selective-1mm": {"strategy": "selective", "selection": SelectionOptions(threshold=0.001)},
    "selective-5mm": {"strategy": "selective", "selection": SelectionOptions(threshold=0.005)},
}
"""One setting changed at a time."""


def settings_of(changes: Changes, seconds: float) -> TrainingSettings:
    """Settings as `stga train` makes them: effects are decided from the capture, except for the
    paper settings and GaussianAvatars, which fix them."""
    fixed = changes.get("schedule") == "paper" or changes.get("strategy") == "gaussian-avatars"
    return make_settings(**{"seconds": seconds, "effects": None if fixed else {}, **changes})


def without_choices(settings: TrainingSettings) -> TrainingSettings:
    """Settings whose effects are decided: what was asked for no longer counts."""
    return replace(settings, effects=None)


def variants_of(request: Benchmark) -> dict[str, Changes]:
    """The variants that are compared. Raises StgaError for unknown names."""
    return select_variants(
        SETTING_VARIANTS if request.knobs else MAIN_VARIANTS, list(request.only) or None
    )


def select_variants(variants: dict[str, Changes], only: list[str] | None) -> dict[str, Changes]:
    """The variants named in `only`, in the order of the table; all without it. Raises StgaError for
    unknown names."""
    unknown = sorted(set(only or ()) - set(variants))
    if unknown:
        raise StgaError(f"--only: '{unknown[0]}' is not one of {', '.join(variants)}")
    return {name: changes for name, changes in variants.items() if only is None or name in only}
