"""A long run at toy size with everything on: what only breaks after thousands of steps. STGA_SOAK
sets how many."""

import os
from types import SimpleNamespace

import numpy as np
import pytest
from training.toys import bits, quick_settings

from stga_addon.capture.images import read_view
from stga_addon.training.optimize.precompile import precompile_kernels
from stga_addon.training.optimize.trainer import Trainer

pytestmark = pytest.mark.nightly
ITERATIONS = int(os.environ.get("STGA_SOAK", 1500))
OUTLIERS = 30
DENSITY = 40
MARK = 250
"""Iterations between two looks at the whole state."""
RSS_GROWTH = 24 << 20


def resident():
    """Bytes of this process in memory; 0 where the system does not say."""
    if not os.path.exists("/proc/self/statm"):
        return 0
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def soak(capture):
    """Train, in each step another view and another random choice of triangles; what the run left
    behind: memory and splats every MARK iterations, losses of global iterations, the number of
    local ones, and what was broken or thawed."""
    settings = quick_settings(
        "selective",
        iterations=ITERATIONS,
        lattice=1,
        warm_up_share=0.02,
        stray_reset_interval=OUTLIERS,
        stray_limit=0.5,
        density_interval=DENSITY,
        density_span=(0.0, 1.0),
        growth=0.5,
        scale_limit=1.0,
    )
    rng = np.random.default_rng(0)
    chosen = {}
    found = SimpleNamespace(local=0)
    for name in ("losses", "memory", "counts", "thawed", "broken"):
        setattr(found, name, [])
    trainer = Trainer(capture, settings, chosen)
    views = [read_view(view) for view in capture.views["train"]]
    for iteration in range(ITERATIONS):
        view, image, _ = views[rng.integers(len(views))]
        share = rng.choice([0.0, 0.01, 0.2, 0.7, 1.0])
        chosen[view.timestep] = rng.random(len(capture.faces)) < share
        face = trainer.state.face.copy()
        before = bits(trainer.state)
        loss = trainer.step(view, image, iteration / ITERATIONS)
        if loss is not None:
            found.losses.append(loss)
        else:
            found.local += 1
            # outliers and density may touch every row
            if trainer.iteration % OUTLIERS and trainer.iteration % DENSITY:
                frozen = ~chosen[view.timestep][face]
                now = bits(trainer.state)
                kept = (np.array_equal(before[n][frozen], now[n][frozen]) for n in before)
                found.thawed += [] if all(kept) else [iteration]
        if (iteration + 1) % MARK == 0:
            found.memory.append(resident())
            found.counts.append(len(trainer.state))
            state = bits(trainer.state)
            values = {n: a.view(np.float32) for n, a in state.items() if "/" in n}
            found.broken += [name for name, each in values.items() if not np.isfinite(each).all()]
    return found


def test_a_long_run(toy):
    """Catches NaN, a row that thaws, training that gets worse, and memory that grows with steps.

    Each tenth is no worse than a quarter above the best one before it; the first quarter may fill
    pools.
    """
    precompile_kernels()
    long = soak(toy)
    assert long.local > ITERATIONS // 3
    assert len(long.losses) > ITERATIONS // 4
    assert len(set(long.counts)) > 1
    assert long.broken == []
    assert np.isfinite(long.losses).all()
    assert long.thawed == []
    tenths = [float(np.mean(part)) for part in np.array_split(long.losses, 10)]
    assert tenths[-1] < 0.5 * tenths[0]
    for n in range(1, 10):
        assert tenths[n] < 1.25 * min(tenths[:n]) + 1e-3
    settled = long.memory[len(long.memory) // 4 :]
    assert max(settled[len(settled) // 2 :]) - min(settled) < RSS_GROWTH
