"""The folder of the head that Blender has open: what is written is read back."""

import numpy as np
import pytest
from capture.factory import edit, write_avatar_of, write_flame_capture, write_mesh_capture
from refusal import refusal

from stga_addon.capture.open import open_capture
from stga_addon.files import read_npz, write_npz
from stga_addon.jobs.avatar_source import ARRAYS, HEAD, OpenHead, Played, read_head, write_head
from stga_addon.jobs.export import Export
from stga_addon.jobs.perform import perform

FACES = 320
VERTICES = 162


@pytest.fixture
def folder(tmp_path):
    root = write_mesh_capture(tmp_path / "capture")
    chosen = {-2: np.zeros(FACES, bool), 10: np.arange(FACES) < 40}
    meshes = {frame: open_capture(root).neutral + frame for frame in (-2, 10)}
    played = Played(meshes, selection=chosen)
    head = OpenHead(root, None, "opencv", None, 25.0, lambda: chosen, lambda: played)
    write_head(tmp_path, head, played=True)
    return tmp_path


def test_a_head_is_read_back(folder):
    """Catches frames of the scene, which may be negative, that lose their sign, order or meshes."""
    head = read_head(folder)
    capture = open_capture(folder / "capture")
    found = head.selection()
    played = head.played()
    for selection in (found or {}, played.selection or {}):
        assert {frame: int(faces.sum()) for frame, faces in selection.items()} == {-2: 0, 10: 40}
    assert sorted(played.meshes) == [-2, 10]
    assert np.array_equal(played.meshes[-2], capture.neutral - 2)


def test_damaged_folders(folder):
    """Catches a traceback for rates and names that are none, and for arrays that are gone."""
    for fps in (float("inf"), float("nan"), 0, "25", None, 10**400):
        edit(folder / HEAD, lambda values, fps=fps: values.update(fps=fps))
        with refusal(r"head\.json: .*fps|head\.json: is not"):
            read_head(folder)
    edit(folder / HEAD, lambda values: values.update(fps=25.0))
    write_npz(folder / ARRAYS, {**read_npz(folder / ARRAYS), "selection.10": np.zeros(FACES)})
    read_head(folder)
    for change in ({"selection": {"1.5": {"array": "selection.10"}}}, {"played": {"meshes": {}}}):
        edit(folder / HEAD, lambda values, change=change: values.update(change))
        with refusal(r"head\.json: is not the head of an open"):
            read_head(folder)
    (folder / ARRAYS).unlink()
    with refusal(r"head\.npz"):
        read_head(folder)


MESH = np.zeros((VERTICES, 3))
MOTION = r"played: (expr|pose) has shape"


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"meshes": {4: np.zeros((7, 3))}}, r"expected finite numbers \(162, 3\), got float64"),
        ({"meshes": {4: MESH * np.nan}}, r"frame 4: expected finite numbers \(162, 3\)"),
        ({"meshes": {4: np.full((VERTICES, 3), "a")}}, r"numbers \(162, 3\), got <U1"),
        ({"meshes": {}}, "played: holds no frame"),
        ({"selection": {4: np.zeros(7, bool)}}, r"expected bool \(320,\), got bool \(7,\)"),
        ({"selection": {4: np.zeros(FACES)}}, r"frame 4: expected bool \(320,\), got float64"),
        ({"motion": {"expr": np.zeros((2, 2))}}, "motion: expected 1 frames, got 2"),
        ({"motion": {"expr": np.zeros((1, 9))}}, rf"{MOTION} \(9,\), expected \(2,\)"),
        ({"motion": {"pose": np.zeros((1, 2))}}, rf"{MOTION} \(1, 2\)"),
    ],
)
def test_what_a_head_cannot_have_played(folder, changes, expected):
    """Catches a traceback for arrays of another head, or parts of different frames."""
    root = folder / "capture"
    model = None
    if "motion" in changes:
        root, model = write_flame_capture(folder / "flame")
    capture = open_capture(root, model)
    avatar = write_avatar_of(capture, folder / "a.npz")
    played = Played(**{"meshes": {4: capture.neutral}, **changes})
    with refusal(expected):
        perform(Export(avatar, folder / "page.glb", "web", root, model, played))
    assert not (folder / "page.glb").exists()
