"""Files that versions of the add-on have written are read, with all that they hold."""

from pathlib import Path

import numpy as np
import pytest
from capture import factory
from equality import assert_same
from export.web.test_player import evaluated
from export.web.web_data import posed_mesh, read_web_data
from numpy.testing import assert_allclose, assert_array_equal

from stga_addon.avatar.file import read_avatar
from stga_addon.capture.open import open_capture, with_sequence
from stga_addon.jobs.perform import read_request, read_result, request_folder
from stga_addon.progress import Written
from stga_addon.training.run.checkpoint import read_checkpoint, read_selection
from stga_addon.training.run.folder import (
    read_residuals,
    read_run,
    with_refined_tracking,
)
from stga_addon.training.run.metrics_log import read_metrics

from . import make

FOLDERS = sorted(make.DATA.iterdir())
pytestmark = pytest.mark.parametrize("folder", FOLDERS, ids=lambda folder: folder.name)


def test_avatar(folder):
    """Catches an avatar file of people that is refused, or loses its colors, light or regions."""
    assert_same(read_avatar(folder / "avatar.npz"), make.avatar())


def test_run(folder):
    """Catches a run that cannot be resumed, or goes on with other settings or another selection."""
    assert_same(read_run(folder), make.run())
    digest = make.IDENTITY.digest
    assert_same(read_checkpoint(folder), make.checkpoint())
    assert_same(read_selection(folder, len(make.FACES), digest), make.SELECTION)
    assert_array_equal(read_residuals(folder, len(make.FACES)), make.RESIDUAL)
    assert read_metrics(folder) == [make.METRICS]


def test_strain_range(folder, tmp_path):
    """Catches a run's range of deformation that is refused, or measured anew in other numbers."""
    found = make.strain_range(folder)
    assert_allclose(found, make.strain_range(tmp_path), atol=1e-6)
    assert np.abs(found[:, :, :2]).max() > 0.3


def test_tracking(folder, tmp_path):
    """Catches refined tracking that is left out, or mixed up."""
    root, model = factory.write_flame_capture(tmp_path, make.TIMESTEPS, (0,))
    capture = with_sequence(open_capture(root, model), make.sequence(model))
    refined = with_refined_tracking(capture, folder).flame
    for timestep, expected in zip(make.TIMESTEPS, make.refined(), strict=True):
        assert_array_equal(refined.frame(timestep).parameters, expected[:-3])
        assert refined.frame(timestep).dynamic_offset is not None


def test_request(folder):
    """Catches a request of a batch or a run that a newer worker refuses."""
    expected = make.train()
    assert_same(read_request(request_folder(folder)), expected)
    found = read_result(request_folder(folder))
    assert found == Written(Path("/runs/anna/avatar.npz"), ("PSNR 30 dB",))


@pytest.mark.needs("node")
def test_web_data(folder, tmp_path):
    """Catches data on people's servers that a newer player refuses, or poses in another way."""
    data = (folder / make.SKINNED).read_bytes()
    header, arrays = read_web_data(data)
    results = evaluated(tmp_path, data)[0]["results"]
    rig = make.rigged().rig
    assert len(results) == len(rig.pose)
    for frame, result in enumerate(results):
        expected = posed_mesh(header, arrays, rig.coefficients[frame], rig.pose[frame], frame)
        assert_allclose(np.reshape(result["vertices"], (-1, 3)), expected, atol=1e-5)
        assert np.ptp(np.reshape(result["texels"], (-1, 5, 4))[:, 3, :3]) > 0.01
