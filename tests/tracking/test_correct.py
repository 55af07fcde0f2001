"""Corrections by hand: the key is kept, its neighbors follow, all others stay."""

import re
import shutil

import numpy as np
import pytest
from command_line import stga
from flame.small_head import small_head
from numpy.testing import assert_allclose, assert_array_equal
from refusal import refusal

from stga_addon.capture.open import open_capture
from stga_addon.files import read_json, read_npz, write_json, write_npz
from stga_addon.flame.forward import RIGID_SIZE, flame_forward, frame_of
from stga_addon.jobs.perform import write_request
from stga_addon.jobs.track import SolveAgain
from stga_addon.tracking.correct import SOLVED_FILE, correct_capture, corrected
from stga_addon.tracking.folder import LANDMARKS_FOLDER, REPORT_FILE
from stga_addon.tracking.footage.open import open_footage
from stga_addon.tracking.head_model import HeadModel
from stga_addon.tracking.opened import TrackingOptions
from stga_addon.tracking.solve import person
from stga_addon.tracking.track import track

from .recording import record
from .test_fit import WORLDS, frame_at, meshes_of, moved, places_on

HEAD = HeadModel(small_head(0), "flame")
PERSON = person(HEAD, np.zeros(HEAD.model.n_identity)).model
JAW = HEAD.model.n_expression + 6
TAKE = np.stack([frame_at(HEAD, timestep).parameters for timestep in range(30)])


def opened(timestep, angle):
    values = TAKE[timestep].copy()
    values[JAW] += angle
    return values


def correct(keys, span=5, seen=None):
    seen = np.ones(len(TAKE), bool) if seen is None else seen
    return corrected(PERSON, places_on(HEAD, 60), TAKE, seen, keys, span)


def test_a_key_moves_its_neighbors_and_nothing_else():
    """Catches a correction that pops for one frame, spreads over the take, or is pulled back by the
    landmarks; also by those that an interpolated frame does not have."""
    change = correct({12: opened(12, 0.3)}) - TAKE
    assert_allclose(change[12], np.eye(TAKE.shape[1])[JAW] * 0.3, atol=1e-12)
    assert_array_equal(change[:7], 0)
    assert_array_equal(change[18:], 0)
    jaw = change[7:18, JAW]
    assert 0.03 < jaw[4] < 0.3
    assert 0.03 < jaw[6] < 0.3
    assert np.abs(np.diff(jaw)).max() < 0.27
    assert np.abs(change[:, :-RIGID_SIZE]).max() < 0.3  # expressions take over little of it
    seen = np.ones(len(TAKE), bool)
    seen[13:16] = False
    unseen = correct({12: opened(12, 0.3)}, seen=seen) - TAKE
    assert unseen[13, JAW] > change[13, JAW] + 0.02


@pytest.mark.parametrize("world", WORLDS)
def test_the_world_says_nothing_of_a_correction(world):
    """Catches keys whose axis-angles are subtracted: near half a turn, a key of 4° turned the heads
    between by up to 131°."""
    key = TAKE[12].copy()
    key[-18:-15] += np.radians([3, -4, 2])
    expected = meshes_of(HEAD, correct({12: key}))
    turned, turn = moved(HEAD, TAKE, WORLDS[world])
    (own,), _ = moved(HEAD, [key], WORLDS[world])
    seen = np.ones(len(TAKE), bool)
    found = corrected(PERSON, places_on(HEAD, 60), turned, seen, {12: own}, 5)
    assert_allclose(meshes_of(HEAD, found), expected @ turn.T, atol=5e-4)


@pytest.mark.parametrize(
    "keys",
    [{}, {0: 0.2}, {29: 0.2}, {10: 0.2, 11: -0.1}, dict.fromkeys(range(30), 0.1)],
)
def test_keys_anywhere(keys):
    """Catches keys at the ends, side by side or everywhere, and a drift with every call."""
    given = {timestep: opened(timestep, angle) for timestep, angle in keys.items()}
    found = correct(given)
    for timestep, values in given.items():
        assert_allclose(found[timestep], values, atol=1e-12)
    assert np.abs(found - TAKE).max() < (0.5 if keys else 1e-15)


@pytest.fixture(scope="module")
def tracked(tmp_path_factory):
    """A tracked capture, its model and its parameters."""
    folder = tmp_path_factory.mktemp("tracked")
    record(folder, HEAD)
    footage = open_footage(folder / "footage")
    track(footage, folder / "head.npz", folder / "out", TrackingOptions(folder / "points"))
    return folder / "out", folder / "head.npz", parameters_in(folder / "out", folder / "head.npz")


def parameters_in(out, model):
    sequence = open_capture(out, model).flame
    return np.stack([sequence.frame(timestep).parameters for timestep in sequence.timesteps])


def test_a_corrected_capture_shows_the_key(tracked, tmp_path):
    """Catches a key in other units, a report of before, and another tracker's capture lost."""
    out, model, before = tracked
    report = read_json(out / "tracking.json")["reprojection_px"]["cam0"]
    key = before[1].copy()
    key[HEAD.model.n_expression + 1] += 0.3  # turns the head
    correct_capture(out, model, {1: key}, span=1)
    capture = open_capture(out, model)
    flame = capture.flame
    expected = flame_forward(flame.model, flame.shape, frame_of(key), flame.static_offset)
    assert_allclose(capture.mesh(1), expected, atol=1e-6)
    assert_allclose(parameters_in(out, model)[3:], before[3:], atol=1e-7)
    after = read_json(out / "tracking.json")["reprojection_px"]["cam0"]
    assert after["1"] > report["1"] + 0.5
    assert abs(after["4"] - report["4"]) < 0.02
    correct_capture(out, model, {})
    assert_allclose(parameters_in(out, model), before, atol=1e-7)
    with refusal("has no timestep 99"):
        correct_capture(out, model, {99: before[0]})
    other = tmp_path / "other"
    shutil.copytree(out, other, ignore=shutil.ignore_patterns("landmarks", "tracking_*"))
    with refusal(r"head_model\.npz"):
        correct_capture(other, model, {1: before[1]})
    assert not (other / SOLVED_FILE).exists()


def changed(name, **values):
    """Damage that sets fields of a JSON or npz file; None removes one."""

    def damage(out):
        read, write = (read_json, write_json) if name.endswith(".json") else (read_npz, write_npz)
        fields = {**read(out / name), **values}
        write(out / name, {key: value for key, value in fields.items() if value is not None})

    return damage


def solved(**arrays):
    return lambda out: write_npz(out / SOLVED_FILE, arrays)


def unconfident(out):
    """No landmark that counts in any file of a camera."""
    for path in (out / LANDMARKS_FOLDER).glob("cam*.npz"):
        arrays = read_npz(path)
        write_npz(path, {**arrays, "confidence": np.zeros_like(arrays["confidence"])})


SIZE = TAKE.shape[1]
MISFIT = "image_misfit: expected fractions by region and timestep"
INTERPOLATED = r"interpolated: expected timesteps"
PARAMETERS = rf"parameters: expected \(5, {SIZE}\) finite numbers"
OTHERS = "timesteps: expected those of the capture"
FIVE = np.arange(5)
POSES = TAKE[:5]
DAMAGES = {
    "report missing": (lambda out: (out / REPORT_FILE).unlink(), REPORT_FILE, "cannot be read"),
    "no landmark counts": (unconfident, LANDMARKS_FOLDER, "has no landmarks of a face"),
    "solved folder": (lambda out: (out / SOLVED_FILE).mkdir(), SOLVED_FILE, "is not a regular"),
    "report null": (
        lambda out: (out / REPORT_FILE).write_text("null"),
        REPORT_FILE,
        INTERPOLATED,
    ),
    "interpolated": (changed(REPORT_FILE, interpolated=["2"]), REPORT_FILE, INTERPOLATED),
    "misfit": (changed(REPORT_FILE, image_misfit={"face": {"0": "much"}}), REPORT_FILE, MISFIT),
    **{
        f"solved {name}": (solved(**arrays), SOLVED_FILE, message)
        for name, arrays, message in (
            ("without parameters", {"timesteps": FIVE}, PARAMETERS),
            ("of fewer timesteps", {"timesteps": FIVE, "parameters": TAKE[:4]}, PARAMETERS),
            ("as complex", {"timesteps": FIVE, "parameters": POSES.astype(complex)}, PARAMETERS),
            ("not a number", {"timesteps": FIVE, "parameters": np.nan * POSES}, PARAMETERS),
            ("astronomic", {"timesteps": FIVE, "parameters": POSES + 1e300}, PARAMETERS),
            ("without timesteps", {"parameters": POSES}, OTHERS),
            ("of others", {"timesteps": FIVE + 7, "parameters": POSES}, OTHERS),
        )
    },
}


@pytest.mark.parametrize("name", DAMAGES)
def test_a_damaged_capture_is_named(tracked, tmp_path, capsys, name):
    """Catches a traceback, or heads that are overwritten from damaged files."""
    out, model, before = tracked
    damage, file, message = DAMAGES[name]
    shutil.copytree(out, tmp_path / "out")
    (tmp_path / "out" / SOLVED_FILE).unlink(missing_ok=True)
    write_request(tmp_path / "job", SolveAgain(tmp_path / "out", model, {1: before[1]}))
    damage(tmp_path / "out")
    assert stga("perform", tmp_path / "job") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert str(tmp_path / "out" / file) in line
    assert re.search(message, line)
    assert_array_equal(parameters_in(tmp_path / "out", model), before)


def test_a_key_that_is_none_is_named(tracked, tmp_path, capsys):
    """Catches heads that are written from a request whose arrays are damaged."""
    out, model, before = tracked
    write_request(tmp_path / "job", SolveAgain(out, model, {1: np.full(SIZE, np.nan)}))
    assert stga("perform", tmp_path / "job") == 2
    message = rf"key at timestep 1: expected \({SIZE},\) finite numbers"
    assert re.search(message, capsys.readouterr().err)
    assert_array_equal(parameters_in(out, model), before)
