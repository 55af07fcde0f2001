"""Jobs of a batch: a request each, what it comes after and needs; and what an engine is, which carries them out."""

import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Any, Protocol, get_args, get_type_hints

from ..requests.folder import request_folder, worker_arguments
from ..requests.values import Extend, MakeAvatar, Refine, RenderBlend, Request, Resume, Train
from ..schema import IS_PATH, setting
from ..training.run.folder import AVATAR
from ..worker.status import WorkerSnapshot
from ..worker.training_python import PYTHON_VARIABLE

KINDS: dict[str, type[Any]] = {}
"""Name of a request in a plan -> its dataclass: every request but Resume, which is how an interrupted one
continues, and MakeAvatar, which is two jobs."""
TRAININGS = (Train, Refine, Extend)
OUTPUT_FIELDS = ("out", "output")
"""Names of the field that says where a request writes; of a training it is `run`."""
MAX_THREADS = 1024


def kind_name(kind: type[Any]) -> str:
    """ "select-for-take" for SelectForTake."""
    return "".join(f"-{c.lower()}" if c.isupper() else c for c in kind.__name__).lstrip("-")


KINDS.update({kind_name(kind): kind for kind in get_args(Request) if kind not in (Resume, MakeAvatar)})


@dataclass(frozen=True)
class Resources:
    """What a job needs of a machine.

    threads   to compute on; 0: the machine's, shared among the jobs of the batch
    gpu       whether it needs a GPU to itself
    """

    threads: int = setting(0, 0, MAX_THREADS)
    memory_gb: float = setting(2.0, above=0)
    gpu: bool = False


@dataclass(frozen=True)
class Job:
    """A request in a folder of its own.

    name      unique in the batch, the same each time that the plan is read
    folder    what the request writes lies in it; the request itself in `request_folder`
    after     names of the jobs that have to be finished before
    minutes   how long the plan says that it takes
    """

    name: str
    request: Request
    folder: Path
    after: tuple[str, ...] = ()
    resources: Resources = field(default_factory=Resources)
    minutes: float | None = setting(None, above=0)

    @property
    def request_folder(self) -> Path:
        return request_folder(self.folder)

    @property
    def product(self) -> Path | None:
        """The file or folder that the request writes; None where its result is all."""
        if isinstance(self.request, TRAININGS):
            return self.request.run / AVATAR
        name = output_field(type(self.request))
        path = None if name is None else getattr(self.request, name)
        return path if isinstance(path, Path) else None

    @property
    def is_written(self) -> bool:
        """Whether what the request writes is there."""
        if isinstance(self.request, RenderBlend):
            return all(picture.exists() for picture in self.request.pictures.values())
        return self.product is None or self.product.exists()


def output_field(kind: type[Any]) -> str | None:
    """The field that says where requests of a kind write; None where they have none."""
    if kind in TRAININGS:
        return "run"
    names = [spec.name for spec in fields(kind)]
    return next((name for name in OUTPUT_FIELDS if name in names), None)


@cache
def path_fields(kind: type[Any]) -> frozenset[str]:
    """The fields of a request that hold a path, or several."""
    return frozenset(name for name, hint in get_type_hints(kind).items() if _holds_path(hint))


def is_path(kind: type[Any], name: str, value: Any) -> bool:
    """Whether a field's plain value is a path, or a list of them, rather than a name."""
    names_path = kind.__dataclass_fields__[name].metadata.get(IS_PATH)
    if names_path is not None:
        return isinstance(value, str) and value != "" and bool(names_path(value))
    return name in path_fields(kind)  # type: ignore[arg-type]


def _holds_path(hint: Any) -> bool:
    return hint is Path or any(_holds_path(part) for part in get_args(hint))


def input_paths(request: Request) -> Mapping[str, tuple[Path, ...]]:
    """Field -> the paths that a request reads, of those that are given."""
    kind = type(request)
    found: dict[str, tuple[Path, ...]] = {}
    for spec in fields(kind):
        value = getattr(request, spec.name)
        if value is None or spec.name == output_field(kind) or not is_path(kind, spec.name, value):
            continue
        items = value if isinstance(value, tuple) else (value,)
        if items:
            found[spec.name] = tuple(map(Path, items))
    return found


@dataclass(frozen=True)
class Ended:
    """What became of a job's worker. is_lost: it was killed, or its machine has gone; the job may be tried again."""

    snapshot: WorkerSnapshot
    is_lost: bool = False


class Engine(Protocol):
    """Carries out jobs.

    takes_all    it is given all jobs at once, and minds what they come after itself; else each when it can start
    interval_s   seconds between two questions after what has ended
    """

    takes_all: bool
    interval_s: float

    def has_room(self, job: Job) -> bool:
        """Whether the job can be submitted now."""

    def submit(self, jobs: Sequence[Job]) -> None:
        """Carry out jobs, which follow those that they come after. Raises StgaError where that cannot be begun."""

    def adopt(self, job: Job) -> None:
        """Watch the worker that an earlier start of the batch left running."""

    def running(self) -> Mapping[str, str]:
        """Name of each job that a machine carries out -> the machine, "" where only the worker knows it."""

    def ended(self) -> Mapping[str, Ended]:
        """The jobs whose workers have ended since this was called last."""

    def withdraw(self) -> Sequence[str]:
        """Take back what was submitted and has not begun; returns the names of these jobs."""

    def close(self) -> None:
        """Leave the engine; the work of running jobs is not touched."""


def job_command(job: Job) -> list[str]:
    """What a machine that sees the job's folder runs."""
    arguments = worker_arguments(job.request_folder, job.resources.threads or None, resume=True)
    return [training_python(), "-m", *arguments]


def training_python() -> str:
    """The interpreter that carries out jobs: that of STGA_PYTHON, else this one."""
    return os.environ.get(PYTHON_VARIABLE) or sys.executable
