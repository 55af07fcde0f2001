"""A run that is killed with no chance to clean up: the folder always opens, and little is lost."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from .kill_driver import INTERVAL

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(
        not hasattr(os, "fork"), reason="children are forked and killed with SIGKILL"
    ),
]
KILLS = int(os.environ.get("STGA_KILLS", 32))


@pytest.fixture(scope="module")
def outcome(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    driver = Path(__file__).with_name("kill_driver.py")
    command = [sys.executable, str(driver), str(tmp_path_factory.mktemp("kills")), str(KILLS)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_the_folder_always_opens(outcome: dict[str, Any]) -> None:
    """Catches a checkpoint, avatar, selection or metrics file that is half written when the process
    dies."""
    records = outcome["records"]
    assert [record["error"] for record in records if record["error"]] == []
    assert sum(record["killed"] for record in records) == KILLS
    # The kills must have fallen into training, not only before it or after its end.
    assert sum(record["killed"] and record["reached"] > 0 for record in records) > KILLS // 3


def test_resuming_continues(outcome: dict[str, Any]) -> None:
    """Catches a folder that a kill leaves locked or unusable, and a run that loses its place.

    Every run that came to its end in spite of the kills must hold the bits of one that nobody
    disturbed.
    """
    assert [record["code"] for record in outcome["records"] if record["code"]] == []
    assert outcome["finished"]
    assert all(outcome["finished"])


def test_at_most_one_interval_is_lost(outcome: dict[str, Any]) -> None:
    """Catches checkpoints that come late, and a new checkpoint that destroys the last one before it
    is whole."""
    held: dict[int, int] = {}
    for record in outcome["records"]:
        # A step takes one second of the run's own clock.
        assert record["iteration"] >= record["reached"] - INTERVAL - 1
        assert record["iteration"] >= held.get(record["folder"], 0)
        held[record["folder"]] = record["iteration"]


def test_a_kill_leaves_no_litter_for_ever(outcome: dict[str, Any]) -> None:
    """Catches half-written files that pile up, one a kill, until the disk is full; and a lock
    nobody holds."""
    assert outcome["litter"] == []
