"""Processors and memory of containers, from the files of Linux's control groups."""

import pytest

from stga_addon.worker.machine import free_memory_gb, processors

GB = 1_000_000_000
SYSTEMD = "31 23 0:28 / {sys} ro,nosuid - tmpfs tmpfs ro,mode=755\n"
VERSION_2 = SYSTEMD + "35 31 0:30 {shown} {sys}/a\\040b rw,nosuid shared:9 - cgroup2 cgroup2 rw\n"
VERSION_1 = SYSTEMD + (
    "33 31 0:31 {shown} {sys}/cpu,cpuacct rw - cgroup cgroup rw,cpu,cpuacct\n"
    "34 31 0:32 {shown} {sys}/memory rw master:12 - cgroup cgroup rw,memory\n"
)
TWO = {
    "cpu.max": "200000 100000",
    "memory.max": 6 * GB,
    "memory.current": 3 * GB,
    "memory.stat": f"anon 12\nfile 44\ninactive_file {GB}\nactive_file 9",
}
NONE_2 = {"cpu.max": "max 100000", "memory.max": "max", "memory.current": 50 * GB}
ONE = {
    "cpu,cpuacct/{}/cpu.cfs_quota_us": 150000,
    "cpu,cpuacct/{}/cpu.cfs_period_us": 100000,
    "memory/{}/memory.limit_in_bytes": 6 * GB,
    "memory/{}/memory.usage_in_bytes": 3 * GB,
    "memory/{}/memory.stat": f"cache 1\ninactive_file 7\nhierarchical_memory_limit {6 * GB}\n"
    f"total_inactive_file {GB}\ntotal_unevictable 0",
}
NONE_1 = {
    "cpu,cpuacct/cpu.cfs_quota_us": -1,
    "cpu,cpuacct/cpu.cfs_period_us": 100000,
    "memory/memory.limit_in_bytes": 9223372036854771712,
    "memory/memory.usage_in_bytes": 50 * GB,
}


def below(folder, files):
    return {f"{folder}/{name}": value for name, value in files.items()}


CASES = {
    "none": ("", "", "/", {}, 8, 20),
    "version 2, no limit": ("0::/\n", VERSION_2, "/", below("a b", NONE_2), 8, 20),
    "version 2, in a container": ("0::/\n", VERSION_2, "/", below("a b", TWO), 2, 4),
    "version 2, above": (
        "0::/job.slice/step_0\n",
        VERSION_2,
        "/",
        below("a b/job.slice/step_0", NONE_2) | below("a b/job.slice", TWO),
        2,
        4,
    ),
    "version 1, seen from outside": (
        "5:memory:/docker/12ab\n4:cpu,cpuacct:/docker/12ab\n0::/x\n",
        VERSION_1,
        "/",
        {name.format("docker/12ab"): value for name, value in ONE.items()} | NONE_1,
        2,
        4,
    ),
    "version 1, in a container": (
        "5:memory:/docker/12ab\n4:cpu,cpuacct:/docker/12ab\n",
        VERSION_1,
        "/docker/12ab",
        {name.replace("{}/", ""): value for name, value in ONE.items()},
        2,
        4,
    ),
    "version 1, no limit": ("5:memory:/\n4:cpu,cpuacct:/\n", VERSION_1, "/", NONE_1, 8, 20),
    "files that may not be read": ("0::/\n5:memory:/\n", VERSION_2 + VERSION_1, "/", {}, 8, 20),
}


@pytest.mark.parametrize("case", CASES)
def test_a_container_has_what_it_is_given(tmp_path, monkeypatch, case):
    """Catches a batch planned with the processors and memory of a container's host, a limit of a
    group above, and pages of files that count as memory in use."""
    groups, mounts, shown, files, expected, free = CASES[case]
    written = {f"sys/{name}": value for name, value in files.items()}
    written |= {
        "proc/self/cgroup": groups,
        "proc/meminfo": "MemTotal: 1 kB\nMemAvailable: 19531250 kB",
    }
    written["proc/self/mountinfo"] = mounts.format(shown=shown, sys=tmp_path / "sys")
    for name, value in written.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(f"{value}\n")
    monkeypatch.setattr("os.sched_getaffinity", lambda process: set(range(8)), raising=False)
    assert processors(tmp_path / "proc") == expected
    assert free_memory_gb(tmp_path / "proc") == pytest.approx(free)
