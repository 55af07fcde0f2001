"""Splats, rotations and projections at the edge of float32: kernels against the float64 reference,
both directions."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal

from stga_addon.avatar.embedding import face_frames
from stga_addon.capture.camera import Camera

from .scenes import (
    NAMES,
    assert_agree,
    assert_close,
    compare,
    facing,
    kernel_gradients,
    random_cotangents,
    reference_gradients,
    rows,
    steady_pixels,
)

RNG = default_rng(0)
TAN_89 = np.tan(np.radians(89))


def log_normal(count, scale, seed=1):
    """Anisotropic, because the rotation of a ball has no gradient to compare."""
    return default_rng(seed).normal(np.log(scale), 0.4, (count, 3))


def beside(count, reach):
    """Positions 89° off the axis, left and right, 2 to 20 cm ahead."""
    z = RNG.uniform(0.02, 0.2, count)
    return np.c_[
        z * TAN_89 * np.where(np.arange(count) % 2, 1, -1), RNG.uniform(-reach, reach, count), z
    ]


def needle(longest, count=60):
    return np.tile(np.log([longest, longest * 1e-6, longest * 1e-6]), (count, 1))


def with_depths(depths):
    scene = facing(len(depths))
    scene.splats["xyz"][:, 2] = depths
    return scene


TWO = np.float32(2)
SCENES = {
    # Without PRECISION_X, SHEAR, PRECISION_Y instead of the inverse covariance, in this order:
    # gradients of log_scale off by a factor of 200; by 5e-4; 200; 2e6; 8, and the image by 3e-4.
    "scales from 1e-12 to 1e3 m": facing(
        60, log_scale=RNG.uniform(np.log(1e-12), np.log(1e3), (60, 3))
    ),
    "needle of 0.6 m, 1e6 : 1": facing(60, log_scale=needle(0.6)),
    "needle of 20 m, 1e6 : 1": facing(60, log_scale=needle(20)),
    "needle of 1 km, 1e6 : 1": facing(60, log_scale=needle(1000)),
    "needles that reach in from far outside": facing(
        60,
        xyz=np.c_[RNG.uniform(-8, 8, (60, 2)), RNG.uniform(1.5, 2.5, 60)],
        log_scale=np.tile(np.log([7.4, 7e-3, 7e-3]), (60, 1)),
    ),
    "pancakes 1e6 : 1": facing(
        60, log_scale=np.tile(np.log([20, 20, 2e-5]), (60, 1)), opacity=np.full(60, -2.0)
    ),
    # Catches 1 − σ(x), which keeps two digits of the opacity's gradient in float32.
    "opacity logits of 12": facing(60, opacity=np.full(60, 12.0)),
    # Catches exp(50)², and σ(−50) / σ(−50) of a splat that nobody sees.
    "opacity logits of ±50": facing(60, opacity=np.array([50, -50, 0] * 20)),
    # Catches a color that is clamped above or kept in fewer bits.
    "harmonics of 1e4": facing(60, sh=RNG.normal(0, 1e4, (60, 4, 3))),
    # Catches tile bounds that are not cut at the image.
    "each covers everything": facing(12, log_scale=log_normal(12, 30), opacity=np.full(12, -2.0)),
    # Catches a near plane that is missing, elsewhere, or compared with another rounding of 0.01.
    "on, before and behind the near plane": facing(
        8,
        xyz=np.c_[
            RNG.uniform(-0.004, 0.004, (8, 2)),
            0.01 * (1 + np.array([1e-6, -1e-6, 1e-3, 0.01, 0.1, -0.1, 0, 0])),
        ],
        log_scale=log_normal(8, 3e-4),
        opacity=np.full(8, -1.0),
    ),
    # Catches a Jacobian without limits: these would lie across the image as streaks.
    "89° off the axis": facing(20, xyz=beside(20, 0.1), log_scale=log_normal(20, 3)),
    "89° off the axis, in view of a 178° lens": facing(
        20, xyz=beside(20, 0.1), log_scale=log_normal(20, 0.1), focal=37 / 2 / TAN_89
    ),
    # Catches a sort that is not stable, or that compares fewer bits than a float32 has.
    "equal depths": with_depths(np.full(60, TWO)),
    "depths one ulp apart": with_depths(
        np.choose(
            np.arange(60) * 7 % 3,
            [TWO, np.nextafter(TWO, np.float32(3)), np.nextafter(TWO, np.float32(0))],
        )
    ),
}


@pytest.mark.parametrize("name", SCENES)
def test_hard_scene_is_the_references(back_end, name):
    """Catches what the comment beside the scene says; anything not finite; any error beyond the
    table's tolerances."""
    # The kernel's near plane is the float32 next to 0.01.
    errors, gradients = compare(SCENES[name], near=float(np.float32(0.01)))
    assert all(gradient.any() for gradient in gradients.values()), "nothing to see"
    assert_close(errors, image=2e-5, gradient=2e-4)


@pytest.mark.parametrize("norm", [0.0, 1e-38, 1e-20, 1e-13, 1e13, 1e20, 1e37])
def test_quaternions_of_any_length(back_end, norm):
    """Catches squares that leave float32's range: such splats, and those of length zero, used to
    vanish.

    A quaternion of length zero counts as no rotation, as in the embedding, and has no gradient. The
    gradient of any other is 1 / length times that of the unit quaternion, up to 1e12, so that Adam
    can square it. Graphics cards may take subnormal numbers for zero.
    """
    if back_end == "gpu" and 0 < norm < np.finfo(np.float32).tiny:
        pytest.skip("subnormal components")
    scene = facing(30)
    unit = scene.splats["rotation"].astype(np.float64)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    extreme = replace(scene, splats=scene.splats | {"rotation": (unit * norm).astype(np.float32)})
    if norm == 0:
        unit[:] = [1, 0, 0, 0]
    scene.splats["rotation"] = unit.astype(np.float32)
    cotangents = random_cotangents(scene.camera)
    images, gradients = kernel_gradients(extreme, cotangents)
    expected_images, expected = reference_gradients(scene, cotangents)
    for image, want in zip(images, expected_images, strict=True):
        assert_allclose(image, want, atol=5e-6)
    expected["rotation"] *= min(1 / norm, 1e12) if norm else 0
    lost = 2 * np.finfo(np.float32).tiny if back_end == "gpu" else 0  # of a sum of subnormal ones
    for name in NAMES:
        atol = 1e-5 * np.abs(expected[name]).max() + lost
        assert_allclose(gradients[name], expected[name], atol=atol, rtol=1e-4)


BROKEN = {name: (name, np.nan) for name in NAMES} | {
    "infinite position": ("xyz", np.inf),
    "infinite rotation": ("rotation", np.inf),
    "scale of e^100": ("log_scale", 100.0),
    "sh of minus infinity": ("sh", -np.inf),
}


@pytest.mark.parametrize("name", BROKEN)
def test_a_broken_splat_is_dropped(back_end, name):
    """Catches NaN that spreads, or that a clamp turns into a plausible number.

    NaN in `sh` was cut to zero: a black splat with NaN gradients. The image and the other rows'
    gradients must be bit-identical to those without the splat, and its own row zero.
    """
    scene = facing(20)
    field, value = BROKEN[name]
    scene.splats[field][3] = value
    others = np.arange(20) != 3
    cotangents = random_cotangents(scene.camera)
    images, gradients = kernel_gradients(scene, cotangents)
    expected_images, expected = kernel_gradients(rows(scene, others), cotangents)
    for image, want in zip(images, expected_images, strict=True):
        assert_array_equal(image, want)
    for parameter in NAMES:
        assert_array_equal(gradients[parameter][others], expected[parameter], err_msg=parameter)
        assert not gradients[parameter][3].any(), parameter


def test_ten_thousand_opaque_layers(back_end):
    """Catches a backward pass that divides by 1 − alpha beyond the pixel's end: gradients of 1e30
    and NaN.

    Within the first 300 layers every pixel is closed; behind that nothing may have a gradient,
    before it the reference's. Reading the stop from the transmittance again instead of the stored
    last splat fails here.
    """
    depths = np.linspace(1, 3, 10_000)
    scene = facing(
        10_000,
        size=(18, 17),
        xyz=np.c_[default_rng(2).uniform(-0.3, 0.3, (10_000, 2)), depths],
        log_scale=log_normal(10_000, 0.2),
        opacity=np.full(10_000, 7.0),
    )
    front = rows(scene, np.arange(10_000) < 300)
    steady = torch.from_numpy(steady_pixels(front))
    assert steady.float().mean() > 0.5
    cotangents = [v * steady for v in random_cotangents(scene.camera)]
    images, gradients = kernel_gradients(scene, cotangents)
    expected_images, expected = reference_gradients(front, cotangents)
    assert expected_images[1].min() > 0.99
    for name in NAMES:
        assert not gradients[name][300:].any(), name  # nor NaN
    shown = [steady.numpy() * image for image in images]
    wanted = [steady.numpy() * image for image in expected_images]
    before = {name: gradient[:300] for name, gradient in gradients.items()}
    assert_agree((shown, before), (wanted, expected), 1e-5, 1e-4)


def triangles(seed=3, count=12):
    """Posed and neutral vertices (V, 3) of a head-sized soup of triangles, and its faces."""
    rng = default_rng(seed)
    faces = np.arange(3 * count).reshape(-1, 3)
    neutral = rng.uniform(-0.1, 0.1, (count, 1, 3)) + rng.normal(0, 0.02, (count, 3, 3))
    neutral = neutral.reshape(-1, 3)
    return neutral + rng.normal(0, 0.003, neutral.shape), neutral, faces


def embedded(camera):
    """Splats in the frames of the triangles, and face (N,) int32."""
    rng = default_rng(4)
    scene = facing(60, 4, xyz=rng.normal(0, 0.005, (60, 3)), log_scale=log_normal(60, 0.008))
    return replace(scene, camera=camera), rng.integers(0, 12, 60).astype(np.int32)


def head_camera(distance=0.8, focal=90.0):
    pose = np.eye(4)
    pose[:3, 3] = [0.01, -0.02, distance]
    return Camera(41, 35, focal, focal, 20.0, 18.0, pose)


@pytest.mark.parametrize("shift", [[100.0, 0, 0], [-60.0, 70, 40], [1e4, 1e4, 1e4]])
def test_a_head_far_from_the_origin_is_the_same_head(back_end, shift):
    """Catches frames or cameras composed in float32: at 100 m that is 8 µm a coordinate, at 10 km a
    millimeter."""
    posed, neutral, faces = triangles()
    camera = head_camera()
    cotangents = random_cotangents(head_camera())
    scene, face = embedded(camera)
    found = kernel_gradients(scene, cotangents, face_frames(posed, faces, neutral), face)
    moved = camera.world_to_camera.copy()
    moved[:3, 3] -= moved[:3, :3] @ shift
    far = replace(scene, camera=replace(camera, world_to_camera=moved))
    frames = face_frames(posed + shift, faces, neutral + shift)
    assert_agree(kernel_gradients(far, cotangents, frames, face), found, 2e-6, 1e-5)


@pytest.mark.parametrize(
    ("size", "distance", "focal"), [(1000.0, 800.0, 90.0), (1e-3, 0.08, 9e3), (1e-3, 0.02, 2e3)]
)
def test_a_mesh_a_thousand_times_too_large_or_small(back_end, size, distance, focal):
    """Catches absolute thresholds (areas, lengths) on the way from a mesh to an image and back to
    the splats.

    The large one is seen from as far away; the small one through a longer lens, and from just
    before the near plane.
    """
    posed, neutral, faces = triangles()
    camera = head_camera(distance, focal)
    camera.world_to_camera[:2, 3] *= size
    scene, face = embedded(camera)
    # the splats stay in meters of the neutral mesh
    given = scene, random_cotangents(camera), face_frames(posed * size, faces, neutral), face
    assert_agree(kernel_gradients(*given), reference_gradients(*given))
