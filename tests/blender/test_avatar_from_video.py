"""Avatar from Video: its request, its folder, and its way to splats on a head."""

import sys
from functools import partial
from importlib import import_module

import bpy
import numpy as np
import pytest

pytest.importorskip("av")
pytest.importorskip("cv2")

from tracking.head_video import write_head_video

from stga_addon.scene import tags
from stga_addon.scene.display import splat_nodes
from stga_addon.scene.display.splat_object import get_input, set_input

from .session import failure, ops, panel, save


@pytest.fixture
def video(tmp_path):
    path = tmp_path / "anna.mp4"
    path.write_bytes(b"video")
    return path


@pytest.fixture
def asked(extension, monkeypatch):
    """The requests that the operator starts, which are not carried out."""
    requests = []
    start = lambda scene, request, python: requests.append(request)  # noqa: E731
    monkeypatch.setattr(extension.operators.track, "start", start)
    return requests


def begin(requests):
    """What the worker writes first."""
    jobs = import_module(type(requests[-1]).__module__)
    request = requests[-1]
    request.out.mkdir(parents=True, exist_ok=True)
    jobs.write_json(request.out / jobs.INPUTS, jobs._inputs(request.track))
    perform = import_module(jobs.__name__.replace(".track", ".perform"))
    perform.write_request(perform.request_folder(request.out), request)


def test_it_is_the_request_of_the_command_line(extension, asked, video, tmp_path, monkeypatch):
    """Catches other settings than `stga avatar VIDEO`, a dropped video that starts nothing, and a
    quick look that goes on as another avatar."""
    out = tmp_path / "out"
    opened = list[bool]()
    show_panel = lambda: opened.append(True)  # noqa: E731
    monkeypatch.setattr(extension.operators.track, "show_panel", show_panel)
    ops.avatar_from_video(filepath=video, folder=out, minutes=0.05, focal=2308.3)
    main, commands = (
        import_module(f"{extension.__name__}.stga_addon.cli.{name}")
        for name in ("main", "commands")
    )
    made = []
    monkeypatch.setattr(commands, "carry_out", made.append)
    options = ["--out", str(out), "--budget", "3s", "--focal", "2308.3", "--no-blend"]
    assert main.main(["avatar", str(video), *options]) == 0
    assert asked == made
    look = tmp_path / "look"
    ops.avatar_from_video(filepath=video, folder=look, quick=True)
    assert main.main(["avatar", str(video), "--out", str(look), "--quick", "--no-blend"]) == 0
    assert asked == made
    assert (made[1].track.most, made[1].track.size) == (16, 0.5)
    begin(asked)
    ops.avatar_from_video(folder=look)  # continues
    assert asked[2] == asked[1]
    assert opened == [True] * 3


def test_the_folder_is_proposed_beside_the_file(asked, video, tmp_path):
    """Catches an avatar continued with another video or begun anew, and a folder far away."""

    def make(path):
        ops.avatar_from_video(filepath=path)
        return asked[-1].out

    assert make(video) == tmp_path / "anna avatar"
    (tmp_path / "anna avatar/run").mkdir(parents=True)  # of somebody else
    assert make(video) == tmp_path / "anna avatar 2"
    begin(asked)
    assert make(video) == tmp_path / "anna avatar 2"
    other = tmp_path / "shots/anna.mp4"
    other.parent.mkdir()
    other.touch()
    save(tmp_path / "head.blend")
    assert make(other) == tmp_path / "anna avatar 3"


def test_what_was_begun_is_continued_by_its_folder(asked, video, tmp_path):
    """Catches a Continue that asks for the video again, or has other options or time."""
    ops.avatar_from_video(filepath=video, focal=900.0, minutes=20)
    begin(asked)
    folder = str(tmp_path / "anna avatar")
    ops.avatar_from_video("INVOKE_DEFAULT", folder=folder)
    assert asked[1] == asked[0]
    ops.avatar_from_video(folder=folder, minutes=2)
    assert asked[2].train.settings.seconds == 120


def test_mistakes_are_sentences(extension, video, tmp_path, monkeypatch):
    """Catches a worker started for nothing, and another video's request in a folder."""
    with failure(r"gone\.mp4: is not a file; expected a video"):
        ops.avatar_from_video(filepath=tmp_path / "gone.mp4")
    (tmp_path / "out/capture").mkdir(parents=True)
    (tmp_path / "out/inputs.json").write_text('{"footage": "/shots/ben.mp4", "model": null}')
    with failure(r"footage: .*out began with .*ben\.mp4"):
        ops.avatar_from_video(filepath=video, folder=tmp_path / "out", python=sys.executable)


@pytest.mark.slow
def test_from_a_video_to_splats_on_the_head(extension, tmp_path, monkeypatch):
    """Catches a head, splats, picture or run that does not arrive, or is another's; and what was
    not filmed, which is not shown once, or again at every result."""
    pytest.importorskip("torch")
    tracks = extension.operators.track
    effects = {"relight": "off", "tracking": "off"}  # which take longer than the training
    quick = partial(tracks.make_settings, "global", seconds=1.0, effects=effects)
    monkeypatch.setattr(tracks, "make_settings", lambda *_, **__: quick())
    video = tmp_path / "head.mp4"
    focal = write_head_video(video, 3)
    ops.avatar_from_video(filepath=video, focal=focal, python=sys.executable)
    settings = panel()
    out = tmp_path / "head avatar"
    assert settings.head[tags.CAPTURE] == str(out / "capture")
    assert settings.head[tags.RUN] == settings.run_folder == str(out / "run")
    assert (settings.avatar, settings.avatar_shown) == (str(out / "run/avatar.npz"), True)
    assert not settings.head.visible_get()
    assert get_input(settings.splats, splat_nodes.SHOW_UNSEEN)
    set_input(settings.splats, splat_nodes.SHOW_UNSEEN, False)
    with np.load(out / "job/picture.npz") as stored:
        assert stored["rgb"].std() > 10
    pixels, *_ = extension.operators.monitor.curves[out / "run"]
    assert pixels.shape == (256, 256, 4)
    # Again: nothing is left to do but to show it
    ops.avatar_from_video(filepath=video, focal=focal, python=sys.executable)
    heads = [thing for thing in bpy.data.objects if thing.get(tags.KIND) == tags.HEAD]
    assert heads == [settings.head]
    assert not get_input(settings.splats, splat_nodes.SHOW_UNSEEN)
