"""Everything that can be set about a training run, with its default and where it comes from."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from types import NoneType
from typing import Any, get_args, get_origin, get_type_hints

from ..errors import StgaError
from ..selection import SelectionOptions
from .effect_plan import CHOICES

STRATEGIES = ("selective", "global", "gaussian-avatars")
SCHEDULES = ("default", "paper")
DEVICES = ("auto", "cpu", "cuda", "warp-cpu")
"""What may train (see `device`); no part of a run's settings, because a run may go on elsewhere."""


@dataclass(frozen=True)
class Rates:
    """Adam's learning rates at the start; each decays exponentially to `position_end` or `end` of itself.

    Positions in local units (metres of the neutral mesh), scales as logarithms, opacity as logit.
    """

    xyz: float = 4e-4
    rotation: float = 1e-2
    log_scale: float = 4e-2
    opacity: float = 1e-1
    sh: float = 4e-2
    sh_rest: float = 2e-3
    strain_color: float = 1e-2
    position_end: float = 0.025
    end: float = 0.1


@dataclass(frozen=True)
class TrainingSettings:
    """One training run.

    strategy       "selective" trains local and global iterations in turn (STGA, training); "global" only global
                   ones, which measured best at equal time (docs/results.md); "gaussian-avatars" is global training
                   with that method's binding, losses and rates
    schedule       "paper" took the paper's letter wherever `PAPER_SETTINGS` differs from the defaults
    seconds, iterations   the budget: wall time of training (evaluation not counted), or iterations; one of the two
    seed           fixes the order of views and every random choice
    lattice        order of the barycentric lattice per triangle: 0 → 1 splat, 2 → 6, 4 → 15 (STGA, embedding)
    convention     embedding convention
    views_per_visit  how many views of a frame are trained before the next frame; 0 means all (the paper's batches)
    global_interval, global_unit   a global iteration after every so many local iterations, or "frame" visits
    warm_up_share        share of the budget trained globally before the first local iteration
    selection      which triangles a frame trains
    ssim_weight    of the image loss (1 − w)·L1 + w·(1 − SSIM)
    scale_weight, scale_limit   weight of ‖ReLU(scale − limit)‖₂ and the limit
    distance_weight, distance_limit   the same for the distance from the triangle's origin
    ema_share      the avatar is made of each splat's running average over its steps, in which the latest has this
                   share; 1: of the splats as they are
    stray_reset_interval, stray_limit, stray_reset_share   every so many iterations (0: never), a splat farther than the
                   limit from its triangle's origin is put back to this share of the limit; 0: onto the origin, as in
                   the paper
                   All limits are multiples of sqrt(2·triangle area) for "stga", of the triangle's own unit of length
                   for "gaussian_avatars"
    sh_degree, sh_steps   highest degree, and the shares of the budget at which the degree rises by one
    hull_points    add hull points for what the mesh does not cover
    density_interval  iterations between density control, 0 never; it works during `density_span` of the budget
    growth         most splats that density control may add, as a share of the initial number
    background     colour behind the head in the capture's images, and behind transparent ones
    random_background  where there are masks, put another random colour behind the head in every iteration, so that
                   splats in the background's colour cannot hide in it and alpha becomes right
    scale, coarse_share   size of the images trained on, as a share of the captured ones; during the first
                   `coarse_share` of the budget half of that
    target_psnr    stop when the held-out views reach this many dB
    stop_when_flat  stop when more time no longer helps (`forecast.plateau_start`)
    preset         the preset that these settings began with, or none
    strain_color   splats carry colour that follows how their triangle deforms (`avatar.strain`)
    antialiased    splats narrower than a pixel lose opacity instead of growing (`render_forward`)
    teeth          put splats on the rows of teeth that FLAME's mesh is given
    exposure       per training camera: its index, and gain and offset (levels of 255) of red, green and blue in its
                   images, which are taken away when they are read
    tracking       refine FLAME's expression, joints and translation of each training timestep (`tracking`)
    effects        effect -> "on" or "off" where the person has decided, with everything else to be decided from the
                   capture (`effects.plan`); None: these settings are final
    """

    strategy: str = "global"
    schedule: str = "default"
    seconds: float | None = None
    iterations: int | None = None
    seed: int = 0
    lattice: int = 2
    convention: str = "stga"
    views_per_visit: int = 1
    global_interval: int = 1
    global_unit: str = "iteration"
    warm_up_share: float = 0.6
    selection: SelectionOptions = field(default_factory=SelectionOptions)
    rates: Rates = field(default_factory=Rates)
    ssim_weight: float = 0.2
    scale_weight: float = 1.0
    scale_limit: float = 4.0
    distance_weight: float = 0.0
    distance_limit: float = 1.0
    ema_share: float = 0.05
    stray_reset_interval: int = 200
    stray_limit: float = 6.0
    stray_reset_share: float = 1.0
    sh_degree: int = 3
    sh_steps: tuple[float, ...] = (0.3, 0.5, 0.7)
    hull_points: bool = True
    density_interval: int = 200
    density_span: tuple[float, float] = (0.1, 0.6)
    growth: float = 0.25
    background: tuple[float, float, float] = (1.0, 1.0, 1.0)
    random_background: bool = True
    scale: float = 1.0
    coarse_share: float = 0.0
    target_psnr: float | None = None
    stop_when_flat: bool = False
    preset: str | None = None
    strain_color: bool = False
    antialiased: bool = False
    teeth: bool = True
    exposure: tuple[tuple[float, ...], ...] = ()
    tracking: bool = False
    effects: Mapping[str, str] | None = None


PAPER_SETTINGS = {
    "views_per_visit": 0,
    "global_interval": 20,
    "warm_up_share": 0.0,
    "scale_limit": 1.0,
    "stray_limit": 1.0,
    "stray_reset_share": 0.0,
    "ema_share": 1.0,
    "lattice": 4,
    "hull_points": False,
    "random_background": False,
    "selection": SelectionOptions(threshold=0.01, zero_pose="all"),
}
"""The paper's letter, where it differs from the defaults, which are what measured best (docs/results.md)."""

GAUSSIAN_AVATARS_SETTINGS = {
    "convention": "gaussian_avatars",
    "lattice": 0,
    "rates": Rates(
        xyz=5e-3, log_scale=1.7e-2, rotation=1e-3, opacity=5e-2, sh=2.5e-3, sh_rest=1.25e-4, position_end=0.01, end=1.0
    ),
    "scale_limit": 0.6,
    "distance_weight": 0.01,
    "stray_reset_interval": 0,
    "ema_share": 1.0,
    "hull_points": False,
    "random_background": False,
    "growth": 8.0,
}
"""GaussianAvatars' binding, loss threshold and learning rates (Qian et al. 2024, section 3 and released settings)."""


@dataclass(frozen=True)
class Preset:
    """A level of quality: what it is for, what differs from the defaults, and how long to train.

    iterations, passes  train so many iterations, but at least so many passes over all training views
    """

    purpose: str
    iterations: int
    passes: float
    changes: dict[str, Any]

    def iterations_for(self, views: int) -> int:
        """Iterations for a capture of so many training views."""
        return max(self.iterations, math.ceil(self.passes * views))


PRESETS = {
    "draft": Preset("a first look", 800, 0.5, {"lattice": 1}),
    "standard": Preset("everyday work", 3000, 2.0, {}),
    "final": Preset("the best that a coffee break buys", 9000, 6.0, {"growth": 0.6}),
}
"""Fewer splats are ahead in the first seconds, more of them in the end."""


def make_settings(
    strategy: str | None = None, schedule: str = "default", preset: str | None = None, **changes: Any
) -> TrainingSettings:
    """TrainingSettings of a strategy, schedule and preset with `changes` on top.

    Without a strategy, the paper's schedule trains selectively and the default one by the default strategy.
    Raises StgaError naming an impossible value.
    """
    if strategy is None:
        strategy = "selective" if schedule == "paper" else TrainingSettings.strategy
    if strategy not in STRATEGIES:
        raise StgaError(f"--strategy: '{strategy}' is not one of {', '.join(STRATEGIES)}")
    if schedule not in SCHEDULES:
        raise StgaError(f"--schedule: '{schedule}' is not one of {', '.join(SCHEDULES)}")
    if preset not in (None, *PRESETS):
        raise StgaError(f"--preset: '{preset}' is not one of {', '.join(PRESETS)}")
    base: dict[str, Any] = {"preset": preset}
    if preset is not None:
        base.update(PRESETS[preset].changes)
    if schedule == "paper":
        base.update(PAPER_SETTINGS)
    if strategy == "gaussian-avatars":
        base.update(GAUSSIAN_AVATARS_SETTINGS)
    settings = TrainingSettings(**{**base, "strategy": strategy, "schedule": schedule, **changes})
    if (settings.seconds is None) == (settings.iterations is None):
        raise StgaError("give a budget in wall time (--budget) or in iterations (--iterations), one of the two")
    if not (settings.seconds or settings.iterations or 0) > 0:
        raise StgaError("the budget must be more than nothing")
    if settings.seed < 0:
        raise StgaError(f"--seed: {settings.seed} is negative, expected a whole number from 0 up")
    if not 0 <= settings.selection.threshold < float("inf"):
        raise StgaError(f"--threshold: {settings.selection.threshold} is no distance in metres")
    if settings.effects and (schedule == "paper" or strategy == "gaussian-avatars"):
        raise StgaError("--effect: trains something else than the paper's letter or GaussianAvatars' method")
    if settings.target_psnr is not None and not 0 < settings.target_psnr < 200:
        raise StgaError(f"--target-psnr: {settings.target_psnr} is no PSNR in dB")
    return settings


def to_json(settings: TrainingSettings) -> dict[str, Any]:
    """Plain values, for the run folder and the avatar file; `from_json` reads them back."""
    return dataclasses.asdict(settings)


def from_json(values: dict[str, Any]) -> TrainingSettings:
    """TrainingSettings from `to_json`. Raises TypeError or KeyError where a field is unknown or missing."""
    values = dict(values)
    values["selection"] = SelectionOptions(**{**values["selection"], "regions": tuple(values["selection"]["regions"])})
    values["rates"] = Rates(**values["rates"])
    for name in ("sh_steps", "density_span", "background"):
        values[name] = tuple(values[name])
    values["exposure"] = tuple(tuple(float(number) for number in row) for row in values.get("exposure", ()))
    settings = TrainingSettings(**values)
    if settings.effects is not None and not set(settings.effects.values()) <= set(CHOICES):
        raise TypeError(f"effects is {settings.effects!r}")
    for part in (settings, settings.selection, settings.rates):
        _check_types(part)
    return settings


def _check_types(part: Any) -> None:
    """Raise TypeError where a plain value is of another type than its field says."""
    for name, hint in get_type_hints(type(part)).items():
        kinds = get_args(hint) or (hint,)
        plain = [kind for kind in kinds if kind in (int, float, str, bool, NoneType)]
        if get_origin(hint) is tuple or len(plain) < len(kinds):
            continue
        value = getattr(part, name)
        wanted = (*plain, int) if float in plain else tuple(plain)
        if not isinstance(value, wanted) or (isinstance(value, bool) and bool not in plain):
            raise TypeError(f"{name} is {value!r}")
