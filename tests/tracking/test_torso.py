"""The torso's motion against generated takes in which shoulders are a body of their own, that moves
as told."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from flame.small_head import small_head, small_head_colors, subdivided, write_flame
from numpy.linalg import norm
from numpy.random import default_rng
from numpy.testing import assert_allclose
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from stga_addon.capture.camera import look_at
from stga_addon.capture.mesh_geometry import rasterize, weighted_procrustes
from stga_addon.capture.open import open_capture
from stga_addon.files import read_json
from stga_addon.flame.forward import (
    FlameFrame,
    axis_angle_matrices,
    flame_forward,
    frame_of,
    joint_positions,
)
from stga_addon.flame.model import MIN_TORSO_WEIGHT, torso_faces
from stga_addon.tracking.correspondence import shaded_image
from stga_addon.tracking.dense_head import REGIONS
from stga_addon.tracking.fit import HeadFit, posed_mesh
from stga_addon.tracking.folder import (
    KEPT_FOLDER,
    REPORT_FILE,
    TorsoMotion,
    TorsoPoints,
    read_torso_motion,
    read_torso_points,
)
from stga_addon.tracking.footage.model import Footage, FootageCamera
from stga_addon.tracking.footage.open import open_footage
from stga_addon.tracking.head_model import HeadModel
from stga_addon.tracking.opened import TrackingOptions
from stga_addon.tracking.solve import person
from stga_addon.tracking.stages import Stage, Workers
from stga_addon.tracking.surface import with_offset
from stga_addon.tracking.torso import _followed, follow_torso
from stga_addon.tracking.torso_cloth import Bending, draped, found_bending, torso_sheet
from stga_addon.tracking.torso_take import (
    MAX_UNEVENNESS_M,
    NECK,
    ROOT,
    BothWays,
    Carrier,
    PosedTorso,
    TorsoPose,
    TorsoTake,
    states_along,
    with_root,
)
from stga_addon.tracking.track import track
from stga_addon.worker.helpers import Helpers

from .recording import seen_landmarks, write_footage, write_points
from .test_fit import HERE, places_on

SIZE = 105, 142
TIMESTEPS = 6
SWING_DEG = 20 * np.sin(np.arange(TIMESTEPS) / 1.5 - 2)  # Of what turns, at each timestep
LIFT_M = 0.012 * np.sin(1.3 * np.arange(TIMESTEPS))[:, None] * [0.5, 1.0, 0.2]
"""By which shoulders are shifted at each timestep."""
SLIDE_M = 0.01 * np.sin(0.9 * np.arange(TIMESTEPS))[:, None] * [1.0, 0.3, 0.0]
CLOTH_CENTER_M = np.array([0.04, -0.23, 0.03])
CLOTH_SIGMA_M = 0.05
"""By which cloth slides over the shoulders at each timestep; where, and how far around."""
CHEST_SIZE_M = np.array([0.17, 0.08, 0.085])
CHEST_CENTER_M = np.array([0.0, -0.215, -0.04])


def follow(fit, parameters, footage):
    return follow_torso(fit, parameters, footage, Workers(Helpers(1)))


def assert_head_stays(fit, parameters, meshes):
    """By timestep, what the torso does not carry lies where the tracked head has it."""
    apart = fit.head.model.weights[:, ROOT] == 0
    for timestep, mesh in meshes.items():
        assert np.abs(mesh - posed_mesh(fit, parameters[timestep]))[apart].max() < 2e-3


def assert_unchanged(followed, parameters):
    assert not followed.offsets
    assert all(followed.parameters[timestep] is own for timestep, own in parameters.items())


def ellipsoid():
    """Shoulders (V, 3), faces (F, 3) and colors (V, 3) of patterned cloth, below the small head."""
    angles = np.linspace(0, 2 * np.pi, 90), np.linspace(0, np.pi, 45)
    around, down = (own.ravel() for own in np.meshgrid(*angles, indexing="ij"))
    across = np.sin(down)
    unit = np.stack([across * np.cos(around), np.cos(down), across * np.sin(around)], -1)
    vertices = unit * CHEST_SIZE_M + CHEST_CENTER_M
    grid = np.arange(90 * 45).reshape(90, 45)
    corners = grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]
    a, b, c, d = (own.ravel() for own in corners)
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    waves = np.sin(vertices @ default_rng(1).normal(0, 160, (3, 5)))
    colors = 0.5 + 0.12 * waves @ default_rng(2).normal(0, 1, (5, 3))
    return vertices, faces, np.clip(colors, 0.05, 0.95)


@dataclass(frozen=True)
class Frames:
    """Pictures and masks by timestep."""

    images: list = field(default_factory=list)
    masks: list = field(default_factory=list)

    @property
    def timesteps(self):
        return tuple(range(len(self.images)))

    def image(self, timestep):
        return self.images[timestep]

    def mask(self, timestep):
        return self.masks[timestep]


@pytest.fixture(scope="module")
def fine_head():
    """With several rows of vertices below the neck, as FLAME has."""
    return HeadModel(subdivided(small_head(0))[0], "flame")


def take(head, heads, torsos, size=SIZE, shifts=None):
    """Fit, parameters of a head tracked as one, and footage; heads, torsos (T,): degrees about the
    vertical axis;
    shifts (T, 3) or (T, V, 3): of the shoulders, or of each of their vertices, in meters."""
    pictured, colors = subdivided(small_head(0), small_head_colors())
    colors = np.clip(colors ** (1 / 1.8), 0, 1)
    cloth, cloth_faces, cloth_colors = ellipsoid()
    faces = np.concatenate([pictured.faces, cloth_faces + len(pictured.v_template)])
    cameras = [
        look_at((np.sin(a), 0.0, np.cos(a)), (0, -0.07, 0), *size, 2.6 * size[0])
        for a in (-0.6, 0.0, 0.6)
    ]
    frames = [Frames() for _ in cameras]
    shape = np.zeros(pictured.n_identity)
    one = person(head, np.zeros(head.model.n_identity))
    joints = joint_positions(one.model, one.model.v_template)
    parameters = {}
    every = np.concatenate([colors, cloth_colors])
    zero = np.zeros(3)
    turns = zip(np.radians(heads), np.radians(torsos), strict=True)
    for timestep, (turned, carried) in enumerate(turns):
        expr = np.zeros(one.model.n_expression)
        moved = np.array([0.002 * timestep, 0, 0])
        root = np.array([0, carried, 0])
        neck = np.array([0, turned - carried, 0])
        frame = FlameFrame(expr, root, neck, zero, moved, np.zeros(6))
        turn, straight = axis_angle_matrices(np.array([root, [0, turned, 0]]))
        shoulders = (cloth - joints[ROOT]) @ turn.T + joints[ROOT] + frame.translation
        shoulders += 0 if shifts is None else shifts[timestep]
        mesh = np.concatenate([flame_forward(pictured, shape, frame), shoulders])
        for camera, own in zip(cameras, frames, strict=True):
            own.images.append(shaded_image(mesh, faces, camera, every))
            seen = rasterize(mesh, faces, camera)[0] >= 0
            own.masks.append(np.where(seen, 255, 0).astype(np.uint8))
        arm = joints[NECK] - joints[ROOT]
        parameters[timestep] = with_root(frame.parameters, straight, arm)
    fit = HeadFit(one, np.zeros(0), parameters, HERE)
    named = zip("012", cameras, frames, strict=True)
    filmed = tuple(FootageCamera(name, camera, own) for name, camera, own in named)
    return fit, parameters, Footage(Path("take"), filmed, tuple(range(len(heads))))


def torso_angles(model, meshes):
    """(T,) degrees by which the end of the neck, which carries the shoulders, is turned about the
    vertical axis."""
    used = np.unique(model.faces[torso_faces(model)])
    pairs = [(model.v_template[used], mesh[used]) for mesh in meshes.values()]
    turns = [weighted_procrustes(*pair, np.ones(len(used)))[0] for pair in pairs]
    return np.degrees([np.arctan2(turn[0, 2], turn[2, 2]) for turn in turns])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("heads", "torsos", "motions"),
    [(1, 0, ("still", "own")), pytest.param(1, 0.5, ("own",), marks=pytest.mark.nightly)],
)
def test_a_torso_that_turns_against_the_head_is_followed(head, heads, torsos, motions):
    """Catches shoulders that ride on the head, and a head that is moved to turn them."""
    fit, parameters, footage = take(head, heads * SWING_DEG, torsos * SWING_DEG)
    followed = follow(fit, parameters, footage)
    torso = followed.motion
    meshes = {t: followed.mesh(t) for t in parameters}
    assert torso.motion in motions
    wrong = torso_angles(fit.head.model, meshes) - torsos * SWING_DEG
    assert np.abs(wrong - wrong.mean()).max() < 3.0
    assert torso.misfit[torso.motion] < 0.7 * torso.misfit["head"]
    assert_head_stays(fit, parameters, meshes)


@pytest.fixture(scope="module")
def lifted(head):
    """A take in which the head turns, and shoulders are shifted."""
    return take(head, SWING_DEG, 0 * SWING_DEG, shifts=LIFT_M)


@pytest.mark.slow
def test_shoulders_that_are_lifted_are_followed(head, lifted):
    """Catches a torso that is only turned, of which patterned cloth is off by pixels, offsets that
    FLAME's joints undo, a head that is moved with them, and points that are as deep as the neck
    instead of on the chest."""
    fit, parameters, footage = lifted
    followed = follow(fit, parameters, footage)
    assert followed.motion.motion == "own"
    assert followed.motion.shift_mm > 5
    meshes = {t: followed.mesh(t) for t in parameters}
    assert_head_stays(fit, parameters, meshes)
    used = np.unique(head.model.faces[torso_faces(head.model)])
    places = [mesh[used].mean(0) - [0.002 * t, 0, 0] for t, mesh in meshes.items()]
    wrong = np.array(places) - LIFT_M
    assert np.abs(wrong - wrong.mean(0)).max() < 3e-3
    timestep = followed.points.timestep
    beside = followed.points.at - [0.002 * timestep, 0, 0] - LIFT_M[timestep] - CHEST_CENTER_M
    assert np.median(np.abs(norm(beside / CHEST_SIZE_M, axis=1) - 1)) < 0.15


def test_the_necks_end_is_drawn_over_the_chest(fine_head):
    """Catches a mesh that is drawn to the points' mean depth, one that ends at the neck, a throat
    that is moved, and a back that is made up."""
    cloth, _, _ = ellipsoid()
    sheet = torso_sheet(fine_head.model)
    at = fine_head.model.v_template[sheet.vertices]
    base = np.array([0.0, -0.14, -0.04])
    shown = cloth[(cloth[:, 2] > CHEST_CENTER_M[2] + 0.02) & (cloth[:, 1] < base[1] - 0.01)]
    after = draped(sheet, at - base, shown - base) + base
    moved = norm(after - at, axis=1) > 0.02
    beside = np.abs(norm((after - CHEST_CENTER_M) / CHEST_SIZE_M, axis=1) - 1)
    assert moved.sum() > 20
    assert np.median(beside[moved & (sheet.height < 0.7)]) < 0.1
    assert after[:, 1].min() < shown[:, 1].min() + 0.03
    assert_allclose(after[sheet.height == 0], at[sheet.height == 0], atol=1e-12)
    behind = at[:, 2] < base[2] - 0.02
    assert behind.any()
    assert_allclose(after[behind], at[behind], atol=1e-12)


@pytest.mark.slow
def test_cloth_that_slides_over_the_shoulders_is_followed(fine_head):
    """Catches a torso that only moves as one, flow that is applied in another camera's or the
    head's axes, and a head that moves with the joint that FLAME finds from the bent vertices."""
    cloth, _, _ = ellipsoid()
    near = np.exp(-(((cloth - CLOTH_CENTER_M) / CLOTH_SIGMA_M) ** 2).sum(1) / 2)[:, None]
    slides = np.array([slide * near for slide in SLIDE_M])
    shifts = LIFT_M[:, None] + slides
    fit, parameters, footage = take(fine_head, SWING_DEG / 2, 0 * SWING_DEG, shifts=shifts)
    posed = TorsoTake(fit, parameters, footage.cameras)
    motion = posed.motion({t: TorsoPose(np.eye(3), LIFT_M[t]) for t in parameters}, rigid=True)
    first = 3
    moved = np.arange(TIMESTEPS)[:, None] * [0.002, 0, 0] + LIFT_M
    shown = (cloth + slides[first] + moved[first])[cloth[:, 2] > CHEST_CENTER_M[2] + 0.02]
    walk = BothWays(Workers(Helpers(1)), Stage.CLOTH, TIMESTEPS)
    bending = found_bending(posed, motion, TorsoPoints(first, shown), sorted(parameters), walk)
    meshes = {}
    for timestep, torso in motion.items():
        values, offset = posed.with_offset(torso, bending.at(timestep))
        meshes[timestep] = posed_mesh(fit, values, offset)
    assert_head_stays(fit, parameters, meshes)
    at = {t: mesh[bending.vertices] for t, mesh in meshes.items()}
    distance, nearest = cKDTree(cloth + slides[first] + moved[first]).query(at[first])
    on_cloth = (distance < 0.01) & (near[nearest, 0] > 0.5)
    assert on_cloth.sum() > 5
    true = (slides - slides[first])[:, nearest[on_cloth]]
    found = [at[t] - at[first] - moved[t] + moved[first] for t in meshes]
    wrong = np.array(found)[:, on_cloth] - true
    assert norm(wrong, axis=2).mean() < 0.5 * norm(true, axis=2).mean()


@pytest.mark.slow
def test_a_torso_that_rides_on_the_head_changes_nothing(head):
    """Catches a torso that noise turns: a bust on a turntable, or a studio capture, keeps its
    parameters bit for bit."""
    fit, parameters, footage = take(head, SWING_DEG, SWING_DEG)
    followed = follow(fit, parameters, footage)
    assert followed.motion.motion == "head"
    assert followed.motion.turn_deg < 1e-3
    assert_unchanged(followed, parameters)


def test_without_masks_the_torso_is_not_told_from_the_wall(head):
    """Catches shoulders that follow the backdrop."""
    fit, parameters, footage = take(head, [0, 5, 10, 15], [0, 0, 0, 0], (40, 55))
    for camera in footage.cameras:
        camera.frames.masks[:] = [None] * 4
    followed = follow(fit, parameters, footage)
    assert followed.motion is None
    assert_unchanged(followed, parameters)


@pytest.mark.parametrize("gap", [1, 2])
def test_what_lies_between_is_solved_where_the_motion_is_uneven(gap):
    """Catches a torso that lags where it begins to move, jerks or stops between two timesteps that
    are followed; and a take of which every timestep is followed, or one whose gaps are taken for
    motion between neighbors."""
    speed = np.repeat([0.0, 0.03, -0.02, 0.0], (7, 8, 9, 20))
    true = np.cumsum(speed)[:, None] * [1.0, 0.5]
    timesteps = range(0, gap * len(true), gap)

    class Take:
        parameters = dict.fromkeys(range(gap * len(true)))
        shot = staticmethod(lambda timestep: timestep)

    solved = []
    steps = []

    def solve(before, now, state):
        assert_allclose(state, true[before // gap])
        solved.append(now)
        return true[now // gap]

    found = states_along(Take, timesteps, true[0], solve, lambda: steps.append(None))
    assert_allclose(found, true, atol=4 * MAX_UNEVENNESS_M)
    assert len(steps) == len(true) - 1
    assert len(solved) < 0.75 * len(steps) if gap == 1 else len(solved) == len(steps)


def test_turning_the_root_leaves_the_head_in_its_place(head):
    """Catches a neck that turns about another point than the model's."""
    one = person(head, np.zeros(head.model.n_identity))
    rng = default_rng(0)
    expr = rng.normal(0, 0.3, one.model.n_expression)
    root = rng.normal(0, 0.4, 3)
    neck = rng.normal(0, 0.2, 3)
    frame = FlameFrame(expr, root, neck, np.zeros(3), rng.normal(0, 1, 3), np.zeros(6))
    # the throat's correctives are another thing
    model = replace(one.model, posedirs=np.zeros_like(one.model.posedirs))
    joints = joint_positions(model, model.v_template + model.shapedirs @ frame.expr)
    rotation = axis_angle_matrices(rng.normal(0, 0.5, (1, 3)))[0]
    changed = with_root(frame.parameters, rotation, joints[NECK] - joints[ROOT])
    before, after = (flame_forward(model, np.zeros(0), own) for own in (frame, frame_of(changed)))
    apart = model.weights[:, ROOT] == 0
    assert_allclose(after[apart], before[apart], atol=1e-12)
    turned = axis_angle_matrices(frame_of(changed).rotation[None])[0]
    assert_allclose(turned, rotation, atol=1e-12)


def test_points_are_carried_by_the_triangles_that_they_lie_on(fine_head):
    """Catches points that the wrong triangle carries: near the neck, each moves otherwise."""
    one = person(fine_head, np.zeros(fine_head.model.n_identity))
    first, last = np.zeros((2, one.model.n_expression + 18))
    last[-18:-15] = [0.1, 0.5, 0.0]
    last[-15:-12] = [0.0, -0.5, 0.1]
    fit = HeadFit(one, np.zeros(0), {0: first, 1: last}, HERE)
    torso = TorsoTake(fit, fit.parameters, [])
    meshes = [posed_mesh(fit, own)[one.model.faces[torso.torso]] for own in (first, last)]
    at, expected = (corners.mean(axis=1) for corners in meshes)
    found = Carrier(torso, PosedTorso(first), at).carried(PosedTorso(last))(at)
    away = norm(found - expected, axis=1)
    assert norm(expected - at, axis=1).max() > 0.02
    assert np.median(away) < 1e-4
    assert away.max() < 2e-3


@pytest.mark.parametrize(("earlier", "bends"), [(True, True), (False, True), (True, False)])
def test_a_take_on_its_torso_has_the_vertices_that_motion_and_cloth_say(fine_head, earlier, bends):
    """Catches a drape that offsets repeat, or that template or static offset lack, an earlier
    static offset that is lost, cloth that does not bend, a head that offsets move, and figures of
    the report in other units or of another joint."""
    bare = person(fine_head, np.zeros(fine_head.model.n_identity))
    rng = default_rng(3)
    size = bare.model.v_template.shape
    static = rng.normal(0, 1e-3, size) * earlier
    one = with_offset(bare, static)
    model = one.model
    expressions = bare.model.n_expression
    tracked = {t: rng.normal(0, 0.2, expressions + 18) for t in (2, 5, 9)}
    posed = {t: PosedTorso(values, rng.normal(0, 0.01, 3)) for t, values in tracked.items()}
    fit = HeadFit(one, np.zeros(0), tracked, HERE, static if earlier else None)
    cloth = torso_sheet(model).vertices
    drape = np.zeros(size)
    drape[cloth] = rng.normal(0, 0.01, (len(cloth), 3))
    bent = {t: rng.normal(0, 0.004, (len(cloth), 3)) for t in posed}
    bending = Bending(cloth, drape, bent) if bends else None
    take = TorsoTake(fit, tracked, ())
    decided = TorsoMotion("own", {"head": 0.5, "still": 0.4, "own": 0.2}, 0.0)
    followed = _followed(fit, take, posed, bending, decided)
    share = np.minimum(model.weights[:, [ROOT]] / MIN_TORSO_WEIGHT, 1)
    assert (share[cloth] > 0).all()
    for timestep, torso in posed.items():
        expression, pose = np.split(torso.parameters, [expressions])
        rest = model.v_template + model.shapedirs @ expression
        turn = Rotation.from_rotvec(pose[:3]).as_matrix()
        joint = model.j_regressor[ROOT] @ rest
        rigid = (rest - joint) @ turn.T + joint + pose[-3:] + torso.shift
        wanted = share * rigid + (1 - share) * posed_mesh(fit, torso.parameters)
        if bends:
            wanted[cloth] += (drape[cloth] + bent[timestep]) @ turn.T
        found = posed_mesh(followed.fit, followed.parameters[timestep], followed.offsets[timestep])
        assert_allclose(found, wanted, atol=1e-9)
    template = bare.model.v_template + followed.fit.static_offset
    assert_allclose(followed.fit.static_offset, static + drape * bends, atol=1e-15)
    assert_allclose(followed.fit.head.model.v_template, template, atol=1e-15)
    motion = followed.motion
    assert motion.misfit == decided.misfit
    necks = [values[expressions + 3 : expressions + 6] for values in tracked.values()]
    assert motion.turn_deg == pytest.approx(np.degrees(norm(necks, axis=1).max()))
    shifts = [1000 * norm(torso.shift) for torso in posed.values()]
    assert motion.shift_mm == pytest.approx(max(shifts))
    by_cloth = [1000 * norm(bend, axis=1).max() for bend in bent.values()]
    assert motion.bend_mm == (pytest.approx(max(by_cloth)) if bends else 0)


@pytest.mark.slow
@pytest.mark.usefixtures("without_surface")
def test_track_writes_the_torso_as_flames_neck(tmp_path, head, lifted):
    """Catches a torso that is followed and then not written, or not reported to those who train on
    the capture; dense tracking that `track` does not run, and a report without it."""
    fit, parameters, footage = lifted
    cameras = [own.camera for own in footage.cameras]
    numbers = {camera.position.tobytes(): number for number, camera in enumerate(cameras)}

    def picture(camera, timestep):
        own = footage.cameras[numbers[camera.position.tobytes()]]
        return np.dstack([own.image(timestep), own.mask(timestep)])

    write_footage(tmp_path / "footage", cameras, TIMESTEPS, picture)
    write_flame(head.model, tmp_path / "head.npz")
    places = places_on(head, 200)
    meshes = [posed_mesh(fit, parameters[timestep]) for timestep in range(TIMESTEPS)]
    seen = [seen_landmarks(head, places, meshes, camera) for camera in cameras]
    write_points(tmp_path / "points", places, {f"cam{n}": own for n, own in enumerate(seen)})
    footage = open_footage(tmp_path / "footage")
    out = tmp_path / "out"
    result = track(
        footage, tmp_path / "head.npz", out, TrackingOptions(tmp_path / "points", mattes=False)
    )
    assert not (out / KEPT_FOLDER).exists()
    found = read_torso_motion(out)
    assert found == result.torso
    assert found.shift_mm > 5
    assert len(read_torso_points(out).at) > 100
    misfit = read_json(out / REPORT_FILE)["image_misfit"]
    assert list(misfit) == list(REGIONS)
    assert all(list(own) == list(map(str, range(TIMESTEPS))) for own in misfit.values())
    assert all(0 < value < 0.5 for own in misfit.values() for value in own.values())
    capture = open_capture(out, tmp_path / "head.npz")
    sequence = capture.flame
    used = np.unique(capture.faces[torso_faces(capture.flame.model)])
    lifts = np.array([capture.mesh(timestep)[used].mean(0)[1] for timestep in range(TIMESTEPS)])
    assert np.corrcoef(lifts, LIFT_M[:, 1])[0, 1] > 0.95
    necks = np.degrees([sequence.frame(timestep).neck_pose[1] for timestep in range(TIMESTEPS)])
    assert np.ptp(necks) > 0.7 * np.ptp(SWING_DEG)
