"""Standard streams: closed pipes, full devices, ASCII, progress, interruption."""

import logging
import os
import re
import shutil
import signal
import subprocess
import sys
import time

import pytest
from capture import factory

from stga_addon.cli.commands import ProgressBar
from stga_addon.development.package import ROOT
from stga_addon.progress import Progress

STGA = f'"{sys.executable}" -m stga_addon'
INFO = "stga info --device cpu"
"""Without a look for graphics adapters, which takes as long as the rest of the command."""


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return factory.write_mesh_capture(tmp_path_factory.mktemp("streams") / "ball")


def shell(command, **environment):
    """Run a bash command line in which `stga` is the command line; its exit code."""
    script = f'stga() {{ {STGA} "$@"; }}\n{command}\nexit ${{PIPESTATUS[0]}}'
    return subprocess.run(
        ["bash", "-c", script],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, **environment},
        timeout=120,
    )


@pytest.mark.parametrize("command", ["info --device cpu", "select", "presets --help"])
def test_closed_pipe(capture, command):
    """Catches a traceback, or "Exception ignored", where the reader of a pipe has gone."""
    done = shell(f"stga {command} {capture} | head -c0")
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full on this system")
def test_full_device(capture):
    """Catches a traceback, and success although nothing could be printed."""
    done = shell(f"{INFO} {capture} > /dev/full")
    assert done.returncode == 2
    assert done.stderr == "stga: standard output cannot be written (No space left on device)\n"
    assert shell(f"{INFO} {capture} 2> /dev/full").returncode == 0
    assert shell(f"{INFO} /none 2> /dev/full").returncode == 2


@pytest.mark.parametrize(
    "environment", [{"PYTHONIOENCODING": "ascii"}, {"LC_ALL": "C", "PYTHONCOERCECLOCALE": "0"}]
)
def test_ascii_streams(tmp_path, environment):
    """Catches a UnicodeEncodeError for a folder's name, in the output and in an error."""
    capture = factory.write_mesh_capture(tmp_path / "Käthe−²")
    done = shell(f"{INFO} {capture}", PYTHONUTF8="0", **environment)
    assert (done.returncode, done.stderr) == (0, "")
    assert "320 triangles" in done.stdout
    done = shell(f"{INFO} {capture / 'none'}", PYTHONUTF8="0", **environment)
    assert done.returncode == 2
    assert done.stderr.startswith("stga: ")
    assert "Traceback" not in done.stderr


# Three commands of one process, which is started with all streams closed: any file may get any of
# their descriptors.
THREE = """
import os, sys
from stga_addon.cli.main import main
capture, out = sys.argv[1:]
train = ["train", capture, "--out", f"{out}/run", "--iterations", "2", "--strategy",
    "gaussian-avatars", "--device", "cpu"]
render = ["render", f"{out}/run", "--cameras", f"{capture}/transforms_val.json", "--out",
    f"{out}/pictures", "--device", "cpu"]
codes = [main(arguments) for arguments in (train, render, ["info", "/none"])]
null = os.stat(os.devnull)
assert codes == [0, 0, 2] and all(os.path.samestat(os.fstat(number), null) for number in range(3))
"""


def test_closed_descriptors(capture, tmp_path):
    """Catches a progress bar that needs stderr, and files that get a closed stream's descriptor."""
    done = shell(f"\"{sys.executable}\" -c '{THREE}' {capture} {tmp_path} <&- >&- 2>&-")
    assert (done.returncode, "Traceback" in done.stderr) == (0, False), done.stderr
    assert (tmp_path / "run/avatar.npz").exists()
    assert list((tmp_path / "pictures").glob("*.png"))
    for closed, folder, code in (("<&-", "/none", 2), (">&-", capture, 0), ("2>&-", "/none", 2)):
        assert shell(f"{INFO} {folder} {closed}").returncode == code, closed


def test_interrupted_training_keeps_its_exit_code(capture, tmp_path):
    """Catches a bar that needs a terminal, and a traceback or other code after Ctrl-C."""
    out = tmp_path / "run"
    command = [sys.executable, "-m", "stga_addon", "train", str(capture), "--out", str(out)]
    how = {"cwd": ROOT, "stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, "text": True}
    process = subprocess.Popen([*command, "--budget", "60s", "--device", "cpu"], **how)
    end = time.monotonic() + 60
    while not (out / "run.json").exists() and time.monotonic() < end:
        time.sleep(0.1)
    time.sleep(1)
    process.send_signal(signal.SIGINT)
    error = process.communicate(timeout=60)[1]
    assert process.returncode == 130, error
    assert error.splitlines()[-1] == "stga: interrupted"
    assert "Compiling kernels:" in error
    assert "Traceback" not in error


# A command that is interrupted while a library makes an object, which then complains when it is
# collected.
HALF_MADE = """
from dataclasses import replace
from stga_addon.cli import main
class Half:
    def __init__(self):
        raise KeyboardInterrupt
    def __del__(self):
        self.handle
main.COMMANDS["info"] = replace(main.COMMANDS["info"], run=lambda options, head: Half())
raise SystemExit(main.main(["info", "capture"]))
"""


@pytest.mark.skipif(os.name == "nt", reason="has no such limit")
def test_a_tight_limit_of_addresses_is_said(capture):
    """Catches a process that LLVM aborts, with std::bad_alloc as the only reason."""
    tight = shell(f"(ulimit -v 3000000; stga info {capture})")
    assert tight.returncode == 0
    said = "stga: warning: this process may have 3.1 GB of addresses (ulimit -v); expected 4 GB"
    assert tight.stderr.startswith(said)
    assert "ulimit" not in shell(f"{INFO} {capture}").stderr


@pytest.mark.skipif(sys.platform != "linux", reason="names there are Unicode")
def test_folders_that_no_path_reaches(capture, tmp_path):
    """Catches a run or a capture that cannot be read back, or a traceback, where a folder's or a
    photo's name is not UTF-8, or the working folder was removed; and what is written before that is
    found."""
    latin = os.path.join(os.fsencode(tmp_path), b"caf\xe9")
    os.makedirs(os.path.join(latin, b"gone"))
    shutil.copytree(os.fsencode(capture), os.path.join(latin, b"ball"))
    inside = f"cd {tmp_path}/caf*; PYTHONPATH={ROOT}"
    for arguments in (
        "ball --out /run",
        f"{capture} --out run",
        f"{tmp_path}/caf*/ball --out /run",
    ):
        done = shell(f"{inside} stga train {arguments}")
        assert done.returncode == 2
        assert re.search("^stga .*not UTF-8; rename it[)]$", done.stderr, re.MULTILINE)
    assert sorted(os.listdir(latin)) == [b"ball", b"gone"]
    os.mkdir(tmp_path / "photos")
    image = next((capture / "images").glob("*.png"))
    shutil.copy(image, os.path.join(os.fsencode(tmp_path), b"photos", b"Andr\xe9.png"))
    done = shell(f"stga track {tmp_path}/photos --out {tmp_path}/tracked")
    assert "photos/Andr\\udce9.png: is not a usable path" in done.stderr
    assert not (tmp_path / "tracked").exists()
    removed = f"mkdir {tmp_path}/gone; cd {tmp_path}/gone; rmdir {tmp_path}/gone"
    done = shell(f"{removed}; PYTHONPATH={ROOT} stga train {capture} --out run")
    assert done.returncode == 2
    assert "--out: run: is not a usable path (the working folder was removed" in done.stderr


# One that is interrupted where C code calls Python, as LLVM does for each kernel that it loads.
DROPPED = """
import ctypes, signal, time
from dataclasses import replace
from stga_addon.cli import main
calling = ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signal.SIGINT))
def run(options, head):
    calling()
    for _ in range(500):
        time.sleep(0.01)
main.COMMANDS["info"] = replace(main.COMMANDS["info"], run=run)
raise SystemExit(main.main(["info", "capture"]))
"""


@pytest.mark.parametrize("script", [DROPPED, HALF_MADE], ids=["dropped", "half made"])
def test_interruption_says_nothing_else(script):
    """Catches Ctrl-C without effect while kernels are loaded, and the traceback of a destructor
    where it came while a library made an object."""
    done = shell(f"\"{sys.executable}\" -c '{script}'")
    assert (done.returncode, done.stderr) == (130, "stga: interrupted\n")


def test_messages_have_lines_of_their_own(capsys):
    """Catches a sentence glued to the end of the bar."""
    with ProgressBar() as bar:
        bar.report(Progress(0.5, "Training"))
        logging.getLogger("stga_addon").warning("the GPU failed")
        bar.log("a warning")
        bar.report(Progress(0.6, "Training"))
    written = capsys.readouterr()
    lines = (written.err + "\n" + written.out).replace("\r", "\n").splitlines()
    assert {"the GPU failed", "a warning"} <= {line.strip() for line in lines}


FITTED = {"psnr": 31.0, "psnr_unmatched": 25.0}


@pytest.mark.parametrize(
    ("figures", "shown"),
    [
        (FITTED, "PSNR 31.00 dB (exposure fitted)   25.00 dB"),
        ({"left_s": 31.0}, "About 31 s left"),
    ],
)
def test_figures(capsys, figures, shown):
    """Catches a fitted PSNR that is not called so, and the bar's guess beside the work's."""
    with ProgressBar() as bar:
        for share in (0.0, 0.5):
            bar.report(Progress(share, "Landmarks", figures=lambda: figures))
    written = capsys.readouterr().err
    assert shown in written
    assert "<" not in written
