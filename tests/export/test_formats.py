"""Export by format: which files are written, from which meshes."""

import numpy as np
import pytest

from stga_addon.avatar.embedding import to_world
from stga_addon.avatar.file import Avatar
from stga_addon.errors import StgaError
from stga_addon.export.formats import FORMATS, export_avatar
from stga_addon.export.ply import read_ply


def posed(avatar: Avatar, shift: float) -> np.ndarray:
    return np.asarray(avatar.neutral + np.float32(shift))


def test_ply_is_the_first_mesh(avatar, tmp_path):
    """Catches splats of another mesh in the file, and meshes that are posed although nothing is written of them."""
    taken = []

    def meshes():
        for number in (7, 8):
            taken.append(number)
            yield number, posed(avatar, number)

    assert export_avatar(tmp_path / "a.ply", avatar, "ply", meshes()) == [tmp_path / "a.ply"]
    expected = to_world(avatar.splats, avatar.frames(posed(avatar, 7)))
    assert np.allclose(read_ply(tmp_path / "a.ply").xyz, expected.xyz)
    assert taken == [7]


def test_sequence_is_named_by_number(avatar, tmp_path):
    """Catches frames that are left out, overwritten, or named after their place instead of their timestep."""
    numbered = [(3, posed(avatar, 3)), (12, posed(avatar, 12))]
    files = export_avatar(tmp_path, avatar, "ply-sequence", numbered)
    assert [path.name for path in files] == ["00003.ply", "00012.ply"]
    for path, (_, mesh) in zip(files, numbered, strict=True):
        assert np.allclose(read_ply(path).xyz, to_world(avatar.splats, avatar.frames(mesh)).xyz)


@pytest.mark.parametrize("format", ["ply", "ply-sequence", "gaussian-avatars"])
def test_missing_source(format, avatar, tmp_path):
    """Catches a format that writes nothing, or fails with a traceback, where its meshes or parameters are missing."""
    with pytest.raises(StgaError, match=r"FLAME parameters|no posed mesh"):
        export_avatar(tmp_path / f"out{next(iter(FORMATS[format].suffixes), '')}", avatar, format)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("format", [name for name, format in FORMATS.items() if format.suffixes])
def test_other_suffixes_are_refused(format, avatar, tmp_path):
    """Catches binary glTF under the name of its text form, and a file under a name that no viewer opens."""
    with pytest.raises(StgaError, match=r"a\.gltf: expected a name that ends in \."):
        export_avatar(tmp_path / "a.gltf", avatar, format, [(0, avatar.neutral)])
    assert list(tmp_path.iterdir()) == []
