"""Estimate Light in Blender: from the button to the light of the avatar that is shown."""

from dataclasses import replace

import bpy
import numpy as np
import pytest

for package in ("torch", "numba", "PIL"):
    pytest.importorskip(package)

from capture.factory import write_mesh_capture  # noqa: E402

from stga_addon.avatar.file import read_avatar, write_avatar  # noqa: E402
from stga_addon.scene.display.splat_object import stored_avatar  # noqa: E402
from stga_addon.scene.render.scene_splats import SplatCache, visible_layers  # noqa: E402


@pytest.mark.slow
def test_estimate_light(extension, tmp_path):
    """Catches a button whose worker is not given the run, whose light is another than training
    finds, does not reach the splats that are shown, or reaches those of another avatar."""
    run, scene = tmp_path / "run", bpy.context.scene
    bpy.ops.stga.import_capture(directory=str(write_mesh_capture(tmp_path / "capture")))
    bpy.ops.stga.train(directory=str(run), iterations=6)
    trained = read_avatar(run / "avatar.npz")
    write_avatar(run / "avatar.npz", replace(trained, light=None))
    bpy.ops.stga.show_avatar(filepath=str(run / "avatar.npz"))
    shown, scene.stga.run_folder = scene.stga.splats, str(run)
    assert stored_avatar(shown).light is None
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    scene.collection.objects.link(sun)
    scene.stga_lighting.mode = "scene"

    bpy.ops.stga.estimate_light()
    found = stored_avatar(shown).light
    for name in ("radiance", "transfer", "occlusion", "irradiance", "roughness"):
        np.testing.assert_allclose(
            getattr(found, name), getattr(trained.light, name), atol=1e-6, err_msg=name
        )
    assert read_avatar(run / "avatar.npz").light.source == "estimated"
    bpy.context.view_layer.update()
    (layer,) = visible_layers(bpy.context.evaluated_depsgraph_get(), SplatCache())
    assert [light.kind for light in layer.relit.lighting.lights] == ["sun"]

    write_avatar(tmp_path / "other.npz", replace(trained, splats=trained.splats.rows(np.arange(9))))
    bpy.ops.stga.show_avatar(filepath=str(tmp_path / "other.npz"))
    scene.stga.run_folder = str(run)
    with pytest.raises(RuntimeError, match="is not the one that the scene shows"):
        bpy.ops.stga.estimate_light()
