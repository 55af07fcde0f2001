"""Several takes of one person: which they are, and whose head they are tracked with."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from refusal import refusal

from stga_addon.capture.open import open_capture
from stga_addon.jobs import track as jobs
from stga_addon.jobs.track import MakeAvatar, Track
from stga_addon.jobs.train import Train
from stga_addon.progress import ignore
from stga_addon.tracking.footage.open import open_footage
from stga_addon.tracking.footage.takes import takes_in
from stga_addon.tracking.opened import TrackingOptions
from stga_addon.tracking.reprojection import check_cameras, misread_cameras
from stga_addon.tracking.track import track as track_footage
from stga_addon.training.settings import make_settings

from .recording import record


def lay_out(folder, *names):
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".png":
            Image.fromarray(np.zeros((2, 2, 3), np.uint8)).save(path)
        else:
            path.write_bytes(b"")
    return folder


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (["around.mp4", "talk.mov"], ["around.mp4", "talk.mov"]),
        (["photos/1.png", "photos/2.png", "talk.mp4"], ["photos", "talk.mp4"]),
        (["talk.mp4"], ["."]),
        (["1.png", "2.png"], ["."]),
        (["1.png", "talk.mp4"], "put the images into a folder of their own"),
    ],
)
def test_takes_in_a_folder(tmp_path, names, expected):
    """Catches photos or a video that is forgotten, one camera's images torn into takes, and two
    videos that are taken for a rig without a calibration."""
    folder = lay_out(tmp_path / "anna", *names)
    if isinstance(expected, str):
        with refusal(expected):
            takes_in(folder)
        return
    assert [path.relative_to(folder) for path in takes_in(folder)] == [*map(Path, expected)]


def test_a_calibrated_rig_is_one_take(tmp_path, head):
    """Catches a rig whose cameras are taken for takes of their own."""
    record(tmp_path, head)
    assert takes_in(tmp_path / "footage") == [tmp_path / "footage"]


def test_a_misread_face_does_not_refuse_a_walk(tmp_path, head, without_surface, monkeypatch):
    """Catches a walk around a head that is refused for one image whose landmarks are wrong, or
    whose head is bent by it; of calibrated cameras, one that does not fit is still refused."""
    monkeypatch.setattr("stga_addon.tracking.fitted_head.fit_dense", lambda *_, **__: None)
    record(tmp_path, head)
    options = TrackingOptions(landmarks=tmp_path / "points", mattes=False)
    footage = open_footage(tmp_path / "footage")
    found = replace(footage, finds_cameras=True)
    sound = track_footage(found, tmp_path / "head.npz", tmp_path / "sound", options)
    path = tmp_path / "points/cam3.npz"
    arrays = dict(np.load(path))
    np.savez(path, **{**arrays, "points": arrays["points"] + [9.0, 0.0]})
    with refusal("camera cam3: its landmarks are off by"):
        track_footage(footage, tmp_path / "head.npz", tmp_path / "refused", options)
    again = track_footage(found, tmp_path / "head.npz", tmp_path / "again", options)
    assert "landmarks are misread, and not used, in images of: cam3" in again.warnings
    assert again.median_px == pytest.approx(sound.median_px, abs=0.05)
    assert sound.warnings == tuple(w for w in again.warnings if "misread" not in w)


def test_a_camera_that_would_be_refused_is_misread():
    """Catches a walk around a head that is refused for landmarks that hardly miss the limit: of
    five cameras, the fifth is 4.7 times as far off as the others' median, and 3.5 times as far as
    that of all."""
    fractions = {"a": 0.01, "b": 0.01, "c": 0.02, "d": 0.02, "e": 0.07}
    errors = {name: {0: (100 * own, own)} for name, own in fractions.items()}
    assert misread_cameras(errors) == ["e"]
    with refusal("camera e: its landmarks are off by 7 pixels"):
        check_cameras(errors)
    check_cameras({name: own for name, own in errors.items() if name != "e"})


def asked(out, footage, **more):
    track = Track(footage[0], None, out / "capture", **more)
    train = Train(out / "run", out / "capture", make_settings(iterations=3))
    return MakeAvatar(track, train, tuple(footage[1:]))


@pytest.mark.parametrize(
    ("take", "kinds", "order"),
    [
        ("auto", ["talk", "around", "talk"], ["capture_2", "capture", "capture_3"]),
        ("auto", ["around", "talk", "talk"], ["capture_2", "capture", "capture_3"]),
        ("auto", ["talk", "talk", "talk"], ["capture", "capture_2", "capture_3"]),
        ("auto", ["around", "around", "talk"], ["capture_2", "capture_3", "capture"]),
        ("around", None, ["capture_2", "capture", "capture_3"]),
        ("talk", None, ["capture", "capture_2", "capture_3"]),
    ],
)
def test_the_order_of_takes(tmp_path, monkeypatch, take, kinds, order):
    """Catches a head that is sought in a talk although it was filmed all around, an avatar that
    plays a still head, a word that does not decide, a take that is recognized twice, and an order
    that changes when it goes on."""
    names = ["a/1.png", "b/1.png", "c/1.png"]
    folder = lay_out(tmp_path, *names)
    footage = [folder / name for name in "abc"]
    found = iter(kinds or ())
    monkeypatch.setattr("stga_addon.tracking.around.take_of", lambda *_: (next(found), "so"))
    request = asked(tmp_path / "out", footage, take=take)
    jobs.write_json(request.out / jobs.INPUTS, jobs._inputs(request.track, request.takes))
    said = []
    for _ in range(2):
        planned = jobs._planned(request, ignore, said.append)
        assert {why for _, (_, why) in planned} == {"so" if kinds else ""}
        tracks = [own for own, _ in planned]
        assert [own.out.name for own in tracks] == order
        first, *others = tracks
        assert first.avatar is None
        assert {own.avatar for own in others} == {first.out}
    assert len(said) == len(kinds or ())
    jobs.check_inputs(request.track, request.takes)
    with refusal("takes: .*out began with"):
        jobs.check_inputs(request.track, request.takes[:1])


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ({"focal": 900.0}, "--focal: is of one take, but 2 are given"),
        ({"mattes": "masks"}, "--mattes: a folder is of one take"),
    ],
)
def test_options_of_one_take(tmp_path, more, says):
    """Catches a lens or masks of one take that silently serve for all, and a take given twice."""
    with refusal(says):
        asked(tmp_path, [Path("a.mp4"), Path("b.mp4")], **more).check()
    with refusal("a.mp4: is given twice"):
        asked(tmp_path, [Path("a.mp4"), Path("b.mp4"), Path("./a.mp4")]).check()


def test_a_talk_has_the_head_of_the_capture(tmp_path, head, without_surface, monkeypatch):
    """Catches a take that makes a head of its own, so that the takes do not train together."""
    monkeypatch.setattr("stga_addon.tracking.fitted_head.fit_dense", lambda *_, **__: None)
    meshes = record(tmp_path, head)
    given = {"footage": tmp_path / "footage", "landmarks": tmp_path / "points", "mattes": "none"}
    rig, again = (tmp_path / name for name in ("rig", "again"))
    model = tmp_path / "head.npz"
    jobs.track(Track(model=model, out=rig, **given), ignore, lambda line: None)
    offset = np.zeros((len(meshes[0]), 3), np.float32)
    offset[:, 2] = 0.004  # what no shape of the model has
    for path in [rig / "canonical_flame_param.npz", *sorted((rig / "flame_param").glob("*.npz"))]:
        arrays = dict(np.load(path))
        np.savez(path, **{**arrays, "static_offset": offset})
    person = open_capture(rig, model)
    request = Track(model=model, out=again, avatar=rig, **given)
    jobs.track(request, ignore, lambda line: None)
    found = open_capture(again, model)
    np.testing.assert_allclose(found.neutral, person.neutral, atol=1e-6)
    assert json.loads((again / "tracking.json").read_text())["in_order"] is not None
    assert not (again / "unfinished").exists()
    for timestep in found.timesteps:
        apart = np.linalg.norm(found.mesh(timestep) - person.mesh(timestep), axis=1)
        assert apart.mean() < 0.004
