"""Render Video in background mode, and videos that Blender draws and encodes itself."""

import errno
import gc
import io
import os
import sys
import tempfile
from dataclasses import replace

import av
import bpy
import numpy as np
import pytest
from avatar.conftest import splats_of
from capture.factory import write_mesh_capture
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

from stga_addon.avatar.file import write_avatar
from stga_addon.capture.camera import Camera
from stga_addon.errors import StgaError
from stga_addon.export.ply import write_ply
from stga_addon.jobs.table import Kind
from stga_addon.raster.cpu.compose import compose
from stga_addon.raster.posed_splats import ComposedImage
from stga_addon.render.video import check_output
from stga_addon.scene.record import capture_of
from stga_addon.scene.render import drawn_video
from stga_addon.scene.render.drawn_video import DrawnVideo, png_bytes

from .session import failure, ops, panel, picture
from .test_engine import veil_before
from .test_operators import write_ball_avatar
from .test_splat_object import active_camera


@pytest.fixture
def shown(extension, tmp_path):
    """A scene of three frames that shows an avatar on the moving ball."""
    ops.import_capture(directory=write_mesh_capture(tmp_path / "capture", range(3), range(3)))
    avatar = write_ball_avatar(tmp_path / "avatar.npz")
    colors = default_rng(1).normal(0, 1.5, avatar.splats.sh.shape).astype(np.float32)
    write_avatar(tmp_path / "avatar.npz", replace(avatar, splats=replace(avatar.splats, sh=colors)))
    ops.show_avatar(filepath=tmp_path / "avatar.npz")
    render = bpy.context.scene.render
    render.resolution_percentage = 200
    render.fps = 10
    render.film_transparent = True
    bpy.context.scene.frame_set(1)
    return tmp_path


@pytest.fixture(autouse=True)
def temporary(tmp_path, monkeypatch):
    """The folder of temporary files; whatever happens, nothing is left in it."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    yield folder
    assert not list(folder.glob("stga_video_*"))


def engine_image(frame, path):
    """The frame as the render engine writes it, (H, W, 4) uint8."""
    bpy.context.scene.frame_set(frame)
    return picture(path, "STGA_SPLATS")


def around_each_image(extension, monkeypatch, before, after):
    """Call `before()` and `after()` around the recording of every image."""
    operator = extension.operators.render_video.RenderVideo
    own = operator.record

    def record(*arguments):
        steps = own(*arguments)
        yield next(steps)
        before()
        for _ in steps:
            after()
            yield
            before()

    monkeypatch.setattr(operator, "record", record)


def test_image_sequence_of_the_scene(extension, shown, monkeypatch):
    """Catches another camera, size, frame, transparency or scene than the engine's, splats of every
    recorded frame that stay in memory until the video is rendered, and the time that recording
    takes told as that of the video."""
    own = bpy.context.scene
    render = {"path": "scene", "format": "png"}
    ops.render_video(filepath=shown / "images", **render)
    assert own.frame_current == 1
    written = sorted((shown / "images").glob("*.png"))
    assert [path.name for path in written] == ["0001.png", "0002.png", "0003.png"]
    other = bpy.data.scenes.new("other")
    other.frame_set(7)
    window = bpy.context.window_manager.windows[0]
    posed = extension.operators.render_video.PosedSplats
    counts = []
    figures = []
    writer = extension.stga_addon.worker.status.StatusWriter

    def report(writer, progress, own=writer.report):
        figures.append(progress.figures())
        return own(writer, progress)

    def count():
        gc.collect()
        # Not isinstance, which raises for a weak proxy whose object has gone.
        counts.append(sum(type(each) is posed for each in gc.get_objects()))

    monkeypatch.setattr(writer, "report", report)
    look = lambda: setattr(window, "scene", other)  # noqa: E731
    around_each_image(extension, monkeypatch, look, count)
    try:
        ops.render_video(filepath=shown / "beside", **render)
        assert window.scene == other
        assert (own.frame_current, other.frame_current) == (1, 7)
    finally:
        window.scene = own
    assert len(counts) == 3
    assert [np.isnan(each["left_s"]) for each in figures[1:4]] == [True, True, True]
    assert 0 < max(counts) <= 2
    for frame, path in enumerate(written):
        image = np.asarray(Image.open(path)).astype(int)
        assert_array_equal(image, np.asarray(Image.open(shown / "beside" / path.name)))
        expected = engine_image(frame, shown / "engine.png")
        opaque = (expected[..., 3] > 250) & (image[..., 3] > 250)
        assert opaque.mean() > 0.1
        assert np.abs(image - expected)[opaque].max() <= 2
        assert np.abs(image[..., 3] - expected[..., 3]).max() <= 1


@pytest.mark.parametrize("is_drawn", [False, True])
@pytest.mark.parametrize("transparent", [False, True])
def test_holdouts(extension, shown, transparent, is_drawn, monkeypatch):
    """Catches objects that mask what is behind them in F12's images and are seen in a video's."""
    scene = bpy.context.scene
    scene.frame_end = scene.frame_start
    scene.render.film_transparent = transparent
    veil_before(scene.camera).is_holdout = True
    expected = engine_image(scene.frame_start, shown / "engine.png")
    assert expected[..., 3].min() < 128 < 250 < expected[..., 3].max()
    if is_drawn:  # as the GPU draws it, by the rasterizer
        video = extension.operators.render_video
        monkeypatch.setattr(video, "has_training_python", lambda _: False)
        monkeypatch.setattr(video, "has_gpu_context", lambda: True)

        def draw(layers, view):
            posed = [layer.posed(view.camera.position) for layer in layers]
            return compose(posed, view.camera)

        monkeypatch.setattr(extension.stga_addon.scene.render.drawn_video, "draw_image", draw)
    ops.render_video(filepath=shown / "images", path="scene", format="png")
    image = np.asarray(Image.open(shown / "images/0001.png")).astype(int)
    seen = expected[..., 3] > 25
    assert np.abs(image - expected)[seen].max() <= 3
    assert np.abs(image[..., 3] - expected[..., 3]).max() <= 1


def test_undo_and_a_removed_scene_meanwhile(extension, shown, monkeypatch, temporary):
    """Catches references to scene, view layer or head, which undo makes invalid: a video that ends
    with an error, its recorded images deleted; and files of one whose scene is gone."""
    operator = extension.operators.render_video
    recorded = []
    started = []

    class Recorder(operator.Recorder):
        def add(self, layers, camera):
            recorded.append(layers[0].frames.origin[:, 0].mean())

    monkeypatch.setattr(operator, "Recorder", Recorder)
    monkeypatch.setattr(operator, "start", lambda *arguments: started.append(arguments[1].images))
    bpy.ops.ed.undo_push(message="before")
    panel().head.location.x = 5
    bpy.ops.ed.undo_push(message="moved")

    def undo():
        if panel().head.location.x:
            bpy.ops.ed.undo()
            bpy.context.scene.name = "renamed"

    with monkeypatch.context() as patch:
        around_each_image(extension, patch, lambda: None, undo)
        ops.render_video(filepath=shown / "meanwhile", path="scene", format="png")
    assert np.round(recorded).tolist() == [5, 0, 0]
    assert started == [3]
    assert bpy.context.scene.frame_current == 1
    other = bpy.data.scenes.new("other")

    def remove():
        if "renamed" in bpy.data.scenes:
            bpy.context.window_manager.windows[0].scene = other
            bpy.data.scenes.remove(bpy.data.scenes["renamed"])

    around_each_image(extension, monkeypatch, lambda: None, remove)
    with failure("renamed: was removed meanwhile"):
        ops.render_video(filepath=shown / "gone", path="scene", format="png")


def test_turntable_video(shown):
    """Catches a turntable that stands still, lasts another time, or ends without its file."""
    ops.render_video(filepath=shown / "turn", seconds=1.5)
    with av.open(str(shown / "turn.mp4")) as container:
        assert container.streams.video[0].average_rate == 10
        frames = container.decode(video=0)
        images = [frame.to_ndarray(format="rgb24").astype(int) for frame in frames]
    assert len(images) == 15
    assert np.abs(images[0] - images[4]).max() > 40
    (video,) = [video for video in shown.iterdir() if video.suffix == ".mp4"]
    assert video.name == "turn.mp4"


def test_turntable_of_a_ply(extension, tmp_path):
    """Catches a turntable that needs a head, or turns about splats far away."""
    rng = default_rng(0)
    xyz = rng.normal((3, 1, 0), 0.1, (200, 3))
    xyz[0] = 1e4
    write_ply(tmp_path / "scan.ply", splats_of(xyz, opacity=3, sh=1.5))
    ops.import_ply(filepath=tmp_path / "scan.ply")
    scene = bpy.context.scene
    active_camera((3, -1, 1)).rotation_euler = (np.pi / 2, 0, 0)
    scene.render.resolution_percentage = 5
    scene.frame_end = 3
    ops.render_video(filepath=tmp_path / "turn", format="png", seconds=0.5)
    paths = sorted((tmp_path / "turn").glob("*.png"))
    images = [np.asarray(Image.open(path)).astype(int) for path in paths]
    assert len(images) == 12
    shown = [(image[..., :3].max(2) > image[0, 0, :3].max() + 20).mean() for image in images]
    assert min(shown) > 0.5 * max(shown) > 0


def test_failures_leave_no_job(extension, shown, monkeypatch):
    """Catches a traceback, a late refusal, a recording on a full disk, and a job left behind."""
    operator = extension.operators.render_video

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def fails(sentence, name="turn", **options):
        with failure(sentence):
            ops.render_video(filepath=shown / name, **options)
        assert bpy.context.scene.frame_current == 1
        assert not ops.cancel.poll()
        assert not ops.dismiss.poll()

    (shown / "file").write_text("")
    fails("cannot be written", "file/turn.mp4")
    with monkeypatch.context() as patch:
        patch.setattr(sys.modules[operator.Recorder.__module__], "send", full)
        fails("No space left on device")
    with monkeypatch.context() as patch:
        patch.setattr(operator, "training_python", lambda _: str(shown / "no python"))
        with failure("cannot be started"):
            ops.render_video(filepath=shown / "turn", seconds=0.1)
    bpy.data.objects.remove(panel().head)
    fails("has no head to follow", path="scene")


def test_finished_jobs_end_with_the_add_on(extension, shown, temporary):
    """Catches temporary folders of videos that nobody dismissed."""
    operator = extension.operators.render_video
    folder = temporary / "stga_video_kept"
    folder.mkdir()
    operator.Recorder(folder / operator.RECORDING).close()
    monitor = extension.operators.monitor
    monitor.follow(bpy.context.scene, Kind.VIDEO, shown / "turn.mp4", folder)
    extension.unregister()
    extension.register()
    assert not folder.exists()


def test_while_blender_renders(extension, shown, monkeypatch):
    """Catches frames that are set under a running render, by a video, an export, an import or at
    its end, and an engine that is unregistered meanwhile, which hangs Blender for ever."""
    scene = bpy.context.scene
    rendering = [True]
    waiting = []
    monkeypatch.setattr(bpy.app.timers, "register", lambda tick, **_: waiting.append(tick))
    objects = extension.stga_addon.scene.objects
    monkeypatch.setattr(objects, "is_rendering", lambda: rendering[0])
    for module in (extension.operators.render_video, extension.operators.import_capture):
        monkeypatch.setattr(module, "is_rendering", lambda: rendering[0])
    with failure("would get other meshes"):
        ops.import_capture(directory=capture_of(panel().head))
    with failure("wait until the render has ended"):
        ops.render_video(filepath=shown / "images", path="scene", format="png")
    with failure("wait until the render has ended"):
        ops.export_splats(filepath=shown / "a.ply")
    assert not (shown / "images").exists()
    rendering[0] = False
    recorded = extension.operators.render_video.RenderVideo.record
    mine = []

    def record(*arguments):
        for count, _ in enumerate(recorded(*arguments)):
            rendering[0] = 2 <= count < 6
            if rendering[0]:
                scene.frame_set(7)  # as the render does
            mine.append(scene.frame_current)
            yield

    monkeypatch.setattr(extension.operators.render_video.RenderVideo, "record", record)
    ops.render_video(filepath=shown / "images", path="scene", format="png")
    assert mine == [1, 0, 7, 7, 7, 7, 7, 2]
    monkeypatch.undo()
    ops.render_video(filepath=shown / "alone", path="scene", format="png")
    for path in sorted((shown / "alone").glob("*.png")):
        assert path.read_bytes() == (shown / "images" / path.name).read_bytes()


def test_engine_of_a_running_render(extension, monkeypatch):
    """Catches an engine that is unregistered or replaced during a render, which hangs Blender for
    ever, and one that stays afterwards."""
    engine = extension.stga_addon.scene.render.engine
    rendering = [True]
    waiting = []
    monkeypatch.setattr(bpy.app.timers, "register", lambda tick, **_: waiting.append(tick))
    monkeypatch.setattr(extension.stga_addon.scene.objects, "is_rendering", lambda: rendering[0])
    for _ in range(2):
        extension.unregister()
        assert engine.SplatsEngine.is_registered
        extension.register()
    extension.unregister()
    assert all(tick() for tick in waiting)
    rendering[0] = False
    assert not any(tick() for tick in waiting)
    assert not engine.SplatsEngine.is_registered
    extension.register()
    assert engine.SplatsEngine.is_registered


CAMERA = Camera(63, 48, 50.0, 50.0, 31.5, 24.0, np.eye(4))


@pytest.mark.parametrize(("channels", "mode"), [(3, "RGB"), (4, "RGBA")])
def test_png(channels, mode):
    """Catches rows, channels or checksums that other readers take for something else."""
    pixels = default_rng(0).integers(0, 256, (7, 5, channels), np.uint8)
    with Image.open(io.BytesIO(png_bytes(pixels))) as image:
        assert image.mode == mode
        assert_array_equal(np.asarray(image), pixels)


def drawn(monkeypatch, video, shades):
    for shade in shades:
        rgb = np.full((3, CAMERA.height, CAMERA.width), shade, np.float32)
        picture = ComposedImage(rgb, np.ones((CAMERA.height, CAMERA.width), np.float32), None)
        monkeypatch.setattr(drawn_video, "draw_image", lambda *_, shown=picture: shown)
        video.add([], CAMERA)


@pytest.mark.slow
def test_video_without_a_training_python(monkeypatch, tmp_path):
    """Catches colors, an order, a size or a rate in the video that is not the images'."""
    scenes = len(bpy.data.scenes)
    (tmp_path / "drawn").mkdir()
    video = DrawnVideo(tmp_path / "drawn", tmp_path / "out.mp4", None)
    shades = [0.1, 0.4, 0.7, 0.9]
    drawn(monkeypatch, video, shades)
    video.encode(24.0)
    with av.open(str(tmp_path / "out.mp4")) as container:
        stream = container.streams.video[0]
        assert float(stream.average_rate) == pytest.approx(24.0)
        means = [
            frame.to_ndarray(format="rgb24")[8:40, 8:56].mean() / 255
            for frame in container.decode(stream)
        ]
        assert (stream.width, stream.height) == (64, 48)
    assert_allclose(means, shades, atol=0.03)
    assert len(bpy.data.scenes) == scenes


def test_images_without_a_training_python(monkeypatch, tmp_path):
    """Catches images that are not written, a folder that takes a sequence only once, and a GPU that
    fails without a sentence."""
    out = tmp_path / "out"
    for shades in ([0.2, 0.6], [0.8]):
        folder = tmp_path / f"drawn_{len(shades)}"
        folder.mkdir()
        check_output(out)
        video = DrawnVideo(folder, out, (0.0, 0.0, 0.0))
        drawn(monkeypatch, video, shades)
        video.encode(24.0)
        means = [np.asarray(Image.open(path)).mean() / 255 for path in sorted(out.glob("*.png"))]
        assert_allclose(means, shades, atol=0.01)
    monkeypatch.setattr(drawn_video, "draw_image", lambda *_: None)
    with pytest.raises(StgaError, match="no GPU context"):
        video.add([], CAMERA)
