"""Generated arguments of each command about the files of a case, with some nonsense in them."""

import stga_addon.development.commands  # noqa: F401 (adds its requests)
from stga_addon.jobs import table as ask

REQUESTS = tuple(kind.__name__ for kind in ask.JOBS)
NUMBERS = [
    "0", "1", "2", "-1", "nan", "inf", "-inf", "1e308", "1e-320", "0x10", "1_0", "٣", " 1", "",
    "9" * 400, "many",
]  # fmt: skip
TEXTS = [
    "", " ", ".", "..", "/", "//", "a\0b", "\ud800", "a" * 300, "a/" * 3000, "ä²−", "\n", "\x1b[2J",
    "-", "--", "=", "~",
]  # fmt: skip


def generate_arguments(rng, case):
    """A command line about the files of the case, with some nonsense in it, and environment
    variables."""
    command = rng.choices(list(COMMANDS), [weight for weight, _ in COMMANDS.values()])[0]
    arguments = [command, *filled(rng, case, COMMANDS[command][1])]
    if rng.random() < 0.04 and len(arguments) > 1:
        arguments.pop(rng.randrange(1, len(arguments)))
    if rng.random() < 0.1:
        nonsense = rng.choice([*TEXTS, *NUMBERS, "--bogus", "--help", "--out"])
        arguments.insert(rng.randrange(len(arguments) + 1), nonsense)
    heads = [str(case / "head")] * 3 + [str(case), "a" * 5000, ".", str(case / "none")]
    chosen = {"STGA_HEAD": rng.choice(heads)} if rng.random() < 0.1 else {}
    for name in ("STGA_LPIPS", "STGA_PYTHON"):
        if rng.random() < 0.05:
            chosen[name] = rng.choice([some_path(rng, case), "a" * 5000]).replace("\0", "")
    return arguments, {n: v.encode("utf-8", "replace").decode() for n, v in chosen.items()}


def some_path(rng, case, *likely):
    """Usually one of the `likely` names in the case, sometimes any file of it, sometimes
    nonsense."""
    chance = rng.random()
    if likely and chance < 0.9:
        return str(case / rng.choice(likely))
    if chance < 0.96:
        return str(rng.choice(sorted(case.rglob("*"))))
    return rng.choice([*TEXTS, str(case / "none"), f"{case}/" + "a" * 300])


def filled(rng, case, rows):
    """Arguments of rows: a value by position; a tuple, an option that is there with a probability,
    its first value more often than the others; a list, one of several lists of rows; a function
    that makes some. "@a b": a path, mostly that of `a` or `b` in the case."""

    def of(value):
        return some_path(rng, case, *value[1:].split()) if value.startswith("@") else value

    found = []
    for row in rows:
        if isinstance(row, str):
            found.append(of(row))
        elif isinstance(row, list):
            found += filled(rng, case, rng.choice(row))
        elif callable(row):
            found += row(rng, case)
        elif rng.random() < row[0]:
            _, name, *values = row
            value = [] if not values else [values[0] if rng.random() < 0.5 else rng.choice(values)]
            found += [name, *map(of, value)]
    return found


def tracked_footage(case):
    """What `stga track` is given to track the footage of the case from its landmark files."""
    at = case / "footage"
    return [str(at / "footage"), "--model", str(at / "head.npz"), "--landmarks", str(at / "points")]


def begun_avatar(rng, case):
    """As if a first call had been interrupted, sometimes."""
    if rng.random() < 0.4:
        (case / "new").mkdir(parents=True, exist_ok=True)
        texts = ["{}", "[]", '{"model": 1}', '{"model": "x", "footage": null}', "x"]
        (case / "new" / "inputs.json").write_text(rng.choice(texts))
    return []


BATCH_PLANS = (
    'out = "{new}"\n[job.a]\nrequest = "train"\ncapture = "mesh"\n'
    'settings = {{ preset = "draft" }}\n'
    '[job.b]\nrequest = "evaluate"\nrun = "{new}/a"\nsplit = {value}\n',
    'out = "{new}"\n[resources]\nthreads = {value}\n'
    '[job.a]\nrequest = "track"\nminutes = {value}\n',
    "[job.a]\nrequest = {value}\nafter = [{value}]\n",
    "{value}",
)


def batch_plan(rng, case):
    value = rng.choice(['"val"', "1", "-1", "nan", "1e400", "[]", '"../x"', '""', "true"])
    plan = rng.choice(BATCH_PLANS).format(new=some_path(rng, case, "new"), value=value)
    (case / "plan.toml").write_bytes(plan.encode("utf-8", "surrogatepass"))
    return [str(case / "plan.toml")]


FLAME = (0.2, "--flame", "@flame/model.npz")
MODEL = "@flame/model.npz"
POINT = (0.2, "--principal-point", "vhap", "opencv", "center", *TEXTS)
BARE = ["@mesh mesh release mesh/meshes", (0.05, "--flame", MODEL)]
CAPTURE = [[BARE, BARE, ["@flame motion.npz", (0.9, "--flame", MODEL)]], POINT]
CHOICES = [f"{e}={c}" for e in ("jaw", "teeth", "tracking", "exposure") for c in ("on", "off")]
EFFECT = (0.2, "--effect", *CHOICES, "jaw=auto", *TEXTS, "jaw=", "=on", "a" * 5000)
DEVICE = (0.2, "--device", "cpu", "auto", "tpu")
SEED = (0.2, "--seed", "5", *NUMBERS)
THRESHOLD = (0.2, "--threshold", "0.001", *NUMBERS)
OUT = (1, "--out", "@new")
FPS = (0.2, "--fps", "25", *NUMBERS)
TRAIN = [
    SEED,
    THRESHOLD,
    (0.2, "--target-psnr", "30", *NUMBERS),
    (0.1, "--stop-when-flat"),
    (0.3, "--schedule", "paper", "default"),
    (0.3, "--strategy", "global", "selective", "gaussian-avatars", "x"),
]
RESUMED = [["@mesh", (1, "--out", "@run unfinished")], ["@flame", (1, "--out", "@tracked run")]]
RESUME = [RESUMED, (1, "--resume"), FLAME, [[], [], [], [], TRAIN]]
ITERATIONS = (1, "--iterations", "1", "2")
BUDGET = [[ITERATIONS], [ITERATIONS], [ITERATIONS], [(1, "--budget", "0.01s", *NUMBERS[:9])]]
CONTINUE = [
    (1, "--iterations", "1", "2", "0", "x"),
    OUT,
    (0.2, "--growth", "0.5", *NUMBERS),
    SEED,
    (0.05, "--resume"),
    DEVICE,
]
TAKE = "@take mesh flame"
TRACK = [
    [
        [lambda _, case: tracked_footage(case), OUT, (0.2, "--focal", "900", *NUMBERS)],
        [
            "@mesh flame mesh/images",
            (1, "--model", MODEL),
            OUT,
            *((0.3, name, "@mesh mesh/transforms.json") for name in ("--landmarks", "--cameras")),
            *((0.2, f"--{name}", "1", *NUMBERS) for name in ("start", "stop", "step", "focal")),
            (0.2, "--sync", "auto", "motion", *TEXTS),
            (0.2, "--world", "keep", *TEXTS),
            (0.2, "--offset", "0=1", *TEXTS),
        ],
    ]
]
FORMATS = (
    "ply",
    "ply-sequence",
    "gaussian-avatars",
    "usd",
    "web",
    "skinned-gltf",
    "gltf",
    "spz",
    "obj",
)
SUFFIXES = {"usd": ".usdc", "web": ".html", "gltf": ".glb", "skinned-gltf": ".glb", "spz": ".spz"}
COMMANDS = {
    "info": (3, [*CAPTURE, EFFECT, DEVICE]),
    "select": (3, [
        *CAPTURE, THRESHOLD, (0.2, "--zero-pose", "head", "all", "x"), (0.3, "--out", "@new.npz"),
    ]),
    "export": (3, [
        "@run tracked run/avatar.npz tracked/avatar.npz unfinished",
        [[(1, "--format", f), (1, "--out", f"@exported{SUFFIXES.get(f, '')}")] for f in FORMATS],
        (0.3, "--capture", "@mesh flame"), FLAME, (0.3, "--timestep", "1", *NUMBERS), FPS,
        (0.2, "--frames", "0:1", "1:0", "7:9", *NUMBERS), (0.1, "--filmed-only"),
    ]),
    "drive": (1, [
        "@take.csv motion.npz flame", (1, "--out", "@new.csv new.npz"), (0.7, "--flame", MODEL),
        (0.2, "--head", "@flame mesh"), FPS, (0.2, "--neutral", "quiet", "first", *TEXTS),
        (0.2, "--strength", "2", *NUMBERS), (0.2, "--smooth", "0.1", *NUMBERS),
        (0.2, "--gain", "jaw=2", "x=1", "jaw=nan", *TEXTS),
    ]),
    # a turntable always has few images: each takes as long as one of any other render
    "render": (3, [
        "@run tracked run/avatar.npz splats.ply unfinished", FLAME, POINT,
        (0.8, "--cameras", "@mesh/transforms_val.json flame/transforms_test.json"),
        (0.2, "--turntable", "90", "360", *NUMBERS), (0.2, "--camera", "0", "2", *NUMBERS),
        (1, "--seconds", "0", "0.1"), (0.1, "--fps", "10", "0", "-1", "nan"),
        (0.2, "--frames", "0:3", "2-2", "9:12", *TEXTS), (0.3, "--capture", "@mesh flame"),
        (0.2, "--motion", "@motion.npz flame take.csv"),
        (0.2, "--background", "black", "0,0.5,1", "nan,0,0", "1,2", "1e400,0,0", *TEXTS),
        [[(1, "--video", "@new.mp4 new.avi")], *[[(1, "--out", "@pictures")]] * 4],
    ]),
    "eval": (2, ["@run tracked unfinished", (0.5, "--split", "train", "test", "x")]),
    "train": (1, [[RESUME, RESUME, [*CAPTURE, OUT, BUDGET, EFFECT, DEVICE, *TRAIN]]]),
    "refine": (0.5, [
        "@splats run", (0.2, "--frames", "0-1", "1-0", "7-9", *NUMBERS), *CONTINUE,
        (0.9, "--region", "mouth", "@mesh/regions.json motion.npz", *TEXTS),
    ]),
    "extend": (0.5, [
        "@splats run", [[TAKE], [TAKE], [TAKE], [TAKE, TAKE], []],
        *CONTINUE,
    ]),
    "exact": (0.5, ["@splats run"]),
    "relight": (0.5, [
        "@splats run", (0.3, "--light", "@mesh motion.npz"),
        (0.3, "--gray-card", "0.5,0.5,0.4", *TEXTS),
    ]),
    "track": (1, TRACK),
    "avatar": (
        0.5, [begun_avatar, *TRACK, (1, "--iterations", "2", "0", "x"), (0.8, "--no-blend")],
    ),
    "perform": (1.5, [f"@{' '.join(f'jobs/{name}' for name in REQUESTS)}"]),
    # plans, shown or prepared: jobs themselves are requests, which `perform` is tried with
    "batch": (1, [
        [[(1, "--dry-run")], [(1, "--dry-run")], [(1, "--commands")]],
        [
            [batch_plan, (0.3, "--threads", *NUMBERS)],
            ["@mesh flame", (1, "--iterations", "3", *NUMBERS), SEED, (0.8, "--out", "@new")],
        ],
    ]),
    "presets": (0.5, CAPTURE),
    "benchmark": (0.5, [
        *CAPTURE, (0.3, "--seeds", *NUMBERS), (0.3, "--budget", *NUMBERS),
        (0.3, "--only", "draft", "x", *TEXTS),
    ]),
    "demo": (0.2, [(0.5, "--budget", *NUMBERS), (0.5, "--out", "@")]), "x": (0.1, []),
}  # fmt: skip
