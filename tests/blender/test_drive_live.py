"""Driving a head live: what a source sends on the head, and what stays afterwards."""

import gc
import socket
import tempfile
import tracemalloc
from types import SimpleNamespace

import bpy
import numpy as np
import pytest
from driving.live import wire
from numpy.testing import assert_allclose

from stga_addon.driving.head_map import head_map
from stga_addon.driving.open_motion import exchanged_neutral, quiet_neutral
from stga_addon.driving.performance import ARKIT_SHAPES, Performance
from stga_addon.driving.performers import read_performance
from stga_addon.flame.forward import flame_forward
from stga_addon.flame.sequence import read_motion
from stga_addon.scene.arrays import evaluated_vertices
from stga_addon.scene.rig.head import rig_of

from .captures import import_small_head
from .session import failure, ops, panel
from .test_splat_object import active_camera

pytestmark = [pytest.mark.usefixtures("extension"), pytest.mark.slow]
TOLERANCE_M = 2e-5


@pytest.fixture
def live(tmp_path, extension):
    """The small head, driven by packets that the test sends."""
    expr = np.random.default_rng(4).normal(0, 0.3, (5, 10))
    jaw = np.linspace([0, 0, 0], [0.2, 0, 0], 5)
    own = import_small_head(tmp_path, expr=expr, jaw_pose=jaw)
    settings = panel().drive
    settings.port = wire.free_port()
    settings.takes = str(tmp_path / "takes")
    recorded = read_motion(tmp_path / "own.npz", own.model)
    sender = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sessions = extension.operators.drive

    def send(weights, frame, **options):
        sender.sendto(wire.live_link_face(weights, frame, **options), ("127.0.0.1", settings.port))
        return sessions.session().tick()

    yield SimpleNamespace(
        send=send,
        settings=settings,
        sessions=sessions,
        own=own,
        frames=[recorded.frame(timestep) for timestep in recorded.timesteps],
        map=head_map(own, "demo"),
        takes=tmp_path / "takes",
    )
    if sessions.session() is not None:
        sessions.session().stop()
    sender.close()


def mesh():
    bpy.context.view_layer.update()
    return evaluated_vertices(panel().head)


TURN = (0.1, 0.2, -0.1)


def assert_shows(live, weights):
    """The head is posed by the weights, and by TURN."""
    row = np.array([[weights.get(name, 0.0) for name in ARKIT_SHAPES]])
    take = Performance(np.zeros(1), row, np.array([TURN]), 60.0)
    expected = flame_forward(live.own.model, live.own.shape, live.map.frames(take)[0])
    assert_allclose(mesh(), expected, atol=TOLERANCE_M)


def test_a_head_without_its_sliders_is_not_driven(live):
    """Catches Drive Live that is finished, and a face that does not move."""
    head = panel().head
    head.shape_key_remove(head.data.shape_keys.key_blocks["expr_003"])
    with failure("has no slider expr_003"):
        ops.drive_live()


def half(seed):
    return {name: 0.5 * value for name, value in wire.mixed(seed).items()}


def test_the_head_follows_and_comes_back(live):
    """Catches another pose than a file's, keyframes, a head left posed, and sliders added."""
    bpy.context.scene.frame_set(1)
    before = mesh()
    actions = sorted(bpy.data.actions.keys())
    ops.drive_live()
    for number in range(3):
        weights = half(number)
        assert 0 < live.send(weights, number, head=TURN) <= 1 / 60
        assert_shows(live, weights)
    bpy.context.scene.frame_set(2)  # its own animation does not come between two packets
    assert_shows(live, weights)
    bpy.context.scene.frame_set(1)
    ops.stop_live()
    assert_allclose(mesh(), before, atol=1e-7)
    assert sorted(bpy.data.actions.keys()) == actions
    assert live.sessions.session() is None
    assert not ops.stop_live.poll()
    ops.add_arkit_controls()
    slider = panel().head.data.shape_keys.key_blocks["jawOpen"]
    slider.value = 0.25
    ops.drive_live()
    weights = half(1)
    live.send(weights, 1, head=TURN)
    assert_shows(live, weights)
    ops.stop_live()
    assert slider.value == 0.25


def test_a_rendered_animation_keeps_its_own_pose(live):
    """Catches an animation rendered while driving that shows the last live pose."""
    rendered = {}

    class Recorder(bpy.types.RenderEngine):
        bl_idname = "TEST_RECORDER"
        bl_label = "Recorder"

        def render(self, depsgraph):
            vertices = panel().head.evaluated_get(depsgraph).data.vertices
            rendered[depsgraph.scene.frame_current] = np.array([vertex.co for vertex in vertices])

    ops.drive_live()
    live.send(half(0), 0)
    scene = bpy.context.scene
    scene.frame_start = 1
    scene.frame_end = 3
    scene.render.resolution_x = scene.render.resolution_y = 4
    active_camera()
    scene.render.filepath = str(live.takes / "image_")
    bpy.utils.register_class(Recorder)
    try:
        scene.render.engine = Recorder.bl_idname
        bpy.ops.render.render(animation=True)
    finally:
        bpy.utils.unregister_class(Recorder)
    for number in (1, 2, 3):
        wanted = flame_forward(live.own.model, live.own.shape, live.frames[number])
        assert_allclose(rendered[number], wanted, atol=TOLERANCE_M)


def test_record_with_a_calibrated_face(live):
    """Catches a take of something else, with the resting face, not kept, or lost with Esc."""
    ops.drive_live()
    live.send({"jawOpen": 0.2}, 0)
    ops.calibrate_live()
    bpy.context.scene.frame_set(10)
    bpy.context.scene.render.fps = 30
    ops.record_live()
    rows = [{"jawOpen": 0.2 + 0.08 * number, "mouthPucker": 0.05 * number} for number in range(9)]
    for number, row in enumerate(rows):
        live.send(row, 100 + number)
    shown = mesh()
    ops.record_live()
    take = read_performance(live.takes / "take_001.csv")
    assert len(take.times) == 9
    assert_allclose(take.times, np.arange(9) / 60, atol=1e-5)
    assert take.weights[0].max() == pytest.approx(0, abs=1e-6)
    assert_allclose(mesh(), shown, atol=TOLERANCE_M)  # still live
    ops.stop_live()
    bpy.context.scene.frame_set(14)  # 8/60 s after frame 10
    assert_allclose(mesh(), shown, atol=TOLERANCE_M)
    bpy.context.scene.frame_set(10)  # at rest, as the head itself was recorded
    quiet = exchanged_neutral(live.map.frames(take), None, quiet_neutral(live.frames))[0]
    quiet_mesh = flame_forward(live.own.model, live.own.shape, quiet)
    assert_allclose(mesh(), quiet_mesh, atol=TOLERANCE_M)
    ops.drive_live()
    ops.record_live()
    for number in range(3):
        live.send({"jawOpen": 0.3 * number}, number)
    ops.stop_live()
    assert (live.takes / "take_002.csv").is_file()


def record(live, faces=60):
    """Begin to record, and receive some faces."""
    if live.sessions.session() is None:
        ops.drive_live()
    ops.record_live()
    for number in range(faces):
        live.send({"jawOpen": 0.5}, number)


def taken(folder):
    """Faces of each take in the folder."""
    return [len(read_performance(path).times) for path in sorted(folder.glob("*.csv"))]


@pytest.mark.parametrize("end", ["stop_live", "record_live"])
def test_a_take_that_cannot_be_written_is_not_lost(live, tmp_path, end):
    """Catches a recording that is forgotten where its folder cannot be made."""
    (tmp_path / "file").write_text("")
    live.settings.takes = str(tmp_path / "file/takes")
    record(live)
    with failure(r"file/takes: .*; the recording goes on"):
        getattr(ops, end)()
    live.settings.takes = str(live.takes)
    getattr(ops, end)()
    assert taken(live.takes) == [60]
    assert rig_of(panel().head).animation_data.action.name.endswith("take_001")


def test_a_take_follows_new_names_and_its_own_head(live, tmp_path):
    """Catches a take that is lost where scene or head is renamed, or that another head gets."""
    panel().drive.takes = str(live.takes)
    record(live, 30)
    bpy.context.scene.name = "Shot 12"
    panel().head.name = "Anna"
    for number in range(30, 60):
        assert live.send({"jawOpen": 0.5}, number) is not None
    ops.stop_live()
    assert taken(live.takes) == [60]
    anna = panel().head
    assert rig_of(anna).animation_data.action.name.endswith("take_001")
    record(live)
    (tmp_path / "ben").mkdir()
    import_small_head(tmp_path / "ben", expr=np.zeros((5, 10)))
    assert panel().head != anna
    with failure(r"Recorded .*take_002.csv, but it was not applied"):
        ops.stop_live()
    assert taken(live.takes) == [60, 60]
    assert "take_002" not in rig_of(panel().head).animation_data.action.name


@pytest.mark.parametrize("end", ["head", "scene", "file", "unsaved", "disabled", "error"])
def test_a_take_is_kept_however_driving_ends(live, extension, tmp_path, monkeypatch, capsys, end):
    """Catches a take that is lost, or kept nobody knows where, and a socket that stays open, as
    head or scene is removed, a file opened, the extension disabled, as when Blender quits, or a
    step fails."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    if end == "unsaved":  # where Blender's own folder of temporary files would go with it
        live.settings.takes = "//stga_takes"
    record(live)
    running = live.sessions.session()
    if end == "head":
        bpy.data.objects.remove(panel().head)
    elif end == "scene":
        driven = bpy.context.scene
        bpy.context.window_manager.windows[0].scene = bpy.data.scenes.new("other")
        bpy.data.scenes.remove(driven)
    elif end in ("file", "unsaved"):
        bpy.ops.wm.read_homefile(use_empty=True)
    elif end == "disabled":
        extension.unregister()
        extension.register()
    elif end == "error":
        monkeypatch.setattr(running.receiver, "read", lambda: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            running.tick()
        running.close()  # as the timer does
    if live.sessions.session() is not None:
        assert running.tick() is None
    assert live.sessions.session() is None
    assert running.receiver._socket.fileno() == -1
    folder = tmp_path / "stga_takes" if end in ("scene", "unsaved") else live.takes
    assert taken(folder) == [60]
    said = f"{folder}/take_001.csv"
    assert capsys.readouterr().out.count(said) == 1
    if end != "disabled":
        assert said in bpy.context.window_manager.stga_message


def test_a_recording_is_a_step_to_undo(live):
    """Catches Stop after a recording whose action undo cannot take back, or only with more."""
    bpy.ops.ed.undo_push(message="before")
    panel().drive.strength = 0.5
    bpy.ops.ed.undo_push(message="strength")
    actions = sorted(bpy.data.actions.keys())
    record(live)
    ops.stop_live("EXEC_DEFAULT", True)
    assert sorted(bpy.data.actions.keys()) != actions
    bpy.ops.ed.undo()
    assert sorted(bpy.data.actions.keys()) == actions
    assert panel().drive.strength == 0.5


def test_sliders_that_are_moved_meanwhile(live):
    """Catches components by place in Blender's list of shape keys, a session that ends where one is
    added, and sliders of others that are held."""
    head = panel().head
    keys = head.data.shape_keys.key_blocks

    def move(name, way):
        head.active_shape_key_index = keys.find(name)
        with bpy.context.temp_override(object=head):
            bpy.ops.object.shape_key_move(type=way)

    move("expr_002", "BOTTOM")
    ops.drive_live()
    assert live.send(half(0), 0, head=TURN) is not None
    assert_shows(live, half(0))
    move("expr_005", "UP")
    head.shape_key_add(name="wrinkle", from_mix=False).value = 0.7
    assert live.send(half(1), 1, head=TURN) is not None
    assert_shows(live, half(1))
    assert keys["wrinkle"].value == pytest.approx(0.7)
    head.shape_key_remove(keys["expr_003"])
    assert live.send({"jawOpen": 0.5}, 2) is not None
    row = np.array([[0.5 * (name == "jawOpen") for name in ARKIT_SHAPES]])
    wanted = live.map.parameters(row)[0]
    for component in (2, 4, 5, 9):
        value = keys[f"expr_{component:03d}"].value
        assert value == pytest.approx(wanted[component], abs=1e-6)
    ops.stop_live()
    assert keys["wrinkle"].value == pytest.approx(0.7)


def test_the_trained_range(live):
    """Catches a meter that says inside where nobody trained, and poses not led back."""
    bpy.context.scene.frame_set(2)
    ops.measure_range()
    from stga_addon.scene.rig.motion import outside_now, stored_range

    head = panel().head
    rig = rig_of(panel().head)
    trained = stored_range(head)
    assert_allclose(trained.middle["jaw"][0], 0.1, atol=0.01)
    assert outside_now(head, rig, trained)["jaw"] == 0
    ops.drive_live()
    live.send({"jawOpen": 1.0}, 0)
    bpy.context.view_layer.update()
    open_jaw = float(live.map.jaw[ARKIT_SHAPES.index("jawOpen"), 0])
    assert outside_now(head, rig, trained)["jaw"] == pytest.approx(
        (open_jaw - 0.1) / trained.width["jaw"][0] - 1, rel=0.1
    )
    live.settings.stay_trained = 1.0
    live.send({"jawOpen": 1.0}, 1)
    assert outside_now(head, rig, trained)["jaw"] <= 0.25


def test_another_address_needs_online_access(live):
    """Catches packets from the network although Blender's preferences forbid it."""
    if bpy.app.online_access:
        pytest.skip("online access is allowed here")
    live.settings.address = "0.0.0.0"
    with failure("online access is off"):
        ops.drive_live()
    live.settings.address = "127.0.0.1"
    live.settings.source = "facial_mocap"
    live.settings.phone = "192.168.0.7"
    with failure("online access is off"):
        ops.drive_live()


def test_a_minute_without_growth(live):
    """Catches memory that grows with packets, senders or noise, and ticks that grow slower."""
    ops.drive_live()
    noise = np.random.default_rng(0)
    rows = [half(number) for number in range(10)]

    def minute(first):
        for number in range(600):
            live.send(rows[number % 10], first + number, subject="A" if number % 7 else "B")
            other = wire.live_link_face({}, number, subject=str(first + number))
            for data in (noise.bytes(40), other):
                live.sessions.session().stream.receive(f"1.2.3.{number}", data, number / 60)

    minute(0)
    gc.collect()
    tracemalloc.start()
    minute(1000)
    gc.collect()
    before = tracemalloc.get_traced_memory()[0]
    minute(2000)
    gc.collect()
    after = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    assert after - before < 20_000
