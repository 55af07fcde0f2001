"""A long run at toy size with everything on: what only breaks after thousands of steps. STGA_SOAK
sets how many."""

import hashlib
import os
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
import pytest
from capture import factory
from training.toys import bits, quick_settings

from stga_addon.capture.images import read_view
from stga_addon.capture.model import Capture
from stga_addon.capture.open import open_capture
from stga_addon.raster.cpu.threads import set_threads, threads
from stga_addon.training.optimize.precompile import precompile_kernels
from stga_addon.training.optimize.trainer import Trainer

pytestmark = pytest.mark.nightly
ITERATIONS = int(os.environ.get("STGA_SOAK", 1500))
STRAYS, DENSITY = 30, 40
MARK = 250  # iterations between fingerprints
RSS_GROWTH = 24 << 20


@dataclass
class Soak:
    """What a run left behind: fingerprints, memory and splats every MARK iterations, losses of
    global iterations, the number of local ones, and what was broken or thawed."""

    marks: list[str] = field(default_factory=list)
    losses: list[float] = field(default_factory=list)
    memory: list[int] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    local: int = 0
    thawed: list[int] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Capture:
    folder = tmp_path_factory.mktemp("soak")
    return open_capture(factory.write_mesh_capture(folder, (0, 1, 3), range(4)))


@pytest.fixture(autouse=True)
def as_many_threads_as_before() -> Iterator[None]:
    before = threads()
    yield
    set_threads(before)


def resident() -> int:
    """Bytes of this process in memory."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def soak(capture: Capture, until: int, on: int, seed: int = 0) -> Soak:
    """Train `until` of ITERATIONS steps, each with another view and another random choice of
    triangles."""
    set_threads(on)
    settings = quick_settings(
        "selective", iterations=ITERATIONS, seed=seed, lattice=1, warm_up_share=0.02,
        stray_reset_interval=STRAYS, stray_limit=0.5, density_interval=DENSITY,
        density_span=(0.0, 1.0), growth=0.5, scale_limit=1.0,
    )  # fmt: skip
    rng, chosen = np.random.default_rng(seed), dict[int, np.ndarray]()
    trainer = Trainer(capture, settings, chosen)
    views = [read_view(view) for view in capture.views["train"]]
    found = Soak()
    for iteration in range(until):
        view, image, _ = views[rng.integers(len(views))]
        share = rng.choice([0.0, 0.01, 0.2, 0.7, 1.0])
        chosen[view.timestep] = rng.random(len(capture.faces)) < share
        face, before = trainer.state.face.copy(), bits(trainer.state)
        loss = trainer.step(view, image, iteration / ITERATIONS)
        if loss is not None:
            found.losses.append(loss)
        else:
            found.local += 1
            # strays and density may touch every row
            if trainer.iteration % STRAYS and trainer.iteration % DENSITY:
                frozen = ~chosen[view.timestep][face]
                now = bits(trainer.state)
                kept = (np.array_equal(before[n][frozen], now[n][frozen]) for n in before)
                found.thawed += [] if all(kept) else [iteration]
        if (iteration + 1) % MARK == 0:
            _mark(trainer, found)
    return found


def _mark(trainer: Trainer, found: Soak) -> None:
    state = bits(trainer.state)
    whole = b"".join(state[name].tobytes() for name in sorted(state))
    found.marks.append(hashlib.sha256(whole).hexdigest())
    found.memory.append(resident())
    found.counts.append(len(trainer.state))
    for part in ("parameters", "first", "second"):
        arrays = getattr(trainer.state, part)._asdict()
        found.broken += [
            f"{part}/{name}" for name, array in arrays.items() if not np.isfinite(array).all()
        ]


@pytest.fixture(scope="module")
def long(capture: Capture) -> Soak:
    precompile_kernels()
    return soak(capture, ITERATIONS, on=2)


def test_a_long_run(long):
    """Catches NaN or infinity in parameters or moments, a row that a local iteration changed though
    its triangle was not selected, training that gets worse (each tenth is no worse than a quarter
    above the best one before it), and a soak without local steps, growth or pruning."""
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


@pytest.mark.skipif(
    not os.path.exists("/proc/self/statm"), reason="resident memory is read from /proc"
)
def test_memory_is_flat(long):
    """Catches a buffer that grows with the number of steps; the first quarter may fill pools."""
    settled = long.memory[len(long.memory) // 4 :]
    assert max(settled[len(settled) // 2 :]) - min(settled) < RSS_GROWTH
