"""A run that is killed with no chance to clean up: the folder always opens, and little is lost."""

import os
import sys
from pathlib import Path

import pytest
from blender.zips import output_of

KILLS = int(os.environ.get("STGA_KILLS", 32))


@pytest.mark.nightly
@pytest.mark.skipif(not hasattr(os, "fork"), reason="children are forked and killed with SIGKILL")
def test_a_run_outlives_its_kills(tmp_path):
    """Catches a file half written, a folder left locked, a lost checkpoint, and litter."""
    driver = Path(__file__).with_name("kill_driver.py")
    output_of([sys.executable, driver, tmp_path, KILLS], timeout=300)
