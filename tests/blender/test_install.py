"""The built zip, installed as users do: in a new Blender profile and process."""

import json
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("bpy")

from stga_addon import __version__
from stga_addon.avatar.file import Avatar, write_avatar
from stga_addon.avatar.lattice import lattice_splats
from stga_addon.capture.open import open_capture
from stga_addon.development.package import WHEELS, build_zip, extension_files, read_manifest
from stga_addon.errors import StgaError

ROOT = Path(__file__).resolve().parents[2]


def run(script: str, *arguments: object, home: Path) -> str:
    """Output of a script in a Python with bpy and an empty Blender profile."""
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(home)}
    command = [sys.executable, "-c", script, *map(str, arguments)]
    done = subprocess.run(command, cwd=home, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout


def blender_ext(command: str, *arguments: object, home: Path) -> str:
    """Blender's own extension tool."""
    script = (
        "import bpy, runpy, sys; from pathlib import Path\n"
        "tool = next(Path(bpy.utils.resource_path('LOCAL')).rglob('bl_pkg/cli/blender_ext.py'))\n"
        "sys.argv[0] = str(tool); runpy.run_path(str(tool), run_name='__main__')\n"
    )
    return run(script, command, *arguments, home=home)


def test_manifest_and_package_agree():
    """Catches a release whose parts name different versions or different wheels."""
    manifest = read_manifest(ROOT)
    assert manifest["version"] == __version__
    assert manifest["wheels"] == [f"./wheels/{name}" for name in WHEELS]


def test_blender_validates_the_zip(zip_file, tmp_path):
    """Catches a manifest that Blender's extension platform refuses."""
    assert "error" not in blender_ext("validate", zip_file, home=tmp_path).lower()


def test_same_files_as_blenders_own_build(zip_file, tmp_path):
    """Catches exclude patterns that this build and Blender interpret differently."""
    blender_ext(
        "build",
        "--source-dir",
        ROOT,
        "--output-filepath",
        tmp_path / "reference.zip",
        home=tmp_path,
    )
    names, reference = (
        set(zipfile.ZipFile(path).namelist()) for path in (zip_file, tmp_path / "reference.zip")
    )
    assert names == reference


def test_zip_holds_what_the_extension_runs(zip_file):
    """Catches tests, docs or development in the zip, and a module left out."""
    names = set(zipfile.ZipFile(zip_file).namelist())
    left_out = ("tests/", "docs/", "benchmarks/", "stga_addon/development/", ".")
    assert not [name for name in names if name.startswith(left_out) or name.endswith(".pyc")]
    assert {name for name in names if "/" not in name} == {
        "LICENSE",
        "README.md",
        "CHANGELOG.md",
        "THIRD_PARTY.md",
        "__init__.py",
        "blender_manifest.toml",
    }
    assert {
        "operators/train.py",
        "ui/panel.py",
        "stga_addon/worker/launch.py",
    } <= names
    assert {name for name in names if name.startswith("wheels/")} == {
        f"wheels/{name}" for name in WHEELS
    }


def test_equal_sources_give_an_equal_zip(zip_file, tmp_path):
    """Catches times, order or permissions of this computer in the zip."""
    for path in extension_files(ROOT, read_manifest(ROOT)):
        assert path.is_file()
    assert build_zip(tmp_path).read_bytes() == zip_file.read_bytes()


def test_other_folders_are_refused(tmp_path):
    """Catches an empty zip."""
    with pytest.raises(StgaError, match=r"blender_manifest\.toml: cannot be read"):
        build_zip(tmp_path / "dist", root=tmp_path)


# A Blender that nobody has installed anything into: training's packages are out of reach, others
# come from the zip.
INSTALL = """
import importlib.machinery, json, os, sys
from pathlib import Path
import bpy

class Bare(importlib.machinery.PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        package = name.split(".")[0]
        if package in {"torch", "numba", "scipy", "PIL", "smplx"}:
            return None
        if path is None and package in {"filelock", "trimesh", "tqdm"}:
            own = os.environ["BLENDER_USER_RESOURCES"]
            path = [folder for folder in sys.path if folder.startswith(own)]
        return super().find_spec(name, path, target)

whole = importlib.machinery.PathFinder
sys.meta_path = [Bare if finder is whole else finder for finder in sys.meta_path]
archive, capture, avatar = sys.argv[1:]
result = {}
commands = {}
bpy.utils.register_cli_command = lambda name, handler: commands.setdefault(name, handler)
bpy.utils.unregister_cli_command = lambda handler: commands.clear()
install = bpy.ops.extensions.package_install_files
install(filepath=archive, repo="user_default", enable_on_install=True)
result["commands"] = sorted(commands)
module = "bl_ext.user_default.stga"
result["enabled"] = module in bpy.context.preferences.addons
loaded = {name.split(".")[0] for name in sys.modules}
result["heavy"] = sorted({"torch", "numba", "trimesh", "tqdm"} & loaded)
names = "import_capture import_motion import_meshes select heat_map train".split()
names += ["show_avatar", "apply_motion"]
names += "standard_view import_ply export_avatar".split()
result["missing"] = [name for name in names if not hasattr(bpy.types, "STGA_OT_" + name)]
result["tabs"] = [name for name in dir(bpy.types) if name.startswith("STGA_PT_")]
result["wheels"] = [__import__(name).__file__ for name in ("filelock", "trimesh", "tqdm")]

bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.preferences.addon_enable(module=module)
bpy.ops.stga.import_capture(directory=capture)
bpy.ops.stga.select(threshold=0.002)
bpy.ops.stga.show_avatar(filepath=avatar)
scene = bpy.context.scene
scene.frame_set(scene.frame_end)
splat_object = sys.modules[f"{module}.stga_addon.scene.display.splat_object"]
xyz = splat_object.evaluated_splats(scene.stga.splats)[0].ravel().tolist()
result["frame"], result["xyz"] = scene.frame_current, xyz
result["groups"] = sum(group.name.startswith("stga_") for group in scene.stga.head.vertex_groups)

bpy.ops.preferences.addon_disable(module=module)
result["left"] = [*commands] + [name for name in names if hasattr(bpy.types, "STGA_OT_" + name)]
repos = bpy.context.preferences.extensions.repos
index = next(i for i, repo in enumerate(repos) if repo.module == "user_default")
bpy.ops.extensions.package_uninstall(repo_index=index, pkg_id="stga")
folder = Path(bpy.context.preferences.extensions.repos[index].directory)
result["files"] = [path.name for path in folder.glob("stga*")]
print("RESULT " + json.dumps(result))
"""


def test_install_use_and_uninstall(zip_file, shared_data, tmp_path):
    """Catches absolute imports, files left out, and packages needed too early."""
    folder = shared_data / "studio_head"
    capture = open_capture(folder)
    splats = lattice_splats(capture.neutral, capture.faces, order=0, sh_degree=0)
    write_avatar(
        tmp_path / "a.npz",
        Avatar(splats, "stga", capture.neutral.astype(np.float32), capture.faces),
    )
    output = run(INSTALL, zip_file, folder, tmp_path / "a.npz", home=tmp_path)
    result = json.loads(
        next(line for line in output.splitlines() if line.startswith("RESULT")).removeprefix(
            "RESULT "
        )
    )
    assert result["enabled"]
    assert result["commands"] == ["stga"]
    assert result["heavy"] == []
    assert result["missing"] == []
    assert {f"STGA_PT_{step}" for step in ("capture", "select", "train", "show", "motion")} <= set(
        result["tabs"]
    )
    assert all(str(tmp_path) in path for path in result["wheels"]), (
        "a bundled wheel was not installed"
    )
    assert result["groups"] > 0
    centres = capture.mesh(result["frame"])[capture.faces].mean(1)
    np.testing.assert_allclose(np.reshape(result["xyz"], (-1, 3)), centres, atol=1e-5)
    assert result["left"] == []
    assert result["files"] == []
