"""The training job: what is written down, what is refused, and that a worker trains what the same process would."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from capture.factory import ball, write_mesh_capture

from stga_addon.avatar.file import read_avatar
from stga_addon.cli.main import main
from stga_addon.errors import StgaError
from stga_addon.files import read_npz, write_json
from stga_addon.requests import training_job
from stga_addon.requests.open_head import FOLDER
from stga_addon.requests.training_job import TrainingJob, job_folder, read_job, run_training_job, write_job
from stga_addon.training.run.folder import Run, write_run
from stga_addon.training.run.progress import describe_figures
from stga_addon.training.run.request import Extension, Refinement, Request
from stga_addon.training.settings import make_settings
from stga_addon.worker.launch import start_worker
from stga_addon.worker.status import (
    CANCEL_FILE,
    LOG_FILE,
    STATUS_FILE,
    WorkerState,
    inspect_worker,
    log_lines,
    request_cancel,
    status_writer,
)


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    return write_mesh_capture(tmp_path / "capture")


def new_job(capture: Path, **changes: object) -> TrainingJob:
    settings = make_settings("selective", **{"iterations": 12, "hull_points": False, "seed": 3, **changes})
    return TrainingJob(capture, None, "opencv", settings)


def painted() -> dict[int, np.ndarray]:
    return {0: np.zeros(320, bool), 1: np.arange(320) < 40, 3: np.arange(320) % 2 == 0}


def start(run: Path) -> "subprocess.Popen[bytes]":
    return start_worker(job_folder(run), sys.executable, training_job.worker_arguments(run))


def test_round_trip(tmp_path, capture):
    """Catches a setting or a path that is lost between the panel and the worker."""
    wanted = new_job(capture)
    write_job(tmp_path / "run", wanted, painted())
    assert read_job(tmp_path / "run") == wanted
    read = read_npz(job_folder(tmp_path / "run") / training_job.SELECTION)
    assert {int(name): mask.tolist() for name, mask in read.items()} == {t: m.tolist() for t, m in painted().items()}


def test_the_next_job_forgets_the_last(tmp_path, capture):
    """Catches yesterday's selection, preview or wish to cancel in today's training."""
    run, folder = tmp_path / "run", job_folder(tmp_path / "run")
    write_job(run, new_job(capture), painted())
    for name in (training_job.PREVIEW, CANCEL_FILE, STATUS_FILE):
        (folder / name).write_text("{}")
    write_job(run, new_job(capture))
    assert sorted(path.name for path in folder.iterdir()) == [training_job.JOB, LOG_FILE]


def test_refusals(tmp_path, capture):
    """Catches a run that is overwritten, and one resumed that is not there: both before a worker is started."""
    run = tmp_path / "run"
    with pytest.raises(StgaError, match=r"holds no run \(run\.json is missing\)"):
        write_job(run, TrainingJob(capture, None, "vhap", None))
    assert not run.exists()
    write_run(run, Run(capture, None, "vhap", make_settings(iterations=5)))
    with pytest.raises(StgaError, match="already holds a run; resume it, or choose another folder"):
        write_job(run, new_job(capture))
    write_job(run, TrainingJob(capture, None, "vhap", None))
    assert read_job(run).settings is None
    with status_writer(job_folder(run)), pytest.raises(StgaError, match="another worker is running"):
        write_job(run, TrainingJob(capture, None, "vhap", None))


def test_the_worker_refuses_another_run(tmp_path, capture):
    """Catches a run continued with another principal point: reading the capture is left to the worker."""
    pytest.importorskip("torch")
    run = tmp_path / "run"
    write_run(run, Run(capture, None, "vhap", make_settings(iterations=5)))
    write_job(run, TrainingJob(capture, None, "opencv", None))
    with pytest.raises(StgaError, match="was trained with principal point 'vhap', not 'opencv'"):
        run_training_job(run)
    assert inspect_worker(job_folder(run)).status.error.startswith(f"{run}: was trained with principal point")
    assert not (run / "avatar.npz").exists()


HEADER = {"format": "stga-job", "version": 2}


@pytest.mark.parametrize(
    "values",
    [[], {}, {"format": "stga-job", "version": 1}, {"format": "stga-job", "version": 2}]
    + [
        {**HEADER, "capture": "c", "flame": None, "principal_point": "vhap", "device": device, "settings": settings}
        for device, settings in (("cpu", {}), ("cpu", {"strategy": "global"}), ("cpu", 3), ("toaster", None))
    ],
)
def test_damaged_jobs(tmp_path, values):
    """Catches a traceback where a job was damaged or comes from another version."""
    write_json(_made(job_folder(tmp_path)) / training_job.JOB, values)
    with pytest.raises(StgaError, match=r"job\.json"):
        read_job(tmp_path)


def test_figures_in_short_lines():
    """Catches a panel that shows what is not known yet, or numbers that nobody can read."""
    assert describe_figures({}) == []
    figures = {"iteration": 900, "per_second": 12.34, "left_s": 125.0, "splats": 61234.0, "psnr": 30.0}
    assert describe_figures(figures) == ["12.3 it/s   2.1 min left", "PSNR 30.00 dB", "61\u202f234 splats"]


@pytest.mark.slow
def test_a_worker_trains_what_this_process_would(tmp_path, capture):
    """Catches the panel and the command line drifting apart: same seed, same threads, same avatar to the last bit."""
    pytest.importorskip("torch")
    here, there, plain = tmp_path / "here", tmp_path / "there", tmp_path / "plain"
    for run in (here, there):
        write_job(run, new_job(capture), painted())
    assert run_training_job(here) == here / "avatar.npz"
    process = start(there)
    assert process.wait(300) == 0, log_lines(job_folder(there), 50)
    seen = inspect_worker(job_folder(there), process)
    assert seen.state == WorkerState.FINISHED
    assert seen.status.figures["splats"] > 0
    assert {"psnr", "loss", "memory_mb", "per_second"} <= set(seen.status.figures)
    one, two = (read_npz(run / "avatar.npz") for run in (here, there))
    assert one.keys() == two.keys()
    for name in one:
        np.testing.assert_array_equal(one[name], two[name], err_msg=name)
    assert read_npz(here / "selection.npz")["00003"].tolist() == painted()[3].tolist()

    options = ["--iterations", "12", "--seed", "3", "--strategy", "selective", "--principal-point", "opencv"]
    assert main(["train", str(capture), "--out", str(plain), *options]) == 0  # with hull seeds, by the rule
    assert len(read_npz(plain / "avatar.npz")["xyz"]) >= len(one["xyz"])


@pytest.mark.slow
def test_cancel_keeps_the_avatar_and_resume_goes_on(tmp_path, capture):
    """Catches a cancel that throws work away, and a resumed run that begins anew."""
    pytest.importorskip("torch")
    run, folder = tmp_path / "run", job_folder(tmp_path / "run")
    write_job(run, new_job(capture, iterations=40))

    def cancel(progress):
        if progress.iteration == 5:
            request_cancel(folder)
        assert progress.iteration <= 6
        return False

    run_training_job(run, also=cancel)
    assert inspect_worker(folder).state == WorkerState.CANCELLED
    assert (run / "avatar.npz").exists()
    write_job(run, TrainingJob(capture, None, "opencv", None))
    first = []
    run_training_job(run, also=lambda progress: first.append(progress.iteration))
    assert min(n for n in first if n) > 5
    assert max(first) == 40
    assert inspect_worker(folder).state == WorkerState.FINISHED


@pytest.mark.slow
def test_previews_while_it_trains(tmp_path, capture, monkeypatch):
    """Catches a preview that never comes, cannot be read, or changes what is trained."""
    pytest.importorskip("torch")
    from stga_addon.avatar.file import read_avatar

    monkeypatch.setattr(training_job, "PREVIEW_S", 0.0)
    run, quiet = tmp_path / "run", tmp_path / "quiet"
    previews = []

    def look(progress):
        path = job_folder(run) / training_job.PREVIEW
        if path.exists():
            previews.append(len(read_avatar(path).splats))
        return False

    write_job(run, new_job(capture))
    run_training_job(run, also=look)
    assert len(previews) > 5
    monkeypatch.setattr(training_job, "PREVIEW_S", 1e9)
    write_job(quiet, new_job(capture))
    run_training_job(quiet)
    assert not (job_folder(quiet) / training_job.PREVIEW).exists()
    np.testing.assert_array_equal(read_npz(run / "avatar.npz")["xyz"], read_npz(quiet / "avatar.npz")["xyz"])


@pytest.mark.slow
def test_a_preview_that_cannot_be_written_costs_nothing_else(tmp_path, capture, monkeypatch):
    """Catches a training that ends because its preview, or a word about it, found no room on the disk."""
    pytest.importorskip("torch")

    def full(path: Path, avatar: object) -> None:
        raise StgaError(f"{path}: cannot be written (No space left on device)")

    monkeypatch.setattr(training_job, "PREVIEW_S", 0.0)
    monkeypatch.setattr(training_job, "write_avatar", full)
    write_job(tmp_path / "run", new_job(capture))
    assert run_training_job(tmp_path / "run").exists()


@pytest.mark.slow
def test_mistakes_reach_the_folder_and_the_exit_code(tmp_path, capture, capsys):
    """Catches a worker whose failure only its log shows, and a command that ends well although nothing was trained."""
    pytest.importorskip("torch")
    assert main(["job", str(tmp_path / "nothing")]) == 2
    assert "holds no job" in capsys.readouterr().err
    run = tmp_path / "run"
    write_job(run, new_job(capture))
    (capture / "meshes/00003.obj").write_text("v 0 0 nan\n")
    assert main(["job", str(run)]) == 2
    seen = inspect_worker(job_folder(run))
    assert seen.state == WorkerState.FAILED
    assert "00003.obj" in seen.status.error
    assert seen.status.traceback == ""


@pytest.mark.slow
def test_closed_stderr_still_leaves_a_status(tmp_path, capture):
    """Catches a worker without stderr that ends before it writes its status."""
    pytest.importorskip("torch")
    run = tmp_path / "run"
    write_job(run, new_job(capture, iterations=2))
    shell = f'"{sys.executable}" -m stga_addon job "{run}" 2>&-'
    done = subprocess.run(["sh", "-c", shell], cwd=Path(__file__).parents[2], timeout=300)
    assert done.returncode == 0
    assert inspect_worker(job_folder(run)).state == WorkerState.FINISHED


@pytest.mark.slow
def test_interrupted_job_is_cancelled(tmp_path, capture):
    """Catches Ctrl-C in a worker that is reported as a failure with a traceback."""
    pytest.importorskip("torch")
    run = tmp_path / "run"
    write_job(run, new_job(capture))

    def interrupt(progress):
        if progress.iteration == 3 and progress.message == "Training":
            signal.raise_signal(signal.SIGINT)
        return False

    with pytest.raises(KeyboardInterrupt):
        run_training_job(run, also=interrupt)
    assert inspect_worker(job_folder(run)).state == WorkerState.CANCELLED
    assert (run / "checkpoint.npz").exists()


def test_an_interpreter_without_anything_is_named(tmp_path, capture):
    """Catches a traceback about imports where a sentence should say which Python lacks what."""
    write_job(tmp_path / "run", new_job(capture))
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(tmp_path / "venv")], check=True)
    python = tmp_path / "venv/bin/python"
    process = start_worker(job_folder(tmp_path / "run"), str(python), training_job.worker_arguments(tmp_path / "run"))
    assert process.wait(60) == 2
    seen = inspect_worker(job_folder(tmp_path / "run"), process)
    assert seen.status.error == f"Worker exited with status 2: stga: {python} lacks the package 'numpy'"


def test_a_head_that_is_not_there_is_a_sentence(tmp_path):
    """Catches a traceback where a command is to be about a head whose folder has gone."""
    environment = {**os.environ, FOLDER: str(tmp_path / "gone")}
    command = [sys.executable, "-m", "stga_addon", "info"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stderr.startswith(f"stga: {tmp_path / 'gone' / 'head.json'}: cannot be read")
    assert done.stderr.count("\n") == 1


def _made(folder: Path) -> Path:
    folder.mkdir(parents=True)
    return folder


def test_removed_job_leaves_other_files(tmp_path, capture):
    """Catches *Dismiss* removing a person's files along a path that a .blend file names."""
    folder = job_folder(tmp_path / "run")
    folder.mkdir(parents=True)
    for name in (STATUS_FILE, LOG_FILE, "notes.txt"):
        (folder / name).write_text("mine")
    training_job.remove_job(tmp_path / "run")
    assert len(list(folder.iterdir())) == 3  # no job
    write_job(tmp_path / "run", new_job(capture), painted())
    training_job.remove_job(tmp_path / "run")
    assert [path.name for path in folder.iterdir()] == ["notes.txt"]
    (folder / "notes.txt").unlink()
    write_job(tmp_path / "run", new_job(capture), painted())
    training_job.remove_job(tmp_path / "run")
    assert not folder.exists()


@pytest.mark.parametrize(
    "wanted",
    [
        Refinement(Path("/runs/anna"), "mouth", (3, 5), 0.5, seconds=20.0),
        Refinement(Path("/runs/anna"), "painted.npz", None, iterations=3, seed=2),
        Extension(Path("/runs/anna"), (Path("/smile"), Path("/frown")), iterations=3),
    ],
)
def test_jobs_that_continue_a_run(tmp_path: Path, wanted: Request) -> None:
    """Catches a region, frames or takes that the worker does not get."""
    write_job(tmp_path / "run", TrainingJob(Path("/anna"), None, "vhap", None, continues=wanted), region=np.ones(4))
    job = read_job(tmp_path / "run")
    assert job.continues == wanted
    assert not job.resumes
    assert read_npz(job_folder(tmp_path / "run") / training_job.REGION)["weights"].sum() == 4
    training_job.remove_job(tmp_path / "run")
    assert not job_folder(tmp_path / "run").exists()


def test_a_worker_refines_and_resumes(tmp_path: Path) -> None:
    """Catches a worker that trains anew, or ignores the painted region, where a run is to be continued."""
    capture = write_mesh_capture(tmp_path / "capture")
    write_job(tmp_path / "run", new_job(capture))
    run_training_job(tmp_path / "run")
    refined, weights = tmp_path / "run_2", np.zeros(len(ball()[1]))
    weights[:40] = 1.0
    wanted = Refinement(tmp_path / "run", str(job_folder(refined) / training_job.REGION), iterations=4)
    job = TrainingJob(capture, None, "opencv", None, "cpu", wanted)
    write_job(refined, job, region=weights)
    run_training_job(refined)
    before, after = (read_avatar(folder / "avatar.npz").splats for folder in (tmp_path / "run", refined))
    same = (before.sh == after.sh).all((1, 2))
    assert same[before.face >= 40].all()
    assert not same[before.face < 40].all()
    write_job(refined, TrainingJob(capture, None, "opencv", None, "cpu"))
    run_training_job(refined)
