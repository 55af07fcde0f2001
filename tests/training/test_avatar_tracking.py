"""Tracking by a finished avatar: where it brings a head that is off, and what it leaves alone."""

from dataclasses import replace

import numpy as np
import pytest

from stga_addon.avatar.file import Avatar
from stga_addon.capture.model import Capture
from stga_addon.errors import StgaError
from stga_addon.flame.forward import FlameFrame, frame_of
from stga_addon.flame.sequence import sequence_mesh
from stga_addon.training.avatar_tracking import AvatarTracking, track_by_avatar
from stga_addon.training.optimize.trainer import Trainer
from stga_addon.training.settings import TrainingSettings

from .heads import TIMESTEPS, write_head
from .test_flame_refinement import trained

TRAINED = TIMESTEPS[:-1]
Person = tuple[Avatar, TrainingSettings]


@pytest.fixture(scope="module")
def person(tmp_path_factory: pytest.TempPathFactory) -> Person:
    """An avatar whose training saw the right meshes."""
    capture, _ = write_head(tmp_path_factory.mktemp("right"), error=0.0)
    trainer: Trainer = trained(capture, 300)
    settings = trainer.settings
    avatar = Avatar(
        trainer.state.averaged(), settings.convention, capture.neutral.astype(np.float32), capture.faces,
        antialiased=settings.antialiased,
    )  # fmt: skip
    return avatar, settings


@pytest.fixture(scope="module")
def lost(tmp_path_factory: pytest.TempPathFactory) -> tuple[Capture, dict[int, np.ndarray]]:
    """The same head, tracked a few millimeters and degrees off, and its true meshes."""
    return write_head(tmp_path_factory.mktemp("lost"))


def millimeters(capture: Capture, found: AvatarTracking, true: dict[int, np.ndarray]) -> np.ndarray:
    """(T,) mean distance of the vertices from where they are."""
    assert capture.flame is not None
    frames = dict(zip(found.timesteps, found.parameters, strict=True))
    moved = replace(capture.flame, frame=lambda t: frame_with(capture, t, frames[t]))
    away = [sequence_mesh(moved, t) - true[t] for t in found.timesteps]
    return 1000 * np.linalg.norm(away, axis=-1).mean(1)


def frame_with(capture: Capture, timestep: int, values: np.ndarray) -> FlameFrame:
    assert capture.flame is not None
    return frame_of(values, capture.flame.frame(timestep).dynamic_offset)


def test_it_finds_the_head(person: Person, lost: tuple[Capture, dict[int, np.ndarray]]) -> None:
    """Catches a gradient or a preconditioner with a wrong sign, axis or joint, and steps that stop too early: the true
    meshes are known, and those of the last timestep are tracked right already."""
    capture, true = lost
    stages: list[tuple[int, int]] = []
    found = track_by_avatar(*person, capture, report=lambda stage, done, total: stages.append((done, total)))
    assert capture.flame is not None
    start = np.stack([capture.flame.frame(t).parameters for t in found.timesteps])
    before = millimeters(capture, replace(found, parameters=start), true)
    after = millimeters(capture, found, true)
    assert (before[:-1] > 2).all()
    assert np.median(after[:-1] / before[:-1]) < 0.3
    assert after[-1] < 0.8  # a third of a pixel
    assert (found.after <= found.before).all()
    assert [stages[0], stages[-1]] == [(0, len(TIMESTEPS)), (len(TIMESTEPS),) * 2]


def test_another_head(person: Person, lost: tuple[Capture, dict[int, np.ndarray]]) -> None:
    capture = lost[0]
    with pytest.raises(StgaError, match="another head"):
        track_by_avatar(*person, replace(capture, faces=capture.faces[:-1]))
    with pytest.raises(StgaError, match="is not tracked"):
        track_by_avatar(*person, replace(capture, flame=None))
