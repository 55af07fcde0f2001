"""The built zip: what is in it, and that Blender's own tool agrees."""

import os
import sys
import zipfile
from pathlib import Path

import pytest
from refusal import refusal

pytest.importorskip("bpy")

from stga_addon import __version__
from stga_addon.development.package import WHEELS, build_zip, extension_files, read_manifest

from .zips import output_of

ROOT = Path(__file__).resolve().parents[2]


def blender_ext(*arguments, home):
    """Output of Blender's own extension tool, in a Python with bpy and an empty Blender profile."""
    script = (
        "import bpy, runpy, sys; from pathlib import Path\n"
        "tool = next(Path(bpy.utils.resource_path('LOCAL')).rglob('bl_pkg/cli/blender_ext.py'))\n"
        "sys.argv[0] = str(tool); runpy.run_path(str(tool), run_name='__main__')\n"
    )
    environment = {**os.environ, "BLENDER_USER_RESOURCES": str(home)}
    return output_of([sys.executable, "-c", script, *arguments], cwd=home, env=environment)


def test_blender_agrees(zip_file, tmp_path):
    """Catches a manifest that Blender refuses, and patterns that it interprets differently."""
    assert "error" not in blender_ext("validate", zip_file, home=tmp_path).lower()
    reference = tmp_path / "reference.zip"
    paths = ("--source-dir", ROOT, "--output-filepath", reference)
    blender_ext("build", *paths, home=tmp_path)
    names, others = (set(zipfile.ZipFile(path).namelist()) for path in (zip_file, reference))
    assert names == others


def test_the_zip(zip_file, tmp_path):
    """Catches tests or docs in the zip, a module left out, another version or wheel, traces of
    this computer, and a zip of nothing."""
    names = set(zipfile.ZipFile(zip_file).namelist())
    left_out = ("tests/", "docs/", "stga_addon/development/", ".")
    assert not [name for name in names if name.startswith(left_out) or name.endswith(".pyc")]
    expected = "LICENSE README.md CHANGELOG.md THIRD_PARTY.md __init__.py blender_manifest.toml"
    assert {name for name in names if "/" not in name} == {*expected.split()}
    assert {"operators/train.py", "ui/panel.py", "stga_addon/worker/launch.py"} <= names
    wheels = {name.removeprefix("wheels/") for name in names if name.startswith("wheels/")}
    assert wheels == {*WHEELS}
    for path in extension_files(ROOT, read_manifest(ROOT)):
        assert path.is_file()
    assert build_zip(tmp_path).read_bytes() == zip_file.read_bytes()
    manifest = read_manifest(ROOT)
    assert manifest["version"] == __version__
    assert manifest["wheels"] == [f"./wheels/{name}" for name in WHEELS]
    with refusal(r"blender_manifest\.toml: cannot be read"):
        build_zip(tmp_path / "dist", root=tmp_path)
