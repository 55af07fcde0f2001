"""Embedding, projection and color on a WebGPU device against the CPU's kernels, and their gradients."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from numerics.meshes import bent_ball, collapsed

from raster import gpu_device
from raster.test_kernels import GRADIENT_TOLERANCE, SCENES, Scene
from stga_addon.avatar.embedding import CONVENTIONS, face_frames
from stga_addon.avatar.file import Avatar
from stga_addon.avatar.splats import Splats
from stga_addon.avatar.strain import COLOR_RANGE, MAX_STRAIN, STRAIN_COMPONENTS, strain_basis
from stga_addon.capture.camera import Camera
from stga_addon.raster.cpu.layout import PRECISION_X, PRECISION_Y, PROJECTED, CameraFrames, Parameters, TileLists
from stga_addon.raster.cpu.project import project_backward as cpu_backward
from stga_addon.raster.cpu.project import project_forward as cpu_forward
from stga_addon.raster.cpu.rasterize import BufferPool, frames_in_camera, new_projection, tile_grid
from stga_addon.raster.cpu.tiles import sum_tiles
from stga_addon.raster.gpu.device import Device
from stga_addon.raster.gpu.frames import Embedding
from stga_addon.raster.gpu.layout import HIDDEN, VIEW, splat_rows, split_rows
from stga_addon.raster.gpu.project import mark_focus, project, project_backward, projected_tables

pytestmark = pytest.mark.needs("adapter")

FRAME_TOLERANCE = 2e-6
"""Of origins in meters and of rotations times scale: float32 at a few meters from the camera."""

SHAPES = {"xyz": (3,), "rotation": (4,), "log_scale": (3,), "opacity": (), "sh": (1, 3), "strain_color": (0, 3)}
"""Of a splat of degree 0 whose color does not follow strain."""


@pytest.fixture(scope="module")
def device() -> Device:
    return gpu_device.device()


@dataclass
class Case:
    """A scene on a few deformed triangles, with colors that follow their strain."""

    splats: Parameters
    face: np.ndarray
    frames: CameraFrames
    camera: Camera
    degree: int
    depth_as_color: bool = False
    antialiased: bool = False

    def view(self) -> np.ndarray:
        """The uniform of all kernels."""
        camera, view = self.camera, np.zeros(1, VIEW)
        for name in ("fl_x", "fl_y", "cx", "cy", "width", "height"):
            view[name] = getattr(camera, name)
        view["tiles_x"], view["tiles_y"] = tile_grid(camera.width, camera.height)
        for row in range(3):
            for column in range(3):
                view[f"to_world_{row}{column}"] = self.frames.to_world[row, column]
        view["splats"] = len(self.face)
        view["coefficients"], view["strain_colors"] = self.splats.sh.shape[1], self.splats.strain_color.shape[1]
        view["degree"], view["frame_strains"] = self.degree, self.frames.strain.shape[1]
        view["strains"] = min(self.splats.strain_color.shape[1], self.frames.strain.shape[1])
        view["depth_as_color"], view["antialiased"] = self.depth_as_color, self.antialiased
        return view

    def upload(self, device: Device) -> dict[str, Any]:
        """The buffers that projection and its backward pass both read."""
        frames = self.frames
        table = np.concatenate([frames.origin, frames.matrix.reshape(-1, 9), frames.strain], axis=1)
        return {
            "view": device.upload("view", self.view(), "uniform"),
            "splats": device.upload("splats", splat_rows(self.splats)),
            "face": device.upload("face", self.face),
            "frames": device.upload("test frames", table),
        }


def case_of(scene: Scene, strains: int = STRAIN_COMPONENTS, **options: Any) -> Case:
    """The scene's splats on nine frames that differ by a few degrees and percent, and in their strain."""
    rng, count = np.random.default_rng(30), len(scene.splats["xyz"])
    world = frames_in_camera(face_frames(np.eye(3), np.arange(3)[None], np.eye(3)), scene.camera)
    turn = np.float32(world.to_world.T)
    matrix = np.stack([turn @ (np.eye(3) + rng.normal(0, 0.05, (3, 3))) for _ in range(9)]).astype(np.float32)
    origin = np.float32(scene.camera.world_to_camera[:3, 3] + rng.normal(0, 0.05, (9, 3)))
    frames = world._replace(origin=origin, matrix=matrix, strain=rng.normal(0, 0.5, (9, strains)).astype(np.float32))
    color = rng.normal(0, 0.2, (count, STRAIN_COMPONENTS, 3)).astype(np.float32)
    splats = Parameters(**{name: array.copy() for name, array in scene.splats.items()}, strain_color=color)
    return Case(splats, rng.integers(0, 9, count).astype(np.int32), frames, scene.camera, scene.degree, **options)


def cpu_projection(case: Case):
    projection = new_projection(len(case.face), BufferPool())
    everywhere = sum_tiles(np.ones(tile_grid(case.camera.width, case.camera.height)[::-1], bool))
    cpu_forward(
        np.arange(len(case.face)), everywhere, case.splats, case.face, case.frames, case.degree, case.depth_as_color,
        case.antialiased, projection,
    )  # fmt: skip
    return projection


def cases() -> dict[str, Case]:
    found = {name: case_of(scene) for name, scene in SCENES.items()}
    for name in ("plain", "smaller than a pixel", "needles", "around the camera", "degree 1"):
        found[f"{name}, antialiased"] = case_of(SCENES[name], antialiased=True)
    found["depth"] = case_of(SCENES["plain"], depth_as_color=True)
    found["no strain"] = case_of(SCENES["plain"], strains=0)
    return found


CASES = cases()


def run_forward(device: Device, case: Case) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """projected (N, PROJECTED), depth keys (N,) and tile bounds (N, 4)."""
    n, buffers = len(case.face), case.upload(device)
    with device.record() as work:
        out = projected_tables(device, n)
        project(work, n, out, **buffers)
    keys, bounds = device.read(out.depth_key, (n,), np.uint32), device.read(out.rect, (n, 4), np.int32)
    return device.read(out.projected, (n, PROJECTED)), keys, bounds


@pytest.mark.parametrize("name", CASES)
def test_projection_is_the_cpus(device: Device, name: str) -> None:
    """Catches any error in embedding, projection, harmonics, strain color, tile bounds or the near plane."""
    case = CASES[name]
    expected = cpu_projection(case)
    projected, keys, bounds = run_forward(device, case)
    # A bound that lies on a tile's edge may fall on either side of it.
    assert (bounds != expected.rect).any(1).mean() < 0.02
    visible = (expected.rect[:, 2] > expected.rect[:, 0]) & (bounds[:, 2] > bounds[:, 0])
    assert visible.any()
    np.testing.assert_array_equal(keys == HIDDEN, bounds[:, 2] <= bounds[:, 0])
    np.testing.assert_allclose(keys[visible].view(np.float32), expected.depth[visible], rtol=1e-6)
    for column in range(PROJECTED):
        got, want = projected[visible, column], expected.columns[visible, column]
        scale = np.abs(want) if column in (PRECISION_X, PRECISION_Y) else np.abs(want).max() + 1e-6
        assert (np.abs(got - want) / scale).max() < 2e-5, f"column {column}"


def sample(count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Rows of pair gradients (P, PROJECTED) and slots (N, 2): a few pairs a splat, none for some."""
    pairs = rng.integers(0, 4, count)
    first = np.concatenate([[0], np.cumsum(pairs)[:-1]])
    rows = rng.normal(size=(pairs.sum(), PROJECTED)) * [0.1, 0.1, 1, 1, 1, 1, 1, 1, 1]
    return rows.astype(np.float32), np.stack([first, pairs], 1).astype(np.int32)


@pytest.mark.parametrize("name", CASES)
def test_gradient_is_the_cpus(device: Device, name: str) -> None:
    """Catches any error in a derivative, a row summed short or twice, and rows written that are not wanted."""
    case, rng = CASES[name], np.random.default_rng(7)
    n, expected = len(case.face), cpu_projection(case)
    rows, slots = sample(n, rng)
    wanted = (expected.rect[:, 2] > expected.rect[:, 0]) & (slots[:, 1] > 0) & (np.arange(n) % 5 > 0)
    if n == 1:
        slots[:], rows, wanted[:] = [0, 1], rng.normal(size=(1, PROJECTED)).astype(np.float32), True
    if name == "needles, antialiased":
        # Where a splat has hardly any area, the derivative by its compensation has hardly any digits.
        rows[:, 5] *= 0.01
    want = Parameters(*(np.full_like(part, 123) for part in case.splats))
    screen = np.empty(n, np.float32)
    visible = np.flatnonzero(wanted).astype(np.int32)
    listed = TileLists(
        visible, slots[:, 0].copy(), slots[:, 1].copy(), np.arange(len(rows), dtype=np.int32), None, None
    )  # fmt: skip
    listed = listed._replace(start=np.zeros(1, np.int64), pair_splat=np.zeros(1, np.int32))
    cpu_backward(
        visible, case.splats, case.face, case.frames, case.degree, case.depth_as_color, case.antialiased,
        expected.columns, listed, rows, want, screen,
    )  # fmt: skip
    table = splat_rows(case.splats)
    gradients = device.upload("test gradients", np.full_like(table, 123))
    with device.record() as work:
        out = project_backward(
            work, n, **case.upload(device), projected=device.upload("test projected", expected.columns),
            wanted=device.upload("test wanted", wanted.astype(np.uint32)), slots=device.upload("test slots", slots),
            pair_gradients=device.upload("test rows", rows), gradients=gradients,
        )  # fmt: skip
    got = split_rows(device.read(gradients, table.shape), case.splats.sh.shape[1])
    assert wanted.any()
    for field, found, right in zip(Parameters._fields, got, want, strict=True):
        assert (found[~wanted] == 123).all(), field
        error = np.abs(found[wanted] - right[wanted]).max() / np.abs(right[wanted]).max(initial=1e-6)
        assert error < GRADIENT_TOLERANCE.get(field, 1e-5), f"{field}: {error:.2e}"
    np.testing.assert_allclose(device.read(out, (n,))[wanted], screen[wanted], rtol=1e-5)


@pytest.mark.parametrize("field", Parameters._fields)
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_broken_splat_is_dropped(device: Device, field: str, value: float) -> None:
    """Catches NaN and infinity that reach the screen, and neighbors that change because of them."""
    case = case_of(SCENES["plain"])
    expected, _, bounds = run_forward(device, case)
    row = int(np.flatnonzero(bounds[:, 2] > bounds[:, 0])[3])
    getattr(case.splats, field)[row, ...].reshape(-1)[0:1] = value
    if field == "opacity":
        case.splats.opacity[row] = value
    cpu = cpu_projection(case)
    projected, keys, found = run_forward(device, case)
    others = np.arange(len(bounds)) != row
    np.testing.assert_array_equal(found[others], bounds[others])
    np.testing.assert_array_equal(projected[others & (keys != HIDDEN)], expected[others & (keys != HIDDEN)])
    if keys[row] != HIDDEN:
        assert np.isfinite(projected[row]).all()
    assert (keys[row] == HIDDEN) == (cpu.rect[row, 2] <= cpu.rect[row, 0])


def test_focus_is_the_selected_triangles_splats(device: Device) -> None:
    """Catches a triangle's byte read from the wrong place of its word."""
    case = case_of(SCENES["plain"])
    selected = np.random.default_rng(2).random(len(case.frames.origin)) < 0.5
    buffers = case.upload(device)
    with device.record() as work:
        focus = mark_focus(
            work, len(case.face), view=buffers["view"], face=buffers["face"],
            selected=device.upload("selected", selected.astype(np.uint8)),
        )  # fmt: skip
    np.testing.assert_array_equal(device.read(focus, case.face.shape, np.uint32), selected[case.face])


@pytest.mark.parametrize("mesh", ["ball", "collapsed", "lines in the neutral mesh", "far away"])
@pytest.mark.parametrize("convention", CONVENTIONS)
def test_frames_and_strain_are_numpys(device: Device, convention: str, mesh: str) -> None:
    """Catches another rule for a triangle without area, an axis that differs, and edges that lose digits in float32."""
    posed, neutral, faces = bent_ball() if mesh in ("ball", "far away") else collapsed()
    camera = SCENES["plain"].camera
    camera = Camera(camera.width, camera.height, 50, 50, 25, 20, camera.world_to_camera.copy())
    if mesh == "lines in the neutral mesh":
        posed, neutral = neutral, posed
    if mesh == "far away":
        shift = np.array([1e4, -1e4, 1e4])
        posed, camera.world_to_camera[:3, 3] = posed + shift, -camera.world_to_camera[:3, :3] @ shift
    ends = np.random.default_rng(8).uniform(0, 1.5, (2, len(faces), STRAIN_COMPONENTS)) * [[[-1]], [[1]]]
    basis = strain_basis(neutral, faces, np.float32(ends.swapaxes(0, 1)) if mesh == "ball" else None)
    expected = frames_in_camera(face_frames(posed, faces, neutral, convention, basis), camera)
    step = Embedding(device, neutral, faces, convention, basis)
    step.upload(posed, camera)
    with device.record() as work:
        table = step.compose(work, {})
    frames = device.read(table, (len(faces), 12 + STRAIN_COMPONENTS))
    np.testing.assert_allclose(frames[:, :3], expected.origin, atol=FRAME_TOLERANCE)
    # The area of what is a line in float32, whose root is the scale, has hardly any digits.
    tolerance = 1e-5 if mesh == "collapsed" else FRAME_TOLERANCE
    np.testing.assert_allclose(frames[:, 3:12].reshape(-1, 3, 3), expected.matrix, atol=tolerance)
    assert expected.strain.any()
    if mesh == "lines in the neutral mesh":
        # A strain per area that is hardly there; float64 has few digits of it, too.
        assert (np.abs(frames[:, 12:]) <= MAX_STRAIN).all()
    else:
        np.testing.assert_allclose(frames[:, 12:], expected.strain, atol=5e-6)


def test_without_strain_there_is_none(device: Device) -> None:
    """Catches columns of strain where nobody asked for them, and triangles that lie elsewhere then."""
    posed, neutral, faces = bent_ball()
    camera = SCENES["plain"].camera
    step = Embedding(device, neutral, faces, "stga")
    step.upload(posed, camera)
    with device.record() as work:
        table = step.compose(work, {})
    expected = frames_in_camera(face_frames(posed, faces, neutral), camera)
    frames = device.read(table, (len(faces), 12))
    np.testing.assert_allclose(frames[:, :3], expected.origin, atol=FRAME_TOLERANCE)
    np.testing.assert_allclose(frames[:, 3:].reshape(-1, 3, 3), expected.matrix, atol=FRAME_TOLERANCE)


@pytest.mark.parametrize("convention", CONVENTIONS)
def test_frames_moved_by_strain_are_the_avatars(device: Device, convention: str) -> None:
    """Catches strain that is not averaged, or over other triangles (an open border, three triangles on one edge), rest
    that is not subtracted, a shift in other axes or units, and frames that stay moved."""
    posed, neutral, faces = bent_ball()
    faces = np.concatenate([faces[10:], [[*faces[40][:2], faces[30][2]]]])
    rng = np.random.default_rng(9)
    range_of_strain = COLOR_RANGE * rng.uniform(0.5, 1, (len(faces), 1, STRAIN_COMPONENTS)).astype(np.float32)
    unit = face_frames(neutral, faces, neutral, convention).scale.mean()
    coefficients = rng.normal(0, 0.01 / unit, (len(faces), STRAIN_COMPONENTS, 3)).astype(np.float32)
    bare = {name: np.zeros((0, *shape), np.float32) for name, shape in SHAPES.items()}
    splats = Splats(**bare, face=np.zeros(0, np.int32), unbound=np.zeros(0, bool))
    avatar = Avatar(
        splats,
        convention,
        neutral,
        faces,
        strain_range=range_of_strain,
        driven_offsets={"strain_position": coefficients},
    )
    camera = SCENES["plain"].camera
    basis = strain_basis(neutral, faces, range_of_strain)
    still = frames_in_camera(face_frames(posed, faces, neutral, convention, basis), camera)
    expected = frames_in_camera(avatar.frames(posed), camera)
    assert (np.abs(expected.origin - still.origin).max(axis=1) > 100 * FRAME_TOLERANCE).mean() > 0.9
    step = Embedding(device, neutral, faces, convention, basis, ["strain_position"])
    step.upload(posed, camera)
    for moved, want in ((coefficients, expected), (None, still)):
        uploaded = {} if moved is None else {"strain_position": device.upload("test coefficients", moved)}
        with device.record() as work:
            table = step.compose(work, uploaded)
        frames = device.read(table, (len(faces), 12 + STRAIN_COMPONENTS))
        np.testing.assert_allclose(frames[:, :3], want.origin, atol=FRAME_TOLERANCE)
        np.testing.assert_allclose(frames[:, 3:12].reshape(-1, 3, 3), want.matrix, atol=FRAME_TOLERANCE)
        np.testing.assert_allclose(frames[:, 12:], want.strain, atol=5e-6)
