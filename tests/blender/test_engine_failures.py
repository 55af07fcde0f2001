"""What the render engine refuses, and what it leaves behind after a failure."""

import threading

import pytest

bpy = pytest.importorskip("bpy")
pytest.importorskip("numba")

from stga_addon.errors import StgaError  # noqa: E402
from stga_addon.scene.display import splat_nodes  # noqa: E402
from stga_addon.scene.display.splat_object import set_input  # noqa: E402
from stga_addon.scene.render import engine  # noqa: E402
from stga_addon.scene.render.scene_splats import SplatCache, visible_layers  # noqa: E402

from .exr import read_exr  # noqa: E402
from .test_engine import HEIGHT, WIDTH, _engine, camera_at, multilayer, no_python, show  # noqa: E402, F401
from .test_splat_object import avatar_of  # noqa: E402


@pytest.mark.parametrize("kind", ["ORTHO", "PANO", None])
def test_unsupported_cameras_are_refused(kind):
    """Catches a perspective image from a camera of another type."""
    if kind is not None:
        camera_at(type=kind)
    message = "no camera" if kind is None else "camera: is not a perspective camera"
    with pytest.raises(RuntimeError, match=message):
        bpy.ops.render.render()


def test_changed_topology_is_refused():
    """Catches splats scattered over a subdivided mesh, and a traceback."""
    shown, head = show(avatar_of("stga", 10))
    camera_at()
    head.modifiers.new("finer", "SUBSURF")
    with pytest.raises(RuntimeError, match="head: has other triangles than head splats"):
        bpy.ops.render.render()
    set_input(shown, splat_nodes.HEAD, None)
    with pytest.raises(RuntimeError, match="has no head to follow"):
        bpy.ops.render.render()


def test_a_head_in_edit_mode_is_named():
    """Catches a head that is being edited and is said to have other triangles than its splats."""
    _, head = show(avatar_of("stga", 10))
    bpy.context.view_layer.objects.active = head
    bpy.ops.object.mode_set(mode="EDIT")
    message = "head: is in Edit Mode; head splats is drawn again when you leave it"
    with pytest.raises(StgaError, match=message):
        visible_layers(bpy.context.evaluated_depsgraph_get(), SplatCache())
    bpy.ops.object.mode_set(mode="OBJECT")
    assert len(visible_layers(bpy.context.evaluated_depsgraph_get(), SplatCache())) == 1


@pytest.mark.parametrize("stage", ["visible_layers", "combined"])
@pytest.mark.parametrize("raised", [StgaError("head: is broken"), MemoryError("of pixels")])
def test_failed_render_is_an_error_and_an_empty_image(stage, raised, tmp_path, monkeypatch):
    """Catches an image without passes, and a failure saved as an image."""

    def fail(*_: object) -> None:
        raise raised

    scene = bpy.context.scene
    scene.render.filepath = str(tmp_path / "failed.png")
    camera_at()
    monkeypatch.setattr(engine, stage, fail)
    message = "^Error: head: is broken$"
    if isinstance(raised, MemoryError):
        message = r"Unexpected error \(MemoryError: of pixels\); see the console"
    with pytest.raises(RuntimeError, match=message) as reported:
        bpy.ops.render.render(write_still=True)
    assert str(reported.value).count(str(raised)) == 1
    assert not any(tmp_path.iterdir())
    multilayer(scene.render.image_settings)
    bpy.data.images["Render Result"].save_render(str(tmp_path / "empty.exr"))
    passes = read_exr(tmp_path / "empty.exr")
    combined = [values for name, values in passes.items() if "Combined" in name]
    assert len(combined) == 4
    assert all(values.shape == (HEIGHT, WIDTH) and not values.any() for values in combined)


def test_panels_drop_the_engine_on_unregister():
    """Catches panels that still list the engine after it was unregistered."""

    def panels() -> list[type]:
        every = bpy.types.Panel.__subclasses__()
        return [each for each in every if engine.ENGINE in getattr(each, "COMPAT_ENGINES", ())]

    assert panels()
    engine.unregister()
    assert not panels()
    engine.register(no_python)


def test_render_environment_is_looked_up_by_the_main_thread(monkeypatch):
    """Catches preferences read from a render thread, and an error that is lost."""
    monkeypatch.setattr(engine, "missing_packages", lambda: ["numba"])
    answers, callers = [StgaError("no environment"), "python"], []

    def find() -> str:
        callers.append(threading.current_thread())
        answer = answers.pop(0)
        if isinstance(answer, StgaError):
            raise answer
        return answer

    environment = engine.Rasterizer(find, lambda: "cpu")
    environment.update()
    with pytest.raises(StgaError, match="no environment"):
        environment.python()
    environment.update()
    found: list[str] = []
    thread = threading.Thread(target=lambda: found.append(environment.python()))
    thread.start()
    thread.join()
    assert found == ["python"]
    assert callers == [threading.main_thread()] * 2
