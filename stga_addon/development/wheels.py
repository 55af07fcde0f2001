"""Wheels of the complete edition: which ones a target needs, their download, and the check of what
came.

pip evaluates environment markers for the system it runs on, so dependencies are followed here, with
the markers of the target, and pip only downloads one wheel per package, by its hash.
"""

import hashlib
import platform
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from email.parser import HeaderParser
from functools import cache
from pathlib import Path

from packaging.requirements import Requirement
from packaging.tags import Tag, cpython_tags
from packaging.utils import canonicalize_name, parse_wheel_filename

from ..errors import StgaError
from ..progress import Log
from ..worker.training_python import CAMERAS_REQUIREMENT, GPU_REQUIREMENT, REQUIREMENTS

TORCH_CPU_INDEX = "https://download.pytorch.org/whl/cpu"
"""PyTorch's CPU build serves GPUs as well, since the kernels are WebGPU's; the CUDA build, which
PyPI has for Linux, takes gigabytes. Everything else comes from PyPI, or the mirror that pip is
configured for."""
PLATFORM_TAGS = {
    "linux-x64": (
        *(f"manylinux_2_{minor}_x86_64" for minor in range(28, 4, -1)),
        *("manylinux2014_x86_64", "manylinux2010_x86_64", "manylinux1_x86_64"),
    ),
    "windows-x64": ("win_amd64",),
    "macos-arm64": (
        *(
            f"macosx_{major}_0_{kind}"
            for major in range(14, 10, -1)
            for kind in ("arm64", "universal2")
        ),
        *(f"macosx_10_{minor}_universal2" for minor in range(15, 8, -1)),
    ),
}
"""Blender's name of a platform -> tags of wheels that run there: glibc 2.28 and macOS 14 or
newer."""
MARKERS = {
    "linux-x64": {
        "sys_platform": "linux",
        "platform_system": "Linux",
        "platform_machine": "x86_64",
        "os_name": "posix",
    },
    "windows-x64": {
        "sys_platform": "win32",
        "platform_system": "Windows",
        "platform_machine": "AMD64",
        "os_name": "nt",
    },
    "macos-arm64": {
        "sys_platform": "darwin",
        "platform_system": "Darwin",
        "platform_machine": "arm64",
        "os_name": "posix",
    },
}
"""Values of environment markers on each platform."""
BLENDER_RANGES = {"3.11": ("4.2.0", "5.1.0"), "3.13": ("5.1.0", "")}
"""Python -> first Blender that brings it, and the first that no longer does."""
PYTHONS = (*BLENDER_RANGES, "3.14")
"""Pythons that `LOCK` has wheels for; of the last, for a Blender that is built with it."""
PROVIDED = frozenset({"numpy"})
"""Packages that Blender brings."""
LOCK = Path(__file__).with_name("wheels.lock")
"""SHA-256 and file name of each wheel that an edition may hold, as coreutils write them. SciPy
and Matplotlib of Python 3.11 are the last that run with numpy 1.24, as in Blender 4.2 and 4.3."""


@dataclass(frozen=True)
class Target:
    """A platform by Blender's name, a Python as "3.11", the Blender versions (first, first no
    longer) with it, and whether torch may be the CUDA build, where its CPU build cannot be had."""

    platform: str
    python: str
    blender: tuple[str, str]
    cuda: bool = False

    @property
    def name(self) -> str:
        return f"{self.platform}-py{self.python.replace('.', '')}"

    @property
    def markers(self) -> dict[str, str]:
        more = {
            "python_version": self.python,
            "python_full_version": f"{self.python}.0",
            "extra": "",
        }
        return {
            **MARKERS[self.platform],
            **more,
            "implementation_name": "cpython",
            "platform_python_implementation": "CPython",
        }

    def tags(self) -> frozenset[Tag]:
        """Tags of the wheels that run on the target."""
        version = tuple(int(part) for part in self.python.split("."))
        compiled = cpython_tags(version, platforms=PLATFORM_TAGS[self.platform])
        pure = (
            Tag(f"py{name}", "none", where)
            for name in ("3", self.python.replace(".", ""))
            for where in ("any", *PLATFORM_TAGS[self.platform])
        )
        return frozenset((*compiled, *pure))


TARGETS = tuple(
    Target(platform, python, blender)
    for platform in PLATFORM_TAGS
    for python, blender in BLENDER_RANGES.items()
)


def this_platform() -> str:
    """Blender's name of the platform that this process runs on. Raises StgaError for one without a
    complete edition."""
    found = {
        ("Linux", "x86_64"): "linux-x64",
        ("Windows", "AMD64"): "windows-x64",
        ("Darwin", "arm64"): "macos-arm64",
    }
    here = platform.system(), platform.machine()
    if here not in found:
        raise StgaError(
            f"{' '.join(here)}: has no complete edition; expected one of {', '.join(PLATFORM_TAGS)}"
        )
    return found[here]


def collect_wheels(folder: Path, target: Target, log: Log = lambda line: None) -> list[Path]:
    """The wheels that training needs on the target, sorted by name. Those that `folder` lacks are
    downloaded into it. log: called with a line for each wheel.

    Raises StgaError if a wheel is not available.
    """
    wanted = [*REQUIREMENTS.values(), GPU_REQUIREMENT, CAMERAS_REQUIREMENT]
    wheels: dict[str, Path] = {}
    followed: set[str] = set()
    while wanted:
        requirement = Requirement(wanted.pop())
        name = canonicalize_name(requirement.name)
        if name in PROVIDED or str(requirement) in followed:
            continue
        followed.add(str(requirement))
        if name not in wheels:
            present = _present(folder, requirement, target)
            log(f"{target.name}: {present.name if present else f'downloading {requirement}'}")
            wheels[name] = present or _download(folder, requirement, target)
        wanted += needs(wheels[name], target, requirement.extras)
    chosen = sorted(wheels.values())
    check_wheels(chosen, target)
    return chosen


def check_wheels(wheels: Sequence[Path], target: Target) -> None:
    """Raise StgaError unless every wheel runs on the target and all that they need, and training
    needs, is there."""
    tags = target.tags()
    versions = {}
    for wheel in wheels:
        name, version, _, wheel_tags = parse_wheel_filename(wheel.name)
        if not wheel_tags & tags:
            raise StgaError(
                f"{wheel.name}: does not run on {target.platform} with Python {target.python}"
            )
        versions[str(name)] = version
    wanted = [(text, "training") for text in REQUIREMENTS.values()]
    wanted += [(text, wheel.name) for wheel in wheels for text in needs(wheel, target)]
    for text, owner in wanted:
        requirement = Requirement(text)
        name = canonicalize_name(requirement.name)
        if name in PROVIDED:
            continue
        if name not in versions:
            raise StgaError(f"{target.name}: {owner} needs {name}, which is not among the wheels")
        if not requirement.specifier.contains(versions[name], prereleases=True):
            raise StgaError(
                f"{target.name}: {owner} needs {text}, the wheels hold {versions[name]}"
            )


def needs(wheel: Path, target: Target, extras: Iterable[str] = ()) -> list[str]:
    """Requirements of a wheel on the target, without their markers. Raises StgaError where it is no
    wheel."""
    try:
        with zipfile.ZipFile(wheel) as archive:
            name = next(name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
            metadata = HeaderParser().parsestr(archive.read(name).decode("utf-8"))
    except (OSError, zipfile.BadZipFile, StopIteration) as error:
        raise StgaError(f"{wheel}: is not a wheel ({error or 'no METADATA'})") from error
    found = []
    for text in metadata.get_all("Requires-Dist", []):
        requirement = Requirement(text)
        given = [{**target.markers, "extra": extra} for extra in ("", *extras)]
        if requirement.marker is None or any(map(requirement.marker.evaluate, given)):
            requirement.marker = None
            found.append(str(requirement))
    return found


@cache
def locked_wheels() -> Mapping[str, str]:
    """File name -> SHA-256 of the wheels in LOCK."""
    lines = LOCK.read_text(encoding="ascii").splitlines()
    return {name: digest for digest, name in (line.split() for line in lines)}


def is_locked(wheel: Path) -> bool:
    """Whether a file is there, and the wheel of its name that LOCK has."""
    if not wheel.is_file():
        return False
    with wheel.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest() == locked_wheels()[wheel.name]


def download_locked(folder: Path, names: Sequence[str], options: Sequence[str] = ()) -> None:
    """Download wheels of LOCK with pip, one of each package, into `folder`. options: more of pip's.
    Raises StgaError where pip fails, or comes back with other bytes."""
    folder.mkdir(parents=True, exist_ok=True)
    wanted: dict[str, list[str]] = {}
    for name in names:
        package, version = name.split("-")[:2]
        wanted.setdefault(f"{package}=={version}", []).append(locked_wheels()[name])
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        lines = (f"{what} --hash=sha256:{' --hash=sha256:'.join(h)}" for what, h in wanted.items())
        requirements = Path(scratch) / "wheels.txt"
        requirements.write_text("\n".join(lines), encoding="utf-8")
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps"]
        command += ["--disable-pip-version-check", "--only-binary=:all:", "--require-hashes"]
        command += ["-r", str(requirements), "-d", scratch, *options]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            # The first error: the last one of several is about how to ask for help.
            errors = (line for line in done.stderr.splitlines() if line.startswith("ERROR: "))
            reason = next(errors, "pip failed").removeprefix("ERROR: ")
            raise StgaError(f"{folder}: pip could not download {', '.join(wanted)} ({reason})")
        for wheel in sorted(Path(scratch).glob("*.whl")):
            wheel.replace(folder / wheel.name)


def _locked(requirement: Requirement, target: Target) -> list[str]:
    """Names of the wheels in LOCK that fit a requirement and run on the target; of torch on Linux,
    the CPU build's first."""
    tags = target.tags()
    found = []
    for wheel in locked_wheels():
        name, version, _, wheel_tags = parse_wheel_filename(wheel)
        fits = requirement.specifier.contains(version, prereleases=True)
        if name == canonicalize_name(requirement.name) and fits and wheel_tags & tags:
            found.append((version.local is None, wheel))
    if not found:
        raise StgaError(f"{target.name}: {LOCK.name} has no wheel of {requirement}")
    return [wheel for _, wheel in sorted(found)]


def _present(folder: Path, requirement: Requirement, target: Target) -> Path | None:
    """The wheel that is already in the folder, with the hash that LOCK has."""
    for name in _locked(requirement, target):
        wheel = folder / name
        if is_locked(wheel) and (
            target.cuda or requirement.name != "torch" or not _needs_cuda(wheel, target)
        ):
            return wheel
    return None


def _needs_cuda(wheel: Path, target: Target) -> bool:
    return any(text.startswith(("nvidia-", "cuda-")) for text in needs(wheel, target))


def _download(folder: Path, requirement: Requirement, target: Target) -> Path:
    """Download one wheel as it is; on Linux PyTorch's CPU build, unless the target may have
    another."""
    names = _locked(requirement, target)
    if requirement.name != "torch" or target.platform != "linux-x64":
        return _downloaded(folder, names, target)
    cpu = [name for name in names if "+cpu" in name]
    failure = f"{LOCK.name} has no CPU build of torch for {target.name}"
    for more in ([], ["--index-url", TORCH_CPU_INDEX, "--retries", "0"]) if cpu else ():
        try:
            return _downloaded(folder, cpu, target, more)
        except StgaError as error:
            failure = str(error)
    if target.cuda:
        return _downloaded(folder, [name for name in names if name not in cpu], target)
    raise StgaError(
        f"{failure}; expected the CPU build where pip is configured to look, at {TORCH_CPU_INDEX}, "
        f"or in {folder}; with --allow-cuda (make: CUDA=1) the zip has the CUDA build, and "
        "gigabytes that nothing uses"
    )


def _downloaded(
    folder: Path, names: Sequence[str], target: Target, more: Sequence[str] = ()
) -> Path:
    """The one of these wheels of a package that pip takes for the target."""
    options = ["--python-version", target.python, "--implementation", "cp", *more]
    for tag in PLATFORM_TAGS[target.platform]:
        options += ["--platform", tag]
    download_locked(folder, names, options)
    return next(folder / name for name in names if (folder / name).is_file())
