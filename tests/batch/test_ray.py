"""The Ray engine on a cluster that is started here, with its token; skipped by name where Ray is not installed."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from stga_addon.batch.engines import ray as ray_engine
from stga_addon.batch.engines.local import LocalEngine
from stga_addon.batch.engines.table import make_engine
from stga_addon.errors import StgaError

from .simulated import carry_out
from .tiny import splats_of, tiny_plan

ROOT = Path(__file__).resolve().parents[2]
BATCH = """
import os, subprocess, sys
sys.path[:0] = [sys.argv[1], sys.argv[1] + "/tests"]
from pathlib import Path
from batch.simulated import carry_out
from batch.tiny import tiny_plan
from stga_addon.batch.engines.table import make_engine

engine = make_engine("ray")
assert os.environ["RAY_AUTH_MODE"] == "token"
import ray
address = ray.get_runtime_context().gcs_address
look = f"from ray._raylet import GcsClient; print(GcsClient(address={address!r}).get_all_node_info(timeout=60))"
for token, code in ((os.environ["RAY_AUTH_TOKEN"], 0), ("0" * 64, 1)):
    variables = {**os.environ, "RAY_AUTH_TOKEN": token}
    asked = subprocess.run([sys.executable, "-c", look], env=variables, capture_output=True, text=True, timeout=120)
    assert asked.returncode == code, asked
    assert ("InvalidAuthToken" in asked.stderr) == bool(code), asked
batch, _ = carry_out(tiny_plan(Path(sys.argv[2]), iterations=100), engine)
print(sorted((entry.job.name, str(entry.state), entry.error) for entry in batch.entries.values()))
"""


@pytest.mark.slow
def test_same_results_through_ray(tmp_path: Path) -> None:
    """Catches a job that trains something else through Ray, and a cluster that anyone on this machine may use."""
    pytest.importorskip("torch")
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'stga-addon[ray]'")
    for name in ("local", "ray"):
        (tmp_path / name).mkdir()
    variables = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    command = [sys.executable, "-c", BATCH, str(ROOT), str(tmp_path / "ray")]
    done = subprocess.run(command, env=variables, capture_output=True, text=True, timeout=400, cwd=ROOT)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    names = ("evaluate-seed0", "evaluate-seed1", "train-seed0", "train-seed1")
    assert done.stdout.splitlines()[-1] == str([(name, "finished", "") for name in names])
    here, there = (tiny_plan(tmp_path / name, iterations=100) for name in ("local", "ray"))
    carry_out(here, LocalEngine(2, 8.0))
    for seed in range(2):
        assert splats_of(there, f"train-seed{seed}") == splats_of(here, f"train-seed{seed}")


def test_without_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a traceback where Ray is not installed."""
    monkeypatch.setattr(ray_engine, "find_spec", lambda name: None)
    with pytest.raises(StgaError, match="--engine ray: the package ray is not installed"):
        make_engine("ray")
