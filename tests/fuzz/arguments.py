"""Generated arguments of each command about the files of a case, with some nonsense in them."""

import random
from collections.abc import Callable
from pathlib import Path
from typing import get_args

from stga_addon.jobs import table as ask

REQUESTS = tuple(kind.__name__ for kind in get_args(ask.Request))
NUMBERS = [
    "0", "1", "2", "-1", "nan", "inf", "-inf", "1e308", "1e-320", "0x10", "1_0", "٣", " 1", "",
    "9" * 400, "many",
]  # fmt: skip
TEXTS = [
    "", " ", ".", "..", "/", "//", "a\0b", "\ud800", "a" * 300, "a/" * 3000, "ä²−", "\n", "\x1b[2J",
    "-", "--", "=", "~",
]  # fmt: skip


def generate_arguments(rng: random.Random, case: Path) -> tuple[list[str], dict[str, str]]:
    """A command line about the files of the case, with some nonsense in it, and environment
    variables."""
    command = rng.choices(list(COMMANDS), [weight for weight, _ in COMMANDS.values()])[0]
    arguments = [command, *COMMANDS[command][1](rng, case)]
    if rng.random() < 0.04 and len(arguments) > 1:
        arguments.pop(rng.randrange(1, len(arguments)))
    if rng.random() < 0.1:
        arguments.insert(
            rng.randrange(len(arguments) + 1),
            rng.choice([*TEXTS, *NUMBERS, "--bogus", "--help", "--out"]),
        )
    variables = {}
    if rng.random() < 0.1:
        variables["STGA_HEAD"] = rng.choice(
            [str(case / "head")] * 3 + [str(case), "a" * 5000, ".", str(case / "none")]
        )
    if rng.random() < 0.05:
        variables["STGA_LPIPS"] = rng.choice([some_path(rng, case), "a" * 5000]).replace("\0", "")
    if rng.random() < 0.05:
        variables["STGA_PYTHON"] = rng.choice([some_path(rng, case), "a" * 5000]).replace("\0", "")
    variables = {
        name: value.encode("utf-8", "replace").decode() for name, value in variables.items()
    }
    return arguments, variables


def some_path(rng: random.Random, case: Path, *likely: str) -> str:
    """Usually one of the `likely` names in the case, sometimes any file of it, sometimes
    nonsense."""
    chance = rng.random()
    if likely and chance < 0.9:
        return str(case / rng.choice(likely))
    if chance < 0.96:
        return str(rng.choice(sorted(case.rglob("*"))))
    return rng.choice([*TEXTS, str(case / "none"), f"{case}/" + "a" * 300])


def output(rng: random.Random, case: Path, name: str) -> list[str]:
    return ["--out", str(case / name) if rng.random() < 0.8 else some_path(rng, case)]


def option(rng: random.Random, share: float, name: str, *values: str) -> list[str]:
    """Sometimes the option, its first value more often than the others."""
    return (
        [name, values[0] if rng.random() < 0.5 else rng.choice(values)]
        if rng.random() < share
        else []
    )


def capture_arguments(rng: random.Random, case: Path) -> list[str]:
    kind = rng.choice(["mesh", "mesh", "flame", "release", "mesh/meshes", "motion.npz"])
    share = 0.9 if kind in ("flame", "motion.npz") else 0.05
    arguments = [
        some_path(rng, case, kind),
        *option(rng, share, "--flame", some_path(rng, case, "flame/model.npz")),
    ]
    return [*arguments, *option(rng, 0.2, "--principal-point", "vhap", "opencv", "center", *TEXTS)]


def effects_and_device(rng: random.Random) -> list[str]:
    choices = [
        f"{name}={choice}"
        for name in ("jaw", "teeth", "tracking", "exposure")
        for choice in ("on", "off", "auto")
    ]
    effects = option(rng, 0.2, "--effect", *choices, *TEXTS, "jaw=", "=on", "a" * 5000)
    return [*effects, *option(rng, 0.2, "--device", "cpu", "auto", "tpu")]


def train(rng: random.Random, case: Path) -> list[str]:
    options = [
        *option(rng, 0.2, "--seed", "5", *NUMBERS),
        *option(rng, 0.2, "--threshold", "0.001", *NUMBERS),
    ]
    options += [
        *option(rng, 0.2, "--target-psnr", "30", *NUMBERS),
        *option(rng, 0.3, "--schedule", "paper", "default"),
    ]
    options += option(rng, 0.3, "--strategy", "global", "selective", "gaussian-avatars", "x")
    options += ["--stop-when-flat"] if rng.random() < 0.1 else []
    if rng.random() < 0.6:
        run, capture = rng.choice(
            [("run", "mesh"), ("unfinished", "mesh"), ("tracked", "flame"), ("run", "flame")]
        )
        arguments = [some_path(rng, case, capture), "--out", some_path(rng, case, run), "--resume"]
        return [
            *arguments,
            *(options if rng.random() < 0.2 else []),
            *option(rng, 0.2, "--flame", f"{case}/flame/model.npz"),
        ]
    budget = rng.choice(
        [["--iterations", rng.choice(["1", "2"])]] * 4
        + [["--budget", rng.choice(["0.01s", *NUMBERS[:9]])]]
    )
    return [
        *capture_arguments(rng, case),
        *output(rng, case, "new"),
        *budget,
        *effects_and_device(rng),
        *options,
    ]


def render(rng: random.Random, case: Path) -> list[str]:
    source = some_path(rng, case, "run", "tracked", "run/avatar.npz", "splats.ply", "unfinished")
    cameras = some_path(rng, case, "mesh/transforms_val.json", "flame/transforms_test.json")
    arguments = [source, *option(rng, 0.8, "--cameras", cameras)]
    arguments += option(rng, 0.2, "--turntable", "90", "360", *NUMBERS)
    arguments += option(rng, 0.2, "--camera", "0", "2", *NUMBERS)
    # A turntable always has few images: each takes as long as one of any other render.
    arguments += [
        "--seconds",
        rng.choice(["0", "0.1"]),
        *option(rng, 0.1, "--fps", "10", "0", "-1", "nan"),
    ]
    arguments += option(rng, 0.2, "--frames", "0:3", "2-2", "9:12", *TEXTS)
    arguments += option(rng, 0.3, "--capture", some_path(rng, case, "mesh", "flame"))
    arguments += option(rng, 0.2, "--flame", some_path(rng, case, "flame/model.npz"))
    arguments += option(
        rng, 0.2, "--motion", some_path(rng, case, "motion.npz", "flame", "take.csv")
    )
    arguments += option(
        rng, 0.2, "--background", "black", "0,0.5,1", "nan,0,0", "1,2", "1e400,0,0", *TEXTS
    )
    arguments += option(rng, 0.1, "--principal-point", "vhap", "opencv", *TEXTS)
    if rng.random() < 0.2:
        return [*arguments, "--video", some_path(rng, case, "new.mp4", "new.avi")]
    return [*arguments, *output(rng, case, "pictures")]


def export(rng: random.Random, case: Path) -> list[str]:
    arguments = [
        some_path(rng, case, "run", "tracked", "run/avatar.npz", "tracked/avatar.npz", "unfinished")
    ]
    format = rng.choice(
        ["ply", "ply", "ply-sequence", "gaussian-avatars", "usd", "web", "gltf", "spz", "obj"]
    )
    arguments += ["--format", format]
    arguments += option(rng, 0.3, "--capture", some_path(rng, case, "mesh", "flame"))
    arguments += option(rng, 0.2, "--flame", some_path(rng, case, "flame/model.npz"))
    arguments += option(rng, 0.3, "--timestep", "1", *NUMBERS)
    arguments += option(rng, 0.2, "--frames", "0:1", "1:0", "7:9", *NUMBERS)
    arguments += option(rng, 0.2, "--fps", "25", *NUMBERS)
    suffix = {"usd": ".usdc", "web": ".html", "gltf": ".glb", "spz": ".spz"}.get(format, "")
    return [*arguments, *output(rng, case, "exported" + suffix)]


def select(rng: random.Random, case: Path) -> list[str]:
    options = [
        *option(rng, 0.3, "--threshold", "0.001", *NUMBERS),
        *option(rng, 0.2, "--zero-pose", "head", "all", "x"),
    ]
    return [
        *capture_arguments(rng, case),
        *options,
        *option(rng, 0.3, "--out", some_path(rng, case, "new.npz")),
    ]


def info(rng: random.Random, case: Path) -> list[str]:
    flags = [flag for flag in ("--json", "--presets") if rng.random() < 0.3]
    return [*capture_arguments(rng, case), *effects_and_device(rng), *flags]


def evaluate(rng: random.Random, case: Path) -> list[str]:
    return [
        some_path(rng, case, "run", "tracked", "unfinished"),
        *option(rng, 0.5, "--split", "train", "test", "x"),
    ]


def benchmark(rng: random.Random, case: Path) -> list[str]:
    arguments = [*capture_arguments(rng, case), *option(rng, 0.3, "--seeds", *NUMBERS)]
    return [
        *arguments,
        *option(rng, 0.3, "--budget", *NUMBERS),
        *option(rng, 0.3, "--only", "draft", "x", *TEXTS),
    ]


def demo(rng: random.Random, case: Path) -> list[str]:
    return [
        *option(rng, 0.5, "--budget", *NUMBERS),
        *option(rng, 0.5, "--out", some_path(rng, case)),
    ]


def refine(rng: random.Random, case: Path) -> list[str]:
    region = option(
        rng,
        0.9,
        "--region",
        "mouth",
        some_path(rng, case, "mesh/regions.json", "motion.npz"),
        *TEXTS,
    )
    frames = option(rng, 0.2, "--frames", "0-1", "1-0", "7-9", *NUMBERS)
    return [some_path(rng, case, "splats", "run"), *region, *frames, *continuing(rng, case)]


def extend(rng: random.Random, case: Path) -> list[str]:
    takes = [
        some_path(rng, case, "take", "mesh", "flame") for _ in range(rng.choice([1, 1, 1, 2, 0]))
    ]
    only = option(rng, 0.3, "--select-only", some_path(rng, case, "new.npz"))
    return [
        some_path(rng, case, "splats", "run"),
        *takes,
        *only,
        *([] if only else continuing(rng, case)),
    ]


def relight(rng: random.Random, case: Path) -> list[str]:
    light = option(rng, 0.3, "--light", some_path(rng, case, "mesh", "motion.npz"))
    return [
        some_path(rng, case, "splats", "run"),
        *light,
        *option(rng, 0.3, "--gray-card", "0.5,0.5,0.4", *TEXTS),
    ]


def continuing(rng: random.Random, case: Path) -> list[str]:
    """Options that `refine` and `extend` share; each training has an iteration or two."""
    arguments = ["--iterations", rng.choice(["1", "1", "2", "0", "x"]), *output(rng, case, "new")]
    arguments += [
        *option(rng, 0.2, "--growth", "0.5", *NUMBERS),
        *option(rng, 0.2, "--seed", "5", *NUMBERS),
    ]
    arguments += ["--resume"] if rng.random() < 0.05 else []
    return [*arguments, *option(rng, 0.2, "--device", "cpu", "auto", "tpu")]


def tracked_footage(case: Path) -> list[str]:
    """What `stga track` is given to track the footage of the case from its landmark files."""
    footage = case / "footage"
    return [
        str(footage / "footage"),
        "--model",
        str(footage / "head.npz"),
        "--landmarks",
        str(footage / "points"),
    ]


def track(rng: random.Random, case: Path) -> list[str]:
    if rng.random() < 0.4:
        return [
            *tracked_footage(case),
            *output(rng, case, "new"),
            *option(rng, 0.2, "--focal", "900", *NUMBERS),
        ]
    arguments = [
        some_path(rng, case, "mesh", "flame", "mesh/images"),
        "--model",
        some_path(rng, case, "flame/model.npz"),
    ]
    for name in ("--landmarks", "--cameras"):
        arguments += option(rng, 0.3, name, some_path(rng, case, "mesh", "mesh/transforms.json"))
    for name in ("--start", "--stop", "--step", "--focal"):
        arguments += option(rng, 0.2, name, "1", *NUMBERS)
    arguments += option(rng, 0.2, "--sync", "auto", "motion", *TEXTS) + option(
        rng, 0.2, "--world", "keep", *TEXTS
    )
    return [*arguments, *option(rng, 0.2, "--offset", "0=1", *TEXTS), *output(rng, case, "new")]


def avatar(rng: random.Random, case: Path) -> list[str]:
    begun = case / "new" / "inputs.json"  # as if a first call had been interrupted
    if rng.random() < 0.4:
        begun.parent.mkdir(parents=True, exist_ok=True)
        begun.write_text(
            rng.choice(["{}", "[]", '{"model": 1}', '{"model": "x", "footage": null}', "x"])
        )
    iterations = ["--iterations", rng.choice(["2", "0", "x"])]
    return [*track(rng, case), *iterations, *(["--no-blend"] if rng.random() < 0.8 else [])]


def drive(rng: random.Random, case: Path) -> list[str]:
    arguments = [some_path(rng, case, "take.csv", "motion.npz", "flame")]
    arguments += ["--out", some_path(rng, case, "new.csv", "new.npz")]
    arguments += option(rng, 0.7, "--flame", some_path(rng, case, "flame/model.npz"))
    arguments += option(rng, 0.2, "--head", some_path(rng, case, "flame", "mesh"))
    arguments += option(rng, 0.2, "--fps", "25", *NUMBERS)
    arguments += option(rng, 0.2, "--neutral", "quiet", "first", *TEXTS)
    arguments += option(rng, 0.2, "--strength", "2", *NUMBERS)
    arguments += option(rng, 0.2, "--smooth", "0.1", *NUMBERS)
    return arguments + option(rng, 0.2, "--gain", "jaw=2", "x=1", "jaw=nan", *TEXTS)


BATCH_PLANS = (
    'out = "{new}"\n[job.a]\nrequest = "train"\ncapture = "mesh"\n'
    'settings = {{ preset = "draft" }}\n'
    '[job.b]\nrequest = "evaluate"\nrun = "{new}/a"\nsplit = {value}\n',
    'out = "{new}"\n[resources]\nthreads = {value}\n'
    '[job.a]\nrequest = "track"\nminutes = {value}\n',
    "[job.a]\nrequest = {value}\nafter = [{value}]\n",
    "{value}",
)


def batch(rng: random.Random, case: Path) -> list[str]:
    """Plans, shown or prepared: jobs themselves are requests, which `perform` is tried with."""
    value = rng.choice(['"val"', "1", "-1", "nan", "1e400", "[]", '"../x"', '""', "true"])
    new = some_path(rng, case, "new")
    plan = rng.choice(BATCH_PLANS).format(new=new, value=value)
    (case / "plan.toml").write_bytes(plan.encode("utf-8", "surrogatepass"))
    arguments = ["--dry-run"] if rng.random() < 0.7 else ["--commands"]
    if rng.random() < 0.6:
        return [str(case / "plan.toml"), *arguments, *option(rng, 0.3, "--threads", *NUMBERS)]
    arguments += [
        "--iterations",
        rng.choice(["3", *NUMBERS]),
        *option(rng, 0.3, "--seed", *NUMBERS),
    ]
    return [some_path(rng, case, "mesh", "flame"), *arguments, *option(rng, 0.8, "--out", new)]


COMMANDS: dict[str, tuple[float, Callable[[random.Random, Path], list[str]]]] = {
    "info": (3, info), "select": (3, select), "export": (3, export), "drive": (1, drive),
    "render": (3, render), "eval": (2, evaluate), "train": (1, train), "refine": (0.5, refine),
    "extend": (0.5, extend),
    "relight": (0.5, relight), "track": (1, track), "avatar": (0.5, avatar),
    "perform": (1.5, lambda rng, case: [some_path(rng, case, *(f"jobs/{n}" for n in REQUESTS))]),
    "batch": (1, batch), "presets": (0.5, lambda rng, case: capture_arguments(rng, case)),
    "benchmark": (0.5, benchmark), "demo": (0.2, demo),
    "x": (0.1, lambda rng, case: []),
}  # fmt: skip
