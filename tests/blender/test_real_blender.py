"""The complete edition in real Blenders without a network, from installing to uninstalling.

The wheels of the Python of each are downloaded into build/wheels, where they are missing.
"""

import json
import os
import subprocess
import time
import tomllib
from dataclasses import replace
from pathlib import Path

import pytest

from stga_addon import __version__
from stga_addon.development.compiled_kernels import compile_kernels
from stga_addon.development.editions import complete
from stga_addon.development.package import ROOT, build_zip, target_of, wheel_folder
from stga_addon.development.wheels import collect_wheels
from stga_addon.errors import StgaError
from stga_addon.jobs.perform import perform
from stga_addon.jobs.train import Train
from stga_addon.progress import ignore
from stga_addon.training.run.metrics_log import read_metrics
from stga_addon.training.settings import make_settings
from stga_addon.worker.status import WorkerState, inspect_worker

from .zips import BLENDERS, OLD_VERSION, name_of, output_of, with_version

pytestmark = [
    pytest.mark.nightly,
    pytest.mark.skipif(not BLENDERS, reason="STGA_BLENDER does not say how to start a Blender"),
]
SCRIPT = Path(__file__).with_name("complete_script.py")
ITERATIONS = 60
UPDATE_ITERATIONS = 3000
"""Of a training; of one that is still at work when the update has ended."""
MAX_DIFFERENCE_DB = 0.3
TIMEOUT_S = 1800.0


def offline():
    """A prefix of commands that leaves them no network but the machine itself."""
    inside = ["sh", "-c", 'ip link set lo up; exec "$@"', "sh"]
    prefixes = (["unshare", "-n", *inside], ["unshare", "-rn", *inside], [])
    return next(
        prefix
        for prefix in prefixes
        if not prefix or not subprocess.run([*prefix, "true"]).returncode
    )


def complete_zip(command, out, demo):
    """The complete edition for a Blender, in `out`; skips where wheels cannot be had."""
    target = replace(target_of(command), cuda=True)
    try:
        collect_wheels(wheel_folder(target), target)
    except StgaError as error:
        pytest.skip(f"wheels not present and not downloadable: {error}")
    kernels = compile_kernels(target, wheel_folder(target), command)
    return build_zip(out, edition=complete(target), demo=demo, kernels=kernels)


def blender(command, home, *arguments, background=True, **variables):
    """Run a Blender in a home folder of its own, without a network; with environment variables."""
    others = ("PYTHON", "BLENDER", "STGA", "NUMBA")
    kept = {name: value for name, value in os.environ.items() if not name.startswith(others)}
    full = [*offline(), *command, *["--background"] * background, *map(str, arguments)]
    how = {"env": {**kept, "HOME": str(home), **variables}, "timeout": TIMEOUT_S}
    output_of(full, cwd=ROOT, **how)


def install(command, home, archive):
    """Install the zip of an edition, and enable it."""
    extension = ("--command", "extension", "install-file", "--repo", "user_default", "--enable")
    blender(command, home, *extension, archive)


def files_of(home):
    """All files in a home folder but those that Blender itself writes."""
    caches = ".cache/blender", ".cache/mesa_shader_cache", ".cache/openbox"
    own = *caches, ".config/blender", ".local"
    extension = ("/user_default/stga/", "extensions/.local/lib", ".user/user_default/stga")
    names = {path.relative_to(home).as_posix() for path in home.rglob("*") if not path.is_dir()}
    # Of modules of a single file, such as typing_extensions.py, Blender leaves what its own Python
    # has compiled.
    names = {name for name in names if "/site-packages/__pycache__/" not in name}
    is_ours = {name: any(part in name for part in extension) for name in names}
    return {name for name in names if is_ours[name] or not name.startswith(own)}


@pytest.fixture(scope="module")
def home(demo, tmp_path_factory):
    """A home folder in which every Blender has an old version of the complete edition."""
    folder = tmp_path_factory.mktemp("real")
    home = folder / "home"
    home.mkdir()
    for command in BLENDERS:
        new = complete_zip(command, folder / name_of(command), demo)
        blender(command, home, "--command", "extension", "validate", new)
        old = with_version(new, OLD_VERSION, folder / "old.zip")
        install(command, home, old)
        old.unlink()  # gigabytes
    return home


def script(command, home, wait, iterations):
    """What complete_script.py saw."""
    result = home.parent / "result.json"
    arguments = (result, int(wait), f"iterations={iterations}")
    blender(command, home, "--python-exit-code", 1, "--python", SCRIPT, "--", *arguments)
    seen = json.loads(result.read_text())
    print(seen)
    return seen


@pytest.mark.parametrize("command", BLENDERS, ids=name_of)
def test_train(command, home, demo, tmp_path):
    """Catches a missing wheel, a worker that needs a Python or network, and worse avatars."""
    seen = script(command, home, True, ITERATIONS)
    settings = make_settings("global", iterations=ITERATIONS)
    perform(Train(tmp_path / "here", demo, settings), ignore, print)
    found, expected = (
        read_metrics(run)[-1]["psnr"] for run in (Path(seen["run"]), tmp_path / "here")
    )
    assert abs(found - expected) < MAX_DIFFERENCE_DB
    assert seen["splats"] > 0


@pytest.mark.parametrize("command", BLENDERS, ids=name_of)
def test_update_while_a_worker_trains(command, home):
    """Catches an update that fails, ends a training, or disturbs another Blender."""
    seen = script(command, home, False, UPDATE_ITERATIONS)
    run = Path(seen["run"])
    others = other_profiles(home, seen["version"])
    while not (run / "job/preview.npz").exists() and inspect_worker(run / "job").state.is_alive:
        time.sleep(0.2)
    new = next((home.parent / name_of(command)).glob("*.zip"))
    install(command, home, new)
    assert inspect_worker(run / "job").state.is_alive, "the training ended before the update"
    manifest = next(
        home.glob(f".config/blender/{short(seen['version'])}/extensions/user_default/stga/*.toml")
    )
    assert tomllib.loads(manifest.read_text())["version"] == __version__
    while (last := inspect_worker(run / "job")).state.is_alive:
        time.sleep(0.5)
    assert last.state == WorkerState.FINISHED, last
    assert (run / "avatar.npz").is_file()
    assert other_profiles(home, seen["version"]) == others


def test_uninstall(home):
    """Catches files that uninstalling leaves, and one that disturbs another Blender's extension."""
    for command in BLENDERS:
        version = output_of([*command, "--version"], cwd=ROOT).split()[1]
        others = other_profiles(home, version)
        blender(command, home, "--command", "extension", "remove", "user_default.stga")
        assert other_profiles(home, version) == others
    assert {name for name in files_of(home) if not name.startswith("STGA Demo/run")} == set()


def short(version):
    return ".".join(version.split(".")[:2])


def other_profiles(home, version):
    """Files of other Blender versions' extensions, and when they were changed."""
    profiles = [path for path in home.glob(".config/blender/*") if path.name != short(version)]
    files = [path for profile in profiles for path in (profile / "extensions").rglob("*")]
    return {str(path): path.stat().st_mtime_ns for path in files if path.is_file()}
