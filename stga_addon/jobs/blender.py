"""Rendering for Blender: images that it recorded, and frames of a .blend file by Blender itself."""

import os
import re
import shlex
import subprocess
import sys
from collections import deque
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path

from ..errors import StgaError
from ..files import naming, temporary_folder
from ..options import like
from ..progress import Cancelled, Log, Progress, Report, Written, counted
from ..render.composer import Composer
from ..render.video import (
    finished,
    is_video,
    recorded_images,
    sequence_writer,
    video_writer,
)
from ..schema import MAX_COUNT, setting
from ..worker.launch import end_with_this_process
from ..worker.training_python import BLENDER_VARIABLE, PYTHON_VARIABLE
from .train import Train

PARTIAL = "rendering"
"""Part of the name of the folder into which Blender writes; a finished picture is moved out of
it."""
SAVED = re.compile(r"Saved: '(?P<path>.+)'")  # What Blender prints when it has written a picture
LAST_LINES = 30  # Lines of Blender's output that are searched for why it failed
STOP_TIMEOUT_S = 10.0
MAX_FRAME = 1_048_574  # Blender's last frame
FRAME_DIGITS = 6  # Least number of digits in the name of a frame's picture


@dataclass(frozen=True)
class RenderRecording:
    """Render the images that Blender has recorded, and encode them.

    recording       file of the images (`render.video`), removed afterwards
    output          an .mp4 file, or a folder for PNGs
    images          how many
    background      sRGB in 0…1; None: transparent in PNGs, black in a video
    """

    recording: Path
    output: Path
    images: int = setting(minimum=0, maximum=MAX_COUNT)
    fps: float = setting(above=0)
    background: tuple[float, float, float] | None = setting(None, 0, 1)
    device: str = like(Train, "device")


def render_recording(request: RenderRecording, report: Report, log: Log) -> Written:
    """Render the recorded images and remove the recording; cancelled, no video is written, finished
    PNGs stay."""
    output = request.output
    count = request.images
    to_video = is_video(request.output)
    try:
        images = recorded_images(request.recording, count, Composer(request.device))
        writer = video_writer(output, request.fps) if to_video else sequence_writer(output)
        with writer as write:
            for image in counted(images, count, report, "Rendering", "Image"):
                write(finished(image, request.background, to_video))
    finally:
        request.recording.unlink(missing_ok=True)
    return Written(output)


@dataclass(frozen=True)
class RenderBlend:
    """Render frames of a .blend file with the Blender of the machine, as PNGs called by their
    numbers (000012.png).

    output          folder; pictures that it holds already stay
    frames          first and last
    engine          as Blender's --engine takes it
    """

    blend: Path
    output: Path
    frames: tuple[int, int] = setting(minimum=0, maximum=MAX_FRAME)
    engine: str = "STGA_SPLATS"

    def check(self) -> None:
        """Raise StgaError for a file of another name, and frames in the wrong order."""
        first, last = self.frames
        if self.blend.suffix.lower() != ".blend":
            raise StgaError(f"{self.blend}: expected a name that ends in .blend")
        if first > last:
            raise StgaError(f"frames: expected the first and then the last, got {first}, {last}")

    @property
    def pictures(self) -> dict[int, Path]:
        """Frame -> its file."""
        frames = range(self.frames[0], self.frames[1] + 1)
        return {frame: self.output / f"{frame:0{FRAME_DIGITS}d}.png" for frame in frames}


def pictures(request: RenderBlend) -> Collection[Path]:
    """What it has rendered when it is finished."""
    return request.pictures.values()


def render_blend(request: RenderBlend, report: Report, log: Log) -> Written:
    """Render the frames that have no picture yet.

    The add-on has to be enabled in that Blender; it renders with the Python of this process, unless
    STGA_PYTHON names another. Raises StgaError where Blender is missing or fails, Cancelled between
    two pictures.
    """
    if not request.blend.is_file():
        raise StgaError(f"{request.blend}: is not a file; expected a .blend file")
    total = len(request.pictures)
    missing = [frame for frame, path in request.pictures.items() if not path.exists()]
    done = total - len(missing)
    report(Progress(done / total, "Rendering"))
    # runs that follow each other
    for _, numbered in groupby(enumerate(missing), lambda item: item[1] - item[0]):
        frames = [frame for _, frame in numbered]
        for _ in _rendered(request, frames[0], frames[-1], log):
            done += 1
            progress = Progress(done / total, "Rendering", f"Frame {done} of {total}")
            if report(progress) and done < total:
                raise Cancelled
    return Written(request.output)


def _rendered(request: RenderBlend, first: int, last: int, log: Log) -> Iterator[Path]:
    """Let Blender render the frames; yields each picture when it is whole."""
    with temporary_folder(request.output, PARTIAL) as partial:
        names = str(partial.absolute() / ("#" * FRAME_DIGITS))
        process = _start(
            [
                *blender_command(),
                "--background",
                str(request.blend.absolute()),
                "--engine",
                request.engine,
                "--render-output",
                names,
                "--render-format",
                "PNG",
                "--use-extension",
                "1",
                "--frame-start",
                str(first),
                "--frame-end",
                str(last),
                "--frame-jump",
                "1",
                "--render-anim",
            ]
        )
        printed: deque[str] = deque(maxlen=LAST_LINES)
        pictures = request.pictures
        expected = first
        assert process.stdout is not None
        try:
            for line in process.stdout:
                printed.append(line.strip())
                log(line.rstrip())
                picture = pictures[min(expected, last)]
                found = SAVED.search(line)
                if found is not None and Path(found["path"]).name == picture.name:
                    with naming(picture):
                        os.replace(partial / picture.name, picture)
                    expected += 1
                    yield picture
            code = process.wait()
        finally:
            if process.poll() is None:
                process.terminate()
                try:
                    process.wait(STOP_TIMEOUT_S)
                except subprocess.TimeoutExpired:
                    process.kill()
                    process.wait()
            process.stdout.close()
    if expected <= last:
        lines = [line for line in printed if line] or ["it printed nothing"]
        said = ([line for line in lines if "error" in line.lower()] or lines)[-1]
        raise StgaError(
            f"{request.blend}: frame {expected} was not rendered: Blender ended with exit "
            f"status {code}: {said}"
        )


def blender_command() -> list[str]:
    """What starts this machine's Blender: the command in STGA_BLENDER, else `blender`."""
    text = os.environ.get(BLENDER_VARIABLE, "")
    if os.path.isfile(text):  # whose path may hold spaces
        return [text]
    return shlex.split(text, posix=os.name != "nt") or ["blender"]


def _start(command: list[str]) -> subprocess.Popen[str]:
    # Without the variables of this Python, whose place the add-on knows.
    kept = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    try:
        return subprocess.Popen(
            command,
            env={PYTHON_VARIABLE: sys.executable, **kept},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            encoding="utf-8",
            errors="replace",
            preexec_fn=end_with_this_process(),
        )
    except OSError as error:
        raise StgaError(
            f"{command[0]}: Blender cannot be started ({error.strerror or error}); expected it "
            f"on PATH, or the command that starts it in {BLENDER_VARIABLE}"
        ) from error
