"""USD: read back by USD, checked by its validators and more, rendered equal."""

import os
import sys
from dataclasses import replace

import numpy as np
import pytest
from avatar.conftest import rendered, world_splats
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from pxr import Usd, UsdGeom, UsdValidation, UsdVol
from refusal import refusal

from stga_addon.avatar.embedding import to_world
from stga_addon.export import usd
from stga_addon.export.formats import FORMATS, Content, export_avatar, write_content
from stga_addon.export.playback import Playback
from stga_addon.progress import Cancelled

PLAYBACK = Playback(fps=30.0)


def moved(avatar, frames=(3, 4, 7)):
    rng = default_rng(2)
    for frame in frames:
        yield frame, avatar.neutral + rng.normal(0, 0.01, avatar.neutral.shape)


def colored(avatar):
    rng = default_rng(3)
    shape = (len(avatar.faces), 3, 3)
    driven = {
        name: rng.normal(0, 0.1, shape).astype(np.float32)
        for name in ("strain_color", "normal_color")
    }
    return replace(avatar, driven_offsets=driven)


def splats_at(stage, time):
    """What USD's own class of the prim says, as splats; raises where array lengths differ."""
    field = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/Avatar/Splats"))
    assert field
    xyz = np.array(field.GetPositionsAttr().Get(time))
    count = len(xyz)
    degree = field.GetRadianceSphericalHarmonicsDegreeAttr().Get()
    sh = field.GetRadianceSphericalHarmonicsCoefficientsAttr().Get(time)
    sh = sh or field.GetRadianceSphericalHarmonicsCoefficientshAttr().Get(time)
    rotation = [(q.GetReal(), *q.GetImaginary()) for q in field.GetOrientationsAttr().Get(time)]
    opacity = np.array(field.GetOpacitiesAttr().Get(time), np.float64)
    log_scale = np.log(np.array(field.GetScalesAttr().Get(time)))
    sh = np.array(sh)
    return world_splats(xyz, rotation, log_scale, opacity, sh.reshape(count, (degree + 1) ** 2, 3))


@pytest.mark.parametrize("color", ["constant", "driven"])
@pytest.mark.parametrize("suffix", [".usdc", ".usdz"])
def test_reads_back_and_renders_equal(avatar, tmp_path, suffix, color):
    """Catches wrong quaternion or coefficient order, activations, frames, no driven color."""
    path = tmp_path / f"a{suffix}"
    stage_of = avatar if color == "constant" else colored(avatar)
    assert export_avatar(path, stage_of, "usd", moved(avatar), playback=PLAYBACK) == [path]
    stage = Usd.Stage.Open(str(path))
    times = stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()
    assert times == (3, 7, 30.0)
    pictures = []
    for frame, mesh in moved(avatar):
        expected = to_world(stage_of.splats, stage_of.frames(mesh))
        found = splats_at(stage, frame)
        assert_array_equal(found.xyz, expected.xyz)
        assert_allclose(np.linalg.norm(found.rotation, axis=1), 1, atol=1e-6)
        pictures.append(rendered(found))
        assert np.abs(pictures[-1] - rendered(expected)).max() < 1e-3
    assert np.abs(pictures[0] - pictures[1]).max() > 0.05
    assert [path.name for path in tmp_path.iterdir()] == [path.name]


def test_valid(avatar, tmp_path):
    """Catches what validators find, and units, axis, hints and extents they do not."""
    path = tmp_path / "a.usdz"
    export_avatar(path, avatar, "usd", moved(avatar), playback=PLAYBACK)
    stage = Usd.Stage.Open(str(path))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert validators
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    assert [error.GetMessage() for error in errors] == []
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1)
    assert str(stage.GetDefaultPrim().GetPath()) == "/Avatar"
    prim = stage.GetPrimAtPath("/Avatar/Splats")
    assert prim.GetAttribute("projectionModeHint").Get() == "perspective"
    assert prim.GetAttribute("sortingModeHint").Get() == "zDepth"
    for frame, mesh in moved(avatar):
        world = to_world(avatar.splats, avatar.frames(mesh))
        low, high = np.array(prim.GetAttribute("extent").Get(frame))
        reach = 3 * np.exp(world.log_scale).max(axis=1, keepdims=True)
        assert (low <= world.xyz - reach + 1e-6).all()
        assert (high >= world.xyz + reach - 1e-6).all()
    authored = {attribute.GetName() for attribute in prim.GetAuthoredAttributes()}
    assert authored <= set(prim.GetPrimDefinition().GetPropertyNames())


def test_size_is_known_before(avatar, tmp_path):
    """Catches an estimate that would let a range fill the disk."""
    many = default_rng(0).integers(0, len(avatar.splats), 5000)
    avatar = replace(avatar, splats=avatar.splats.rows(many))
    for item in (avatar, colored(avatar)):
        export_avatar(tmp_path / "a.usdc", item, "usd", moved(item, (0, 1, 2, 3)))
        size = (tmp_path / "a.usdc").stat().st_size
        assert FORMATS["usd"].size(Content(item), 4) == pytest.approx(size, rel=0.02)


@pytest.fixture
def without_usd(monkeypatch):
    """This interpreter lacks USD."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "pxr"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "pxr", None)


def interpreter(path, line):
    path.write_text(f"#!/bin/sh\n{line}\n")
    path.chmod(0o755)
    return str(path)


@pytest.mark.parametrize("suffix", [".usdc", ".usdz"])
def test_another_interpreter_writes_the_same(avatar, tmp_path, monkeypatch, suffix):
    """Catches frames, rates or colors that are lost on the way to the Python that has USD, and
    files that are left beside it."""
    content = Content(colored(avatar), list(moved(avatar)), playback=PLAYBACK)
    here = tmp_path / f"here/a{suffix}"
    there = tmp_path / f"there/a{suffix}"
    write_content(here, "usd", content)
    monkeypatch.setattr(usd, "find_usd", lambda: None)
    write_content(there, "usd", replace(content, python=sys.executable))
    written, expected = (Usd.Stage.Open(str(file)).ExportToString(False) for file in (there, here))
    assert written == expected
    assert [path.name for path in there.parent.iterdir()] == [there.name]


def test_without_usd_the_package_is_named(avatar, tmp_path, without_usd):
    """Catches tracebacks, endless waits and half files without USD, here and in the other Python,
    and for a path that USD cannot hold."""
    path = tmp_path / "out/a.usdz"
    (tmp_path / "none").mkdir()
    (tmp_path / "none/pxr.py").write_text("raise ImportError")
    run = f'exec {sys.executable} "$@"'
    lacking = f"PYTHONPATH={tmp_path / 'none'}:$PYTHONPATH {run}"

    def interrupted():
        yield from moved(avatar)
        raise Cancelled

    content = Content(avatar, moved(avatar), playback=PLAYBACK)
    for name, line, sentence in (
        ("", "", r"a\.usdz: USD files need the package usd-core, which .* lacks"),
        ("lacking", lacking, "usd-core, which neither .* nor .*lacking has; install it in"),
        ("ends", "exit 3", "ends: exited unexpectedly while it wrote a USD file"),
    ):
        python = name and interpreter(tmp_path / name, line)
        with refusal(sentence):
            write_content(path, "usd", replace(content, python=python))
    with refusal(r"usable path .*not UTF-8; rename it"):
        write_content(tmp_path / os.fsdecode(b"out/caf\xe9.usdz"), "usd", content)
    there = interpreter(tmp_path / "there", run)
    with pytest.raises(Cancelled):
        write_content(path, "usd", replace(content, meshes=interrupted(), python=there))
    assert not path.parent.exists()
