"""The training environment: how it is chosen, made, checked, kept while in use, and removed; how making it fails."""

import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from stga_addon.errors import StgaError
from stga_addon.requests import environment_job, environment_make
from stga_addon.requests.environment_job import (
    check_arguments,
    check_python,
    describe_check,
    remove_environment,
    store_choice,
)
from stga_addon.requests.environment_make import InstallStep, install_steps, make_environment
from stga_addon.worker import environment
from stga_addon.worker.environment import (
    ADAPTERS_FILE,
    CHOICE_FILE,
    PYTHON_VARIABLE,
    find_training_python,
    made_python,
    status_folder,
    stored_adapters,
    stored_choice,
    venv_python,
)
from stga_addon.worker.environment_use import environment_users
from stga_addon.worker.launch import prepare_status_folder, start_worker
from stga_addon.worker.requirements import GPU_REQUIREMENT, REQUIREMENTS
from stga_addon.worker.status import LOG_FILE, WorkerState, inspect_worker, log_lines, read_status

FOUND = {
    "python": "3.11.7",
    "versions": dict.fromkeys(REQUIREMENTS, "1.0"),
    "failures": {},
    "device": "CPU with 4 threads",
    "adapters": ["Card (Vulkan)"],
}


def test_install_steps(tmp_path):
    """Catches pip's configured index ignored, offline steps that need a network, and packages left out."""
    looking, making, small, rest, gpu = install_steps(tmp_path, "/python", None, "linux")
    assert making.command == ["/python", "-m", "venv", str(tmp_path)]
    assert rest.command[0] == small.command[0] == str(venv_python(tmp_path))
    assert small.command[-3:] == ["--index-url", "https://download.pytorch.org/whl/cpu", "torch>=2.4,<3"]
    assert small.optional  # where pytorch.org cannot be reached, there is PyPI
    assert set(rest.command) >= set(REQUIREMENTS.values())
    assert not rest.optional
    assert "--index-url" not in rest.command
    assert gpu.command[-1] == GPU_REQUIREMENT
    assert gpu.optional  # the CPU trains everywhere
    assert install_steps(tmp_path, "/python", None, "win32") == [looking, making, rest, gpu]
    _, _, offline, offline_gpu = install_steps(tmp_path, "/python", tmp_path / "wheels", "linux")
    for step in (offline, offline_gpu):
        assert "--no-index" in step.command
        assert str(tmp_path / "wheels") in step.command
    assert set(offline.command) >= set(REQUIREMENTS.values())


@pytest.mark.parametrize(("newest", "status"), [((3, 11), 0), ((99, 0), 1)])
def test_old_python_is_refused_first(newest, status, tmp_path, monkeypatch):
    """Catches gigabytes downloaded for a Python that cannot use them."""
    monkeypatch.setattr(environment_make, "MIN_PYTHON", newest)
    looking = install_steps(tmp_path, sys.executable, None)[0]
    done = subprocess.run(looking.command, capture_output=True, text=True)
    assert done.returncode == status
    assert ("ERROR: Python 3." in done.stderr) == bool(status)


def test_check_is_described():
    """Catches an interpreter reported as usable that cannot train."""
    assert describe_check("p", FOUND) == "Python 3.11.7, torch 1.0, numba 1.0, CPU with 4 threads"
    old = {**FOUND, "python": "3.9.1"}
    with pytest.raises(StgaError, match=r"p: is Python 3\.9\.1, training needs 3\.11 or newer"):
        describe_check("p", old)
    bare = {**FOUND, "failures": {"torch": "ModuleNotFoundError: No module", "PIL": "OSError: libjpeg.so"}}
    with pytest.raises(StgaError, match=r"p: Python 3\.11\.7 lacks torch, pillow \(OSError: libjpeg\.so\); install"):
        describe_check("p", bare)


def test_bare_interpreter_is_checked(tmp_path):
    """Catches a check that itself needs a package: this interpreter has none."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(tmp_path / "venv")], check=True)
    python = str(venv_python(tmp_path / "venv"))
    with pytest.raises(
        StgaError, match=r"lacks numpy, torch, numba, scipy, .*matplotlib, av, opencv-python-headless; install"
    ):
        check_python(python)


def test_other_programs_are_refused(tmp_path):
    """Catches a traceback where the path is missing or that of another program."""
    with pytest.raises(StgaError, match="cannot be started as a Python interpreter"):
        check_python(str(tmp_path / "python"))
    with pytest.raises(StgaError, match=r"is not a Python that runs this add-on \(exit status 1\)"):
        check_python("false")


@pytest.mark.slow
def test_check_in_a_worker(tmp_path):
    """Catches a check that misses installed packages, and a worker without a status."""
    pytest.importorskip("torch")
    folder = status_folder(tmp_path)
    prepare_status_folder(folder)
    process = start_worker(folder, sys.executable, check_arguments(tmp_path, sys.executable))
    assert process.wait(120) == 0, log_lines(folder, 50)
    seen = inspect_worker(folder, process)
    assert seen.state == WorkerState.FINISHED
    assert seen.status.message.startswith(f"Python {sys.version.split()[0]}, torch ")
    assert (tmp_path / ADAPTERS_FILE).exists()
    if find_spec("wgpu") is not None:
        from stga_addon.raster.gpu.adapters import adapters

        assert stored_adapters(tmp_path) == list(adapters())


@pytest.fixture
def tiny(monkeypatch):
    """An installation of the virtual environment alone, without pip."""
    monkeypatch.setattr(environment_make, "SIZE_GB", 0.0)
    made = [sys.executable, "-m", "venv", "--without-pip"]
    monkeypatch.setattr(
        environment_make, "install_steps", lambda venv, *_: [InstallStep("making the environment", [*made, str(venv)])]
    )


def test_environment_is_made(tiny, tmp_path, monkeypatch):
    """Catches an environment used before it passed the check, or not found afterwards."""
    monkeypatch.setattr(environment_job, "check_python", lambda python, folder: f"good {Path(python).exists()}")
    python = venv_python(tmp_path / "venv-1")
    python.parent.mkdir(parents=True)
    python.touch()
    assert made_python(tmp_path) is None  # what a killed maker leaves
    assert make_environment(tmp_path, sys.executable) == "good True"
    made = made_python(tmp_path)
    assert made is not None
    assert [made] == [venv_python(folder) for folder in tmp_path.glob("venv-*")]
    assert read_status(status_folder(tmp_path)).message == "good True"


def test_failed_environment_is_removed(tiny, tmp_path):
    """Catches an incomplete environment that is used the next time."""
    with pytest.raises(StgaError, match="lacks numpy, torch"):
        make_environment(tmp_path, sys.executable)
    assert made_python(tmp_path) is None
    assert not list(tmp_path.glob("venv*"))
    assert inspect_worker(status_folder(tmp_path)).state == WorkerState.FAILED


def test_failed_attempt_keeps_the_environment(tiny, tmp_path, monkeypatch):
    """Catches a working environment lost when making a newer one fails."""
    with monkeypatch.context() as patched:
        patched.setattr(environment_job, "check_python", lambda python, folder: "good")
        make_environment(tmp_path, sys.executable)
    before = made_python(tmp_path)
    with pytest.raises(StgaError, match="lacks numpy, torch"):
        make_environment(tmp_path, sys.executable)
    assert before is not None
    assert made_python(tmp_path) == before


@pytest.mark.parametrize(
    ("printed", "reason"),
    [
        ("ERROR: Could not install packages due to an OSError: [Errno 28] No space left on device", "the disk is full"),
        (
            "The virtual environment was not created successfully because ensurepip is not\navailable",
            "no ensurepip; choo",
        ),
        (
            "WARNING: Retrying after connection broken by 'X'\nERROR: No matching distribution",
            "index cannot be reached",
        ),
        ("ERROR: no matching distribution\nnotice", "ERROR: no matching distribution$"),
        ("connection broken by an optional step\n$ pip\nERROR: no space", "ERROR: no space$"),
        ("ERROR: No matching distribution found for torch", "for torch: no version fits this Python and system$"),
        ("bye", "exit status 1$"),
    ],
)
def test_failing_step_names_its_reason(printed, reason, tiny, tmp_path, monkeypatch):
    """Catches pip's reason left in the log, or shown as pip words it."""
    log = status_folder(tmp_path) / LOG_FILE
    script = f"import sys; open({str(log)!r}, 'a').write({printed + chr(10)!r}); sys.exit(1)"
    monkeypatch.setattr(
        environment_make, "install_steps", lambda *_: [InstallStep("installing torch", [sys.executable, "-c", script])]
    )
    with pytest.raises(StgaError, match=f"installing torch failed: .*{reason}"):
        make_environment(tmp_path, sys.executable)


def test_optional_step_may_fail(tiny, tmp_path, monkeypatch):
    """Catches a failure where pytorch.org cannot be reached, but PyPI can."""
    monkeypatch.setattr(environment_job, "check_python", lambda python, folder: "good")
    failing = InstallStep("failing", [sys.executable, "-c", "raise SystemExit(1)"], optional=True)
    making = environment_make.install_steps
    monkeypatch.setattr(environment_make, "install_steps", lambda *given: [*making(*given), failing])
    assert make_environment(tmp_path, sys.executable) == "good"


def test_cancel_stops_pip_and_cleans_up(tiny, tmp_path, monkeypatch):
    """Catches a cancel that waits for a download, or leaves an incomplete environment."""
    folder = status_folder(tmp_path)
    script = f"import pathlib, time; pathlib.Path({str(folder / 'cancel')!r}).touch(); time.sleep(600)"
    steps = [
        InstallStep(
            "making the environment", [sys.executable, "-m", "venv", "--without-pip", str(tmp_path / "venv-1")]
        ),
        InstallStep("waiting", [sys.executable, "-c", script]),
    ]
    monkeypatch.setattr(environment_make, "install_steps", lambda *_: steps)
    assert make_environment(tmp_path, sys.executable) == ""
    assert inspect_worker(folder).state == WorkerState.CANCELLED
    assert not list(tmp_path.glob("venv*"))


def test_small_disk_is_refused(tmp_path, monkeypatch):
    """Catches a full disk after half an hour of downloading."""
    monkeypatch.setattr(environment_make.shutil, "disk_usage", lambda path: type("Usage", (), {"free": 10**8}))
    with pytest.raises(StgaError, match=r"has 0\.1 GB free, the environment needs 1\.5 GB"):
        make_environment(tmp_path, sys.executable, "cpu")


@pytest.fixture
def chosen(tmp_path, monkeypatch):
    """An environment folder and a check that every interpreter passes."""
    monkeypatch.delenv(PYTHON_VARIABLE, raising=False)
    monkeypatch.setattr(environment_job, "check_python", lambda python, folder: "good")
    return tmp_path / "environment"


def test_order_of_choices(chosen, tiny, monkeypatch):
    """Catches a farm's variable, the preferences or a stored choice that is overruled by a lower one."""
    monkeypatch.setattr(environment, "missing_packages", lambda: ["torch"])
    with pytest.raises(
        StgaError, match=rf"lacks torch.*complete edition.*environment use PATH`, or set {PYTHON_VARIABLE}"
    ):
        find_training_python(chosen)
    monkeypatch.setattr(environment, "missing_packages", list)
    assert find_training_python(chosen) == sys.executable
    make_environment(chosen, sys.executable)
    assert find_training_python(chosen) == str(venv_python(chosen / "venv-1"))
    assert store_choice(chosen, "/stored/python") == "good"
    assert find_training_python(chosen) == "/stored/python"
    assert find_training_python(chosen, "/preferred/python") == "/preferred/python"
    monkeypatch.setenv(PYTHON_VARIABLE, "/farm/python")
    assert find_training_python(chosen, "/preferred/python") == "/farm/python"
    monkeypatch.delenv(PYTHON_VARIABLE)
    make_environment(chosen, sys.executable)  # the later choice
    assert find_training_python(chosen) == str(venv_python(chosen / "venv-2"))


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"python": 3}', "null"])
def test_damaged_choice_is_a_sentence(tmp_path, text):
    """Catches a traceback for a damaged choice.json."""
    (tmp_path / CHOICE_FILE).write_text(text)
    with pytest.raises(StgaError, match=CHOICE_FILE):
        stored_choice(tmp_path)


def test_choice_that_cannot_train_is_refused(tmp_path):
    """Catches a choice stored although nothing can be trained with it."""
    with pytest.raises(StgaError, match="cannot be started as a Python interpreter"):
        store_choice(tmp_path, str(tmp_path / "python"))
    assert not list(tmp_path.iterdir())


def run_in(venv: Path) -> "subprocess.Popen[bytes]":
    """A process of the environment that has marked it as used and waits for its input to end."""
    code = (
        f"import sys; sys.path[:0] = {[path for path in sys.path if path]!r}; "
        "from stga_addon.worker.environment_use import mark_environment_used; mark_environment_used(); "
        "print('ready', flush=True); sys.stdin.read()"
    )
    process = subprocess.Popen([str(venv_python(venv)), "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    assert process.stdout is not None
    assert process.stdout.readline() == b"ready\n"
    return process


def test_environment_in_use_is_kept(chosen, tiny):
    """Catches an environment removed or replaced while a worker trains with it."""
    make_environment(chosen, sys.executable)
    with run_in(chosen / "venv-1") as worker:
        assert environment_users(chosen / "venv-1") == [worker.pid]
        with pytest.raises(StgaError, match=rf"venv-1: is in use by process {worker.pid}"):
            remove_environment(chosen)
        make_environment(chosen, sys.executable)
        assert venv_python(chosen / "venv-1").exists()
        assert made_python(chosen) == venv_python(chosen / "venv-2")
        worker.kill()
    assert environment_users(chosen / "venv-1") == []
    make_environment(chosen, sys.executable)
    assert sorted(path.name for path in chosen.glob("venv-*")) == ["venv-3"]


def test_environment_is_removed(chosen, tiny):
    """Catches a removal that leaves the environment or the stored choice, or takes other files with it."""
    make_environment(chosen, sys.executable)
    store_choice(chosen, "/stored/python")
    (chosen / "venv-notes").mkdir()
    assert remove_environment(chosen) == 1
    assert made_python(chosen) is None
    assert stored_choice(chosen) == ""
    assert (chosen / "venv-notes").exists()
    assert remove_environment(chosen) == 0


def test_installation_does_not_see_other_packages(tiny, tmp_path, monkeypatch):
    """Catches pip that takes packages on the worker's path for installed ones."""
    monkeypatch.setenv("PYTHONPATH", "/bundled")
    monkeypatch.setattr(environment_job, "check_python", lambda python, folder: "good")
    code = "import os, sys; sys.exit('PYTHONPATH' in os.environ)"
    making = environment_make.install_steps
    step = InstallStep("looking", [sys.executable, "-c", code])
    monkeypatch.setattr(environment_make, "install_steps", lambda *given: [*making(*given), step])
    assert make_environment(tmp_path, sys.executable) == "good"
