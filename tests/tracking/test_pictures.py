"""The contact sheet: which views it shows, and where the mesh lies in them; and the head drawn over
the footage while it is tracked."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from PIL import Image

from stga_addon.capture.camera import look_at
from stga_addon.capture.model import View
from stga_addon.tracking import pictures
from stga_addon.tracking.face_networks import FaceNetworks
from stga_addon.tracking.fit import RecordedTake
from stga_addon.tracking.footage.model import Footage, FootageCamera, ImageFrames
from stga_addon.tracking.footage.open import open_footage
from stga_addon.tracking.head_model import read_head_model
from stga_addon.tracking.landmarks import read_places
from stga_addon.tracking.pictures import (
    COLUMNS,
    MESH_OPACITY,
    PICTURE,
    PosedHead,
    write_contact_sheet,
)
from stga_addon.tracking.recorded import BUNDLED_PLACES

from .head_video import write_head_video
from .test_surface import rays_of

SIZE = 120
BALL = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
FACES = np.asarray(BALL.faces, np.int32)


def ball(timestep):
    return np.add(BALL.vertices, (0.02 * timestep, 0, 0))


def footage(folder, cameras, timesteps):
    """Images in which the ball is white on black, by its exact outline; red says the camera, green
    the timestep."""
    found = []
    for number in range(cameras):
        camera = look_at((0.2 * number, 0.1, 1.0), (0, 0, 0), SIZE, SIZE, 400.0)
        views = {}
        rays = rays_of(camera)
        for t in range(timesteps):
            away = [0.02 * t, 0, 0] - camera.position
            covered = away @ away - (rays @ away) ** 2 < 0.1**2
            image = np.where(covered[..., None], 255, np.array([20 * number, 20 * t, 0]))
            path = folder / f"{number}_{t}.png"
            Image.fromarray(image.astype(np.uint8)).save(path)
            views[t] = View(t, number, camera, path.name, path)
        found.append(FootageCamera(f"cam{number}", camera, ImageFrames(views)))
    return Footage(folder, tuple(found), tuple(range(timesteps)))


def write(folder, take, errors, misfit=None):
    cameras = {camera.name: camera.camera for camera in take.cameras}
    write_contact_sheet(folder / "sheet.png", take, PosedHead(cameras, ball, FACES), errors, misfit)
    return np.asarray(Image.open(folder / "sheet.png").convert("RGB")).astype(int)


def tiles(sheet, count):
    """The pictures of each view: as recorded, and with the mesh, from the positions of the
    tiles."""
    width, height = PICTURE
    top = sheet.shape[0] - 12 - (-(-count // COLUMNS)) * (height + 18 + 8)
    for number in range(count):
        row, column = divmod(number, COLUMNS)
        y = top + row * (height + 26)
        x = 12 + column * (2 * width + 8)
        yield sheet[y : y + height, x : x + width], sheet[y : y + height, x + width : x + 2 * width]


def test_worst_views_first(tmp_path):
    """Catches views in another order or of another timestep, and a mesh shifted by the crop."""
    take = footage(tmp_path, 2, 3)
    errors = {"cam0": {0: 1.0, 2: 5.0}, "cam1": {0: 2.0, 1: 9.0, 2: 0.5}}
    sheet = write(tmp_path, take, errors)
    corners = [plain[3, 3, :2].tolist() for plain, _ in tiles(sheet, 5)]
    assert corners == [[20, 20], [0, 40], [20, 0], [0, 0], [20, 40]]
    sheet = write(tmp_path, take, {"cam0": {1: 1.0}, "cam1": {0: 2.0}})
    for plain, drawn in tiles(sheet, 2):
        head = plain.min(axis=2) > 128
        changed = np.abs(plain - drawn).max(axis=2) > 255 * MESH_OPACITY / 8
        assert head.mean() > 0.3
        assert (head ^ changed)[:, :190].mean() < 0.02
        y, x = (int(np.mean(axis)) for axis in np.nonzero(head))
        # where the surface faces the camera, its color is blue; above, greener than below
        assert drawn[y, x, 2] > drawn[y, x, 0]
        top = head.any(axis=1).argmax()
        assert drawn[top + 12, x, 1] > drawn[2 * y - top - 12, x, 1]


def test_what_images_do_not_explain_counts_beside_landmarks(tmp_path):
    """Catches a sheet that hides where landmarks and head agree on what images do not show."""
    take = footage(tmp_path, 1, 4)
    errors = {"cam0": {0: 1.0, 1: 1.3, 2: 1.0, 3: 1.0}}
    misfit = {"mouth": {0: 0.1, 1: 0.1, 2: 0.4, 3: 0.1}, "eyes": {0: 0.05, 3: 0.15}}
    sheet = write(tmp_path, take, errors, misfit)
    corners = [plain[3, 3, 1] for plain, _ in tiles(sheet, 4)]
    assert corners == [40, 60, 20, 0]
    # a row of the chart for each region
    assert len(sheet) == len(write(tmp_path, take, errors)) + 2 * 12


def test_what_a_matte_leaves_out_is_green(tmp_path):
    """Catches mattes that cannot be checked on the sheet, and a head that is painted over."""
    take = footage(tmp_path, 1, 1)
    half = np.zeros((SIZE, SIZE), np.uint8)
    half[:, : SIZE // 2] = 255
    Image.fromarray(half).save(tmp_path / "matte.png")
    matted = replace(take, cameras=(replace(take.cameras[0], mattes={0: tmp_path / "matte.png"}),))
    sheets = (write(tmp_path, each, {"cam0": {0: 1.0}}) for each in (take, matted))
    (plain, _), (shown, _) = (next(tiles(sheet, 1)) for sheet in sheets)
    np.testing.assert_array_equal(shown[:180, :85], plain[:180, :85])
    assert (shown[:180, 115:190, 1] > shown[:180, 115:190, 0] + 40).all()


@pytest.mark.parametrize("cameras", [1, 60])
def test_many_cameras_and_none_seen(tmp_path, cameras):
    """Catches a sheet that grows without bound, and one of a take in which nothing was measured."""
    take = footage(tmp_path, cameras, 1)
    sheet = write(tmp_path, take, {camera.name: {0: 1.0} for camera in take.cameras})
    assert sheet.shape[0] < 2400
    assert write(tmp_path, take, {camera.name: {} for camera in take.cameras}).size


def test_first_frame_shows_the_head_where_it_is(tmp_path, monkeypatch):
    """Catches a mesh drawn beside the head, of another frame, or in another part of the image than
    is shown."""
    pytest.importorskip("cv2")
    pytest.importorskip("av")
    write_head_video(tmp_path / "head.mp4", 2)
    head = read_head_model(None)
    networks = FaceNetworks()
    take = RecordedTake(*read_places(BUNDLED_PLACES, len(head.model.faces)), {})
    shown = []
    draw = pictures.with_mesh
    for with_mesh in (draw, lambda picture, *_: picture):
        monkeypatch.setattr(pictures, "with_mesh", with_mesh)
        footage = open_footage(tmp_path / "head.mp4")
        shown.append(pictures.picture_of_first_frame(head, footage, networks, take)["rgb"])
    over, plain = (picture.astype(int) for picture in shown)
    assert over.shape == (pictures.SIZE, pictures.SIZE, 3)
    drawn = np.abs(over - plain).max(2) > 8
    skin = plain[..., 0] - plain[..., 2] > 20
    rows = np.flatnonzero(skin.any(1))
    above_the_neck = slice(0, rows[0] + 6 * len(rows) // 10)
    drawn = drawn[above_the_neck]
    skin = skin[above_the_neck]
    assert (drawn & skin).sum() > 0.7 * (drawn | skin).sum() > 0
