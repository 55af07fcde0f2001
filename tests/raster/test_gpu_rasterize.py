"""The GPU rasterizer: what it has beside the tests that both back ends share, which are those with
`back_end`."""

import numpy as np
import pytest

from raster import gpu_device
from raster.test_kernels import (
    NAMES,
    SCENES,
    Scene,
    random_cotangents,
)
from stga_addon.avatar.embedding import WORLD
from stga_addon.raster.cpu.layout import PROJECTED, Parameters
from stga_addon.raster.cpu.rasterize import frames_in_camera, render_forward
from stga_addon.raster.gpu import trial
from stga_addon.raster.gpu.device import Device
from stga_addon.raster.gpu.layout import split_rows
from stga_addon.raster.gpu.rasterize import (
    Rasterizer,
    Tables,
    ViewOptions,
    upload_frames,
    upload_splats,
)

pytestmark = pytest.mark.needs("adapter")


class Raw:
    """Renders a scene of numpy arrays by `Rasterizer`, forward and backward; rows not written keep
    `fill`."""

    def __init__(
        self, scene: Scene, rasterizer: Rasterizer | None = None, antialiased: bool = False
    ) -> None:
        self.rasterizer = rasterizer or Rasterizer(Device())
        self.device, self.scene, self.antialiased = self.rasterizer.device, scene, antialiased
        self.count = len(scene.splats["xyz"])
        self.splats = Parameters(*(scene.splats[name] for name in NAMES))
        v_image, v_alpha, _ = random_cotangents(scene.camera, 3)
        self.cotangents = v_image.float().numpy(), -v_alpha.float().numpy()

    def read(self, buffer, *shape: int, dtype: type = np.float32) -> np.ndarray:
        return self.device.read(buffer, shape, dtype)

    def image(self, rendering: Tables) -> np.ndarray:
        return self.read(rendering["image"], 3, self.scene.camera.height, self.scene.camera.width)

    def forward(
        self, focus: np.ndarray | None = None, reach: int = 0, background=(0, 0, 0)
    ) -> Tables:
        self.table = upload_splats(self.device, self.splats, np.zeros(self.count, np.int32))
        frames = upload_frames(self.device, frames_in_camera(WORLD, self.scene.camera))
        options = ViewOptions(
            self.scene.camera, self.scene.degree, background, antialiased=self.antialiased,
            focused=focus is not None,
            reach=reach,
        )  # fmt: skip
        marked = None if focus is None else self.device.upload("focus", focus.astype(np.uint32))
        with self.device.record() as work:
            view = self.rasterizer.upload_view(self.table, options)
            return self.rasterizer.forward(work, self.table, frames, options, view, marked)

    def gradients(
        self, rendering: Tables, fill: float = 0.0
    ) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
        """Gradients by name, the rows written, and those rows' screen gradient."""
        table, device = self.table, self.device
        gradients = device.upload(
            "gradients", np.full((table.count, table.stride), fill, np.float32)
        )
        v_image, v_transmittance = (
            device.upload(f"v {n}", v) for n, v in enumerate(self.cotangents)
        )
        with device.record() as work:
            screen = self.rasterizer.backward(
                work, rendering, table, self.scene.camera, v_image, gradients, v_transmittance
            )
        written = np.flatnonzero(self.read(rendering["wanted"], self.count, dtype=np.uint32))
        rows = split_rows(self.read(gradients, table.count, table.stride), table.coefficients)
        return (
            {name: getattr(rows, name) for name in NAMES},
            written,
            self.read(screen, self.count)[written],
        )


def test_the_same_bits_twice_and_from_used_buffers() -> None:
    """Catches sums in the order of chance, and results that depend on what an earlier image left in
    the buffers."""
    rasterizer = Raw(SCENES["plain"]).rasterizer
    for name in ("plain", "opaque layers", "one pixel", "exact tiles", "plain"):
        fresh, used = Raw(SCENES[name]), Raw(SCENES[name], rasterizer)
        expected, rendering = fresh.forward(), used.forward()
        np.testing.assert_array_equal(used.image(rendering), fresh.image(expected), err_msg=name)
        wanted, rows_written, _ = fresh.gradients(expected)
        gradients, same_rows, _ = used.gradients(rendering)
        np.testing.assert_array_equal(same_rows, rows_written)
        for parameter, want in wanted.items():
            np.testing.assert_array_equal(
                gradients[parameter], want, err_msg=f"{name}: {parameter}"
            )


def test_a_trial_finds_wrong_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches a trial that passes whatever a device computes."""
    device = gpu_device.device()
    monkeypatch.setattr(trial, "SECONDS", 0.0)
    assert trial.try_device(device).is_right
    backward = Rasterizer.backward

    def loses_a_tile(self, work, rendering, *arguments):
        # which hold the right ones of the first trial
        work.clear(work.device.buffer("pair_gradients", 0))
        work.clear(rendering["touched"], 12)
        return backward(self, work, rendering, *arguments)

    monkeypatch.setattr(Rasterizer, "backward", loses_a_tile)
    assert not trial.try_device(device).is_right


@pytest.mark.parametrize("field", NAMES)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_broken_splat_is_dropped(field: str, value: float) -> None:
    """Catches NaN and infinity that reach the screen, and neighbors that change because of them."""
    scene = SCENES["plain"]
    raw = Raw(scene, Rasterizer(gpu_device.device()))

    def projected() -> tuple[np.ndarray, np.ndarray]:
        raw.forward()
        return raw.read(raw.device.buffer("rect", 0), raw.count, 4, dtype=np.int32), raw.read(
            raw.device.buffer("projected", 0), raw.count, PROJECTED
        )

    bounds, expected = projected()
    row = int(np.flatnonzero(bounds[:, 2] > bounds[:, 0])[3])
    raw.splats = Parameters(*(scene.splats[name].copy() for name in NAMES))
    getattr(raw.splats, field).reshape(raw.count, -1)[row, 0] = value
    frames = frames_in_camera(WORLD, scene.camera)
    on_cpu = render_forward(
        raw.splats, np.zeros(raw.count, np.int32), frames, scene.degree
    ).projection.rect
    found, columns = projected()
    visible, others = found[:, 2] > found[:, 0], np.arange(raw.count) != row
    np.testing.assert_array_equal(found[others], bounds[others])
    np.testing.assert_array_equal(columns[others & visible], expected[others & visible])
    assert np.isfinite(columns[visible]).all()
    assert visible[row] == (on_cpu[row, 2] > on_cpu[row, 0])
