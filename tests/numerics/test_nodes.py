"""Degenerate meshes in Blender's geometry nodes, which compute in float32: numpy's remedy, not just
a finite one."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

bpy = pytest.importorskip("bpy")

from blender.test_splat_object import evaluated_vertices, random_splats, same_rotation  # noqa: E402

from stga_addon.avatar.embedding import CONVENTIONS, face_frames, to_world  # noqa: E402
from stga_addon.avatar.file import Avatar  # noqa: E402
from stga_addon.development.demo.in_blender import evaluated_splats  # noqa: E402
from stga_addon.scene.display.splat_object import show_avatar  # noqa: E402

from .meshes import DEGENERATE, WHOLE, mesh_of  # noqa: E402

PER_FACE = 4
HALF_TURNS = [np.diag(signs) for signs in ((1, -1, -1), (-1, 1, -1), (-1, -1, 1))]


@pytest.fixture(autouse=True)
def _empty_scene():
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)


def shown_and_expected(posed, neutral, convention):
    """Evaluated (xyz, rotation, scale) of a few splats a triangle, and `to_world` on the evaluated
    vertices."""
    vertices, faces = mesh_of(posed)
    splats = random_splats(
        len(faces), PER_FACE * len(faces), extent=0.005 if convention == "stga" else 0.5
    )
    splats.face[:] = np.repeat(np.arange(len(faces)), PER_FACE)
    avatar = Avatar(splats, convention, mesh_of(neutral)[0].astype(np.float32), faces)
    mesh = bpy.data.meshes.new("head")
    mesh.from_pydata(vertices.tolist(), [], faces.tolist())
    head = bpy.data.objects.new("head", mesh)
    bpy.context.scene.collection.objects.link(head)
    shown = show_avatar(avatar, head)
    bpy.context.view_layer.update()
    frames = face_frames(evaluated_vertices(head), faces, avatar.neutral, convention)
    return evaluated_splats(shown), to_world(splats, frames)


@pytest.mark.parametrize("when", ["now", "in the neutral mesh", "always"])
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_degenerate_triangles_are_numpys(convention, when):
    """Catches Blender's own substitutes for missing axes, and a rounding error taken for a normal
    or for growth.

    With the node's substitutes, and areas compared with zero, rotations differ by up to half a
    turn, and splats of a triangle that is a line in the neutral mesh only fly up to 100 m away.
    """
    flat = list(DEGENERATE.values())
    whole = [WHOLE + 0.02 * n for n in range(len(DEGENERATE))]
    posed, neutral = {
        "now": (flat, whole),
        "in the neutral mesh": (whole, flat),
        "always": (flat, flat),
    }[when]
    (xyz, rotation, scale), expected = shown_and_expected(posed, neutral, convention)
    for n, name in enumerate(DEGENERATE):
        splats = slice(PER_FACE * n, PER_FACE * (n + 1))
        assert_allclose(xyz[splats], expected.xyz[splats], atol=2e-6, err_msg=name)
        assert np.abs(expected.xyz[splats]).max() < 1, name
        assert same_rotation(rotation[splats], expected.rotation[splats]) < 1e-3, name
        # A line's area is rounding; its splats are too small to be seen, whatever its square root
        # is.
        assert_allclose(
            scale[splats], np.exp(expected.log_scale[splats]), rtol=2e-3, atol=2e-5, err_msg=name
        )


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_half_turns_and_flips(convention):
    """Catches a matrix-to-quaternion conversion that divides by zero at trace −1, and a mirrored
    frame."""
    turns = [np.eye(3), *HALF_TURNS]
    (xyz, rotation, _), expected = shown_and_expected(
        [WHOLE @ turn for turn in turns] + [WHOLE[[0, 2, 1]]], [WHOLE] * 5, convention
    )
    assert_allclose(xyz, expected.xyz, atol=2e-6)
    assert same_rotation(rotation, expected.rotation) < 1e-3
