"""Files dropped into the viewport: which operator a handler calls, and the result."""

from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from capture.factory import write_flame_capture, write_mesh_capture

from .test_import_operators import write_motion
from .test_operators import write_ball_avatar

pytestmark = pytest.mark.usefixtures("extension")

HANDLERS = {
    "STGA_FH_video": (".mp4;.mov;.mkv;.avi;.m4v;.webm;.mts;.mxf", "stga.avatar_from_video"),
    "STGA_FH_capture": (".json", "stga.import_capture"),
    "STGA_FH_performance": (".csv;.json;.txt", "stga.apply_motion"),
    "STGA_FH_npz": (".npz", "stga.open_npz"),
    "STGA_FH_ply": (".ply", "stga.import_ply"),
}


@pytest.mark.parametrize("name", HANDLERS)
def test_handlers_call_operators_that_take_a_file(name):
    """Catches a handler whose operator is missing, or has no property for the path, and a capture
    that is imported because its JSON was dropped into the text editor."""
    handler = getattr(bpy.types, name)
    extensions, operator = HANDLERS[name]
    assert (handler.bl_file_extensions, handler.bl_import_operator) == (extensions, operator)
    group, _, function = operator.partition(".")
    properties = getattr(getattr(bpy.ops, group), function).get_rna_type().properties
    assert properties["filepath"].subtype == "FILE_PATH"
    assert properties["filepath"].is_skip_save
    assert handler.poll_drop(SimpleNamespace(area=SimpleNamespace(type="VIEW_3D")))
    assert not handler.poll_drop(SimpleNamespace(area=SimpleNamespace(type="TEXT_EDITOR")))
    assert not handler.poll_drop(SimpleNamespace(area=None))


def test_a_file_stands_for_its_capture(tmp_path):
    """Catches a file browser that opens a capture by one of its files only, or by the name of the
    .blend file that Blender proposes, and one that takes any file for a capture."""
    folder = write_mesh_capture(tmp_path / "capture")
    image = next(folder.rglob("*.png"))
    for given in (folder / "transforms_train.json", image, folder / "demo.blend"):
        bpy.ops.wm.read_homefile(use_empty=True)
        bpy.ops.stga.import_capture(filepath=str(given))
        assert bpy.context.scene.stga.head["stga_capture"] == str(folder)
    (tmp_path / "notes.json").write_text("{}")
    with pytest.raises(RuntimeError, match=r"notes.json: is in no capture; choose"):
        bpy.ops.stga.import_capture(filepath=str(tmp_path / "notes.json"))


def test_an_npz_is_opened_by_its_content(tmp_path):
    """Catches an avatar taken for a motion, where both have an array `rotation`, a motion that
    arrives as a second head, and a traceback or an error on FLAME for anything else."""
    avatar, motion = tmp_path / "a.npz", write_motion(tmp_path / "smile.npz")
    write_ball_avatar(avatar)
    np.savez(tmp_path / "other.npz", values=np.zeros(3))
    (tmp_path / "noise.npz").write_bytes(b"no archive")
    for name, sentence in (
        ("a.npz", ".*import a capture first"),
        ("smile.npz", ".* choose your FLAME model"),
        ("other.npz", "is neither an avatar .* nor a FLAME motion"),
        ("noise.npz", "cannot be read as an .npz file"),
        ("gone.npz", "cannot be read as an .npz file"),
    ):
        with pytest.raises(RuntimeError, match=f"^Error: .*{name}: {sentence}"):
            bpy.ops.stga.open_npz(filepath=str(tmp_path / name))
    folder, model = write_flame_capture(tmp_path / "capture")
    bpy.ops.stga.import_capture(directory=str(folder), flame=str(model))
    objects = len(bpy.data.objects)
    bpy.ops.stga.open_npz(filepath=str(motion))
    assert len(bpy.data.objects) == objects
    assert [action for action in bpy.data.actions if "smile" in action.name]
    bpy.ops.stga.open_npz(filepath=str(avatar))
    assert bpy.context.scene.stga.splats is not None
