"""Visible splat objects as plain values: what both renderers, GPU and CPU, are given; numpy only."""

from dataclasses import dataclass, replace

import numpy as np

from ..avatar.embedding import FaceFrames
from ..avatar.splats import SH_C0, Splats
from ..capture.color import linear_to_srgb
from ..raster.posed_splats import PosedSplats

FROZEN_COLOR = (0.25, 0.25, 0.25, 1.0)  # linear; splats that the current frame does not train
FROZEN_COLOR_SRGB = tuple(float(channel) for channel in linear_to_srgb(np.array(FROZEN_COLOR[:3])))


@dataclass(frozen=True)
class DisplaySettings:
    """A splat object's display settings, as the inputs of its modifier of the same names (`display.splat_nodes`)."""

    size: float = 1.0
    opacity_threshold: float = 0.0
    percentage: float = 100.0
    view_dependent: bool = True
    show_selection: bool = False
    selected_only: bool = False


@dataclass(frozen=True)
class SceneLayer:
    """One visible splat object: its splats as stored, and how they are posed and displayed.

    frames, to_world, antialiased: as in `PosedSplats`. frozen (F,) bool: triangles that the current frame does not
    train; None where the settings do not ask for it, or where the frame has no selection.
    """

    splats: Splats
    frames: FaceFrames
    to_world: np.ndarray
    antialiased: bool = False
    settings: DisplaySettings = DisplaySettings()
    frozen: np.ndarray | None = None

    def posed(self) -> PosedSplats:
        """The same with the settings applied to the splats."""
        splats, settings = self.splats, self.settings
        visible = 1 / (1 + np.exp(-splats.opacity)) >= settings.opacity_threshold
        visible &= random_percentage(len(splats)) < settings.percentage
        if self.frozen is not None:
            frozen = self.frozen[splats.face]
            splats = _grayed(splats, frozen) if settings.show_selection else splats
            visible &= ~(frozen & settings.selected_only)
        if splats.sh_degree > 0 and not settings.view_dependent:
            splats = replace(splats, sh=splats.sh[:, :1])
        if settings.size != 1:
            visible &= settings.size > 0
            splats = replace(splats, log_scale=splats.log_scale + np.float32(np.log(max(settings.size, 1e-6))))
        splats = splats if visible.all() else splats.rows(visible)
        return PosedSplats(splats, self.frames, self.to_world, self.antialiased)


def random_percentage(count: int) -> np.ndarray:
    """(N,) in 0…100, the same in every call: a splat is shown where it is less than `DisplaySettings.percentage`."""
    return np.random.default_rng(0).random(count) * 100


def _grayed(splats: Splats, frozen: np.ndarray) -> Splats:
    sh, strain_color = splats.sh.copy(), splats.strain_color.copy()
    sh[frozen] = strain_color[frozen] = 0
    sh[frozen, 0] = (np.array(FROZEN_COLOR_SRGB) - 0.5) / SH_C0
    return replace(splats, sh=sh, strain_color=strain_color)
