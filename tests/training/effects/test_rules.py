"""Rules of effects, on scenes whose colors depend on known causes."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from refusal import refusal

from stga_addon.files import write_json
from stga_addon.flame.forward import FlameFrame
from stga_addon.flame.teeth import TEETH_VERTICES, TEMPLATE_VERTICES, teeth_faces
from stga_addon.tracking.folder import LANDMARKS_FOLDER, PLACES_FILE, REPORT_FILE
from stga_addon.training.effect_catalog import RELIGHT
from stga_addon.training.effects import plan as rules
from stga_addon.training.effects.evidence import Evidence
from stga_addon.training.effects.facts import MAX_TIMESTEPS, CaptureFacts
from stga_addon.training.effects.plan import plan_effects
from stga_addon.training.effects.samples import MAX_VIEWS, sample_views, take_samples
from stga_addon.training.optimize.initial_splats import initial_splats
from stga_addon.training.settings import TrainingSettings, make_settings

from .scenes import gloss, sliding, unlike_cameras, wrinkles

FEW_VIEWS = {"cameras": 3, "timesteps": 3}
"""For what does not depend on how sure evidence is."""


def planned(capture, **choices):
    """effect -> decision, and the settings that follow."""
    names = {name.replace("_", "-"): choice for name, choice in choices.items()}
    settings, plan = plan_effects(capture, make_settings(iterations=1, effects=names))
    return {decision.effect: decision for decision in plan}, settings


def on(plan):
    """Effects that this capture calls for; `relight` is left to the scene that shows the avatar."""
    return {name for name, decision in plan.items() if decision.on and name != RELIGHT}


def gains(decision):
    """In decibels, of colors in frames, and in cameras, that were left out."""
    pattern = r"([+-]\d+\.\d+) dB in left-out (?:frames|cameras)"
    return [float(gain) for gain in re.findall(pattern, decision.reason)]


SETTINGS = make_settings(iterations=1)
USUAL = {"antialiasing", "background", "density"}
"""Effects that every painted capture calls for, and `MOVING` those that are deformed."""
MOVING = {*USUAL, "normal-color"}
ALIKE = "because the mesh has the same shape"
STILL = {"timesteps": 1, "deformed": 0.0}


@pytest.mark.parametrize(
    ("scene", "choice", "reason"),
    [
        (STILL, "strain_color", ALIKE),
        (STILL, "strain_position", ALIKE),
        (STILL, "normal_color", "because triangles turn by 0.0°"),
        (STILL, "selection", "because no triangle moves"),
        ({"cameras": 1, "paint": gloss}, "view_color", "because a single camera"),
        ({"cameras": 1, "timesteps": 1}, "exposure", "because a single image"),
        ({"masks": False, **FEW_VIEWS}, "background", "because not every image has a mask"),
        (
            {"masks": False, "background": (90, 110, 70), **FEW_VIEWS},
            "hull_points",
            "because without masks",
        ),
    ],
)
def test_what_cannot_work_is_refused(painted, scene, choice, reason):
    """Catches a choice that the capture tells nothing about and that is trained all the same."""
    flag = f"--effect {choice.replace('_', '-')}=on"
    with refusal(f"{flag}: is not possible, {reason}"):
        planned(painted(**scene), **{choice: "on"})


def test_plain(painted):
    """Catches noise, edges or pose that count as a cause, and FLAME's effects without FLAME."""
    plan, settings = planned(painted())
    assert on(plan) == MOVING
    assert (settings.sh_degree, settings.exposure) == (0, ())
    assert settings.driven_offsets == ("normal_color",)
    assert not settings.hull_points
    assert plan[RELIGHT].on
    # there is no FLAME
    assert not set(plan) & {"teeth", "neck", "jaw", "eyes", "dynamic-offsets", "tracking"}
    # a static capture is not refused as a whole
    assert on(planned(painted(**STILL))[0]) == USUAL


def test_color_that_follows_strain(painted):
    """Catches wrinkles that are not seen, or are taken for the cameras' doing."""
    plan, settings = planned(painted(paint=wrinkles))
    assert on(plan) >= {*MOVING, "strain-color", "strain-position"}
    assert {"strain_color", "strain_position"} <= set(settings.driven_offsets)
    unseen_frames, unseen_cameras = gains(plan["strain-color"])
    assert unseen_frames > 1
    assert unseen_cameras > 3


def test_what_moves_over_triangles_with_strain(painted):
    """Catches positions that follow the mesh alone where its surface slides."""
    plan, settings = planned(painted(paint=sliding))
    assert plan["strain-position"].on
    assert "strain_position" in settings.driven_offsets
    assert min(gains(plan["strain-position"])) > 0.5


@pytest.mark.parametrize(
    ("frames", "cameras", "gained", "on", "on_tracked"),
    [
        # much gained in other views, little lost in other expressions
        ((10, 10.4), (10, 8), "-0.34 +1.94", True, True),
        ((10, 8), (10, 10.4), "+1.94 -0.34", True, True),
        ((10, 12), (10, 9.5), "-1.58 +0.45", False, False),
        ((10, 9.5), (10, 12), "+0.45 -1.58", False, False),
        # 1.1 levels of 30 are nothing that can be seen
        ((30, 29.98), (30, 29.98), "+0.01 +0.01", False, True),
    ],
)
def test_what_is_gained_outweighs_what_is_lost(frames, cameras, gained, on, on_tracked, tmp_path):
    """Catches a small loss that outweighs a large gain, or is not shown, and takes as exact."""
    errors = {"frames": Evidence(*frames), "cameras": Evidence(*cameras)}
    change = {"smoothed_strain": 0.1}.__getitem__
    capture = SimpleNamespace(root=tmp_path)
    known = {"signal_change": change, "timesteps": 10, "strain_dependence": errors}
    verdict = rules.strain(SimpleNamespace(capture=capture, **known))
    assert [f"{gain:+.2f}" for gain in gains(verdict)] == gained.split()
    assert verdict.on == on
    for path in (tmp_path / LANDMARKS_FOLDER / PLACES_FILE, tmp_path / REPORT_FILE):
        path.parent.mkdir(exist_ok=True)
        path.touch()
    assert rules.strain(SimpleNamespace(capture=capture, **known)).on == on_tracked
    verdict = rules.strain(SimpleNamespace(signal_change=change, timesteps=3))
    assert (verdict.on, verdict.fixed) == (False, False)
    assert verdict.reason.startswith("3 frames are too few to show what")


def test_color_that_follows_the_normal():
    """Catches a head that turns and keeps its shade, and coefficients that nothing tells."""
    for change, on in ((0.09, True), (0.02, False)):
        facts = SimpleNamespace(signal_change={"normal": change}.__getitem__)
        verdict = rules.normal_color(facts)
        assert (verdict.on, verdict.fixed) == (on, False)
        assert f"turn by {np.degrees(3**0.5 * change):.1f}°" in verdict.reason


def test_color_that_follows_the_view(painted):
    """Catches gloss taken for exposure, and effects that one camera cannot tell."""
    plan, settings = planned(painted(paint=gloss))
    assert on(plan) == {*MOVING, "view-color"}
    assert settings.sh_degree == TrainingSettings.sh_degree
    plan, settings = planned(painted(cameras=1, paint=gloss))
    assert on(plan) == {*MOVING, "depth-limits"}
    assert (settings.scale_limit, settings.stray_limit, settings.adam_epsilon) == (1.5, 0.5, 0.03)
    assert settings.sh_steps == ()


def test_cameras_of_different_exposure(painted):
    """Catches gains and offsets not found, mixed up, or wrong by more than two levels."""
    gain, offset = unlike_cameras()
    plan, settings = planned(painted(gain=gain, offset=offset))
    assert on(plan) == {*MOVING, "exposure"}
    rows = np.array(settings.exposure)
    assert rows[:, 0].tolist() == list(range(8))
    for level in (80, 120, 160):  # what the ball's colors are
        truth = gain * level + offset
        found = rows[:, 1:4] * level + rows[:, 4:]
        assert abs(found - truth).max() < 2.0
    assert abs(gain * 120 + offset - 120).max() > 8.0


def test_exposure_of_photos_and_a_talk(painted):
    """Catches an avatar of photos and a talk that is brighter or darker than the talk."""
    gain, offset = unlike_cameras()
    capture = painted(gain=gain, offset=offset)
    views = [view for view in capture.views["train"] if view.camera_index == 3 or not view.timestep]
    found = CaptureFacts(replace(capture, views={"train": views}), SETTINGS).camera_colors
    assert (found.gain[3] == 1).all()
    assert (found.offset[3] == 0).all()
    for level in (80, 120, 160):
        shown = gain[3] * level + offset[3]
        differences = found.gain * shown + found.offset - (gain * level + offset)
        assert abs(differences).max() < 4.0


def test_background(painted):
    """Catches a background guessed without masks, and splats of the wall behind the head."""
    plan, settings = planned(painted(background=(0, 0, 0), **FEW_VIEWS))
    assert plan["background"].on
    assert settings.background == (0.0, 0.0, 0.0)
    plan, settings = planned(painted(masks=False, **FEW_VIEWS))
    assert (plan["background"].on, settings.random_background) == (False, False)
    capture = painted(masks=False, background=(90, 110, 70), **FEW_VIEWS)
    plan, settings = planned(capture)
    assert (settings.backdrop, settings.hull_points) == ("mesh", False)
    assert settings.random_background
    assert "sampled images have no mask" in plan["background"].reason
    assert len(initial_splats(capture, settings)) == len(capture.faces) * 3


def in_a_room(capture):
    """Facts of a capture behind whose head colors vary by 40 levels."""
    facts = CaptureFacts(capture, SETTINGS)
    facts.samples = replace(
        facts.samples, background_spread=np.full(len(facts.samples.camera), 40.0)
    )
    return facts


def test_a_room_behind_the_head(painted):
    """Catches masks not used, a room exchanged as one color, and a world of a moving camera."""
    verdict = rules.background(in_a_room(painted()))
    assert (verdict.on, verdict.changes["backdrop"]) == (True, "masked")
    assert "varies by 40 of 255 levels, is replaced" in verdict.reason
    for capture in (painted(), painted(masks=False)):
        assert rules.world(CaptureFacts(capture, SETTINGS)).fixed
    found = rules.world(in_a_room(painted()))
    assert (found.on, found.fixed) == (False, False)
    first, *rest = painted().views["train"]
    pose = first.camera.world_to_camera.copy()
    pose[0, 3] += 0.001
    moved = replace(first.camera, world_to_camera=pose)
    again = replace(first, camera=moved, timestep=first.timestep + 1)
    facts = in_a_room(painted())
    facts.views = (first, *rest, again)
    assert (rules.world(facts).fixed, rules.world(facts).reason[:9]) == (True, "1 of 8 ca")


def test_something_beside_the_mesh_of_one_camera(painted):
    """Catches hair of a single camera that is not trained, or is promised a depth."""
    capture = painted(cameras=1)
    # the ball's top is cut off
    low = capture.faces[(capture.neutral[capture.faces][:, :, 1] < 0.06).all(1)]
    plan, settings = planned(replace(capture, faces=low))
    assert settings.hull_points
    assert "becomes a flat layer" in plan["hull-points"].reason


def test_different_pixels(painted):
    """Catches cameras whose pixels are of different size and are treated as alike."""
    capture = painted()
    views = list(capture.views["train"])
    for number, view in enumerate(views):
        if view.camera_index == 0:
            large = replace(view.camera, fl_x=840.0, fl_y=840.0)
            views[number] = replace(view, camera=large)
    single = make_settings(iterations=1, lattice=0)
    verdict = rules.antialiasing(
        CaptureFacts(replace(capture, views={"train": tuple(views)}), single)
    )
    assert verdict.on
    assert 1.9 < float(re.search(r"is (\d\.\d+) times the narrowest", verdict.reason)[1]) < 2.1
    assert not rules.antialiasing(CaptureFacts(painted(), single)).on
    assert rules.antialiasing(CaptureFacts(painted(), SETTINGS)).on


def test_many_splats_a_pixel(painted):
    """Catches density control where the first splats are already finer than the images."""
    fine = make_settings(iterations=1, lattice=8, effects={})
    settings, plan = plan_effects(painted(**FEW_VIEWS), fine)
    assert not next(decision.on for decision in plan if decision.effect == "density")
    assert settings.density_interval == 0


def test_selection_follows_the_strategy(painted):
    """Catches a strategy dropped or taken unasked, and refused as sampled frames stand still."""
    selective = make_settings("selective", iterations=1, effects={})
    assert plan_effects(painted(**FEW_VIEWS), selective)[0].strategy == "selective"
    assert planned(painted(**FEW_VIEWS), selection="on")[1].strategy == "selective"
    settings, plan = plan_effects(painted(**STILL), selective)
    assert settings.strategy == "global"
    assert "2 mm" in next(decision.reason for decision in plan if decision.effect == "selection")
    moving = painted()
    still = replace(moving, expression_mesh=lambda timestep, zero_pose: moving.neutral)
    still = replace(still, timesteps=tuple(range(500)))
    verdict = rules.selection(CaptureFacts(still, make_settings(iterations=1)))
    assert (verdict.on, verdict.fixed) == (False, False)
    assert "any of 64 frames" in verdict.reason


def frame(**pose):
    zero = {name: np.zeros(3) for name in ("rotation", "neck_pose", "jaw_pose", "translation")}
    return FlameFrame(**{"expr": np.zeros(2), "eyes_pose": np.zeros(6), **zero, **pose})


def with_frames(*frames):
    """Facts of a FLAME capture that has these frames and no teeth."""
    model = SimpleNamespace(v_template=np.zeros((10, 3)), masks={})
    flame = SimpleNamespace(
        timesteps=tuple(range(len(frames))), frame=lambda timestep: frames[timestep], model=model
    )
    capture = SimpleNamespace(views={"train": ()}, flame=flame, timesteps=flame.timesteps)
    return CaptureFacts(capture, SETTINGS)


@pytest.mark.parametrize(
    ("name", "pose"),
    [
        ("neck", {"neck_pose": np.array([0.1, 0, 0])}),
        ("jaw", {"jaw_pose": np.array([0.1, 0, 0])}),
        ("eyes", {"eyes_pose": np.array([0, 0, 0, 0, 0.1, 0])}),
    ],
)
def test_joints_that_move(name, pose):
    """Catches a joint that is taken for another, and the second eye that is forgotten."""
    facts = with_frames(frame(), frame(**pose))
    moving = {joint for joint in ("neck", "jaw", "eyes") if rules.RULES[joint](facts).on}
    assert moving == {name}
    assert "5.7°" in rules.RULES[name](facts).reason


def test_dynamic_offsets():
    """Catches offsets off although the tracked mesh is made with them, and the other way round."""
    assert rules.dynamic_offsets(with_frames(frame())).on is False
    moved = frame(dynamic_offset=np.ones((10, 3)))
    found = rules.dynamic_offsets(with_frames(frame(), moved))
    assert (found.on, found.fixed) == (True, True)


def off_track(capture, meters, device="cpu"):
    """Facts of the ball as if it were a FLAME capture tracked so far beside its images."""
    meshes = {t: capture.mesh(t) + np.array([meters, 0, 0]) for t in capture.timesteps}
    facts = CaptureFacts(replace(capture, mesh=meshes.__getitem__), SETTINGS, device)
    facts.frames = [frame()]
    return facts


def test_mesh_and_mask_disagree(painted, tmp_path):
    """Catches a tracking that is off, or of landmarks, and left so, and one refined in vain."""
    assert not rules.tracking(off_track(painted(), 0.0)).on
    found = rules.tracking(off_track(painted(), 0.012))  # five pixels
    assert found.on
    assert 0.5 < float(found.reason.split("%")[0]) < 5.0
    unknown = rules.tracking(off_track(painted(masks=False), 0.012))
    assert (unknown.on, unknown.fixed) == (False, False)
    cut = rules.tracking(off_track(painted(masks=False, background=(90, 120, 60)), 0.012))
    assert (cut.on, cut.fixed) == (False, True)  # by the mesh that would be tracked
    for impossible in (
        off_track(painted(timesteps=1), 0.012),
        off_track(painted(), 0.012, "cuda:0"),
    ):
        verdict = rules.tracking(impossible)
        assert (verdict.on, verdict.fixed) == (False, True)
    assert "on the CPU only, not on cuda:0" in verdict.reason
    facts = off_track(painted(), 0.0)
    facts.capture = replace(facts.capture, root=tmp_path)
    (tmp_path / LANDMARKS_FOLDER).mkdir()
    for name in (REPORT_FILE, f"{LANDMARKS_FOLDER}/{PLACES_FILE}"):
        (tmp_path / name).touch()
    assert rules.tracking(facts).on


def test_torso(tmp_path):
    """Catches shoulders taken off the head without evidence, and evidence not shown."""

    def judged(torso):
        write_json(tmp_path / REPORT_FILE, torso)
        facts = SimpleNamespace(frames=[None], capture=SimpleNamespace(root=tmp_path))
        return rules.torso(facts)

    misfit = {"head": 0.4, "still": 0.2, "own": 0.1}
    verdict = judged({"torso": {"motion": "own", "misfit": misfit, "turn_deg": 17.3}})
    assert verdict.on
    assert all(figure in verdict.reason for figure in ("17°", "40%", "20%", "10%"))
    shifted = {"motion": "own", "misfit": misfit, "turn_deg": 3.0, "shift_mm": 8.2}
    assert "3° and 8 mm" in judged({"torso": shifted}).reason
    assert "bends by up to 10 mm" in judged({"torso": {**shifted, "bend_mm": 10.4}}).reason
    for still in ({"motion": "head", "misfit": misfit, "turn_deg": 0.0}, None):
        assert not judged({"torso": still}).on
    assert not judged({}).on
    assert rules.torso(SimpleNamespace(frames=[])) is None


def seen(samples):
    """(S, K) bool: which triangles have a color in which views."""
    return ~np.isnan(samples.color[..., 0])


def test_samples(painted):
    """Catches colors beside the triangle, or of what hides it: itself, a hand or the nose."""
    capture = painted()
    samples = take_samples(capture)
    assert seen(samples).any(0).mean() > 0.5
    away = capture.neutral[capture.faces[samples.faces]].mean(1)
    hidden = np.einsum("skd,kd->sk", samples.direction, away / 0.1) > 0.3
    assert not (seen(samples) & hidden).any()
    other = take_samples(capture, seed=1)
    known = seen(samples).any(0) & seen(other).any(0)
    assert len(known) == len(capture.faces)
    middle = np.nanmedian(samples.color[:, known], 0) - np.nanmedian(other.color[:, known], 0)
    assert abs(middle).mean() < 2.0
    # above the ball's equator
    plate = np.array([[-0.2, 0, 0.12], [0.2, 0, 0.12], [0.2, 0.4, 0.12], [-0.2, 0.4, 0.12]])
    corners = np.array([[0, 1, 2], [0, 2, 3]], np.int32) + len(capture.neutral)
    neutral = np.concatenate([capture.neutral, plate])
    views = tuple(view for view in capture.views["train"] if view.camera_index == 4)
    front = replace(capture, views={"train": views}, neutral=neutral)
    front = replace(front, faces=np.concatenate([capture.faces, corners]))
    front = replace(front, mesh=lambda t: np.concatenate([capture.mesh(t), plate]))
    samples = take_samples(front)
    height = front.neutral[front.faces[samples.faces]].mean(1)[:, 1]
    ball = samples.faces < len(capture.faces)
    assert not seen(samples)[:, ball & (height > 0.05)].any()
    assert seen(samples)[:, ball & (height < -0.05)].any()
    alone = take_samples(replace(capture, views=front.views))
    assert seen(alone)[:, capture.neutral[capture.faces[alone.faces]].mean(1)[:, 1] > 0.05].any()


def test_every_camera_is_sampled(painted):
    """Catches cameras without exposure, and parts of a long sequence that are left out."""
    views = [
        SimpleNamespace(timestep=t, camera_index=c) for t in range(20) for c in range(3 * MAX_VIEWS)
    ]
    late = [view for view in views if view.camera_index != 7 or view.timestep == 4]
    for given in (views, late):
        chosen = [view.camera_index for view in sample_views(given)]
        assert set(chosen) == set(range(3 * MAX_VIEWS))
        assert len(chosen) <= 3 * MAX_VIEWS + 1
    long = [SimpleNamespace(timestep=t, camera_index=c) for t in range(500) for c in range(16)]
    spread = sample_views(long)
    assert len(spread) == MAX_VIEWS == len({(view.timestep, view.camera_index) for view in spread})
    assert np.ptp(np.bincount([view.camera_index for view in spread], minlength=16)) <= 1
    assert {view.timestep for view in spread} >= {0, 499}
    capture = painted(cameras=MAX_VIEWS + 12, timesteps=1, deformed=0.0)
    facts = CaptureFacts(capture, make_settings(iterations=5))
    assert len(facts.camera_colors.camera) == MAX_VIEWS + 12


def test_each_timestep_is_posed_once(painted, monkeypatch):
    """Catches a long capture whose timesteps are all posed, or one several times."""
    monkeypatch.setattr(
        "stga_addon.training.effects.facts.lip_pairs", lambda model: np.arange(30).reshape(2, 15)
    )
    neutral = np.random.default_rng(0).normal(size=(TEMPLATE_VERTICES + TEETH_VERTICES, 3))
    posed = []

    def expression_mesh(timestep, zero_pose):
        posed.append(timestep)
        return neutral + 0.01

    flame = SimpleNamespace(model=SimpleNamespace(v_template=neutral, masks={"teeth": [0]}))
    capture = replace(painted(), timesteps=tuple(range(500)), neutral=neutral, flame=flame)
    capture = replace(capture, expression_mesh=expression_mesh)
    facts = CaptureFacts(capture, SETTINGS)
    assert facts.selected_fraction == 1
    assert facts.lip_gap_mm == pytest.approx(0)
    assert len(posed) == len(set(posed)) == MAX_TIMESTEPS
    assert {0, 499} <= set(posed)


def test_lips_that_part(painted, shared_data):
    """Catches other vertices than FLAME's lips, and a turn taken for lips that part."""
    with np.load(shared_data / "flame_open/flame2023_open_basis.npz") as data:
        template = data["v_template"].astype(float)
        faces = data["faces"]
    closed = np.concatenate([template, np.zeros((TEETH_VERTICES, 3))])
    faces = np.concatenate([faces, teeth_faces(TEMPLATE_VERTICES)])
    model = SimpleNamespace(
        v_template=closed, faces=faces, masks={"teeth": [0]}, expression_names=()
    )
    # a cut through the mouth, below its corners
    opened = closed - [0, 0.01, 0] * (closed[:, 1:2] < -0.047)
    meshes = [closed, closed @ [[0.8, 0, 0.6], [0, 1, 0], [-0.6, 0, 0.8]], opened]
    flame = SimpleNamespace(model=model)
    capture = replace(painted(), timesteps=(0, 1), neutral=closed, flame=flame)
    capture = replace(capture, expression_mesh=lambda timestep, zero_pose: meshes[timestep])
    assert CaptureFacts(capture, SETTINGS).lip_gap_mm == pytest.approx(0, abs=1e-9)
    opens = CaptureFacts(replace(capture, timesteps=(0, 2)), SETTINGS)
    assert opens.lip_gap_mm == pytest.approx(10, abs=0.2)
