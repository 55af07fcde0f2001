"""Files for farms: an OpenJD template that `openjd` runs, and a Flamenco job type that Node runs."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from capture.factory import write_mesh_capture

from stga_addon.batch.engines.openjd import MAX_STEPS, openjd_template
from stga_addon.batch.engines.table import emit
from stga_addon.batch.plan import make_plan
from stga_addon.batch.run import Batch
from stga_addon.errors import StgaError

from .simulated import SimulatedEngine, carry_out, empty_jobs

OPENJD = shutil.which("openjd", path=str(Path(sys.executable).parent)) or shutil.which("openjd")
AUTHOR = """
const made = [];
const author = {
  Task: (name, type) => ({ name, type, commands: [], after: [],
    addCommand(command) { this.commands.push(command); }, addDependency(task) { this.after.push(task.name); } }),
  Command: (name, parameters) => ({ name, parameters }),
};
const job = { settings: {}, addTask: (task) => made.push(task) };
compileJob(job);
console.log(JSON.stringify({ label: JOB_TYPE.label, settings: JOB_TYPE.settings, made }));
"""


def openjd(*arguments: str) -> str:
    if OPENJD is None:
        pytest.skip("openjd-cli is not installed: pip install openjd-cli")
    done = subprocess.run([OPENJD, *arguments], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout


@pytest.mark.slow
def test_openjd_runs_the_batch(tmp_path: Path) -> None:
    """Catches a template that schedulers refuse, or whose tasks do not do what the plan asks for."""
    if OPENJD is None:
        pytest.skip("openjd-cli is not installed: pip install openjd-cli")
    write_mesh_capture(tmp_path / "capture")
    look = {"request": "select", "capture": "capture"}
    plan = make_plan({"out": "runs", "job": {"look": look, "again": {**look, "after": ["look"]}}}, tmp_path, "plan")
    path = emit("openjd", Batch(plan))
    openjd("check", str(path))
    summary = json.loads(openjd("summary", str(path), "--output", "json"))
    assert summary["total_tasks"] == 2
    first, second = (step["name"] for step in json.loads(path.read_text())["steps"])
    openjd("run", str(path), "--step", second, "--run-dependencies")
    assert first.endswith("look")
    assert not Batch(plan).unfinished


def test_openjd_steps(tmp_path: Path) -> None:
    """Catches jobs that are left out of a template, share needs that are not theirs, or exceed its limits."""
    after = {"last": {"request": "analyze", "capture": "capture", "after": ["look"], "resources": {"memory_gb": 7}}}
    plan = empty_jobs(tmp_path, 1500, after)
    template = openjd_template(plan, plan.jobs)
    first, second, last = template["steps"]
    folders = [s["parameterSpace"]["taskParameterDefinitions"][0]["range"] for s in (first, second, last)]
    assert [len(found) for found in folders] == [1024, 476, 1]
    assert {folder for found in folders for folder in found} == {str(job.request_folder) for job in plan.jobs}
    for step in template["steps"]:
        arguments = step["script"]["actions"]["onRun"]["args"]
        assert arguments[arguments.index("perform") + 1] == "{{Task.Param.Folder}}"
    assert [each["dependsOn"] for each in last["dependencies"]] == [first["name"], second["name"]]
    assert "dependencies" not in second
    memory = {"name": "amount.worker.memory", "min": 7000}
    assert memory in last["hostRequirements"]["amounts"]
    assert memory not in first["hostRequirements"]["amounts"]
    (tmp_path / "capture").mkdir(exist_ok=True)
    tables = {f"t{n}": {"request": "analyze", "capture": "capture"} for n in range(MAX_STEPS)}
    with pytest.raises(StgaError, match="101 steps of an OpenJD template"):
        openjd_template(plan, empty_jobs(tmp_path, 1, tables).jobs)


@pytest.mark.needs("node")
def test_flamenco_compiles(tmp_path: Path) -> None:
    """Catches JavaScript that the manager cannot read, tasks in another order than the plan's, and jobs that are
    finished already."""
    (tmp_path / "shot.blend").touch()
    film = {"request": "render-blend", "blend": "shot.blend", "frames": [1, 2], "after": ["look"]}
    plan = empty_jobs(tmp_path, 2, {"last": {"request": "analyze", "capture": "{look}"}, "film": film})
    carry_out(plan, SimulatedEngine())
    (tmp_path / "runs/look-00001/job/status.json").unlink()
    path = emit("flamenco", Batch(plan))
    script = tmp_path / "run.js"
    script.write_text(path.read_text() + AUTHOR)
    done = subprocess.run(["node", "--use_strict", str(script)], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert found["settings"] == []
    assert {(task["name"], task["type"], *task["after"]) for task in found["made"]} == {
        ("look-00001", "misc"),
        ("last-00001", "misc", "look-00001"),
        ("film", "blender", "look-00001"),
    }
    (command,) = found["made"][0]["commands"]
    assert command["name"] == "exec"
    assert command["parameters"]["exe"] == "env"
    tail = ["stga_addon", "perform", str(tmp_path / "runs/look-00001/job"), "--resume"]
    assert command["parameters"]["args"][2:] == ["-m", *tail]
