"""Footage tracked by the avatar of its person: another exposure, another size of the world."""

import json
import os
import shutil
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image
from scipy.spatial.transform import Rotation

from stga_addon.avatar.file import write_avatar
from stga_addon.capture.mesh_geometry import Similarity, rasterize
from stga_addon.capture.model import cameras_at_once
from stga_addon.capture.open import open_capture
from stga_addon.capture.takes import join_takes
from stga_addon.files import read_json, write_json
from stga_addon.progress import Cancelled
from stga_addon.render.render import render_avatar
from stga_addon.tracking.folder import (
    AVATAR_MISFIT,
    TorsoPoints,
    read_torso_points,
    write_torso_points,
)
from stga_addon.training.effects.facts import CaptureFacts
from stga_addon.training.effects.plan import depth_limits
from stga_addon.training.optimize.avatar_tracking import (
    normal_images,
)
from stga_addon.training.run.folder import AVATAR, Run, write_run
from stga_addon.training.run.recording import (
    avatar_person,
    cameras_of,
    move_capture,
    track_recording,
)
from stga_addon.worker.helpers import Helpers

from .heads import TIMESTEPS, parameters_of, tracked_as
from .test_avatar_tracking import millimeters
from .toys import one_camera, quick_settings

SCALE = 1.02
GAIN = 0.85
OFFSET = 12
SHADE = 0.3
IDENTITY = Similarity(1.0, np.eye(3), np.zeros(3))


def ignore(done, total):
    pass


@pytest.fixture
def recording(tmp_path, lost, person):
    """A run, and a capture that is darker, lit from a side, and in a world that is too large."""
    avatar, settings = person
    run = tmp_path / "run"
    root = tmp_path / "recording"
    run.mkdir()
    shutil.copytree(lost[0].root, root)
    write_run(run, Run(root, root / "model.npz", "vhap", settings))
    write_avatar(run / AVATAR, avatar)
    for view in (view for views in lost[0].views.values() for view in views):
        image, mask = (np.asarray(Image.open(path)) for path in (view.image, view.mask))
        mesh = lost[1][view.timestep]
        faces = lost[0].faces
        shown = rasterize(mesh, faces, view.camera)
        shade = 1 + SHADE * normal_images(mesh, faces, shown)[1][..., :1]
        darker = np.where(mask[..., None] > 0, image * GAIN * shade + OFFSET, image)
        Image.fromarray(np.clip(darker, 0, 255).astype(np.uint8)).save(root / view.name)
    report = {"image_misfit": {}, "meters_per_unit": 1.0, "in_order": True}
    write_json(root / "tracking.json", report)
    move_capture(root, root / "model.npz", SCALE, np.eye(3))
    write_torso_points(root, TorsoPoints(0, np.full((4, 3), SCALE)))
    return run, root


@pytest.mark.nightly
def test_another_recording_is_tracked(recording, lost):
    """Catches another exposure or light taken for a pose, a lost size, identity or offset."""
    run, root = recording
    before = json.loads((root / "transforms_train.json").read_text())["frames"]
    found = track_recording(run, root, Helpers(1), ignore)
    after = json.loads((root / "transforms_train.json").read_text())["frames"]
    places = [np.array(frame["transform_matrix"])[:3, 3] for frame in (before[0], after[0])]
    sizes = np.linalg.norm(places, axis=1)
    assert sizes[1] / sizes[0] == pytest.approx(1 / SCALE, abs=0.004)
    assert read_json(root / "tracking.json")["meters_per_unit"] == pytest.approx(1, abs=0.004)
    torso = read_torso_points(root)
    assert_allclose(torso.at, 1, atol=0.004)
    away = millimeters(open_capture(root, root / "model.npz"), lost[1])
    tracked = millimeters(*lost)
    assert np.median(away[:-1] / tracked[:-1]) < 0.4
    misfit = read_json(root / "tracking.json")["image_misfit"][AVATAR_MISFIT]
    assert sorted(misfit) == sorted(map(str, TIMESTEPS))
    assert found.misfit.max() < 0.2
    known, model = avatar_person(recording[0])
    fit = known.fit
    assert known.camera is None
    assert model == recording[1] / "model.npz"
    assert_allclose(fit.head.model.v_template, lost[0].neutral, atol=1e-9)
    assert fit.head.model.n_identity == 0
    assert len(fit.shape) == 4


@pytest.mark.usefixtures("hasty")
@pytest.mark.parametrize(("light_turns", "keeps_world"), [(0, False), (1, False), (0, True)])
def test_the_world_is_turned_as_the_avatars_was(light_turns, keeps_world, recording, lost, person):
    """Catches colors that are looked up in other directions than training saw them from, a world
    turned though its light was too, or though it is kept, and heads that do not turn with it."""
    run, root = recording
    avatar, settings = person
    turn = Rotation.from_rotvec([0.5, 0.2, 0])
    shutil.rmtree(root)
    shutil.copytree(lost[0].root, root)
    write_run(run, Run(lost[0].root, root / "model.npz", "vhap", settings))
    sh = np.full((len(avatar.splats.sh), 4, 3), 0.4, np.float32)  # brighter from one side
    sh[:, 0] = avatar.splats.sh[:, 0]
    shiny = replace(avatar, splats=replace(avatar.splats, sh=sh))
    write_avatar(run / AVATAR, shiny)
    moved = Similarity(1.0, turn.as_matrix(), np.zeros(3))
    for view in (view for views in lost[0].views.values() for view in views):
        world = moved if light_turns else IDENTITY
        mesh = world.apply(lost[1][view.timestep])
        camera = world.camera(view.camera)
        drawn = 255 * render_avatar(shiny, mesh, camera, settings.background)
        colors = np.clip(drawn.transpose(1, 2, 0), 0, 255).astype(np.uint8)
        Image.fromarray(colors).save(root / view.name)
    write_json(root / "tracking.json", {"meters_per_unit": 1.0, "in_order": True})
    capture = open_capture(root, root / "model.npz")
    before = {timestep: capture.mesh(timestep) for timestep in TIMESTEPS}
    move_capture(root, root / "model.npz", 1.0, turn.as_matrix())
    after = open_capture(root, root / "model.npz")
    for timestep in after.timesteps:
        expected = moved.apply(before[timestep])
        assert_allclose(after.mesh(timestep), expected, atol=2e-6)
    told = []

    def stop_once_turned(done, total):
        told.append(done)
        if len(told) == 2:
            raise Cancelled

    with pytest.raises(Cancelled):
        track_recording(run, root, Helpers(1), stop_once_turned, keeps_world)
    found = open_capture(root, root / "model.npz").views["train"][0].camera.world_to_camera
    first = lost[0].views["train"][0].camera.world_to_camera[:3, :3]
    stays = light_turns or keeps_world
    expected = first @ turn.inv().as_matrix() if stays else first
    assert_allclose(found[:3, :3], expected, atol=1e-5)


def test_another_person_is_missed(recording, hasty):
    """Catches a misfit that is small whatever the images show."""
    run, root = recording
    for path in (root / "images").iterdir():
        Image.fromarray(np.asarray(Image.open(path))[..., [1, 2, 0]]).save(path)
    found = track_recording(run, root, Helpers(1), ignore, keeps_world=True)
    assert np.median(found.misfit) > 0.4


def test_parts_of_another_avatar_are_not_taken(recording, tmp_path, monkeypatch):
    """Catches a cancelled tracking that begins anew, or goes on with another avatar's."""
    run, root = recording
    calls = []
    every = [1] * len(TIMESTEPS)
    twice = [len(TIMESTEPS)] * 2
    shutil.copytree(root, tmp_path / "start")

    def as_tracked(trained, capture, timesteps, *_):
        calls.append(len(timesteps))
        values = parameters_of(capture, timesteps)
        known = np.tile(np.eye(values.shape[1] + 3), (len(values), 1, 1))
        return tracked_as(timesteps, values, information=known)

    monkeypatch.setattr("stga_addon.training.run.recording.track_by_avatar", as_tracked)
    for trained_ns, expected in ((1, [*every, *twice]), (1, []), (2, [*every, *twice])):
        shutil.rmtree(root)
        shutil.copytree(tmp_path / "start", root)
        os.utime(run / AVATAR, ns=(trained_ns, trained_ns))
        calls.clear()
        track_recording(run, root, Helpers(1, tmp_path / "kept"), ignore, keeps_world=True)
        assert calls == expected


def test_a_phone_is_one_camera_in_all_its_takes(lost, person, tmp_path):
    """Catches an avatar of one phone that, extended by a second take, no longer tells the focal
    length of its camera and how the world is turned, and whose depth is left free."""
    first = lost[0]
    phone = one_camera(first)
    views = phone.views["train"]
    place = np.eye(4)
    place[:3, 3] = 0.02
    poses = [view.camera.world_to_camera @ place for view in views]
    again = tuple(
        replace(view, camera=replace(view.camera, fl_x=99.0, world_to_camera=pose))
        for view, pose in zip(views, poses, strict=True)
    )
    joined = join_takes([phone, replace(phone, views={"train": again})])
    every = joined.views["train"]
    assert len({view.camera_index for view in every}) == 2
    assert cameras_at_once(every) == 1
    assert cameras_at_once(first.views["train"]) == 4
    (camera,) = cameras_of(joined).values()
    assert camera == views[0].camera
    assert len(cameras_of(first)) > 1
    settings = quick_settings("global", lattice=0)
    for capture, is_one in ((joined, True), (first, False)):
        assert depth_limits(CaptureFacts(capture, settings)).on == is_one
