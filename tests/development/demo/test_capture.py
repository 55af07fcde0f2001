"""Synthetic capture: Blender's pictures against the geometry and cameras in the files."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from stga_addon.capture.camera import camera_from_gl
from stga_addon.development.demo.capture import CaptureOptions, make_capture
from stga_addon.errors import StgaError
from stga_addon.flame.model import read_flame
from stga_addon.flame.sequence import FlameSequence, read_frame, read_identity, sequence_mesh

bpy = pytest.importorskip("bpy", reason="bpy is not installed")

TINY = CaptureOptions(train=2, test=1, cameras=3, width=72, height=96, samples=1)


KINDS = ("scenes", "objects", "meshes", "materials", "worlds", "lights", "cameras")


def _counts() -> dict[str, int]:
    return {kind: len(getattr(bpy.data, kind)) for kind in KINDS}


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("demo") / "capture"
    before, seen = _counts(), []
    assert make_capture(folder, 4, TINY, lambda done, total: seen.append((done, total))) == folder / "flame_model.npz"
    # Catches a studio that stays behind in the person's file.
    assert _counts() == before
    assert seen == [(done, 9) for done in range(1, 10)]
    return folder


def _entries(folder: Path, split: str) -> list[dict[str, Any]]:
    return json.loads((folder / f"transforms_{split}.json").read_text())["frames"]


def _sequence(folder: Path) -> FlameSequence:
    model = read_flame(folder / "flame_model.npz")
    shape, offset = read_identity(folder / "flame_param" / "00000.npz", model)
    return FlameSequence(
        model, shape, offset, (0, 1, 2), lambda t: read_frame(folder / "flame_param" / f"{t:05d}.npz", model)
    )


def test_layout(capture: Path) -> None:
    # Catches a missing file, a split that leaks, or a picture that is not what its entry says.
    splits = {split: _entries(capture, split) for split in ("train", "val", "test")}
    held = {(e["timestep_index"], e["camera_index"]) for e in splits["val"]}
    assert held == {(0, 1), (1, 1)}
    assert {(e["timestep_index"], e["camera_index"]) for e in splits["test"]} == {(2, 0), (2, 1), (2, 2)}
    assert {(e["timestep_index"], e["camera_index"]) for e in splits["train"]} == {(0, 0), (0, 2), (1, 0), (1, 2)}
    for entry in json.loads((capture / "transforms.json").read_text())["frames"]:
        with Image.open(capture / entry["file_path"]) as image:
            assert (image.size, image.mode) == ((72, 96), "RGB")
            white = np.asarray(image)[0, 0]
        with Image.open(capture / entry["fg_mask_path"]) as mask:
            assert (mask.size, mask.mode) == ((72, 96), "L")
        assert white.tolist() == [255, 255, 255]
        assert (capture / entry["flame_param_path"]).is_file()
    assert (capture / "canonical_flame_param.npz").is_file()
    assert not list(capture.rglob("*.partial"))


def test_pictures_show_the_mesh_where_the_cameras_say(capture: Path) -> None:
    # Catches a wrong camera convention (axes, principal point, `cy` from the bottom, focal length) or parameters that
    # belong to another timestep: the silhouette's box must match the projected mesh's within a pixel or two.
    sequence = _sequence(capture)
    for entry in json.loads((capture / "transforms.json").read_text())["frames"]:
        vertices = sequence_mesh(sequence, entry["timestep_index"])
        local = np.linalg.inv(np.array(entry["transform_matrix"])) @ np.c_[vertices, np.ones(len(vertices))].T
        across = entry["fl_x"] * local[0] / -local[2] + entry["cx"]
        down = entry["h"] - (entry["fl_y"] * local[1] / -local[2] + entry["cy"])
        mask = np.asarray(Image.open(capture / entry["fg_mask_path"])) > 127
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        seen = np.array([columns[0], rows[0], columns[-1] + 1, rows[-1] + 1])
        expected = np.array([across.min(), down.min(), across.max(), down.max()])
        assert abs(seen - expected).max() < 1.3
    # The off-centre principal point is what makes this a test of its convention.
    assert abs(2 * entry["cy"] - entry["h"]) > 2.6
    assert abs(2 * entry["cx"] - entry["w"]) > 2.6


def test_the_head_is_a_face_not_a_shade(capture: Path) -> None:
    # Catches black renders, lost colors and missing texture.
    image = np.asarray(Image.open(capture / "images/00000_01.png")).astype(float)
    mask = np.asarray(Image.open(capture / "fg_masks/00000_01.png")) > 250
    assert 0.2 < mask.mean() < 0.6
    skin = image[mask]
    assert skin.std(0).min() > 20
    assert (skin[:, 0] - skin[:, 2]).mean() > 10
    assert (image[np.asarray(Image.open(capture / "fg_masks/00000_01.png")) == 0] == 255).all()


def test_parameters_depend_on_the_seed_only(capture: Path, tmp_path: Path) -> None:
    # Catches a capture that cannot be made again.
    make_capture(tmp_path / "again", 4, CaptureOptions(2, 1, 3, width=16, height=16, samples=1))
    for path in sorted((capture / "flame_param").iterdir()):
        with np.load(path) as first, np.load(tmp_path / "again" / "flame_param" / path.name) as second:
            for name in first.files:
                np.testing.assert_array_equal(first[name], second[name])


def test_blender_camera_projects_like_ours() -> None:
    # Catches a wrong sign of the lens shift or a focal length on the wrong axis, in Blender's own projection.
    from bpy_extras.object_utils import world_to_camera_view
    from mathutils import Vector

    from stga_addon.development.demo.studio import place_camera

    rng = np.random.default_rng(0)
    scene = bpy.data.scenes.new("test")
    camera = bpy.data.objects.new("test", bpy.data.cameras.new("test"))
    scene.collection.objects.link(camera)
    for width, height in ((120, 200), (200, 120)):
        pose = np.eye(4)
        pose[:3, :3], _ = np.linalg.qr(rng.normal(size=(3, 3)))
        pose[:3, :3] *= np.sign(np.linalg.det(pose[:3, :3]))
        pose[:3, 3] = rng.normal(size=3)
        view = camera_from_gl(pose, width, height, 310.0, 310.0, 0.42 * width, 0.57 * height)
        place_camera(scene, camera, view)
        scene.view_layers[0].update()
        for point in (pose @ [0.1, -0.07, -1.3, 1])[None, :3], (pose @ [-0.2, 0.05, -0.9, 1])[None, :3]:
            x, y, z = view.world_to_camera[:3] @ [*point[0], 1]
            expected = np.array([view.fl_x * x / z + view.cx, view.fl_y * y / z + view.cy])
            seen = world_to_camera_view(scene, camera, Vector(point[0]))
            np.testing.assert_allclose([seen.x * width, (1 - seen.y) * height], expected, atol=2e-3)
    bpy.data.scenes.remove(scene)
    bpy.data.cameras.remove(camera.data)


def test_impossible_sizes(tmp_path: Path) -> None:
    with pytest.raises(StgaError, match="too small"):
        make_capture(tmp_path / "none", 0, CaptureOptions(cameras=1))
    assert not (tmp_path / "none").exists()
