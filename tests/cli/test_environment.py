"""`stga environment`: which Python trains, chosen and made from the command line."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from stga_addon.cli import environment as command
from stga_addon.cli.main import main
from stga_addon.worker.environment import PYTHON_VARIABLE, find_training_python


@pytest.fixture
def stga(tmp_path, monkeypatch):
    """The command with an environment folder of this test."""
    monkeypatch.delenv(PYTHON_VARIABLE, raising=False)
    monkeypatch.setenv(command.FOLDER_VARIABLE, str(tmp_path / "environment"))
    return lambda *arguments: main(["environment", *map(str, arguments)])


@pytest.fixture
def passing(tmp_path):
    """An interpreter that passes the test: a script that prints its report."""
    script = tmp_path / "python"
    versions = ", ".join(f'"{name}": "1.0"' for name in ("torch", "numba"))
    report = f'{{"python": "3.12.0", "versions": {{{versions}}}, "failures": {{}}, "device": "CPU", "adapters": []}}'
    script.write_text(f"#!/bin/sh\necho '{report}'\n")
    script.chmod(0o755)
    return script


@pytest.mark.skipif(os.name == "nt", reason="a shell script stands in for Python")
def test_use_and_remove(stga, passing, tmp_path, monkeypatch, capsys):
    """Catches a choice that Blender's side does not see, or that `remove` does not forget."""
    folder = tmp_path / "environment"
    assert stga("use", passing) == 0
    assert capsys.readouterr().out == f"{passing}: Python 3.12.0, torch 1.0, numba 1.0, CPU\n"
    assert find_training_python(folder) == str(passing)
    assert stga("test") == 0
    assert capsys.readouterr().out.startswith(f"{passing}: Python 3.12.0")
    assert stga("remove") == 0
    assert find_training_python(folder) != str(passing)
    monkeypatch.setenv(PYTHON_VARIABLE, "/farm/python")
    assert stga("use", passing) == 0
    assert "/farm/python takes precedence: STGA_PYTHON" in capsys.readouterr().out


@pytest.mark.parametrize("exists", [False, True])
def test_removing_what_is_not_there_leaves_no_trace(stga, tmp_path, capsys, exists):
    """Catches folders that `remove` makes, or takes away, where nothing was made."""
    folder = tmp_path / "environment"
    if exists:
        folder.mkdir()
    assert stga("remove") == 0
    assert capsys.readouterr().out == f"Removed 0 environment(s) from {folder}\n"
    assert list(tmp_path.rglob("*")) == ([folder] if exists else [])


@pytest.mark.parametrize("arguments", [("use", "{}/none"), ("use", "null\0"), ("make", "--wheels", "{}/none")])
def test_mistakes_are_sentences(stga, arguments, tmp_path, capsys):
    """Catches a traceback for a Python or a folder of wheels that is not there, and a choice stored all the same."""
    assert stga(*(argument.format(tmp_path) for argument in arguments)) == 2
    assert capsys.readouterr().err.startswith("stga: ")
    assert not (tmp_path / "environment" / "choice.json").exists()


@pytest.mark.slow
def test_failed_make_names_the_reason(stga, tmp_path, capsys):
    """Catches a failure of pip that is reported without its reason, and half an environment that stays."""
    (tmp_path / "wheels").mkdir()
    assert stga("make", "--wheels", tmp_path / "wheels") == 2
    seen = capsys.readouterr()
    assert "Creating the virtual environment" in seen.out
    assert "Installing from the folder of wheels failed: ERROR: No matching distribution" in seen.err
    assert not list((tmp_path / "environment").glob("venv-*"))


def test_commands_mark_their_environment(tmp_path):
    """Catches a command that trains in an environment which another process may remove meanwhile."""
    code = (
        "import runpy, sys; from pathlib import Path; sys.prefix = sys.argv[1]; sys.argv[1:] = ['--version']\n"
        "try: runpy.run_module('stga_addon', run_name='__main__')\n"
        "except SystemExit: print(sorted(path.name for path in Path(sys.prefix, 'users').iterdir()))"
    )
    (tmp_path / "ready").touch()
    done = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], stdout=subprocess.PIPE, text=True,
                            cwd=Path(__file__).parents[2])  # fmt: skip
    output, _ = done.communicate(timeout=60)
    assert output.splitlines()[-1] == f"['{done.pid}']"
