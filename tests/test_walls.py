"""The walls between the packages, read from the source's imports."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = ("__init__.py", "operators", "ui", "stga_addon")
SOURCES = sorted(
    path for name in SHIPPED for path in ([ROOT / name] if name.endswith(".py") else (ROOT / name).rglob("*.py"))
)
BLENDER = {"bpy", "bmesh", "gpu", "mathutils", "bl_ext"}
HEAVY = {"torch", "numba", "wgpu"}
# A module may import from layers before its own; a package counts as its first name.
LAYERS = (
    {"errors", "__version__"},
    {"files", "format", "progress", "schema"},
    {"worker"},
    {"flame"},
    {"capture"},
    {"avatar", "selection"},
    {"export"},
    {"raster"},
    {"render"},
    {"tracking"},
    {"training"},
    {"report"},
    {"requests"},
    {"perform"},
    {"scene"},
    {"cli"},
    {"development"},
    {"__main__", "__init__"},
)
LIGHT = (
    "errors",
    "files",
    "flame",
    "capture",
    "capture.open",
    "avatar",
    "avatar.file",
    "export.ply",
    "selection",
    "requests.folder",
)


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def imports(path: Path) -> Iterator[tuple[str, int]]:
    """(dotted module, level) of every import, at the top or inside a function; `from x import y` gives x.y."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((alias.name, 0) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            prefix = f"{node.module}." if node.module else ""
            yield from ((prefix + alias.name, node.level) for alias in node.names)


def test_the_walls_are_looked_at():
    """Catches a move of the sources that leaves every test below without anything to read."""
    assert len(SOURCES) > 30
    assert {ROOT / "__init__.py", ROOT / "operators/train.py", ROOT / "stga_addon/scene/display/splat_nodes.py"} <= set(
        SOURCES
    )


@pytest.mark.parametrize("path", SOURCES, ids=name_of)
def test_bpy_only_where_blender_is(path):
    """Catches an engine that can no longer run, or be tested, outside Blender."""
    if (
        name_of(path).startswith(("stga_addon/scene/", "stga_addon/development/demo/studio.py", "operators/", "ui/"))
        or path == ROOT / "__init__.py"
    ):
        return
    assert not {module.split(".")[0] for module, level in imports(path) if level == 0} & BLENDER


@pytest.mark.parametrize("path", SOURCES, ids=name_of)
def test_torch_and_numba_only_where_training_is(path):
    """Catches an extension that needs PyTorch to be enabled, or to import and show."""
    if name_of(path).startswith(("stga_addon/raster/", "stga_addon/training/")):
        return
    if name_of(path) == "stga_addon/flame/forward_torch.py":
        return
    assert not {module.split(".")[0] for module, _ in imports(path)} & HEAVY


@pytest.mark.parametrize("path", SOURCES, ids=name_of)
def test_own_modules_by_relative_import(path):
    """Catches `import stga_addon…`, which is not there once Blender installs the extension as bl_ext.….stga."""
    absolute = {module.split(".")[0] for module, level in imports(path) if level == 0}
    assert not absolute & {"stga_addon", "operators", "ui", "stga"}


@pytest.mark.parametrize("path", [p for p in SOURCES if p.is_relative_to(ROOT / "stga_addon")], ids=name_of)
def test_imports_run_one_way(path):
    """Catches cycles, and an engine that knows of the scene or the command line."""
    parts = path.relative_to(ROOT / "stga_addon").with_suffix("").parts
    own = layer(parts[0])
    for module, level in imports(path):
        # level 1 from stga_addon/x.py, level 2 from stga_addon/x/y.py, 3 from stga_addon/x/y/z.py reach stga_addon
        if level == 0 or level < len(parts):
            continue
        assert level == len(parts), f"{name_of(path)} imports from outside stga_addon"
        other = module.split(".")[0]
        if other == parts[0]:
            continue
        assert layer(other) < own or {parts[0], other} <= {"avatar", "selection"}, f"{name_of(path)} imports {module}"


def layer(name: str) -> int:
    found = [index for index, names in enumerate(LAYERS) if name in names]
    assert found, f"stga_addon/{name} has no layer in tests/test_walls.py"
    return found[0]


@pytest.mark.parametrize("path", [p for p in SOURCES if p.is_relative_to(ROOT / "operators")], ids=name_of)
def test_operators_do_not_know_the_panels(path):
    """Catches operators that only work where the panels are registered."""
    assert not [module for module, level in imports(path) if level == 2 and module.split(".")[0] == "ui"]


BLOCKED = """
import sys
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {"torch", "numba", "wgpu", "trimesh", "scipy", "PIL", "tqdm", "bpy", "smplx"}:
            raise ModuleNotFoundError(f"blocked: {name}", name=name)
sys.meta_path.insert(0, Block())
import importlib
for name in sys.argv[1:]:
    importlib.import_module(f"stga_addon.{name}" if name else "stga_addon")
"""


def test_numpy_is_enough_to_import_the_engine():
    """Catches a top-level import that a plain Blender cannot satisfy."""
    done = subprocess.run([sys.executable, "-c", BLOCKED, "", *LIGHT], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


SCENE = BLOCKED.replace('"bpy", ', "")


def test_numpy_is_enough_to_import_the_scene():
    """Catches the same below scene/, with Blender there."""
    pytest.importorskip("bpy")
    modules = [
        path.relative_to(ROOT / "stga_addon").with_suffix("").as_posix().replace("/", ".")
        for path in sorted((ROOT / "stga_addon/scene").rglob("[a-z]*.py"))
    ]
    done = subprocess.run([sys.executable, "-c", SCENE, *modules], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert len(modules) > 5
