"""Regions by name and from files."""

import json
from pathlib import Path

import numpy as np
import pytest

from stga_addon.capture.meshes import find_region
from stga_addon.capture.model import Capture
from stga_addon.errors import StgaError
from stga_addon.files import write_npz


def test_names_and_files(toy: Capture, tmp_path: Path) -> None:
    """Catches a region of other triangles than those painted."""
    np.testing.assert_array_equal(find_region(toy, "mouth"), toy.regions["mouth"])
    weights = np.linspace(0, 1, len(toy.faces))
    write_npz(tmp_path / "painted.npz", {"weights": weights})
    np.testing.assert_array_equal(find_region(toy, str(tmp_path / "painted.npz")), weights >= 0.5)
    triangle = toy.faces[7]
    (tmp_path / "regions.json").write_text(json.dumps({"one": triangle.tolist()}))
    found = find_region(toy, str(tmp_path / "regions.json"))
    assert found[7]
    np.testing.assert_array_equal(found, np.isin(toy.faces, triangle).all(1))


@pytest.mark.parametrize(
    ("weights", "sentence"),
    [
        (np.ones(3, np.float32), r"expected 'weights', one number from 0 to 1 per triangle .* found float32 \(3,\)"),
        (np.ones(3, np.int64), "found int64"),
        (None, "found no such array"),
    ],
)
def test_files_that_do_not_fit(toy: Capture, tmp_path: Path, weights: np.ndarray | None, sentence: str) -> None:
    """Catches weights of another mesh taken for this one's."""
    path = tmp_path / "painted.npz"
    np.savez(path, **({"other": np.ones(2)} if weights is None else {"weights": weights}))
    with pytest.raises(StgaError, match=sentence):
        find_region(toy, str(path))


def test_an_empty_region_is_refused(toy: Capture, tmp_path: Path) -> None:
    """Catches a refinement that would train nothing and say so nowhere."""
    write_npz(tmp_path / "nothing.npz", {"weights": np.zeros(len(toy.faces))})
    with pytest.raises(StgaError, match="holds no triangle"):
        find_region(toy, str(tmp_path / "nothing.npz"))
