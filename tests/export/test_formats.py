"""Export by format: which files are written, from which meshes."""

import errno
import os
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from capture import factory
from refusal import refusal

from export.web.conftest import make_head
from stga_addon.avatar.embedding import to_world
from stga_addon.capture.open import open_capture
from stga_addon.errors import StgaError
from stga_addon.export.formats import FORMATS, export_avatar
from stga_addon.export.playback import DEFAULT_FPS, Playback, playback_fps
from stga_addon.export.ply import read_ply


def posed(avatar, *numbers):
    """Meshes that are shifted by their numbers."""
    return [(number, avatar.neutral + np.float32(number)) for number in numbers]


def is_posed(path, avatar, number):
    """Whether a PLY file holds the avatar on a mesh of `posed`."""
    ((_, mesh),) = posed(avatar, number)
    return np.allclose(read_ply(path).xyz, to_world(avatar.splats, avatar.frames(mesh)).xyz)


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_ply_is_the_first_mesh(avatar, tmp_path):
    """Catches splats of another mesh, and meshes posed for nothing."""
    meshes = iter(posed(avatar, 7, 8))
    assert export_avatar(tmp_path / "a.ply", avatar, "ply", meshes) == [tmp_path / "a.ply"]
    assert is_posed(tmp_path / "a.ply", avatar, 7)
    assert next(meshes)[0] == 8


def test_a_sequence_replaces_an_earlier_one(avatar, tmp_path):
    """Catches frames left out, of an earlier or a cancelled export, and others' files removed."""
    export_avatar(tmp_path, avatar, "ply-sequence", posed(avatar, -7, 0, 1, 2, 100000))
    others = {"notes.txt", "point_cloud.ply", "12.ply", ".stga_sequence"}
    for name in others:
        (tmp_path / name).touch()
    files = export_avatar(tmp_path, avatar, "ply-sequence", posed(avatar, 1, 12))
    assert [path.name for path in files] == ["00001.ply", "00012.ply"]
    assert is_posed(files[0], avatar, 1)
    assert is_posed(files[1], avatar, 12)
    assert set(contents(tmp_path)) == {"00001.ply", "00012.ply", *others}

    def meshes():
        yield from posed(avatar, 9)
        raise KeyboardInterrupt

    before = contents(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        export_avatar(tmp_path, avatar, "ply-sequence", meshes())
    assert contents(tmp_path) == before
    (tmp_path / "00002.ply").write_text("a scan of somebody else")
    before = contents(tmp_path)
    with refusal(r"holds 00002\.ply, which was not written here"):
        export_avatar(tmp_path, avatar, "ply-sequence", posed(avatar, 1))
    assert contents(tmp_path) == before


@pytest.mark.parametrize("ends", [OSError(errno.EACCES, "Permission denied"), SystemExit()])
def test_a_sequence_whose_third_rename_fails(avatar, tmp_path, monkeypatch, ends):
    """Catches frames of two exports in one folder, and a folder that refuses all later exports,
    also where the process ends between two renames."""
    frames = posed(avatar, 1, 2, 3, 4)
    export_avatar(tmp_path, avatar, "ply-sequence", frames[:2])
    before = contents(tmp_path)
    replace = os.replace

    def fails(source, target):
        if Path(target).name == "00003.ply":
            monkeypatch.setattr("os.replace", replace if isinstance(ends, OSError) else killed)
            raise ends
        replace(source, target)

    def killed(source, target):  # nothing is put back
        raise ends

    monkeypatch.setattr("os.replace", fails)
    moved = [(number, mesh + 5) for number, mesh in frames]
    with pytest.raises(StgaError if isinstance(ends, OSError) else SystemExit):
        export_avatar(tmp_path, avatar, "ply-sequence", moved)
    monkeypatch.undo()
    if isinstance(ends, OSError):
        assert contents(tmp_path) == before
    export_avatar(tmp_path, avatar, "ply-sequence", frames[:1])
    assert sorted(path.name for path in tmp_path.glob("*.ply")) == ["00001.ply"]
    assert is_posed(tmp_path / "00001.ply", avatar, 1)


@pytest.mark.parametrize("fps", [0.0, -25.0, 1e-9, 1e4, 1e300, float("inf"), float("nan")])
@pytest.mark.parametrize("format", [name for name, format in FORMATS.items() if format.has_rate])
def test_frame_rates_that_nothing_plays(format, fps, avatar, tmp_path):
    """Catches a file its viewers refuse, such as a page with damaged data."""
    path = tmp_path / f"a{FORMATS[format].suffixes[0]}"
    with refusal(r"frame rate \(--fps\) must be from 0\.01 to 1000"):
        export_avatar(path, avatar, format, [(0, avatar.neutral)], playback=Playback(fps=fps))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("format", FORMATS)
def test_a_missing_source_and_other_suffixes_are_refused(format, avatar, tmp_path):
    """Catches a format that writes nothing, or a traceback, without its input; binary glTF named as
    text, and names that no viewer opens."""
    suffixes = FORMATS[format].suffixes
    if format != "usd":  # which may not be installed
        with refusal(r"FLAME parameters|no posed mesh"):
            export_avatar(tmp_path / f"out{next(iter(suffixes), '')}", avatar, format)
    if suffixes:
        with refusal(r"a\.gltf: expected a name that ends in \."):
            export_avatar(tmp_path / "a.gltf", avatar, format, posed(avatar, 0))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("timesteps", "fps", "in_a_row", "at_their_numbers"),
    [
        (range(5), 60.0, 60.0, 60.0),
        (range(1, 30, 3), 60.0, 20.0, 60.0),
        ([0, 1, 2, 3, 9, 10, 11], 50.0, 50.0, 50.0),
        ([7], 60.0, 60.0, 60.0),
        (range(1, 30, 3), None, DEFAULT_FPS, DEFAULT_FPS),
    ],
)
def test_rate_of_a_capture(tmp_path, timesteps, fps, in_a_row, at_their_numbers):
    """Catches every third frame of a recording played too fast, or too slowly."""
    capture = open_capture(factory.write_mesh_capture(tmp_path / "ball"))
    capture = replace(capture, timesteps=tuple(timesteps), fps=fps)
    assert playback_fps(capture) == pytest.approx(in_a_row)
    assert playback_fps(capture, numbered=True) == pytest.approx(at_their_numbers)
    assert playback_fps(capture, 12.5) == playback_fps(None, 12.5, numbered=True) == 12.5
    assert np.isclose(playback_fps(None), DEFAULT_FPS)


@pytest.mark.parametrize(
    "name", [f"{k}{s}" for k, v in FORMATS.items() for s in v.suffixes or [""]]
)
@pytest.mark.parametrize("room", [0.0, 0.6, 0.99999])
def test_every_format_without_room(name, room, tmp_path):
    """Catches a message without file or cause, and leftovers of half an export."""
    resource = pytest.importorskip("resource")
    head = make_head()
    format, dot, suffix = name.partition(".")
    path = tmp_path / f"new/anna{dot}{suffix}"

    def export():
        meshes = enumerate(head.meshes)
        return export_avatar(path, head.avatar, format, meshes, head.sequence)

    largest = max(file.stat().st_size for file in export())
    shutil.rmtree(path.parent)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(room * largest), hard))
    try:
        with pytest.raises(StgaError) as caught:
            export()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert str(caught.value).startswith(str(path.parent))
    reason = errno.ENOSPC if suffix == "usdz" and room > 0.9 else errno.EFBIG  # as packed by USD
    assert f"cannot be written ({os.strerror(reason)})" in str(caught.value)
    assert list(tmp_path.iterdir()) == []
