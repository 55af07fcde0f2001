"""Captures with absurd values: refused in one sentence that names file and field, without warnings
of NumPy."""

from pathlib import Path

import numpy as np
import pytest

from stga_addon.capture.open import open_capture
from stga_addon.errors import StgaError
from stga_addon.training.effects.samples import take_samples

from . import factory


def change_frames(root: Path, change) -> None:
    """Change every frame of every split in place."""
    for split in factory.SPLITS:
        path = root / f"transforms_{split}.json"
        factory.edit(path, lambda document: [change(frame) for frame in document["frames"]])


@pytest.mark.parametrize("name", ["neutral", "00001"])
def test_mesh_collapsed_to_a_point(tmp_path, name):
    """Catches a mesh without extent that ends in a LinAlgError where head motion is removed."""
    root = factory.write_mesh_capture(tmp_path / "capture")
    vertices, faces = factory.ball()
    factory.write_mesh(root / f"meshes/{name}.obj", np.full_like(vertices, 0.1), faces)
    with pytest.raises(StgaError, match=rf"{name}\.obj: all vertices of the mesh lie in one point"):
        open_capture(root).expression_mesh(1, "head")


@pytest.mark.parametrize(("field", "value", "expected"), [
    ("translation", 9e5, "timestep 1: the mesh reaches farther than"),
    ("expr", 1e300, r"00001\.npz: expr holds values"),
])  # fmt: skip
def test_flame_mesh_out_of_reach(tmp_path, field, value, expected):
    """Catches FLAME parameters with which vertices overflow."""
    root, model = factory.write_flame_capture(tmp_path / "capture")
    parameters = factory.flame_parameters(1)
    parameters[field] = np.full(parameters[field].shape, value)
    np.savez(root / "flame_param/00001.npz", **parameters)
    with pytest.raises(StgaError, match=expected):
        open_capture(root, model).mesh(1)


@pytest.mark.parametrize("folder", ["a" * 5000, "a/" * 3000, "nul\0"])
def test_impossible_capture_folder(folder):
    """Catches an OSError or ValueError for a folder whose name cannot exist."""
    with pytest.raises(StgaError, match="is not a folder"):
        open_capture(Path(folder))


@pytest.mark.parametrize("distance", [0.0, 1e-9, 0.02, 0.1, -1.0])
@pytest.mark.filterwarnings("error")
def test_camera_inside_the_head(tmp_path, distance):
    """Catches divisions by a depth or distance of zero for a camera in the head, or with the head
    behind it."""
    root = factory.write_mesh_capture(tmp_path / "capture")

    def change(frame):
        pose = np.array(frame["transform_matrix"])
        pose[:3, 3] *= distance
        frame["transform_matrix"] = pose.tolist()

    change_frames(root, change)
    samples = take_samples(open_capture(root))
    assert np.isfinite(samples.direction).all()
    assert np.isnan(samples.pixel_width).all() or distance > 0


@pytest.mark.parametrize("value", [0, -25, 1000, float("inf"), float("nan"), True, "60", [60]])
def test_impossible_frame_rate(tmp_path, value):
    """Catches a rate at which nothing plays, which fails as late as in an export."""
    root = factory.write_mesh_capture(tmp_path / "capture")
    factory.edit(root / "transforms_val.json", lambda document: document.update(fps=value))
    expected = r"transforms_val\.json: (fps: expected a finite number|is not valid JSON)"
    with pytest.raises(StgaError, match=expected):
        open_capture(root)
