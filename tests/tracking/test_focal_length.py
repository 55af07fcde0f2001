"""Focal lengths of a single camera: stated by files, and estimated from landmarks."""

import struct
from dataclasses import replace

import numpy as np
import pytest
from flame.small_head import write_flame
from PIL import Image
from scipy.spatial.transform import Rotation

from stga_addon.capture.camera import camera_from_gl
from stga_addon.files import read_json, write_json
from stga_addon.flame.forward import FlameFrame, flame_forward
from stga_addon.tracking import focal_length
from stga_addon.tracking.fit import HeadFit, RecordedTake, TimestepLandmarks
from stga_addon.tracking.focal_length import estimated_focal
from stga_addon.tracking.folder import describe_focal_length
from stga_addon.tracking.footage.open import open_footage, sized, typical_focal
from stga_addon.tracking.footage.video import VideoFrames
from stga_addon.tracking.known_person import KnownPerson
from stga_addon.tracking.opened import TrackingOptions, open_take
from stga_addon.tracking.track import track

from .recording import write_points
from .scenes import write_image, write_video
from .test_fit import HERE, places_on

EQUIVALENT_MM = 28.0
WIDTH = 64
HEIGHT = 48
EXPECTED = EQUIVALENT_MM / np.hypot(36, 24) * 80
QUICKTIME_KEY = b"com.apple.quicktime.camera.focal_length.35mm_equivalent"


def write_photo(path, tags, size=(WIDTH, HEIGHT)):
    exif = Image.Exif()
    exif.get_ifd(0x8769).update(tags)
    Image.new("RGB", size).save(path, exif=exif)


# 6.4 mm wide at 4000 pixels: f = 4.8 mm is 3000 pixels there.
SENSOR = {0x920A: 4.8, 0xA002: 4000, 0xA003: 3000}


@pytest.mark.parametrize(
    ("tags", "expected"),
    [
        ({0xA405: 28}, EXPECTED),
        ({0xA405: 28, 0xA002: 4000, 0xA003: 3000}, EXPECTED),  # made smaller
        ({0xA405: 28, 0xA002: 3000, 0xA003: 4000}, EXPECTED),  # turned
        ({0xA405: 28, 0xA002: 4000, 0xA003: 2000}, None),  # cropped
        ({**SENSOR, 0xA20E: 4000 / 6.4 * 25.4, 0xA210: 2}, 3000 * WIDTH / 4000),
        ({**SENSOR, 0xA20E: 4000 / 6.4 * 10, 0xA210: 3}, 3000 * WIDTH / 4000),
        ({0x920A: 4.8}, None),
        ({0xA405: 0}, None),
        ({}, None),
    ],
)
def test_focal_length_of_photos(tmp_path, tags, expected):
    """Catches a photo's lens that is not read, is related to the wrong side, or survives a crop."""
    write_photo(tmp_path / "a.jpg", tags)
    footage = open_footage(tmp_path)
    camera = footage.cameras[0].camera
    focal = pytest.approx(expected or typical_focal(WIDTH, HEIGHT), rel=2e-3)
    assert camera.fl_x == camera.fl_y == focal
    assert footage.focal == ("file" if expected else "usual")
    assert open_footage(tmp_path, focal=50.0).cameras[0].camera.fl_x == 50


def box(kind, content):
    return struct.pack(">I4s", 8 + len(content), kind) + content


def with_metadata(path, value, kind, where, versioned):
    """Append QuickTime's metadata to the movie or to its track, behind whose boxes nothing lies
    that they point to."""
    hdlr = box(b"hdlr", bytes(8) + b"mdta" + bytes(13))
    names = [b"com.apple.quicktime.camera.lens_model", QUICKTIME_KEY]
    listed = b"".join(box(b"mdta", name) for name in names)
    data = (1, 1, b"\0\0\0\0"), (2, kind, bytes(4) + value)
    items = [
        box(struct.pack(">I", number), box(b"data", struct.pack(">I", own) + content))
        for number, own, content in data
    ]
    keys = box(b"keys", struct.pack(">II", 0, len(names)) + listed)
    meta = box(b"meta", bytes(4 * versioned) + hdlr + keys + box(b"ilst", b"".join(items)))
    data = bytearray(path.read_bytes())
    holders = []
    start = 0
    for name in (b"moov", b"trak")[: 1 + (where == "trak")]:
        while data[start + 4 : start + 8] != name:
            start += struct.unpack_from(">I", data, start)[0]
        holders.append(start)
        start += 8
    end = holders[-1] + struct.unpack_from(">I", data, holders[-1])[0]
    data[end:end] = meta
    for holder in holders:
        struct.pack_into(">I", data, holder, struct.unpack_from(">I", data, holder)[0] + len(meta))
    path.write_bytes(data)


@pytest.mark.parametrize("where", ["moov", "trak"])
@pytest.mark.parametrize(
    ("name", "value", "kind"),
    [
        ("a.mov", b"28", 1),
        ("a.mov", b"28.00mm", 1),
        ("a.mov", struct.pack(">i", 28), 21),
        ("a.mp4", struct.pack(">f", 28), 23),
        ("a.mp4", struct.pack(">d", 28), 24),
    ],
)
def test_focal_length_of_videos(tmp_path, name, value, kind, where):
    """Catches a phone's lens that is not read, as by FFmpeg, which leaves out the metadata of
    tracks."""
    av = pytest.importorskip("av")
    path = tmp_path / name
    write_video(path, [60, 90, 120], size=(WIDTH, HEIGHT))
    with_metadata(path, value, kind, where, versioned=name.endswith("mp4"))
    with av.open(str(path)) as container:
        assert sum(1 for _ in container.decode(video=0)) == 3
    footage = open_footage(path)
    assert footage.focal == "file"
    assert footage.cameras[0].camera.fl_x == pytest.approx(EXPECTED, rel=1e-3)


def test_damaged_metadata(tmp_path):
    """Catches a traceback, or an endless loop, for tags that are cut off or no numbers."""
    pytest.importorskip("av")
    values = [(b"", 1), (b"..", 1), (b"\0", 23), (b"\xff\xff\xff\xff", 23), (b"-3", 1)]
    for number, (value, kind) in enumerate(values):
        path = tmp_path / f"{number}/a.mov"
        write_video(path, [60, 90, 120], size=(WIDTH, HEIGHT))
        with_metadata(path, value, kind, "trak", versioned=False)
        assert open_footage(path).focal == "usual"
    write_image(tmp_path / "photo/a.jpg")
    whole = (tmp_path / "photo/a.jpg").read_bytes()
    exif = b"\xff\xe1\x00\x10Exif\0\0MM\0*\0\0\0\x08"
    (tmp_path / "photo/a.jpg").write_bytes(whole[:2] + exif + whole[2:])
    assert open_footage(tmp_path / "photo").focal == "usual"


@pytest.fixture
def few_landmarks(monkeypatch):
    """Half as many landmarks are compared, which takes a quarter of the time."""
    monkeypatch.setattr(focal_length, "LANDMARKS", 40)


def turning(head, focal, turn_deg, size=(1080, 1920), count=30, ahead_deg=0.0):
    """Places, and landmarks of a head that turns that far to either side of where it looks, 0.6 m
    before a camera.

    Each landmark lies 2 mm beside its place on the model, in all frames alike, as a detector's do.
    """
    rng = np.random.default_rng(3)
    places = places_on(head, 300)
    shape = rng.normal(0, 0.7, head.model.n_identity)
    own = rng.normal(0, 0.002, (300, 3))
    typical = typical_focal(*size)
    (width, height) = size
    camera, guessed = (
        camera_from_gl(np.eye(4), size, (f, f), (width / 2, height / 2)) for f in (focal, typical)
    )
    take = {}
    for timestep, share in enumerate(np.sin(np.linspace(0, 7, count))):
        angle = np.radians(ahead_deg + turn_deg * share)
        expression = np.zeros(head.model.n_expression)
        expression[timestep % 3] = 0.5
        zero = np.zeros(3)
        moved = np.array([0.02 * share, 0.0, -0.6])
        pose = np.array([0.1 * share**2, angle, 0.0])
        frame = FlameFrame(expression, pose, zero, zero, moved, np.zeros(6))
        turn = Rotation.from_rotvec([0, angle, 0]).as_matrix()
        points = places.on(flame_forward(head.model, shape, frame), head.model.faces) + own @ turn.T
        pixels = camera.project(points)[0] + rng.normal(0, width / 1080, (300, 2))
        take[timestep] = TimestepLandmarks((guessed,), pixels[None], np.ones((1, 300)))
    return places, take


@pytest.mark.parametrize(("factor", "turn_deg"), [(0.8, 30), (1.6, 7)])
def test_focal_length_of_a_head_that_turns(head, factor, turn_deg):
    """Catches a head that is taken for one at a phone's distance: its depth would be that much too
    large or small; and, of people who sit still, the shape of a face taken for perspective, or a
    narrow interval that does not hold the truth."""
    truth = factor * typical_focal(1080, 1920)
    places, take = turning(head, truth, turn_deg)
    found = estimated_focal(head, RecordedTake(places, np.ones(300, bool), take))
    assert turn_deg < found.turn_deg < 2 * turn_deg + 5
    assert found.low < truth < found.high
    if turn_deg == 30:
        assert found.pixels == pytest.approx(truth, rel=0.15)
    else:
        assert 0.75 * truth < found.pixels < 2 * truth
        assert found.high > 1.5 * found.low


def test_off_axis_faces_have_no_vote(head):
    """Catches a focal length by landmarks of profiles, where networks err: 0.35 of a real one."""
    places, take = turning(head, 1.6 * typical_focal(1080, 1920), 15, count=8)
    off_axis = turning(head, 1.6 * typical_focal(1080, 1920), 15, count=8, ahead_deg=60)[1]
    middle = np.array([540, 960])
    for timestep, landmarks in off_axis.items():
        beside = (landmarks.points - middle) * [1.3, 1] + middle
        take[8 + timestep] = replace(landmarks, points=beside)
    every = np.ones(300, bool)
    expected = estimated_focal(head, RecordedTake(places, every, {t: take[t] for t in range(8)}))
    found = estimated_focal(head, RecordedTake(places, every, take))
    assert found.turn_deg > 50 > expected.turn_deg
    assert replace(found, turn_deg=0) == replace(expected, turn_deg=0)
    alone = {t: take[t] for t in range(8, 16)}
    phone = typical_focal(1080, 1920)
    prior = estimated_focal(head, RecordedTake(places, every, alone))
    assert prior.low < 2 * phone < 5 * phone < prior.high


SIZE = (108, 192)
COUNT = 6


def film(folder, head, turn_deg):
    """A video, head.npz and points of a head that turns so far before a lens of 1.6 times a
    phone's focal length."""
    pytest.importorskip("av")
    places, take = turning(head, 1.6 * typical_focal(*SIZE), turn_deg, SIZE, COUNT)
    write_video(folder / "phone.mp4", range(60, 60 + 10 * COUNT, 10), size=SIZE, gop=COUNT)
    write_flame(head.model, folder / "head.npz")
    points = np.concatenate([take[t].points for t in range(COUNT)])
    write_points(folder / "points", places, {"phone": points})


@pytest.mark.usefixtures("few_landmarks")
def test_a_lens_that_nothing_tells_is_that_of_the_avatars_camera(tmp_path, head):
    """Catches the perspective of a phone where the person was filmed before, and another
    resolution taken for another lens."""
    film(tmp_path, head, 3)
    footage = open_footage(tmp_path / "phone.mp4")
    (width, height) = SIZE
    likely = camera_from_gl(np.eye(4), (2 * width, 2 * height), (600, 600), (width, height))
    inputs = footage, tmp_path / "head.npz", tmp_path / "out"
    fit = HeadFit(head, np.zeros(0), {}, HERE)
    known = KnownPerson(fit, likely, lambda mesh, camera: np.zeros((1, 1, 3), np.uint8))
    found = track(*inputs, TrackingOptions(tmp_path / "points", mattes=False, person=known))
    assert (found.focal_length.source, found.focal_length.pixels) == ("avatar", 300)
    assert any("focal length is an estimate" in warning for warning in found.warnings)


@pytest.mark.usefixtures("few_landmarks")
def test_a_phones_video_is_decoded_once_and_its_lens_is_told(tmp_path, head, monkeypatch):
    """Catches a video that is decoded for each stage, backwards or by seeking, and an estimated
    focal length that the capture does not have."""
    film(tmp_path, head, 30)
    # no helping processes, whose decoders would not be seen
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    decoded = []
    decode = VideoFrames._frame

    def decode_and_note(self, number):
        decoded.append(number)
        return decode(self, number)

    monkeypatch.setattr(VideoFrames, "_frame", decode_and_note)
    footage = open_footage(tmp_path / "phone.mp4")
    out = tmp_path / "out"
    found = track(
        footage, tmp_path / "head.npz", out, TrackingOptions(tmp_path / "points", mattes=False)
    )
    assert decoded == list(range(COUNT))
    assert found.focal_length.source == "estimated"
    (low, high) = found.focal_length.interval_px
    assert low < 1.6 * typical_focal(*SIZE) < found.focal_length.pixels < high
    report = read_json(tmp_path / "out/tracking.json")
    assert report["focal_length_px"] == found.focal_length.pixels
    assert report["focal_length_from"] == "estimated"
    frame = read_json(tmp_path / "out/transforms_train.json")["frames"][4]
    assert frame["fl_x"] == pytest.approx(found.focal_length.pixels, abs=0.05)
    written = np.asarray(Image.open(tmp_path / "out" / frame["file_path"]))
    np.testing.assert_array_equal(written, footage.cameras[0].image(4))


def test_resized_frames_of_a_video_are_decoded_once(tmp_path, head, monkeypatch):
    """Catches a quick look's video that is decoded anew in each stage."""
    film(tmp_path, head, 30)
    footage = sized(open_footage(tmp_path / "phone.mp4"), 0.5)
    opened = open_take(footage, tmp_path / "head.npz", tmp_path / "out", TrackingOptions())
    camera = opened.footage.cameras[0]
    image = camera.image(4)
    np.testing.assert_array_equal(image, footage.cameras[0].image(4))
    monkeypatch.setattr(VideoFrames, "_frame", lambda *_: pytest.fail("was decoded again"))
    np.testing.assert_array_equal(camera.image(4), image)


@pytest.mark.parametrize(
    ("source", "interval", "expected"),
    [
        ("solved", None, "924 px, solved from the turns of the head"),
        ("usual", None, "924 px, that of a phone"),
        ("estimated", [465.2, 1518.0], "465 to 1518 px with a probability of 90 %"),
    ],
)
def test_reports_of_earlier_versions_are_described(tmp_path, source, interval, expected):
    """Catches captures of earlier versions that are refused by what told their focal length, and an
    interval that is not said."""
    values = {"focal_length_px": 924.3, "focal_length_from": source}
    if interval is not None:
        values["focal_length_interval_px"] = interval
    write_json(tmp_path / "tracking.json", values)
    assert expected in describe_focal_length(tmp_path)
    write_json(tmp_path / "tracking.json", {"focal_length_px": None, "in_order": True})
    assert describe_focal_length(tmp_path) == ""
