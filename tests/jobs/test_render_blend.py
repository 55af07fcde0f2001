"""Rendering frames with a program in place of Blender (tests/batch/test_blender.py: a real one)."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
from refusal import refusal

from stga_addon.jobs.blender import RenderBlend, blender_command
from stga_addon.jobs.perform import perform, worker_arguments, write_request
from stga_addon.progress import Cancelled, Written

BLENDER = """
import os, sys, time
given = dict(zip(sys.argv[1:], sys.argv[2:]))
first, last = int(given["--frame-start"]), int(given["--frame-end"])
assert "PYTHONPATH" not in os.environ
with open(os.environ["LOG"], "a") as log:
    print(os.getpid(), first, last, given["--engine"], os.environ["STGA_PYTHON"], file=log)
for frame in range(first, last + 1):
    path = given["--render-output"].replace("######", f"{frame:06d}") + ".png"
    if frame == int(os.environ.get("FAILS", -1)):
        sys.exit("Error: Out of memory")
    with open(path, "w") as picture:
        picture.write("half")
        picture.flush()
        while frame == int(os.environ.get("STAYS", -1)):
            time.sleep(0.05)
        time.sleep(float(os.environ.get("PAUSE", 0)))
        picture.write(f" {frame}")
    print(f"00:01.0  render  | Saved: '{path}'", flush=True)
"""


@pytest.fixture
def shot(tmp_path, monkeypatch):
    script = tmp_path / "blender.py"
    script.write_text(BLENDER)
    (tmp_path / "shot.blend").touch()
    monkeypatch.setenv("STGA_BLENDER", f"{sys.executable} {script}")
    monkeypatch.setenv("LOG", str(tmp_path / "log"))
    monkeypatch.delenv("STGA_PYTHON", raising=False)
    return RenderBlend(tmp_path / "shot.blend", tmp_path / "out", (8, 12))


def pictures(folder):
    return {path.name: path.read_text() for path in folder.glob("*.png")}


def calls(folder):
    return [line.split()[1:] for line in (folder / "log").read_text().splitlines()]


WHOLE = {f"{frame:06d}.png": f"half {frame}" for frame in range(8, 13)}


def test_only_missing_frames_are_rendered(shot, tmp_path):
    """Catches frames that are rendered twice, left out, or by another engine or training Python."""
    shot.output.mkdir()
    (shot.output / "000010.png").write_text("half 10")
    shares = []
    perform(shot, lambda progress: bool(shares.append(progress.fraction)))
    assert pictures(shot.output) == WHOLE
    same = ["STGA_SPLATS", sys.executable]
    assert calls(tmp_path) == [["8", "9", *same], ["11", "12", *same]]
    assert shares == [0.2, 0.4, 0.6, 0.8, 1.0]
    perform(shot)
    assert len(calls(tmp_path)) == 2


def test_a_program_with_spaces_in_its_path(monkeypatch, tmp_path):
    """Catches "C:/Program Files/…/blender.exe" that is taken apart, and a command that is not."""
    program = tmp_path / "Blender Foundation" / "blender"
    program.parent.mkdir()
    program.touch()
    words = ["xvfb-run", "-a", "blender"]
    for text, command in ((str(program), [str(program)]), (" ".join(words), words)):
        monkeypatch.setenv("STGA_BLENDER", text)
        assert blender_command() == command
    monkeypatch.delenv("STGA_BLENDER")
    assert blender_command() == ["blender"]


def test_what_went_wrong_is_a_sentence(shot, tmp_path, monkeypatch):
    """Catches a film that counts as finished without all frames, and a missing Blender."""
    monkeypatch.setenv("FAILS", "10")
    with refusal(r"shot\.blend: frame 10 was not rendered: .*exit status 1: Error: Out of memory"):
        perform(shot)
    assert sorted(pictures(shot.output)) == ["000008.png", "000009.png"]
    monkeypatch.setenv("STGA_BLENDER", str(tmp_path / "nowhere"))
    with refusal(r"nowhere: Blender cannot be started .*; expected it on PATH"):
        perform(shot)


def test_cancelling_ends_blender(shot, tmp_path, monkeypatch):
    """Catches a Blender that goes on after Ctrl-C, and pictures of which only a part is written."""
    monkeypatch.setenv("PAUSE", "0.3")

    def report(progress):
        return progress.fraction >= 0.4

    with pytest.raises(Cancelled):
        perform(shot, report)
    assert pictures(shot.output) == {name: WHOLE[name] for name in ("000008.png", "000009.png")}
    process = int((tmp_path / "log").read_text().split()[0])
    with pytest.raises(ProcessLookupError):
        os.kill(process, 0)


def test_a_film_cancelled_with_its_last_picture_is_whole(shot):
    """Catches a job that is reported as cancelled, and done again, though no picture is missing."""
    result = perform(shot, lambda progress: progress.fraction == 1)
    assert result == Written(shot.output)
    assert pictures(shot.output) == WHOLE


@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="Linux ends a process with the one that started it"
)
def test_blender_ends_with_a_killed_worker(shot, tmp_path, monkeypatch):
    """Catches two Blenders that render the same frames, and half a picture among the rest."""
    monkeypatch.setenv("STAYS", "10")
    write_request(tmp_path / "job", shot)
    arguments = worker_arguments(tmp_path / "job", resume=True)
    worker = subprocess.Popen([sys.executable, "-m", *arguments])
    deadline = time.monotonic() + 60
    begun = {name: WHOLE[name] for name in ("000008.png", "000009.png")}
    while pictures(shot.output) != begun and time.monotonic() < deadline:
        time.sleep(0.05)
    worker.kill()
    worker.wait()
    process = int((tmp_path / "log").read_text().split()[0])
    while Path(f"/proc/{process}/stat").exists() and time.monotonic() < deadline:
        time.sleep(0.05)
    with pytest.raises(ProcessLookupError):
        os.kill(process, signal.SIGTERM)
    assert pictures(shot.output) == begun
    monkeypatch.delenv("STAYS")
    perform(shot)
    assert pictures(shot.output) == WHOLE
    assert set(os.listdir(shot.output)) == set(WHOLE)


def test_two_jobs_with_one_output(shot):
    """Catches a job that removes what the Blender of another one is writing."""
    other = replace(shot, frames=(20, 21))

    def report(progress):
        if progress.fraction == 0.2:  # the first Blender has four pictures to go
            perform(other)
        return False

    perform(shot, report)
    more = {f"{frame:06d}.png": f"half {frame}" for frame in (20, 21)}
    assert pictures(shot.output) == WHOLE | more
    assert set(os.listdir(shot.output)) == set(WHOLE | more)
