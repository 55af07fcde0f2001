"""`stga track` from footage to a capture that opens, with landmark files and with the networks."""

import os
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from command_line import stga
from flame.small_head import write_flame
from numpy.testing import assert_allclose, assert_array_equal
from refusal import refusal
from scipy.spatial.transform import Rotation

from stga_addon.capture.camera import look_at
from stga_addon.capture.mesh_geometry import Similarity
from stga_addon.capture.open import open_capture
from stga_addon.export.playback import playback_fps
from stga_addon.files import read_json, read_npz, write_json, write_npz
from stga_addon.flame.forward import RIGID_SIZE, flame_forward
from stga_addon.flame.parts import flame_model
from stga_addon.jobs.perform import perform
from stga_addon.jobs.track import Track
from stga_addon.tracking.correspondence import nearest_points, shaded_image
from stga_addon.tracking.fit import HeadFit, RecordedTake, TimestepLandmarks
from stga_addon.tracking.focal_length import scale_warnings
from stga_addon.tracking.folder import PLACES_FILE
from stga_addon.tracking.footage.open import open_footage
from stga_addon.tracking.footage.sequences import FrameRange
from stga_addon.tracking.head_model import HeadModel, read_head_model
from stga_addon.tracking.landmarks import detect_landmarks, landmark_file, read_camera
from stga_addon.tracking.opened import TrackingOptions
from stga_addon.tracking.solve import person
from stga_addon.tracking.stages import Stage, Workers
from stga_addon.tracking.track import track
from stga_addon.worker.helpers import Helpers

from .recording import LANDMARKS, SIZE, record, rig, seen_landmarks, write_footage
from .scenes import write_video
from .test_fit import HERE, frame_at, places_on
from .test_sequences import write_folders


@pytest.fixture(scope="module")
def take(tmp_path_factory, head):
    """The folder of a take with blank images, and its meshes."""
    folder = tmp_path_factory.mktemp("take")
    return folder, record(folder, head)


@pytest.fixture
def recorded(tmp_path, take, without_surface, monkeypatch):
    """A copy of the take that a test may change, and its meshes; contact sheets stay empty."""
    sheet = "stga_addon.tracking.track.write_contact_sheet"
    monkeypatch.setattr(sheet, lambda path, *_: path.touch())
    folder, meshes = take
    return shutil.copytree(folder, tmp_path, dirs_exist_ok=True), meshes


def command(folder, *more):
    paths = (
        "--model",
        folder / "head.npz",
        "--out",
        folder / "out",
        "--landmarks",
        folder / "points",
    )
    return stga("track", folder / "footage", *paths, "--mattes none", *more)


def assert_projects_as(capture, meshes, vertices, skipped=2):
    """The capture's meshes lie in its images where the recording's do."""
    for view in (*capture.views["train"], *capture.views["val"]):
        if view.timestep != skipped:
            pixels, _ = view.camera.project(capture.mesh(view.timestep)[vertices])
            expected, _ = rig()[view.camera_index].project(meshes[view.timestep][vertices])
            assert np.abs(pixels - expected).mean() < 0.4


def change(path, **values):
    write_npz(path, {**np.load(path), **values})


@pytest.mark.usefixtures("without_surface")
def test_the_bundled_head_is_tracked_without_a_model(tmp_path):
    """Catches a default that needs a file, and weights of another scale."""
    head = HeadModel(flame_model(None), "flame")
    meshes = record(tmp_path, head)
    paths = tmp_path / "footage", "--out", tmp_path / "out", "--landmarks", tmp_path / "points"
    assert stga("track", *paths, "--mattes none") == 0
    capture = open_capture(tmp_path / "out", tmp_path / "head.npz")
    assert capture.flame_file == tmp_path / "out/bundled_head.npz"
    assert capture.flame.model.expression_names == head.model.expression_names
    assert_projects_as(capture, meshes, head.model.masks["nose"])


def test_the_capture_opens_and_projects_where_the_landmarks_were(recorded, head):
    """Catches wrong axes, units or a principal point in what is written, and a bar's jumps."""
    folder, meshes = recorded
    paths = (folder / "footage", folder / "head.npz", folder / "out")
    told = []
    request = Track(*paths, landmarks=folder / "points", meshes=True)
    written = perform(request, lambda progress: bool(told.append(progress)), print)
    assert "interpolated: 2" in str(written.lines)
    capture = open_capture(folder / "out", folder / "head.npz")
    assert capture.layout == "flame"
    assert capture.timesteps == (0, 1, 2, 3, 4)
    assert len({view.camera_index for view in capture.views["val"]}) == 1
    assert_projects_as(capture, meshes, head.model.masks["face"])
    mesh = (folder / "out/meshes/00001.obj").read_text().splitlines()
    vertices = np.array([line.split()[1:] for line in mesh if line.startswith("v ")], float)
    assert_allclose(vertices, capture.mesh(1), atol=2e-6)
    assert (folder / "out/contact_sheet.png").is_file()
    shares = [progress.fraction for progress in told]
    assert shares == sorted(shares)
    assert {progress.stage for progress in told} <= {*(stage.title for stage in Stage), "Tracked"}
    quality = {progress.stage: progress.figures().get("error_px") for progress in told}
    assert quality["Opening the footage"] is None
    assert 0 < quality["Heads"] < 0.5


@pytest.mark.parametrize(("scale", "arguments"), [(1.06, []), (1000.0, ["--world", "keep"])])
def test_the_cameras_world_is_kept(recorded, capsys, head, scale, arguments):
    """Catches cameras and head moved, turned or scaled away from the scene that the footage was
    filmed in.

    Without --world, the calibration says it. The head is 6 % larger than the model's, or in
    millimeters.
    """
    folder, meshes = recorded
    turn = Rotation.from_euler("xyz", [100, -40, 20], degrees=True).as_matrix()
    world = Similarity(scale, turn, np.array([2.0, -1.0, 0.5]) * scale)
    path = folder / "footage/transforms.json"
    values = read_json(path)
    for entry in values["frames"]:
        pose = np.array(entry["transform_matrix"])
        pose[:3] = np.column_stack([turn @ pose[:3, :3], world.apply(pose[None, :3, 3])[0]])
        entry["transform_matrix"] = pose.tolist()
    write_json(path, values if arguments else {**values, "world": "keep"})
    assert command(folder, *arguments) == 0
    assert ("is kept but for its scale" in capsys.readouterr().out) == (scale == 1000)
    capture = open_capture(folder / "out", folder / "head.npz")
    unit = read_json(folder / "out/tracking.json")["meters_per_unit"]
    assert unit == (pytest.approx(1.0, rel=1e-9) if scale < 2 else pytest.approx(0.001, rel=0.03))
    filmed = {camera.name: camera.camera for camera in open_footage(folder / "footage").cameras}
    for view in capture.views["train"]:
        camera = filmed[f"cam{view.camera_index}"]
        turned = view.camera.world_to_camera[:3, :3]
        assert_allclose(view.camera.position, unit * camera.position, atol=1e-6)
        assert_allclose(turned, camera.world_to_camera[:3, :3], atol=1e-9)
    for timestep in (0, 3):
        missed = capture.mesh(timestep) - unit * world.apply(meshes[timestep])
        assert np.linalg.norm(missed[head.model.masks["face"]], axis=1).mean() < 2e-3


@pytest.mark.parametrize("fps", [None, 60000 / 1001])
def test_frame_rate_of_the_footage(recorded, fps):
    """Catches a rate that is read and thrown away, or that a step of the frames makes another
    one."""
    folder, _ = recorded
    for path in (folder / "points").glob("cam*.npz"):
        write_npz(path, {name: array[::3] for name, array in read_npz(path).items()})
    transforms = folder / "footage/transforms.json"
    write_json(transforms, {**read_json(transforms), "fps": fps})
    footage = open_footage(folder / "footage", frames=FrameRange(0, None, 3))
    assert footage.fps == fps
    options = TrackingOptions(folder / "points")
    track(footage, folder / "head.npz", folder / "out", options)
    capture = open_capture(folder / "out", folder / "head.npz")
    assert capture.timesteps == (0, 3)
    assert capture.fps == fps
    assert playback_fps(capture) == pytest.approx(25 if fps is None else 20000 / 1001)


@pytest.mark.parametrize("offset", ["cam0", "cam0=soon", "=", "cam0=1.5"])
def test_offsets_that_are_none(recorded, capsys, offset):
    """Catches an offset that is silently ignored."""
    with pytest.raises(SystemExit, match="2"):
        command(recorded[0], "--offset", offset)
    assert "expected a camera and a number of frames, as in left=-3" in capsys.readouterr().err


def test_a_linear_model_gives_a_mesh_capture(recorded, head):
    """Catches a layout that only FLAME's own files open in, and joints of a head that has none."""
    folder = recorded[0]
    model = head.model
    shapes = np.split(model.shapedirs, [model.n_identity], axis=2)
    named = dict(zip(("identity", "expression"), shapes, strict=True))
    write_npz(folder / "head.npz", {"mean": model.v_template, "faces": model.faces, **named})
    assert command(folder) == 0
    capture = open_capture(folder / "out")
    assert capture.layout == "mesh"
    assert len(capture.neutral) == len(model.v_template)
    assert read_head_model(folder / "head.npz").joints == (True, False, False, False, False)


ONE_POINT = {"face": np.zeros(LANDMARKS, int), "barycentric": np.full((LANDMARKS, 3), 1 / 3)}
OTHERS = {"points": np.zeros((5, 7, 2)), "confidence": np.ones((5, 7))}


@pytest.mark.parametrize(
    ("file", "changes", "more", "message"),
    [
        (
            "cam3",
            lambda points: {"points": points * [-1, 1] + [SIZE + 9, 0]},
            (),
            r"camera cam3: .* timestep",
        ),
        (
            "cam3",
            lambda points: {"points": np.roll(points, 3, axis=0)},
            (),
            r"camera cam3: .* at timestep \d, .* check its calibration, synchroniz",
        ),
        ("cam0", lambda _: OTHERS, (), "points: the files have different numbers of landmarks"),
        (
            "head_model",
            lambda _: ONE_POINT,
            (),
            "head_model.npz: face: its landmarks lie in one point of the head model",
        ),
        (
            "cam0",
            lambda _: {},
            ("--offset", "cam1=3"),
            "transforms.json: lists images, which offsets do not apply to",
        ),
    ],
)
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_what_does_not_fit_is_named(recorded, capsys, file, changes, more, message):
    """Catches a camera mirrored, misplaced or started later, and others' landmarks."""
    folder, _ = recorded
    points = np.load(folder / "points/cam3.npz")["points"]
    change(folder / f"points/{file}.npz", **changes(points))
    assert command(folder, *more) == 2
    assert re.search(message, capsys.readouterr().err)
    assert not (folder / "out/transforms_train.json").exists()


def test_a_mirrored_rig_is_named(recorded, capsys, head):
    """Catches images that are all mirrored, where no camera stands out from the others."""
    folder, meshes = recorded
    template = head.model.v_template
    faces = head.model.faces
    mirrored = places_on(head, LANDMARKS).on(template, faces) * [-1, 1, 1]
    twins, _ = nearest_points(template, faces, mirrored)
    for number, camera in enumerate(rig()):
        points = seen_landmarks(head, twins, meshes, camera)
        # a detector calls the left eye of a mirrored face its right one
        change(folder / f"points/cam{number}.npz", points=points * [-1, 1] + [SIZE, 0])
    assert command(folder) == 2
    message = r"camera cam\d: .* pixels at timestep \d, and those of the other cameras are too;"
    assert re.search(message, capsys.readouterr().err)


@pytest.mark.parametrize("factor", [0.95, 1.05])
def test_a_wrong_focal_length_is_named(recorded, capsys, factor):
    """Catches a camera whose focal length is 5 % off, which moves landmarks less than a detector's
    own errors."""
    path = recorded[0] / "footage/transforms.json"
    written = read_json(path)
    for entry in written["frames"]:
        if entry["camera_id"] == "cam1":
            entry["fl_x"], entry["fl_y"] = factor * entry["fl_x"], factor * entry["fl_y"]
    write_json(path, written)
    assert command(recorded[0]) == 0
    (warning,) = re.findall("(?m)^warning: camera .*$", capsys.readouterr().out)
    expected = rf"[45]\.\d% {'larger' if factor < 1 else 'smaller'} .* timestep \d; check its focal"
    assert re.search(f"camera cam1: shows the head {expected} length", warning)


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_timesteps_that_determine_no_pose_are_interpolated(tmp_path, head, capsys):
    """Catches NaN, or a head at the camera, of too few landmarks, and training on a guess."""
    record(tmp_path, head, timesteps=8)
    face = np.load(tmp_path / "points/head_model.npz")["face"]
    face[:7] = -1
    change(tmp_path / "points/head_model.npz", face=face)
    for camera in range(5):
        path = tmp_path / f"points/cam{camera}.npz"
        points, confidence = (np.load(path)[name] for name in ("points", "confidence"))
        confidence[3, 7:] = 0  # unreliable ones alone
        points[4, 7:] = 5.0  # reliable ones in one point
        confidence[5] = np.arange(LANDMARKS) % 5 == camera  # each in one camera
        confidence[6] = np.isin(np.arange(LANDMARKS), (20, 21))  # only two
        change(path, points=points, confidence=confidence)
    assert command(tmp_path) == 0
    assert read_json(tmp_path / "out/tracking.json")["interpolated"] == [2, 3, 4, 5, 6]
    timesteps = {}
    for split in ("train", "test"):
        frames = read_json(tmp_path / f"out/transforms_{split}.json")["frames"]
        timesteps[split] = {frame["timestep_index"] for frame in frames}
    assert timesteps == {"train": {0, 1, 7}, "test": {2, 3, 4, 5, 6}}


@pytest.mark.parametrize(("side_deg", "is_told"), [(68, False), (45, True)])
def test_a_camera_at_the_side_is_not_blamed_for_what_landmarks_get_wrong_there(
    head, side_deg, is_told
):
    """Catches a warning on a sound camera that sees the face nearly in profile, where landmarks are
    of another size by up to 7 % on the path-traced head; and a wrong focal length at the side that
    is no longer told."""
    places = places_on(head, LANDMARKS)
    used = np.ones(LANDMARKS, bool)
    parameters = {t: np.zeros(head.model.n_expression + RIGID_SIZE) for t in range(3)}
    shape = np.zeros(head.model.n_identity)
    fit = HeadFit(person(head, shape), shape, parameters, HERE)
    at = places.on(head.model.v_template, head.model.faces)
    cameras = []
    points = []
    for number, angle in enumerate(np.radians([-30, -10, 10, 30, side_deg])):
        eye = at.mean(0) + 0.9 * np.array([np.sin(angle), 0, np.cos(angle)])
        camera = look_at(eye, at.mean(0), 200, 200, 500.0)
        pixels, _ = camera.project(at)
        size = 0.93 if number == 4 else 1.0
        points.append(pixels.mean(0) + size * (pixels - pixels.mean(0)))
        cameras.append(camera)
    names = tuple(f"cam{number}" for number in range(5))
    own = TimestepLandmarks(tuple(cameras), np.stack(points), np.ones((5, LANDMARKS)), names)
    warnings = scale_warnings(fit, RecordedTake(places, used, dict.fromkeys(range(3), own)))
    told = ["camera cam4: shows the head 7.0% smaller"]
    assert [text[:40] for text in warnings] == (told if is_told else [])


class Detector:
    """Sees faces by the brightness of an image, of which there are as many as `faces`, and
    counts."""

    def __init__(self, *faces):
        self.faces = faces
        self.calls = 0

    def find(self, image, near=None):
        self.calls += 1
        return self.faces[int(image[0, 0, 0]) % len(self.faces)]


def unmoved(points, camera):
    return points


def test_detection_resumes_camera_by_camera(recorded):
    """Catches a canceled detection that starts from the beginning, or keeps half a camera, and a
    head that jumps between two people."""
    folder, _ = recorded
    footage = open_footage(folder / "footage")
    detector = Detector([np.ones((3, 2))] * 2)
    with pytest.raises(KeyboardInterrupt):
        detect_landmarks(footage, detector, unmoved, folder / "found", Workers(Helpers(1), cancel))
    assert len(list((folder / "found").iterdir())) == 2
    detector.calls = 0
    found = detect_landmarks(footage, detector, unmoved, folder / "found", Workers(Helpers(1)))
    assert detector.calls == 15
    # the same face twice is one face
    assert all(camera.confidence.all() for camera in found.values())
    camera = footage.cameras[0]
    written = read_camera(landmark_file(folder / "found", camera.name), camera)
    assert_array_equal(written.points, 1)
    two = np.array([[0.0, 0.0], [9.0, 9.0]])
    with refusal(r"camera cam0 sees 5 of 5 frames with two faces, the first at timestep 0"):
        detect_landmarks(footage, Detector([two, two + 30]), unmoved, folder, Workers(Helpers(1)))


def cancel(stage, done, total):
    if done == 13:
        raise KeyboardInterrupt


def numbered_take(folder, head):
    """Footage whose images are of different brightness; places on the head, and (25, N, 2) their
    landmarks by image."""
    number = iter(range(25))
    meshes = record(folder, head, lambda *_: np.full((SIZE, SIZE, 3), next(number), np.uint8))
    places = places_on(head, LANDMARKS)
    points = [seen_landmarks(head, places, meshes, camera) for camera in rig()]
    return open_footage(folder / "footage"), places, np.concatenate(points)


def use_detector(monkeypatch, detector, places):
    """Let `track` use a detector whose landmarks lie at some places of the head model."""
    monkeypatch.setattr("stga_addon.tracking.recorded.FaceNetworks", lambda: detector)
    calibrated = places, np.ones(len(places), bool)
    monkeypatch.setattr("stga_addon.tracking.recorded.calibrate", lambda *_: calibrated)


@pytest.mark.usefixtures("without_surface")
def test_a_canceled_run_ends_as_an_unbroken_one(tmp_path, head, monkeypatch):
    """Catches landmarks in another precision on disk than in memory: the same track, with other
    numbers."""
    footage, places, exact = numbered_take(tmp_path, head)
    noisy = exact + np.random.default_rng(0).normal(0, 0.1, exact.shape)
    use_detector(monkeypatch, Detector(*([own] for own in noisy)), places)
    model = tmp_path / "head.npz"
    track(footage, model, tmp_path / "unbroken")
    with pytest.raises(KeyboardInterrupt):
        track(footage, model, tmp_path / "resumed", report=cancel)
    track(footage, model, tmp_path / "resumed")
    written = [path for path in sorted((tmp_path / "unbroken").rglob("*")) if path.is_file()]
    assert len(written) > 30
    for path in written:
        other = tmp_path / "resumed" / path.relative_to(tmp_path / "unbroken")
        if path.suffix == ".npz":  # an archive holds the time at which it was written
            for name, array in np.load(path).items():
                assert_array_equal(np.load(other)[name], array, f"{path}: {name}")
        else:
            assert path.read_bytes() == other.read_bytes(), path


def test_cameras_have_landmark_files_of_their_own(tmp_path):
    """Catches cameras whose landmarks overwrite each other, or the correspondence of the head
    model."""
    names = ["walk/1", "walk_1", "walk%2F1", "walk 1", "head_model", "kamera-Ä.2", "a\\b", "a:b"]
    files = [landmark_file(tmp_path, name) for name in names]
    assert len({*files, tmp_path / PLACES_FILE}) == len(names) + 1
    assert files[0].name == "walk%2F1.npz"
    assert all(file.parent == tmp_path for file in files)


def test_the_capture_is_not_written_into_the_footage(tmp_path):
    """Catches images of the footage that those of the capture replace."""
    write_folders(tmp_path)
    with refusal("is the folder of the footage; give another --out"):
        track(open_footage(tmp_path), tmp_path / "head.npz", tmp_path)


def test_landmarks_of_another_recording_are_not_used_again(tmp_path, head, monkeypatch):
    """Catches landmarks of another offset, recording or head model under its name."""
    write_folders(tmp_path / "footage", (6, 8))
    write_flame(head.model, tmp_path / "head.npz")
    use_detector(monkeypatch, Detector([]), places_on(head, LANDMARKS))
    for name in ("out", "out_0", "out_1"):
        (tmp_path / name / "job").mkdir(parents=True)  # else nothing is left without a face
    none = "shows no face"
    other = "holds landmarks of other footage"
    for offset, message in ((1, none), (1, none), (2, other)):
        frames = FrameRange(stop=6, offsets={"b": offset})
        with refusal(message):
            track(
                open_footage(tmp_path / "footage", frames=frames),
                tmp_path / "head.npz",
                tmp_path / "out",
            )
    image = sorted((tmp_path / "footage").rglob("*.png"))[3]
    for number, changed in enumerate((image, tmp_path / "head.npz")):
        footage = open_footage(tmp_path / "footage", frames=FrameRange(stop=6))
        with refusal(none):
            track(footage, tmp_path / "head.npz", tmp_path / f"out_{number}")
        os.utime(changed, ns=(0, 1))
        with refusal(other):
            track(footage, tmp_path / "head.npz", tmp_path / f"out_{number}")


def test_two_trackings_of_one_capture(recorded, capsys, monkeypatch):
    """Catches two trackings that write into one folder, of which none says so."""
    (folder, _) = recorded
    codes = []

    def meanwhile(head, fit, *_, **__):
        codes.append(command(folder))
        return fit

    monkeypatch.setattr("stga_addon.tracking.fitted_head.fit_surface", meanwhile)
    assert command(folder) == 0
    assert codes == [2]
    own = f"out: another tracking is writing this capture (process {os.getpid()})"
    assert own in capsys.readouterr().err
    assert not (folder / "out/tracking.lock").exists()
    open_capture(folder / "out", folder / "head.npz")


def test_footage_without_a_face_leaves_nothing(tmp_path, monkeypatch):
    """Catches images and landmarks that stay where the footage is of no use, and a message that
    does not name it."""
    write_video(tmp_path / "landscape.mp4", range(0, 200, 50))
    bundled = HeadModel(flame_model(None), "flame")
    use_detector(monkeypatch, Detector([]), places_on(bundled, LANDMARKS))
    with refusal(r"landscape.mp4.*: shows no face, nor does any other of 4 frames"):
        perform(Track(tmp_path / "landscape.mp4", None, tmp_path / "out"))
    assert not (tmp_path / "out").exists()


def test_a_face_that_is_hardly_ever_found_is_no_capture(tmp_path, head, monkeypatch):
    """Catches a take of five timesteps that is written from one face, with exit code 0; and one
    that shows the face half of the time and is refused."""
    footage, places, points = numbered_take(tmp_path, head)
    model = tmp_path / "head.npz"

    def seen_at(*timesteps):
        return Detector(*([own] * (n % 5 in timesteps) for n, own in enumerate(points)))

    use_detector(monkeypatch, seen_at(3), places)
    message = r"is found at 1 of 5 timesteps, expected 33% .* crop the video to head and shoulders"
    with refusal(message):
        track(footage, model, tmp_path / "out", TrackingOptions(mattes=False))
    assert not (tmp_path / "out").exists()
    use_detector(
        monkeypatch,
        seen_at(0, 4),
        places,
    )
    found = track(footage, model, tmp_path / "out", TrackingOptions(mattes=False))
    assert any("no face at 3 of 5 timesteps" in warning for warning in found.warnings)


@pytest.mark.usefixtures("without_surface")
def test_pictures_of_a_head_are_tracked(tmp_path, head):
    """Catches a correspondence or a detector's convention that is off: everything from pixels,
    nothing given."""
    pytest.importorskip("cv2")
    shape = np.random.default_rng(1).normal(0, 0.5, head.model.n_identity)
    still = np.zeros(head.model.n_expression)
    frames = [replace(frame_at(head, t), expr=still) for t in range(2)]
    meshes = [flame_forward(head.model, shape, frame) for frame in frames]

    def picture(camera, timestep):
        return shaded_image(meshes[timestep], head.model.faces, camera)

    footage = write_footage(tmp_path / "footage", rig(5, 256), 2, picture)
    write_flame(head.model, tmp_path / "head.npz")
    result = track(open_footage(footage), tmp_path / "head.npz", tmp_path / "out")
    assert result.median_px < 3
    capture = open_capture(tmp_path / "out", tmp_path / "head.npz")
    face = head.model.masks["face"]
    for view in capture.views["train"]:
        pixels, _ = view.camera.project(capture.mesh(view.timestep)[face])
        expected, _ = rig(5, 256)[view.camera_index].project(meshes[view.timestep][face])
        assert np.median(np.linalg.norm(pixels - expected, axis=1)) < 5  # of a face of 120 pixels


def test_no_face_is_found_on_the_back_of_a_head(recorded, capsys, head):
    """Catches a head model without a face that is fitted all the same."""
    pytest.importorskip("cv2")
    folder, _ = recorded
    turned = replace(head.model, v_template=head.model.v_template * [-1, 1, -1])
    write_flame(turned, folder / "turned.npz")
    words = "track", folder / "footage", "--model", folder / "turned.npz", "--out", folder / "out"
    assert stga(*words) == 2
    assert re.search(r"turned\.npz: shows a face in . of 9 pictures", capsys.readouterr().err)
    assert not (folder / "out").exists()
