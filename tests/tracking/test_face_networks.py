"""The face networks without MediaPipe, against what MediaPipe finds in the same pictures."""

from pathlib import Path

import numpy as np
import pytest
from flame.small_head import small_head
from numpy.linalg import norm
from scipy.spatial.transform import Rotation

from stga_addon.capture.camera import look_at
from stga_addon.capture.mesh_geometry import similarity
from stga_addon.capture.open import open_capture
from stga_addon.flame.forward import flame_forward, neutral_frame
from stga_addon.flame.model import EYEBALL_WEIGHT
from stga_addon.flame.parts import flame_model
from stga_addon.tracking import recorded
from stga_addon.tracking.correspondence import (
    calibrate,
    head_colors,
    picture_cameras,
    shaded_image,
)
from stga_addon.tracking.face_networks import IRIS_CENTERS, SCORE_NAMES, FaceNetworks
from stga_addon.tracking.fit import HeadFit
from stga_addon.tracking.footage.open import open_footage
from stga_addon.tracking.head_model import read_head_model
from stga_addon.tracking.known_person import KnownPerson
from stga_addon.tracking.landmark_bias import bias_in, without_bias
from stga_addon.tracking.landmarks import read_places
from stga_addon.tracking.opened import TrackingOptions
from stga_addon.tracking.recorded import BUNDLED_PLACES
from stga_addon.tracking.solve import person
from stga_addon.tracking.track import track

from .test_fit import HERE

cv2 = pytest.importorskip("cv2")

REFERENCE = Path(__file__).with_name("mediapipe.npz")
"""Of mediapipe 0.10.21's Tasks, image mode, on `pictures`: landmarks (3, 478, 2) and scores (3,
52)."""


@pytest.fixture(scope="module")
def pictures():
    """From the front, from the side, and turned in the image's plane before a wide dark
    background."""
    model = small_head(0)
    mesh = model.v_template
    faces = model.faces
    cameras = picture_cameras(mesh)
    front, side = (shaded_image(mesh, faces, cameras[number]) for number in (0, 3))
    wide = cv2.copyMakeBorder(front, 60, 20, 40, 400, cv2.BORDER_CONSTANT, value=(30, 40, 50))
    turn = cv2.getRotationMatrix2D((300, 300), 25, 1.0)
    return [front, side, cv2.warpAffine(wide, turn, wide.shape[1::-1])]


def test_landmarks_and_scores_are_mediapipes(pictures):
    """Catches other anchors, crops or inputs than networks had, faces found twice or on a wall."""
    reference = np.load(REFERENCE)
    for image, points, scores in zip(
        pictures, reference["points"], reference["scores"], strict=True
    ):
        (found,) = FaceNetworks().detect(image)
        assert np.median(norm(found - points, axis=1)) < 0.1  # of 512 pixels
        weights = FaceNetworks().score(image).weights
        np.testing.assert_allclose([weights[name] for name in SCORE_NAMES], scores, atol=0.02)
    front = pictures[0]
    assert len(FaceNetworks().detect(np.concatenate([front, front], axis=1))) == 2
    assert len(FaceNetworks().detect(front)) == 1
    assert FaceNetworks().detect(np.full_like(front, 128)) == []
    assert FaceNetworks().score(np.full_like(front, 128)) is None


def test_small_faces_are_found(pictures):
    """Catches a person two meters before a phone who is not found: the detector sees the whole
    frame in 128 pixels; and landmarks that are placed in a part of the frame instead of the
    frame."""
    front = pictures[0]
    face = cv2.resize(front, (200, 200), interpolation=cv2.INTER_AREA)
    (whole,) = FaceNetworks().detect(face)
    assert 90 < np.ptp(whole[:, 1]) < 130
    for x, y in ((30, 60), (310, 640), (510, 1070)):
        frame = np.full((1280, 720, 3), front[0, 0], np.uint8)
        frame[y : y + 200, x : x + 200] = face
        assert FaceNetworks().detect(frame) == []
        (found,) = FaceNetworks().find(frame)
        assert np.median(norm(found - [x, y] - whole, axis=1)) < 1.5
        assert FaceNetworks().score(frame) is not None
        (again,) = FaceNetworks().find(frame, found + 40)
        assert np.median(norm(again - found, axis=1)) < 1.5
        frame[850:1050, 10:210] = face
        assert len(FaceNetworks().find(frame)) == 2
    side = cv2.resize(pictures[1], (360, 360), interpolation=cv2.INTER_AREA)
    frame = np.full((1280, 720, 3), side[0, 0], np.uint8)
    frame[500:860, 200:560] = side
    (whole,) = FaceNetworks().detect(side)
    away = [
        np.median(norm(found - [200, 500] - whole, axis=1))
        for (found,) in (FaceNetworks().detect(frame), FaceNetworks().find(frame))
    ]
    assert away[1] < 0.6 * away[0]  # from a coarse box


def test_a_face_is_looked_for_in_parts_only_where_the_frame_shows_none(pictures, monkeypatch):
    """Catches ordinary clips that take longer, and a face that is lost for a frame and sought
    everywhere before it is sought where it was."""
    looks = []
    boxes = FaceNetworks._boxes

    def count(self, image, part):
        looks.append(part.side)
        return boxes(self, image, part)

    monkeypatch.setattr(FaceNetworks, "_boxes", count)
    front = pictures[0]
    FaceNetworks().find(front)
    assert looks == [512]
    frame = np.full((1280, 720, 3), front[0, 0], np.uint8)
    frame[100:250, 100:250] = cv2.resize(front, (150, 150), interpolation=cv2.INTER_AREA)
    (found,) = FaceNetworks().find(frame)
    looks.clear()
    assert len(FaceNetworks().find(frame, found)) == 1
    assert looks[0] == 1280
    assert len(looks) == 2
    assert looks[1] < 640


class Pictured:
    """Landmarks of a person, whom the file of the bias was not made of, in a picture by a camera at
    this place from the face's middle: as found, and the true ones."""

    def __init__(self, away, focal, up=(0, 1, 0)):
        model = flame_model(None)
        places, self.used = read_places(BUNDLED_PLACES, len(model.faces))
        shape = np.random.default_rng(77).normal(0, 0.5, model.n_identity)
        mesh = flame_forward(model, shape, neutral_frame(model))
        at = places.on(mesh, model.faces)
        center = at[self.used].mean(0)
        self.camera = look_at(center + away, center, 512, 512, focal, up=up)
        image = shaded_image(mesh, model.faces, self.camera, head_colors(model))
        (self.found,) = FaceNetworks().detect(image)
        self.truth = self.camera.project(at)[0]
        self.neutral = places.on(model.v_template, model.faces)


@pytest.mark.parametrize("roll_deg", [0, 25])
@pytest.mark.parametrize("azimuth_deg", [-40, 0, 40])
def test_landmarks_are_moved_to_where_they_belong(azimuth_deg, roll_deg):
    """Catches a bias that is added instead of taken away, mirrored, or not turned with the image;
    of a person and directions that the file was not made of."""
    turn = np.radians([azimuth_deg, roll_deg])
    up = (np.sin(turn[1]), np.cos(turn[1]), 0)
    person = Pictured(np.array([np.sin(turn[0]), 0.6, np.cos(turn[0])]), 1100, up)
    used = person.used
    before = norm((person.found - person.truth)[used])
    moved = without_bias(person.found, person.camera, person.neutral, used)
    assert norm((moved - person.truth)[used]) < 0.85 * before


@pytest.mark.parametrize("azimuth_deg", [-25, 10])
def test_landmarks_of_a_near_face_are_moved_further(azimuth_deg):
    """Catches the bias of a near camera that is added instead of taken away: a selfie's focal
    length was estimated twice as long as it is."""
    turn = np.radians(azimuth_deg)
    person = Pictured(0.4 * np.array([np.sin(turn), 0.1, np.cos(turn)]), 440)
    used = person.used
    bias = bias_in(person.found, person.camera, person.neutral, used)
    assert bias.distance_m == pytest.approx(0.4, rel=0.1)
    far = person.found - bias.offset - person.truth
    near = far - bias.beyond_offset(bias.distance_m)
    assert norm(near[used]) < 0.97 * norm(far[used])
    assert not bias.beyond_offset(1.2).any()  # the distance of the file's cameras


def test_landmarks_of_lips_and_lids_lie_on_what_moves_them():
    """Catches the lower lip's landmarks on the upper lip, which they touch while the mouth is
    closed, and those of lids on the eyeballs: an open mouth would be tracked as closed, and a blink
    as half of one. And places that are kept of another head or other networks."""
    model = flame_model(None)
    places, used = calibrate(model, FaceNetworks(), "head")
    kept, kept_used = read_places(BUNDLED_PLACES, len(model.faces))
    both = used & kept_used
    assert both.sum() > 0.98 * max(used.sum(), kept_used.sum())
    at = [own.on(model.v_template, model.faces)[both] for own in (kept, places)]
    apart = norm(at[0] - at[1], axis=1)
    assert np.quantile(apart, 0.95) < 2e-4  # as processors round

    def moved(name):
        shape = model.shapedirs[:, :, model.n_identity + model.expression_names.index(name)]
        return norm(places.on(shape, model.faces), axis=1)

    upper = moved("jawOpen")[[80, 82, 13, 312, 310]]
    lower = moved("jawOpen")[[88, 87, 14, 317, 318]]
    assert upper.max() < 0.01 < 0.025 < lower.min()
    on_eyeballs = (model.weights[model.faces, 3:] > EYEBALL_WEIGHT).any((1, 2))[places.face]
    assert np.flatnonzero(on_eyeballs).tolist() == sorted(IRIS_CENTERS)
    assert moved("eyeBlinkLeft")[[385, 386, 387]].min() > 0.003


def test_a_known_head_seen_from_above_is_not_tilted(tmp_path, monkeypatch):
    """Catches the networks' bias, which depends on the direction, taken for a turn of a head that
    is known: the only camera of another take looks down on it. Where the networks see no face in
    its pictures, the bias stays."""
    anyone = read_head_model(None)
    head = person(anyone, np.zeros(anyone.model.n_identity))
    mesh = head.model.v_template
    faces = head.model.faces
    center = (mesh.min(0) + mesh.max(0)) / 2
    raised = Rotation.from_euler("x", -35, degrees=True).apply([0.0, 0.0, 1.0])
    camera = look_at(center + raised, center, 512, 512, 1500.0)
    turns = [Rotation.from_euler("y", angle, degrees=True) for angle in (-12, 0, 12)]
    heads = [center + turn.apply(mesh - center) for turn in turns]
    (tmp_path / "photos").mkdir()
    for number, own in enumerate(heads):
        image = shaded_image(own, faces, camera)
        cv2.imwrite(str(tmp_path / f"photos/{number}.png"), image[..., ::-1])
    footage = open_footage(tmp_path / "photos", focal=1500.0)

    def draw(vertices, seen_by):
        return shaded_image(vertices, faces, seen_by)

    def draw_nothing(vertices, seen_by):
        return np.zeros((512, 512, 3), np.uint8)

    places = read_places(BUNDLED_PLACES, len(faces))
    monkeypatch.setattr(recorded, "calibrate", lambda *_: places)  # as both would find them
    fit = HeadFit(head, np.zeros(0), {}, HERE)
    tilts_deg = []
    for name, drawn in (("biased", draw_nothing), ("corrected", draw)):
        known = KnownPerson(fit, drawn, None)
        options = TrackingOptions(mattes=False, person=known)
        track(footage, None, tmp_path / name, options)
        capture = open_capture(tmp_path / name)
        own_deg = []
        for view in capture.views["train"]:
            seen = capture.mesh(view.timestep) @ view.camera.world_to_camera[:3, :3].T
            true = heads[view.timestep] @ camera.world_to_camera[:3, :3].T
            turn = Rotation.from_matrix(similarity(seen, true).rotation)
            own_deg.append(turn.magnitude() * 180 / np.pi)
        tilts_deg.append(np.median(own_deg))
    assert len(own_deg) == len(heads)
    assert tilts_deg[0] < 1.5  # more than 3 without the bias by direction
    assert tilts_deg[1] < 1.5
