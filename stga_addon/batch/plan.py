"""Plan of a batch: a TOML file, or some captures, as jobs.

    out = "runs"                       # folder of the batch

    [resources]                        # of every job, unless its own table says otherwise
    threads = 1

    [job.train]
    request = "train"                  # a request (`job.KINDS`); the other keys are its fields
    capture = "captures/anna"
    settings = { preset = "standard" }
    sweep = { "settings.seed" = [0, 1, 2] }     # a job for each combination; or of ranges:
                                       # { frames = { first = 1, last = 900, size = 100 } }
    cases = [{ name = "…", capture = "…" }]     # a job for each set of fields

    [job.evaluate]
    request = "evaluate"
    run = "{train}"                    # folder of the other job; one job for each of its jobs
    after = ["…"]                      # further tables to wait for

Paths are relative to the plan's folder; where a request writes, to the job's own folder.
"""

import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from graphlib import CycleError, TopologicalSorter
from itertools import product
from math import prod
from pathlib import Path
from typing import Any

from ..errors import StgaError, shorten
from ..files import read_toml
from ..requests.values import Request
from ..schema import complaint, from_json, to_json
from ..training.settings import TrainingSettings, make_settings
from .job import KINDS, Job, Resources, input_paths, is_path, output_field

MAX_JOBS = 100_000
PLAN_KEYS = ("out", "resources", "job")
TABLE_KEYS = ("request", "sweep", "cases", "after", "resources", "minutes")
"""Keys of a job's table that are not fields of its request."""
RANGE_KEYS = ("first", "last", "size")
"""Keys of a sweep over ranges: [first, first + size - 1] and so on up to the last."""
REPLACED = "replaced"
"""Folder of the batch that keeps what changed jobs wrote before."""
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,99}", re.ASCII)
REFERENCE = re.compile(r"\{([^{}]*)\}")
MAX_JOB_NAME = 200
"""Longest name of a job, whose folder has it."""


@dataclass(frozen=True)
class Plan:
    """Jobs of a batch, each after those that it comes after.

    source   the file, for messages; out: folder of the batch
    """

    source: str
    out: Path
    jobs: tuple[Job, ...]


@dataclass(frozen=True)
class _Variant:
    """A job's name, fields and choices. choices: axis ("train.seed") -> the label that the name has for it."""

    values: Mapping[str, Any]
    choices: Mapping[str, str]
    after: tuple[str, ...] = ()


def read_plan(path: Path) -> Plan:
    """Raises StgaError naming file, table and key of the first mistake."""
    return make_plan(read_toml(path), path.resolve().parent, str(path))


def plan_of_captures(
    captures: Sequence[Path], out: Path, settings: Mapping[str, Any], fields: Mapping[str, Any]
) -> Plan:
    """A training of each capture. settings: of `make_settings`; fields: further ones of `Train`. Raises StgaError."""
    folders = [path.resolve() for path in captures]
    cases = [{"name": name, "capture": str(path)} for name, path in zip(_names(folders), folders, strict=True)]
    table = {"request": "train", "settings": dict(settings), "cases": cases, **fields}
    return make_plan({"out": str(out.resolve()), "job": {"train": table}}, Path.cwd(), "CAPTURES")


def _names(folders: Sequence[Path]) -> list[str]:
    """What a case of each folder is called: the folder's name; with that above it where several have it; and numbered
    where these are the same in ASCII."""
    names = [_case_name(path.name) for path in folders]
    shared = Counter(names)
    names = [_case_name("-".join(p.parts[-2:])) if shared[n] > 1 else n for n, p in zip(names, folders, strict=True)]
    earlier = [names[:number].count(name) for number, name in enumerate(names)]
    return [name if not count else f"{name}_{count + 1}" for name, count in zip(names, earlier, strict=True)]


def _case_name(text: str) -> str:
    return _slug(text).lstrip("_-.") or "x"


def make_plan(values: Mapping[str, Any], base: Path, source: str) -> Plan:
    """The plan of a TOML file's values; paths are relative to `base`. Raises StgaError as `read_plan` does."""
    _require_keys(f"{source}", values, PLAN_KEYS)
    out, tables = values.get("out"), values.get("job")
    if not isinstance(out, str) or not out:
        raise StgaError(f"{source}: out: expected the batch's folder as a text, got {shorten(out)}")
    if not isinstance(tables, dict) or not tables:
        raise StgaError(f"{source}: holds no job; expected a table [job.NAME]")
    folder = _absolute(base, out)
    shared = _resources(f"{source}: [resources]", values.get("resources", {}), Resources())
    made: dict[str, list[tuple[Job, Mapping[str, str]]]] = {}
    for name in _in_order(source, tables):
        made[name] = list(_jobs_of(source, name, tables[name], base, folder, shared, made))
        if sum(map(len, made.values())) > MAX_JOBS:
            raise StgaError(f"{source}: [job.{name}]: makes more than {MAX_JOBS} jobs")
    jobs = [job for of_table in made.values() for job, _ in of_table]
    by_name = {job.name: job for job in _with_inputs(source, jobs)}
    order = _topological(source, {name: job.after for name, job in by_name.items()})
    return Plan(source, folder, tuple(by_name[name] for name in order))


# Tables and their order


def _require_keys(where: str, values: Mapping[str, Any], allowed: Sequence[str]) -> None:
    unknown = next((key for key in values if key not in allowed), None)
    if unknown is not None:
        raise StgaError(f"{where}: {unknown}: is not a key of it; expected one of {', '.join(allowed)}")


def _in_order(source: str, tables: Mapping[str, Any]) -> list[str]:
    """Names of the job tables, each after those that it refers to."""
    graph: dict[str, list[str]] = {}
    for name, table in tables.items():
        where = f"{source}: [job.{name if NAME.fullmatch(name) else shorten(name)}]"
        if not NAME.fullmatch(name) or name == REPLACED:
            raise StgaError(f"{where}: expected a name of letters, digits, '_', '.' and '-', other than '{REPLACED}'")
        if not isinstance(table, dict):
            raise StgaError(f"{where}: expected a table, got {shorten(table)}")
        graph[name] = [*_after(where, table), *_references(table)]
        unknown = next((other for other in graph[name] if other not in tables), None)
        if unknown is not None:
            raise StgaError(f"{where}: refers to the job '{shorten(unknown)[1:-1]}', which the plan does not have")
    return _topological(source, graph)


def _topological(source: str, graph: Mapping[str, Sequence[str]]) -> list[str]:
    try:
        return list(TopologicalSorter(graph).static_order())
    except CycleError as error:
        circle = " → ".join(map(str, error.args[1]))
        raise StgaError(f"{source}: these jobs wait for each other: {circle}") from error


def _after(where: str, table: Mapping[str, Any]) -> list[str]:
    after = table.get("after", [])
    if not isinstance(after, list) or not all(isinstance(name, str) for name in after):
        raise StgaError(f"{where}: after: expected a list of job names, got {shorten(after)}")
    return after


def _references(value: Any) -> list[str]:
    """Names in braces, in any text of a table."""
    if isinstance(value, str):
        return [found.strip() for found in REFERENCE.findall(value)]
    items = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return [name for item in items for name in _references(item)]


def _resources(where: str, values: Any, shared: Resources) -> Resources:
    if not isinstance(values, dict):
        raise StgaError(f"{where}: expected a table, got {shorten(values)}")
    _require_keys(where, values, [spec.name for spec in fields(Resources)])
    try:
        found: Resources = from_json(Resources, {**to_json(shared), **values})
    except StgaError as error:
        raise StgaError(f"{where}: {error}") from error
    return found


# Jobs of a table


def _jobs_of(
    source: str,
    name: str,
    table: Mapping[str, Any],
    base: Path,
    out: Path,
    shared: Resources,
    made: Mapping[str, list[tuple[Job, Mapping[str, str]]]],
) -> Iterator[tuple[Job, Mapping[str, str]]]:
    """The jobs of a table, with the choices of each."""
    where = f"{source}: [job.{name}]"
    kind = KINDS.get(table["request"]) if isinstance(table.get("request"), str) else None
    if kind is None:
        raise StgaError(f"{where}: request: expected one of {', '.join(KINDS)}, got {shorten(table.get('request'))}")
    resources = _resources(f"{where}: resources", table.get("resources", {}), shared)
    minutes = table.get("minutes")
    given = {key: value for key, value in table.items() if key not in TABLE_KEYS}
    for variant in _joined(_variants(where, name, given, table), _after(where, table), made):
        full_name = "-".join([name, *variant.choices.values()])
        if len(full_name) > MAX_JOB_NAME:
            raise StgaError(f"{where}: its job's name '{shorten(full_name)}' is too long; give its cases short names")
        folder = out / full_name
        request = _request(where, kind, variant.values, base, folder)
        job = Job(full_name, name, request, folder, variant.after, resources, minutes)
        if minutes is not None and (not isinstance(minutes, int | float) or not minutes > 0):
            raise StgaError(f"{where}: {complaint('minutes', 'a number above 0', minutes)}")
        yield job, variant.choices


def _variants(where: str, name: str, given: Mapping[str, Any], table: Mapping[str, Any]) -> Iterator[_Variant]:
    """The combinations of a table's cases and sweep."""
    cases, sweep = table.get("cases", [{}]), table.get("sweep", {})
    if not isinstance(cases, list) or not cases or not all(isinstance(case, dict) for case in cases):
        raise StgaError(f"{where}: cases: expected a list of tables, got {shorten(cases)}")
    if not isinstance(sweep, dict):
        raise StgaError(f"{where}: sweep: expected lists of values by field, got {shorten(sweep)}")
    swept = {key: _swept(f"{where}: sweep: {key}", key, items) for key, items in sweep.items()}
    if len(cases) * prod(map(len, swept.values())) > MAX_JOBS:
        raise StgaError(f"{where}: makes more than {MAX_JOBS} jobs")
    for number, case in enumerate(cases):
        own = case.get("name", str(number) if case else "")
        if case and (not isinstance(own, str) or not NAME.fullmatch(own)):
            raise StgaError(f"{where}: cases.{number}.name: expected letters, digits, '_', '.' and '-', got {own!r}")
        of_case = {f"{name}": own} if case else {}
        for chosen in product(*swept.values()):
            values = _merged(given, {key: item for key, item in case.items() if key != "name"})
            choices = dict(of_case)
            for key, (label, item) in zip(swept, chosen, strict=True):
                values = _merged(values, _nested(key, item))
                choices[f"{name}.{key}"] = label
            yield _Variant(values, choices)


def _swept(where: str, key: str, items: Any) -> list[tuple[str, Any]]:
    """Label and value of each step of a sweep: of a list's items, or of the ranges that a table asks for."""
    if isinstance(items, list) and items:
        return [(_label(key, item), item) for item in items]
    if not isinstance(items, dict) or set(items) != set(RANGE_KEYS):
        expected = f"expected a list of values, or a table of {', '.join(RANGE_KEYS)}"
        raise StgaError(f"{where}: {expected}; got {shorten(items)}")
    first, last, size = (items[name] for name in RANGE_KEYS)
    whole = all(isinstance(number, int) and not isinstance(number, bool) for number in (first, last, size))
    if not whole or not 0 <= first <= last or size < 1:
        raise StgaError(
            f"{where}: expected whole numbers, 'first' up to 'last' and 'size' from 1, got {shorten(items)}"
        )
    if (last - first) // size >= MAX_JOBS:
        raise StgaError(f"{where}: makes more than {MAX_JOBS} jobs")
    short, digits = key.rpartition(".")[2], len(str(last))
    spans = [(begin, min(begin + size - 1, last)) for begin in range(first, last + 1, size)]
    return [(f"{short}{begin:0{digits}d}-{end:0{digits}d}", [begin, end]) for begin, end in spans]


def _nested(key: str, value: Any) -> dict[str, Any]:
    """{"a": {"b": value}} for "a.b"."""
    for part in reversed(key.split(".")):
        value = {part: value}
    return dict(value)


def _merged(values: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """The values with the changes; tables in both are merged."""
    merged = dict(values)
    for key, item in changes.items():
        before = merged.get(key)
        merged[key] = _merged(before, item) if isinstance(before, dict) and isinstance(item, dict) else item
    return merged


def _label(key: str, value: Any) -> str:
    """How a job's name tells this value from the others of its sweep."""
    short = key.rpartition(".")[2]
    if isinstance(value, str):
        named = REFERENCE.sub(r"\1", value)
        return _slug(Path(named).name if "/" in named or "\\" in named else named)
    if isinstance(value, list):
        return short + _slug("-".join(str(item) for item in value))
    if isinstance(value, dict):
        return _slug("-".join(_label(name, item) for name, item in value.items()))
    return short + _slug(str(value).lower())


def _slug(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9_.-]+", "-", text).strip("-.") or "x"


def _joined(
    variants: Iterator[_Variant], after: Sequence[str], made: Mapping[str, list[tuple[Job, Mapping[str, str]]]]
) -> Iterator[_Variant]:
    """Each variant with each fitting combination of the jobs that it refers to.

    Jobs fit where they and the variant agree on every choice that they have in common. A table in `after` alone is
    waited for as a whole, and makes no further jobs.
    """
    for variant in variants:
        names = list(dict.fromkeys(_references(variant.values)))
        for others in product(*(made[name] for name in names)):
            choices: dict[str, str] | None = {}
            for _, chosen in others:
                choices = _agreed(choices, chosen)
            choices = _agreed(choices, variant.choices)
            if choices is None:
                continue
            folders = {name: str(job.folder) for name, (job, _) in zip(names, others, strict=True)}
            waits = [job.name for job, _ in others]
            waits += [job.name for name in after for job, chosen in made[name] if _agreed(choices, chosen) is not None]
            yield _Variant(_expanded(variant.values, folders), choices, tuple(dict.fromkeys(waits)))


def _agreed(first: dict[str, str] | None, second: Mapping[str, str]) -> dict[str, str] | None:
    """The choices of both; None where they differ on one."""
    if first is None or any(first.get(axis, label) != label for axis, label in second.items()):
        return None
    return {**first, **second}


def _expanded(value: Any, folders: Mapping[str, str]) -> Any:
    if isinstance(value, str):
        return REFERENCE.sub(lambda found: folders[found[1].strip()], value)
    if isinstance(value, dict):
        return {key: _expanded(item, folders) for key, item in value.items()}
    return [_expanded(item, folders) for item in value] if isinstance(value, list) else value


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
        settings = from_json(TrainingSettings, _merged(whole, nested))
    except StgaError as error:
        raise StgaError(f"{where}: {str(error).replace('setting ', 'settings.', 1)}") from error
    values["settings"] = to_json(settings)


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


# Inputs


def _with_inputs(source: str, jobs: Sequence[Job]) -> Iterator[Job]:
    """The jobs, each after those whose folders it reads. Raises StgaError for an input that nothing makes."""
    by_folder: dict[Path, Job] = {}
    for job in jobs:
        if job.folder in by_folder:
            cure = "give its cases names of their own"
            raise StgaError(f"{source}: [job.{job.table}]: two of the jobs are called '{job.name}'; {cure}")
        by_folder[job.folder] = job
    for job in jobs:
        after = list(job.after)
        for name, paths in input_paths(job.request).items():
            for path in paths:
                if path == job.folder.parent:
                    cure = "is the batch's own folder; choose another 'out'"
                    raise StgaError(f"{source}: [job.{job.table}]: {name}: {path} {cure}")
                maker = next((by_folder[folder] for folder in (path, *path.parents) if folder in by_folder), None)
                if maker is not None and maker is not job:
                    after.append(maker.name)
                elif maker is None and not path.exists():
                    raise StgaError(f"{source}: [job.{job.table}]: {name}: {path} does not exist")
        yield replace(job, after=tuple(dict.fromkeys(after)))
