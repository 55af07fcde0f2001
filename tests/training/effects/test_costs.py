"""An effect that is off takes no memory and no calls; one that is on reaches the training."""

from collections import Counter
from dataclasses import replace
from types import SimpleNamespace

import numpy as np

from stga_addon.capture.images import read_view
from stga_addon.flame.teeth import TEETH_FACES, teeth_faces
from stga_addon.training.effects.plan import plan_effects
from stga_addon.training.optimize import cpu_backend, frames, initial_splats, trainer
from stga_addon.training.optimize.density import DensityControl
from stga_addon.training.optimize.image_preparation import exposure_correction
from stga_addon.training.run import session
from stga_addon.training.run.checkpoint import read_checkpoint
from stga_addon.training.run.folder import Run
from stga_addon.training.settings import make_settings

from ..toys import hidden_layer_size
from .scenes import unlike_cameras

# What each effect calls, by where the call is made from.
CALLS = {
    "background": (cpu_backend, "change_background"),
    "hull-points": (initial_splats, "visual_hull_points"),
    "density": (DensityControl, "apply"),
    "selection": (session, "select_capture"),
    "strain-color": (frames, "strain_basis"),
}
ITERATIONS = 12


def train(capture, out, monkeypatch, choice):
    """Train with all effects on or off; how often each was called, and the checkpoint."""
    names = dict.fromkeys((*CALLS, "normal-color", "view-color", "antialiasing"), choice)
    wanted = make_settings(iterations=ITERATIONS, effects=names, warm_up_share=0.0)
    settings, plan = plan_effects(capture, wanted)
    if settings.density_interval:
        settings = replace(settings, density_interval=2, density_span=(0.0, 1.0))
    calls = Counter()
    for effect, (module, name) in CALLS.items():
        monkeypatch.setattr(module, name, counting(calls, effect, getattr(module, name)))
    session.train_run(capture, out, Run(capture.root, None, "vhap", settings, plan))
    return calls, read_checkpoint(out).state


def counting(calls, effect, function):
    def counted(*arguments, **more):
        calls[effect] += 1
        return function(*arguments, **more)

    return counted


def test_off_calls_nothing_and_on_calls_all(painted, tmp_path, monkeypatch):
    """Catches work and memory of an effect that is off, and one that is on but not called."""
    calls, state = train(painted(), tmp_path / "off", monkeypatch, "off")
    assert calls == {}
    assert state.parameters.sh.shape[1] == 1
    assert not state.driven_offsets
    store = frames.FrameStore(painted(), "stga")
    shown = int((~store.surface.hidden).sum())
    assert len(state) == 6 * shown + hidden_layer_size(store)
    calls, state = train(painted(), tmp_path / "on", monkeypatch, "on")
    assert set(calls) == set(CALLS)
    assert calls["background"] == ITERATIONS
    assert state.parameters.sh.shape[1] == 16
    assert "strain_color" in state.driven_offsets


def test_exposure_is_taken_away(painted):
    """Catches gains and offsets applied inversely, to the background, or to another camera."""
    gain, offset = unlike_cameras()
    table = np.column_stack([np.arange(8.0), gain, offset])
    rows = tuple(map(tuple, table.tolist()))
    correct = exposure_correction(make_settings(iterations=1, exposure=rows))
    alike = painted()
    unlike = painted(gain=gain, offset=offset)
    for same, other in zip(alike.views["train"][:8], unlike.views["train"][:8], strict=True):
        (_, expected, _) = read_view(same)
        (view, image, mask) = read_view(other)
        corrected = correct(view, image, mask)
        pair = image.astype(int), corrected.astype(int)
        before, after = (abs(shown - expected)[mask > 0].mean() for shown in pair)
        assert after < 1.0
        assert before > 2 * after
        assert (corrected[mask == 0] == image[mask == 0]).all()
    stranger = replace(view, camera_index=99)
    assert correct(stranger, image, mask) is image
    assert exposure_correction(make_settings(iterations=1)) is None


def test_no_splats_on_teeth(painted):
    """Catches splats on teeth that are never visible."""
    capture = painted()
    vertices = len(capture.neutral)
    rows = capture.neutral[0] + np.random.default_rng(0).normal(0, 0.002, (120, 3))
    faces = np.concatenate([capture.faces, teeth_faces(vertices)])
    masks = {"teeth": np.arange(vertices, vertices + 120)}
    flame = SimpleNamespace(model=SimpleNamespace(masks=masks))
    neutral = np.concatenate([capture.neutral, rows])
    toothed = replace(capture, faces=faces, neutral=neutral, flame=flame)
    toothed = replace(toothed, mesh=lambda t: np.concatenate([capture.mesh(t), rows]))
    for kept in (True, False):
        splats = initial_splats.initial_splats(
            toothed, make_settings(iterations=1, hull_points=False, lattice=2, teeth=kept)
        )
        on_teeth = (splats.face >= len(capture.faces)).sum()
        assert on_teeth == (6 * TEETH_FACES if kept else 0)
        assert len(splats) - on_teeth == 6 * len(capture.faces)


def test_antialiasing_reaches_training_and_evaluation(painted):
    """Catches an effect that is decided and then forgotten."""
    capture = painted()
    losses = []
    pictures = []
    view, image, _ = read_view(capture.views["train"][0], 0.4)
    for choice in ("on", "off"):
        settings, _ = plan_effects(
            capture, make_settings(iterations=1, effects={"antialiasing": choice})
        )
        settings = replace(settings, lattice=0, hull_points=False)
        small = trainer.Trainer(capture, settings, {})
        for parameters in (small.state.parameters, small.state.average):
            parameters.log_scale[:] -= 1.5  # narrower than a pixel
            parameters.sh[:, 0, 0] = 1.0
        pictures.append(small.render(view, 0.0))
        losses.append(small.step(view, image, 0.0))
    assert np.abs(pictures[0] - pictures[1]).max() > 0.05
    assert abs(losses[0] - losses[1]) > 1e-3
