"""Catalog of effects: what each costs, its settings, and what a run decided about it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ..errors import StgaError
from ..flame.parts import PARTS
from ..schema import setting


@dataclass(frozen=True)
class Effect:
    """An effect: its name, as in `--effect NAME=on`, and its cost while it is on.

    title, price  for everybody: two or three words, and one of "free", "slower" and "larger"
    switch        the setting that is true where it is on, and false where it is off
    on, off       other changes to `TrainingSettings`
    offsets       the driven offsets (`avatar.offsets.OFFSETS`) that it trains
    added_later   whether a continuation may switch it on in a run that went without: only where it
                  adds coefficients, which leave the splats as they were while they are zero
    """

    name: str
    title: str
    price: str
    cost: str
    switch: str = ""
    on: Mapping[str, Any] = field(default_factory=dict)
    off: Mapping[str, Any] = field(default_factory=dict)
    offsets: tuple[str, ...] = ()
    added_later: bool = False


RELIGHT = "relight"
"""The capture's light is estimated after training, so that a scene's lights can take its place."""
WORLD = "world"
"""The static background becomes splats of its own, after training."""
_SHAPES = "shape keys and drivers in Blender"
"""Part of the cost of joints that Blender's rig turns."""
_STRAIN = "and the strain of every frame"
"""Part of the cost of offsets that strain drives."""
_LIMITS = {"scale_limit": 1.5, "stray_limit": 0.5, "stray_reset_interval": 20, "adam_epsilon": 0.03}
"""Settings with which splats stay small and near their triangles."""
_EFFECTS = (
    Effect(
        "occlusions",
        "No hands on the face",
        "free",
        "none: expressions that only these views show are not trained",
        off={"covered": ()},
    ),
    Effect(
        "view-color",
        "Moving highlights",
        "slower",
        "3, 8 or 15 coefficients more a splat and channel",
        off={"sh_degree": 0, "sh_steps": ()},
    ),
    Effect("exposure", "Even brightness", "free", "a pass over each image when it is read"),
    Effect("antialiasing", "Sharp from afar", "free", "a root a splat", "antialiased"),
    Effect(
        "background",
        "Clean outline",
        "slower",
        "a pass over the image in every iteration, and one when it is read where the backdrop "
        "is not of one color",
        "random_background",
        on={"backdrop": "plain"},
        off={"backdrop": "plain"},
    ),
    Effect(
        "hull-points",
        "Hair beyond face",
        "larger",
        "a splat for every 4 mm beside the mesh",
        "hull_points",
    ),
    Effect(
        "depth-limits",
        "No outliers",
        "free",
        "none: splats are smaller and nearer to their triangles",
        on=_LIMITS,
    ),
    Effect(
        "density",
        "Finer detail",
        "slower",
        "up to 1.25 times the full lattice and visual-hull points; 1.6 in the preset final",
        off={"density_interval": 0},
    ),
    Effect(
        "selection",
        "Moving parts only",
        "free",
        "none: local iterations are cheaper than global ones",
        on={"strategy": "selective"},
        off={"strategy": "global"},
    ),
    Effect(
        "strain-color",
        "Color of wrinkles",
        "slower",
        f"9 coefficients a triangle, {_STRAIN}",
        offsets=("strain_color",),
        added_later=True,
    ),
    Effect(
        "normal-color",
        "Shade of turned skin",
        "slower",
        "9 coefficients a triangle, and the normals of every frame",
        offsets=("normal_color",),
        added_later=True,
    ),
    Effect(
        "strain-position",
        "Shape of wrinkles",
        "slower",
        f"12 coefficients a triangle, {_STRAIN}",
        offsets=("strain_position", "strain_scale"),
        added_later=True,
    ),
    Effect(
        RELIGHT,
        "Other lighting",
        "slower",
        "seconds after training, and 30 bytes a vertex in the avatar file",
    ),
    Effect(
        WORLD, "Room behind", "slower", "seconds to a minute after training, and a file of its own"
    ),
    *(
        Effect(name, part.label, "free", f"splats on {part.faces} triangles", name)
        for name, part in PARTS.items()
    ),
    Effect(
        "torso", "Shoulders", "free", "none: splats below the neck follow other triangles", "torso"
    ),
    Effect("neck", "Turning neck", "free", f"9 {_SHAPES}"),
    Effect("jaw", "Turning jaw", "free", f"9 {_SHAPES}"),
    Effect("eyes", "Turning eyes", "free", f"18 {_SHAPES}"),
    Effect("dynamic-offsets", "Recorded details", "larger", "a mesh a frame beside the parameters"),
    Effect(
        "tracking",
        "Better tracking",
        "slower",
        "a fifth of the time, or up to a second a timestep and view; tracking.npz is then the "
        "head's motion",
        "tracking",
    ),
)
"""Every effect, in display order."""
EFFECTS = {effect.name: effect for effect in _EFFECTS}
"""Effects by name, in display order."""
CHOICES = ("auto", "on", "off")


@dataclass(frozen=True)
class EffectDecision:
    """About one of EFFECTS: the user's choice, whether it is on, why, and its cost while on."""

    effect: str
    choice: str = setting(choices=CHOICES)
    on: bool = setting()
    reason: str = setting()
    cost: str = setting()

    def __str__(self) -> str:
        asked = "" if self.choice == "auto" else ", as asked"
        cost = f" [{self.cost}]"
        return f"{'on' if self.on else 'off'}{asked}: {self.reason}{cost if self.on else ''}"


def parse_choice(text: str) -> tuple[str, str]:
    """Effect and choice, from a text such as "jaw=off". Raises StgaError for anything else."""
    name, _, choice = text.partition("=")
    if name not in EFFECTS or choice not in CHOICES:
        raise StgaError(
            f"'{text}' is not NAME=on, NAME=off or NAME=auto with one of {', '.join(EFFECTS)}"
        )
    return name, choice
