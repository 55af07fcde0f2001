"""Video jobs: images of a scene, recorded by Blender and rendered by a worker.

FOLDER/video.json     what to write
FOLDER/images.bin     a message for each image: its camera, and what has changed of the splats
besides the files of the worker's status folder
"""

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from ..capture.camera import Camera
from ..errors import StgaError, shorten
from ..files import check_writable, read_json, write_json
from ..raster.posed_splats import ComposedImage, PosedSplats
from ..render.compose import Composer
from ..render.device import is_device
from ..render.protocol import pack_layers, receive, send, unpack_layers
from ..worker.launch import prepare_status_folder
from ..worker.status import remove_status_folder, status_writer

FORMAT, VERSION = "stga-video", 1
VIDEO, IMAGES = "video.json", "images.bin"
FIRST_IMAGE = "0001.png"
"""Of a sequence, as `render.video.sequence_writer` names it."""


@dataclass(frozen=True)
class VideoJob:
    """What to write.

    output      an .mp4 file, or a folder for PNGs
    images      how many
    background  sRGB in 0…1; None: transparent in PNGs, black in a video
    device      as `render.compose.Composer` takes it
    """

    output: Path
    images: int
    fps: float
    background: tuple[float, float, float] | None
    device: str = "auto"

    @property
    def is_video(self) -> bool:
        return self.output.suffix.lower() == ".mp4"


class Recorder:
    """Writes the messages of a job's images; close it before the worker starts."""

    def __init__(self, folder: Path, job: VideoJob) -> None:
        """Raises StgaError where the folder, or the job's output, cannot be written."""
        check_writable(job.output if job.is_video else job.output / FIRST_IMAGE)
        prepare_status_folder(folder)
        write_json(
            folder / VIDEO,
            {
                "format": FORMAT,
                "version": VERSION,
                "output": str(job.output),
                "images": job.images,
                "fps": job.fps,
                "background": job.background,
                "device": job.device,
            },
        )
        self._path = folder / IMAGES
        with self._reported():
            self._stream: BinaryIO = self._path.open("wb")
        self._before: Sequence[PosedSplats] = ()

    def add(self, layers: Sequence[PosedSplats], camera: Camera) -> None:
        """Append an image. Raises StgaError on a full disk."""
        intrinsics = np.array([camera.width, camera.height, camera.fl_x, camera.fl_y, camera.cx, camera.cy])
        message = {"camera": intrinsics, "pose": camera.world_to_camera, **pack_layers(layers, self._before)}
        self._before = layers
        with self._reported():
            send(self._stream, message)

    def close(self) -> None:
        """Raises StgaError on a full disk, and closes all the same."""
        with self._reported():
            self._stream.close()

    @contextmanager
    def _reported(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise StgaError(f"{self._path}: cannot be written ({error.strerror or error})") from error


def is_video_job(folder: Path) -> bool:
    return (folder / VIDEO).is_file()


def remove_video_job(folder: Path) -> None:
    """Remove the job's files; what it has written stays. Raises StgaError while its worker is running."""
    remove_status_folder(folder, (VIDEO, IMAGES))


def read_video_job(folder: Path) -> VideoJob:
    """Raises StgaError where the folder holds no video job, or a damaged one."""
    path = folder / VIDEO
    values = read_json(path)
    if not isinstance(values, dict) or (values.get("format"), values.get("version")) != (FORMAT, VERSION):
        raise StgaError(f"{path}: is not a video job that this version reads (format '{FORMAT}', version {VERSION})")
    try:
        background = values["background"]
        if background is not None:
            red, green, blue = map(float, background)
            background = red, green, blue
        output, images, fps, device = values["output"], values["images"], values["fps"], values["device"]
        if not is_device(device):
            raise ValueError(f"device is {shorten(device)}")
        return VideoJob(Path(output), int(images), float(fps), background, device)
    except (KeyError, TypeError, ValueError) as error:
        raise StgaError(f"{path}: a field is missing or malformed ({error!s:.200})") from error


class _Cancelled(Exception):
    pass


def run_video_job(folder: Path) -> None:
    """Render the job's images and write them, with its status in the folder.

    A cancelled video is not written; images of a sequence that are finished stay. Raises what rendering raises.
    """
    with status_writer(folder) as writer:
        writer.update(0.0, "Starting")
        job = read_video_job(folder)
        try:
            with _output(job) as write:
                for index, image in enumerate(_images(folder, job)):
                    write(finished(image, job.background, job.is_video))
                    share = (index + 1) / max(job.images, 1)
                    if writer.update(share, "Rendering", f"Image {index + 1} of {job.images}"):
                        raise _Cancelled
        except _Cancelled:
            pass
        finally:
            (folder / IMAGES).unlink(missing_ok=True)


def finished(image: ComposedImage, background: tuple[float, float, float] | None, opaque: bool) -> np.ndarray:
    """(H, W, 3) uint8 sRGB over the background, or (H, W, 4) with straight alpha where it is None and not `opaque`."""
    color, alpha = image.rgb.transpose(1, 2, 0), image.alpha[..., None]
    if background is None and not opaque:
        pixels = np.concatenate([color / np.maximum(alpha, np.finfo(np.float32).tiny), alpha], axis=2)
    else:
        pixels = color + (1 - alpha) * np.array(background or (0, 0, 0), np.float32)
    return np.asarray(np.rint(np.clip(pixels, 0, 1) * 255), np.uint8)


def _output(job: VideoJob) -> AbstractContextManager[Any]:
    from ..render.video import sequence_writer, video_writer

    return video_writer(job.output, job.fps) if job.is_video else sequence_writer(job.output)


def _images(folder: Path, job: VideoJob) -> Iterator[ComposedImage]:
    composer = Composer(job.device)
    layers: list[PosedSplats] = []
    path = folder / IMAGES
    try:
        with path.open("rb") as stream:
            for _ in range(job.images):
                message = receive(stream)
                layers = unpack_layers(message, layers)
                width, height, fl_x, fl_y, cx, cy = message["camera"].tolist()
                yield composer.compose(layers, Camera(int(width), int(height), fl_x, fl_y, cx, cy, message["pose"]))
    except (OSError, EOFError, KeyError, ValueError) as error:
        raise StgaError(f"{path}: cannot be read as the images of a video ({type(error).__name__})") from error
