"""A run that is killed with no chance to clean up: the folder always opens, and little is lost."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from .kill_driver import INTERVAL

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.skipif(
        not hasattr(os, "fork"), reason="children are forked and killed with SIGKILL"
    ),
]
KILLS = int(os.environ.get("STGA_KILLS", 32))


def test_a_run_outlives_its_kills(tmp_path):
    """Catches a file that is half written when the process dies, a folder that a kill leaves locked
    or unusable, a run that loses its place or its last checkpoint, and half-written files that pile
    up.

    Every run that came to its end in spite of the kills must hold the bits of one that nobody
    disturbed.
    """
    driver = Path(__file__).with_name("kill_driver.py")
    command = [sys.executable, str(driver), str(tmp_path), str(KILLS)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    outcome = json.loads(done.stdout)
    records = outcome["records"]
    assert [record["error"] for record in records if record["error"]] == []
    assert [record["code"] for record in records if record["code"]] == []
    assert sum(record["killed"] for record in records) == KILLS
    # The kills must have fallen into training, not only before it or after its end.
    assert sum(record["killed"] and record["reached"] > 0 for record in records) > KILLS // 3
    held = {}
    for record in records:
        # A step takes one second of the run's own clock.
        assert record["iteration"] >= record["reached"] - INTERVAL - 1
        assert record["iteration"] >= held.get(record["folder"], 0)
        held[record["folder"]] = record["iteration"]
    assert outcome["finished"]
    assert all(outcome["finished"])
    assert outcome["litter"] == []
