"""The recipe "an effect with a parameter" of docs/architecture.md, followed by a toy."""

from dataclasses import replace

import numpy as np
import pytest

from stga_addon.avatar.embedding import FaceFrames
from stga_addon.avatar.file import Avatar, read_avatar
from stga_addon.avatar.lattice import lattice_splats
from stga_addon.avatar.offsets import OFFSETS, POSITION, SIGNALS, DrivenOffset
from stga_addon.avatar.strain import StrainBasis
from stga_addon.capture.model import Capture
from stga_addon.errors import StgaError
from stga_addon.export.formats import export_avatar
from stga_addon.training.effect_catalog import EFFECTS, Effect
from stga_addon.training.effects.plan import (
    RULES,
    Verdict,
    describe_effects,
    plan_effects,
)
from stga_addon.training.optimize.trainer import Trainer
from stga_addon.training.run.checkpoint import read_checkpoint
from stga_addon.training.run.continuation import starting_state
from stga_addon.training.run.folder import Continuation, Run
from stga_addon.training.run.identity import file_digest
from stga_addon.training.run.session import train

from ..test_driven_offsets import squeezed
from ..toys import bits, quick_settings, stop_at

NAME = "toy_growth"


def growth(basis: StrainBasis, frames: FaceFrames) -> np.ndarray:
    """(F, 3): how much larger a triangle is than at rest, and the square and cube of that."""
    larger = frames.scale - 1
    return np.stack([larger, larger**2, larger**3], axis=1).astype(np.float32)


@pytest.fixture(autouse=True)
def toy_effect(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the recipe asks for: a file of its own (`growth`), and a row in each table."""
    monkeypatch.setitem(SIGNALS, NAME, growth)
    monkeypatch.setitem(OFFSETS, NAME, DrivenOffset(NAME, NAME, POSITION, "xyz", 1.0))
    effect = Effect("toy-growth", "Head grows", "larger", "6 numbers", "", {}, {}, (NAME,), True)
    monkeypatch.setitem(EFFECTS, effect.name, effect)
    reason = "the head grows"
    monkeypatch.setitem(RULES, effect.name, lambda facts: Verdict(facts.timesteps > 1, reason))


@pytest.fixture
def capture(toy: Capture) -> Capture:
    """Without evaluation views: the avatar is then that of the last state."""
    return replace(squeezed(toy), views={"train": toy.views["train"]})


def planned(capture: Capture) -> Run:
    others = [each.name for each in EFFECTS.values() if each.offsets not in ((), (NAME,))]
    choices = dict.fromkeys((*others, "view-color", "exposure"), "off")
    settings = quick_settings(
        "global", lattice=1, iterations=30, effects={**choices, "tracking": "auto"}
    )
    settings = replace(settings, density_interval=10, density_span=(0.0, 1.0))
    return Run(capture.root, None, "vhap", *plan_effects(capture, settings))


def test_it_is_decided_trained_and_resumed_to_the_same_bits(capture, tmp_path):
    """Catches plan, training, density, checkpoint, file or continuation that go by names."""
    run = planned(capture)
    assert run.settings.driven_offsets == (NAME,)
    assert dict(describe_effects(run.effect_plan))["toy-growth"] == "on: the head grows [6 numbers]"
    train(capture, tmp_path / "whole", run)
    train(capture, tmp_path / "parts", run, report=stop_at(13))
    assert read_checkpoint(tmp_path / "parts").iteration == 13
    train(capture, tmp_path / "parts", run, resume=True)
    whole, parts = (read_checkpoint(tmp_path / name).state for name in ("whole", "parts"))
    for name, expected in bits(whole).items():
        np.testing.assert_array_equal(bits(parts)[name], expected, err_msg=name)
    for name, expected in vars(whole.driven_offsets[NAME]).items():
        np.testing.assert_array_equal(
            getattr(parts.driven_offsets[NAME], name), expected, err_msg=name
        )
    avatar = read_avatar(tmp_path / "parts" / "avatar.npz")
    np.testing.assert_array_equal(avatar.driven_offsets[NAME], whole.driven_offsets[NAME].average)
    assert np.abs(avatar.driven_offsets[NAME]).max() > 1e-4
    folder = tmp_path / "whole"
    continuation = Continuation(folder, file_digest(folder / "avatar.npz"), 0, 9)
    state = starting_state(continuation, run.settings, len(capture.faces))
    np.testing.assert_array_equal(
        state.driven_offsets[NAME].second, whole.driven_offsets[NAME].second
    )


def test_a_device_without_its_kernels_says_so(capture):
    """Catches an effect that trains without its parameter on a GPU."""
    with pytest.raises(
        StgaError, match=f"driven offset {NAME}: is trained on the CPU only, not on gpu"
    ):
        Trainer(
            capture, quick_settings("global", lattice=0, driven_offsets=(NAME,)), {}, device="gpu"
        )


def test_the_web_player_says_that_it_lacks_it(tmp_path):
    """Catches a page that shows the avatar without the effect."""
    neutral = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]]) / 10
    faces, values = np.int32([[0, 1, 2]]), {NAME: np.ones((1, 3, 3), np.float32)}
    splats = lattice_splats(neutral, faces, 1)
    avatar = Avatar(splats, "stga", neutral, faces, driven_offsets=values)
    with pytest.raises(StgaError, match=f"the web player has no driven offset {NAME}"):
        export_avatar(tmp_path / "a.html", avatar, "web", [(0, neutral)])
