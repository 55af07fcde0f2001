"""A SLURM cluster of two nodes on this host: munged, slurmctld and two slurmd."""

import os
import pwd
import shutil
import signal
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

PROGRAMS = ("munged", "slurmctld", "slurmd", "sbatch", "squeue", "scancel", "sinfo")
START_TIMEOUT_S = 60.0
CONFIGURATION = """
ClusterName=stga
SlurmctldHost={host}
SlurmUser={user}
SlurmctldPort={controller}
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket
CryptoType=crypto/munge
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool-%n
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd-%n.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd-%n.log
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SwitchType=switch/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU_Memory
SchedulerParameters=sched_interval=2,bf_interval=2,sched_min_interval=0
SlurmdTimeout=10
ReturnToService=2
NodeName=one NodeHostname={host} NodeAddr=127.0.0.1 Port={first} CPUs=1 RealMemory=4000
NodeName=two NodeHostname={host} NodeAddr=127.0.0.1 Port={second} CPUs=1 RealMemory=4000
PartitionName=all Nodes=one,two Default=YES MaxTime=INFINITE State=UP
"""


def missing_programs() -> list[str]:
    return [name for name in PROGRAMS if shutil.which(name, path=_path()) is None]


def _path() -> str:
    return os.environ.get("PATH", "") + ":/usr/sbin"


def _free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


class Cluster:
    """nodes: name -> its slurmd; variables: what SLURM's programs need in their environment."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.variables = {**os.environ, "PATH": _path(), "SLURM_CONF": str(folder / "slurm.conf")}
        self.nodes: dict[str, subprocess.Popen[bytes]] = {}
        self._others: list[subprocess.Popen[bytes]] = []

    def start(self) -> None:
        self.folder.chmod(0o755)
        (self.folder / "state").mkdir()
        key = self.folder / "munge.key"
        key.write_bytes(os.urandom(128))
        key.chmod(0o600)
        ports = {name: _free_port() for name in ("controller", "first", "second")}
        user = pwd.getpwuid(os.geteuid()).pw_name
        host = socket.gethostname()
        text = CONFIGURATION.format(folder=self.folder, user=user, host=host, **ports)
        (self.folder / "slurm.conf").write_text(text)
        names = {
            "socket": "munge.socket",
            "pid-file": "munge.pid",
            "log-file": "munge.log",
            "seed-file": "munge.seed",
        }
        files = [f"--{option}={self.folder / name}" for option, name in names.items()]
        self._others.append(
            self._spawn(["munged", "--foreground", "--force", f"--key-file={key}", *files])
        )
        self._await(lambda: (self.folder / "munge.socket").exists(), "munged")
        self._others.append(self._spawn(["slurmctld", "-D"]))
        for name in ("one", "two"):
            self.start_node(name)
        self._await(lambda: self._idle() == 2, "slurmctld")

    def start_node(self, name: str) -> None:
        self.nodes[name] = self._spawn(["slurmd", "-D", "-N", name])

    def kill_node(self, name: str) -> None:
        """Kill everything of a node, as when a machine loses power."""
        self.nodes[name].kill()
        self.nodes[name].wait()
        marks = (f"SLURMD_NODENAME={name}".encode(), f"SLURM_CONF={self.folder}".encode())
        for process in Path("/proc").glob("[0-9]*"):
            try:
                variables = (process / "environ").read_bytes().split(b"\0")
                if all(any(found.startswith(mark) for found in variables) for mark in marks):
                    parent = int((process / "stat").read_text().rpartition(")")[2].split()[1])
                    if "slurmstepd" in Path(f"/proc/{parent}/comm").read_text():
                        os.kill(parent, signal.SIGKILL)
                    os.kill(int(process.name), signal.SIGKILL)
            except (OSError, ProcessLookupError):  # it has ended meanwhile
                continue

    def start_delayed(self) -> None:
        """Start what waits for its time only: SLURM holds back a lost node's jobs for minutes."""
        waiting = self._run(
            "squeue", "--noheader", "--states=PENDING", "--format=%i %r"
        ).splitlines()
        for job, reason in (line.split(maxsplit=1) for line in waiting):
            if reason == "BeginTime":
                self._run("scontrol", "update", f"JobId={job}", "StartTime=now")

    def stop(self) -> None:
        for process in [*self.nodes.values(), *reversed(self._others)]:
            process.terminate()
        for process in [*self.nodes.values(), *self._others]:
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def _idle(self) -> int:
        return self._run("sinfo", "--noheader", "--Node", "--format=%T").split().count("idle")

    def _run(self, *command: str) -> str:
        return subprocess.run(command, env=self.variables, capture_output=True, text=True).stdout

    def _spawn(self, command: list[str]) -> subprocess.Popen[bytes]:
        with (self.folder / f"{command[0]}.out").open("ab") as out:
            return subprocess.Popen(
                command, env=self.variables, stdout=out, stderr=out, start_new_session=True
            )

    def _await(self, is_there: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + START_TIMEOUT_S
        while not is_there():
            if time.monotonic() > deadline:
                logs = "\n".join(
                    p.read_text(errors="replace")[-1500:]
                    for p in self.folder.glob("*.[lo][ou][gt]")
                )
                raise TimeoutError(f"{what} did not start:\n{logs}")
            time.sleep(0.2)


@contextmanager
def running_cluster(folder: Path) -> Iterator[Cluster]:
    cluster = Cluster(folder)
    try:
        cluster.start()
        yield cluster
    finally:
        cluster.stop()
