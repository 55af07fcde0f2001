"""Which effects a capture calls for: one rule an effect, with the figure that decided."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..flame.sequence import TURN
from .facts import CaptureFacts

FEWEST_CAMERAS = 4
"""With fewer, colour that depends on the view has nothing between the cameras to be right about."""
VIEW_LEVELS = 1.0
"""Levels of 255 that colours must follow the direction of view by."""
CAMERA_LEVELS = 1.5
"""Levels of 255 that the cameras must differ by, to be brought together."""
STRAIN_LEVELS = 1.0
"""Levels of 255 that colours must follow the triangles' deformation by."""
STILL = 1e-6
"""Stretch that is rounding."""
PIXEL_RANGE = 1.25
"""Widest over narrowest pixel from which splats narrower than a pixel would look different to different cameras."""
FINE = 4.0
"""Pixels a splat below which what keeps splats from being narrower than a pixel changes how they look."""
EVEN = 6.0
"""Levels of 255 that a background of one colour may scatter by."""
SAME = 3.0
"""Levels of 255 by which a background may miss the colour that the settings name."""
BESIDE = 0.003
"""Share of the foreground beside the mesh from which something must stand for it."""
PIXELS_PER_SPLAT = 0.5
"""Fewer than this leave nothing for further splats to show."""
LIPS, JAW = 1.5, 3.0
"""Millimetres that the lips must part by, or degrees that the jaw must open by, for teeth to be seen."""

OUTSIDE = 0.001
"""Share of the mesh outside the masks from which the tracking cannot be right."""


@dataclass(frozen=True)
class Verdict:
    """What a rule found.

    on       whether the capture calls for the effect
    reason   why, in half a sentence with its figure
    only     nothing else can work, so the reason is also what an override is refused with
    changes  further settings that go with the effect being on
    """

    on: bool
    reason: str
    only: bool = False
    changes: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Effect:
    """An effect: its name, what it costs while it is on, its rule, and the settings that switch it.

    rule     what decides; None where the capture has nothing that the effect could apply to
    on, off  what it sets of `TrainingSettings`
    """

    name: str
    cost: str
    rule: Callable[[CaptureFacts], Verdict | None]
    on: Mapping[str, Any] = field(default_factory=dict)
    off: Mapping[str, Any] = field(default_factory=dict)


def view_color(facts: CaptureFacts) -> Verdict:
    if facts.cameras == 1:
        return Verdict(False, "one camera sees everything from one direction only", only=True)
    if facts.cameras < FEWEST_CAMERAS:
        return Verdict(False, f"{facts.cameras} cameras are too few to tell how colour depends on the view")
    found = facts.view_dependence
    says = f"colours follow the direction of view by {found.gain:.1f} of 255 levels ({found.share:.1%} of the variance)"
    return Verdict(found.gain >= VIEW_LEVELS, says)


def exposure(facts: CaptureFacts) -> Verdict:
    if facts.cameras == 1:
        return Verdict(False, "one camera has no other to differ from", only=True)
    found, colors = facts.camera_difference, facts.camera_colors
    rows = tuple(
        (float(camera), *gain, *offset)
        for camera, gain, offset in zip(colors.camera, colors.gain.tolist(), colors.offset.tolist(), strict=True)
    )
    says = f"{facts.cameras} cameras show the same colours {found.gain:.1f} of 255 levels apart"
    return Verdict(found.gain >= CAMERA_LEVELS, says, changes={"exposure": rows})


def antialiasing(facts: CaptureFacts) -> Verdict:
    settings, widest = facts.settings, facts.pixel_range
    if settings.scale < 1 or settings.coarse_share > 0:
        return Verdict(True, "images are trained on at less than the size that they are drawn at")
    if widest > PIXEL_RANGE:
        return Verdict(True, f"the widest pixel at the head is {widest:.2f} times the narrowest")
    pixels = facts.pixels_per_splat(50)
    return Verdict(
        pixels < FINE, f"pixels are alike at the head, and half of the splats have under {pixels:.1f} of them"
    )


def background(facts: CaptureFacts) -> Verdict:
    samples = facts.samples
    backdrops = samples.backdrop
    if np.isnan(backdrops).any():
        return Verdict(False, "not every image has a mask or transparency that says where the head ends", only=True)
    color, uneven = backdrops.mean(0), float(samples.unevenness.max())
    apart = max(uneven, float(abs(backdrops - color).max()))
    if apart > EVEN:
        return Verdict(False, f"behind the head the images vary by {apart:.0f} of 255 levels", only=True)
    named = bool(abs(color - 255 * np.array(facts.settings.background)).max() < SAME)
    changes = {} if named else {"background": tuple((color / 255).round(4).tolist())}
    red, green, blue = color.round().astype(int).tolist()
    return Verdict(True, f"masks everywhere, and one colour behind the head ({red}, {green}, {blue})", changes=changes)


def hull_points(facts: CaptureFacts) -> Verdict:
    if facts.cameras == 1:
        return Verdict(False, "one camera cannot tell how far away something beside the mesh is", only=True)
    if np.isnan(facts.beside):
        return Verdict(facts.settings.hull_points, "without masks, how much lies beside the mesh is not known")
    return Verdict(facts.beside > BESIDE, f"{facts.beside:.1%} of the foreground lies beside the mesh")


def density(facts: CaptureFacts) -> Verdict:
    pixels = facts.pixels_per_splat(90)
    return Verdict(pixels > PIXELS_PER_SPLAT, f"triangles show up to {pixels:.1f} pixels a splat")


def selection(facts: CaptureFacts) -> Verdict:
    threshold = 1000 * facts.settings.selection.threshold
    if facts.selected == 0:
        return Verdict(False, f"no triangle moves by more than {threshold:g} mm in any frame", only=True)
    says = f"a frame moves {facts.selected:.0%} of the triangles by more than {threshold:g} mm"
    asked = facts.settings.strategy == "selective"
    return Verdict(asked, says + ("" if asked else ", but training all of them measured best"))


def strain_color(facts: CaptureFacts) -> Verdict:
    if facts.strain < STILL:
        return Verdict(False, "the mesh has the same shape in every training frame", only=True)
    if facts.timesteps < 3:
        return Verdict(False, f"{facts.timesteps} frames are too few to tell how colour follows deformation")
    found = facts.strain_dependence
    says = f"colours follow deformation by {found.gain:.1f} of 255 levels ({found.share:.1%} of the variance)"
    return Verdict(found.gain >= STRAIN_LEVELS, says)


def teeth(facts: CaptureFacts) -> Verdict | None:
    if not facts.has_teeth:
        return None
    jaw, lips = facts.turns(2), facts.lips
    says = f"the jaw opens by {jaw:.0f}°, the lips by {lips:.1f} mm"
    return Verdict(jaw > JAW or lips > LIPS, says)


def joint(name: str, *joints: int) -> Effect:
    """Bones of Blender's rig that move, and the shape keys that correct the mesh where they do."""

    def rule(facts: CaptureFacts) -> Verdict | None:
        if not facts.frames:
            return None
        turn = facts.turns(*joints)
        return Verdict(turn > TURN, f"turns by up to {turn:.1f}°")

    return Effect(name, f"{9 * len(joints)} shape keys and drivers in Blender", rule)


def dynamic_offsets(facts: CaptureFacts) -> Verdict | None:
    if not facts.frames:
        return None
    count = sum(frame.dynamic_offset is not None for frame in facts.frames)
    if not count:
        return Verdict(False, "no frame has any", only=True)
    return Verdict(True, f"{count} of {len(facts.frames)} frames have some, and the tracked mesh with them", only=True)


def tracking(facts: CaptureFacts) -> Verdict | None:
    if not facts.frames:
        return None
    if facts.device != "cpu":
        return Verdict(False, f"FLAME's parameters are refined on the CPU only, not on {facts.device}", only=True)
    if facts.timesteps == 1:
        return Verdict(False, "the splats of a single frame go where its images are by themselves", only=True)
    if np.isnan(facts.outside):
        return Verdict(False, "without masks, whether the mesh is where the images are is not known")
    return Verdict(facts.outside > OUTSIDE, f"{facts.outside:.2%} of the mesh sticks out of the masks")


EFFECTS = (
    Effect(
        "view-color",
        "3, 8 or 15 coefficients more a splat and channel",
        view_color,
        off={"sh_degree": 0, "sh_steps": ()},
    ),
    Effect("exposure", "a pass over each image when it is read", exposure),
    Effect("antialiasing", "a root a splat", antialiasing, on={"antialiased": True}, off={"antialiased": False}),
    Effect(
        "background",
        "a pass over the image in every iteration",
        background,
        on={"random_background": True},
        off={"random_background": False},
    ),
    Effect(
        "hull-points",
        "a splat for every 4 mm beside the mesh",
        hull_points,
        on={"hull_points": True},
        off={"hull_points": False},
    ),
    Effect("density", "up to a quarter more splats, more in the preset final", density, off={"density_interval": 0}),
    Effect(
        "selection",
        "none: local iterations are cheaper than global ones",
        selection,
        on={"strategy": "selective"},
        off={"strategy": "global"},
    ),
    Effect(
        "strain-color",
        "3 coefficients more a splat and channel, and the strain of every frame",
        strain_color,
        on={"strain_color": True},
        off={"strain_color": False},
    ),
    Effect("teeth", "splats on 168 triangles", teeth, on={"teeth": True}, off={"teeth": False}),
    joint("neck", 1),
    joint("jaw", 2),
    joint("eyes", 3, 4),
    Effect("dynamic-offsets", "a mesh a frame beside the parameters", dynamic_offsets),
    Effect(
        "tracking",
        "a pass through FLAME and back in every global iteration; the run's tracking.npz is then the head's motion",
        tracking,
        on={"tracking": True},
        off={"tracking": False},
    ),
)
"""In the order in which they are shown."""
