"""COLMAP itself run on rendered images of a distorted lens."""

import numpy as np
import pytest
from PIL import Image

from stga_addon.capture.camera import look_at
from stga_addon.tracking.footage.open import open_footage
from stga_addon.tracking.footage.shots import Lens

WIDTH, HEIGHT, FOCAL = 480, 360, 420.0
LENS = Lens(radial=(-0.22,))
TEXELS = 1024


def textures():
    """Noise of all scales for each of three walls."""
    import cv2

    random, walls = np.random.default_rng(1), []
    for _ in range(3):
        noise = [random.normal(size=(n, n)) for n in (8, 32, 128, 512)]
        total = sum(cv2.resize(layer, (TEXELS, TEXELS)) for layer in noise)
        walls.append(((total - total.min()) / np.ptp(total) * 255).astype(np.float32))
    return walls


def rendered(camera, rays, walls):
    """Gray image (H, W) of a room's corner (x = -1, y = -1, z = -1), seen along rays (H, W, 2), (x,
    y) / depth."""
    import cv2

    directions = np.concatenate([rays, np.ones((*rays.shape[:2], 1))], axis=-1)
    directions = directions @ camera.world_to_camera[:3, :3]
    with np.errstate(divide="ignore"):
        reach = (-1 - camera.position) / directions
    reach[reach <= 0] = np.inf
    nearest = reach.argmin(axis=-1)
    points = camera.position + directions * reach.min(axis=-1)[..., None]
    image = np.zeros(rays.shape[:2], np.float32)
    for wall, texture in enumerate(walls):
        texels = (np.delete(points, wall, axis=-1) + 1.0) / 3 * TEXELS
        u, v = np.moveaxis(texels, -1, 0).astype(np.float32)
        image = np.where(nearest == wall, cv2.remap(texture, u, v, cv2.INTER_LINEAR), image)
    return image


def pixel_rays(camera):
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    return np.stack([(x - camera.cx) / camera.fl_x, (y - camera.cy) / camera.fl_y], axis=-1)


def ideal_rays(camera):
    """Rays of the recorded pixels: `LENS` inverted by iteration."""
    recorded = pixel_rays(camera)
    rays = recorded.copy()
    for _ in range(30):
        rays += recorded - LENS.distort(rays)
    return rays


def similarity(source, target):
    """Scale, rotation and translation that take points (N, 3) to others, by Umeyama's method."""
    middle_s, middle_t = source.mean(axis=0), target.mean(axis=0)
    u, s, vt = np.linalg.svd((target - middle_t).T @ (source - middle_s))
    sign = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ sign @ vt
    scale = np.trace(np.diag(s) @ sign) / ((source - middle_s) ** 2).sum()
    return scale, rotation, middle_t - scale * rotation @ middle_s


@pytest.mark.slow
def test_undistorted_frames_show_what_the_cameras_see(tmp_path):
    """Catches any step from COLMAP's files to pinhole images that is off: pose, lens, principal
    point, resampling."""
    pytest.importorskip("cv2")
    pycolmap = pytest.importorskip("pycolmap")
    walls = textures()
    angles = np.linspace(0.3, 1.25, 7)
    eyes = [(1.6 * np.cos(a), 0.3 + 0.4 * np.sin(3 * a), 1.6 * np.sin(a)) for a in angles]
    truth = [look_at(eye, (-0.6, -0.6, -0.6), WIDTH, HEIGHT, FOCAL) for eye in eyes]
    (tmp_path / "images").mkdir()
    rays = ideal_rays(truth[0])  # of all cameras
    for number, camera in enumerate(truth):
        image = rendered(camera, rays, walls).round().astype(np.uint8)
        Image.fromarray(image).convert("RGB").save(tmp_path / f"images/{number}.png")

    database, images, sparse = (
        str(tmp_path / name) for name in ("database.db", "images", "sparse")
    )
    reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
    single = pycolmap.CameraMode.SINGLE
    pycolmap.extract_features(database, images, camera_mode=single, reader_options=reader)
    pycolmap.match_exhaustive(database)
    (tmp_path / "sparse").mkdir()
    models = pycolmap.incremental_mapping(database, images, sparse)
    assert len(models) == 1

    footage = open_footage(tmp_path)
    assert [camera.name for camera in footage.cameras] == [str(n) for n in range(len(truth))]
    positions = np.array([camera.camera.position for camera in footage.cameras])
    true = np.array([camera.position for camera in truth])
    scale, rotation, translation = similarity(positions, true)
    for found, expected in zip(footage.cameras, truth, strict=True):
        aligned = scale * rotation @ found.camera.position + translation
        np.testing.assert_allclose(aligned, expected.position, atol=0.02)
        turned = found.camera.world_to_camera[:3, :3] @ rotation.T
        np.testing.assert_allclose(turned, expected.world_to_camera[:3, :3], atol=0.01)
        ideal = rendered(expected, pixel_rays(found.camera), walls)
        difference = np.abs(found.image(0)[..., 0].astype(float) - ideal)[4:-4, 4:-4]
        assert np.median(difference) < 6, found.name
    recorded = np.asarray(Image.open(tmp_path / "images/0.png").convert("L"), float)
    assert np.median(np.abs(recorded - rendered(truth[0], pixel_rays(truth[0]), walls))) > 12
