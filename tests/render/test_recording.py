"""Recordings without Blender: layers that are written down, and rendered as a request asks for."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stga_addon.avatar.embedding import WORLD
from stga_addon.avatar.splats import Splats
from stga_addon.capture.camera import look_at
from stga_addon.errors import StgaError
from stga_addon.jobs.blender import RenderRecording
from stga_addon.jobs.perform import perform_in_folder, write_request
from stga_addon.raster.cpu.compose import compose
from stga_addon.raster.posed_splats import ComposedImage, PosedSplats
from stga_addon.render.client import pack_layers, unpack_layers
from stga_addon.render.video import Recorder, finished
from stga_addon.worker.status import inspect_worker, request_cancel

from .test_client import embedded

IMAGES = "recording.bin"
CAMERA = look_at((0, 0, 2), (0, 0, 0), 32, 24, 40.0)


def record(
    folder: Path, output: Path, images: list[list[PosedSplats]], count: int | None = None
) -> None:
    """Record images and ask for them; count: how many, if others than there are."""
    folder.mkdir()
    recorder = Recorder(folder / IMAGES)
    for layers in images:
        recorder.add(layers, CAMERA)
    recorder.close()
    background = (1.0, 0.5, 0.0) if len(images) > 1 else None
    count = count or len(images)
    write_request(folder, RenderRecording(folder / IMAGES, output, count, 25.0, background))


def layer(seed: int, to_world: np.ndarray | None = None, count: int = 40) -> PosedSplats:
    rng = np.random.default_rng(seed)
    floats = {"xyz": rng.normal(0, 0.3, (count, 3)), "rotation": rng.normal(size=(count, 4))}
    floats |= {"log_scale": np.full((count, 3), -2.5), "opacity": np.ones(count)}
    floats["sh"] = rng.normal(size=(count, 1, 3))
    arrays = {name: values.astype(np.float32) for name, values in floats.items()}
    splats = Splats(**arrays, face=np.zeros(count, np.int32), unbound=np.zeros(count, bool))
    return PosedSplats(splats, WORLD, np.eye(4) if to_world is None else to_world)


def moved(x: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[0, 3] = x
    return matrix


def test_layers_without_what_the_reader_has() -> None:
    """Catches splats that are sent again with each image, others that are taken for those sent
    before, and a field that is not sent."""
    before = [layer(0), layer(1)]
    after = [replace(layer(0), to_world=moved(1)), layer(2), embedded()]
    packed = pack_layers(after, before)
    assert "0 splats xyz" not in packed
    assert {"1 splats xyz", "2 splats xyz"} <= set(packed)
    for given, again in zip(after, unpack_layers(packed, before), strict=True):
        for one, other in ((given.splats, again.splats), (given.frames, again.frames)):
            for name, value in vars(one).items():
                np.testing.assert_array_equal(getattr(other, name), value, err_msg=name)
        np.testing.assert_array_equal(again.to_world, given.to_world)
        assert again.antialiased == given.antialiased


def test_images_are_those_recorded(tmp_path: Path) -> None:
    """Catches images of other splats, poses or cameras than recorded, and a recording left on the
    disk."""
    folder, out = tmp_path / "job", tmp_path / "out"
    images = [[layer(0)], [replace(layer(0), to_world=moved(0.3))], [layer(1), layer(0)]]
    record(folder, out, images)
    perform_in_folder(folder)
    assert inspect_worker(folder).state == "finished"
    assert not (folder / IMAGES).exists()
    for index, layers in enumerate(images):
        expected = finished(compose(layers, CAMERA), (1.0, 0.5, 0.0), opaque=False)
        with Image.open(out / f"{index + 1:04d}.png") as image:
            np.testing.assert_array_equal(np.asarray(image), expected)


def test_a_cancelled_video_is_not_written(tmp_path: Path) -> None:
    """Catches half a video under the name of a whole one, and a cancel that counts as a failure."""
    pytest.importorskip("av")
    folder = tmp_path / "job"
    record(folder, tmp_path / "video.mp4", [[layer(0)]])
    request_cancel(folder)
    perform_in_folder(folder)
    assert inspect_worker(folder).state == "cancelled"
    assert [path.name for path in tmp_path.iterdir()] == ["job"]


def test_backgrounds() -> None:
    """Catches premultiplied color in a PNG with alpha, and a background in front of the splats."""
    rgb, alpha = np.full((3, 1, 1), 0.25, np.float32), np.full((1, 1), 0.5, np.float32)
    image = ComposedImage(rgb, alpha, None)
    assert finished(image, None, opaque=False).tolist() == [[[128, 128, 128, 128]]]
    assert finished(image, None, opaque=True).tolist() == [[[64, 64, 64]]]
    assert finished(image, (1.0, 0.0, 0.5), opaque=True).tolist() == [[[191, 64, 128]]]


def test_a_truncated_recording(tmp_path: Path) -> None:
    """Catches a traceback where the disk was full while Blender recorded."""
    folder = tmp_path / "job"
    record(folder, tmp_path / "out", [[layer(0)]], count=2)
    with pytest.raises(StgaError, match="cannot be read as the images of a video"):
        perform_in_folder(folder)
    assert inspect_worker(folder).state == "failed"
    assert not (folder / IMAGES).exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full")
def test_a_full_disk_while_recording(tmp_path: Path) -> None:
    """Catches a recording whose end never reached the disk and that counts as whole, and a
    traceback."""
    recorder = Recorder(tmp_path / IMAGES)
    recorder._stream.close()
    recorder._stream = Path("/dev/full").open("wb")  # noqa: SIM115
    with pytest.raises(StgaError, match=f"{IMAGES}: cannot be written .No space left"):
        recorder.add([layer(0, count=10_000)], CAMERA)
    with pytest.raises(StgaError, match=f"{IMAGES}: cannot be written .No space left"):
        recorder.close()
    recorder.close()
