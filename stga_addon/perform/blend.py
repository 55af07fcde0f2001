"""Rendering of frames of a .blend file by the Blender of this machine, without a window."""

import os
import re
import shlex
import shutil
import subprocess
import sys
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

from ..errors import StgaError
from ..progress import Cancelled, Progress, Report, Say
from ..requests.results import Written
from ..requests.values import FRAME_DIGITS, RenderBlend
from ..worker.launch import end_with_this_process
from ..worker.training_python import BLENDER_VARIABLE, PYTHON_VARIABLE

PARTIAL = ".rendering-"
"""Start of the name of the folder that Blender writes into; a picture leaves it when it is whole."""
SAVED = re.compile(r"Saved: '(?P<path>.+)'")
"""What Blender prints when it has written a picture."""
LAST_LINES = 30
"""Lines of Blender's output that are searched for why it failed."""
STOP_TIMEOUT_S = 10.0


def render_blend(request: RenderBlend, report: Report, say: Say) -> Written:
    """Render the frames that have no picture yet.

    The add-on has to be enabled in that Blender; it renders with the Python of this process, unless
    STGA_PYTHON names another. Raises StgaError where Blender is missing or fails, Cancelled between two pictures.
    """
    if not request.blend.is_file():
        raise StgaError(f"{request.blend}: is not a file; expected a .blend file")
    pictures = request.pictures
    missing = [frame for frame, path in pictures.items() if not path.exists()]
    done = len(pictures) - len(missing)
    report(Progress(done / len(pictures), "Rendering"))
    for begin, end in _spans(missing):
        for _ in _rendered(request, begin, end, say):
            done += 1
            detail = f"Frame {done} of {len(pictures)}"
            if report(Progress(done / len(pictures), "Rendering", detail)) and done < len(pictures):
                raise Cancelled
    return Written(request.output)


def _spans(frames: Iterable[int]) -> Iterator[tuple[int, int]]:
    """First and last of each run of numbers that follow each other."""
    first = last = None
    for frame in frames:
        if first is None or last is None:
            first = last = frame
        elif frame == last + 1:
            last = frame
        else:
            yield first, last
            first = last = frame
    if first is not None and last is not None:
        yield first, last


def _rendered(request: RenderBlend, first: int, last: int, say: Say) -> Iterator[Path]:
    """Let Blender render the frames; yields each picture when it is whole."""
    request.output.mkdir(parents=True, exist_ok=True)
    for left in request.output.glob(PARTIAL + "*"):  # of a process that was killed
        shutil.rmtree(left, ignore_errors=True)
    with TemporaryDirectory(prefix=PARTIAL, dir=request.output) as partial:
        process = _start(_command(request, first, last, Path(partial)))
        printed: deque[str] = deque(maxlen=LAST_LINES)
        pictures, expected = request.pictures, first
        try:
            assert process.stdout is not None
            for line in process.stdout:
                printed.append(line.strip())
                say(line.rstrip())
                picture, found = pictures[min(expected, last)], SAVED.search(line)
                if found is not None and Path(found["path"]).name == picture.name:
                    os.replace(Path(partial, picture.name), picture)
                    expected += 1
                    yield picture
            code = process.wait()
        finally:
            _stop(process)
    if expected <= last:
        raise StgaError(f"{request.blend}: frame {expected} was not rendered: {_reason(code, printed)}")


def _command(request: RenderBlend, first: int, last: int, folder: Path) -> list[str]:
    blend, names = str(request.blend.absolute()), str(folder.absolute() / ("#" * FRAME_DIGITS))
    return [
        *blender_command(), "--background", blend, "--engine", request.engine,
        "--render-output", names, "--render-format", "PNG", "--use-extension", "1",
        "--frame-start", str(first), "--frame-end", str(last), "--frame-jump", "1", "--render-anim",
    ]  # fmt: skip


def blender_command() -> list[str]:
    """What starts this machine's Blender: the program or command in STGA_BLENDER, else the program `blender`."""
    text = os.environ.get(BLENDER_VARIABLE, "")
    if os.path.isfile(text):  # whose path may hold spaces
        return [text]
    return shlex.split(text, posix=os.name != "nt") or ["blender"]


def _start(command: list[str]) -> subprocess.Popen[str]:
    try:
        return subprocess.Popen(
            command,
            env=_variables(os.environ),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            encoding="utf-8",
            errors="replace",
            preexec_fn=end_with_this_process(),
        )
    except OSError as error:
        expected = f"expected it on PATH, or the command that starts it in {BLENDER_VARIABLE}"
        raise StgaError(f"{command[0]}: Blender cannot be started ({error.strerror or error}); {expected}") from error


def _variables(own: Mapping[str, str]) -> dict[str, str]:
    """Environment variables for Blender: without those of this Python, whose place the add-on is told."""
    kept = {name: value for name, value in own.items() if not name.startswith("PYTHON")}
    return {PYTHON_VARIABLE: sys.executable, **kept}


def _reason(code: int, printed: Iterable[str]) -> str:
    lines = [line for line in printed if line]
    errors = [line for line in lines if "error" in line.lower()]
    said = (errors or lines or ["it printed nothing"])[-1]
    return f"Blender ended with exit status {code}: {said}"


def _stop(process: subprocess.Popen[str]) -> None:
    """End Blender, if it is still running."""
    if process.poll() is None:
        process.terminate()
        try:
            process.wait(STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
    if process.stdout is not None:
        process.stdout.close()
