"""The folder of the head that Blender has open: what is written is read back, and damage is one
sentence."""

from pathlib import Path

import numpy as np
import pytest
from capture.factory import edit, write_flame_capture, write_mesh_capture

from stga_addon.avatar.file import Avatar, write_avatar
from stga_addon.avatar.lattice import lattice_splats
from stga_addon.capture.open import open_capture
from stga_addon.errors import StgaError
from stga_addon.files import write_npz
from stga_addon.jobs.avatar_source import (
    HEAD,
    PLAYED,
    SELECTION,
    OpenHead,
    Played,
    read_head,
    write_head,
)
from stga_addon.jobs.export import Export
from stga_addon.jobs.perform import perform

FACES, VERTICES = 320, 162


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    root = write_mesh_capture(tmp_path / "capture")
    chosen = {-2: np.zeros(FACES, bool), 10: np.arange(FACES) < 40}

    played = Played({frame: open_capture(root).neutral + frame for frame in (-2, 10)})
    write_head(
        tmp_path,
        OpenHead(root, None, "opencv", None, 25.0, lambda: chosen, lambda: played),
        played=True,
    )
    return tmp_path


def test_a_head_is_read_back(folder: Path) -> None:
    """Catches frames of the scene, which may be negative, that lose their sign, order or meshes."""
    head, capture = read_head(folder), open_capture(folder / "capture")
    found, played = head.selection(), head.played()
    assert found is not None
    for selection in (found, played.selection or {}):
        assert {frame: int(faces.sum()) for frame, faces in selection.items()} == {-2: 0, 10: 40}
    assert sorted(played.meshes) == [-2, 10]
    assert np.array_equal(played.meshes[-2], capture.neutral - 2)


@pytest.mark.parametrize(
    ("name", "array", "expected"),
    [
        ("smile", np.zeros(FACES, bool), "selection.npz: expected frames as names, got 'smile'"),
        ("1.5", np.zeros(FACES, bool), "selection.npz: expected frames as names, got '1.5'"),
        ("٣", np.zeros(FACES, bool), "selection.npz: expected frames as names"),
        ("9" * 5000, np.zeros(FACES, bool), "selection.npz: expected frames as names"),
        (
            "1",
            np.zeros(FACES),
            r"selection.npz: frame 1: expected bool \(F,\), got float64 \(320,\)",
        ),
        (
            "1",
            np.zeros((FACES, 2), bool),
            r"selection.npz: frame 1: expected bool \(F,\), got bool \(320, 2\)",
        ),
    ],
)
def test_damaged_selections(folder: Path, name: str, array: np.ndarray, expected: str) -> None:
    """Catches a traceback for names that are no frames, and for arrays that are no selection."""
    write_npz(folder / SELECTION, {"0": np.zeros(FACES, bool), name: array})
    with pytest.raises(StgaError, match=expected):
        read_head(folder).selection()


@pytest.mark.parametrize(
    ("arrays", "expected"),
    [
        ({"mesh": np.zeros((VERTICES, 3))}, "played.npz: expected frames as names, got 'mesh'"),
        (
            {"4": np.zeros((7, 3))},
            r"played: frame 4: expected finite numbers \(162, 3\), got float64 \(7, 3\)",
        ),
        (
            {"4": np.full((VERTICES, 3), np.nan)},
            r"played: frame 4: expected finite numbers \(162, 3\)",
        ),
        (
            {"4": np.full((VERTICES, 3), "a")},
            r"played: frame 4: expected finite numbers \(162, 3\), got <U1",
        ),
        ({}, "played: holds no frame"),
    ],
)
def test_damaged_meshes(folder: Path, arrays: dict[str, np.ndarray], expected: str) -> None:
    """Catches a traceback, or meshes of another head, from a damaged file of what the head
    plays."""
    write_npz(folder / PLAYED, arrays)
    with pytest.raises(StgaError, match=expected):
        export_played(folder, read_head(folder).played())
    assert not (folder / "page.stga").exists()


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (
            {"selection": {4: np.zeros(7, bool)}},
            r"selection of frame 4: expected bool \(320,\), got bool \(7,\)",
        ),
        (
            {"selection": {4: np.zeros(FACES)}},
            r"selection of frame 4: expected bool \(320,\), got float64",
        ),
        ({"motion": {"expr": np.zeros((2, 2))}}, "motion: expected 1 frames, got 2"),
        ({"motion": {"expr": np.zeros((1, 9))}}, r"played: expr has shape \(9,\), expected \(2,\)"),
        ({"motion": {"pose": np.zeros((1, 2))}}, r"played: pose has shape \(1, 2\)"),
    ],
)
def test_what_a_head_cannot_have_played(folder, changes, expected):
    """Catches a traceback for arrays of another head in a request, or a page whose parts are of
    different frames."""
    root, model = write_flame_capture(folder / "flame")
    meshes = {4: open_capture(root, model).neutral}
    if "selection" in changes:
        root, model = folder / "capture", None
        meshes = {4: open_capture(root).neutral}
    with pytest.raises(StgaError, match=expected):
        export_played(folder, Played(meshes, **changes), root, model)


def export_played(folder, played, root=None, model=None):
    """Export a page of an avatar that moves as `played`."""
    root = root or folder / "capture"
    capture = open_capture(root, model)
    splats = lattice_splats(capture.neutral, capture.faces, order=0)
    write_avatar(
        folder / "a.npz", Avatar(splats, "stga", capture.neutral.astype(np.float32), capture.faces)
    )
    perform(Export(folder / "a.npz", folder / "page.stga", "web", root, model, played))


@pytest.mark.parametrize("fps", [float("inf"), float("nan"), 0, "25", None, 10**400])
def test_frame_rates_that_are_none(folder: Path, fps: object) -> None:
    """Catches a rate that is no positive number in exports and videos."""
    edit(folder / HEAD, lambda values: values.update(fps=fps))
    with pytest.raises(StgaError, match=r"head\.json: .*fps|head\.json: is not"):
        read_head(folder)
