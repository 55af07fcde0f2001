"""Dense tracking against a generated take whose meshes are known, with landmarks that fail where a
detector's do."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pytest
from flame.small_head import EXPRESSIONS, small_head, small_head_colors, subdivided
from numpy.random import default_rng
from numpy.testing import assert_allclose

from stga_addon.capture.camera import look_at
from stga_addon.flame.forward import FlameFrame, flame_forward
from stga_addon.tracking import dense
from stga_addon.tracking.appearance import (
    Sample,
    average_texture,
    light_basis,
    projection_derivative,
)
from stga_addon.tracking.correspondence import shaded_image
from stga_addon.tracking.dense import fit_dense
from stga_addon.tracking.dense_head import REGIONS, in_single_precision
from stga_addon.tracking.fit import RecordedTake, fit_head
from stga_addon.tracking.fitted_head import by_images
from stga_addon.tracking.head_model import HeadModel
from stga_addon.tracking.posed_points import PosedPoints
from stga_addon.tracking.solve import (
    Observation,
    acceleration_precision,
    normal_equations,
    person,
    smoothed,
    solve_take,
)
from stga_addon.tracking.stages import Workers
from stga_addon.worker.helpers import Helpers

from .test_fit import in_cameras_world, places_on, seen, shown
from .test_surface import no_image

JAW = 2
OPENINGS = 0.0, 0.0, 0.1, 0.25, 0.4, 0.45, 0.3, 0.05  # Radians of the jaw at each timestep
BROWS_UP = EXPRESSIONS.index("brows_up")
BROWS_DOWN = EXPRESSIONS.index("brows_down")
DETECTOR_PULL = 1 / 3  # Share of the jaw's motion that landmarks do not follow


@dataclass(frozen=True)
class Scene:
    """A take: head model, meshes that are true, cameras, and what is recorded of them."""

    head: HeadModel
    meshes: list
    take: RecordedTake


def frame_at(opening, timestep):
    expr = np.zeros(10)
    zero = np.zeros(3)
    expr[timestep % 3] = 0.3
    turn = np.array([0.03 * np.sin(timestep), 0.15 * np.sin(0.8 * timestep), 0.0])
    jaw = np.array([opening, 0, 0])
    moved = np.array([0.004, 0, 0]) * timestep
    return FlameFrame(expr, turn, zero, jaw, moved, np.zeros(6))


def skin_texture(rest):
    """(V, 1) factor of skin's colors: waves of 6 to 30 mm, since the small head's painted chin is
    of one color."""
    rng = default_rng(3)
    factor = 1
    for length, amount in [(0.006, 0.02), (0.010, 0.03), (0.018, 0.03), (0.03, 0.03)] * 4:
        phase = 2 * np.pi * rest @ (rng.normal(size=3) / 1.7) / length
        factor = factor + amount * np.sin(phase + rng.uniform(0, 6))
    return factor[:, None]


def scene(eyes, openings=OPENINGS, pull=DETECTOR_PULL, size=(230, 300), brows=0.0):
    """brows: by which they are raised at timesteps 3 and 6, or lowered where it is negative."""
    tracked = small_head(0)
    pictured, tint = subdivided(tracked, small_head_colors())
    head = HeadModel(tracked, "flame")
    rng = default_rng(4)
    shape = rng.normal(0, 0.5, tracked.n_identity)
    frames = [frame_at(opening, t) for t, opening in enumerate(openings)]
    for t in (3, 6) if brows else ():
        frames[t].expr[BROWS_UP if brows > 0 else BROWS_DOWN] = abs(brows)
    colors = np.clip(tint ** (1 / 1.8) * skin_texture(pictured.v_template), 0, 1)
    cameras = [
        look_at((1.1 * np.sin(a), 0.05, 1.1 * np.cos(a)), (0, -0.02, 0), *size, 3.7 * size[0])
        for a in eyes
    ]
    meshes = []
    landmarks = {}
    pictures = {}
    places = places_on(head, 300)
    wrong = rng.normal(0, 0.001, (300, 3))
    for t, frame in enumerate(frames):
        mesh = flame_forward(tracked, shape, frame)
        closed = flame_forward(tracked, shape, replace(frame, jaw_pose=np.zeros(3)))
        points = places.on(mesh - pull * (mesh - closed), tracked.faces) + wrong
        fine = flame_forward(pictured, shape, frame)
        meshes.append(mesh)
        landmarks[t] = seen(cameras, points, noise=0.4, seed=t)
        pictures[t] = [(c, shaded_image(fine, pictured.faces, c, colors)) for c in cameras]
    used = np.ones(300, bool)
    images = partial(shown, pictures)
    return Scene(head, meshes, RecordedTake(places, used, landmarks, images, metric=True))


def jaw_errors(take, fit):
    """Mean distance in mm of the jaw's and lower lip's vertices from the true ones, by timestep."""
    model = take.head.model
    return errors_of((model.weights[:, JAW] > 0.5) & (model.v_template[:, 2] > 0.03), take, fit)


def brow_errors(take, fit):
    """The same of the vertices that raised brows move most."""
    moved = np.abs(take.head.model.shapedirs[:, 1, take.head.model.n_identity + BROWS_UP])
    return errors_of(moved > 0.5 * moved.max(), take, fit)


def errors_of(moved, take, fit):
    missed = [in_cameras_world(fit, t)[moved] - true[moved] for t, true in enumerate(take.meshes)]
    return 1000 * np.linalg.norm(missed, axis=2).mean(axis=1)


def test_texture_is_free_of_lighting_and_distrusts_what_changes():
    """Catches shading baked into the texture, which a jaw that turns would be compared with, and
    hands and hair that count like skin."""
    rng = default_rng(0)
    normals = rng.normal(size=(400, 3)) * [1, 1, 0.5] + [0, 0, 1]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    skin = np.array([120, 0, 30]) + rng.normal(0, [12, 8, 5], (400, 3))
    found = []
    for view in range(12):
        light = np.array([1.0, 0.3 * (-1) ** view, 0.05 * view, 0.2, 0, 0, 0, 0, 0])
        values = skin * (light_basis(normals) @ light)[:, None]
        values[:20] = rng.uniform(0, 255, (20, 3))  # hair
        values[20 + 20 * view : 40 + 20 * view] = 10  # a hand that moves
        camera = b"ab"[view % 2 : view % 2 + 1]
        found.append(Sample(camera, [values], light_basis(normals), np.ones(400)))
    texture = average_texture(found)
    own = texture.values[b"a"][0]
    scale = np.median(own[20:, 0] / skin[20:, 0])
    assert np.median(np.abs(own[20:] / scale - skin[20:])) < 1.0
    assert texture.trust[:20].max() < 0.3
    assert np.median(texture.trust[20:]) > 0.8


def test_projection_derivative_agrees_with_differences():
    """Catches a sign or a focal length that sends Gauss-Newton the wrong way."""
    camera = look_at((0.3, 0.2, 1.1), (0, 0, 0), 200, 150, 500)
    points = default_rng(0).normal(0, 0.05, (7, 3))
    found = projection_derivative(camera, points)
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        difference = (camera.project(points + step)[0] - camera.project(points - step)[0]) / 2e-6
        assert_allclose(found[:, :, axis], difference, rtol=1e-5, atol=1e-5)


def test_smoothing_stays_at_the_solution_of_its_own_terms(head):
    """Catches terms that are changed while they are used, or a right-hand side of the wrong
    sign."""
    one = person(head, np.zeros(head.model.n_identity))
    places = places_on(head, 60)
    root = np.tile(np.eye(3), (60, 1, 1))
    observed = []
    for t in range(4):
        mesh = flame_forward(head.model, np.zeros(10), frame_at(0.1, t))
        observed.append(Observation(places.on(mesh, head.model.faces), root, np.ones(60)))
    start = np.zeros((4, one.model.n_expression + 18))
    solved = solve_take(one, places, observed, start, ordered=True)
    points = PosedPoints(one.model, places)
    terms = [normal_equations(points, row, own) for row, own in zip(solved, observed, strict=True)]
    information, right = map(np.stack, zip(*terms, strict=True))
    stiffness = acceleration_precision(one.model)
    found = smoothed(solved, information, stiffness, right, one)
    assert_allclose(found, solved, atol=5e-3)


def test_a_short_take_is_left_to_landmarks_and_surface():
    """Catches a texture averaged over the very frames that it judges."""
    take = RecordedTake(None, None, dict.fromkeys(range(5)), no_image)
    assert fit_dense(None, take, Workers(Helpers(1))) is None


@pytest.mark.nightly
def test_a_jaw_that_landmarks_leave_too_little_open_is_opened():
    """Catches tracking that follows landmarks where they fail: they leave the jaw open by two
    thirds. Three cameras 60 degrees apart, and a surface whose poses are worse."""
    take = scene(np.radians([-60, 0, 60]))
    first = fit_head(take.head, take.take)
    found, misfit = by_images(take.head, first, take.take, Workers(Helpers(1)))
    wide = np.argsort(OPENINGS)[-3:]
    before = jaw_errors(take, first)
    after = jaw_errors(take, found)
    assert before[wide].min() > 8
    assert after[wide].mean() < 1.2
    assert (after < before + 0.4).all()
    assert set(misfit) == set(REGIONS)
    assert found.static_offset is not None


@pytest.mark.slow
def test_a_timestep_is_moved_as_those_beside_it_unless_it_looks_otherwise(monkeypatch):
    """Catches every timestep solved in full, where neighbors tell half of them; and a mouth that
    stays closed because it is closed before and after."""
    solve = dense._Solver.solve
    solved = []

    def counted(*arguments):
        solved.append(arguments)
        return solve(*arguments)

    monkeypatch.setattr(dense._Solver, "solve", counted)
    eyes = np.radians([-50, 0, 50])
    errors = []
    for openings in (np.linspace(0, 0.3, 7), [0, 0.4, 0, 0.4, 0, 0.4, 0]):
        take = scene(eyes, openings, size=(150, 195))
        first = fit_head(take.head, take.take)
        solved.clear()
        found = fit_dense(first, take.take, Workers(Helpers(1)))
        errors.append((len(solved), jaw_errors(take, first), jaw_errors(take, found.fit)))
    (count, before, after), (every, shut, opened) = errors
    assert count == 4
    assert before.max() > 6
    assert after.max() < 2
    assert every == 7
    assert shut[1::2].min() > 8
    assert opened.max() < 2


@pytest.mark.slow
def test_a_settled_timestep_is_moved_as_little_with_its_neighbors_as_alone(monkeypatch):
    """Catches a surface that several cameras see given up where images hardly say more."""
    kept = []

    def noted(*arguments):
        kept.append(carried(*arguments) is None)

    carried = dense._Solver.carried
    monkeypatch.setattr(dense._Solver, "carried", noted)
    monkeypatch.setattr(dense, "SETTLED_GAIN", 1.0)
    take = scene(np.radians([-50, 0, 50]), np.linspace(0, 0.3, 7), size=(115, 150))
    fit_dense(fit_head(take.head, take.take), take.take, Workers(Helpers(1)), settled=True)
    assert kept == [True] * 3


@pytest.mark.slow
def test_result_depends_on_neither_processes_nor_interruptions(tmp_path, monkeypatch):
    """Catches parts in another order, what one leaves behind, and a take that begins anew."""
    monkeypatch.setattr(dense, "PART_TIMESTEPS", 3)
    monkeypatch.setattr(dense, "TEXTURE_PART_TIMESTEPS", 3)
    take = scene(np.radians([-40, 40]), openings=OPENINGS[:6], size=(115, 150))
    first = fit_head(take.head, take.take)
    alone = fit_dense(first, take.take, Workers(Helpers(1)))

    def interrupt(stage, done, total):
        if done == total - 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        fit_dense(first, take.take, Workers(Helpers(1, tmp_path), interrupt))
    assert len(list(tmp_path.iterdir())) == 1
    with Helpers(2, tmp_path) as helpers:
        together = fit_dense(first, take.take, Workers(helpers))
    assert len(list(tmp_path.iterdir())) == 2
    for t in alone.fit.parameters:
        one, other = (
            [own.fit.parameters[t], own.landmarks[t].points, own.misfit[t]]
            for own in (alone, together)
        )
        assert all(map(np.array_equal, one, other))


@pytest.mark.slow
def test_raised_brows_are_not_lowered_by_images_that_prove_little():
    """Catches images that overrule landmarks though they look hardly more like another pose."""
    eyes = np.radians([-50, 0, 50])
    still = [0.0] * 8
    take, lowered = (scene(eyes, still, brows=brows) for brows in (1.5, -1.5))

    mixed = []
    for t in range(8):
        pairs = zip(take.take.images(t), lowered.take.images(t), strict=True)
        mixed.append([(c, (0.4 * up + 0.6 * low).astype(np.uint8)) for (c, up), (_, low) in pairs])
    images = partial(shown, mixed)
    first = fit_head(take.head, take.take)
    found = fit_dense(first, replace(take.take, images=images), Workers(Helpers(1)))
    assert brow_errors(take, first).max() < 1
    assert brow_errors(take, found.fit).max() < 3


def test_a_surface_that_is_not_found_is_not_refined(monkeypatch):
    """Catches a second round of dense tracking for a single camera, which moves nothing and takes
    as long as the first."""
    fit = object()
    rounds = []

    def fit_once(fit, take, workers, settled=False):
        rounds.append(settled)
        return dense.DenseFit(fit, {}, {0: np.arange(len(REGIONS))})

    monkeypatch.setattr("stga_addon.tracking.fitted_head.fit_dense", fit_once)
    monkeypatch.setattr(
        "stga_addon.tracking.fitted_head.fit_surface", lambda _, fit, *__, **___: fit
    )
    take = RecordedTake(None, None, {}, no_image)
    found, misfit = by_images(None, fit, take, Workers(Helpers(1)))
    assert found is fit
    assert rounds == [False]
    assert misfit == {name: {0: row} for row, name in enumerate(REGIONS)}


def test_single_precision_is_enough_for_points(head):
    """Catches derivatives that lose a joint, or their digits, where arrays are of single
    precision: correctives of the pose are added in it too."""
    rng = default_rng(3)
    one = person(head, np.zeros(head.model.n_identity)).model
    bent = replace(one, posedirs=rng.normal(0, 1e-3, (*one.v_template.shape, 36)))
    values = rng.normal(0, 0.3, one.n_expression), rng.normal(0, 0.3, 18)
    exact = PosedPoints(bent, places_on(head, 60)).linearized(*values)
    single = PosedPoints(in_single_precision(bent), places_on(head, 60)).linearized(*values)
    for found, expected in zip(single, exact, strict=True):
        assert found.dtype == np.float32
        assert_allclose(found, expected, atol=2e-6)
