"""The range of deformation that an avatar takes along from its training."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from refusal import refusal

from stga_addon.avatar.file import Avatar, read_avatar, write_avatar
from stga_addon.avatar.strain import (
    MIN_COMPRESSION,
    TRAINED_RANGE,
    deformation,
    strain_basis,
    trained_range,
)
from stga_addon.files import read_npz, write_npz
from stga_addon.training.evaluate.forecast import kept_line
from stga_addon.training.evaluate.metrics import evaluate_avatar
from stga_addon.training.optimize.frames import FrameStore
from stga_addon.training.run.checkpoint import STRAIN_RANGE, trained_strain_range
from stga_addon.training.run.folder import Continuation
from stga_addon.training.run.metrics_log import read_metrics
from stga_addon.training.run.session import train_run
from stga_addon.training.settings import Rates

from .toys import random_splats, run_of, stop_at

COLORS = "strain_color", "normal_color"


def deformed(toy, timestep):
    """The toy's mesh, stretched by another amount along each axis in each timestep."""
    return toy.neutral * (1 + 0.03 * np.random.default_rng(timestep).normal(size=3))


def test_a_run_writes_the_range_of_what_it_trained(toy, tmp_path):
    """Catches a range of held-out expressions, one that clips, and one nobody needs."""
    capture = replace(toy, mesh=lambda timestep: deformed(toy, timestep))
    run = run_of(capture, iterations=4, lattice=0, driven_offsets=COLORS)
    found = read_avatar(train_run(capture, tmp_path / "on", run).path)
    basis = strain_basis(toy.neutral, toy.faces, trained_range(len(toy.faces)))
    timesteps = {view.timestep for view in toy.views["train"]}
    trained = np.stack([deformation(basis, deformed(toy, t)) for t in timesteps])
    limits = found.strain_range
    assert (limits[:, 0] <= trained.min(0)).all()
    assert (trained.max(0) <= limits[:, 1]).all()
    assert (trained.max(0) * 1.21 + 1e-6 >= limits[:, 1])[trained.max(0) > 0].all()
    without = run_of(capture, iterations=4, lattice=0)
    assert read_avatar(train_run(capture, tmp_path / "off", without).path).strain_range is None


def test_a_continuation_keeps_what_its_parent_saw(toy, tmp_path):
    """Catches an avatar that forgets expressions because only one frame was refined."""
    count = len(toy.faces)
    limits = np.broadcast_to(np.array([[-0.5], [0.01]], np.float32), (count, 2, 6)).copy()
    neutral = toy.neutral.astype(np.float32)
    offsets = {"strain_color": np.zeros((count, 3, 3), np.float32)}
    parent = Avatar(
        random_splats(20, count),
        "stga",
        neutral,
        toy.faces,
        strain_range=limits,
        driven_offsets=offsets,
    )
    write_avatar(tmp_path / "avatar.npz", parent)
    continuation = Continuation(tmp_path, "", 0, 0)
    alone = trained_strain_range(toy, lambda t: deformed(toy, t), None)
    both = trained_strain_range(toy, lambda t: deformed(toy, t), continuation)
    assert_array_equal(both[:, 0], np.minimum(alone[:, 0], -0.5))
    # its parent followed stretch
    assert_array_equal(both[:, 1, :2], np.float32(-MIN_COMPRESSION))
    assert_array_equal(both[:, 1, 2:], np.maximum(alone[:, 1, 2:], np.float32(0.01)))
    write_avatar(tmp_path / "avatar.npz", replace(parent, strain_range=None))
    unlimited = trained_strain_range(toy, lambda t: deformed(toy, t), continuation)
    assert_array_equal(unlimited, np.broadcast_to(TRAINED_RANGE, (count, 2, 6)))


def test_colors_follow_compression_and_shear_but_no_stretch(toy):
    """Catches wrinkles of opposite sign in stretched skin, or of the least compression."""
    basis = FrameStore(toy, "stga", strain=True).strain
    larger, little, smaller = (
        deformation(basis, scale * toy.neutral) for scale in (1.05, 0.985, 0.9)
    )
    assert_array_equal(larger[:, :2], np.float32(-MIN_COMPRESSION))
    assert_array_equal(little[:, :2], np.float32(-MIN_COMPRESSION))
    assert (smaller[:, :2] < -0.4).all()
    limits = trained_strain_range(toy, lambda t: 1.05 * toy.neutral, None)
    assert_array_equal(limits[:, :, :2], np.float32(-MIN_COMPRESSION))
    sheared = toy.neutral @ np.array([[1, 0.1, 0], [0, 1, 0], [0, 0, 1.0]])
    shear = deformation(basis, sheared)[:, 2]
    assert shear.min() < -0.05
    assert shear.max() > 0.05


def test_the_range_covers_an_expression_of_few_timesteps(toy):
    """Catches a blink of six frames in 1,200 that is trained, but clipped."""
    view = toy.views["train"][0]
    blink = range(1003, 1009)
    views = {"train": tuple(replace(view, timestep=timestep) for timestep in range(1200))}

    def mesh(timestep):
        return toy.neutral * (0.85 if timestep in blink else 1.0)

    basis = strain_basis(toy.neutral, toy.faces, trained_range(len(toy.faces)))
    limits = trained_strain_range(replace(toy, views=views), mesh, None)
    assert (limits[:, 0] <= deformation(basis, mesh(blink[0]))).all()


def test_evaluation_while_training_measures_the_avatar_that_is_written(toy, tmp_path):
    """Catches metrics of an avatar that follows held-out expressions further than the file does."""
    strong = {view.timestep for view in toy.views["val"]} - {0}

    def mesh(timestep):
        return toy.neutral * (0.8 if timestep in strong else 1.0)

    weak = tuple(view for view in toy.views["train"] if view.timestep not in strong)
    plain = {"iterations": 20, "lattice": 0, "sh_degree": 0, "sh_steps": (), "ema_share": 1.0}
    rates = Rates(strain_color=0.5)
    capture = replace(toy, mesh=mesh, views={**toy.views, "train": weak})
    run = run_of(capture, driven_offsets=COLORS, rates=rates, **plain)
    path = train_run(capture, tmp_path / "run", run).path
    best = kept_line(read_metrics(tmp_path / "run"), run.settings)
    found = evaluate_avatar(read_avatar(path), capture, "val").psnr
    assert found == pytest.approx(best["psnr"], abs=1e-3)


def test_a_range_of_another_mesh_is_refused(toy, tmp_path):
    """Catches a resumed run whose kernels read beyond its file."""
    run = run_of(toy, iterations=4, lattice=0, driven_offsets=COLORS)
    train_run(toy, tmp_path, run, report=stop_at(2))
    arrays = read_npz(tmp_path / STRAIN_RANGE)
    write_npz(tmp_path / STRAIN_RANGE, {**arrays, "strain_range": arrays["strain_range"][1:]})
    with refusal(r"strain_range\.npz: .* is float32 .*, expected float32 \(320, 2, 6\)"):
        train_run(toy, tmp_path, run, resume=True)
