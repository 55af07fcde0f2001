"""Videos and image sequences, decoded again by FFmpeg and Pillow."""

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest
from avatar.conftest import splats_of
from numpy.testing import assert_array_equal
from PIL import Image

from stga_addon.avatar.embedding import WORLD
from stga_addon.capture.camera import look_at
from stga_addon.errors import StgaError
from stga_addon.jobs.blender import RenderRecording
from stga_addon.jobs.perform import perform_in_folder, write_request
from stga_addon.raster.cpu.compose import compose
from stga_addon.raster.posed_splats import ComposedImage, PosedSplats
from stga_addon.render.client import pack_layers, unpack_layers
from stga_addon.render.video import Recorder, check_output, finished, sequence_writer, video_writer
from stga_addon.worker.status import inspect_worker, request_cancel

from .test_client import embedded

FPS = 12.5


def images(height=61, width=80, count=10):
    """Red above, blue below, and a gray stripe that moves down."""
    picture = np.zeros((height, width, 3), np.uint8)
    picture[: height // 2, :, 0] = picture[height // 2 :, :, 2] = 255
    moving = [picture.copy() for _ in range(count)]
    for index, image in enumerate(moving):
        image[4 * index : 4 * index + 8] = 128
    return moving


def test_a_video_is_what_was_written(tmp_path):
    """Catches lost or doubled frames, a wrong rate, and colors tagged as of another matrix."""
    path = tmp_path / "a" / "video.mp4"
    written = images()
    with video_writer(path, FPS) as write:
        for image in written:
            write(image)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.average_rate) == ("h264", FPS)
        assert stream.codec_context.colorspace == stream.codec_context.color_range == 1
        decoded = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(decoded) == len(written)
    assert decoded[0].shape == (62, 80, 3)  # the format has even sizes only
    for image, again in zip(written, decoded, strict=True):
        error = np.abs(again[:61].astype(int) - image)
        assert np.median(error) <= 3
        assert error.mean() < 6  # edges of color are blurred to half the resolution
    assert [item.name for item in path.parent.iterdir()] == ["video.mp4"]


def test_nothing_is_left_of_an_unfinished_video(tmp_path):
    """Catches half a video after an error, and an older one that it destroyed."""
    path = tmp_path / "video.mp4"
    path.write_bytes(b"older")
    with suppress(KeyboardInterrupt), video_writer(path, FPS) as write:
        write(images()[0])
        raise KeyboardInterrupt
    assert path.read_bytes() == b"older"
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("fps", [0.0, 1e9, float("nan")])
def test_frame_rates_no_video_has(tmp_path, fps):
    """Catches FFmpeg's own message, or a video without duration."""
    with pytest.raises(StgaError, match="frame rate"), video_writer(tmp_path / "video.mp4", fps):
        pass


def test_image_sequence(tmp_path):
    """Catches images out of order, transparency that is lost, and an earlier sequence lost to a
    rendering that failed at its first image."""
    written = [np.dstack([image, image[..., 0]]) for image in images(count=3)]
    with sequence_writer(tmp_path / "images") as write:
        for image in written:
            write(image)
    names = ["0001.png", "0002.png", "0003.png"]
    assert sorted(path.name for path in (tmp_path / "images").glob("*.*g")) == names
    for name, image in zip(names, written, strict=True):
        assert_array_equal(np.asarray(Image.open(tmp_path / "images" / name)), image)
    before = contents(tmp_path / "images")
    with suppress(KeyboardInterrupt), sequence_writer(tmp_path / "images"):
        raise KeyboardInterrupt
    assert contents(tmp_path / "images") == before


def write_sequence(folder, count):
    with sequence_writer(folder) as write:
        for image in images(count=count):
            write(image)


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("cut_short", [False, True])
def test_a_sequence_replaces_an_earlier_one(tmp_path, cut_short):
    """Catches images of a longer, killed sequence that stay, and others' that do not."""
    write = sequence_writer(tmp_path).__enter__()  # of a process that was killed
    for image in images(count=4):
        write(image)
    for name in ("12.png", "texture_0001.png"):
        (tmp_path / name).write_bytes(b"of others")
    with suppress(KeyboardInterrupt), sequence_writer(tmp_path) as write:
        write(images()[0])
        if cut_short:
            raise KeyboardInterrupt
    left = ["0001.png", "12.png", "texture_0001.png"]
    assert sorted(path.name for path in tmp_path.glob("*.png")) == left
    assert_array_equal(np.asarray(Image.open(tmp_path / "0001.png")), images()[0])


@pytest.mark.parametrize("name", ["0001.png", "0002.png", "0044.png", "0044.PNG"])
def test_images_of_others_are_kept(tmp_path, name):
    """Catches footage or retouched images lost, and a refusal that comes too late."""
    write_sequence(tmp_path, 2)
    (tmp_path / name).write_bytes(b"of others")
    before = contents(tmp_path)
    with pytest.raises(StgaError, match=f"{tmp_path}: holds {name}, which was not written here"):
        write_sequence(tmp_path, 3)
    with pytest.raises(StgaError, match=f"{tmp_path}: holds {name}, which was not written here"):
        check_output(tmp_path)
    assert contents(tmp_path) == before


IMAGES = "recording.bin"
CAMERA = look_at((0, 0, 2), (0, 0, 0), 32, 24, 40.0)


def record(folder, output, images, count=None):
    """Record images and ask for them; count: how many, if others than there are."""
    folder.mkdir()
    recorder = Recorder(folder / IMAGES)
    for layers in images:
        recorder.add(layers, CAMERA)
    recorder.close()
    background = (1.0, 0.5, 0.0) if len(images) > 1 else None
    count = count or len(images)
    write_request(folder, RenderRecording(folder / IMAGES, output, count, 25.0, background))


def layer(seed, to_world=None, count=40):
    rng = np.random.default_rng(seed)
    xyz = rng.normal(0, 0.3, (count, 3))
    sh = rng.normal(size=(count, 1, 3))
    splats = splats_of(xyz, rng.normal(size=(count, 4)), log_scale=-2.5, opacity=1, sh=sh)
    return PosedSplats(splats, WORLD, np.eye(4) if to_world is None else to_world)


def moved(x):
    matrix = np.eye(4)
    matrix[0, 3] = x
    return matrix


def test_layers_without_what_the_reader_has():
    """Catches splats sent again with each image, taken for others, and a field that is not sent."""
    before = [layer(0), layer(1)]
    after = [replace(layer(0), to_world=moved(1)), layer(2), embedded()]
    packed = pack_layers(after, before)
    assert "0 splats xyz" not in packed
    assert {"1 splats xyz", "2 splats xyz"} <= set(packed)
    for given, again in zip(after, unpack_layers(packed, before), strict=True):
        for one, other in ((given.splats, again.splats), (given.frames, again.frames)):
            for name, value in vars(one).items():
                assert_array_equal(getattr(other, name), value, err_msg=name)
        assert_array_equal(again.to_world, given.to_world)
        assert again.antialiased == given.antialiased


def test_images_are_those_recorded(tmp_path):
    """Catches images of other splats, poses or cameras than recorded, and a recording left."""
    folder = tmp_path / "job"
    out = tmp_path / "out"
    images = [[layer(0)], [replace(layer(0), to_world=moved(0.3))], [layer(1), layer(0)]]
    record(folder, out, images)
    perform_in_folder(folder)
    assert inspect_worker(folder).state == "finished"
    assert not (folder / IMAGES).exists()
    for index, layers in enumerate(images):
        expected = finished(compose(layers, CAMERA), (1.0, 0.5, 0.0), opaque=False)
        with Image.open(out / f"{index + 1:04d}.png") as image:
            assert_array_equal(np.asarray(image), expected)


def test_a_cancelled_video_is_not_written(tmp_path):
    """Catches half a video under the name of a whole one, and a cancel that counts as a failure."""
    pytest.importorskip("av")
    folder = tmp_path / "job"
    record(folder, tmp_path / "video.mp4", [[layer(0)]])
    request_cancel(folder)
    perform_in_folder(folder)
    assert inspect_worker(folder).state == "cancelled"
    assert [path.name for path in tmp_path.iterdir()] == ["job"]


def test_backgrounds():
    """Catches premultiplied color in a PNG with alpha, and a background before the splats."""
    rgb = np.full((3, 1, 1), 0.25, np.float32)
    alpha = np.full((1, 1), 0.5, np.float32)
    image = ComposedImage(rgb, alpha, None)
    assert finished(image, None, opaque=False).tolist() == [[[128, 128, 128, 128]]]
    assert finished(image, None, opaque=True).tolist() == [[[64, 64, 64]]]
    assert finished(image, (1.0, 0.0, 0.5), opaque=True).tolist() == [[[191, 64, 128]]]
    # a quarter of the pixel is hidden by a holdout
    image = replace(image, hidden=np.full((1, 1), 0.25, np.float32))
    assert finished(image, None, opaque=False).tolist() == [[[255, 255, 255, 64]]]
    assert finished(image, (1.0, 0.0, 0.5), opaque=False).tolist() == [[[255, 85, 170, 191]]]
    assert finished(image, (1.0, 0.0, 0.5), opaque=True).tolist() == [[[191, 64, 128]]]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
def test_a_truncated_recording(tmp_path):
    """Catches a traceback, or a recording taken for whole, where the disk was full."""
    folder = tmp_path / "job"
    record(folder, tmp_path / "out", [[layer(0)]], count=2)
    with pytest.raises(StgaError, match="cannot be read as the images of a video"):
        perform_in_folder(folder)
    assert inspect_worker(folder).state == "failed"
    assert not (folder / IMAGES).exists()
    recorder = Recorder(tmp_path / IMAGES)
    recorder._stream.close()
    recorder._stream = Path("/dev/full").open("wb")  # noqa: SIM115
    with pytest.raises(StgaError, match=f"{IMAGES}: cannot be written .No space left"):
        recorder.add([layer(0, count=10_000)], CAMERA)
    with pytest.raises(StgaError, match=f"{IMAGES}: cannot be written .No space left"):
        recorder.close()
    recorder.close()
