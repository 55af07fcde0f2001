"""Kernels are compiled before the clock of a run starts."""

import json
import os
import shutil
import subprocess
import sys

import pytest
from capture import factory
from PIL import Image

from stga_addon.raster.cpu import KERNEL_CACHE_FOLDER
from stga_addon.training.optimize.precompile import precompile_kernels

# In a process of its own: here other tests may already have compiled what is missing.
SCRIPT = """
import importlib, json, pkgutil, sys
from pathlib import Path
from numba.core.dispatcher import Dispatcher
import stga_addon.raster.cpu as kernels
from stga_addon.raster.cpu.precompile import compile_gradients, compile_rendering
from stga_addon.training.optimize import precompile
from stga_addon.training.run import session as run_module
from stga_addon.training.run.metrics_log import read_metrics
from stga_addon.training.run.folder import Run
from stga_addon.training.settings import make_settings
from stga_addon.capture.open import open_capture

out, *roots = map(Path, sys.argv[1:])
modules = [importlib.import_module(f"{kernels.__name__}.{m.name}")
    for m in pkgutil.iter_modules(kernels.__path__)]
functions = [getattr(f, "__wrapped__", f) for m in modules for f in vars(m).values()]
found = {f.__module__ + "." + f.__name__: f for f in functions if isinstance(f, Dispatcher)}
counts = lambda: {name: len(f.signatures) for name, f in found.items()}
compile_rendering()
compile_gradients()
compiled = counts()
precompile._render()
assert counts() == compiled  # what two processes compile is all of the rasterizer
run_module.precompile_kernels()
before = counts()
settings = make_settings(
    iterations=14, lattice=1, hull_points=False, warm_up_share=0.2, stray_reset_interval=3,
    density_interval=3, density_span=(0, 1), distance_weight=0.1, scale_limit=0.5, sh_steps=(0.2,
    0.4, 0.6),
)
for root in roots:
    run_module.train_run(open_capture(root), out / f"run of {root.name}", Run(root, None, "vhap",
    settings))
    assert len(read_metrics(out / f"run of {root.name}")) == 10
after = counts()
print(json.dumps([sum(before.values()), {name: [before[name], after[name]] for name in after}]))
"""


def test_training_compiles_nothing_new(tmp_path):
    """Catches a kernel first met in the middle of a run (other types, read-only or strided arrays):
    seconds lost.

    Images with transparency are decoded into arrays of another kind than those without.
    """
    roots = [
        factory.write_mesh_capture(tmp_path / name, (0, 1, 3), range(3))
        for name in ("opaque", "transparent")
    ]
    for path in (roots[1] / "images").iterdir():
        alpha = Image.open(roots[1] / "fg_masks" / path.name)
        image = Image.open(path).convert("RGB")
        image.putalpha(alpha)
        image.save(path)
    command = [sys.executable, "-c", SCRIPT, str(tmp_path), *map(str, roots)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    warmed, kernels = json.loads(done.stdout.splitlines()[-1])
    assert warmed >= 8
    new = {name: counts for name, counts in kernels.items() if counts[0] != counts[1]}
    assert not new


COLD = """
import json
from stga_addon.raster.cpu import tiles
from stga_addon.training.optimize import precompile
precompile._step = lambda: None  # which the first process compiles meanwhile
precompile.precompile_kernels()
kernel = getattr(tiles.list_pairs, "__wrapped__", tiles.list_pairs)
print(json.dumps([sum(kernel.stats.cache_hits.values()), len(kernel.signatures)]))
"""


@pytest.mark.nightly
@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="needs two processors")
def test_a_second_process_compiles_what_is_missing(tmp_path):
    """Catches a first start that waits for a second process and then compiles everything again, or
    never starts one.

    One kernel, and what tells that all are compiled, are missing in a copy of this machine's
    kernels.
    """
    precompile_kernels()
    shutil.copytree(
        KERNEL_CACHE_FOLDER, tmp_path / "kernels", ignore=shutil.ignore_patterns("*.tmp.*")
    )
    for name in ("tiles.list_pairs", "image_loss.image_loss"):
        removed = list((tmp_path / "kernels").glob(f"*/{name}-*"))
        assert removed
        for path in removed:
            path.unlink()
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "kernels")}
    done = subprocess.run(
        [sys.executable, "-c", COLD], capture_output=True, text=True, timeout=300, env=environment
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == [1, 1]
