"""The Python that tracks and trains: how it is chosen and checked."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from refusal import refusal

from stga_addon.development.package import ROOT
from stga_addon.jobs.python_check import describe_check, finish_check, start_check
from stga_addon.worker import training_python
from stga_addon.worker.training_python import (
    CAMERAS_REQUIREMENT,
    GPU_REQUIREMENT,
    PYTHON_VARIABLE,
    REQUIREMENTS,
    find_training_python,
    package_name,
)

FOUND = {
    "python": "3.11.7",
    "versions": dict.fromkeys(REQUIREMENTS, "1.0"),
    "failures": {},
    "device": "CPU with 4 threads",
    "adapters": ["Card (Vulkan)"],
}


def check(python, timeout_s=120.0):
    return finish_check(str(python), start_check(str(python)), timeout_s)


def test_check_is_described():
    """Catches an interpreter reported as usable that cannot train."""
    assert describe_check("p", FOUND) == "Python 3.11.7, torch 1.0, numba 1.0, CPU with 4 threads"
    old = {**FOUND, "python": "3.9.1"}
    with refusal(r"p: is Python 3\.9\.1, training needs 3\.11 or newer"):
        describe_check("p", old)
    failures = {"torch": "ModuleNotFoundError: No module", "PIL": "OSError: libjpeg.so"}
    bare = {**FOUND, "failures": failures}
    with refusal(r"p: Python 3\.11\.7 lacks torch, pillow \(OSError: libjpeg\.so\); install"):
        describe_check("p", bare)


def test_what_cannot_train_is_refused(tmp_path):
    """Catches a check that needs a package, and a program that is waited for for ever."""
    make = [sys.executable, "-m", "venv", "--without-pip", str(tmp_path / "venv")]
    subprocess.run(make, check=True)
    python = next(path for path in (tmp_path / "venv").glob("*/python*") if path.stem == "python")
    with refusal(r"lacks numpy, torch, numba, scipy, .*av, opencv-python-headless; install"):
        check(python)
    with refusal("cannot be started as a Python interpreter"):
        check(tmp_path / "python")
    with refusal(r"is not a Python that runs this add-on \(exit status 1\)"):
        check("false")
    (tmp_path / "slow").write_text("#!/bin/sh\nexec sleep 60\n")
    (tmp_path / "slow").chmod(0o755)
    with refusal("slow: did not answer within"):
        check(tmp_path / "slow", timeout_s=0.2)


@pytest.mark.slow
def test_this_interpreter_passes():
    """Catches a check that misses installed packages, or the GPUs that can be named."""
    from stga_addon.raster.gpu.adapters import adapters

    found = check(sys.executable)
    assert found.line.startswith(f"Python {sys.version.split()[0]}, torch ")
    assert found.adapters == tuple(adapters())


def test_order_of_choices(monkeypatch):
    """Catches a farm's variable or the preferences overruled, and no word of what to do."""
    monkeypatch.delenv(PYTHON_VARIABLE, raising=False)
    monkeypatch.setattr(training_python, "missing_packages", lambda: ["torch"])
    with refusal(rf"lacks torch\. Install the complete edition .* or by {PYTHON_VARIABLE}"):
        find_training_python()
    assert find_training_python("/preferred/python") == "/preferred/python"
    monkeypatch.setattr(training_python, "missing_packages", list)
    assert Path(find_training_python()).samefile(sys.executable)
    monkeypatch.setenv(PYTHON_VARIABLE, "/farm/python")
    assert find_training_python("/preferred/python") == "/farm/python"


PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]


def test_requirements():
    """Catches other versions than an installation by pip has, and ones that are not bounded."""
    extras = PROJECT["optional-dependencies"]
    required = sorted([*REQUIREMENTS.values(), CAMERAS_REQUIREMENT])
    assert required == sorted([*PROJECT["dependencies"], *extras["train"]])
    assert GPU_REQUIREMENT in extras["gpu"]
    for requirement in [*required, GPU_REQUIREMENT]:
        assert re.fullmatch(r"[a-z-]+>=[\d.]+,<\d+", requirement)
        assert re.fullmatch(r"[a-z-]+", package_name(requirement))
