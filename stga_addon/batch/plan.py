"""Plan of a batch: a TOML file of jobs, or some captures, with a job each.

    out = "runs"                       # folder of the batch

    [resources]                        # of every job, unless its own table says otherwise
    threads = 1

    [job.anna]
    request = "train"                  # a request (`job.KINDS`); the other keys are its fields
    capture = "captures/anna"
    settings = { preset = "standard", seed = 1 }

    [job.anna-test]
    request = "evaluate"
    run = "runs/anna"                  # the folder of another job, which is waited for
    after = ["…"]                      # further jobs to wait for

Paths are relative to the plan's folder; where a request writes, to the job's own folder.
"""

import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any

from ..errors import StgaError, shorten
from ..files import read_toml
from ..requests.values import Request
from ..schema import complaint, from_json, to_json
from ..training.settings import TrainingSettings, make_settings
from .job import KINDS, Job, Resources, input_paths, is_path, output_field

PLAN_KEYS = ("out", "resources", "job")
TABLE_KEYS = ("request", "after", "resources", "minutes")
"""Keys of a job's table that are not fields of its request."""
REPLACED = "replaced"
"""Folder of the batch that keeps what changed jobs wrote before."""
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,199}", re.ASCII)
"""Of a job, whose folder has it."""


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
    """A training of each capture. settings: of `make_settings`; fields: further ones of `Train`. Raises StgaError."""
    folders = [path.resolve() for path in captures]
    table = {"request": "train", "settings": dict(settings), **fields}
    jobs = {
        f"train-{name}": {**table, "capture": str(path)} for name, path in zip(_names(folders), folders, strict=True)
    }
    return make_plan({"out": str(out.resolve()), "job": jobs}, Path.cwd(), "CAPTURES")


def _names(folders: Sequence[Path]) -> list[str]:
    """What the job of each folder is called: the folder's name; with that above it where several have it; and numbered
    where these are the same in ASCII."""
    names = [_slug(path.name) for path in folders]
    shared = Counter(names)
    names = [_slug("-".join(p.parts[-2:])) if shared[n] > 1 else n for n, p in zip(names, folders, strict=True)]
    earlier = [names[:number].count(name) for number, name in enumerate(names)]
    return [name if not count else f"{name}_{count + 1}" for name, count in zip(names, earlier, strict=True)]


def _slug(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.-]+", "-", text).rstrip("-.").lstrip("_-.") or "x"


def make_plan(values: Mapping[str, Any], base: Path, source: str) -> Plan:
    """The plan of a TOML file's values; paths are relative to `base`. Raises StgaError as `read_plan` does."""
    _require_keys(source, values, PLAN_KEYS)
    out, tables = values.get("out"), values.get("job")
    if not isinstance(out, str) or not out:
        raise StgaError(f"{source}: out: expected the batch's folder as a text, got {shorten(out)}")
    if not isinstance(tables, dict) or not tables:
        raise StgaError(f"{source}: holds no job; expected a table [job.NAME]")
    folder = _absolute(base, out)
    shared = _resources(f"{source}: [resources]", values.get("resources", {}), Resources())
    jobs = [_job(source, name, table, base, folder, shared) for name, table in tables.items()]
    by_name = {job.name: job for job in _with_inputs(source, jobs)}
    try:
        order = list(TopologicalSorter({name: job.after for name, job in by_name.items()}).static_order())
    except CycleError as error:
        circle = " → ".join(map(str, error.args[1]))
        raise StgaError(f"{source}: these jobs wait for each other: {circle}") from error
    return Plan(source, folder, tuple(by_name[name] for name in order))


def _require_keys(where: str, values: Mapping[str, Any], allowed: Sequence[str]) -> None:
    unknown = next((key for key in values if key not in allowed), None)
    if unknown is not None:
        raise StgaError(f"{where}: {unknown}: is not a key of it; expected one of {', '.join(allowed)}")


def _job(source: str, name: str, table: Any, base: Path, out: Path, shared: Resources) -> Job:
    """The job of a table, which waits for those that its `after` names."""
    where = f"{source}: [job.{name if NAME.fullmatch(name) else shorten(name)}]"
    if not NAME.fullmatch(name) or name == REPLACED:
        raise StgaError(f"{where}: expected a name of letters, digits, '_', '.' and '-', other than '{REPLACED}'")
    if not isinstance(table, dict):
        raise StgaError(f"{where}: expected a table, got {shorten(table)}")
    kind = KINDS.get(table["request"]) if isinstance(table.get("request"), str) else None
    if kind is None:
        raise StgaError(f"{where}: request: expected one of {', '.join(KINDS)}, got {shorten(table.get('request'))}")
    after, minutes = table.get("after", []), table.get("minutes")
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
    try:
        found: Resources = from_json(Resources, {**to_json(shared), **values})
    except StgaError as error:
        raise StgaError(f"{where}: {error}") from error
    return found


# Requests


def _request(where: str, kind: type[Any], values: Mapping[str, Any], base: Path, folder: Path) -> Request:
    """The request of a kind from the fields that are given; the others have their defaults. Raises StgaError."""
    specs, output = {spec.name: spec for spec in fields(kind)}, output_field(kind)
    _require_keys(where, values, list(specs))
    values = dict(values)
    if output is not None:
        values.setdefault(output, ".")
    for name, value in values.items():
        if is_path(kind, name, value):
            values[name] = _resolved(folder if name == output else base, value)
    if "settings" in specs:
        _set_training(where, values)
    plain = {name: _completed(spec, values.get(name)) for name, spec in specs.items()}
    missing = next((name for name, value in plain.items() if value is MISSING), None)
    if missing is not None:
        raise StgaError(f"{where}: {missing}: is missing")
    try:
        request: Request = from_json(kind, plain)
    except StgaError as error:
        raise StgaError(f"{where}: {str(error).removeprefix('setting ')}") from error
    return request


def _completed(spec: Any, value: Any) -> Any:
    """A field's value or default as JSON has it, MISSING without either; a table is completed by the defaults."""
    if spec.default_factory is not MISSING:
        default = to_json(spec.default_factory())
        return default if value is None else {**default, **value} if isinstance(value, dict) else value
    if value is not None:
        return value
    return list(spec.default) if isinstance(spec.default, tuple) else spec.default


def _resolved(base: Path, value: Any) -> Any:
    if isinstance(value, list):
        return [_resolved(base, item) for item in value]
    return str(_absolute(base, value)) if isinstance(value, str) and value else value


def _absolute(base: Path, text: str) -> Path:
    return Path(os.path.abspath(base / os.path.expanduser(text)))


def _set_training(where: str, values: dict[str, Any]) -> None:
    """Replace the changes in `settings` by whole settings, as `stga train` makes them: with the effects decided from
    the capture."""
    changes = values.get("settings", {})
    if not isinstance(changes, dict):
        raise StgaError(f"{where}: settings: expected a table, got {shorten(changes)}")
    _require_keys(f"{where}: settings", changes, [spec.name for spec in fields(TrainingSettings)])
    changes = dict(changes)
    if changes.get("schedule") != "paper" and changes.get("strategy") != "gaussian-avatars":
        changes.setdefault("effects", {})
    nested = {name: changes.pop(name) for name in ("selection", "rates") if name in changes}
    try:
        # As lists become tuples: the plain form is read back with the nested changes merged into it.
        whole = to_json(make_settings(**{key: _tuples(item) for key, item in changes.items()}))
        for name, change in nested.items():
            whole[name] = {**whole[name], **change} if isinstance(change, dict) else change
        settings = from_json(TrainingSettings, whole)
    except StgaError as error:
        raise StgaError(f"{where}: {str(error).replace('setting ', 'settings.', 1)}") from error
    values["settings"] = to_json(settings)


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


# Inputs


def _with_inputs(source: str, jobs: Sequence[Job]) -> Iterator[Job]:
    """The jobs, each also after those whose folders it reads. Raises StgaError for an input that nothing makes."""
    by_name, by_folder = {job.name: job for job in jobs}, {job.folder: job for job in jobs}
    for job in jobs:
        where, after = f"{source}: [job.{job.name}]", list(job.after)
        unknown = next((other for other in after if other not in by_name), None)
        if unknown is not None:
            raise StgaError(f"{where}: after: '{shorten(unknown)[1:-1]}' is not a job of the plan")
        for name, paths in input_paths(job.request).items():
            for path in paths:
                if path == job.folder.parent:
                    raise StgaError(f"{where}: {name}: {path} is the batch's own folder; choose another 'out'")
                maker = next((by_folder[folder] for folder in (path, *path.parents) if folder in by_folder), None)
                if maker is not None and maker is not job:
                    after.append(maker.name)
                elif maker is None and not path.exists():
                    raise StgaError(f"{where}: {name}: {path} does not exist")
        yield replace(job, after=tuple(dict.fromkeys(after)))
