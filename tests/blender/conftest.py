"""An empty Blender file for every test, the checkout as an extension, and what is built from it."""

import importlib.util
import pkgutil
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest
from capture.factory import write_flame_capture, write_mesh_capture

from stga_addon.capture.open import CAPTURE_MODELS
from stga_addon.development.package import build_zip, fetch_wheels
from stga_addon.errors import StgaError
from stga_addon.jobs.table import Kind
from stga_addon.progress import Progress
from stga_addon.worker.training_python import missing_packages

collect_ignore_glob = [] if importlib.util.find_spec("bpy") else ["test_*.py"]
if not collect_ignore_glob:
    import bpy

    from .session import CHECKOUT, ops, panel, write_interpreter

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True, scope="session")
def _factory_settings():
    pytest.importorskip("bpy")
    bpy.ops.wm.read_factory_settings(use_empty=True)


@pytest.fixture(autouse=True)
def empty_scene(_factory_settings):
    """As after factory settings, in a fifth of the time: Blender's add-ons stay registered."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)


@pytest.fixture
def lighting(empty_scene):
    """The scene's settings of light, whether or not the extension is registered, too."""
    from stga_addon.scene import light

    registered = light.lighting_settings(bpy.context.scene) is not None
    if not registered:
        light.register()
    yield light.lighting_settings(bpy.context.scene)
    if not registered:
        light.unregister()


@pytest.fixture(scope="session")
def extension():
    """The checkout as a package of its own, as Blender imports an extension: only relative imports
    find their way.

    Its kernels are those of `stga_addon`: under another name they would be compiled again, which
    takes a minute.
    """
    if not missing_packages():
        kernels = importlib.import_module("stga_addon.raster.cpu")
        sys.modules[f"{CHECKOUT}.{kernels.__name__}"] = kernels
        for _, part, _ in pkgutil.iter_modules(kernels.__path__, f"{kernels.__name__}."):
            sys.modules[f"{CHECKOUT}.{part}"] = importlib.import_module(part)
    spec = importlib.util.spec_from_file_location(
        CHECKOUT, ROOT / "__init__.py", submodule_search_locations=[str(ROOT)]
    )
    module = sys.modules[CHECKOUT] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.register()
    yield module
    module.unregister()


@pytest.fixture
def head(extension, tmp_path):
    """The head of a mesh capture, in the folder `capture`."""

    ops.import_capture(directory=write_mesh_capture(tmp_path / "capture"))
    return panel().head


@pytest.fixture
def worker(extension, head, tmp_path):
    """A stand-in for a worker of the scene's training: the test says what it does."""
    jobs = extension.stga_addon.jobs
    monitor = extension.operators.monitor
    with ExitStack() as stack:
        run = tmp_path / "run"
        settings = extension.stga_addon.training.settings.make_settings("global", iterations=5)
        folder = jobs.perform.request_folder(run)
        jobs.perform.write_request(folder, jobs.train.Train(run, tmp_path / "capture", settings))
        monitor.follow(bpy.context.scene, Kind.TRAINING, run, folder)
        writer = stack.enter_context(extension.stga_addon.worker.status.status_writer(folder))
        writer.report(Progress(0.25, "Training"))
        writer.run = run
        writer.leave = stack.close
        yield writer


@pytest.fixture
def stand_in(extension, monkeypatch, tmp_path):
    """Let a program with this body stand in for the training Python."""

    def replace(body):
        python = write_interpreter(tmp_path / "python", body)
        found = lambda context, given="": python  # noqa: E731
        monkeypatch.setattr(extension.operators.train, "training_python", found)

    return replace


@pytest.fixture
def asked(extension, monkeypatch):
    """What operators that train ask for; nothing is trained."""
    requests = []
    start = lambda scene, wanted, *_, **__: requests.append(wanted)  # noqa: E731
    monkeypatch.setattr(extension.operators.train, "missing_packages", list)
    monkeypatch.setattr(extension.operators.train, "start", start)
    return requests


@pytest.fixture(scope="session")
def zip_file(tmp_path_factory):
    """The built zip of the small edition."""
    try:
        fetch_wheels(ROOT / "wheels")
    except StgaError as error:
        pytest.skip(f"wheels not present and not downloadable: {error}")
    return build_zip(tmp_path_factory.mktemp("dist"))


@pytest.fixture(scope="session")
def demo(tmp_path_factory):
    """A capture with its FLAME file, in place of the demo of the complete edition."""
    folder, model = write_flame_capture(tmp_path_factory.mktemp("demo") / "capture")
    model.rename(folder / CAPTURE_MODELS[0])
    return folder
