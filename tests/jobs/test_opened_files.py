"""How often a training that is asked for as the panel asks opens what it reads."""

import os
import sys
from collections import Counter
from dataclasses import dataclass, field

import pytest
from capture.factory import write_flame_capture

from stga_addon.jobs.perform import perform_in_folder, request_folder, write_request
from stga_addon.jobs.train import Extend, Refine, Resume, Train
from stga_addon.training.settings import make_settings

STREAMED = ("images", "fg_masks")
"""Folders of files that are too many to be held, and are decoded each time that they are needed."""


@dataclass
class Watch:
    """Counts the files of a folder that are opened to be read, while there is one."""

    folder: str = ""
    found: Counter = field(default_factory=Counter)

    def __call__(self, event, arguments):
        if event != "open" or not self.folder or not isinstance(arguments[0], str | os.PathLike):
            return
        path, mode, flags = arguments
        reads = mode == "r" or (mode is None and not flags & (os.O_WRONLY | os.O_RDWR))
        name = os.path.relpath(path, self.folder)
        if (reads or mode == "rb") and not name.startswith(".."):
            self.found[name] += not any(folder in name for folder in STREAMED)


@pytest.fixture(scope="module")
def watch():
    """One for all, because Python keeps its audit hooks."""
    found = Watch()
    sys.addaudithook(found)
    yield found
    found.folder = ""


def reads_of(watch, base, request):
    """The files below `base` that a request opens more than once -> how often."""
    folder = request_folder(request.run)
    write_request(folder, request)
    watch.found.clear()
    watch.folder = str(base)
    perform_in_folder(folder, lambda line: None)
    watch.folder = ""
    assert watch.found["head/flame_param/00000.npz"]  # it counts
    return {name: count for name, count in watch.found.items() if count > 1}


def test_a_training_reads_each_file_once(tmp_path, watch):
    """Catches a run, an avatar or a timestep's parameters that are read anew at each evaluation and
    by each part of a training, from a disk that may be far away."""
    base = tmp_path.resolve()
    _, model = write_flame_capture(base / "head", (0, 1, 2, 3), range(5))
    write_flame_capture(base / "second", (0, 1, 3), range(5))
    settings = make_settings(iterations=20, strategy="selective", lattice=1, hull_points=False)
    run = base / "run"
    assert reads_of(watch, base, Train(run, base / "head", settings, model, device="cpu")) == {}
    assert reads_of(watch, base, Resume(run, device="cpu", more_s=0.2)) == {}
    again = {"iterations": 4, "device": "cpu"}
    # its digest, before and after
    digests = {"run/avatar.npz": 3}
    refine = Refine(base / "run_2", run, region="mouth", **again)
    assert reads_of(watch, base, refine) == digests
    extend = Extend(base / "run_3", run, captures=(base / "second",), **again)
    assert reads_of(watch, base, extend) == digests
