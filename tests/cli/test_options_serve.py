"""Every option of every command: for what it serves, and that it is refused elsewhere."""

from dataclasses import is_dataclass
from pathlib import Path

import pytest
from refusal import refusal

from stga_addon.cli.commands import COMMANDS
from stga_addon.cli.main import make_parser
from stga_addon.options import flag_of, option_fields
from stga_addon.schema import type_hints

ALWAYS = """
--albedo --avatar --background --budget --cameras --capture --device --dry-run --effect
--filmed-only --flame --focal --footage --format --fps --frames --gray-card --growth --iterations
--knobs --landmarks --light --mattes --meshes --model --neutral --no-blend --offset --only --out
--phone --preset --principal-point --quick --region --repair --resume --schedule --seed --seeds
--shot --size --split --start --step --stop --stop-when-flat --strategy --strength --sync --take
--target-psnr --threads --threshold --timesteps --turntable --video --world --zero-pose
"""
"""Options that serve wherever their command does not say otherwise (`needs`)."""
VALUES = """
--address x:1 --budget 9 --camera 1 --capture c --device cpu --effect jaw=on --engine local
--exchange jaw --flame f.npz --fps 9 --frames 1:2 --gain jaw=2 --growth 0.1 --head c --iterations 9
--light l.hdr --light-turn 9 --motion m.csv --neutral quiet --out o --preset draft
--principal-point opencv --recorded-fps 24 --region mouth --seconds 9 --seed 1 --smooth 1
--strength 2 --timestep 1
"""
GIVEN = {flag: f"{flag} {value}" for flag, value in zip(*[iter(VALUES.split())] * 2, strict=True)}
"""Flag -> how it is given; others stand alone."""
SERVES = """
render a.npz --out o            | a.npz --video v.mp4           | --camera
render a.npz --out o --motion m.npz | a.npz --out o --motion m.csv | --fps
render a.npz --video v.mp4      | a.npz --video v.mp4 --turntable | --seconds
render a.npz --video v.mp4 --turntable | a.npz --video v.mp4    | --frames
render a.ply --out o            | a.npz --out o                 | --capture --flame --motion --light --world
render a.npz --out o --motion m.csv --cameras t.json | a.npz --video v.mp4 --motion m.csv | --capture
render a.npz --video v.mp4      | a.npz --out o --cameras t.json | --principal-point
render a.npz --out o            | a.npz --out o --motion m.npz  | --strength --neutral --stay-trained
render a.npz --out o --motion m.npz | a.npz --out o --motion m.csv | --smooth --mirror --gain --exchange --recorded-fps
render a.npz --video v.mp4      | a.npz --video v.mp4 --light l.hdr | --light-turn
render a.npz --out o --light l.hdr | a.npz --video v.mp4 --light l.hdr | --light-turn
export a.npz --out o --format ply | . --out o --format ply      | --capture --flame
export a.npz --out o --format ply | a.npz --out o --format ply --timestep 1 | --capture --flame --motion
export a.npz --out o --format usd | a.npz --out o --format ply  | --timestep
export a.npz --out o --format ply | a.npz --out o --format usd  | --frames --fps
export a.npz --out o --format usd | a.npz --out o --format web  | --motion-only
export a.npz --out o --format web | a.npz --out o --format web --motion m.npz | --strength --neutral --stay-trained
export a.npz --out o --format web --motion m.npz | a.npz --out o --format web --motion m.csv | --smooth --mirror --gain --exchange --recorded-fps
drive m.csv --out o.csv         | m.csv --out o.npz             | --flame --head
drive v.mp4 --out o.npz --avatar r | m.npz --out o.csv          | --smooth --mirror --gain --exchange --flame
drive m.npz --out o.csv         | m.csv --out o.csv             | --recorded-fps
drive v.mp4 --out o.npz         | m.csv --out o.npz             | --recorded-fps
drive m.csv --out o.npz         |                               | --stay-trained
info a.npz                      | c                             | --flame --principal-point --effect --device --repair
info HEAD                       | c                             | --flame --principal-point --effect --device --repair
batch plan.toml                 | .                             | --out --preset --budget --iterations --seed --flame --principal-point --device
batch . --dry-run               | .                             | --commands
batch . --commands              | .                             | --engine
batch . --engine local          | . --engine ray                | --address
refine r --resume               | r                             | --out --growth --budget --iterations --seed --region --frames
extend r --resume               | r c                           | --out --growth --budget --iterations --seed
"""  # noqa: E501
"""Command without the effect, with it (nothing: nowhere), and the options that this is about."""
HEAD = Path(__file__).parents[2] / "docs/ten-splats.glb"
ROWS = [
    [part.strip().replace("HEAD", str(HEAD)) for part in row.split("|")]
    for row in SERVES.strip().splitlines()
]


def refuse_useless(words):
    command = COMMANDS[words.split()[0]]
    command.refuse_useless(make_parser().parse_args(words.split()))


@pytest.mark.parametrize("row", ROWS, ids=[row[0] for row in ROWS])
def test_an_option_is_refused_where_it_has_no_effect(row):
    """Catches an option that is taken and ignored, and one that is refused where it serves."""
    without, served, flags = row
    for flag in flags.split():
        given = GIVEN.get(flag, flag)
        with refusal(f"^{flag}: has no effect"):
            refuse_useless(f"{without} {given}")
        if served:
            refuse_useless(f"{without.split()[0]} {served} {given}")


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_says_for_what_it_serves(name):
    """Catches an option that was added and says nowhere for what it serves."""
    undeclared = []
    untested = []
    for kind in COMMANDS[name].kinds:
        hints = type_hints(kind)
        rows = [row for row in ROWS if kind in COMMANDS[row[0].split()[0]].kinds]
        tested = {flag for row in rows for flag in row[2].split()}
        for outer in option_fields(kind):
            is_nested = is_dataclass(hints[outer.name])
            for spec in option_fields(hints[outer.name]) if is_nested else [outer]:
                flag = flag_of(spec)
                if outer.metadata["needs"] or spec.metadata["needs"]:
                    untested += [] if flag in tested else [flag]
                elif flag.startswith("--") and flag not in ALWAYS.split():
                    undeclared.append(flag)
    assert (undeclared, untested) == ([], [])
