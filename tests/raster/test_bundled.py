"""Kernels that are compiled where an edition is built, and used where it is installed; kernels from
the cache against kernels that were just compiled."""

import os
import shutil
import sys
from pathlib import Path

import pytest
from blender.zips import output_of

from stga_addon.development.package import KERNELS_FOLDER, ROOT
from stga_addon.raster.cpu.bundled import BUNDLE, PROCESSOR, kernel_folder

STEP = """
import numpy as np
from stga_addon.raster.cpu import USES_BUNDLED_KERNELS
from stga_addon.raster.cpu.image_loss import change_background
image, black = np.zeros((4, 4, 3), np.uint8), np.zeros(3, np.float32)
out = np.empty_like(image)
change_background(image, np.zeros((4, 4), np.uint8), black, np.full(3, 7, np.float32), out)
print("RESULT", USES_BUNDLED_KERNELS, out.min(), out.max())
"""


def run(folder, cache, package="stga_addon", **variables):
    environment = {k: v for k, v in os.environ.items() if not k.startswith("NUMBA_")}
    environment |= {
        "NUMBA_CACHE_DIR": str(cache),
        "STGA_CACHE": str(cache),
        "NUMBA_DEBUG_CACHE": "1",
    }
    command = [sys.executable, "-c", STEP.replace("stga_addon", package)]
    environment |= variables
    return output_of(command, env=environment, cwd=folder)


def loads(output):
    """Whether the kernel came from the cache."""
    kernel = [
        line for line in output.splitlines() if "change_background" in line and "data " in line
    ]
    assert kernel
    return all("data loaded" in line for line in kernel)


@pytest.mark.slow
def test_kernels_of_another_machine_are_used_where_they_fit(tmp_path, monkeypatch):
    """Catches a first training that compiles what the zip holds, because of the folder, the time of
    the files or the processor's name; and kernels of an older version that are used for newer
    sources."""
    assert BUNDLE == ROOT / KERNELS_FOLDER
    built = tmp_path / "built"
    assert not loads(run(ROOT, built, NUMBA_CPU_NAME=PROCESSOR, NUMBA_CPU_FEATURES=""))
    shutil.copytree(ROOT / "stga_addon", tmp_path / "installed/stga_addon")
    shutil.copytree(next(built.iterdir()), tmp_path / "installed" / KERNELS_FOLDER)
    monkeypatch.setattr(
        "stga_addon.raster.cpu.bundled.BUNDLE", tmp_path / "installed" / KERNELS_FOLDER
    )
    monkeypatch.setattr("stga_addon.raster.cpu.bundled.config", type("Config", (), {})())
    if not kernel_folder(tmp_path / "a", tmp_path / "b")[1]:
        pytest.skip("this processor lacks AVX2")
    output = run(tmp_path / "installed", tmp_path / "cache")
    assert "RESULT True 7 7" in output
    assert loads(output)
    (tmp_path / "extension").symlink_to(tmp_path / "installed")  # the package inside of Blender
    output = run(tmp_path, tmp_path / "another", "extension.stga_addon")
    assert "RESULT False 7 7" in output
    assert not loads(output)
    with (tmp_path / "installed/stga_addon/raster/cpu/image_loss.py").open("a") as source:
        source.write("# newer\n")
    output = run(tmp_path / "installed", tmp_path / "cache")
    assert "RESULT True 7 7" in output
    assert not loads(output)


@pytest.mark.slow
def test_the_first_run_on_a_machine_has_the_bits_of_all_later_ones(kernel_bundle):
    """Catches a helper that is called in one process and compiled as a copy in the next."""
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
    found = output_of(command, env=environment, cwd=ROOT)
    assert sorted(folder.rglob("*")) == files  # nothing was compiled again
    assert len(compiled.split()) == 8
    assert found == compiled
