"""Kernels from the cache against kernels that were just compiled."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("numba")
from stga_addon.raster.cpu.bundled import PROCESSOR


@pytest.mark.slow
def test_the_first_run_on_a_machine_has_the_bits_of_all_later_ones(
    kernel_bundle: tuple[Path, str],
) -> None:
    """Catches a helper that is called where it was compiled alone, in one process, and as a copy in
    the next."""
    folder, compiled = kernel_bundle
    environment = {
        **os.environ,
        "NUMBA_CACHE_DIR": str(folder),
        "NUMBA_CPU_NAME": PROCESSOR,
        "NUMBA_CPU_FEATURES": "",
    }
    script = Path(__file__).with_name("kernel_bits.py")
    command = [sys.executable, "-c", f"import runpy; runpy.run_path({str(script)!r})"]
    files = sorted(folder.rglob("*"))
    done = subprocess.run(
        command, env=environment, cwd=script.parents[2], capture_output=True, text=True, check=True
    )
    assert sorted(folder.rglob("*")) == files  # nothing was compiled again
    assert len(compiled.split()) == 8
    assert done.stdout == compiled
