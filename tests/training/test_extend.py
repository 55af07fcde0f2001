"""Extending a run by takes: what is learned, remembered, and resumed to the same bits."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from capture import factory
from numpy.testing import assert_allclose
from PIL import Image
from refusal import refusal

from stga_addon.avatar.file import read_avatar
from stga_addon.avatar.splats import SH_C0
from stga_addon.avatar.strain import TRAINED_RANGE
from stga_addon.capture.meshes import read_mesh
from stga_addon.capture.open import open_capture
from stga_addon.capture.takes import require_same_scale
from stga_addon.jobs.train import Extend, Train, prepare
from stga_addon.progress import ignore
from stga_addon.training.run import continuation
from stga_addon.training.run.checkpoint import read_checkpoint
from stga_addon.training.run.continuation import START_FRACTION
from stga_addon.training.run.folder import open_run, read_run
from stga_addon.training.run.metrics_log import read_metrics
from stga_addon.training.run.session import train_run
from stga_addon.training.schedule import learning_rates

from .toys import assert_same_run, quick_settings, run_of, stop_at

ITERATIONS = 15
CAP_PX = 8
"""Pixels above the ball's center from which the second take is yellow: some 4 cm."""


@pytest.fixture(scope="module")
def takes(tmp_path_factory):
    """Two takes of one ball; in the second one's images its upper part is yellow."""
    folder = tmp_path_factory.mktemp("takes")
    old = factory.write_mesh_capture(folder / "old", (0, 1, 3), range(4))
    new = Path(shutil.copytree(old, folder / "new"))
    top = factory.silhouette() & (np.arange(factory.HEIGHT)[:, None] < factory.CY - CAP_PX)
    for path in sorted((new / "images").rglob("*.png")):
        with Image.open(path) as image:
            changed = np.where(top[..., None], [255, 230, 0], np.asarray(image)).astype(np.uint8)
        Image.fromarray(changed).save(path)
    return old, new


@pytest.fixture(scope="module")
def parent(takes, tmp_path_factory):
    out = tmp_path_factory.mktemp("parent") / "run"
    capture = open_capture(takes[0])
    colors = ("strain_color",)
    run = run_of(capture, iterations=60, lattice=1, driven_offsets=colors, density_interval=0)
    train_run(capture, out, run)
    return out


def prepare_extension(parent, takes, growth=0.0, iterations=1):
    request = Extend(
        parent / "unused", parent, takes, growth=growth, iterations=iterations, device="cpu"
    )
    return prepare(request, ignore, lambda line: None)


def extend(parent, take, out, stop=None, growth=0.0, iterations=ITERATIONS):
    prepared = prepare_extension(parent, (take,), growth, iterations=iterations)

    train_run(prepared.capture, out, prepared.run, prepared.selection, report=stop_at(stop))
    return out


def test_the_run_remembers_its_takes(takes, parent, tmp_path):
    """Catches a new take that is lost, exchanged, not learned or hidden in a mean."""
    before = {path.name: path.read_bytes() for path in parent.iterdir()}
    moved = Path(shutil.copytree(takes[1], tmp_path / "new"))
    out = extend(parent, moved, tmp_path / "extended")
    assert {path.name: path.read_bytes() for path in parent.iterdir()} == before
    first, *_, last = read_metrics(out)
    assert first["iteration"] == 0
    assert last["psnr_take_2"] > first["psnr_take_2"] + 0.02
    assert last["psnr_take_1"] != last["psnr_take_2"]
    opened = open_run(out)
    assert opened.capture.timesteps == (0, 1, 3, 4, 5, 7)
    assert [take.start for take in opened.run.takes] == [4]
    assert (opened.run.continuation.first, opened.run.continuation.last) == (4, 7)
    with refusal("is a take of this run already"):
        prepare_extension(out, (moved,), iterations=1)
    again = prepare_extension(out, (takes[1],), iterations=1)
    assert [take.start for take in again.run.takes] == [4, 8]
    factory.edit(moved / "transforms_train.json", lambda document: document["frames"].pop(0))
    with refusal(r"was extended with .*new .* but it now has other images"):
        open_run(out)


def test_a_new_run_of_several_takes(takes, tmp_path):
    """Catches a take that a new run does not train, measures with another or forgets, and one that
    is resumed to other bits."""
    settings = quick_settings("global", iterations=16, lattice=1, effects=None)
    request = Train(tmp_path / "run", takes[0], settings, device="cpu", takes=(takes[1],))
    prepared = prepare(request, ignore, lambda line: None)
    for name, stop in (("whole", None), ("stopped", 7)):
        train_run(prepared.capture, tmp_path / name, prepared.run, report=stop_at(stop))
    opened = open_run(tmp_path / "stopped")
    assert (opened.run.continuation, opened.capture.timesteps) == (None, (0, 1, 3, 4, 5, 7))
    train_run(opened.capture, tmp_path / "stopped", opened.run, resume=True)
    assert_same_run(tmp_path / "stopped", tmp_path / "whole")
    last = read_metrics(tmp_path / "whole")[-1]
    assert last["psnr_take_1"] != last["psnr_take_2"]
    with refusal("is a take of this run already"):
        prepare(replace(request, takes=(takes[0],)), ignore, lambda line: None)


def painted(root, cameras, color):
    """A take of a ball of one color, trained from the first of two cameras."""
    factory.write_mesh_capture(root, (0, 1, 3), cameras)
    for path in sorted((root / "images").iterdir()):
        pixels = np.where(factory.silhouette()[..., None], color, 255).astype(np.uint8)
        Image.fromarray(pixels).save(path)
    return root


def test_a_take_of_the_back_replaces_what_was_plausible(tmp_path):
    """Catches a region of what no camera saw that stays as it was, and a back that stays what it
    was thought to be, beside a front that changes for it."""
    blue = np.array([60, 90, 160])
    orange = np.array([240, 140, 20])
    front, back = (
        painted(tmp_path / name, cameras, color)
        for name, cameras, color in (("front", (1, 2), blue), ("back", (9, 10), orange))
    )
    capture = open_capture(front)
    run = run_of(capture, iterations=60, lattice=1, density_interval=0)
    train_run(capture, tmp_path / "run", run)
    extend(tmp_path / "run", back, tmp_path / "extended", iterations=150)
    before, after = (read_avatar(tmp_path / name / "avatar.npz") for name in ("run", "extended"))
    height = capture.neutral[capture.faces].mean(1)[:, 2] / factory.RADIUS
    assert before.regions["unseen"][height < -0.2].all()
    assert not after.regions["unseen"][np.abs(height) > 0.2].any()

    def color(avatar, rows):
        return 255 * (0.5 + SH_C0 * avatar.splats.sh[rows[avatar.splats.face], 0]).mean(0)

    assert_allclose(color(before, height < -0.6), blue, atol=2)
    share = (color(after, height < -0.6) - blue) / (orange - blue)
    assert share.min() > 0.2
    assert_allclose(color(after, height > 0.6), color(before, height > 0.6), atol=3)


def test_an_extension_begins_with_its_parents_rates(takes, parent):
    """Catches rates that jump, and colors that cannot follow the strain of a new take."""
    original = read_run(parent).settings.rates
    extended = prepare_extension(parent, (takes[1],)).run.settings.rates
    middle = learning_rates(original, START_FRACTION)
    assert learning_rates(extended, 0.0) == pytest.approx(
        {**middle, "strain_color": original.strain_color}
    )


@pytest.mark.parametrize("growth", [0.0, 0.5])
def test_a_stopped_extension_is_continued_to_the_same_bits(
    takes, parent, tmp_path, growth, monkeypatch
):
    """Catches an order, selection or count of splats not found again, or only by the parent."""
    monkeypatch.setattr(continuation, "DENSITY_INTERVAL", 3)
    whole = extend(parent, takes[1], tmp_path / "whole", growth=growth)
    beside = Path(shutil.copytree(parent, tmp_path / "parent"))
    stopped = extend(beside, takes[1], tmp_path / "stopped", stop=7, growth=growth)
    shutil.rmtree(beside)  # resuming does not need it
    before, after = (len(read_avatar(run / "avatar.npz").splats) for run in (parent, whole))
    assert (after > before) == bool(growth)
    opened = open_run(stopped)
    train_run(opened.capture, stopped, opened.run, resume=True)
    assert_same_run(stopped, whole)


def test_what_follows_strain_can_begin_with_a_further_take(takes, tmp_path):
    """Catches splats that cannot gain coefficients or train them, and an avatar that jumps."""
    capture = open_capture(takes[0])
    run = run_of(capture, iterations=20, lattice=1, density_interval=0)
    train_run(capture, tmp_path / "run", run)
    prepared = prepare_extension(tmp_path / "run", (takes[1],), iterations=6)
    follows = {"driven_offsets": ("strain_position", "strain_color")}
    run = replace(prepared.run, settings=replace(prepared.run.settings, **follows))
    train_run(prepared.capture, tmp_path / "new", run, prepared.selection)
    before, first = (read_metrics(tmp_path / name)[at] for name, at in (("run", -1), ("new", 0)))
    assert first["psnr_take_1"] == pytest.approx(before["psnr"], abs=0.01)
    avatar = read_avatar(tmp_path / "new" / "avatar.npz")
    trained = read_checkpoint(tmp_path / "new").state.driven_offsets
    assert set(avatar.driven_offsets) == set(trained) == set(follows["driven_offsets"])
    assert all(offset.value.any() for offset in trained.values())
    assert (
        avatar.strain_range[:, 0] > TRAINED_RANGE[0]
    ).all()  # what the takes show, not any strain


@pytest.mark.parametrize("change", ["shape", "images"])
def test_takes_that_do_not_fit(takes, parent, change, monkeypatch):
    """Catches another head, or a take without images, found after minutes of training."""

    def changed(path, *rest):
        capture = open_capture(path, *rest)
        if change == "shape":
            return replace(capture, neutral=capture.neutral * 1.1)
        return replace(capture, views={}) if change == "images" else capture

    monkeypatch.setattr("stga_addon.capture.takes.open_capture", changed)
    sentences = {"shape": "must be of the same head", "images": "has no training views"}
    with refusal(sentences[change]):
        prepare_extension(parent, (takes[1],), iterations=1)
    assert read_run(parent).takes == ()
    monkeypatch.undo()
    again = takes[1] / ".." / takes[1].name
    with refusal("new: is given twice"):
        prepare_extension(parent, (takes[1], again))


@pytest.mark.parametrize(
    ("what", "says"),
    [
        ("cameras", "head appears 1e+03 times smaller in the images than in those of .*old"),
        ("meshes", "tracked meshes are 1e+03 times as large as the neutral mesh"),
    ],
)
def test_a_take_in_millimeters(takes, parent, tmp_path, what, says):
    """Catches a take of which a part is in another unit, on which training is wasted without an
    error."""
    take = Path(shutil.copytree(takes[0], tmp_path / "new"))

    def enlarge(document):
        for frame in document["frames"]:
            for row in frame["transform_matrix"][:3]:
                row[3] *= 1000

    for path in sorted(take.glob("transforms_*.json")) if what == "cameras" else ():
        factory.edit(path, enlarge)
    for path in sorted(take.glob("meshes/0*.obj")) if what == "meshes" else ():
        vertices, faces = read_mesh(path)
        factory.write_mesh(path, 1000 * vertices, faces)
    with refusal(f"new: its {says}".replace("+", r"\+")):
        prepare_extension(parent, (take,))


def test_takes_from_another_distance_fit(takes):
    """Catches a refusal of cameras that stand three times as far away, or zoom."""
    first = open_capture(takes[0])
    cameras = [view.camera for view in first.views["train"]]
    wide = [replace(lens, fl_x=lens.fl_x / 3, fl_y=lens.fl_y / 3) for lens in cameras]
    views = map(lambda view, lens: replace(view, camera=lens), first.views["train"], wide)
    zoomed = replace(first, views={"train": tuple(views)})
    require_same_scale(first, zoomed)
    require_same_scale(zoomed, first)
