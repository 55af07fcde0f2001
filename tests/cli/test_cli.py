"""Commands of the command line, and their errors: one sentence, exit code 2."""

import json
import shutil
import subprocess
import sys
from argparse import ArgumentParser
from dataclasses import replace
from pathlib import Path
from time import process_time
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from capture.factory import (
    CY,
    edit,
    silhouette,
    write_avatar_of,
    write_flame_capture,
    write_mesh_capture,
)
from command_line import refused, stga
from export.web.web_data import read_web_data
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from pxr import Usd

from stga_addon.avatar.embedding import to_world
from stga_addon.avatar.file import read_avatar, write_avatar
from stga_addon.avatar.observed import observed_part
from stga_addon.capture.open import open_capture
from stga_addon.capture.selection import SelectionOptions
from stga_addon.cli import commands
from stga_addon.cli.commands import COMMANDS
from stga_addon.development.package import ROOT
from stga_addon.errors import StgaError
from stga_addon.export.ply import read_ply
from stga_addon.jobs.render import unique_names
from stga_addon.options import option_fields
from stga_addon.training.evaluate.forecast import kept_line
from stga_addon.training.run.checkpoint import read_checkpoint
from stga_addon.training.run.folder import read_run
from stga_addon.training.run.metrics_log import read_metrics

from .conftest import CAMERAS, TIMESTEPS


def pictures(folder):
    return sorted(p.name for p in folder.glob("[!.]*"))


def pixels(path):
    with Image.open(path) as image:
        assert image.mode == "RGB"
        return np.asarray(image)


# What each command does


def test_select(root, tmp_path, capsys):
    """Catches a threshold that is ignored, and masks or lines of another timestep."""
    out = tmp_path / "selection.npz"
    assert stga("select", root, "--threshold 0.0008 --out", out) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "threshold 0.8 mm, 320 triangles"
    assert [int(line.split()[0]) for line in lines[1:]] == list(TIMESTEPS)
    with np.load(out) as data:
        chosen = {int(name): data[name] for name in data.files}
    assert set(chosen) == set(TIMESTEPS)
    assert not chosen[0].any()
    mouth = open_capture(root).regions["mouth"]
    assert chosen[3][mouth].all()
    assert chosen[3].mean() < 0.5
    assert "mouth" in lines[3]
    assert stga("select", root, "--threshold 1") == 0
    assert all("0.0%" in line for line in capsys.readouterr().out.splitlines()[1:])


def test_train_and_eval(trained, root, capsys):
    """Catches options that do not reach the run, and figures of another split or training."""
    run = read_run(trained)
    assert run.capture == root.resolve()
    assert (run.settings.iterations, run.settings.seconds) == (10, None)
    assert run.settings.global_interval == 20
    assert run.settings.selection == SelectionOptions(threshold=0.005, zero_pose="all")
    assert len(read_avatar(trained / "avatar.npz").splats) >= 15 * 320
    for split, views in (("val", 2), ("test", 3), ("train", 4)):
        assert stga("eval", trained, "--split", split) == 0
        assert f"{split}: {views} views, PSNR " in capsys.readouterr().out
        quality = json.loads((trained / f"quality_{split}.json").read_text())
        assert quality["views"] == views
    kept = kept_line(read_metrics(trained), read_run(trained).settings)
    measured = json.loads((trained / "quality_val.json").read_text())["detail_difference"]
    assert measured == pytest.approx(kept["detail_difference"], rel=0.02)


def test_train_in_wall_time_and_resume(root, tmp_path):
    """Catches --budget ignored, and --resume that starts anew or goes beyond the budget."""
    out = tmp_path / "run"
    options = "--budget 0.2s --strategy gaussian-avatars"
    assert stga("train", root, "--out", out, options) == 0
    first = read_checkpoint(out)
    assert 0.2 <= first.elapsed_s < 1.5
    assert stga("train", root, "--out", out, options, "--resume") == 0
    again = read_checkpoint(out)
    assert (again.iteration, again.elapsed_s) == (first.iteration, first.elapsed_s)


def test_render_a_run_an_avatar_and_a_ply(trained, root, tmp_path):
    """Catches pictures that are missing, misnamed, upside down, or of another frame or mesh, and a
    PLY that needs a capture or differs."""
    ply = tmp_path / "frame.ply"
    assert stga("export", trained, "--format ply --timestep 1 --out", ply) == 0
    val = ["00000_02.png", "00001_02.png"]
    for name, split, names, source in (
        ("run", "val", val, [trained]),
        ("test", "test", [f"00003_{c:02d}.png" for c in CAMERAS], [trained]),
        ("avatar", "val", val, [trained / "avatar.npz", "--capture", root]),
        ("ply", "val", val, [ply]),
    ):
        cameras = root / f"transforms_{split}.json"
        assert stga("render", *source, "--cameras", cameras, "--out", tmp_path / name) == 0
        assert pictures(tmp_path / name) == names
    drawn = pixels(tmp_path / "run" / "00000_02.png")
    assert drawn.shape == (60, 40, 3)
    assert (drawn[0] == 255).all()
    # Ten steps from gray: the ball stands where its silhouette says, in something not white.
    dark = (drawn < 230).any(axis=2)
    assert np.mean(dark == silhouette()) > 0.9
    middle = np.average(np.arange(60), weights=dark.sum(axis=1))
    assert middle == pytest.approx(CY - 0.5, abs=1.5)
    for name in val:
        assert_array_equal(*(pixels(tmp_path / kind / name) for kind in ("run", "avatar")))
    right, baked = (pixels(tmp_path / kind / val[1]).astype(int) for kind in ("run", "ply"))
    assert np.abs(right - baked).max() <= 1


def test_names_of_a_long_capture():
    """Catches minutes before the first image of thousands, and two images with one name."""
    paths = [f"images/{n:05d}_{camera:02d}.png" for n in range(1000) for camera in range(16)]
    begin = process_time()
    assert unique_names(paths) == [Path(path).name for path in paths]
    assert process_time() - begin < 5
    names = ["a.png", "a_2.png", "a_2_2.png", "a_3.png"]
    assert unique_names(["a.png", "a.png", "a_2.png", "a.png"]) == names


def test_export_of_frames(trained, root, tmp_path, capsys):
    """Catches a PLY of another frame or in local coordinates, and a range cut in silence."""
    avatar = read_avatar(trained / "avatar.npz")
    capture = open_capture(root)
    meshes = {None: avatar.neutral, 3: capture.mesh(3)}
    for timestep, mesh in meshes.items():
        out = tmp_path / f"{timestep}.ply"
        chosen = "" if timestep is None else f"--timestep {timestep}"
        assert stga("export", trained, "--format ply --out", out, chosen) == 0
        expected = to_world(avatar.splats, avatar.frames(mesh))
        again = read_ply(out)
        assert_allclose(again.xyz, expected.xyz, atol=1e-6)
        assert_allclose(again.log_scale, expected.log_scale, atol=1e-5)
    posed, neutral = (read_ply(tmp_path / f"{name}.ply").xyz for name in ("3", "None"))
    assert np.abs(posed - neutral).max() > 0.002
    assert np.linalg.norm(neutral, axis=1).mean() == pytest.approx(0.1, abs=0.01)
    for span, said in (("1:999999", True), ("0:3", False), ("0:2", False)):
        words = f"--format ply-sequence --frames {span} --out"
        assert stga("export", trained, words, tmp_path / span[2:]) == 0
        message = f"--frames {span}: the capture has timesteps 0 to 3\n"
        assert (message in capsys.readouterr().out) == said
    files = sorted((tmp_path / "3").glob("*.ply"))
    assert [path.name for path in files] == ["00000.ply", "00001.ply", "00003.ply"]
    low = [read_ply(path).xyz[:, 1].min() for path in files]
    assert low[0] > low[1] > low[2]


def test_a_page_is_called_like_its_run(trained, tmp_path):
    """Catches a folder's name that is cut at a dot, as if it were a file's."""
    run = shutil.copytree(trained, tmp_path / "anna.v2")
    out = tmp_path / "page.glb"
    assert stga("export", run, "--format web --frames 0:0 --out", out) == 0
    assert read_web_data(out.read_bytes())[0]["title"] == "anna.v2"


@pytest.mark.parametrize(
    ("format", "name"), [("ply-sequence", "o"), ("ply-sequence", "/"), ("web", "o.html")]
)
def test_export_to_a_full_disk(trained, tmp_path, capsys, monkeypatch, format, name):
    """Catches a range that fills the disk, and a folder that has none above it."""
    monkeypatch.setattr("shutil.disk_usage", lambda folder: SimpleNamespace(free=1000))
    message = refused(capsys, "export", trained, "--format", format, "--out", tmp_path / name)
    assert "1.0 kB are free there" in message
    assert list(tmp_path.iterdir()) == []


def test_files_that_have_moved(tmp_path, capsys, trained, root):
    """Catches a run lost with its FLAME file's or capture's old place, or measured on another."""
    tracked, model = write_flame_capture(tmp_path / "flame")
    out = tmp_path / "run"
    pair = tmp_path / "pair"
    elsewhere = tmp_path / "elsewhere.npz"
    options = "--flame", model, "--iterations 2 --strategy gaussian-avatars"
    assert stga("train", tracked, "--out", out, *options) == 0
    assert stga("export", out, "--format gaussian-avatars --out", pair) == 0
    assert pictures(pair) == ["flame_param.npz", "point_cloud.ply"]
    with np.load(pair / "flame_param.npz") as data:
        assert len(data["expr"]) >= 3
    model.rename(elsewhere)
    assert "cannot be read" in refused(capsys, "eval", out)
    assert stga("eval", out, "--flame", elsewhere) == 0
    run = Path(shutil.copytree(trained, tmp_path / "copy"))
    moved = Path(shutil.copytree(root, tmp_path / "moved"))
    edit(run / "run.json", lambda document: document.update(capture=str(tmp_path / "gone")))
    assert "gone" in refused(capsys, "eval", run)
    assert stga("eval", run, "--capture", moved) == 0
    assert stga("eval", trained) == 0
    qualities = [(path / "quality_val.json").read_text() for path in (run, trained)]
    assert qualities[0] == qualities[1]
    val = moved / "transforms_val.json"
    edit(val, lambda document: document["frames"][0].update(fl_x=300.0))
    assert "other camera poses or intrinsics" in refused(capsys, "eval", run, "--capture", moved)


# Mistakes

NONSENSE_OPTIONS = [
    *(("train", "--iterations", value) for value in ("0", "1.5", "9" * 5000)),
    *(("train", "--budget", value) for value in ("0s", "soon", "9" * 400)),
    ("train", "--seed", "-1"),
    ("train", "--threshold", "1mm"),
    ("train", "--target-psnr", "nan"),
    *(("train", "--out", value) for value in ("", "a" * 300, "no/" + "a" * 300, "a\0b", "\ud800")),
    ("train", "--budget=5m --iterations", "5"),
    ("refine", "--growth", "101"),
    ("select", "--threshold", "inf"),
]


@pytest.mark.parametrize(
    ("command", "option", "value"), NONSENSE_OPTIONS, ids=lambda text: ascii(text)[:20]
)
def test_option_values_without_meaning(root, tmp_path, capsys, command, option, value):
    """Catches a traceback, a run of nothing or for ever, and one of two budgets ignored."""
    *others, name = option.split()
    out = [f"--out={tmp_path / 'run'}"] if name != "--out" else []
    with pytest.raises(SystemExit, match="2"):
        stga(command, root, *out, *others, f"{name}={value}")
    error = capsys.readouterr().err
    assert f"argument {name}: " in error
    assert len(error) < 3000
    assert list(tmp_path.iterdir()) == []


# The entry point


WITHOUT = """
import sys
sys.modules.update(dict.fromkeys(sys.argv.pop(1).split()))  # importing one of them fails
from stga_addon.cli.main import main
sys.exit(main(sys.argv[1:]))
"""
NUMPY_ALONE = "torch numba wgpu trimesh scipy PIL tqdm matplotlib platformdirs bpy"


def test_commands_need_few_packages(root, trained, tmp_path):
    """Catches an import that looking at a capture, selecting or exporting cannot do without, and a
    traceback where Blender, with numpy alone, lacks a package."""
    flame, model = write_flame_capture(tmp_path / "flame")
    ply = tmp_path / "a.ply"
    exported = f"export {trained}/avatar.npz --format ply --out {ply}"
    known = "162 vertices, 320 triangles", "40 x 60", "view-color"
    meshes = {
        suffix: write_mesh_capture(tmp_path / suffix, suffix=f".{suffix}")
        for suffix in ("ply", "stl")
    }
    unsized = write_mesh_capture(tmp_path / "unsized")
    for path in unsized.glob("transforms_*.json"):
        edit(path, lambda document: [entry.pop("w") for entry in document["frames"]])
    pillow = "frames[0].w: w and h are missing; to take them from the image needs Pillow"
    for missing, arguments, says in (
        ("torch numba wgpu", f"info {root}", known),
        (NUMPY_ALONE, f"select {flame} --flame {model}", ("320 triangles",)),
        (NUMPY_ALONE, f"select {meshes['ply']}", ("320 triangles",)),
        (NUMPY_ALONE, f"select {meshes['stl']}", "reading STL needs the Python package"),
        (NUMPY_ALONE, f"select {unsized}", pillow),
        (NUMPY_ALONE, exported, ()),
    ):
        command = [sys.executable, "-c", WITHOUT, missing, *arguments.split()]
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
        if isinstance(says, str):
            assert done.returncode == 2
            assert says in done.stderr
            continue
        assert (done.returncode, done.stderr) == (0, "")
        assert all(part in done.stdout for part in says)
    assert len(read_ply(ply)) == len(read_avatar(trained / "avatar.npz").splats)


def test_interruption_and_mistakes_have_their_codes(root, monkeypatch, capsys):
    """Catches a traceback after Ctrl-C, and a bug reported as the user's mistake; and
    the traceback of a library that cannot be loaded in little memory, or its crash or endless wait
    in less."""

    def fails_with(error):
        def run(options, head):
            raise error

        monkeypatch.setitem(commands.COMMANDS, "info", replace(commands.COMMANDS["info"], run=run))

    fails_with(KeyboardInterrupt())
    assert stga("info", root) == 130
    fails_with(StgaError("the sentence"))
    assert refused(capsys, "info", root) == "stga: the sentence"
    fails_with(StgaError("long " * 100_000 + "\n\ud800"))
    assert len(refused(capsys, "info", root)) < 1100
    fails_with(MemoryError())
    assert refused(capsys, "info", root) == "stga: 'info' needs more memory than there is"
    fails_with(RecursionError())
    assert "nested too deeply" in refused(capsys, "info", root)
    fails_with(RuntimeError("a bug"))
    with pytest.raises(RuntimeError, match="a bug"):
        stga("info", root)
    monkeypatch.setattr("stga_addon.cli.main.address_space_gb", lambda: 1.2)
    for kind in (ImportError, OSError, RuntimeError, SystemError, AttributeError):
        fails_with(kind("failed to map\nsegment"))
        assert stga("info", root) == 2
        sentence = capsys.readouterr().err.splitlines()[-1]
        assert "'info' failed within the 1.2 GB of addresses" in sentence
        assert sentence.endswith("(ulimit -v); expected 4 GB or no limit: 'failed to map segment'")
    monkeypatch.setattr("stga_addon.cli.main.address_space_gb", lambda: 0.9)
    assert "'info' is not started, because this process may have 0.9 GB" in refused(
        capsys, "info", root
    )


# In a process of its own


@pytest.mark.parametrize("content", ["[]", '{"capture": 5}', "{", None])
def test_damaged_folder_of_the_open_head(tmp_path, capsys, monkeypatch, content):
    """Catches a traceback for a folder in STGA_HEAD that is damaged, empty or missing."""
    if content is not None:
        (tmp_path / "head.json").write_text(content)
    monkeypatch.setenv("STGA_HEAD", str(tmp_path))
    assert "head.json" in refused(capsys, "select")


def test_refine_and_extend(trained, tmp_path, capsys, root):
    """Catches runs in another's folder, that end there, or say nothing of the gain."""
    runs = Path(shutil.copytree(trained, tmp_path / "anna"))
    assert stga("refine", runs, "--region mouth --frames 1-3 --iterations 6") == 0
    printed = capsys.readouterr().out
    assert "region: " in printed
    assert f"avatar: {tmp_path / 'anna_2' / 'avatar.npz'}" in printed
    assert stga("refine", tmp_path / "anna_2", "--region mouth --iterations 3 --growth 0.5") == 0
    assert read_checkpoint(tmp_path / "anna_3").iteration == 3
    assert stga("refine", tmp_path / "anna_3", "--resume") == 0
    assert stga("eval", tmp_path / "anna_3") == 0
    take = Path(shutil.copytree(root, tmp_path / "smile"))
    assert stga("extend", runs, take, "--iterations 6") == 0
    printed = capsys.readouterr().out
    assert "take 1: " in printed
    assert "take 2: " in printed
    out = tmp_path / "anna_4"
    assert stga("eval", out) == 0
    assert stga("refine", out, "--region mouth --iterations 3") == 0
    assert stga("extend", out, "--resume") == 0
    assert "is a take of this run already" in refused(capsys, "extend", out, take)


def test_names_that_a_terminal_would_obey(root, tmp_path, capsys):
    """Catches control characters of a capture's names that clear the screen, or write a title."""
    capture = shutil.copytree(root, tmp_path / "clear \x1b[2J")
    evil = "eyes\x1b]0;title\x07\nfolder\x9b2J"
    edit(capture / "regions.json", lambda document: document.update({evil: [0]}))
    for command in ("info", "select"):
        assert stga(command, capture) == 0
        printed = capsys.readouterr().out
        assert not set(printed) & set(map(chr, (*range(10), *range(11, 32), *range(127, 160))))
        assert "\nfolder" not in printed.removeprefix("folder")
    assert stga("info", capture) == 0
    assert r"eyes\x1b]0;title\x07\nfolder\x9b2J" in capsys.readouterr().out


def test_refinements_at_once_have_folders_of_their_own(trained, tmp_path, monkeypatch):
    """Catches two refinements that train into one folder, and a folder left of none."""
    shutil.copytree(trained, tmp_path / "run")
    command = f"refine {tmp_path}/run --region mouth --iterations 1"
    runs = []

    def meanwhile(request, *_):
        runs.append(request.run.name)
        if len(runs) < 3:
            assert stga(command) == 0

    monkeypatch.setattr("stga_addon.cli.commands.carry_out", meanwhile)
    assert stga(command) == 0
    assert runs == ["run_2", "run_3", "run_4"]
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_frames_cameras_and_selection_of_a_capture(tmp_path):
    """Catches frames, cameras or rates other than asked for, and a page that needs a capture."""
    capture = open_capture(write_mesh_capture(tmp_path / "capture"))
    avatar_file = write_avatar_of(capture, tmp_path / "anna.npz", order=2, sh_degree=1)
    first = capture.timesteps[1]
    last = capture.timesteps[-1]
    words = f"--format web --capture {capture.root} --frames {first}:{last} --fps 30 --out"
    assert stga("export", avatar_file, words, tmp_path / "a.glb") == 0
    header, arrays = read_web_data((tmp_path / "a.glb").read_bytes())
    frames = len(capture.timesteps) - 1
    assert (header["title"], header["fps"]) == ("anna", 30)
    assert len(arrays["pose"]) == len(arrays["selection"]) == frames
    cameras = {view.camera_index for views in capture.views.values() for view in views}
    assert {view["name"] for view in header["views"]} == {f"Camera {index}" for index in cameras}
    edit(tmp_path / "capture/transforms_train.json", lambda document: document.update(fps=60))
    words = f"--capture {capture.root} --out"
    assert stga("export", avatar_file, "--format web", words, tmp_path / "a.glb") == 0
    assert read_web_data((tmp_path / "a.glb").read_bytes())[0]["fps"] == 60
    assert stga("export", avatar_file, "--format web --out", tmp_path / "a.html") == 0
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert "<title>anna</title>" in text
    assert "{{" not in text.partition('<script type="module">')[0]
    assert stga("export", avatar_file, "--format usd", words, tmp_path / "a.usdc") == 0
    assert Usd.Stage.Open(str(tmp_path / "a.usdc")).GetTimeCodesPerSecond() == 60


def test_what_no_camera_saw_is_left_out(tmp_path, capsys):
    """Catches splats of unseen triangles in a file of any format, others lost or exchanged, also of
    the colors for linear light, and an avatar without the mark that is exported as a whole."""
    capture = open_capture(write_mesh_capture(tmp_path / "capture"))
    path = write_avatar_of(capture, tmp_path / "anna.npz", order=2)
    whole = read_avatar(path)
    out = tmp_path / "a.ply"
    message = refused(capsys, "export", path, "--format ply --filmed-only --out", out)
    assert "anna.npz: does not state what was filmed" in message
    assert not out.exists()
    unseen = np.arange(len(whole.faces)) % 3 == 0
    kept = ~unseen[whole.splats.face]
    logits = np.linspace(-3, 3, len(kept), dtype=np.float32)
    base = np.column_stack([whole.splats.sh[:, 0], logits])
    along = np.tile(np.float32([0, 0, -1]), (len(unseen), 1))
    marked = replace(whole, regions={"unseen": unseen}, linear_base=base)
    assert observed_part(path, replace(marked, filmed_along=along)).splats.sh_degree == 0
    write_avatar(path, marked)
    count = int(kept.sum())

    def written(format, name):
        file = tmp_path / name
        assert stga("export", path, "--format", format, "--filmed-only --out", file) == 0
        return file

    expected = to_world(whole.splats, whole.frames(whole.neutral)).rows(kept)
    assert_array_equal(np.float32(trimesh.load(written("ply", "a.ply")).vertices), expected.xyz)
    assert len(read_web_data(written("web", "b.glb").read_bytes())[1]["xyz"]) == count
    words = f"--format usd --filmed-only --capture {capture.root} --out"
    assert stga("export", path, words, tmp_path / "a.usdc") == 0
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    positions = stage.GetPrimAtPath("/Avatar/Splats").GetAttribute("positions")
    assert len(positions.Get(positions.GetTimeSamples()[0])) == count
    opacities = stage.GetPrimAtPath("/Avatar/Splats").GetAttribute("opacities").Get(0)
    assert_allclose(opacities, 1 / (1 + np.exp(-logits[kept])), atol=1e-5)


def test_what_is_left_of_flame_is_said(tmp_path, capsys):
    """Catches an export that does not say what of FLAME is in the page."""
    root, model = write_flame_capture(tmp_path / "flame")
    avatar = write_avatar_of(open_capture(root, model), tmp_path / "anna.npz", sh_degree=1)
    words = "export", avatar, "--format web --capture", root, "--flame", model
    assert stga(*words, "--motion-only --out", tmp_path / "a.glb") == 0
    said = "Contains the triangles and the posed meshes of a FLAME head: FLAME's licence"
    assert said in capsys.readouterr().out
    assert stga(*words, "--out", tmp_path / "a.glb") == 0
    said = "--motion-only leaves them out, but not the meshes of the take."
    assert said in capsys.readouterr().out


@pytest.mark.parametrize("name", COMMANDS)
def test_help_states_each_default_once(name):
    """Catches a default that `--help` hides, or two at once; 0 and folders as well."""
    parser = ArgumentParser()
    COMMANDS[name].add_arguments(parser, None)
    shown = {action.dest: str(action.help) for action in parser._actions}
    kinds = [item[0] if isinstance(item, tuple) else item for item in COMMANDS[name].options]
    for spec in (spec for kind in kinds for spec in option_fields(kind) if spec.name in shown):
        text = shown[spec.name]
        assert text.count("(default") <= 1
        assert " to extend" not in text
        if isinstance(spec.default, int | float | Path) and not isinstance(spec.default, bool):
            assert "default" in text, text


@pytest.mark.parametrize(
    ("name", "field"),
    [("refine", "region"), ("extend", "captures"), ("render", "out"), ("batch", "out")],
)
def test_help_says_what_is_required(name, field):
    """Catches an argument that `--help` shows as optional and the command refuses to do without."""
    parser = ArgumentParser()
    COMMANDS[name].add_arguments(parser, None)
    (text,) = (action.help for action in parser._actions if action.dest == field)
    assert "required" in str(text)
