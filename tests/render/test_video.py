"""Videos and image sequences, decoded again by FFmpeg and Pillow."""

from contextlib import suppress
from pathlib import Path

import av
import numpy as np
import pytest
from PIL import Image

from stga_addon.errors import StgaError
from stga_addon.render.video import check_output, sequence_writer, video_writer

FPS = 12.5


def images(height: int = 61, width: int = 80, count: int = 10) -> list[np.ndarray]:
    """Red above, blue below, and a gray stripe that moves down."""
    picture = np.zeros((height, width, 3), np.uint8)
    picture[: height // 2, :, 0] = picture[height // 2 :, :, 2] = 255
    moving = [picture.copy() for _ in range(count)]
    for index, image in enumerate(moving):
        image[4 * index : 4 * index + 8] = 128
    return moving


def test_a_video_is_what_was_written(tmp_path: Path) -> None:
    """Catches lost or doubled frames, a wrong rate, and colors converted by one matrix and tagged
    as another."""
    path, written = tmp_path / "a" / "video.mp4", images()
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


def test_nothing_is_left_of_an_unfinished_video(tmp_path: Path) -> None:
    """Catches half a video after an error, and an older one that it destroyed."""
    path = tmp_path / "video.mp4"
    path.write_bytes(b"older")
    with suppress(KeyboardInterrupt), video_writer(path, FPS) as write:
        write(images()[0])
        raise KeyboardInterrupt
    assert path.read_bytes() == b"older"
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("fps", [0.0, 1e9, float("nan")])
def test_frame_rates_no_video_has(tmp_path: Path, fps: float) -> None:
    """Catches FFmpeg's own message, or a video without duration."""
    with pytest.raises(StgaError, match="frame rate"), video_writer(tmp_path / "video.mp4", fps):
        pass


def test_image_sequence(tmp_path: Path) -> None:
    """Catches images out of order, and transparency that is lost."""
    written = [np.dstack([image, image[..., 0]]) for image in images(count=3)]
    with sequence_writer(tmp_path / "images") as write:
        for image in written:
            write(image)
    assert sorted(path.name for path in (tmp_path / "images").glob("*.*g")) == [
        "0001.png",
        "0002.png",
        "0003.png",
    ]
    for index, image in enumerate(written):
        np.testing.assert_array_equal(
            np.asarray(Image.open(tmp_path / f"images/{index + 1:04d}.png")), image
        )


def write_sequence(folder: Path, count: int) -> None:
    with sequence_writer(folder) as write:
        for image in images(count=count):
            write(image)


def contents(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.parametrize("cut_short", [False, True])
def test_a_sequence_replaces_an_earlier_one(tmp_path: Path, cut_short: bool) -> None:
    """Catches images of an earlier, longer sequence that play after the new ones, and other files
    that are removed."""
    write_sequence(tmp_path, 4)
    for name in ("12.png", "texture_0001.png"):
        (tmp_path / name).write_bytes(b"of others")
    with suppress(KeyboardInterrupt), sequence_writer(tmp_path) as write:
        write(images()[0])
        if cut_short:
            raise KeyboardInterrupt
    assert sorted(path.name for path in tmp_path.glob("*.png")) == [
        "0001.png",
        "12.png",
        "texture_0001.png",
    ]
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "0001.png")), images()[0])


def test_a_sequence_without_images_removes_none(tmp_path: Path) -> None:
    """Catches an earlier sequence lost to a rendering that failed at its first image."""
    write_sequence(tmp_path, 2)
    before = contents(tmp_path)
    with suppress(KeyboardInterrupt), sequence_writer(tmp_path):
        raise KeyboardInterrupt
    assert contents(tmp_path) == before


@pytest.mark.parametrize("name", ["0001.png", "0002.png", "0044.png", "0044.PNG"])
def test_images_of_others_are_kept(tmp_path: Path, name: str) -> None:
    """Catches footage, retouched images or a camera's capitals, in the folder of an earlier
    sequence of ours, that a sequence replaces or removes, and a refusal after something was
    written, recorded or drawn."""
    write_sequence(tmp_path, 2)
    (tmp_path / name).write_bytes(b"of others")
    before = contents(tmp_path)
    with pytest.raises(StgaError, match=f"{tmp_path}: holds {name}, which was not written here"):
        write_sequence(tmp_path, 3)
    with pytest.raises(StgaError, match=f"{tmp_path}: holds {name}, which was not written here"):
        check_output(tmp_path)
    assert contents(tmp_path) == before


def test_a_killed_sequence_can_be_rendered_again(tmp_path: Path) -> None:
    """Catches images of a process that was killed, or whose disk was full, taken for those of
    somebody else."""
    writer = sequence_writer(tmp_path)
    write = writer.__enter__()
    for image in images(count=3):
        write(image)
    write_sequence(tmp_path, 2)
    assert sorted(path.name for path in tmp_path.glob("*.png")) == ["0001.png", "0002.png"]
