"""Standard output claimed for messages."""

import subprocess
import sys

import pytest

SCRIPT = """
import os, sys
if {closed}: os.close(2)
from stga_addon.worker.helpers import claim_stdout
messages = claim_stdout()
os.write(1, b"from C")
if not {closed}: print("from Python")
messages.write(b"message")
messages.flush()
"""


@pytest.mark.parametrize("closed", [False, True])
def test_only_messages_reach_standard_output(closed: bool) -> None:
    """Catches output of libraries between the messages, and a closed standard error that ends the
    process."""
    done = subprocess.run([sys.executable, "-c", SCRIPT.format(closed=closed)], capture_output=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout == b"message"
    if not closed:
        assert b"from C" in done.stderr
        assert b"from Python" in done.stderr
