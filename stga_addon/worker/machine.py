"""Processors and memory that this process may use: those of the machine, or of its container, which
Linux limits by control groups of version 1 or 2."""

import math
import os
import re
from collections.abc import Iterator
from pathlib import Path

PROC = Path("/proc")


def processors(proc: Path = PROC) -> int:
    """How many processors this process may use."""
    known = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    quotas = [math.inf]
    for folder in _groups("cpu", proc):
        quota, _, period = _text(folder / "cpu.max").partition(" ")
        if not period:  # version 1
            quota = _text(folder / "cpu.cfs_quota_us")
            period = _text(folder / "cpu.cfs_period_us")
        if quota.isdecimal() and period.isdecimal():  # else "max" or -1
            quotas.append(int(quota) / max(int(period), 1))
    return max(1, math.ceil(min(known or 1, *quotas)))


def free_memory_gb(proc: Path = PROC) -> float:
    """Memory that is available, in GB; infinite where the system does not report it (Windows,
    macOS)."""
    lines = _text(proc / "meminfo").splitlines()
    found = (line.split()[1] for line in lines if line.startswith("MemAvailable:"))
    free = [float(next(found, "inf")) * 1024]
    for folder in _groups("memory", proc):
        limit = _text(folder / "memory.max")
        used = _text(folder / "memory.current")
        if not used:  # version 1
            limit = _text(folder / "memory.limit_in_bytes")
            used = _text(folder / "memory.usage_in_bytes")
        if limit.isdecimal() and used.isdecimal():  # else "max"
            # pages of files, which are let go when memory runs short
            pages = re.findall(
                r"^(?:total_)?inactive_file (\d+)$", _text(folder / "memory.stat"), re.M
            )
            free.append(int(limit) - int(used) + int(pages[-1] if pages else 0))
    return max(0.0, min(free)) / 1e9


def address_space_gb() -> float:
    """How much address space this process may have (`ulimit -v`), in GB; infinite without a
    limit."""
    if os.name == "nt":
        return math.inf
    import resource

    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    return math.inf if limit == resource.RLIM_INFINITY else limit / 1e9


def _groups(controller: str, proc: Path) -> Iterator[Path]:
    """The folders of the groups that limit this process: its own and those above."""
    mounts = [line.split(" ") for line in _text(proc / "self/mountinfo").splitlines()]
    for line in _text(proc / "self/cgroup").splitlines():
        number, controllers, path = line.split(":", 2)
        if number != "0" and controller not in controllers.split(","):
            continue
        for mount in mounts:
            kind = mount[mount.index("-") + 1]
            options = mount[-1].split(",")
            has_controller = kind == "cgroup2" if number == "0" else controller in options
            if not (kind.startswith("cgroup") and has_controller):
                continue
            top = Path(_unescaped(mount[4]))
            inside = Path(path)
            mount_root = Path(_unescaped(mount[3]))  # which group is at the top
            below = inside.relative_to(mount_root) if inside.is_relative_to(mount_root) else Path()
            yield from (top / part for part in (below, *below.parents))


def _unescaped(text: str) -> str:
    """Blanks in mountinfo are octal numbers."""
    return re.sub(r"\\([0-7]{3})", lambda found: chr(int(found[1], 8)), text)


def _text(path: Path) -> str:
    """What a file says; nothing where it cannot be read."""
    try:
        return path.read_text(encoding="utf-8", errors="replace").strip()
    except OSError:
        return ""
