"""Settings of a training run, their presets and their validation."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from ..avatar.embedding import CONVENTIONS
from ..avatar.offsets import OFFSETS
from ..avatar.splats import MAX_SH_DEGREE
from ..capture.selection import SelectionOptions
from ..errors import StgaError
from ..options import duration, option
from ..schema import MAX_COUNT, complaint, setting, validate
from .effect_catalog import CHOICES, EFFECTS, parse_choice

STRATEGIES = {
    "global": "every iteration trains all splats; most accurate on the captures measured so far",
    "selective": "local iterations train the triangles selected in each frame; global ones, all",
    "gaussian-avatars": "the binding, losses and learning rates of GaussianAvatars",
}
"""Strategies that a training can be asked for -> what they do."""
CONTINUATIONS = ("refine", "extend")
"""Strategies of runs that continue a finished one (`run.continuation`)."""
BACKDROPS = ("plain", "masked", "mesh")
"""plain: one color, that of the settings' background; masked: anything, replaced by that color
outside the masks; mesh: the same, and images without a mask have the tracked mesh's silhouette for
one."""
MAX_WEIGHT = 1e6
"""Largest weight or limit of a loss; larger ones overflow float32."""
MAX_RATE = 1e3
MAX_ADDED_RATIO = 100


@dataclass(frozen=True)
class Rates:
    """Adam's learning rates at the start, of positions in local units (meters of the neutral mesh),
    scales as logarithms, opacity as logit and, `strain_color`, of colors that follow the pose; each
    decays exponentially to `position_end` or `end` of itself."""

    xyz: float = setting(6e-4, 0, MAX_RATE)
    rotation: float = setting(2e-2, 0, MAX_RATE)
    log_scale: float = setting(13e-2, 0, MAX_RATE)
    opacity: float = setting(1e-1, 0, MAX_RATE)
    sh: float = setting(4e-2, 0, MAX_RATE)
    sh_rest: float = setting(2e-3, 0, MAX_RATE)
    strain_color: float = setting(1e-2, 0, MAX_RATE)
    position_end: float = setting(0.017, 0, 1)
    end: float = setting(0.2, 0, 1)


MAX_FINE_TRIANGLES = 16_000
"""FLAME's; on 20,000 and more triangles, 3 splats a triangle give the same images as 6."""


@dataclass(frozen=True)
class Preset:
    """A level of quality: its purpose, and the settings that differ from the defaults; it trains so
    many iterations, but at least so many passes over all training views."""

    purpose: str
    iterations: int
    passes: float
    changes: dict[str, Any]

    def iterations_for(self, views: int) -> int:
        """Iterations for a capture of so many training views."""
        return max(self.iterations, math.ceil(self.passes * views))


PRESETS = {
    "draft": Preset("a first look", 500, 0.3, {"lattice": 1}),
    "standard": Preset("everyday work", 1900, 1.3, {}),
    "final": Preset("the best quality of the three", 5600, 3.8, {"growth": 0.6}),
}
"""Fewer splats are ahead in the first seconds, more of them in the end."""


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of one training run.

    strategy       "selective" trains local and global iterations in turn (STGA, training); "global"
                   only global ones (as good at equal time, docs/benchmarks.md);
                   "refine" and "extend" continue a finished run
    seconds, iterations   the budget: wall time of training (evaluation not counted), or iterations;
                          one of the two, or neither with a preset, which brings its iterations
    lattice        order of the barycentric lattice per triangle: 0 → 1 splat, 2 → 6, 4 → 15 (STGA,
                   embedding); None: 2, or 1 (3 splats) on meshes of more than MAX_FINE_TRIANGLES
    coarse_lattice  without a given `lattice`, begin one order lower, where density control adds the
                   other splats
    views_per_visit  how many views of a frame are trained before the next frame; 0 means all (the
                     paper's batches)
    global_interval, global_unit   a global iteration after every so many local iterations, or
                                   "frame" visits
    warm_up_share  fraction of the budget trained globally before the first local iteration
    selection      which triangles a frame trains
    ssim_weight    of the image loss (1 − w)·L1 + w·(1 − SSIM)
    scale_weight, scale_limit   weight of ‖ReLU(scale − limit)‖₂ and the limit
    distance_weight, distance_limit   the same for the distance from the triangle's origin
    unbound_scale_limit  the scale limit of unbound splats, a multiple of the distance between
                         visual-hull points
    unseen_opacity_weight  of the mean of opacity times unseen fraction (`TrainState`): visual-hull
                   points that few cameras see fade, unless nothing else explains what these cameras
                   see
    adam_beta2     decay of Adam's second moment: at 0.999 it is an average over more iterations
                   than a detail takes to be learned
    adam_nesterov  Adam with Nesterov's momentum (Dozat 2016)
    adam_epsilon   Adam's ε as a fraction of the weight of one of an image's values in the loss:
                   splats that hardly show in an image, and whose gradients are below it, hardly
                   move
    ema_share      fraction of the latest step in each splat's exponential moving average, which the
                   avatar is made of; 1: no averaging
    stray_reset_interval, stray_limit, stray_reset_share   every so many iterations (0: never), a
                   splat farther than the limit from its triangle's origin is put back to this
                   fraction of the limit; 0: onto the origin, as in the paper. On the scalp, the
                   height of hair is added. All limits but `unbound_scale_limit` are multiples of
                   sqrt(2·triangle area) for "stga", of the triangle's own unit of length for
                   "gaussian_avatars"
    sh_degree, sh_steps   highest SH degree, and the fractions of the budget at which the degree
                          rises by one
    hull_points    add visual-hull points for what the mesh does not cover
    density_interval  iterations between density control, 0 never; it works during `density_span` of
                      the budget
    split_share    largest fraction of the splats that one round of density control splits
    growth         most splats that density control may add, as a fraction of the whole lattice and
                   the visual-hull points
    background     color behind the head in the capture's images, and behind transparent ones
    random_background  where there are masks, put a random color behind the head in every iteration,
                   so that splats of the background's color cannot hide in it and alpha is learned
    backdrop       what is behind the head in the images, one of BACKDROPS: but for "plain",
                   training and evaluations see the head over the color `background`
    scale, coarse_share   size of the images trained on, as a fraction of the captured ones; during
                          the first `coarse_share` of the budget half of that
    driven_offsets  names of `avatar.offsets.OFFSETS`: splats follow signals of the pose
    antialiased    splats narrower than a pixel lose opacity instead of growing (`render_forward`)
    teeth          put splats on the rows of teeth that FLAME's mesh is given
    torso          visual-hull points below the neck follow FLAME's root joint, not the head's
                   nearest triangle
    exposure       per training camera: its index, and gain and offset (levels of 255) of red, green
                   and blue in its images, which are corrected when they are read; where it drifts,
                   several rows with their timestep
    covered        camera index and timestep of the training views that are left out, because
                   something covers the head
    tracking       whether the avatar tracks its own head halfway (`RefinedTracking`)
    effects        effect -> "on" or "off" where the user has decided; the others are decided from
                   the capture (`effects.plan`). None: these settings are final
    """

    LATER_FIELDS = ("covered",)

    strategy: str = option(
        "which splats an iteration trains (default global, with --schedule paper selective)",
        "global",
        choices=(*STRATEGIES, *CONTINUATIONS),
        offered=STRATEGIES,
    )
    schedule: str = option(
        "default: what measured best; paper: the settings of the STGA paper",
        "default",
        choices=("default", "paper"),
    )
    seconds: float | None = option(
        "training time such as 90s, 10m (default 2m)",
        None,
        above=0,
        flag="--budget",
        metavar="TIME",
        parse=duration,
        group="budget",
    )
    iterations: int | None = option(
        "number of iterations instead of a time", None, 1, MAX_COUNT, group="budget"
    )
    seed: int = option("fixes every random choice", 0, 0, (1 << 63) - 1)
    lattice: int | None = setting(None, 0, 16)
    coarse_lattice: bool = True
    convention: str = setting("stga", choices=CONVENTIONS)
    views_per_visit: int = setting(1, 0, MAX_COUNT)
    global_interval: int = setting(1, 1, MAX_COUNT)
    global_unit: str = setting("iteration", choices=("iteration", "frame"))
    warm_up_share: float = setting(0.6, 0, 1)
    selection: SelectionOptions = field(default_factory=SelectionOptions)
    rates: Rates = field(default_factory=Rates)
    ssim_weight: float = setting(0.2, 0, 1)
    scale_weight: float = setting(1.0, 0, MAX_WEIGHT)
    scale_limit: float = setting(4.0, 0, MAX_WEIGHT)
    unbound_scale_limit: float = setting(5.0, 0, MAX_WEIGHT)
    unseen_opacity_weight: float = setting(0.06, 0, MAX_WEIGHT)
    distance_weight: float = setting(0.0, 0, MAX_WEIGHT)
    distance_limit: float = setting(1.0, 0, MAX_WEIGHT)
    adam_beta2: float = setting(0.99, 0.5, 0.9999)
    adam_nesterov: bool = True
    adam_epsilon: float = setting(0.003, maximum=1.0, above=0)
    ema_share: float = setting(0.015, 0, 1)
    stray_reset_interval: int = setting(200, 0, MAX_COUNT)
    stray_limit: float = setting(6.0, 0, MAX_WEIGHT)
    stray_reset_share: float = setting(1.0, 0, 1)
    sh_degree: int = setting(3, 0, MAX_SH_DEGREE)
    sh_steps: tuple[float, ...] = setting((0.3, 0.5, 0.7), 0)
    hull_points: bool = True
    density_interval: int = setting(100, 0, MAX_COUNT)
    density_span: tuple[float, float] = setting((0.1, 0.6), 0)
    split_share: float = setting(0.2, 0, 1)
    growth: float = setting(0.25, 0, MAX_ADDED_RATIO)
    background: tuple[float, float, float] = setting((1.0, 1.0, 1.0), 0, 1)
    random_background: bool = True
    backdrop: str = setting("plain", choices=BACKDROPS)
    scale: float = setting(1.0, 0.05, 1)
    coarse_share: float = setting(0.35, 0, 1)
    target_psnr: float | None = option(
        "stop when the held-out views reach it", None, maximum=200, above=0, metavar="DB"
    )
    stop_when_flat: bool = option("stop when more time no longer helps", False)
    preset: str | None = option(
        "quality, and with it training time, in place of a budget; `stga presets` shows the times",
        None,
        choices={name: preset.purpose for name, preset in PRESETS.items()},
    )
    driven_offsets: tuple[str, ...] = ()
    antialiased: bool = False
    teeth: bool = True
    torso: bool = False
    exposure: tuple[tuple[float, ...], ...] = ()
    covered: tuple[tuple[int, ...], ...] = ()
    tracking: bool = False
    effects: Mapping[str, str] | None = option(
        "switch an effect on or off instead of deciding from the capture (docs/effects.md); may be "
        "repeated",
        None,
        flag="--effect",
        metavar="NAME=on|off",
        parse=parse_choice,
    )

    @property
    def background_levels(self) -> tuple[int, int, int]:
        """The background in 0…255, as images are read over it."""
        red, green, blue = (round(255 * part) for part in self.background)
        return red, green, blue

    @property
    def follows_strain(self) -> bool:
        """Whether colors or positions depend on the deformation of the mesh."""
        return bool(self.driven_offsets)

    def lattice_order(self, triangles: int) -> int:
        """Order of the lattice on a mesh of so many triangles, which decides how many splats there
        will be."""
        if self.lattice is not None:
            return self.lattice
        return 2 if triangles <= MAX_FINE_TRIANGLES else 1

    def first_lattice_order(self, triangles: int) -> int:
        """Order of the lattice that training begins with: one less than `lattice_order` where
        density control is to find the places of the other splats."""
        begins_coarse = self.coarse_lattice and self.lattice is None and self.density_interval > 0
        return self.lattice_order(triangles) - begins_coarse

    def check(self) -> None:
        """Raise StgaError for settings at odds, and rows and names that types do not show."""
        given = (self.seconds is not None) + (self.iterations is not None)
        if given > 1 or (given == 0 and self.preset is None):
            raise StgaError("the budget must be given either in seconds or in iterations")
        for row in self.exposure:
            # of a whole recording, and of a timestep of one that drifts
            if len(row) not in (7, 8) or not 0 <= row[0] <= MAX_COUNT or min(row[1:4]) <= 0:
                rows = "rows of a camera index, three gains above 0, three offsets"
                expected = f"{rows}, and a timestep where they drift"
                raise StgaError(complaint("exposure", expected, row))
        for row in self.covered:
            if len(row) != 2 or not all(0 <= number <= MAX_COUNT for number in row):
                raise StgaError(complaint("covered", "rows of a camera index and a timestep", row))
        if not set(self.driven_offsets) <= set(OFFSETS):
            expected = f"names among {', '.join(OFFSETS)}"
            raise StgaError(complaint("driven_offsets", expected, self.driven_offsets))
        effects = self.effects or {}
        if not (set(effects) <= set(EFFECTS) and set(effects.values()) <= set(CHOICES)):
            expected = f"effects with {', '.join(CHOICES)}"
            raise StgaError(complaint("effects", expected, dict(effects)))
        for name, value in {"schedule": "paper", "strategy": "gaussian-avatars"}.items():
            if effects and getattr(self, name) == value:
                raise StgaError(f"--effect cannot be combined with --{name} {value}")


_PUBLISHED = {
    "adam_beta2": 0.999,
    "adam_nesterov": False,
    "adam_epsilon": 1e-9,  # 3D Gaussian Splatting's 1e-15, at an image of 600 by 550
    "ema_share": 1.0,
    "hull_points": False,
    "random_background": False,
    "density_interval": 200,
    "split_share": 0.02,
    "coarse_share": 0.0,
}
"""Settings of published methods that differ from the defaults."""
PAPER_SETTINGS = {
    **_PUBLISHED,
    "views_per_visit": 0,
    "global_interval": 20,
    "warm_up_share": 0.0,
    "rates": Rates(4e-4, 1e-2, 4e-2, position_end=0.025, end=0.1),
    "scale_limit": 1.0,
    "stray_limit": 1.0,
    "stray_reset_share": 0.0,
    "lattice": 4,
    "selection": SelectionOptions(threshold=0.01, zero_pose="all"),
}
"""Settings of the paper where they differ from the defaults, which measured best
(docs/benchmarks.md)."""

GAUSSIAN_AVATARS_SETTINGS = {
    **_PUBLISHED,
    "convention": "gaussian_avatars",
    "lattice": 0,
    "rates": Rates(5e-3, 1e-3, 1.7e-2, 5e-2, 2.5e-3, 1.25e-4, position_end=0.01, end=1.0),
    "scale_limit": 0.6,
    "distance_weight": 0.01,
    "stray_reset_interval": 0,
    "growth": 8.0,
}
"""Binding, loss threshold, learning rates (Qian et al. 2024, section 3, released settings)."""


def with_budget(settings: TrainingSettings, views: int) -> TrainingSettings:
    """With the iterations of their preset for so many training views, if they give no budget."""
    if settings.preset is None or settings.seconds is not None or settings.iterations is not None:
        return settings
    return replace(settings, iterations=PRESETS[settings.preset].iterations_for(views))


def make_settings(
    strategy: str | None = None,
    schedule: str = "default",
    preset: str | None = None,
    **changes: Any,
) -> TrainingSettings:
    """TrainingSettings of a strategy, schedule and preset with `changes` on top.

    Without a strategy, the paper schedule trains selectively and the default one by the default
    strategy. Raises StgaError naming a setting that is not allowed (`validate`).
    """
    if strategy is None:
        strategy = "selective" if schedule == "paper" else TrainingSettings.strategy
    base: dict[str, Any] = {"strategy": strategy, "schedule": schedule, "preset": preset}
    validate(TrainingSettings(iterations=1, **base))
    if preset is not None:
        base.update(PRESETS[preset].changes)
    if schedule == "paper":
        base.update(PAPER_SETTINGS)
    if strategy == "gaussian-avatars":
        base.update(GAUSSIAN_AVATARS_SETTINGS)
    settings = TrainingSettings(**{**base, **changes})
    validate(settings)
    return settings
