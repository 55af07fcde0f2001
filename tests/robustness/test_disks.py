"""Disks that are full or cannot be written: one sentence, and the last good checkpoint stays."""

import errno
import os
import sys

import pytest
from blender.zips import output_of
from capture import factory
from refusal import refusal
from training.toys import quick_settings

from stga_addon.avatar.file import read_avatar
from stga_addon.capture.open import open_capture
from stga_addon.files import read_json, write_json
from stga_addon.training.run import session as run_module
from stga_addon.training.run.checkpoint import read_checkpoint
from stga_addon.training.run.folder import Run, locked
from stga_addon.training.run.metrics_log import append_metrics
from stga_addon.training.run.session import train_run

ITERATIONS = 24
FULL_AT = 8  # the next step writes a checkpoint and no avatar


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    return factory.write_mesh_capture(tmp_path_factory.mktemp("disk"), (0, 1, 3), range(3))


def test_no_room_for_a_checkpoint(root, tmp_path, monkeypatch):
    """Catches a checkpoint destroyed by the one that did not fit, a traceback, and a run that
    cannot go on when there is room again: from one moment on, the system refuses every file above a
    size."""
    resource = pytest.importorskip("resource")
    monkeypatch.setattr(run_module, "CHECKPOINT_S", 0.0)
    capture = open_capture(root)
    run = Run(capture.root, None, "vhap", quick_settings(iterations=ITERATIONS, lattice=1))
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)

    def no_more(progress):
        if progress.figures().get("iteration", 0) == FULL_AT:
            resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
        return False

    try:
        with refusal(r"checkpoint\.npz: cannot be written \(File too large\)"):
            train_run(capture, tmp_path, run, report=no_more)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert read_checkpoint(tmp_path).iteration == FULL_AT
    assert len(read_avatar(tmp_path / "avatar.npz").splats)
    assert not list(tmp_path.glob(".*"))
    assert not (tmp_path / "run.lock").exists()
    train_run(capture, tmp_path, run, resume=True)
    assert read_checkpoint(tmp_path).iteration == ITERATIONS


def test_an_error_when_the_data_reaches_the_disk(tmp_path, monkeypatch):
    """Catches a rename before the data is known to be on the disk: network drives report a full one
    only then."""
    write_json(tmp_path / "a.json", [1])

    def full(descriptor):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with refusal(r"a\.json: cannot be written"):
        write_json(tmp_path / "a.json", [2])
    assert read_json(tmp_path / "a.json") == [1]
    assert os.listdir(tmp_path) == ["a.json"]


def test_metrics_that_cannot_be_written(tmp_path):
    """Catches a traceback from the one file that is not replaced but grows."""
    (tmp_path / "metrics.jsonl").mkdir()
    with refusal(r"metrics\.jsonl: cannot be written"):
        append_metrics(tmp_path, {"iteration": 1})


CROWD = """
import os, sys, time
from pathlib import Path
from stga_addon.errors import StgaError
from stga_addon.training.run.folder import locked
folder = Path(sys.argv[1])
children = []
for n in range(8):
    children.append(os.fork())
    if children[-1] == 0:
        code, held = 0, 0
        end = time.monotonic() + 1.0
        while time.monotonic() < end:
            try:
                with locked(folder):
                    held += 1
                    os.close(os.open(folder / "inside", os.O_CREAT | os.O_EXCL))
                    (folder / "inside").unlink()
                    if held % 3 == 0:
                        (folder / "run.lock").write_text("999999999")
            except StgaError:
                pass
            except FileExistsError:
                code = 1
        os._exit(code if held else 2)
print([os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children])
"""


@pytest.mark.slow
@pytest.mark.skipif(
    not hasattr(os, "fork"), reason="needs processes that start within a microsecond"
)
def test_never_two_in_one_folder(tmp_path):
    """Catches two runs that both take over the lock of a third at the same moment."""
    with locked(tmp_path):
        pass
    (tmp_path / "run.lock").write_text("999999999")
    codes = output_of([sys.executable, "-c", CROWD, tmp_path], timeout=60)
    assert codes.strip() == str([0] * 8)
