"""Videos that Blender draws and encodes itself, read back by pillow and FFmpeg."""

import io

import numpy as np
import pytest

bpy = pytest.importorskip("bpy")

import av  # noqa: E402
from PIL import Image  # noqa: E402

from stga_addon.capture.camera import Camera  # noqa: E402
from stga_addon.errors import StgaError  # noqa: E402
from stga_addon.raster.posed_splats import ComposedImage  # noqa: E402
from stga_addon.scene.render import drawn_video  # noqa: E402
from stga_addon.scene.render.drawn_video import DrawnVideo, png_bytes  # noqa: E402

CAMERA = Camera(63, 48, 50.0, 50.0, 31.5, 24.0, np.eye(4))


@pytest.mark.parametrize(("channels", "mode"), [(3, "RGB"), (4, "RGBA")])
def test_png(channels: int, mode: str) -> None:
    """Catches rows, channels or checksums that other readers take for something else."""
    pixels = np.random.default_rng(0).integers(0, 256, (7, 5, channels), np.uint8)
    with Image.open(io.BytesIO(png_bytes(pixels))) as image:
        assert image.mode == mode
        np.testing.assert_array_equal(np.asarray(image), pixels)


def drawn(monkeypatch: pytest.MonkeyPatch, video: DrawnVideo, shades: list[float]) -> None:
    for shade in shades:
        rgb = np.full((3, CAMERA.height, CAMERA.width), shade, np.float32)
        picture = ComposedImage(rgb, np.ones((CAMERA.height, CAMERA.width), np.float32), None)
        monkeypatch.setattr(drawn_video, "draw_image", lambda *_, shown=picture: shown)
        video.add([], CAMERA)


@pytest.mark.slow
def test_video_without_a_training_python(monkeypatch, tmp_path) -> None:
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
    np.testing.assert_allclose(means, shades, atol=0.03)
    assert len(bpy.data.scenes) == scenes


def test_images_without_a_training_python(monkeypatch, tmp_path) -> None:
    """Catches images that are not written, and a GPU that fails without a sentence."""
    for name in ("drawn", "out"):
        (tmp_path / name).mkdir()
    video = DrawnVideo(tmp_path / "drawn", tmp_path / "out", (0.0, 0.0, 0.0))
    drawn(monkeypatch, video, [0.2, 0.6])
    video.encode(24.0)
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["0001.png", "0002.png"]
    monkeypatch.setattr(drawn_video, "draw_image", lambda *_: None)
    with pytest.raises(StgaError, match="no GPU context"):
        video.add([], CAMERA)
