"""Runs inside a Blender with a window, started by test_newcomer.py: the first two hours.

`blender --python newcomer_script.py -- FOLDER [STEP...]`: reads FOLDER/flame.npz and
FOLDER/own.npz, a head of FLAME, FOLDER/demo, a capture, and FOLDER/anna.mp4, a video of a face;
writes FOLDER/result.json with what was seen, and pictures.
"""

import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import bpy
import numpy as np
from mathutils import Quaternion, Vector

sys.path.insert(0, str(Path(__file__).parent))

import drawn_panels
import in_window
from in_window import ARGUMENTS, chosen, extension, in_viewport, module, play, seen, viewport

FOLDER = Path(ARGUMENTS[0])
FIRST = FOLDER / "first.blend"
NECK_ANGLE = 0.3
MOUTH = 0.6
MINUTES = 0.1
FRONT = Quaternion((1.0, 0.0, 0.0), np.pi / 2)
DISTANCE_M = 0.7
"""How the viewport looks at a head."""
PATIENCE_S = 1500.0
"""With one step, such as a training whose kernels are still to be compiled."""
PORT = 21112
DRIVEN_S = 5.0
RATE = 60
PACKETS = 10_000
IMAGE_PX = 160
SAMPLES = 2
OUTSIDE = ("wm.path_open", "wm.save_mainfile")
"""Buttons that leave Blender, or the file."""
STARTED = time.monotonic()
monitor = module("operators.monitor")
kinds = module("stga_addon.jobs.table").Kind
panels = module("ui.panel").CLASSES
seen["time left"] = {}
for name in ("pressed", "clicks", "messages", "undo", "cut", "texts", "images", "seconds"):
    seen[name] = {}


def shot(name):
    """A picture of the window, and the texts in its panels that do not fit."""
    in_window.picture(FOLDER / f"{name}.png")
    cut = drawn_panels.cut_texts() if hasattr(bpy.types.Scene, "stga") else {}
    seen["cut"] |= {f"{name}, {what}": widths for what, widths in cut.items()}


def click(name, action, /, *how, **options):
    """Do what a click does, and draw the window; notes for how long both hold Blender up, in
    seconds of processor time of its thread, without what a window costs in which nothing changes,
    and by the clock; or its message."""
    begin = time.perf_counter()
    cpu = time.thread_time()
    try:
        with in_viewport():
            return action(*how, **options)
    except RuntimeError as error:
        seen["messages"][name] = str(error).strip().removeprefix("Error: ")
        return {"message"}
    finally:
        done = time.thread_time()
        bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=1)
        shown = time.thread_time()
        wall = time.perf_counter() - begin
        bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=1)
        drawing = max(0.0, 2 * shown - done - time.thread_time())
        seen["clicks"][name] = [round(value, 3) for value in (done - cpu, drawing, wall)]


def opened(file):
    """Open it in the window as it is, with the head in front and the sidebar; what to wait for."""
    bpy.ops.wm.open_mainfile(filepath=str(file), load_ui=False)
    space = viewport()[1].spaces.active
    with in_viewport():  # without, Blender 5.2 crashes
        space.show_region_ui = True
    view = space.region_3d
    view.view_perspective = "PERSP"
    view.view_location = Vector()
    view.view_rotation = FRONT
    view.view_distance = DISTANCE_M
    if extension not in bpy.context.preferences.addons:
        return 0.3
    open_sidebar = module("stga_addon.scene.avatar_scene").open_sidebar
    return lambda: open_sidebar("STGA", [viewport()[0].screen])


def show_only(root=""):
    """Let the sidebar show one panel with those below it, or all of them, none folded: Blender
    remembers for good how it first shows one."""
    for panel in reversed(panels):
        if panel.is_registered:
            bpy.utils.unregister_class(panel)
    for panel in panels:
        if "DEFAULT_CLOSED" in getattr(panel, "bl_options", ()):
            panel.bl_options = panel.bl_options - {"DEFAULT_CLOSED"}
        family = panel.bl_idname, getattr(panel, "bl_parent_id", ""), ""
        if root in family or not issubclass(panel, bpy.types.Panel):
            bpy.utils.register_class(panel)


def panels_unfolded(state):
    """A picture of each panel, and the texts that do not fit."""
    open_sidebar = module("stga_addon.scene.avatar_scene").open_sidebar
    show_only()
    yield lambda: open_sidebar("STGA", [viewport()[0].screen])
    for panel in panels:
        if hasattr(panel, "bl_category") and not hasattr(panel, "bl_parent_id"):
            show_only(panel.bl_idname)
            yield 0.3
            shot(f"{state} {panel.bl_label}")
    show_only()
    yield 0.3
    for name, layout in drawn_panels.drawn().items():
        leaves = [leaf for leaf in layout.leaves if leaf.kind != "label"]
        seen["texts"] |= {f"{name}: {leaf.text}": leaf.kind for leaf in leaves}


RUN_IN_WORK = "training_run"  # noted when a job's first report arrives, whatever is undone


def digest():
    """What undo is to bring back."""
    scene = bpy.context.scene
    found = {"frame": scene.frame_current, "engine": scene.render.engine}
    for owner in (chosen(), scene.stga_lighting):
        names = {*owner.bl_rna.properties.keys()} - {"rna_type", "name", RUN_IN_WORK}
        found |= {name: getattr(owner, name) for name in names}
    plain = bool | int | float | str
    found = {name: what for name, what in found.items() if isinstance(what, plain)}
    for thing in scene.objects:
        keys = getattr(thing.data, "shape_keys", None)
        found[thing.name] = str(
            [
                (
                    thing.hide_get(),
                    thing.hide_viewport,
                    thing.hide_render,
                    thing.mode,
                    len(thing.vertex_groups),
                ),
                [*map(tuple, thing.matrix_world)],
                [round(key.value, 5) for key in keys.key_blocks] if keys else [],
                getattr(getattr(thing.animation_data, "action", None), "name", ""),
            ]
        )
    return found


def running():
    return [kind for kind in kinds if monitor.state_of(bpy.context.scene, kind).is_running]


def browser():
    """The window and area of a file browser that is open."""
    windows = bpy.context.window_manager.windows
    found = [(window, area) for window in windows for area in window.screen.areas]
    return next((pair for pair in found if pair[1].type == "FILE_BROWSER"), None)


def press(state):
    """Press every button to be seen, and undo, close or cancel what it does."""
    for what, (name, options) in drawn_panels.buttons().items():
        group, function = name.split(".")
        operator = getattr(getattr(bpy.ops, group), function)
        label = f"{state}, {what}"
        with in_viewport():
            if name in OUTSIDE or not operator.poll():
                seen["pressed"].setdefault(what, "gray")
                continue
            bpy.ops.ed.undo_push(message="before")
        before = digest()
        seen["pressed"][what] = min(click(label, operator, "INVOKE_DEFAULT", True, **options))
        yield 0.2
        if browser():
            seen["pressed"][what] = "browser"
            window, area = browser()
            seen.setdefault("proposed", {})[what] = area.spaces.active.params.filename
            with bpy.context.temp_override(window=window, area=area, region=area.regions[0]):
                bpy.ops.file.cancel()
            yield lambda: browser() is None
        elif name == "preferences.addon_show":
            with bpy.context.temp_override(window=bpy.context.window_manager.windows[-1]):
                bpy.ops.wm.window_close()
        elif running():
            seen["pressed"][what] = "worker"
            yield from stop_workers()
        elif seen["pressed"][what] == "RUNNING_MODAL":
            shot(f"{state} dialog {what.replace(': ', ' ').replace('/', ' ')}")
            subprocess.run(["xdotool", "key", "Escape"], check=True)
        else:
            if name == "stga.drive_live":
                click(f"{state}, Stop", bpy.ops.stga.stop_live)
            with in_viewport():
                bpy.ops.screen.animation_cancel()
                if "UNDO" not in operator.bl_options:
                    bpy.ops.ed.undo_push(message="after")
                bpy.ops.ed.undo()
            after = digest()
            changed = [name for name in before if before[name] != after.get(name)]
            if changed or len(after) != len(before):
                seen["undo"][label] = [[name, before[name], after.get(name)] for name in changed]
        viewport()[1].spaces.active.shading.type = "SOLID"  # undo leaves it, and others take long
        yield 0.2


def stop_workers():
    for kind in running():
        state = lambda kind=kind: monitor.state_of(bpy.context.scene, kind)  # noqa: E731
        with in_viewport():
            bpy.ops.stga.cancel(request=kind)
        yield lambda state=state: not state().is_running and state().loading is None
        if state().can_be_dismissed:
            with in_viewport():
                bpy.ops.stga.dismiss(request=kind)


def fresh():
    """Every panel and every button in a file without a head."""
    yield from panels_unfolded("fresh")
    yield from press("fresh")
    bpy.ops.wm.read_homefile(app_template="")  # the panels in their order
    yield 0.3


def open_demo():
    click("Open Demo Capture", bpy.ops.stga.open_demo, "INVOKE_DEFAULT", True)
    yield lambda: viewport("UI")[2].active_panel_category == "STGA"
    shot("demo")


def misunderstand():
    """Train into a folder that a file never saved does not have."""
    click("Train without a folder", bpy.ops.stga.train, directory="//run")
    seen["error in the panel"] = bpy.context.window_manager.stga_message
    yield 0.5  # while the panel unfolds
    shot("error")


def training():
    return monitor.state_of(bpy.context.scene, kinds.TRAINING)


def once(what, is_over, kind=kinds.TRAINING):
    """What waits for the end of something in a training, and notes the clock in the panel."""
    begin = time.monotonic()
    noted = seen["time left"].setdefault(what, [])

    def wait():
        status = monitor.state_of(bpy.context.scene, kind).snapshot.status
        figures = dict(status.figures)
        told = [status.message, figures.get("left_s"), status.progress, "longer" in figures]
        if not noted or noted[-1][1:] != told:
            noted.append([round(time.monotonic() - begin, 1), *told])
        return is_over()

    return wait


def train():
    begin = time.monotonic()
    settings = {"directory": chosen().run_folder, "minutes": MINUTES}
    click("Train", bpy.ops.stga.train, **settings)
    yield once("Train", lambda: chosen().splats is not None)
    seen["seconds"]["to the preview"] = round(time.monotonic() - begin, 2)
    yield 0.5
    shot("preview")
    yield once("Train", lambda: chosen().result_shown)
    seen["seconds"]["to the avatar"] = round(time.monotonic() - begin, 2)
    yield 0.5
    shot("trained")
    train_panel = drawn_panels.drawn()["3 Train"].text
    seen["train panel"] = [part for part in ("Quality", "More") if part in train_panel]


def pose():
    click("Pose the Head", bpy.ops.stga.pose_head)
    yield 0.2
    neck = bpy.context.view_layer.objects.active.pose.bones["neck"]
    side = neck.bone.matrix_local.to_3x3().inverted() @ Vector((1.0, 0.0, 0.0))
    neck.rotation_quaternion = Quaternion(side, NECK_ANGLE)
    mouth = chosen().head.data.shape_keys.key_blocks["jawOpen"]
    click("Open Mouth", setattr, mouth, "value", MOUTH)
    yield 0.2
    shot("posed")
    click("Done Posing", bpy.ops.stga.pose_head)
    mouth.value = 0.0
    bpy.context.scene.frame_set(bpy.context.scene.frame_current)  # the neck, which has no keyframe
    bpy.ops.wm.save_as_mainfile(filepath=str(FIRST))


def packet(number, opening):
    """What a phone sends with Live Link Face: a mouth that opens, 0 to 1, and a smile."""
    values = {"jawOpen": opening, "mouthSmileLeft": 0.5, "mouthSmileRight": 0.5}
    names = module("stga_addon.driving.live.decoders").PACKET_SHAPES
    row = [values.get(name, 0.0) for name in names] + [0.0] * 9
    text = b"".join(struct.pack(">i", len(part)) + part for part in (b"DEVICE", b"phone"))
    end = struct.pack(">ifii", number, 0.0, 60, 1) + struct.pack(">B61f", 61, *row)
    return b"\x06" + text + end


def corners():
    """(V, 3) vertices of the head as it is posed."""
    return np.array(module("stga_addon.scene.arrays").evaluated_vertices(chosen().head))


def drive(head):
    """Drive the head by a phone, press the button that there is meanwhile, and stop by Esc."""
    resting = corners()
    ended = threading.Event()
    counted = {"poses": 0, "draws": 0}

    def send():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as phone:
            for number in range(PACKETS):
                phone.sendto(packet(number, number % RATE / RATE), ("127.0.0.1", PORT))
                if ended.wait(1 / RATE):
                    return

    def count(what, *_):
        counted[what] += 1

    chosen().drive.port = PORT
    click(f"Drive Live, {head}", bpy.ops.stga.drive_live)
    session = module("operators.drive").session()
    space = bpy.types.SpaceView3D
    show = session.show_again
    session.show_again = lambda: (count("poses"), show())
    handle = space.draw_handler_add(count, ("draws",), "WINDOW", "POST_PIXEL")
    threading.Thread(target=send, daemon=True).start()
    begin = time.monotonic()
    yield lambda: counted["poses"] > 2 and time.monotonic() - begin > DRIVEN_S
    rates = [number / (time.monotonic() - begin) for number in counted.values()]
    moved = float(np.abs(corners() - resting).max())
    space.draw_handler_remove(handle, "WINDOW")
    ended.set()
    click(f"Set Neutral, {head}", bpy.ops.stga.calibrate_live)
    shot(f"driven {head}")
    point_at_the_head()
    yield 0.5
    subprocess.run(["xdotool", "key", "Escape"], check=True)
    yield lambda: module("operators.drive").session() is None
    left = float(np.abs(corners() - resting).max())
    seen.setdefault("driven", {})[head] = [moved, left, *rates]


def live():
    """Drive the demo's head, and one of FLAME, by a phone."""
    yield from drive("demo")
    bpy.ops.wm.read_homefile(app_template="")
    yield 0.3
    files = {name: str(FOLDER / f"{name}.npz") for name in ("own", "flame")}
    click("FLAME Motion", bpy.ops.stga.import_motion, filepath=files["own"], flame=files["flame"])
    yield 1.0
    yield from drive("FLAME")
    yield opened(FIRST)


def display():
    shading = viewport()[1].spaces.active.shading
    lighting = bpy.context.scene.stga_lighting
    seen["shading"] = {}
    modes = bpy.ops.stga.choose_display.get_rna_type().properties["display"].enum_items
    for mode in sorted(modes.keys(), key=lambda mode: mode == "As Trained"):
        shading.type = "SOLID"
        click(f"Display {mode}", bpy.ops.stga.choose_display, display=mode)
        seen["shading"][mode] = shading.type
        yield 2.0 if shading.type == "MATERIAL" else 0.2  # whose shaders are compiled at first
        shot(f"display {mode}")
    shading.type = "SOLID"
    for mode in ("scene", "mix", "recorded"):
        click(f"Lighting {mode}", setattr, lighting, "mode", mode)
        seen["exposure"] = lighting.exposure
        yield 0.2
        shot(f"light {mode}")


def pressed():
    """Every panel and every button in the demo's file."""
    yield opened(FIRST)
    yield from panels_unfolded("demo")
    yield from press("demo")
    seen["left"] = chosen().splats is not None


def select_only(*things):
    for thing in bpy.context.selected_objects:
        thing.select_set(False)
    for thing in things:
        thing.hide_viewport = False
        thing.hide_set(False)
        thing.select_set(True)
        bpy.context.view_layer.objects.active = thing


def duplicate():
    """Duplicate the splats, and the whole avatar; move the copy aside, and undo."""
    yield opened(FIRST)
    seen["duplicates undone"] = {}
    names = {*bpy.data.objects.keys()}
    for what, things in (("splats", ()), ("avatar", (chosen().head, chosen().head.parent))):
        with in_viewport():
            select_only(*things, chosen().splats)
            bpy.ops.ed.undo_push(message="before")
        click(f"Duplicate {what}", bpy.ops.object.duplicate)
        for made in {*bpy.data.objects.keys()} - names:
            if bpy.data.objects[made].parent in (None, chosen().head.parent):
                bpy.data.objects[made].location.x += 0.3
        yield 0.3
        shot(f"duplicate {what}")
        with in_viewport():
            bpy.ops.ed.undo_push(message="after")
            bpy.ops.ed.undo()
            bpy.ops.ed.undo()
        seen["duplicates undone"][what] = {*bpy.data.objects.keys()} == names
        yield 0.2


def append():
    yield opened(FIRST)
    name = chosen().splats.name
    bpy.ops.wm.read_homefile(app_template="")
    yield 0.2
    click("Append", bpy.ops.wm.append, directory=f"{FIRST}/Object/", filename=name)
    seen["appended"] = chosen().splats == bpy.data.objects[name]
    yield 0.3
    shot("appended")
    yield from panels_unfolded("appended")


def delete():
    """Delete the splats, then the head; undo brings them back."""
    yield opened(FIRST)
    names = {*bpy.data.objects.keys()}
    for what, thing in (("splats", chosen().splats), ("head", chosen().head)):
        with in_viewport():
            select_only(thing)
            bpy.ops.ed.undo_push(message="before")
        click(f"Delete {what}", bpy.ops.object.delete, "EXEC_DEFAULT", True)
        yield lambda what=what: getattr(chosen(), what) is None
        yield from panels_unfolded(f"without {what}")
    with in_viewport():
        bpy.ops.ed.undo()
        bpy.ops.ed.undo()
    seen["deletion undone"] = {*bpy.data.objects.keys()} == names


def disable():
    """Disable and enable the extension with an avatar in the scene."""
    yield opened(FIRST)
    before = digest()
    for name in ("disable", "enable"):
        click(name, getattr(bpy.ops.preferences, f"addon_{name}"), module=extension)
        yield 0.5
        shot(f"{name}d")
    after = digest()
    seen["kept"] = [name for name in before if before[name] != after.get(name)]


def render():
    """An image, and a video of two frames, with each engine."""
    yield opened(FIRST)
    scene = bpy.context.scene
    settings = bpy.context.scene.render
    click("Preview for EEVEE/Cycles", bpy.ops.stga.preview_images)
    yield 2.0
    shot("preview of images")
    bpy.context.preferences.view.render_display_type = "NONE"
    settings.resolution_y = IMAGE_PX * settings.resolution_y // settings.resolution_x
    settings.resolution_x = IMAGE_PX
    scene.frame_end = scene.frame_start + 1
    scene.cycles.samples = scene.eevee.taa_render_samples = SAMPLES
    scene.cycles.use_denoising = False  # which not every build can
    complete = []
    note = lambda *_: complete.append("")  # noqa: E731
    bpy.app.handlers.render_complete.append(note)
    eevee = "BLENDER_EEVEE_NEXT" if bpy.app.version < (5, 0) else "BLENDER_EEVEE"
    for engine in (module("stga_addon.scene.render.engine").ENGINE, "CYCLES", eevee):
        settings.engine = engine
        for kind in ("PNG", "FFMPEG"):
            complete.clear()
            if hasattr(settings.image_settings, "media_type"):
                settings.image_settings.media_type = "VIDEO" if kind == "FFMPEG" else "IMAGE"
            settings.image_settings.file_format = kind
            settings.ffmpeg.format = "MPEG4"
            settings.filepath = str(FOLDER / f"{engine}.mp4")
            begin = time.monotonic()
            with in_viewport():
                bpy.ops.render.render("INVOKE_DEFAULT", animation=kind == "FFMPEG")
            yield lambda: complete and not bpy.app.is_job_running("RENDER")
            seen["seconds"][f"{engine} {kind}"] = round(time.monotonic() - begin, 2)
            if kind == "PNG":
                path = str(FOLDER / f"{engine}.png")
                bpy.data.images["Render Result"].save_render(path)
                pixels = np.array(bpy.data.images.load(path).pixels).reshape(-1, 4)
                seen["images"][engine] = [*map(float, pixels[:, :3].std(0))]
            else:
                seen["images"][f"{engine} video"] = Path(settings.filepath).stat().st_size
    bpy.app.handlers.render_complete.remove(note)


def drop():
    """Drop a video: the dialog of Avatar from Video."""
    video = str(FOLDER / "CYCLES.mp4")
    click("Drop", bpy.ops.stga.avatar_from_video, "INVOKE_DEFAULT", filepath=video)
    yield 0.3
    shot("dropped video")
    subprocess.run(["xdotool", "key", "Escape"], check=True)


# The second hour


def iterations():
    """Of the run in the panel's folder."""
    metrics = module("stga_addon.training.run.metrics_log")
    run = Path(bpy.path.abspath(chosen().run_folder))
    return metrics.read_metrics(run)[-1]["iteration"]


def train_more():
    bpy.ops.wm.read_homefile(app_template="")  # the panels in their order
    yield 0.3
    yield opened(FIRST)
    before = iterations()
    options = {"directory": chosen().run_folder, "minutes": MINUTES, "more": True}
    click("Train More", bpy.ops.stga.train, **options)
    yield once("Train More", lambda: chosen().result_shown and not training().is_running)
    seen["trained more"] = iterations() - before
    shot("trained more")


def occupied():
    """Train where a run is, and cancel at once: the next folder is taken, and nothing replaced."""
    yield opened(FIRST)
    run = Path(chosen().run_folder)
    avatar = chosen().avatar
    click("Train again", bpy.ops.stga.train, directory=str(run), minutes=MINUTES)
    seen["told"] = bpy.context.window_manager.stga_message
    seen["next folder"] = Path(chosen().run_folder).name.removeprefix(run.name)
    yield once("Train again", lambda: training().snapshot.status.figures.get("iteration", 0) > 1)
    shot("occupied")
    yield from stop_workers()
    yield 1.0
    seen["kept when cancelled"] = [chosen().avatar == avatar, len(shown())]
    shot("cancelled")


def shown():
    tags = module("stga_addon.scene.tags")
    return [each for each in bpy.context.scene.objects if each.get(tags.KIND) == tags.SPLATS]


def point_at_the_head():
    """Move the mouse to the middle of the viewport."""
    window, _, region = viewport()
    x = region.x + region.width // 2
    y = window.height - region.y - region.height // 2
    subprocess.run(["xdotool", "mousemove", str(x), str(y)], check=True)


def click_on_the_head():
    yield opened(FIRST)
    with in_viewport():
        bpy.ops.object.select_all(action="DESELECT")
    point_at_the_head()
    yield 0.5
    subprocess.run(["xdotool", "click", "1"], check=True)
    yield 1.0
    seen["clicked"] = [thing.type for thing in bpy.context.selected_objects]
    shot("clicked")


def left_out():
    """A mesh that the engine leaves out, and the button that shows it."""
    yield opened(FIRST)
    scene = bpy.context.scene
    engine = module("stga_addon.scene.render.engine").ENGINE
    shows_set = module("stga_addon.scene.render.film_set").shows_set
    with in_viewport():
        bpy.ops.mesh.primitive_cube_add(size=0.06, location=(0.05, -0.15, 0))
    scene.render.engine = engine
    yield 0.5
    shot("left out")
    said = drawn_panels.drawn()["Next Step"].text
    click("Show Set", bpy.ops.stga.choose_set, shown="SHOWN")
    seen["shows all"] = "leaves out other objects" in said and shows_set(scene)
    with in_viewport():
        bpy.ops.stga.choose_set(shown="LEFT_OUT")
    bpy.context.preferences.view.render_display_type = "WINDOW"
    with in_viewport():
        bpy.ops.render.render("INVOKE_DEFAULT")
    yield lambda: not bpy.app.is_job_running("RENDER")
    yield 1.0
    shot("F12 says what it leaves out")
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[-1]):
        bpy.ops.wm.window_close()


def without_addon():
    """Open the file where the add-on is not there."""
    bpy.ops.preferences.addon_disable(module=extension)
    yield opened(FIRST)
    yield 2.0  # for EEVEE's samples, of which the first shows thin strokes only in part
    notes = [thing for thing in bpy.context.scene.objects if thing.type == "FONT"]
    pictures = []
    for how in ("without the add-on", "nothing"):
        in_window.picture(FOLDER / f"{how}.png")
        pictures.append(np.array(bpy.data.images.load(str(FOLDER / f"{how}.png")).pixels))
        for note in notes:
            note.hide_set(True)
    seen["left without the add-on"] = float(np.abs(pictures[0] - pictures[1]).mean())
    bpy.ops.preferences.addon_enable(module=extension)
    yield opened(FIRST)


def quick_look():
    """A quick look at a video's avatar, until the head is there."""
    bpy.ops.wm.read_homefile(app_template="")
    yield 0.3
    video = str(FOLDER / "anna.mp4")
    click("Quick Look", bpy.ops.stga.avatar_from_video, filepath=video, quick=True)
    yield once("Quick Look", lambda: chosen().head is not None, kinds.AVATAR)
    yield 1.0
    shot("quick look")
    seen["quick look"] = chosen().head.parent.name
    yield from stop_workers()


def german():
    """Every panel in another language, which Blender translates where it knows the words."""
    yield opened(FIRST)
    view = bpy.context.preferences.view
    view.language = "de_DE"
    view.use_translate_interface = view.use_translate_tooltips = True
    yield from panels_unfolded("German")
    view.language = "en_US"


STEPS = """fresh open_demo misunderstand train pose live display pressed duplicate delete append
render drop disable train_more occupied click_on_the_head left_out without_addon german
quick_look"""


def steps():
    for name in ARGUMENTS[1:] or STEPS.split():
        print(f"STEP {name} {time.monotonic() - STARTED:.0f} s", flush=True)
        yield from globals()[name]() or ()
    seen["seconds"]["all"] = round(time.monotonic() - STARTED, 2)


play(steps(), FOLDER / "result.json", PATIENCE_S)
