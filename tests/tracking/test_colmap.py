"""COLMAP models, compared with pycolmap."""

import re

import numpy as np
import pytest
from refusal import refusal

from stga_addon.tracking.footage.colmap import LENSES, read_colmap
from stga_addon.tracking.footage.open import open_footage

from .scenes import HEIGHT, WIDTH, rewrite, rig, write_colmap_text, write_image

RANDOM = np.random.default_rng(3)
PARAMETERS = {"FOV": (0.7,), "DIVISION": (-0.1,), "SIMPLE_DIVISION": (-0.1,)}


def reconstruction():
    """One image for each camera model of `LENSES`, with random pose and points."""
    pycolmap = pytest.importorskip("pycolmap")
    found = pycolmap.Reconstruction()
    for number, (name, (_, _, count, _)) in enumerate(LENSES.items(), start=1):
        camera = pycolmap.Camera.create_from_model_name(number, name, 500.0, 640, 480)
        values = np.array(camera.params)
        values[len(values) - count :] = PARAMETERS.get(name, 0.05 * RANDOM.standard_normal(count))
        camera.params = values
        found.add_camera_with_trivial_rig(camera)
        pose = np.r_[RANDOM.standard_normal(4), RANDOM.standard_normal(3)]
        rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:4] / np.linalg.norm(pose[:4])), pose[4:])
        points = [pycolmap.Point2D(RANDOM.uniform(0, 400, 2)) for _ in range(number % 3)]
        named = {"name": f"cam {name}.jpg", "image_id": number, "camera_id": number}
        image = pycolmap.Image(**named, points2D=pycolmap.Point2DList(points))
        found.add_image_with_trivial_frame(image, rigid)
    return found


@pytest.mark.parametrize("kind", ["text", "binary"])
def test_projections_are_colmaps(tmp_path, kind):
    """Catches any model whose coefficients, pose or principal point are read as another's."""
    model = reconstruction()
    getattr(model, f"write_{kind}")(str(tmp_path))
    shots, _ = read_colmap(tmp_path)
    assert [shot.label for shot in shots] == sorted(f"cam {name}.jpg" for name in LENSES)
    local = np.c_[RANDOM.uniform(-0.5, 0.5, (20, 2)), np.ones(20)] * RANDOM.uniform(1, 3, (20, 1))
    images = sorted(model.images.values(), key=lambda image: image.name)
    for shot, image in zip(shots, images, strict=True):
        pose = image.cam_from_world().matrix()
        world = (local - pose[:, 3]) @ pose[:, :3]
        expected = image.camera.img_from_cam(local)
        camera = shot.camera
        seen = world @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        distorted = shot.lens.distort(seen[:, :2] / seen[:, 2:])
        found = distorted * [camera.fl_x, camera.fl_y] + [camera.cx, camera.cy]
        np.testing.assert_allclose(found, expected, atol=1e-6, err_msg=shot.label)


NO_IMAGE = "has no image, folder or video of the name"


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        (
            "cameras",
            f" {WIDTH} {HEIGHT} ",
            " 0 30 ",
            "'left.png': expected an image size in pixels",
        ),
        ("images", " 2 right.png", " 2 left.png", "image 'left.png': two cameras are named left"),
        ("images", " 1 left.png", " 1 gone.png", f"{NO_IMAGE} 'gone.png'"),
        ("images", " 1 left.png", f" 1 {'9' * 5000}.png", f"{NO_IMAGE} '999"),
        ("images", " 1 left.png", f" 1 {'a/' * 30000}.png", f"{NO_IMAGE} 'a/a/"),
    ],
)
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_models_that_do_not_fit_are_named(tmp_path, file, old, new, message):
    """Catches a traceback, or a message without file and field."""
    write_colmap_text(tmp_path / "sparse/0", rig(2), ["left.png", "right.png"])
    for name in ("left.png", "right.png"):
        write_image(tmp_path / name)
    rewrite(tmp_path / f"sparse/0/{file}.txt", (old, new))
    with refusal(message):
        open_footage(tmp_path)


@pytest.mark.parametrize("file", ["cameras.bin", "images.bin"])
def test_binary_files_cut_short(tmp_path, file):
    """Catches an error of the decoder, or a model that is silently read in part."""
    reconstruction().write_binary(str(tmp_path))
    data = (tmp_path / file).read_bytes()
    huge = data[:-8] + b"\xff" * 8  # the last number of points, where it is one
    cuts = [*(data[:length] for length in range(0, 60, 7)), data[:-9]]
    for cut in (*cuts, huge) if file == "images.bin" else cuts:
        (tmp_path / file).write_bytes(cut)
        with refusal(re.escape(f"{tmp_path / file}: ")):
            read_colmap(tmp_path)
