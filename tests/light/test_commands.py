"""The commands: a run's avatar learns its light, is rendered under others, and exported without."""

import os
import shutil
from dataclasses import replace

import numpy as np
import pytest
from capture import factory
from command_line import refused, stga
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from refusal import refusal

from stga_addon.avatar.file import read_avatar, write_avatar
from stga_addon.capture.color import srgb_to_linear
from stga_addon.capture.open import open_capture
from stga_addon.errors import StgaError
from stga_addon.export.ply import read_ply
from stga_addon.jobs import train as train_job
from stga_addon.jobs.finished_run import add_light
from stga_addon.light.estimate import estimate_light
from stga_addon.light.relight import Relighter, albedo_avatar
from stga_addon.training.run.folder import locked

LIGHTS = """
world = [0.3, 0.3, 0.3]
[[lights]]
kind = "sun"
strength = 4
direction = [-1, 0, -0.5]
"""


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return factory.write_mesh_capture(tmp_path_factory.mktemp("light") / "ball", (0, 1), range(4))


@pytest.fixture(scope="module")
def run(root, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "run"
    assert stga("train", root, "--out", out, "--iterations 10 --schedule paper") == 0
    return out


def rendered(run, root, out, *options):
    cameras = root / "transforms_val.json"
    assert stga("render", run, "--cameras", cameras, "--out", out, *options) == 0
    with Image.open(sorted(out.iterdir())[0]) as image:
        return np.asarray(image).astype(int)


def test_a_run_ends_with_its_light(run, capsys, root, tmp_path):
    """Catches a training whose avatar has no light, or has it against one's will, and a file
    that grows by much."""
    avatar = read_avatar(run / "avatar.npz")
    assert avatar.light.transfer.shape == (len(avatar.neutral), 9)
    without = run.parent / "without.npz"
    write_avatar(without, replace(avatar, light=None))
    grown = (run / "avatar.npz").stat().st_size - without.stat().st_size
    assert grown < 30 * len(avatar.neutral) + 2500
    assert stga("info", run) == 0
    assert "recorded colors differ" in capsys.readouterr().out
    assert stga("info", without) == 0
    assert "stga relight" in capsys.readouterr().out
    assert stga("info", root, "--effect relight=off") == 0
    assert "lights of a scene" in capsys.readouterr().out
    words = "--iterations 2 --effect relight=off"
    assert stga("train", root, "--out", tmp_path / "run", words) == 0
    assert read_avatar(tmp_path / "run/avatar.npz").light is None


@pytest.mark.parametrize("error", [MemoryError(), StgaError("no light")])
def test_a_training_is_whole_without_what_follows_it(error, root, tmp_path, monkeypatch, capsys):
    """Catches a run of an hour that ends with a traceback because its light could not be found."""

    def fail(*_):
        raise error

    for name in ("light.estimate.estimate_light", "training.world.world_of"):
        monkeypatch.setattr(f"stga_addon.{name}", fail)
    monkeypatch.setattr(train_job, "WORLD", "relight")  # an effect that is on
    assert stga("train", root, "--out", tmp_path / "run", "--iterations 2") == 0
    why = str(error) or "not enough memory"
    said = capsys.readouterr().out
    assert f"light: not estimated ({why})" in said
    assert f"world: not made ({why})" in said


def test_a_gray_card_sets_the_level_and_a_running_trainings_avatar_is_kept(
    run, root, tmp_path, monkeypatch, capsys
):
    """Catches a card that is ignored, a light in an older avatar than a training's, and a traceback
    for a capture without views."""
    copy = tmp_path / "run"
    shutil.copytree(run, copy)
    before = (copy / "avatar.npz").read_bytes()
    with locked(copy):  # as a training has it
        assert stga("relight", copy) == 2
    problem = f"another run is working in this folder (process {os.getpid()})"
    assert problem in capsys.readouterr().err
    assert (copy / "avatar.npz").read_bytes() == before

    def estimate(*given):
        with refusal("another run is working"), locked(copy):
            pytest.fail("a training could begin between reading and writing")
        return estimate_light(*given)

    monkeypatch.setattr("stga_addon.light.estimate.estimate_light", estimate)
    without_views = replace(open_capture(root), views={})
    with refusal("has no training views"):
        add_light(copy / "avatar.npz", without_views)
    found = []
    for level in (0.5, 0.25):
        value = str(1.055 * level ** (1 / 2.4) - 0.055)
        assert stga("relight", copy, "--gray-card", f"{value},{value},{value}") == 0
        light = read_avatar(copy / "avatar.npz").light
        assert light.source == "gray_card"
        found.append(light.irradiance.mean(0))
    # the ball of this capture has no red
    assert_allclose(found[0][1:], 2 * found[1][1:], rtol=2e-3)


def test_cameras_are_compared_as_one(run, root, tmp_path):
    """Catches a light estimated without the exposure correction of the avatar's colors."""
    gain = np.array([0.7, 0.8, 0.6])
    offset = np.array([12.0, 5.0, 8.0])
    shutil.copytree(root, tmp_path / "capture")
    for path in (tmp_path / "capture/images").glob("*_02.png"):
        with Image.open(path) as image:
            levels = np.asarray(image)
        Image.fromarray(np.round(gain * levels + offset).astype(np.uint8)).save(path)
    shutil.copytree(run, tmp_path / "run")
    avatar_file = tmp_path / "run/avatar.npz"
    avatar = read_avatar(avatar_file)
    settings = {**avatar.settings, "exposure": [[2.0, *gain, *offset]]}
    write_avatar(avatar_file, replace(avatar, settings=settings))
    add_light(avatar_file, open_capture(tmp_path / "capture"))
    light = read_avatar(avatar_file).light
    # images are rounded to levels
    assert_allclose(light.irradiance, avatar.light.irradiance, rtol=0.05)


def test_render_under_lights(run, root, tmp_path, capsys):
    """Catches lights that do not reach the picture or turn sides, pixels changed without any,
    and a traceback or silence for what has no effect."""
    lights = tmp_path / "lights.toml"
    lights.write_text(LIGHTS)
    plain = rendered(run, root, tmp_path / "plain")
    stripped = tmp_path / "stripped"
    shutil.copytree(run, stripped)
    write_avatar(stripped / "avatar.npz", replace(read_avatar(run / "avatar.npz"), light=None))
    assert_array_equal(rendered(stripped, root, tmp_path / "same"), plain)
    right = rendered(run, root, tmp_path / "right", "--light", str(lights))
    assert np.abs(right - plain).max() > 20
    lights.write_text(LIGHTS.replace("[-1, 0, -0.5]", "[1, 0, -0.5]"))
    left = rendered(run, root, tmp_path / "left", "--light", str(lights))
    brighter = (right - left)[20:40].sum((0, 2))  # rows of the ball
    assert brighter[: len(brighter) // 2 - 5].sum() < 0 < brighter[len(brighter) // 2 + 5 :].sum()
    cameras = f"--cameras {root}/transforms_val.json --out {tmp_path}/p"
    for source, light, message in (
        (f"{stripped}/avatar.npz --capture {root}", f"--light {lights}", "stga relight RUN"),
        (f"{run}", "--light-turn 90", "--light-turn: has no effect"),
        (f"{run}", f"--light {tmp_path}/none.hdr", "none.hdr"),
    ):
        assert message in refused(capsys, "render", source, cameras, light)


def test_albedo_as_ply(run, tmp_path):
    """Catches an export that keeps the recorded light, or loses splats."""
    out = tmp_path / "albedo.ply"
    assert stga("export", run, "--format ply --albedo --out", out) == 0
    avatar = read_avatar(run / "avatar.npz")
    splats = read_ply(out)
    assert not splats.sh[:, 1:].any()
    shown = srgb_to_linear(np.maximum(0.5 + 0.28209479 * splats.sh[:, 0], 0))
    assert_allclose(shown, np.clip(Relighter(avatar).albedo, 0, 1), atol=2e-3)
    assert albedo_avatar(avatar).light is None
