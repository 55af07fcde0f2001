"""Adam with true freezing against torch's, which counts per tensor: here one a row."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from stga_addon.capture.camera import Camera
from stga_addon.training.optimize import adam
from stga_addon.training.optimize.state import new_state
from stga_addon.training.settings import TrainingSettings

from .toys import bits, random_splats, random_state

RATES = {
    "xyz": 1e-3,
    "rotation": 5e-3,
    "log_scale": 2e-2,
    "opacity": 5e-2,
    "sh": 1e-2,
    "sh_rest": 1e-3,
}
OPTIONS = adam.PLAIN._replace(
    beta2=np.float32(0.99), ema_share=np.float32(0.2), epsilon=np.float32(1e-5)
)


def set_gradients(state, rng, scale=1.0):
    for array in state.gradients:
        array[:] = rng.normal(0, scale, array.shape)


def separate_rows(state):
    """Each row's parameters as float64 tensors of their own; the view-dependent color apart."""
    rows = []
    for n in range(len(state)):
        row = {
            name: torch.tensor(a[n], dtype=torch.float64)
            for name, a in state.parameters._asdict().items()
        }
        row["sh"], row["sh_rest"] = row["sh"][:1].clone(), row["sh"][1:].clone()
        rows.append({name: value.requires_grad_() for name, value in row.items()})
    return rows


@pytest.mark.parametrize(("seed", "degree"), [(0, 1), (1, 1), (2, 3), (3, 0)])
def test_each_row_is_torchs_adam_with_its_own_history(seed, degree):
    """Catches a shared step count, momentum that moves unlisted rows, a swapped rate or beta, a
    misplaced ε, and a running average that begins with the initial value, or goes on while its row
    is frozen.

    With constant color, other parameters have more columns than `sh`.
    """
    state = new_state(random_splats(6, 4, seed, degree))
    rng = np.random.default_rng(seed)
    rows = separate_rows(state)
    groups = [{"params": [row[name] for row in rows], "lr": rate} for name, rate in RATES.items()]
    theirs = torch.optim.Adam(groups, betas=(0.9, 0.99), eps=1e-5)
    history = [[] for _ in rows]
    for _ in range(25):
        listed = np.flatnonzero(rng.random(6) < [1, 0.7, 0.5, 0.3, 0.1, 0.0]).astype(np.int32)
        # Sizes over many orders of magnitude: those of real gradients are 1e-8 to 1e-3.
        set_gradients(state, rng, 10 ** rng.uniform(-8, 0))
        for n, row in enumerate(rows):
            for name, value in row.items():
                gradient = torch.tensor(
                    getattr(state.gradients, name.removesuffix("_rest"))[n], dtype=torch.float64
                )
                if name.startswith("sh"):
                    gradient = gradient[1:] if name == "sh_rest" else gradient[:1]
                value.grad = gradient.clone() if n in listed else None
        theirs.step()
        adam.step(state, listed, RATES, OPTIONS)
        for n in listed:
            history[n].append(rows[n]["xyz"].detach().clone())
    for n, values in enumerate(history):
        average = torch.tensor(state.parameters.xyz[n], dtype=torch.float64)
        for count, value in enumerate(values, 1):
            average = average.lerp(value, max(0.2, 4 / (count + 3)))
        assert_allclose(state.average.xyz[n], average, rtol=1e-5, atol=25 * RATES["xyz"] * 1e-5)
    for n, row in enumerate(rows):
        for name in ("xyz", "rotation", "log_scale", "opacity"):
            # 25 float32 steps of at most the rate each
            found = getattr(state.parameters, name)[n]
            wanted = row[name].detach()
            assert_allclose(found, wanted, rtol=1e-5, atol=25 * RATES[name] * 1e-5)
        color = torch.cat([row["sh"], row["sh_rest"]]).detach()
        assert_allclose(state.parameters.sh[n], color, rtol=1e-5, atol=25 * RATES["sh"] * 1e-5)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_broken_gradient_leaves_its_row(bad):
    """Catches one NaN spreading into parameters or moments, where it would stay for ever."""
    state = random_state(4, 3)
    before = bits(state)
    state.gradients.log_scale[1, 2] = bad
    state.gradients.sh[2, 3, 1] = bad
    adam.step(state, np.arange(4, dtype=np.int32), RATES)
    after = bits(state)
    for part in ("parameters", "first", "second"):
        assert_array_equal(after[f"{part}/log_scale"][1], before[f"{part}/log_scale"][1])
        rest = slice(12, None)  # bytes after the first coefficient's three floats
        assert_array_equal(after[f"{part}/sh"][2, rest], before[f"{part}/sh"][2, rest])
        for row in (0, 2, 3):
            assert (after[f"{part}/log_scale"][row] != before[f"{part}/log_scale"][row]).any()
    for array in (*state.parameters, *state.first, *state.second):
        assert np.isfinite(array).all()


@pytest.mark.parametrize("ahead", [0.0, 0.1])
def test_many_rows(ahead):
    """Catches others' step counts in blocks for threads, unused harmonics, and momentum."""
    state = random_state(1500, 7)
    rng = np.random.default_rng(0)
    state.steps[:] = rng.integers(0, 50, 1500)
    rows = np.sort(rng.permutation(1500)[:1100]).astype(np.int32)
    counts = state.steps[rows] + 1.0
    old = {
        f"{p}/{n}": getattr(getattr(state, p), n)[rows].astype(float)
        for p in ("first", "second")
        for n in RATES
        if n != "sh_rest"
    }
    before = {name: array[rows].astype(float) for name, array in state.parameters._asdict().items()}
    adam.step(state, rows, RATES, adam.PLAIN._replace(ahead=np.float32(ahead)), sh_degree=1)
    assert_array_equal(state.steps[rows], counts)
    for name, value in before.items():
        gradient = getattr(state.gradients, name)[rows].astype(float)
        per_row = counts.reshape(-1, *[1] * (value.ndim - 1))
        first = 0.9 * old[f"first/{name}"] + 0.1 * gradient
        in_use = (..., slice(4), slice(None)) if name == "sh" else ...
        kept = getattr(state.first, name)[rows]
        assert_allclose(kept[in_use], first[in_use], rtol=1e-5, atol=1e-6)
        mean = ((1 - ahead) * first + ahead * gradient) / (1 - (1 - ahead) * 0.9**per_row)
        square = (0.999 * old[f"second/{name}"] + 0.001 * gradient**2) / (1 - 0.999**per_row)
        rate = np.full(value.shape[1:], RATES[name])
        if name == "sh":
            rate[1:] = RATES["sh_rest"]
            rate[4:] = 0
        step = rate * mean / np.sqrt(square)
        # Where the random second moment is near zero a step is many rates long, and rounded in
        # proportion.
        error = np.abs(getattr(state.parameters, name)[rows] - (value - step))
        assert (error <= 1e-6 + 1e-5 * np.abs(step) + 1e-6 * np.abs(value)).all(), name


def test_epsilon_is_the_same_share_at_every_image_size():
    """Catches splats that hardly show learning at another speed on images of another size."""
    camera = Camera(200, 100, 300.0, 300.0, 100.0, 50.0, np.eye(4))
    epsilon = adam.adam_options(TrainingSettings(adam_epsilon=0.003), camera).epsilon
    assert epsilon == np.float32(0.003 / 60_000)
