"""The complete edition where Python has numpy alone and no network: it tracks and trains."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("bpy")


from tracking.head_video import write_head_video

from stga_addon.avatar.file import read_avatar
from stga_addon.development.editions import complete
from stga_addon.development.package import build_zip, wheel_folder
from stga_addon.development.wheels import Target, check_wheels, collect_wheels, this_platform
from stga_addon.errors import StgaError
from stga_addon.jobs.perform import perform
from stga_addon.jobs.train import Train
from stga_addon.progress import ignore
from stga_addon.training.run.metrics_log import read_metrics
from stga_addon.training.settings import make_settings

from .zips import result_of

OWN_PACKAGES = "bpy numpy numpy.libs zstandard requests urllib3 idna certifi charset_normalizer"
"""What a Blender's Python has of its own."""
OFFLINE = ["unshare", "-rn"]
ITERATIONS = 60
MAX_DIFFERENCE_DB = 0.3
SCRIPT = """
import json, sys
from pathlib import Path
import bpy
archive, home, video = sys.argv[1], Path(sys.argv[2]), sys.argv[4]
from importlib.util import find_spec
result = {"before": [name for name in ("torch", "numba", "scipy") if find_spec(name)]}
install = bpy.ops.extensions.package_install_files
install(filepath=archive, repo="user_default", enable_on_install=False)
bpy.ops.wm.read_factory_settings(use_empty=True)
module = "bl_ext.user_default.stga"
bpy.ops.preferences.addon_enable(module=module)
result["heavy"] = sorted({"torch", "numba"} & set(sys.modules))
bpy.ops.stga.open_demo()
settings = bpy.context.scene.stga
result["run"], result["minutes"] = settings.run_folder, settings.minutes
folder, count = settings.run_folder, int(sys.argv[3])
bpy.ops.stga.train(directory=folder, iterations=count, python=sys.executable)
bpy.ops.stga.show_avatar(filepath=settings.avatar)
bpy.ops.stga.open_demo()
result["next run"] = settings.run_folder
bpy.ops.stga.test_python()
bpy.ops.stga.avatar_from_video(filepath=video, folder=str(home / "avatar"), minutes=0.05)
splats = settings.splats
head = settings.head
result["made"] = [head["stga_capture"], head["stga_run_folder"], len(splats.data.vertices)]
run = sys.modules[module + ".operators.command_line"]._run
result["codes"] = [
    run(["track", video, "--stop", "3", "--out", str(home / "tracked")]),
    run(["avatar", video, "--out", str(home / "avatar"), "--budget", "3s"]),
]
bpy.ops.preferences.addon_disable(module=module)
repos = bpy.context.preferences.extensions.repos
index = next(i for i, repo in enumerate(repos) if repo.module == "user_default")
bpy.ops.extensions.package_uninstall(repo_index=index, pkg_id="stga")
installed = Path(bpy.context.preferences.extensions.repos[index].directory)
found = [*installed.parent.rglob("*torch*"), *installed.glob("stga*")]
result["left"] = [str(path) for path in found]
print("RESULT " + json.dumps(result))
"""


TARGET = Target(this_platform(), "{}.{}".format(*sys.version_info), ("4.2.0", "5.1.0"))


@pytest.fixture(scope="module")
def archive(demo, kernel_bundle, tmp_path_factory):
    try:
        check_wheels(collect_wheels(wheel_folder(TARGET), TARGET), TARGET)
    except StgaError as error:
        pytest.skip(f"wheels not present and not downloadable: {error}")
    parts = {"demo": demo, "kernels": sorted(kernel_bundle[0].glob("*/*"))}
    return build_zip(tmp_path_factory.mktemp("dist"), edition=complete(TARGET), **parts)


def bare_python(folder):
    """A Python of this version with Blender and numpy alone."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
    site = next(folder.glob("lib/python*/site-packages"))
    for name in OWN_PACKAGES.split():
        source = Path(np.__file__).parents[1] / name
        if source.exists():
            (site / name).symlink_to(source)
    return folder / "bin/python"


@pytest.mark.nightly
def test_track_and_train_at_once(archive, demo, tmp_path):
    """Catches a missing wheel, a worker that needs more, and files that uninstalling leaves."""
    python = bare_python(tmp_path / "bare")
    video = tmp_path / "head.mp4"
    write_head_video(video, 3)
    offline = OFFLINE if subprocess.run([*OFFLINE, "true"], check=False).returncode == 0 else []
    profile = {"BLENDER_USER_RESOURCES": str(tmp_path / "profile"), "HOME": str(tmp_path)}
    others = ("PYTHON", "NUMBA_")
    kept = {name: value for name, value in os.environ.items() if not name.startswith(others)}
    command = [*offline, python, "-c", SCRIPT, archive, tmp_path, ITERATIONS, video]
    result = result_of(command, cwd=tmp_path, env=kept | profile)
    assert (result["before"], result["heavy"]) == ([], [])
    assert result["run"] == str(tmp_path / "STGA Demo/run")
    assert result["next run"] == str(tmp_path / "STGA Demo/run 2")
    assert result["minutes"] == 1.0
    assert result["left"] == []
    *folders, splats = result["made"]
    assert folders == [str(tmp_path / "avatar/capture"), str(tmp_path / "avatar/run")]
    assert splats == len(read_avatar(tmp_path / "avatar/run/avatar.npz").splats)
    assert result["codes"] == [0, 0]
    assert (tmp_path / "tracked/bundled_head.npz").is_file()
    assert (tmp_path / "avatar/avatar.blend").is_file()
    settings = make_settings("global", iterations=ITERATIONS, effects={})  # as the operator
    perform(Train(tmp_path / "here", demo, settings), ignore, print)
    runs = (Path(result["run"]), tmp_path / "here")
    found, expected = (read_metrics(run)[-1]["psnr"] for run in runs)
    assert abs(found - expected) < MAX_DIFFERENCE_DB


@pytest.mark.nightly
def test_bundled_wheels_are_unmodified(archive):
    """Catches a wheel that the build changes, and a manifest that names others."""
    with zipfile.ZipFile(archive) as made:
        names = {name for name in made.namelist() if name.startswith("wheels/")}
        for name in names:
            assert made.read(name) == (wheel_folder(TARGET) / Path(name).name).read_bytes()
        manifest = made.read("blender_manifest.toml").decode()
    assert names
    assert all(f'"./{name}"' in manifest for name in names)
