"""A request and a result of every kind, with values that are easily lost."""

from pathlib import Path

import numpy as np

import stga_addon.development.commands  # noqa: F401 (adds its requests)
from stga_addon.development.benchmark.variants import Benchmark
from stga_addon.driving.open_motion import MotionOptions
from stga_addon.jobs.analyze import Analyze, Analyzed, Select, TimePresets
from stga_addon.jobs.avatar_source import Played
from stga_addon.jobs.blender import RenderBlend, RenderRecording
from stga_addon.jobs.convert_motion import ConvertMotion
from stga_addon.jobs.export import Export
from stga_addon.jobs.finished_run import Evaluate, MakeExact, Relight
from stga_addon.jobs.render import Render
from stga_addon.jobs.track import MakeAvatar, SolveAgain, Track
from stga_addon.jobs.train import Extend, Refine, Resume, Selected, Train
from stga_addon.progress import Written
from stga_addon.training.effect_catalog import EffectDecision
from stga_addon.training.settings import make_settings

HEAD = Path("/captures/anna")
PLAYED = Played(
    {-2: np.zeros((5, 3)), 12: np.ones((5, 3))},
    {"expr": np.ones((2, 4))},
    {-2: np.arange(4) < 2, 12: np.ones(4, bool)},
)
REQUESTS = (
    Train(
        Path("r"),
        HEAD,
        make_settings(iterations=3, preset="draft"),
        device="gpu:Name",
        selection={0: np.ones(4, bool)},
    ),
    Resume(
        Path("r"), HEAD, Path("flame.pkl"), "opencv", selection={7: np.zeros(4, bool)}, more_s=9.0
    ),
    Refine(Path("r_2"), Path("r"), "mouth", frames=(3, 5), growth=0.5, seconds=20.0),
    Refine(
        Path("r_2"), Path("r"), weights=np.arange(4, dtype=np.float32) / 4, iterations=3, seed=2
    ),
    Extend(Path("r_2"), Path("r"), (Path("/smile"), Path("/frown")), iterations=3),
    Select(HEAD, Path("flame.pkl"), threshold=0.01, zero_pose="all"),
    Track(
        Path("f"),
        Path("m.glb"),
        Path("o"),
        focal=900.0,
        stop=9,
        step=3,
        most=40,
        offset={"left": -3},
        meshes=True,
        mattes="none",
    ),
    MakeAvatar(
        Track(Path("v.mp4"), None, Path("o/capture"), focal=900.0),
        Train(Path("o/run"), Path("o/capture"), make_settings(iterations=3), device="cpu"),
    ),
    MakeAvatar(
        Track(Path("v.mp4"), None, Path("o/capture"), take="around"),
        Train(Path("o/run"), Path("o/capture"), make_settings(iterations=3)),
        (Path("talk.mp4"), Path("photos")),
    ),
    SolveAgain(HEAD, Path("flame.npz"), {12: np.linspace(0, 1, 5), 3: np.zeros(5)}),
    RenderRecording(Path("a/b.bin"), Path("v.mp4"), 3, 25.0, (1.0, 0.5, 0.0)),
    Render(
        Path("r"),
        Path("v.mp4"),
        True,
        cameras=Path("t.json"),
        turntable=90.0,
        camera=2,
        seconds=3.0,
        motion=Path("m.npz"),
        background=(0.0, 1.0, 0.5),
        light=Path("sunset.hdr"),
        light_turn=360.0,
        played=PLAYED,
    ),
    Benchmark(Path("b"), HEAD, 30.0, seed=2, only=("draft", "final")),
    RenderBlend(Path("/shots/head.blend"), Path("p"), (3, 12), "CYCLES"),
    Export(
        Path("r"),
        Path("a.html"),
        "web",
        HEAD,
        played=PLAYED,
        frames=(3, 12),
        fps=30.0,
        motion_only=True,
        filmed_only=True,
    ),
    TimePresets(HEAD, principal_point="opencv", device="cpu"),
    Analyze(HEAD, effects={"jaw": "off"}, timed=True),
    Evaluate(Path("r"), "test", capture=HEAD),
    Relight(Path("r"), card=(0.5, 0.4, 0.5), capture=HEAD),
    MakeExact(Path("r"), capture=HEAD),
    ConvertMotion(
        Path("take.csv"),
        Path("m.npz"),
        HEAD,
        options=MotionOptions(gains={"jaw": 0.5}, stay_trained=None),
    ),
)
RESULTS = (
    Written(Path("a.npz"), ("PSNR 30 dB", "avatar: a.npz")),
    Selected({3: np.arange(4) < 2}),
    Analyzed((EffectDecision("jaw", "auto", True, "turns by 9°", "none"),), {"draft": 31.5}),
)
