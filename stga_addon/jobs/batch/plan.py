"""Plan of a batch, a TOML file of jobs (docs/commands.md#batches) or some captures with a job
each; and what an engine is, which carries them out."""

import os
import re
import sys
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, replace
from graphlib import CycleError, TopologicalSorter
from itertools import count
from pathlib import Path
from typing import Any, get_args

from ...errors import StgaError, shorten
from ...files import read_toml
from ...schema import IS_PATH, complaint, from_json, setting, to_json, type_hints
from ...training.settings import TrainingSettings, make_settings
from ...worker.status import WorkerSnapshot
from ...worker.training_python import find_training_python
from ..perform import request_folder, worker_arguments
from ..table import JOBS, Request
from ..track import MakeAvatar
from ..train import Resume, Train

MAX_THREADS = 1024


def kind_name(kind: type[Any]) -> str:
    """ "render-blend" for RenderBlend."""
    return "".join(f"-{c.lower()}" if c.isupper() else c for c in kind.__name__).lstrip("-")


def request_kinds() -> dict[str, type[Any]]:
    """Name of a request in a plan -> its dataclass: every request but Resume, which is how an
    interrupted one continues, and MakeAvatar, which is two jobs."""
    return {kind_name(kind): kind for kind in JOBS if kind not in (Resume, MakeAvatar)}


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
    minutes   its time as stated in the plan
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
    def forecast_s(self) -> float | None:
        """Seconds that the plan or a training's budget gives it; None: unknown."""
        if self.minutes is not None:
            return 60 * self.minutes
        request = self.request
        budget = request.settings if isinstance(request, Train) else request
        return getattr(budget, "seconds", None)

    @property
    def is_written(self) -> bool:
        """Whether what the request writes, beside its result, is there."""
        return JOBS[type(self.request)].is_written(self.request)


def is_path(kind: type[Any], name: str, value: Any) -> bool:
    """Whether a field's plain value is a path, or a list of them, rather than a name."""
    names_path = kind.__dataclass_fields__[name].metadata.get(IS_PATH)
    if names_path is not None:
        return isinstance(value, str) and value != "" and bool(names_path(value))
    return _holds_path(type_hints(kind)[name])  # type: ignore[arg-type]


def _holds_path(hint: Any) -> bool:
    return hint is Path or any(_holds_path(part) for part in get_args(hint))


def input_paths(request: Request) -> Mapping[str, tuple[Path, ...]]:
    """Field -> the paths that a request reads, of those that are given."""
    kind = type(request)
    found = dict[str, tuple[Path, ...]]()
    for name in kind.__dataclass_fields__:
        value = getattr(request, name)
        if value is not None and name != JOBS[kind].output and is_path(kind, name, value):
            found[name] = tuple(map(Path, value if isinstance(value, tuple) else (value,)))
    return found


@dataclass(frozen=True)
class Ended:
    """What became of a job's worker. is_lost: it was killed, or its machine has gone; the job may
    be tried again."""

    snapshot: WorkerSnapshot
    is_lost: bool = False


class Engine(ABC):
    """Carries out jobs.

    interval_s   seconds between two questions after what has ended
    """

    interval_s = 0.1

    def has_room(self, job: Job) -> bool:
        """Whether the job can be submitted now."""
        return True

    @abstractmethod
    def submit(self, job: Job) -> None:
        """Carry out a job that can start. Raises StgaError if it cannot begin."""

    @abstractmethod
    def adopt(self, job: Job) -> None:
        """Watch the worker that an earlier start of the batch left running."""

    @abstractmethod
    def running(self) -> Mapping[str, str]:
        """Name of each job that a machine carries out -> the machine, "" where unknown."""

    @abstractmethod
    def ended(self) -> Mapping[str, Ended]:
        """The jobs whose workers have ended since this was called last."""

    def withdraw(self) -> Sequence[str]:
        """Take back what was submitted and has not begun; returns the names of these jobs."""
        return ()

    def close(self) -> None:  # noqa: B027 (most engines hold nothing)
        """Leave the engine; the work of running jobs is not touched."""


def job_command(job: Job) -> list[str]:
    """What a machine that sees the job's folder runs."""
    arguments = worker_arguments(job.request_folder, job.resources.threads or None, resume=True)
    return [find_training_python(sys.executable), "-m", *arguments]


# Plans

PLAN_KEYS = ("out", "resources", "job")
"""Keys of a plan's top level."""
TABLE_KEYS = ("request", "after", "resources", "minutes")
"""Keys of a job's table that are not fields of its request."""
REPLACED = "replaced"  # Folder of the batch that keeps what changed jobs wrote before
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,199}", re.ASCII)  # Name of a job, and of its folder


@dataclass(frozen=True)
class Plan:
    """Jobs of a batch, each after those that it comes after.

    source   the file, for messages; out: folder of the batch
    """

    source: str
    out: Path
    jobs: tuple[Job, ...]


def read_plan(path: Path) -> Plan:
    """Raises StgaError naming file, table and key of the first mistake."""
    return make_plan(read_toml(path), path.resolve().parent, str(path))


def plan_of_captures(
    captures: Sequence[Path], out: Path, settings: Mapping[str, Any], fields: Mapping[str, Any]
) -> Plan:
    """A training of each capture; fields: of `Train`, settings: of `make_settings`."""
    folders = [path.resolve() for path in captures]
    slugs = [_slug(path.name) for path in folders]
    jobs: dict[str, Any] = {}
    for name, path in zip(slugs, folders, strict=True):
        # where several share it, with that of the folder above, or numbered
        job = name if slugs.count(name) == 1 else _slug("-".join(path.parts[-2:]))
        numbers = (f"train-{job}" if n == 1 else f"train-{job}_{n}" for n in count(1))
        unused = next(each for each in numbers if each not in jobs)
        jobs[unused] = {"request": "train", "settings": dict(settings), **fields}
        jobs[unused]["capture"] = str(path)
    return make_plan({"out": str(out.resolve()), "job": jobs}, Path.cwd(), "CAPTURES")


def _slug(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.-]+", "-", text).rstrip("-.").lstrip("_-.") or "x"


def make_plan(values: Mapping[str, Any], base: Path, source: str) -> Plan:
    """The plan of a TOML file's values, paths relative to `base`; raises as `read_plan` does."""
    _require_keys(source, values, PLAN_KEYS)
    out = values.get("out")
    tables = values.get("job")
    if not isinstance(out, str) or not out:
        raise StgaError(f"{source}: out: expected the batch's folder as a text, got {shorten(out)}")
    if not isinstance(tables, dict) or not tables:
        raise StgaError(f"{source}: holds no job; expected a table [job.NAME]")
    folder = Path(_resolved(base, out))
    shared = _resources(f"{source}: [resources]", values.get("resources", {}), Resources())
    jobs = [_job(source, name, table, base, folder, shared) for name, table in tables.items()]
    by_name = {job.name: job for job in _with_inputs(source, jobs)}
    try:
        after = {name: job.after for name, job in by_name.items()}
        order = tuple(TopologicalSorter(after).static_order())
    except CycleError as error:
        circle = " → ".join(map(str, error.args[1]))
        raise StgaError(f"{source}: these jobs wait for each other: {circle}") from error
    return Plan(source, folder, tuple(by_name[name] for name in order))


def _require_keys(where: str, values: Mapping[str, Any], allowed: Sequence[str]) -> None:
    unknown = next((key for key in values if key not in allowed), None)
    if unknown is not None:
        raise StgaError(
            f"{where}: {unknown}: is not a key of it; expected one of {', '.join(allowed)}"
        )


def _job(source: str, name: str, table: Any, base: Path, out: Path, shared: Resources) -> Job:
    """The job of a table, which waits for those that its `after` names."""
    where = f"{source}: [job.{name if NAME.fullmatch(name) else shorten(name)}]"
    if not NAME.fullmatch(name) or name == REPLACED:
        problem = f"expected a name of letters, digits, '_', '.' and '-', other than '{REPLACED}'"
        raise StgaError(f"{where}: {problem}")
    if not isinstance(table, dict):
        raise StgaError(f"{where}: expected a table, got {shorten(table)}")
    kinds = request_kinds()
    kind = kinds.get(table["request"]) if isinstance(table.get("request"), str) else None
    if kind is None:
        problem = f"expected one of {', '.join(kinds)}, got {shorten(table.get('request'))}"
        raise StgaError(f"{where}: request: {problem}")
    after = table.get("after", [])
    minutes = table.get("minutes")
    if not isinstance(after, list) or not all(isinstance(other, str) for other in after):
        raise StgaError(f"{where}: after: expected a list of job names, got {shorten(after)}")
    if minutes is not None and (not isinstance(minutes, int | float) or not minutes > 0):
        raise StgaError(f"{where}: {complaint('minutes', 'a number above 0', minutes)}")
    resources = _resources(f"{where}: resources", table.get("resources", {}), shared)
    given = {key: value for key, value in table.items() if key not in TABLE_KEYS}
    request = _request(where, kind, given, base, out / name)
    return Job(name, request, out / name, tuple(after), resources, minutes)


def _resources(where: str, values: Any, shared: Resources) -> Resources:
    if not isinstance(values, dict):
        raise StgaError(f"{where}: expected a table, got {shorten(values)}")
    _require_keys(where, values, [spec.name for spec in fields(Resources)])
    return from_json(Resources, {**to_json(shared), **values}, where)


def _request(
    where: str, kind: type[Any], values: Mapping[str, Any], base: Path, folder: Path
) -> Request:
    """The request of a kind from the fields that are given; the others have their defaults."""
    output = JOBS[kind].output
    _require_keys(where, values, list(kind.__dataclass_fields__))
    values = {output: ".", **values} if output else dict(values)
    for name, value in values.items():
        if is_path(kind, name, value):
            values[name] = _resolved(folder if name == output else base, value)
    if "settings" in kind.__dataclass_fields__:
        values["settings"] = _training_settings(where, values.get("settings", {}))
    for spec in fields(kind):
        value = values.get(spec.name)
        name = spec.name
        if spec.default_factory is not MISSING and isinstance(value, dict | None):
            values[name] = {**to_json(spec.default_factory()), **(value or {})}
        elif value is None and spec.default is MISSING:
            raise StgaError(f"{where}: {name}: is missing")
        elif value is None:
            values[name] = list(spec.default) if isinstance(spec.default, tuple) else spec.default
    return from_json(kind, values, where)


def _resolved(base: Path, value: Any) -> Any:
    """An absolute path, or a list of them; other values as they are."""
    if isinstance(value, list):
        return [_resolved(base, item) for item in value]
    is_path = isinstance(value, str) and value
    return os.path.abspath(base / os.path.expanduser(value)) if is_path else value


def _training_settings(where: str, changes: Any) -> Any:
    """Whole settings as JSON, as `stga train` makes them, from those that differ."""
    if not isinstance(changes, dict):
        raise StgaError(f"{where}: settings: expected a table, got {shorten(changes)}")
    _require_keys(f"{where}: settings", changes, [spec.name for spec in fields(TrainingSettings)])
    changes = dict(changes)
    if changes.get("schedule") != "paper" and changes.get("strategy") != "gaussian-avatars":
        changes.setdefault("effects", {})
    nested = {name: changes.pop(name) for name in ("selection", "rates") if name in changes}
    try:
        # as lists become tuples: the plain form is read back with the nested changes merged into it
        whole = to_json(make_settings(**{key: _tuples(item) for key, item in changes.items()}))
        for name, change in nested.items():
            whole[name] = {**whole[name], **change} if isinstance(change, dict) else change
        settings = from_json(TrainingSettings, whole)
    except StgaError as error:
        raise StgaError(f"{where}: {str(error).replace('setting ', 'settings.', 1)}") from error
    return to_json(settings)


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _with_inputs(source: str, jobs: Sequence[Job]) -> Iterator[Job]:
    """The jobs, each also after those whose folders it reads. StgaError for missing inputs."""
    by_name = {job.name: job for job in jobs}
    by_folder = {job.folder: job for job in jobs}
    for job in jobs:
        where = f"{source}: [job.{job.name}]"
        after = list(job.after)
        unknown = next((other for other in after if other not in by_name), None)
        if unknown is not None:
            raise StgaError(f"{where}: after: '{shorten(unknown)[1:-1]}' is not a job of the plan")
        for name, paths in input_paths(job.request).items():
            for path in paths:
                if path == job.folder.parent:
                    raise StgaError(
                        f"{where}: {name}: {path} is the batch's own folder; choose another 'out'"
                    )
                makers = (by_folder.get(folder) for folder in (path, *path.parents))
                maker = next(filter(None, makers), None)
                if maker is None and not path.exists():
                    raise StgaError(f"{where}: {name}: {path} does not exist")
                if maker is not None and maker is not job:
                    after.append(maker.name)
        yield replace(job, after=tuple(dict.fromkeys(after)))
