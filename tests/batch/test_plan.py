"""Plans: which jobs a table makes, what each comes after, and the sentence for each mistake."""

from dataclasses import replace

import pytest
from refusal import refusal

from stga_addon.driving.open_motion import MotionOptions
from stga_addon.jobs.batch.folder import job_digests
from stga_addon.jobs.batch.plan import Resources, make_plan, plan_of_captures, read_plan
from stga_addon.jobs.export import Export
from stga_addon.jobs.finished_run import Evaluate
from stga_addon.jobs.render import Render
from stga_addon.jobs.track import Track
from stga_addon.jobs.train import Extend, Train
from stga_addon.training.settings import make_settings

PLAN = """
out = "runs"
[resources]
threads = 2
[job.anna-val]
request = "evaluate"
run = "runs/anna"
split = "val"
[job.anna]
request = "train"
capture = "runs/tracked"
settings = { iterations = 30, seed = 7, selection = { threshold = 0.02 }, sh_steps = [0.5] }
resources = { memory_gb = 4.5, gpu = true }
[job.tracked]
request = "track"
model = "head.npz"
footage = "footage/anna"
[job.smile]
request = "extend"
parent = "runs/anna"
captures = ["footage/ben", "runs/tracked"]
iterations = 5
minutes = 2
after = ["anna-val"]
"""


@pytest.fixture
def base(tmp_path):
    for name in ("anna", "ben"):
        (tmp_path / "footage" / name).mkdir(parents=True)
    (tmp_path / "head.npz").touch()
    return tmp_path


def plan_of(base, text=PLAN):
    (base / "plan.toml").write_text(text)
    return read_plan(base / "plan.toml")


def test_jobs_of_a_plan(base):
    """Catches fields that do not reach a request, and a job before what it reads is there."""
    plan = plan_of(base)
    runs = base / "runs"
    jobs = {job.name: job for job in plan.jobs}
    assert [*jobs] == ["tracked", "anna", "anna-val", "smile"]
    assert jobs["tracked"].request == Track(
        base / "footage/anna", base / "head.npz", runs / "tracked"
    )
    default = make_settings(iterations=1).selection
    settings = make_settings(
        iterations=30,
        seed=7,
        effects={},
        sh_steps=(0.5,),
        selection=replace(default, threshold=0.02),
    )
    training = jobs["anna"]
    assert training.request == Train(runs / "anna", runs / "tracked", settings)
    assert training.after == ("tracked",)
    assert training.resources == Resources(threads=2, memory_gb=4.5, gpu=True)
    assert jobs["anna-val"].request == Evaluate(runs / "anna", "val")
    smile = jobs["smile"]
    assert smile.request == Extend(
        runs / "smile", runs / "anna", (base / "footage/ben", runs / "tracked"), iterations=5
    )
    assert set(smile.after) == {"anna", "tracked", "anna-val"}
    assert smile.minutes == 2


def test_names_of_captures(base):
    """Catches captures that cannot be trained together, or not as `stga train` would train them."""
    folders = ["anna/take", "ben/take", "_anna", "_é_ben", "film/東京", "film/大阪", "c 1"]
    for name in folders:
        (base / name).mkdir(parents=True)
    paths = [base / name for name in folders]
    plan = plan_of_captures(paths, base / "out", {"preset": "draft"}, {"device": "cpu"})
    names = ["anna-take", "ben-take", "anna", "ben", "film", "film_2", "c-1"]
    assert {job.name: job.request.capture for job in plan.jobs} == {
        f"train-{name}": base / folder for name, folder in zip(names, folders, strict=True)
    }
    first = plan.jobs[0].request
    settings = plan.jobs[0].request.settings
    assert (first.run, first.device) == (base / "out/train-anna-take", "cpu")
    assert (settings.preset, settings.seconds, settings.lattice) == ("draft", None, 1)
    assert settings.effects == {}


ONE = '[job.one]\nrequest = "train"\ncapture = "footage/anna"\nsettings = { iterations = 3 }\n'
MISTAKES = r"""
out = 3
ONE
! out: expected the batch's folder

out = "r"
workers = 3
ONE
! workers: is not a key of it

out = "r"
! holds no job; expected a table \[job.NAME\]

out = "r"
[job."a/b"]
! \[job.'a/b'\]: expected a name

out = "r"
[job.replaced]
! other than 'replaced'

out = "r"
[job.a]
request = "fly"
! \[job.a\]: request: expected one of train, .*got 'fly'

out = "r"
[job.a]
! \[job.a\]: request: expected one of

out = "r"
ONE
capturee = "x"
! \[job.one\]: capturee: is not a key

out = "r"
ONE
device = 3
! \[job.one\]: setting device: expected a text

out = "r"
ONE
device = "abacus"
! \[job.one\]: setting device: expected auto, cpu, gpu

out = "r"
ONE
flame = 3
! \[job.one\]: setting flame: expected a path

out = "r"
ONE
flame = 1979-05-27
! \[job.one\]: setting flame: expected a path

out = "footage/anna"
ONE
! \[job.one\]: capture: .*anna is the batch's own folder; choose another 'out'

out = "r"
ONE
flame = "none.pkl"
! \[job.one\]: flame: .*none.pkl does not exist

out = "r"
[job.one]
request = "train"
capture = "footage/anna"
settings = { iterations = 0 }
! \[job.one\]: settings.iterations: expected

out = "r"
[job.one]
request = "train"
capture = "footage/anna"
settings = { iterations = inf }
! \[job.one\]: settings.iterations

out = "r"
[job.one]
request = "train"
capture = "footage/anna"
settings = { iteration = 3 }
! \[job.one\]: settings: iteration: is not a key

out = "r"
[job.one]
request = "train"
capture = "footage/anna"
settings = {  }
! \[job.one\]: the budget must be given

out = "r"
[job.one]
request = "train"
capture = "footage/anna"
settings = 3
! \[job.one\]: settings: expected a table

out = "r"
ONE
after = ["two"]
! \[job.one\]: after: 'two' is not a job of the plan

out = "r"
ONE
after = "two"
! \[job.one\]: after: expected a list

out = "r"
ONE
after = ["one"]
! these jobs wait for each other: one → one

out = "r"
[job.a]
request = "evaluate"
run = "r/b"
[job.b]
request = "evaluate"
run = "r/a"
! wait for each other

out = "r"
ONE
resources = { threads = -1 }
! \[job.one\]: resources: setting threads: expected

out = "r"
ONE
resources = { cpus = 1 }
! \[job.one\]: resources: cpus: is not a key

out = "r"
ONE
minutes = 0
! \[job.one\]: setting minutes: expected a number above 0

out = "r"
[job.a]
request = "evaluate"
! \[job.a\]: run: is missing

out = "r
! is not valid TOML
"""
"""Plans, in which ONE is a job that is right, and what is said of them."""


@pytest.mark.parametrize("mistake", MISTAKES.strip().split("\n\n"), ids=lambda text: text[-40:])
def test_a_mistake_is_a_sentence(base, mistake):
    """Catches a mistake in a plan that is carried out, or ends in a traceback."""
    text, _, message = mistake.partition("\n! ")
    with refusal(message) as caught:
        plan_of(base, text.replace("ONE", ONE))
    assert str(caught.value).startswith(str(base / "plan.toml"))


def changed(before, after):
    assert before.keys() == after.keys()
    return {name for name in before if before[name] != after[name]}


def test_what_changed_is_done_again(base):
    """Catches work repeated although nothing changed, and results of old inputs kept."""
    before = job_digests(plan_of(base))
    same = plan_of(base, PLAN.replace("threads = 2", "threads = 1"))
    assert changed(before, job_digests(same)) == set()
    (base / "footage/ben/take.mp4").write_text("new")
    assert changed(before, job_digests(plan_of(base))) == {"smile"}
    (base / "footage/ben/take.mp4").unlink()
    (base / "footage/anna/.cache").touch()  # hidden
    assert changed(before, job_digests(plan_of(base))) == set()
    after = job_digests(plan_of(base, PLAN.replace("iterations = 5", "iterations = 6")))
    assert changed(before, after) == {"smile"}
    run = base / "run"
    run.mkdir()
    for name in ("run.json", "avatar.npz"):
        (run / name).write_text("1")
    values = {"out": "r", "job": {"a": {"request": "evaluate", "run": "run"}}}
    before = job_digests(make_plan(values, base, "plan"))
    (run / "quality_val.json").touch()
    assert changed(before, job_digests(make_plan(values, base, "plan"))) == set()
    (run / "avatar.npz").write_text("2")
    assert changed(before, job_digests(make_plan(values, base, "plan"))) == {"a"}


def test_texts_that_name_files(base):
    """Catches a file looked for where the worker runs, or whose change goes unnoticed."""
    text = """
out = "runs"
""" + "".join(
        f'[job.track-{mattes}]\nrequest = "track"\nmodel = "head.npz"\nfootage = '
        f'"footage/anna"\nmattes = "{mattes}"\n'
        f'[job.refine-{region}]\nrequest = "refine"\nparent = "footage"\nseconds = 3\nregion = '
        f'"{region}"\n'
        for mattes, region in (("none", "mouth"), ("mattes", "brow.JSON"))
    ).replace("refine-brow.JSON", "refine-brow")
    (base / "mattes").mkdir()
    (base / "brow.JSON").write_text("{}")
    jobs = {job.name: job.request for job in plan_of(base, text).jobs}
    mattes = [jobs[f"track-{name}"].mattes for name in ("none", "mattes")]
    assert mattes == ["none", str(base / "mattes")]
    regions = [jobs[f"refine-{name}"].region for name in ("mouth", "brow")]
    assert regions == ["mouth", str(base / "brow.JSON")]
    before = job_digests(plan_of(base, text))
    (base / "brow.JSON").write_text("{ }")
    (base / "mattes/0.png").touch()
    assert changed(before, job_digests(plan_of(base, text))) == {"track-mattes", "refine-brow"}
    (base / "brow.JSON").unlink()
    with refusal(r"\[job.refine-brow\]: region: .*brow.JSON does not exist"):
        plan_of(base, text)


def test_options_inside_a_request(tmp_path):
    """Catches requests that a plan cannot ask for, because options have no plain default."""
    text = """
out = "runs"
[job.film]
request = "render"
source = "a.npz"
output = "film.mp4"
video = true
motion = "take.csv"
motion_options = { neutral = "quiet" }
[job.page]
request = "export"
source = "a.npz"
output = "a.html"
file_format = "web"
"""
    for name in ("a.npz", "take.csv"):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "plan.toml").write_text(text, encoding="utf-8")
    film, page = (job.request for job in read_plan(tmp_path / "plan.toml").jobs)
    assert isinstance(film, Render)
    assert film.motion_options == MotionOptions(neutral="quiet")
    assert film.motion == tmp_path / "take.csv"
    assert isinstance(page, Export)
    assert page.motion_options == MotionOptions()
