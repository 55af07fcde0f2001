"""The fit against heads whose parameters, cameras and landmarks are known."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from flame.conftest import random_arrays, random_frame
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from stga_addon.capture.camera import look_at
from stga_addon.flame.forward import RIGID_SIZE, FlameFrame, by_change, flame_forward, frame_of
from stga_addon.flame.model import FlameModel
from stga_addon.flame.parts import flame_model
from stga_addon.tracking import fit as head_fit
from stga_addon.tracking.correspondence import nearest_points
from stga_addon.tracking.fit import (
    HeadFit,
    RecordedTake,
    Similarity,
    TimestepLandmarks,
    fit_head,
    observed_landmarks,
    posed_mesh,
    rigid_start,
    triangulate,
    triangulated,
)
from stga_addon.tracking.fitted_head import interpolated
from stga_addon.tracking.head_model import HeadModel, read_head_model
from stga_addon.tracking.landmarks import read_places
from stga_addon.tracking.posed_points import PosedPoints, SurfacePoints, split
from stga_addon.tracking.recorded import BUNDLED_PLACES
from stga_addon.tracking.solve import (
    LID_SHAPES,
    WEIGHT_EXCESS_SIGMA,
    Observation,
    acceleration_precision,
    in_order,
    parameter_precision,
    person,
    prior_terms,
    smoothed,
    solve_take,
)

HERE = Similarity(1.0, np.eye(3), np.zeros(3))


def places_on(head, count, seed=0):
    """Places all over the front of the skin."""
    rng = default_rng(seed)
    centers = head.model.v_template[head.model.faces].mean(1)
    front = np.flatnonzero(centers[:, 2] > 0.04)
    return SurfacePoints(rng.choice(front, count), rng.dirichlet([1, 1, 1], count))


def frame_at(head, timestep):
    """A take in which the head turns, smiles and opens its mouth."""
    expr = np.zeros(head.model.n_expression)
    expr[timestep % 3] = 0.5 + 0.4 * np.sin(timestep / 4)
    turn = 0.25 * np.sin(timestep / 5)
    jaw = np.array([0.1 + 0.1 * np.cos(timestep / 6), 0, 0])
    zero = np.zeros(3)
    return FlameFrame(
        expr, np.array([0.05, turn, 0.02]), zero, jaw, np.array([0.01, turn / 50, 0.0]), np.zeros(6)
    )


def cameras(count):
    angles = np.linspace(-0.8, 0.8, count) if count > 1 else [0.1]
    eyes = [(np.sin(a), 0.1 * (-1) ** k, np.cos(a)) for k, a in enumerate(angles)]
    return [look_at(eye, (0, 0, 0), 800, 800, 2000) for eye in eyes]


def seen(rig, points, noise=0.0, seed=0):
    """Landmarks of points (N, 3) in every camera."""
    rng = default_rng(seed)
    pixels = np.stack([camera.project(points)[0] for camera in rig])
    return TimestepLandmarks(
        tuple(rig), pixels + rng.normal(0, noise, pixels.shape), np.ones(pixels.shape[:2])
    )


def shown(pictures, timestep, most=None):
    """The pictures of a timestep; a helping process can be handed this."""
    return pictures[timestep]


def recorded(head, rig, meshes, places, noise=0.0, wrong=0.0, **more):
    """The take of meshes' landmarks, each `wrong` (N, 3) meters off."""
    at = [places.on(mesh, head.model.faces) + wrong for mesh in meshes]
    found = {t: seen(rig, points, noise, t) for t, points in enumerate(at)}
    return RecordedTake(places, np.ones(len(places), bool), found, **more)


def test_points_agree_with_the_forward_pass_and_their_derivatives_with_differences():
    """Catches a joint, corrective or shape that moves landmarks otherwise than FLAME."""
    arrays = random_arrays()
    skeleton = arrays["J_regressor"], np.array([-1, 0, 1, 1, 1]), arrays["weights"]
    shapes = arrays["v_template"], arrays["shapedirs"], 9, arrays["posedirs"]
    model = FlameModel(*shapes, *skeleton, arrays["f"].astype(np.int32))
    frame = random_frame(3, model.n_expression)
    rng = default_rng(1)
    shape = rng.normal(size=model.n_identity)
    places = SurfacePoints(np.arange(50), rng.dirichlet([1, 1, 1], 50))
    points = PosedPoints(model, places)
    values = np.concatenate([shape, frame.parameters])
    positions, jacobian = points.linearized(*split(values))
    expected = places.on(flame_forward(model, shape, frame), model.faces)
    assert_allclose(positions, expected, atol=1e-12)
    for column, step in enumerate(1e-5 * np.eye(len(values))):
        sides = [points.positions(*split(values + s)) for s in (step, -step)]
        assert_allclose(jacobian[..., column], (sides[0] - sides[1]) / 2e-5, atol=5e-6)


def in_cameras_world(fit, timestep):
    """(V, 3) of the fitted head in the world of the cameras."""
    world = fit.to_capture
    mesh = posed_mesh(fit, fit.parameters[timestep])
    return (mesh - world.translation) @ world.rotation / world.scale


def pixel_errors(head, fit, timestep, camera, pixels):
    """Pixels by which the fitted face misses where another camera shows it."""
    found, _ = fit.to_capture.camera(camera).project(posed_mesh(fit, fit.parameters[timestep]))
    return norm(found - pixels, axis=1)[head.model.masks["face"]]


def test_triangulation_outvotes_a_wrong_camera():
    """Catches a plain mean of rays, which one misdetected face pulls centimeters away, and a
    principal point or an axis with the wrong sign."""
    rig = [replace(camera, cx=300.0, cy=450.0, fl_y=1800.0) for camera in cameras(6)]
    points = default_rng(0).normal(0, 0.05, (20, 3))
    landmarks = seen(rig, points)
    landmarks.points[2] += 60
    found = triangulate(rig, landmarks.points, landmarks.confidence)
    assert np.abs(found.position - points).max() < 2e-4
    landmarks.confidence[:, 4] = 0
    assert not triangulate(rig, landmarks.points, landmarks.confidence).observed[4]


def test_a_take_is_found_in_a_world_of_any_scale_and_orientation(head):
    """Catches an error in scale, orientation, identity or expression: vertices would be millimeters
    off."""
    shape = default_rng(5).normal(0, 0.7, head.model.n_identity)
    turn = Rotation.from_euler("xz", [90, 63], degrees=True).as_matrix()
    world = Similarity(0.23, turn, np.array([3.0, -1.0, 2.0]))
    places = places_on(head, 100)
    foreign = [world.camera(camera) for camera in cameras(5)]
    meshes = [flame_forward(head.model, shape, frame_at(head, t)) for t in range(12)]
    take = recorded(head, foreign, [world.apply(mesh) for mesh in meshes], places, noise=0.3)
    one = take.landmarks[7]
    take.landmarks[7] = TimestepLandmarks(one.cameras[:1], one.points[:1], one.confidence[:1])
    fit = fit_head(head, take)
    assert fit.to_capture.scale == pytest.approx(1 / world.scale, rel=0.03)
    for timestep in (0, 7, 11):
        missed = in_cameras_world(fit, timestep) - world.apply(meshes[timestep])
        error = norm(missed, axis=1)[head.model.masks["face"]] / world.scale
        assert error.mean() < (2e-3 if timestep == 7 else 0.8e-3)


def amounts_and_observations(head, amounts, noise):
    """A person without identity, and what is known of 100 landmarks at each timestep of one moving
    expression."""
    one = person(head, np.zeros(head.model.n_identity))
    places = places_on(head, 100)
    rng = default_rng(3)
    observed = []
    for amount in amounts:
        frame = replace(frame_at(head, 0), expr=amount * np.eye(head.model.n_expression)[0])
        mesh = flame_forward(head.model, np.zeros(head.model.n_identity), frame)
        points = places.on(mesh, head.model.faces) + rng.normal(0, noise, (100, 3))
        observed.append(Observation(points, np.tile(np.eye(3), (100, 1, 1)), np.ones(100)))
    return one, places, observed


def test_a_blink_of_one_timestep_is_followed():
    """Catches lids that are smoothed like a mouth, and stay open in blinks of a video."""
    model = flame_model(None)
    one = person(HeadModel(model, "flame"), np.zeros(model.n_identity))
    lid = np.flatnonzero(np.isin(model.faces, model.masks["left_eye_region"]).all(1))
    faces = np.concatenate([lid[::20], np.arange(0, len(model.faces), 400)])
    places = SurfacePoints(faces, np.full((len(faces), 3), 1 / 3))
    truth = np.zeros((7, model.n_expression + RIGID_SIZE))
    blink = model.expression_names.index("eyeBlinkLeft")
    truth[3, blink] = 1
    posed = PosedPoints(one.model, places)
    root = np.tile(np.eye(3), (len(faces), 1, 1))
    weight = np.ones(len(root))
    observed = [Observation(posed.positions(*split(own)), root, weight) for own in truth]
    solved = solve_take(one, places, observed, np.zeros_like(truth), ordered=True)[:, blink]
    assert solved[3] > 0.8
    assert max(solved[2], solved[4]) < 0.1


def test_expressions_are_smoothed_in_order_alone(head):
    """Catches brows that are raised at every third timestep and tracked at rest: beside surface
    points, landmarks count little, and less than smoothness over timesteps that do not follow each
    other; and noise of landmarks that is taken for expressions in no order: a take would
    tremble."""
    amounts = np.array([0, 0.5, 0, 0, 0.4, 0, 0.5, 0, 0, 0.5, 0, 0.4])
    one, places, observed = amounts_and_observations(head, amounts, 0.0003)
    start = np.zeros((24, one.model.n_expression + RIGID_SIZE))
    alone = solve_take(one, places, observed, start[:12], ordered=False)
    ordered = in_order(one, places, observed, alone)
    assert not ordered
    weak = [replace(own, weight=0.05 * own.weight) for own in observed]
    found = solve_take(one, places, weak, start[:12], ordered)[:, 0]
    assert np.polyfit(amounts, found, 1)[0] > 0.7
    amounts = 0.5 * np.sin(np.arange(24) / 4)
    one, places, observed = amounts_and_observations(head, amounts, 0.002)
    alone = solve_take(one, places, observed, start, ordered=False)
    assert in_order(one, places, observed, alone)
    smooth = solve_take(one, places, observed, alone, ordered=True)
    error, unsmoothed = (np.abs(values[:, 0] - amounts).mean() for values in (smooth, alone))
    assert error < 0.7 * unsmoothed


def test_one_camera_keeps_the_size_of_the_head(head):
    """Catches a world that is scaled up without end: the smaller the head, the nearer it passes to
    rays that no head meets all of, as those of a real person's landmarks."""
    places = places_on(head, 100)
    rig = cameras(1)
    # a face that the model has not
    wrong = places.on(head.model.v_template, head.model.faces) * [1.25, 0.8, 1.0]
    take = {t: seen(rig, wrong, noise=4.0, seed=t) for t in range(8)}
    fit = fit_head(head, RecordedTake(places, np.ones(100, bool), take))
    assert fit.to_capture.scale == pytest.approx(1, abs=0.1)
    for timestep, own in take.items():
        at = places.on(posed_mesh(fit, fit.parameters[timestep]), head.model.faces)
        away = fit.to_capture.camera(rig[0]).project(at)[0] - own.points[0]
        assert np.median(norm(away, axis=1)) < 12  # of a face of 300 pixels


@pytest.mark.parametrize("focal", [900.0, 2000.0, 3500.0, 5500.0])
def test_one_camera_keeps_the_distance_between_the_eyes(focal):
    """Catches an identity that makes the head smaller, so that it passes nearer to the rays of
    landmarks that a detector misses by 1.5 mm in all timesteps alike: a real man's eyes were 38 mm
    apart."""
    model = flame_model(None)
    places, reliable = read_places(BUNDLED_PLACES, len(model.faces))
    head = read_head_model(None)
    rng = default_rng(5)
    wrong = rng.normal(0, 0.0015, (len(places), 3))
    camera = look_at((0, 0, focal * 0.2 / 700), (0, 0, 0), 1080, 1920, focal)
    take = {}
    for timestep in range(6):
        turn = np.array([0.1 * np.sin(timestep), 0.3 * np.cos(timestep), 0])
        parameters = np.zeros(model.n_expression + RIGID_SIZE)
        parameters[model.n_expression :][:3] = turn
        mesh = flame_forward(model, np.zeros(model.n_identity), frame_of(parameters))
        at = places.on(mesh, model.faces) + wrong @ Rotation.from_rotvec(turn).as_matrix().T
        take[timestep] = seen([camera], at)
    fit = fit_head(head, RecordedTake(places, reliable, take))

    def between_eyes(vertices):
        left, right = (vertices[model.weights[:, joint] > 0.9].mean(0) for joint in (3, 4))
        return norm(left - right)

    expected = between_eyes(model.v_template)
    assert between_eyes(fit.head.model.v_template) == pytest.approx(expected, rel=0.04)
    assert np.abs(fit.shape).max() < 3


@pytest.mark.parametrize("count", [1, 3])
def test_landmarks_of_no_weight_stay_unknown(head, count):
    """Catches 0 / 0 and NaN from landmarks that no camera sees, in a world whose origin is a
    camera; and, where no second camera helps, a drift in depth or a flipped turn.

    Whether NumPy raises an error for eigenvalues of NaN depends on the processor.
    """
    places = places_on(head, 100)
    rig = cameras(count)
    shape = np.zeros(head.model.n_identity)
    meshes = [flame_forward(head.model, shape, frame_at(head, t)) for t in range(3)]
    take = recorded(head, rig, meshes, places).landmarks
    first = np.linalg.inv(rig[0].world_to_camera)
    own = tuple(replace(camera, world_to_camera=camera.world_to_camera @ first) for camera in rig)
    own = (replace(own[0], world_to_camera=np.eye(4)), *own[1:])
    take = {t: replace(landmarks, cameras=own) for t, landmarks in take.items()}
    for timestep, landmarks in take.items():
        landmarks.confidence[:, timestep::7] = 0
        landmarks.points[:, timestep::7] = 0
    reliable = np.arange(100) % 9 != 4
    neutral = places.on(head.model.v_template, head.model.faces)
    with np.errstate(all="raise"):
        found = triangulated(take[0], reliable, neutral, 1.0)
        fit = fit_head(head, RecordedTake(places, reliable, take))
    for values in (found.position, found.information, found.residual, *fit.parameters.values()):
        assert np.isfinite(values).all()
    assert not found.observed[::7].any()
    for timestep, mesh in enumerate(meshes):
        errors = pixel_errors(head, fit, timestep, own[0], rig[0].project(mesh)[0])
        assert np.median(errors) < 2  # of a face of 300 pixels


def test_rays_that_all_miss_give_a_start(head):
    """Catches weights that vanish, and the mean of no points, where no two cameras agree about any
    landmark."""
    rig = cameras(3)
    rng = default_rng(0)
    points = rng.normal(0, 0.05, (30, 3))
    landmarks = seen(rig, points, noise=100.0)
    found = triangulate(rig, landmarks.points, landmarks.confidence)
    world = Similarity(100.0, np.eye(3), np.zeros(3))
    with np.errstate(all="raise"):
        observed = observed_landmarks(found, world, np.ones(30, bool))
        start = rigid_start(points, observed)
    assert (observed.weight > 0).all()
    assert_allclose(start[-3:], (observed.position - points).mean(0), atol=3)
    assert norm(start[:3]) <= np.pi + 1e-9


def test_timesteps_without_a_face_are_interpolated():
    """Catches gaps that keep the last pose, or extrapolate beyond the ends."""
    low = np.zeros(20)
    high = np.ones(20)
    found = interpolated({2: low, 6: high}, (1, 2, 3, 6, 7))
    assert_allclose([found[t][0] for t in (1, 2, 3, 6, 7)], [0, 0, 0.25, 1, 1])


# y of the world points down; the head faces -z; both are half a turn, but for the head's own
WORLDS = {"y down": [180, 0, 0], "facing -z": [0, 180, 0], "both": [0, 0, 180]}


def moved(head, parameters, degrees):
    """Parameters of the same heads in a world turned by Euler angles."""
    turn = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
    heads = replace(head, model=person_model(head))
    shape = np.zeros(0)
    rows = dict(enumerate(parameters))
    fit = HeadFit(heads, shape, rows, Similarity(1.0, turn.T, np.zeros(3)))
    return np.stack([*head_fit.in_cameras_world(fit).parameters.values()]), turn


def person_model(head):
    return person(head, np.zeros(head.model.n_identity)).model


def meshes_of(head, parameters):
    model = person_model(head)
    return np.stack([flame_forward(model, np.zeros(0), frame_of(own)) for own in parameters])


@pytest.mark.parametrize("world", WORLDS)
def test_the_world_says_nothing_of_smoothness(head, world):
    """Catches a head near half a turn that trembles: where its axis-angle changes its sign, it was
    taken for a cut, and not smoothed."""
    rows = np.stack([frame_at(head, 0).parameters] * 40)
    rng = default_rng(0)
    rows[:, -18:-15] = rng.normal(0, 0.02, (40, 3))
    precision = np.full(rows.shape[1], 1e8)
    precision[-18:-15] = 300.0

    def smooth(values):
        turns = [np.linalg.inv(by_change(own)) for own in values]  # terms are of rotations
        terms = np.stack([turn.T @ np.diag(precision) @ turn for turn in turns])
        found = smoothed(values, terms, acceleration_precision(person_model(head)))
        meshes = meshes_of(head, found)
        return norm(meshes - meshes.mean(0), axis=2).mean()

    turned, _ = moved(head, rows, WORLDS[world])
    meshes = meshes_of(head, rows)
    raw = norm(meshes - meshes.mean(0), axis=2).mean()
    assert smooth(rows) < 0.5 * raw
    assert smooth(turned) < 1.2 * smooth(rows)


def test_nearest_points_of_a_mesh(head):
    """Catches a nearest triangle that is only the one with the nearest center."""
    mesh = head.model.v_template, head.model.faces
    points = default_rng(0).normal(0, 0.08, (40, 3))
    places, distance = nearest_points(*mesh, points)
    assert_allclose(norm(places.on(*mesh) - points, axis=1), distance, atol=1e-9)
    found = trimesh.proximity.closest_point_naive(trimesh.Trimesh(*mesh, process=False), points)
    assert_allclose(distance, found[1], atol=1e-9)


def test_prior_keeps_weights_between_0_and_1():
    """Catches a pull of the wrong sign or size, one on models whose coefficients are no weights,
    and lids that close beyond each other: the right-hand side is minus the slope of the penalty, by
    differences."""
    named = HeadModel(flame_model(None), "flame")
    lids = [
        [named.model.expression_names.index(name + side) for name in LID_SHAPES]
        for side in ("Left", "Right")
    ]
    shares = np.array(list(LID_SHAPES.values()))
    count = named.model.n_expression
    rng = default_rng(0)
    values = np.concatenate([rng.uniform(-1, 2, count), np.zeros(RIGID_SIZE)])
    values[lids[0]] = 0.9, 0.8  # each in its range
    pulled = (values[:count] < 0) | (values[:count] > 1)
    pulled[lids[0]] = True
    pulled[lids[1]] |= values[lids[1]] @ shares > 1

    def penalty(head, at):
        total = (parameter_precision(head) * at**2).sum() / 2
        if head.model.expression_names:
            beyond = np.maximum(at[:count] - 1, 0) + np.maximum(-at[:count], 0)
            total += (beyond**2).sum() / 2 / WEIGHT_EXCESS_SIGMA**2
            for lid in lids:
                total += max(at[lid] @ shares - 1, 0) ** 2 / 2 / WEIGHT_EXCESS_SIGMA**2
        return total

    for head in (named, replace(named, model=replace(named.model, expression_names=()))):
        precision, right = prior_terms(head, values)
        for column in range(count):
            step = np.zeros_like(values)
            step[column] = 1e-6
            slope = (penalty(head, values + step) - penalty(head, values - step)) / 2e-6
            assert right[column] == pytest.approx(-slope, rel=1e-4, abs=1e-6)
        more = precision[:count] > parameter_precision(head)[:count]
        assert (more == pulled).all() == bool(head.model.expression_names)
