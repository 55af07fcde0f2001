"""Depth of field and motion blur of splats against Cycles, on a dot of light."""

import bpy
import numpy as np
import pytest
from numpy.testing import assert_allclose

from stga_addon.avatar.splats import SH_C0
from stga_addon.scene import compat
from stga_addon.scene.display import splat_nodes
from stga_addon.scene.display.splat_object import (
    choose_display,
    show_world_splats,
    use_transparent_bounces,
)

from .session import placed
from .test_engine import HEIGHT, WIDTH, _engine, camera_at, render  # noqa: F401
from .test_film_set import board
from .test_splat_object import random_splats

ZOOM = 4
"""Of images in which clouds are compared."""
DOT_M = 0.02
"""Half the side of the dot, at 2 m from the camera."""
TRIANGLE = "three blades, turned"
"""Name of the aperture whose orientation is seen."""
APERTURES = {
    "disk": {},
    TRIANGLE: {"aperture_blades": 3, "aperture_rotation": 0.4},
    "wide": {"aperture_ratio": 2.0},
}


@pytest.fixture
def scene():
    """A dot of splats and one of a mesh at the same place, of which one is shown."""
    splats = random_splats(1, 1, degree=0, extent=0.0)
    splats.log_scale[:] = np.log(DOT_M / 2)
    splats.opacity[:] = 12.0
    splats.sh[:] = 0.5 / SH_C0
    shown = show_world_splats(splats, "dot")
    corners = [(-DOT_M, -DOT_M), (DOT_M, -DOT_M), (DOT_M, DOT_M), (-DOT_M, DOT_M)]
    mesh = board("mesh", (1.0, 1.0, 1.0), [(x, 0.0, z) for x, z in corners])
    camera = camera_at(lens=40.0)
    camera.location = 0.0, -2.0, 0.0
    camera.rotation_euler = np.pi / 2, 0.0, 0.0
    scene = bpy.context.scene
    scene.eevee.taa_render_samples = 64
    scene.world = None
    return scene, shown, mesh


def moments(image):
    """Center (2,), covariance (2, 2) and third moment, as a complex number, of an image's light, in
    pixels; the angle of the last is three times that of a triangle."""
    light = image / image.sum()
    place = np.stack(np.mgrid[: image.shape[0], : image.shape[1]], -1).astype(float)
    center = (place * light[..., None]).sum((0, 1))
    apart = place - center
    third = (light * (apart[..., 1] + 1j * apart[..., 0]) ** 3).sum()
    return center, np.einsum("hw,hwi,hwj->ij", light, apart, apart), third


def by_both(shot, folder):
    """Moments of the dot by STGA Splats and by Cycles."""
    scene, shown, mesh = shot
    mesh.hide_render = True
    ours = moments(render(folder)["A"])
    mesh.hide_render = False
    shown.hide_render = True
    engine = scene.render.engine
    scene.render.engine = "CYCLES"
    scene.cycles.samples = 256
    scene.cycles.use_denoising = False
    theirs = moments(render(folder)["A"])
    scene.render.engine = engine
    shown.hide_render = False
    return ours, theirs


@pytest.mark.parametrize("name", APERTURES)
def test_depth_of_field_is_that_of_cycles(scene, name, tmp_path):
    """Catches a blur of another size, shape or orientation than Blender's, a focus at the wrong
    distance, and a dot that leaves its place."""
    dof = scene[0].camera.data.dof
    dof.use_dof = True
    dof.aperture_fstop = 0.05
    dof.focus_object = placed("focus", None)
    dof.focus_object.location = 0.3, -0.6, 0.2
    for key, value in APERTURES[name].items():
        setattr(dof, key, value)
    (center, spread, third), (other_center, other_spread, other_third) = by_both(scene, tmp_path)
    assert_allclose(center, other_center, atol=0.4)
    assert_allclose(spread, other_spread, atol=0.08 * spread.max())
    assert spread.trace() > 8.0
    if name == TRIANGLE:
        assert abs(third - other_third) < 0.3 * abs(other_third)


@pytest.mark.parametrize("position", ["START", "END"])
def test_motion_blur_is_that_of_cycles(scene, position, tmp_path):
    """Catches a shutter that opens at another time, or for another time, than Blender's, and a
    scene that is left at another frame."""
    own, *dots = scene
    own.render.use_motion_blur = True
    own.render.motion_blur_shutter = 0.8
    own.render.motion_blur_position = position
    own.frame_set(10)
    for dot in dots:
        for frame, x in ((9, -0.5), (11, 0.5)):
            dot.location.x = x
            dot.keyframe_insert("location", index=0, frame=frame)
        for key in compat.action_curves(dot)[0].keyframe_points:
            key.interpolation = "LINEAR"  # Cycles moves in straight lines within an exposure
    (center, spread, _), (other_center, other_spread, _) = by_both(scene, tmp_path)
    assert own.frame_current_final == 10
    assert_allclose(center, other_center, atol=0.4)
    assert_allclose(spread, other_spread, atol=0.06 * spread.max())
    assert spread.trace() > 8.0


@pytest.mark.nightly
@pytest.mark.skipif(not compat.NATIVE_SPLATS, reason="this Blender has no splats of its own")
@pytest.mark.parametrize("blur", ["lens", "shutter"])
def test_blurred_splats_are_those_of_cycles(scene, blur, tmp_path):
    """Catches a cloud that is blurred otherwise than Blender's own splats: by less than 35 dB. One
    color, because Cycles blends others in linear light."""
    own, dot, mesh = scene
    for each in (dot, mesh):
        bpy.data.objects.remove(each)
    splats = random_splats(1, 300, degree=0, extent=0.3)
    splats.log_scale[:] += 4.0
    splats.sh[:] = 0.5 / SH_C0
    shown = show_world_splats(splats, "cloud")
    own.eevee.taa_render_samples = 128
    own.camera.data.dof.use_dof = blur == "lens"
    own.camera.data.dof.aperture_fstop = 0.08
    own.camera.data.dof.focus_distance = 1.6
    own.render.use_motion_blur = blur == "shutter"
    own.render.resolution_percentage = 100 * ZOOM
    own.frame_set(10)
    for frame, x in ((9, -0.2), (11, 0.2)):
        shown.location.x = x
        shown.keyframe_insert("location", index=0, frame=frame)
    for key in compat.action_curves(shown)[0].keyframe_points:
        key.interpolation = "LINEAR"
    ours = render(tmp_path)["A"]
    choose_display(shown, splat_nodes.NATIVE)
    use_transparent_bounces(own)
    own.render.engine = "CYCLES"
    own.cycles.samples = 256
    own.cycles.use_denoising = False
    theirs = render(tmp_path)["A"]
    own.camera.data.dof.use_dof = own.render.use_motion_blur = False
    sharp = render(tmp_path)["A"]
    # Cycles is noisy: of its samples, each passes a splat or not
    ours, theirs, sharp = (
        image.reshape(HEIGHT, ZOOM, WIDTH, ZOOM).mean((1, 3)) for image in (ours, theirs, sharp)
    )
    error = np.mean((ours - theirs) ** 2)
    assert -10 * np.log10(error) > 35.0
    assert np.mean((sharp - theirs) ** 2) > 4 * error
