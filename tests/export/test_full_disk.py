"""Exports to a disk without room."""

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from robustness.test_disks import PRIVATE, can_mount

from stga_addon.export.formats import FORMATS

SMALL_DISK = 'mount -t tmpfs -o size=24m small "$1" && exec "$2" "$3" "$1"'


@pytest.mark.slow
def test_every_format_on_a_full_disk(tmp_path: Path) -> None:
    """Catches a format whose message leaves out the file or the cause, and files or folders left by half an export."""
    if not can_mount():
        pytest.skip("private mounts (unshare -rm) are not available")
    driver = str(Path(__file__).with_name("full_disk_driver.py"))
    command = [*PRIVATE, "sh", "-c", SMALL_DISK, "sh", str(tmp_path), sys.executable, driver]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2])}
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, env=environment)
    assert done.returncode == 0, done.stderr
    results = json.loads(done.stdout)
    assert {result["format"] for result in results} == set(FORMATS)
    for result in results:
        assert result["message"].startswith(str(tmp_path / "new/")), result
        assert f"cannot be written ({os.strerror(errno.ENOSPC)})" in result["message"], result
        assert result["left"] == [], result
    assert "Traceback" not in done.stderr
