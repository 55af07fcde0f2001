"""Capture, FLAME model, run and avatar of a head, wherever its file is moved, saved or brought."""

import shutil
from pathlib import Path

import bpy
import pytest
from capture.factory import write_flame_capture

from stga_addon.scene import tags
from stga_addon.scene.record import stored_path

from .session import bring, failure, open_file, ops, panel, save
from .test_operators import write_ball_run

pytestmark = pytest.mark.usefixtures("extension")
TAGS = (tags.CAPTURE, tags.FLAME_MODEL, tags.RUN, tags.AVATAR)


def make_project(folder, blend="shots/head.blend"):
    """A project whose .blend file lies beside capture, model and run, or in a folder there."""
    captured, model = write_flame_capture(folder / "capture")
    model = model.rename(folder / "flame.npz")
    ops.import_capture(directory=captured, flame=model)
    ops.show_avatar(filepath=write_ball_run(folder / "run") / "avatar.npz")
    panel().holds_run = False  # as in a file that an older version saved
    (folder / blend).parent.mkdir(exist_ok=True)
    save(folder / blend)
    return folder


def places(head):
    return [Path(bpy.path.abspath(stored_path(head, tag))) for tag in TAGS]


def expected(folder):
    return [folder / name for name in ("capture", "flame.npz", "run", "run/avatar.npz")]


def try_all(folder):
    """What reads capture or model ends without an error."""
    path = next((folder / "capture").rglob("*.npz"))
    ops.measure_range()
    ops.select(threshold=0.001)
    ops.apply_motion(filepath=path)
    ops.export_avatar(filepath=folder / "pair", format="gaussian-avatars")


@pytest.mark.parametrize("home", ["", "link"])
@pytest.mark.parametrize(("blend", "run"), [("head.blend", "//run"), ("shots/head.blend", None)])
def test_a_project_is_moved_as_a_whole(tmp_path, blend, run, home):
    """Catches "OLD/capture: is not a folder" in Apply Motion, Measure, Select and exports of
    motion; a panel that offers no more training of a run that is there; and another head, or a
    lost capture, where a folder above is a link of the file system."""
    (tmp_path / "link").symlink_to(tmp_path / "disk")
    (tmp_path / "disk").mkdir()
    new = tmp_path / home / "new"
    shutil.move(make_project(tmp_path / home / "old", blend), new)
    open_file(new / blend)
    capture, *others = expected(new)
    assert places(panel().head) == [capture.resolve(), *others]
    assert panel().run_folder == (run or str(new / "run"))
    assert panel().holds_run
    objects = set(bpy.data.objects.keys())
    ops.import_capture(directory=new / "capture", flame=new / "flame.npz")
    assert set(bpy.data.objects.keys()) == objects
    try_all(new)


@pytest.mark.parametrize("how", ["make local", "override"])
def test_a_linked_head_leaves_a_file_that_has_moved(tmp_path, how):
    """Catches the places of before the move in a head that was linked, and is now local or
    overridden."""
    project = make_project(tmp_path / "old")
    name = panel().head.users_collection[0].name
    shutil.move(project, tmp_path / "new")
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    save(tmp_path / "film.blend")
    bring(tmp_path / "new/shots/head.blend", "link", name)
    if how == "override":
        where = bpy.context.scene, bpy.context.view_layer
        bpy.data.collections[name].override_hierarchy_create(*where, do_fully_editable=True)
    for each in list(bpy.data.objects) if how == "make local" else ():
        each.make_local()
    own = [each for each in bpy.data.objects if tags.is_head(each) and each.library is None]
    name = own[0].name
    for _ in range(2):
        assert places(own[0]) == expected(tmp_path / "new")
        bpy.ops.wm.save_mainfile()
        open_file(tmp_path / "film.blend")
        own = [each for each in bpy.data.objects if each.name == name and each.library is None]


def test_a_capture_that_was_moved_away_is_found_by_importing_it(tmp_path):
    """Catches "is not a folder" without a remedy, and a second head beside the one that has lost
    its capture."""
    project = make_project(tmp_path / "project")
    head = panel().head
    objects = sorted(bpy.data.objects.keys())
    shutil.move(project / "capture", tmp_path / "archive")
    with failure("its capture is no longer at .*; Import Capture from where it is now"):
        ops.measure_range()
    other, model = write_flame_capture(tmp_path / "other", timesteps=(0, 1))
    ops.import_capture(directory=tmp_path / "archive", flame=project / "flame.npz")
    assert panel().head == head
    assert sorted(bpy.data.objects.keys()) == objects
    assert places(head) == [tmp_path / "archive", *expected(project)[1:]]
    ops.measure_range()
    shutil.move(tmp_path / "archive", project / "capture")
    ops.import_capture(directory=other, flame=model)
    assert panel().head != head


@pytest.mark.parametrize("how", ["save as", "copy", "alone"])
def test_a_file_leaves_its_project(tmp_path, how):
    """Catches paths that follow a .blend file where nothing was moved with it."""
    project = make_project(tmp_path / "project")
    other = tmp_path / "a/b/c/other.blend"
    other.parent.mkdir(parents=True)
    if how == "alone":
        shutil.move(bpy.data.filepath, other)
    else:
        save(other, copy=how == "copy")
    if how == "copy":
        assert places(panel().head) == expected(project)
    open_file(other)
    assert places(panel().head) == expected(project)
    try_all(project)


def test_a_save_that_failed_changes_nothing(tmp_path):
    """Catches the note for other programs left in the face, and paths of a file that was never
    written."""
    project = make_project(tmp_path / "project")
    names = set(bpy.data.objects.keys())
    (tmp_path / "taken.blend").mkdir()
    (tmp_path / "none").write_text("")
    for refused in (tmp_path / "none/head.blend", tmp_path / "taken.blend"):
        with failure("."):
            save(refused)
        assert set(bpy.data.objects.keys()) == names
        assert panel().head[tags.STORED_IN] == bpy.data.filepath
        assert (panel().run_folder, places(panel().head)) == (
            str(project / "run"),
            expected(project),
        )


@pytest.mark.parametrize("how", ["append", "link", "paste"])
@pytest.mark.parametrize("moved", [False, True])
def test_a_head_is_brought_into_another_file(tmp_path, how, moved):
    """Catches a capture, model or run lost, or taken from beside the other file."""
    project = make_project(tmp_path / "project")
    file = project / "shots/head.blend"
    if moved:
        shutil.move(project, tmp_path / "moved")
        project = tmp_path / "moved"
        file = project / "shots/head.blend"
    name = panel().head.users_collection[0].name
    if how == "paste":  # as Blender does it, whose operators need a window
        open_file(file)
        file = tmp_path / "copybuffer.blend"
        bpy.data.libraries.write(str(file), {panel().head.users_collection[0]})
    write_ball_run(tmp_path / "film/run")
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    save(tmp_path / "film/film.blend")
    bring(file, how, name)
    heads = [each for each in bpy.data.objects if each.get(tags.KIND) == tags.HEAD]
    assert [places(head) for head in heads] == [expected(project)]
    assert panel().head == heads[0]
    bpy.ops.wm.save_mainfile()
    open_file(tmp_path / "film/film.blend")
    assert places(panel().head) == expected(project)
    assert Path(bpy.path.abspath(panel().avatar)) == project / "run/avatar.npz"


@pytest.mark.parametrize("what", ["splats", "head", "collection"])
def test_append_shows_what_the_file_shows(tmp_path, what):
    """Catches what only supports a head as loose objects in the scene: a gray spike of a meter for
    the shape that bones are drawn by, and the neutral mesh over the splats."""
    project = make_project(tmp_path / "project")
    brought = {each.get(tags.KIND): each for each in bpy.data.objects}
    brought |= {"splats": panel().splats, "collection": panel().head.users_collection[0]}
    name = brought[what].name
    kept = {kind: each.name for kind, each in brought.items()}
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=True)
    kind = "Collection" if what == "collection" else "Object"
    within = f"{project / 'shots/head.blend'}/{kind}/"
    bpy.ops.wm.append(filepath=within + name, directory=within, filename=name)
    visible = {each.name for each in bpy.context.scene.objects if each.visible_get()}
    wanted = {name} if kind == "Object" else {kept["splats"]}
    others = {kept[each] for each in (tags.RIG, tags.ROOT) if each in kept}
    assert wanted <= visible <= wanted | others
