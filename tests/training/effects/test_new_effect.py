"""The recipe "an effect with a parameter" of docs/architecture.md, followed by a toy."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusal import refusal

from stga_addon.avatar.embedding import face_frames, to_world
from stga_addon.avatar.file import Avatar, read_avatar
from stga_addon.avatar.lattice import lattice_splats
from stga_addon.avatar.offsets import OFFSETS, POSITION, SIGNALS, DrivenOffset
from stga_addon.export.formats import FORMATS, export_avatar
from stga_addon.export.ply import read_ply
from stga_addon.files import file_digest
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
from stga_addon.training.run.session import train_run

from ..test_driven_offsets import squeezed
from ..toys import assert_same_run, quick_settings, stop_at

NAME = "toy_growth"


def growth(basis, frames):
    """(F, 3): how much larger a triangle is than at rest, and the square and cube of that."""
    larger = frames.scale - 1
    return np.stack([larger, larger**2, larger**3], axis=1).astype(np.float32)


@pytest.fixture(autouse=True)
def toy_effect(monkeypatch):
    """What the recipe asks for: a file of its own (`growth`), and a row in each table."""
    monkeypatch.setitem(SIGNALS, NAME, growth)
    monkeypatch.setitem(OFFSETS, NAME, DrivenOffset(NAME, NAME, POSITION, "xyz", 1.0))
    effect = Effect("toy-growth", "Head grows", "larger", "6 numbers", "", {}, {}, (NAME,), True)
    monkeypatch.setitem(EFFECTS, effect.name, effect)
    reason = "the head grows"
    monkeypatch.setitem(RULES, effect.name, lambda facts: Verdict(facts.timesteps > 1, reason))


@pytest.fixture
def capture(toy):
    """Without evaluation views: the avatar is then that of the last state."""
    return replace(squeezed(toy), views={"train": toy.views["train"]})


def planned(capture):
    others = [each.name for each in EFFECTS.values() if each.offsets not in ((), (NAME,))]
    choices = dict.fromkeys((*others, "view-color", "exposure"), "off")
    settings = quick_settings(
        "global", lattice=1, iterations=30, effects={**choices, "tracking": "auto"}
    )
    settings = replace(settings, density_interval=10, density_span=(0.0, 1.0))
    return Run(capture.root, None, "vhap", *plan_effects(capture, settings))


def made():
    """An avatar with the toy's coefficients, and a posed mesh."""
    rng = np.random.default_rng(0)
    neutral = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0.3]]) / 10
    faces = np.int32([[0, 1, 2], [1, 3, 2]])
    values = {NAME: rng.normal(0, 0.05, (2, 3, 3)).astype(np.float32)}
    return Avatar(
        lattice_splats(neutral, faces, 1), "stga", neutral, faces, driven_offsets=values
    ), neutral * 1.3


def test_it_is_decided_trained_and_resumed_to_the_same_bits(capture, tmp_path):
    """Catches a parameter that the plan, training, density control, the checkpoint, the avatar file
    or a continuation loses, because one of them goes by names instead of the tables."""
    run = planned(capture)
    assert run.settings.driven_offsets == (NAME,)
    assert dict(describe_effects(run.effect_plan))["toy-growth"] == "on: the head grows [6 numbers]"
    train_run(capture, tmp_path / "whole", run)
    train_run(capture, tmp_path / "parts", run, report=stop_at(13))
    assert read_checkpoint(tmp_path / "parts").iteration == 13
    train_run(capture, tmp_path / "parts", run, resume=True)
    assert_same_run(tmp_path / "parts", tmp_path / "whole")
    whole = read_checkpoint(tmp_path / "whole").state
    avatar = read_avatar(tmp_path / "parts" / "avatar.npz")
    assert_array_equal(avatar.driven_offsets[NAME], whole.driven_offsets[NAME].average)
    assert np.abs(avatar.driven_offsets[NAME]).max() > 1e-4
    folder = tmp_path / "whole"
    continuation = Continuation(folder, file_digest(folder / "avatar.npz"), 0, 9)
    state = starting_state(continuation, run.settings, len(capture.faces))
    assert_array_equal(state.driven_offsets[NAME].second, whole.driven_offsets[NAME].second)


def test_a_device_without_its_kernels_says_so(capture):
    """Catches an effect that trains without its parameter on a GPU."""
    with refusal(f"driven offset {NAME}: is trained on the CPU only, not on gpu"):
        Trainer(
            capture, quick_settings("global", lattice=0, driven_offsets=(NAME,)), {}, device="gpu"
        )


@pytest.mark.parametrize(
    "format", [name for name, row in FORMATS.items() if row.source != "motion"]
)
def test_exports_hold_it_or_say_that_they_cannot(format, tmp_path):
    """Catches an export that shows the avatar without the effect."""
    if format == "usd":
        pytest.importorskip("pxr")
    avatar, posed = made()
    path = tmp_path / f"avatar{(FORMATS[format].suffixes or ('',))[0]}"
    if FORMATS[format].has_rig:
        with refusal(f"no driven offset {NAME}"):
            export_avatar(path, avatar, format, [(0, posed)])
        return
    files = export_avatar(path, avatar, format, [(0, posed)])
    moved = [file.read_bytes() for file in files]
    export_avatar(path, replace(avatar, driven_offsets={}), format, [(0, posed)])
    assert moved != [file.read_bytes() for file in files]


def test_it_moves_splats_as_its_file_says(tmp_path):
    """Catches an offset in other axes or units than the triangle's: against float64."""
    avatar, posed = made()
    [file] = export_avatar(tmp_path / "a.ply", avatar, "ply", [(0, posed)])
    frames = face_frames(posed, avatar.faces, avatar.neutral)
    assert_allclose(frames.scale, 1.3, rtol=1e-6)
    first, second, third = avatar.driven_offsets[NAME].swapaxes(0, 1)
    local = 0.3 * first + 0.09 * second + 0.027 * third
    moves = 1.3 * np.einsum("fij,fj->fi", frames.rotation, local.astype(np.float64))
    expected = to_world(avatar.splats, frames).xyz + moves[avatar.splats.face]
    assert_allclose(read_ply(file).xyz, expected, atol=1e-6)
    assert np.abs(moves).max() > 0.01


def test_blender_keeps_it():
    """Catches a parameter lost in a .blend file, which viewport and renders pose."""
    bpy = pytest.importorskip("bpy")
    from stga_addon.scene.arrays import triangle_mesh
    from stga_addon.scene.display.splat_object import show_avatar, stored_avatar

    avatar, posed = made()
    head = bpy.data.objects.new("head", triangle_mesh("head", avatar.neutral, avatar.faces))
    bpy.context.scene.collection.objects.link(head)
    stored = stored_avatar(show_avatar(avatar, head))
    assert_array_equal(stored.driven_offsets[NAME], avatar.driven_offsets[NAME])
    assert_allclose(stored.frames(posed).origin, avatar.frames(posed).origin, atol=1e-7)
