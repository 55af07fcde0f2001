"""Visible splat objects as plain values, which both renderers are given; numpy only."""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ..avatar.embedding import NO_COLUMNS, FaceFrames
from ..avatar.splats import SH_C0, Splats
from ..capture.color import linear_to_srgb
from ..light.relight import Relighter
from ..light.values import Caster, Lighting
from ..raster.posed_splats import PosedSplats, in_gray

FROZEN_COLOR = (0.25, 0.25, 0.25, 1.0)  # linear; splats that the current frame does not train
UNSEEN_COLOR = (0.02, 0.2, 0.6, 1.0)  # linear; splats that no camera saw
FROZEN_COLOR_SRGB, UNSEEN_COLOR_SRGB = (
    tuple(float(channel) for channel in linear_to_srgb(np.array(color[:3])))
    for color in (FROZEN_COLOR, UNSEEN_COLOR)
)


@dataclass(frozen=True)
class DisplaySettings:
    """A splat object's display settings, inputs of its modifier (`display.splat_nodes`)."""

    size: float = 1.0
    opacity_threshold: float = 0.0
    percentage: float = 100.0
    view_dependent: bool = True
    show_selection: bool = False
    selected_only: bool = False
    show_unseen: bool = False
    filmed_only: bool = False


@dataclass(frozen=True, eq=False)
class Relit:
    """How a scene lights an avatar: posed mesh (V, 3), light and casters in its space."""

    relighter: Relighter
    mesh: np.ndarray
    lighting: Lighting
    casters: tuple[Caster, ...] = ()

    def splats(self, eye: np.ndarray) -> Splats:
        """The avatar's splats in the colors of this light, seen from eye (3,) in its space."""
        splats = self.relighter.avatar.splats
        color = self.relighter.colors(self.mesh, eye, self.lighting, self.casters)
        sh = ((color - np.float32(0.5)) / np.float32(SH_C0))[:, None]
        return replace(splats, sh=sh)

    @cached_property
    def face_color(self) -> np.ndarray:
        """(F, 3), or (·, 0): of the frames' color, what belongs to the relit colors."""
        return self.relighter.avatar.without_light.frames(self.mesh).color


@dataclass(frozen=True)
class SceneLayer:
    """A visible splat object: its splats, how they are posed (as `PosedSplats`) and displayed.
    frozen (F,) bool: triangles that the frame does not train, None where nobody asks; unseen (F,)
    bool: those that no camera saw, None where the avatar does not know. relit: None where colors
    are as recorded. holdout: it makes what it covers transparent."""

    splats: Splats
    frames: FaceFrames
    to_world: np.ndarray
    antialiased: bool = False
    settings: DisplaySettings = DisplaySettings()
    frozen: np.ndarray | None = None
    unseen: np.ndarray | None = None
    relit: Relit | None = None
    holdout: bool = False

    def painted(self, value: float) -> "SceneLayer":
        """The same splats in one gray of 0…1, sRGB."""
        splats, frames = in_gray(self.splats, self.frames, value)
        settings = replace(self.settings, show_selection=False, show_unseen=False)
        return replace(self, splats=splats, frames=frames, settings=settings, relit=None)

    def posed(self, eye: np.ndarray | None = None) -> PosedSplats:
        """The splats as the settings show them; eye (3,): camera in the scene, where relit."""
        splats = self.splats
        frames = self.frames
        settings = self.settings
        if self.relit is not None:
            assert eye is not None
            splats = self.relit.splats(self.eye_in_avatar(eye))
            frames = replace(frames, color=NO_COLUMNS)
        visible = 1 / (1 + np.exp(-splats.opacity)) >= settings.opacity_threshold
        visible &= random_percentage(len(splats)) < settings.percentage
        for faces, is_painted, is_hidden, paint in (
            (self.frozen, settings.show_selection, settings.selected_only, FROZEN_COLOR_SRGB),
            (self.unseen, settings.show_unseen, settings.filmed_only, UNSEEN_COLOR_SRGB),
        ):
            if faces is None:
                continue
            rows = faces[splats.face]
            if is_painted:
                sh = splats.sh.copy()
                sh[rows] = 0
                sh[rows, 0] = (np.array(paint) - 0.5) / SH_C0
                splats = replace(splats, sh=sh)
                color = np.where(faces[:, None], np.float32(0), frames.color)
                frames = replace(frames, color=color)
            visible &= ~(rows & is_hidden)
        if splats.sh_degree > 0 and not settings.view_dependent:
            splats = replace(splats, sh=splats.sh[:, :1])
        if settings.size != 1:
            visible &= settings.size > 0
            factor = np.float32(np.log(max(settings.size, 1e-6)))
            splats = replace(splats, log_scale=splats.log_scale + factor)
        splats = splats if visible.all() else splats.rows(visible)
        return PosedSplats(splats, frames, self.to_world, self.antialiased, self.holdout)

    def eye_in_avatar(self, eye: np.ndarray) -> np.ndarray:
        """(3,) of a position (3,) in the scene."""
        return (np.linalg.inv(self.to_world) @ [*eye, 1.0])[:3]


def random_percentage(count: int) -> np.ndarray:
    """(N,) in 0…100, always the same: a splat is shown where it is less than the percentage."""
    return np.random.default_rng(0).random(count) * 100
