"""Hard scenes for the float32 kernels, and how far they are from the float64 reference."""

from dataclasses import replace

import numpy as np
import torch
from numpy.testing import assert_allclose
from raster import reference
from raster.test_kernels import (
    NAMES,
    Scene,
    kernel_gradients,
    random_cotangents,
    reference_gradients,
)

from stga_addon.capture.camera import Camera

IMAGES = "rgb", "alpha", "depth"


def facing(count, seed=0, size=(37, 29), focal=40.0, degree=1, **changes):
    """`count` splats two meters before a camera at the origin that looks along +z; `changes`
    replaces parameters."""
    rng = np.random.default_rng(seed)
    width, height = size
    splats = {
        "xyz": np.c_[rng.uniform(-0.8, 0.8, (count, 2)), rng.uniform(1.5, 2.5, count)],
        "rotation": rng.normal(size=(count, 4)),
        "log_scale": rng.normal(-2.5, 0.4, (count, 3)),
        "opacity": rng.normal(0, 1.5, count),
        "sh": rng.normal(0, 0.4, (count, (degree + 1) ** 2, 3)),
    } | changes
    camera = Camera(width, height, focal, focal * 1.1, width / 2 - 0.3, height / 2 + 0.2, np.eye(4))
    return Scene(
        {name: np.asarray(value, np.float32) for name, value in splats.items()}, camera, degree
    )


def rows(scene, keep):
    return replace(scene, splats={name: value[keep] for name, value in scene.splats.items()})


def steady_pixels(scene, margin=1e-3):
    """(H, W) bool: pixels where no splat is within `margin` (relative) of one of the renderer's
    jumps.

    They are alpha at 1/255 and at the clamp 0.999, and transmittance at the stop 1e-4. On which
    side a float32 lies there is chance, and both sides are right.
    """
    *placed, opacity, _ = (torch.from_numpy(scene.splats[name]).double() for name in NAMES)

    def alphas(factor):
        """With the cut-offs moved, by making each splat a little more or less opaque."""
        return reference.layers(*placed, factor * torch.sigmoid(opacity), scene.camera, 0.0099)[1]

    shape = (scene.camera.height, scene.camera.width)
    steady = torch.ones(shape, dtype=torch.bool)
    transmittance = torch.ones(shape, dtype=torch.float64)
    running = torch.ones(shape, dtype=torch.bool)
    kept = alphas(1)
    for moved in (alphas(1 - margin), alphas(1 + margin)):
        steady &= (((moved > 0) == (kept > 0)) & ((moved < 0.999) == (kept < 0.999))).all(0)
    for alpha in kept:
        after = transmittance * (1 - alpha)
        steady &= ~running | ((after - 1e-4).abs() > margin * 1e-4)
        running &= after > 1e-4
        transmittance = torch.where(running, after, transmittance)
    return steady.numpy()


def compare(scene, near=0.01, roundings=0):
    """Largest differences between kernels and reference on steady pixels, and the kernels'
    gradients.

    Images: absolute for rgb and alpha, relative to the largest for depth and for colors above one.
    Gradients: under random cotangents, over the largest of the quantity. Fails if anything is not
    finite.
    roundings: how often the scene's numbers are rounded otherwise to see what that alone does to
    the float64 result; only a difference beyond ten times as much counts, because what hangs on the
    last bit of its input, such as the turning of a long needle or the slope at a splat's summit, no
    float32 can know.
    """
    steady = steady_pixels(scene)
    cotangents = [v * torch.from_numpy(steady) for v in random_cotangents(scene.camera)]
    images, gradients = kernel_gradients(scene, cotangents)
    got = _named(images, gradients, steady)
    want = _named(*reference_gradients(scene, cotangents, near=near), steady)
    moved = [
        _named(*reference_gradients(rounded(scene, seed), cotangents, near=near), steady)
        for seed in range(roundings)
    ]
    scales = {
        name: max(np.abs(value).max(), 1 if name in IMAGES else 1e-6)
        for name, value in want.items()
    }
    # Turning a ball changes nothing: what would be its gradient cancels, and float32 leaves the
    # rounding of its parts.
    length = np.linalg.norm(scene.splats["rotation"].astype(np.float64), axis=1, keepdims=True)
    scales["rotation"] = max(scales["rotation"], np.abs(want["log_scale"] / length).max())
    errors = {}
    for name, value in want.items():
        assert np.isfinite(got[name]).all(), f"{name} is not finite"
        unknown = 10 * max((np.abs(other[name] - value).max() for other in moved), default=0)
        errors[name] = float(max(0, np.abs(got[name] - value).max() - unknown) / scales[name])
    return errors, gradients


def _named(images, gradients, steady):
    """The images, black where they are not steady, and the gradients."""
    shown = (np.where(steady, image, image * 0) for image in images)
    return dict(zip(IMAGES, shown, strict=True)) | gradients


def rounded(scene, seed):
    """The scene with every other number one unit in the last place farther from zero."""
    rng = np.random.default_rng(seed)
    moved = {
        name: np.where(
            rng.random(value.shape) < 0.5, value, np.nextafter(value, np.copysign(np.inf, value))
        )
        for name, value in scene.splats.items()
    }
    return replace(scene, splats=moved)


def assert_close(errors, image, gradient):
    """Every error below its tolerance; the message names those that are not."""
    limits = dict.fromkeys(IMAGES, image)
    bad = {name: f"{e:.1e}" for name, e in errors.items() if not e < limits.get(name, gradient)}
    assert not bad, bad


def assert_agree(found, expected, image=5e-6, gradient=2e-5):
    """Images and gradients are the expected ones; image: absolute tolerance, relative to the
    largest above one; gradient: over the largest of the quantity."""
    images, gradients = found
    expected_images, expected_gradients = expected
    assert expected_images[1].max() > 0.3
    for one, want in zip(images, expected_images, strict=True):
        assert_allclose(one, want, atol=image * max(1, want.max()))
    for name, want in expected_gradients.items():
        largest = np.abs(want).max()
        assert_allclose(gradients[name], want, atol=gradient * largest, err_msg=name)
