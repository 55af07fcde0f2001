"""Kernels are compiled before the clock of a run starts."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from capture import factory
from PIL import Image

# In a process of its own: here other tests may already have compiled what is missing.
SCRIPT = """
import importlib, json, pkgutil, sys
from pathlib import Path
from numba.core.dispatcher import Dispatcher
import stga_addon.raster.cpu as kernels
from stga_addon.training.run import loop as run_module
from stga_addon.training.run.metrics_log import read_metrics
from stga_addon.training.run.folder import Run
from stga_addon.training.settings import make_settings
from stga_addon.capture.open import open_capture

root, out = map(Path, sys.argv[1:])
modules = [importlib.import_module(f"{kernels.__name__}.{m.name}") for m in pkgutil.iter_modules(kernels.__path__)]
functions = [getattr(f, "__wrapped__", f) for m in modules for f in vars(m).values()]
found = {f.__module__ + "." + f.__name__: f for f in functions if isinstance(f, Dispatcher)}
counts = lambda: {name: len(f.signatures) for name, f in found.items()}
run_module.precompile_kernels()
before = counts()
capture = open_capture(root)
settings = make_settings(
    iterations=14, lattice=1, hull_points=False, warm_up_share=0.2, stray_reset_interval=3,
    density_interval=3, density_span=(0, 1), distance_weight=0.1, scale_limit=0.5, sh_steps=(0.2, 0.4, 0.6),
)
run_module.train(capture, out, Run(root, None, "vhap", settings))
assert len(read_metrics(out)) == 10
after = counts()
print(json.dumps([sum(before.values()), {name: [before[name], after[name]] for name in after}]))
"""


@pytest.mark.parametrize("transparent", [False, True])
def test_training_compiles_nothing_new(tmp_path: Path, transparent: bool) -> None:
    """Catches a kernel first met in the middle of a run (other types, read-only or strided arrays): seconds lost.

    Images with transparency are decoded into arrays of another kind than those without.
    """
    root = factory.write_mesh_capture(tmp_path / "capture", (0, 1, 3), range(3))
    if transparent:
        for path in (root / "images").iterdir():
            alpha = Image.open(root / "fg_masks" / path.name)
            image = Image.open(path).convert("RGB")
            image.putalpha(alpha)
            image.save(path)
    command = [sys.executable, "-c", SCRIPT, str(root), str(tmp_path / "run")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    warmed, kernels = json.loads(done.stdout.splitlines()[-1])
    assert warmed >= 8
    new = {name: counts for name, counts in kernels.items() if counts[0] != counts[1]}
    assert not new


COLD = """
import json
from stga_addon.raster.cpu import blend, project, tiles
from stga_addon.training.optimize import precompile
precompile._optimize = precompile._limit = lambda: None  # which the first process compiles meanwhile
precompile.precompile_kernels()
kernels = [getattr(kernel, "__wrapped__", kernel) for kernel in
    (tiles.fill_pairs, blend.blend_forward, blend.blend_backward, project.project_backward)]
print(json.dumps([[sum(kernel.stats.cache_hits.values()), len(kernel.signatures)] for kernel in kernels]))
"""


@pytest.mark.slow
@pytest.mark.skipif((os.cpu_count() or 1) < 2, reason="needs two processors")
def test_a_second_process_compiles_half_of_the_kernels(tmp_path: Path) -> None:
    """Catches a first start that waits for a second process and then compiles everything again, or never starts one."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    done = subprocess.run([sys.executable, "-c", COLD], capture_output=True, text=True, timeout=300, env=environment)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == [[1, 1]] * 4
