"""The walls between the packages, read from the source's imports."""

import ast
import re
import sys
from functools import cache
from pathlib import Path

import pytest
from blender.zips import output_of

ROOT = Path(__file__).resolve().parents[1]
SHIPPED = ("__init__.py", "operators", "ui", "stga_addon")
SOURCES = tuple(
    path
    for name in SHIPPED
    for path in ([ROOT / name] if name.endswith(".py") else sorted((ROOT / name).rglob("*.py")))
)
MODULE_NAME = re.compile(r"(?:(\.+)|stga_addon\.)([a-z_]\w*(?:\.[a-z_]\w*)*)", re.ASCII)
"""A string that may name a module, relative or absolute."""
BLENDER = {"bpy", "bmesh", "gpu", "mathutils", "bl_ext"}
BLENDERS = (
    "stga_addon/scene/",
    "stga_addon/development/demo/in_blender.py",
    "stga_addon/development/demo/studio.py",
    "stga_addon/development/benchmark/hands_on.py",
    "operators/",
    "ui/",
)
"""Where Blender's modules are imported."""
HEAVY = {"torch", "numba", "wgpu"}
TRAININGS = ("stga_addon/raster/", "stga_addon/training/", "stga_addon/development/benchmark/")
# A module may import from layers before its own; a package counts as its first name.
LAYERS = (
    {"errors", "__version__"}, {"format", "schema"}, {"files"}, {"options", "progress"}, {"worker"},
    {"flame"}, {"capture"}, {"avatar"}, {"raster"}, {"light"}, {"export"}, {"render"},
    {"tracking"}, {"driving"}, {"training"}, {"jobs"}, {"api"}, {"scene"}, {"cli"},
    {"development"}, {"__main__", "__init__"},
)  # fmt: skip
LIGHT = (
    "errors", "files", "flame", "capture", "capture.open", "avatar", "avatar.file", "export.ply",
    "capture.selection", "jobs.perform", "jobs.monitor_state", "jobs.python_check", "api",
)  # fmt: skip


def name_of(path):
    return path.relative_to(ROOT).as_posix()


@cache
def imports(path):
    """(dotted module, level) of every import, at the top or inside a function; `from x import y`
    gives x.y."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found += ((alias.name, 0) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            prefix = f"{node.module}." if node.module else ""
            found += ((prefix + alias.name, node.level) for alias in node.names)
    return tuple(found)


@cache
def imports_by_name(path):
    """The same for every string that is the name of a module, whatever reads it: `import_module`,
    `find_spec`, a table of them, or another Python after `-m`."""
    named = []
    depth = len(path.relative_to(ROOT).parts)
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        text = node.value if isinstance(node, ast.Constant) else None
        found = MODULE_NAME.fullmatch(text) if isinstance(text, str) else None
        if found is None:
            continue
        module, level = (found[2], len(found[1])) if found[1] else (f"stga_addon.{found[2]}", depth)
        if level <= depth and module_file(path.parents[level - 1].joinpath(*module.split("."))):
            # has no name for the folder above
            inside = level == depth and path.is_relative_to(ROOT / "stga_addon")
            named.append(
                (module.removeprefix("stga_addon."), level - 1) if inside else (module, level)
            )
    return tuple(named)


def module_file(path):
    """The source of the module or package at a path without suffix."""
    return next(
        (file for file in (path.with_suffix(".py"), path / "__init__.py") if file.is_file()), None
    )


def imported_file(path, module, level):
    """The source file that an import in `path` is of; None where it is none of this package's."""
    if level == 0:
        return None
    target = path.parents[level - 1].joinpath(*module.split("."))
    return module_file(target) or module_file(target.parent)


@cache
def import_graph(sources):
    """File -> the other files that it imports."""
    return {
        path: {
            found
            for each in (*imports(path), *imports_by_name(path))
            if (found := imported_file(path, *each)) not in (None, path)
        }
        for path in sources
    }


def reached(graph, path):
    """All files, or parts, that one imports, or that those import in turn."""
    seen = set()
    left = [path]
    while left:
        new = graph[left.pop()] - seen
        seen |= new
        left += new
    return seen


def test_the_walls_are_looked_at():
    """Catches a move of the sources that leaves every test below without anything to read."""
    assert len(SOURCES) > 30
    assert {
        ROOT / "__init__.py",
        ROOT / "operators/train.py",
        ROOT / "stga_addon/scene/display/splat_nodes.py",
    } <= set(SOURCES)


@pytest.mark.parametrize("path", SOURCES, ids=name_of)
def test_packages_are_imported_only_where_they_may_be(path):
    """Catches an engine that cannot run or be tested outside Blender, an extension that needs
    PyTorch to be enabled, to import and to show, operators that only work where the panels are
    registered, and `import stga_addon…`, which is not there once Blender installs it as
    bl_ext.….stga."""
    absolute = {module.split(".")[0] for module, level in imports(path) if level == 0}
    assert not absolute & {"stga_addon", "operators", "ui", "stga"}
    assert (
        path == ROOT / "__init__.py" or name_of(path).startswith(BLENDERS) or not absolute & BLENDER
    )
    assert (
        name_of(path).startswith(TRAININGS)
        or not {module.split(".")[0] for module, _ in imports(path)} & HEAVY
    )
    above = {module.split(".")[0] for module, level in imports(path) if level == 2}
    assert not (path.is_relative_to(ROOT / "operators") and "ui" in above)


def layer(name):
    found = [index for index, names in enumerate(LAYERS) if name in names]
    assert found, f"stga_addon/{name} has no layer in tests/test_walls.py"
    return found[0]


@pytest.mark.parametrize(
    "path", [p for p in SOURCES if p.is_relative_to(ROOT / "stga_addon")], ids=name_of
)
def test_imports_run_one_way(path):
    """Catches cycles, and an engine that knows of the scene or the command line."""
    parts = path.relative_to(ROOT / "stga_addon").with_suffix("").parts
    own = layer(parts[0])
    for module, level in (*imports(path), *imports_by_name(path)):
        # from a file in stga_addon level 1 reaches it, from one in a room level 2, and so on
        if level == 0 or level < len(parts):
            continue
        assert level == len(parts), f"{name_of(path)} imports from outside stga_addon"
        other = module.split(".")[0]
        assert other == parts[0] or layer(other) < own, f"{name_of(path)} imports {module}"


def test_no_file_imports_itself_by_way_of_others():
    """Catches circles inside a room, those of types only, and those through modules that are loaded
    by name."""
    graph = import_graph(SOURCES)
    assert not [name_of(path) for path in SOURCES if path in reached(graph, path)]


@pytest.mark.parametrize(
    "room", sorted({path.parent for path in SOURCES} - {ROOT, ROOT / "stga_addon"}), ids=name_of
)
def test_no_part_of_a_room_imports_itself_by_way_of_others(room):
    """Catches two folders, or a folder and a file beside it, that need each other though no two of
    their files do."""
    inside = {
        path: path.relative_to(room).parts[0] for path in SOURCES if path.is_relative_to(room)
    }
    parts = {part: set() for part in inside.values()}
    for path, others in import_graph(SOURCES).items():
        if path in inside:
            parts[inside[path]] |= {inside[other] for other in others if other in inside} - {
                inside[path]
            }
    assert not [part for part in parts if part in reached(parts, part)]


@pytest.mark.parametrize(
    ("source", "target"),
    [
        ("from . import b", "a/b.py"),
        ("from .b import name", "a/b.py"),
        ("def run():\n    from ..c import name", "c/__init__.py"),
        ("if TYPE_CHECKING:\n    from ..c.d import name", "c/d.py"),
        ("import_module('..c.d', __package__)", "c/d.py"),
        ("NAMES = ('.b',)", "a/b.py"),
        ("command = ['stga_addon.c.d', 'check']", "c/d.py"),
        ("command = [f'{__package__}.b']", "a/b.py"),
    ],
)
def test_every_way_to_import_is_seen(source, target, tmp_path, monkeypatch):
    """Catches a circle that hides: in a function, behind TYPE_CHECKING, or in a string."""
    files = [
        tmp_path / "stga_addon" / name
        for name in ("a/a.py", "a/b.py", "a/__init__.py", "c/__init__.py", "c/d.py")
    ]
    for path in files:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(
            source if path.name == "a.py" else "NAME = '.npz', 'stga_addon.none', '..c.none'\n"
        )
    monkeypatch.setitem(globals(), "ROOT", tmp_path)
    graph = dict(import_graph(tuple(files)))
    assert graph.pop(files[0]) == {tmp_path / "stga_addon" / target}
    assert not any(graph.values())


BLOCK = """
import sys
from importlib import import_module
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in BLOCKED:
            raise ModuleNotFoundError(f"blocked: {name}", name=name)
sys.meta_path.insert(0, Block())
for name in sys.argv[1:]:
    import_module(f"stga_addon.{name}" if name else "stga_addon")
"""
LOAD = """
import sys
from stga_addon.jobs.compile_ahead import load_ahead
load_ahead()
assert "stga_addon.training.run.session" in sys.modules
assert "torch" not in sys.modules
"""
OTHERS = {"torch", "numba", "wgpu", "trimesh", "scipy", "PIL", "tqdm", "smplx"}
"""Packages that a plain Blender lacks."""


def run(script, *arguments):
    output_of([sys.executable, "-c", script, *arguments], cwd=ROOT)


def test_numpy_is_enough_to_import_the_engine():
    """Catches a top-level import that a plain Blender cannot satisfy."""
    run(BLOCK.replace("BLOCKED", str(OTHERS | {"bpy"})), "", *LIGHT)


def test_numpy_is_enough_to_import_the_scene():
    """Catches the same below scene/, with Blender there."""
    pytest.importorskip("bpy")
    files = sorted((ROOT / "stga_addon/scene").rglob("[a-z]*.py"))
    modules = [path.relative_to(ROOT / "stga_addon").with_suffix("") for path in files]
    assert len(modules) > 5
    names = [module.as_posix().replace("/", ".") for module in modules]
    run(BLOCK.replace("BLOCKED", str(OTHERS)), *names)


def test_training_begins_without_torch():
    """Catches a worker that waits two seconds for what refining the tracking, LPIPS and autograd
    alone need."""
    run(LOAD)


def test_the_python_interface_has_what_it_lists():
    """Catches a name that a move of modules took away from other people's programs, and one that
    is there but not listed."""
    from stga_addon import api

    for name in api.__all__:
        assert getattr(api, name).__name__ == name or name == "Report"
    modules = {"import_module"}
    public = {name for name in vars(api) if not name.startswith("_")} - {"TYPE_CHECKING", "Any"}
    assert public - modules <= set(api.__all__)
