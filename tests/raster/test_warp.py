"""The Warp kernels on Warp's CPU device: what they have beside the tests that both sets of kernels share.

Those are the tests with the fixture `back_end`. That the code is also right on a GPU, no test here can say; that it
compiles for one, the last of them does.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import warp as wp
from numerics.meshes import bent_ball, collapsed

from raster import test_kernels
from raster.test_kernels import (
    GRADIENT_TOLERANCE,
    IMAGE_TOLERANCE,
    NAMES,
    SCENES,
    Scene,
    assert_gradients_agree,
    cloud,
    random_cotangents,
)
from stga_addon.avatar.embedding import CONVENTIONS, WORLD, face_frames
from stga_addon.avatar.strain import strain_basis
from stga_addon.raster import reference
from stga_addon.raster.cpu.image_loss import LOSS_REACH_PX, change_background
from stga_addon.raster.cpu.layout import Parameters
from stga_addon.raster.cpu.optimizer import adam_rows
from stga_addon.raster.cpu.rasterize import frames_in_camera
from stga_addon.raster.gpu import blend, embed, image_loss, optimizer, self_test
from stga_addon.raster.gpu.autograd import shared_arrays
from stga_addon.raster.gpu.rasterize import DeviceFrames, Rasterizer, device_camera
from stga_addon.training.optimize.adam import BETA1, BETA2, EPSILON
from stga_addon.training.optimize.losses import image_gradient, tile_rectangles, whole_image

DEVICE = "cpu"
MODULES = self_test.MODULES


class Raw:
    """A scene through the array door: renderings, and gradients whose untouched rows keep `fill`."""

    def __init__(self, scene: Scene, rasterizer: Rasterizer | None = None, antialiased: bool = False) -> None:
        self.rasterizer = rasterizer or Rasterizer(DEVICE)
        self.count = len(scene.splats["xyz"])
        tensors = [torch.from_numpy(scene.splats[name]) for name in NAMES]
        self.tensors = Parameters(*tensors, torch.zeros(self.count, 0, 3))
        self.face = wp.zeros(self.count, wp.int32, device=DEVICE)
        camera_frames = frames_in_camera(WORLD, scene.camera)
        arrays = [
            wp.array(value, dtype=kind, device=DEVICE)
            for value, kind in (
                (camera_frames.origin, wp.vec3),
                (camera_frames.matrix, wp.mat33),
                (camera_frames.strain, wp.float32),
            )
        ]
        self.frames = DeviceFrames(*arrays, device_camera(scene.camera, scene.degree, 0, antialiased=antialiased))
        v_image, v_alpha, _ = random_cotangents(scene.camera, 3)
        self.v_image, self.v_transmittance = v_image.float(), -v_alpha.float()

    def forward(self, focus: np.ndarray | None = None, reach: int = 0, **options):
        marked = None if focus is None else wp.array(focus.astype(np.uint8), dtype=wp.uint8, device=DEVICE)
        splats = shared_arrays(self.tensors)
        return self.rasterizer.forward(splats, self.face, self.frames, focus=marked, reach=reach, **options)

    def gradients(self, rendering, fill: float = 0.0) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
        """Gradients by name, the rows written, and those rows' screen gradient."""
        gradients = Parameters(*(torch.full_like(t, fill) for t in self.tensors))
        screen = self.rasterizer.backward(
            rendering, shared_arrays(self.tensors), self.face, wp.from_torch(self.v_image), shared_arrays(gradients),
            wp.from_torch(self.v_transmittance),
        )  # fmt: skip
        written = np.flatnonzero(rendering.wanted.numpy())
        return {n: t.numpy() for n, t in gradients._asdict().items()}, written, screen.numpy()[written]


def test_background_shows_through_and_pulls_on_the_splats() -> None:
    """Catches a background left out of the image, of its gradient, or counted twice."""
    scene, background = SCENES["plain"], np.float32([0.9, 0.2, 0.6])
    raw = Raw(scene)
    rendering = raw.forward(background=background)
    gradients, _, _ = raw.gradients(rendering)
    tensors = [torch.from_numpy(scene.splats[name]).double().requires_grad_() for name in NAMES]
    rgb, alpha, _ = reference.render(*tensors, scene.camera)
    image = rgb + torch.from_numpy(background)[:, None, None] * (1 - alpha)
    v_image, v_alpha, _ = random_cotangents(scene.camera, 3)
    expected = torch.autograd.grad((image * v_image).sum() + (alpha * v_alpha).sum(), tensors)
    assert np.abs(rendering.image.numpy() - image.detach().numpy()).max() < IMAGE_TOLERANCE
    assert_gradients_agree(gradients, dict(zip(NAMES, (g.numpy() for g in expected), strict=True)))


def test_screen_gradient_is_the_other_back_ends() -> None:
    """Catches density control fed with pixels, or with the gradient of something else."""
    scene = cloud(25, count=40, size=(60, 35))
    raw = Raw(scene)
    _, written, screen = raw.gradients(raw.forward())
    _, _, expected_rows, expected = test_kernels.raw_gradients(scene)
    np.testing.assert_array_equal(written, np.sort(expected_rows))
    np.testing.assert_allclose(screen, expected[written], atol=GRADIENT_TOLERANCE["xyz"] * expected[written].max())


def test_focused_rendering_gives_selected_rows_the_full_images_gradient() -> None:
    """Catches a local iteration whose restricted tiles change a selected gradient, or touch another row."""
    scene = cloud(21, count=80, size=(100, 70), log_scale=-3.0)
    focus = np.zeros(80, bool)
    focus[[3, 17, 40]] = True
    raw = Raw(scene)
    rendering = raw.forward()
    full, _, full_screen = raw.gradients(rendering)
    image = rendering.image.numpy().copy()
    part = raw.forward(focus, reach=10)
    rendered = part.rendered.numpy().reshape(5, 7).astype(bool)
    assert 0 < rendered.sum() < rendered.size
    gradients, written, screen = raw.gradients(part, fill=123.0)
    assert len(written) > 0
    assert set(written) <= {3, 17, 40}
    for name, gradient in gradients.items():
        np.testing.assert_array_equal(gradient[written], full[name][written], err_msg=name)
        assert (np.delete(gradient, written, axis=0) == 123).all(), name
    np.testing.assert_array_equal(screen, full_screen[np.isin(np.flatnonzero(raw.forward().wanted.numpy()), written)])
    pixels = np.kron(rendered, np.ones((16, 16), bool))[:70, :100]
    part = raw.forward(focus, reach=10)
    np.testing.assert_array_equal(part.image.numpy()[:, pixels], image[:, pixels])


def test_coefficients_above_the_degree_are_overwritten() -> None:
    """Catches stale gradients of harmonics that are not in use yet."""
    raw = Raw(SCENES["lower degree than stored"])
    gradients, written, _ = raw.gradients(raw.forward(), fill=5.0)
    assert len(written) > 20
    assert not gradients["sh"][written, 4:].any()


def test_the_same_bits_twice_and_from_used_buffers() -> None:
    """Catches sums in the order of chance, and results that depend on what an earlier image left in the buffers."""
    rasterizer = Rasterizer(DEVICE)
    for name in ("plain", "opaque layers", "one pixel", "exact tiles", "plain"):
        fresh, used = Raw(SCENES[name]), Raw(SCENES[name], rasterizer)
        expected, rendering = fresh.forward(), used.forward()
        np.testing.assert_array_equal(rendering.image.numpy(), expected.image.numpy(), err_msg=name)
        wanted, rows_written, _ = fresh.gradients(expected)
        gradients, same_rows, _ = used.gradients(rendering)
        np.testing.assert_array_equal(same_rows, rows_written)
        for parameter, want in wanted.items():
            np.testing.assert_array_equal(gradients[parameter], want, err_msg=f"{name}: {parameter}")


def test_what_does_not_fit_is_not_drawn_and_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches pairs that are dropped in silence, written past the buffers' end, or gradients of half a rendering."""
    scene = SCENES["plain"]
    expected = Raw(scene).forward().image.numpy().copy()
    monkeypatch.setattr("stga_addon.raster.gpu.rasterize.INITIAL_PAIR_CAPACITY", 10)
    raw = Raw(scene)
    rendering = raw.forward(wait=False)
    assert not rendering.image.numpy().any()
    gradients, written, _ = raw.gradients(rendering, fill=7.0)
    assert not len(written)
    assert all((gradient == 7).all() for gradient in gradients.values())
    assert not raw.rasterizer.pairs_fit()
    np.testing.assert_array_equal(raw.forward(wait=False).image.numpy(), expected)
    assert raw.rasterizer.pairs_fit()
    # With waiting, there is room at once.
    np.testing.assert_array_equal(Raw(scene).forward().image.numpy(), expected)


def bytes_of(seed: int, *shape: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, np.uint8)


@pytest.mark.parametrize("kind", ["noise", "bright and flat", "restricted"])
def test_image_loss_is_the_other_back_ends(kind: str) -> None:
    """Catches a window, a padding, a clamp or a sign that differs, and pixels outside the tiles that leak in."""
    scene = cloud(21, count=80, size=(100, 70), log_scale=-3.0)
    image, target = np.random.default_rng(1).random((3, 70, 100), np.float32), bytes_of(2, 70, 100, 3)
    rectangles = whole_image(70, 100)
    focus = None
    if kind == "bright and flat":
        image, target = np.full_like(image, 0.999), np.full_like(target, 255)
        image[:, 20:30, 40:60] = 0.5
    raw = Raw(scene)
    if kind == "restricted":
        focus = np.arange(80) == 17
    rendering = raw.forward(focus, LOSS_REACH_PX)
    if focus is not None:
        pixels = [np.kron(marks.numpy().reshape(5, 7), np.ones((16, 16)))[:70, :100] for marks in tiles_of(rendering)]
        touched, rendered = (marks > 0 for marks in pixels)
        rectangles = tile_rectangles(rendering.touched.numpy().reshape(5, 7) > 0, 70, 100)
    else:
        touched = rendered = np.ones((70, 100), bool)
    expected = np.empty_like(image)
    l1, ssim = image_gradient(image, target, rectangles, 0.2, expected)
    visible = np.where(rendered, image, np.nan)
    rendering = replace(rendering, image=wp.array(visible, dtype=wp.float32, device=DEVICE))
    gradient, loss = image_loss.image_loss_gradient(raw.rasterizer, rendering, wp.array(target, device=DEVICE), 0.2)
    got, want = gradient.numpy()[:, touched], expected[:, touched]
    # In flat regions both lose digits to the same cancellation, each in its own order of summation.
    tolerance = 5e-4 if kind == "bright and flat" else 2e-5
    np.testing.assert_allclose(got, want, atol=tolerance * np.abs(want).max())
    if focus is None:
        assert float(loss.numpy().mean()) == pytest.approx(0.8 * l1 + 0.2 * (1 - ssim), rel=2 * tolerance)


def tiles_of(rendering) -> tuple[wp.array, wp.array]:
    return rendering.touched, rendering.rendered


def test_background_is_exchanged_as_on_the_cpu() -> None:
    """Catches another rounding or clamp; only where the mixture lies between two bytes may either be taken."""
    image, mask = bytes_of(3, 60, 80, 3), bytes_of(4, 60, 80)
    before, after = 255 * np.ones(3, np.float32), 255 * np.float32([0.13, 0.82, 0.43])
    expected, out = np.empty_like(image), wp.empty(image.shape, wp.uint8, device=DEVICE)
    change_background(image, mask, before, after, expected)
    given = [wp.array(array, device=DEVICE) for array in (image, mask)]
    wp.launch(
        image_loss.change_background, mask.shape, [*given, wp.vec3(*(after - before).tolist()), out], device=DEVICE
    )
    other = np.abs(out.numpy().astype(int) - expected)
    exact = image + (1 - mask[..., None] / 255) * (after - before).astype(float)
    between = np.abs(exact % 1 - 0.5) < 1e-4
    assert other.max() <= 1
    assert not other[~between].any()
    assert between.mean() < 0.02


def test_adam_is_the_other_back_ends_and_keeps_broken_rows() -> None:
    """Catches a wrong moment or correction, and NaN or a square beyond float32 that gets into a row."""
    rng = np.random.default_rng(5)
    tables = [np.abs(rng.normal(size=(7, 6))).astype(np.float32) for _ in range(5)]
    tables[1][2, 5], tables[1][3, 0], tables[1][4, 1] = np.nan, 1e20, -np.inf
    steps, wanted = np.arange(7, dtype=np.int32) ** 5, np.array([1, 1, 1, 1, 1, 0, 1], np.uint8)
    rates = np.float32([[0.1] * 3 + [0.01] * 3])
    device = [wp.array(table, device=DEVICE) for table in tables]
    counts, correct = wp.array(steps, device=DEVICE), wp.zeros(7, wp.vec3, device=DEVICE)
    marks = wp.array(wanted, device=DEVICE)
    logarithms = np.log(np.float64(BETA1)), np.log(np.float64(BETA2))
    wp.launch(optimizer.count_steps, 7, [marks, *logarithms, 0.05, counts, correct], device=DEVICE)
    wp.launch(
        optimizer.adam, (7, 6), [marks, correct, *device, 0.1, 0.01, 3, *(float(b) for b in (BETA1, BETA2, EPSILON))],
        device=DEVICE,
    )  # fmt: skip
    listed = np.flatnonzero(wanted).astype(np.int32)
    parts = [(table,) for table in tables]
    adam_rows(listed, steps, *parts, rates, BETA1, BETA2, EPSILON, np.float32(0.05))
    np.testing.assert_array_equal(counts.numpy(), steps)
    for got, want in zip(device, tables, strict=True):
        np.testing.assert_allclose(got.numpy(), want, rtol=2e-6, atol=2e-7)


@pytest.mark.parametrize("mesh", ["ball", "collapsed", "lines in the neutral mesh", "far away"])
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_frames_and_strain_are_numpys(convention: str, mesh: str) -> None:
    """Catches another rule for a triangle without area, an axis that differs, and precision lost in float32."""
    posed, neutral, faces = bent_ball() if mesh in ("ball", "far away") else collapsed()
    camera = cloud(1).camera
    if mesh == "lines in the neutral mesh":
        posed, neutral = neutral, posed
    if mesh == "far away":
        shift = np.array([1e4, -1e4, 1e4])
        posed, camera.world_to_camera[:3, 3] = posed + shift, -camera.world_to_camera[:3, :3] @ shift
    basis = strain_basis(neutral, faces)
    expected = frames_in_camera(face_frames(posed, faces, neutral, convention, basis), camera)
    step = embed.Embedding(wp.get_device(DEVICE), neutral, faces, convention, basis)
    origin, matrix, strain = step.frames(wp.array(posed, dtype=wp.vec3d, device=DEVICE), camera)
    np.testing.assert_allclose(origin.numpy(), expected.origin, atol=1e-6)
    np.testing.assert_allclose(matrix.numpy(), expected.matrix, atol=1e-6)
    # On a line of 1 cm, strain is a difference of squares over an area that is hardly there.
    tolerance = 0.02 if mesh == "lines in the neutral mesh" else 1e-6
    np.testing.assert_allclose(strain.numpy(), expected.strain, atol=tolerance)
    assert expected.strain.any()


def test_without_strain_there_is_none() -> None:
    """Catches a strain computed, or colors that follow it, where nobody asked for it."""
    posed, neutral, faces = bent_ball()
    step = embed.Embedding(wp.get_device(DEVICE), neutral, faces, "stga")
    assert step.frames(wp.array(posed, dtype=wp.vec3d, device=DEVICE), cloud(1).camera)[2].shape == (len(faces), 0)


def test_a_trial_finds_wrong_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a trial that passes whatever a device computes."""
    assert self_test.passes(DEVICE)
    backward = Rasterizer.backward

    def loses_a_tile(self, rendering, *arguments):
        rendering.touched.numpy()[0] = 0
        return backward(self, rendering, *arguments)

    monkeypatch.setattr(Rasterizer, "backward", loses_a_tile)
    assert not self_test.passes(DEVICE)


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.__name__.rpartition(".")[2])
def test_kernels_compile_for_a_gpu(module, tmp_path: Path) -> None:
    """Catches code that only Warp's CPU device understands; needs no GPU and no CUDA toolkit. 75 is Turing."""
    (compiled,) = wp.compile_aot_module(module, arch=75, module_dir=tmp_path, use_ptx=True)
    text = compiled.read_text(encoding="utf-8", errors="replace")
    assert text.count(".entry") == len(wp.get_module(module.__name__).kernels)
    assert "local_depot" not in text, "a per-thread array that is not in registers"
    if module is blend:
        assert "shfl.sync" in text
    if module not in (embed, optimizer):
        assert "fma.rn.f64" not in text, "double precision"
