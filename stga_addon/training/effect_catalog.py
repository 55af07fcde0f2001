"""Catalog of effects: what each costs, and the settings that switch it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Effect:
    """An effect: its name, as in `--effect NAME=on`, its cost while it is on, and the settings that
    switch it.

    on, off      changes to `TrainingSettings`
    offset       the driven offset (`avatar.offsets.table`) that it trains, if any
    added_later  whether a continuation may switch it on in a run that went without: only where it
                 adds coefficients, which leave the splats as they were while they are zero
    """

    name: str
    cost: str
    on: Mapping[str, Any] = field(default_factory=dict)
    off: Mapping[str, Any] = field(default_factory=dict)
    offset: str | None = None
    added_later: bool = False


RELIGHT = "relight"
"""The light of the capture is estimated after training, so that the lights of a scene can take its
place."""
WORLD = "world"
"""What stands still behind the person becomes splats of its own, after training."""
_EFFECTS = (
    Effect(
        "view-color",
        "3, 8 or 15 coefficients more a splat and channel",
        off={"sh_degree": 0, "sh_steps": ()},
    ),
    Effect("exposure", "a pass over each image when it is read"),
    Effect("antialiasing", "a root a splat", on={"antialiased": True}, off={"antialiased": False}),
    Effect(
        "background",
        "a pass over the image in every iteration, and one when it is read where the backdrop is not of one color",
        on={"random_background": True, "backdrop": "plain"},
        off={"random_background": False, "backdrop": "plain"},
    ),
    Effect(
        "hull-points",
        "a splat for every 4 mm beside the mesh",
        on={"hull_points": True},
        off={"hull_points": False},
    ),
    Effect(
        "depth-limits",
        "none: splats are smaller and nearer to their triangles",
        on={
            "scale_limit": 1.5,
            "stray_limit": 0.5,
            "stray_reset_interval": 20,
            "adam_epsilon": 0.03,
        },
    ),
    Effect(
        "density",
        "up to a quarter more splats, more in the preset final",
        off={"density_interval": 0},
    ),
    Effect(
        "selection",
        "none: local iterations are cheaper than global ones",
        on={"strategy": "selective"},
        off={"strategy": "global"},
    ),
    Effect(
        "strain-color",
        "3 coefficients more a splat and channel, and the strain of every frame",
        on={"strain_color": True},
        off={"strain_color": False},
        added_later=True,
    ),
    Effect(
        "strain-position",
        "9 coefficients a triangle, and the strain of every frame",
        offset="strain_position",
        added_later=True,
    ),
    Effect(RELIGHT, "seconds after training, and 30 bytes a vertex in the avatar file"),
    Effect(WORLD, "seconds to a minute after training, and a file of its own"),
    Effect("teeth", "splats on 168 triangles", on={"teeth": True}, off={"teeth": False}),
    Effect(
        "torso",
        "none: splats below the neck follow other triangles",
        on={"torso": True},
        off={"torso": False},
    ),
    Effect("neck", "9 shape keys and drivers in Blender"),
    Effect("jaw", "9 shape keys and drivers in Blender"),
    Effect("eyes", "18 shape keys and drivers in Blender"),
    Effect("dynamic-offsets", "a mesh a frame beside the parameters"),
    Effect(
        "tracking",
        "a fifth of the time, or up to a second a timestep and view; tracking.npz is then the head's motion",
        on={"tracking": True},
        off={"tracking": False},
    ),
)
EFFECTS = {effect.name: effect for effect in _EFFECTS}
"""By name, in display order."""
