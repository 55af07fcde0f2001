"""The folder of the head that Blender has open: what is written is read back, and damage is one
sentence."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from capture.factory import edit, write_avatar_of, write_flame_capture, write_mesh_capture

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


NO_FACES = np.zeros(FACES, bool)
DAMAGES: list[tuple[str, dict[str, np.ndarray], str]] = [
    *((SELECTION, {name: NO_FACES}, "selection.npz: expected frames as names, got ")
      for name in ("smile", "1.5", "٣", "9" * 5000)),
    (SELECTION, {"1": np.zeros(FACES)}, r"frame 1: expected bool \(F,\), got float64 \(320,\)"),
    (SELECTION, {"1": np.zeros((FACES, 2), bool)}, r"expected bool \(F,\), got bool \(320, 2\)"),
    (PLAYED, {"mesh": np.zeros((VERTICES, 3))}, "played.npz: expected frames as names, got 'mesh'"),
    (PLAYED, {"4": np.zeros((7, 3))}, r"expected finite numbers \(162, 3\), got float64 \(7, 3\)"),
    (PLAYED, {"4": np.full((VERTICES, 3), np.nan)}, r"frame 4: expected finite numbers \(162, 3\)"),
    (PLAYED, {"4": np.full((VERTICES, 3), "a")}, r"expected finite numbers \(162, 3\), got <U1"),
    (PLAYED, {}, "played: holds no frame"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "arrays", "expected"), DAMAGES)
def test_damaged_files(folder: Path, name: str, arrays: Any, expected: str) -> None:
    """Catches a traceback for names that are no frames, and for arrays that are no selection or
    meshes of another head."""
    write_npz(folder / name, arrays)
    with pytest.raises(StgaError, match=expected):
        export_played(folder, read_head(folder).played())
    assert not (folder / "page.stga").exists()


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"selection": {4: np.zeros(7, bool)}}, r"expected bool \(320,\), got bool \(7,\)"),
        ({"selection": {4: np.zeros(FACES)}}, r"frame 4: expected bool \(320,\), got float64"),
        ({"motion": {"expr": np.zeros((2, 2))}}, "motion: expected 1 frames, got 2"),
        ({"motion": {"expr": np.zeros((1, 9))}}, r"played: expr has shape \(9,\), expected \(2,\)"),
        ({"motion": {"pose": np.zeros((1, 2))}}, r"played: pose has shape \(1, 2\)"),
    ],
)
def test_what_a_head_cannot_have_played(folder, changes, expected):
    """Catches a traceback for arrays of another head in a request, or a page whose parts are of
    different frames."""
    root, model = folder / "capture", None
    if "motion" in changes:
        root, model = write_flame_capture(folder / "flame")
    played = Played({4: open_capture(root, model).neutral}, **changes)
    with pytest.raises(StgaError, match=expected):
        export_played(folder, played, root, model)


def export_played(folder, played, root=None, model=None):
    """Export a page of an avatar that moves as `played`."""
    root = root or folder / "capture"
    capture = open_capture(root, model)
    avatar = write_avatar_of(capture, folder / "a.npz")
    perform(Export(avatar, folder / "page.stga", "web", root, model, played))


@pytest.mark.parametrize("fps", [float("inf"), float("nan"), 0, "25", None, 10**400])
def test_frame_rates_that_are_none(folder: Path, fps: object) -> None:
    """Catches a rate that is no positive number in exports and videos."""
    edit(folder / HEAD, lambda values: values.update(fps=fps))
    with pytest.raises(StgaError, match=r"head\.json: .*fps|head\.json: is not"):
        read_head(folder)
