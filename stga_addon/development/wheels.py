"""Wheels of the complete edition: which ones a target needs, their download, and the check of what
came.

pip evaluates environment markers for the system it runs on, so dependencies are followed here, with
the markers of the target, and pip only picks and downloads one wheel per package.
"""

import platform
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from email.parser import HeaderParser
from pathlib import Path

from packaging.requirements import Requirement
from packaging.tags import Tag, cpython_tags
from packaging.utils import canonicalize_name, parse_wheel_filename

from ..errors import StgaError
from ..worker.training_python import GPU_REQUIREMENT, REQUIREMENTS

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
PROVIDED = frozenset({"numpy"})
"""Packages that Blender brings."""
PINS = {
    "": (
        "filelock==4.2.11",
        "trimesh==5.2.0",
        "tqdm==4.70.1",
        "torch==2.13.0",
        "numba==0.68.1",
        "llvmlite==0.50.0",
        "pillow==13.0.0",
        "platformdirs==4.14.7",
        "av==18.1.0",
        "wgpu==0.32.0",
        "opencv-python-headless==4.14.0.94",
    ),
    # The last that run with numpy 1.24, which Blender 4.2 and 4.3 bring.
    "3.11": ("scipy==1.15.3", "matplotlib==3.10.8", "contourpy==1.3.2"),
}
"""Versions that the complete edition bundles, on every Python and on one; what these need
follows."""


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
        own = cpython_tags(version, platforms=PLATFORM_TAGS[self.platform])
        pure = (
            Tag(f"py{name}", "none", where)
            for name in ("3", self.python.replace(".", ""))
            for where in ("any", *PLATFORM_TAGS[self.platform])
        )
        return frozenset((*own, *pure))


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


def collect_wheels(folder: Path, target: Target) -> list[Path]:
    """The wheels that training needs on the target, downloaded into `folder` where they are
    missing; sorted by name.

    Raises StgaError where one cannot be had.
    """
    wanted = [*REQUIREMENTS.values(), GPU_REQUIREMENT]
    wheels: dict[str, Path] = {}
    followed: set[str] = set()
    while wanted:
        requirement = Requirement(wanted.pop())
        name = canonicalize_name(requirement.name)
        if name in PROVIDED or str(requirement) in followed:
            continue
        followed.add(str(requirement))
        if name not in wheels:
            wheels[name] = _present(folder, requirement, target) or _download(
                folder, requirement, target
            )
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
        name, version, _, own = parse_wheel_filename(wheel.name)
        if not own & tags:
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


def _present(folder: Path, requirement: Requirement, target: Target) -> Path | None:
    """The wheel that is already in the folder; its version is the pinned one, or any that fits."""
    pins = {Requirement(text).name: Requirement(text).specifier for text in pins_of(target)}
    specifier = requirement.specifier & pins.get(requirement.name, requirement.specifier)
    tags = target.tags()
    for wheel in sorted(folder.glob("*.whl"), reverse=True):
        name, version, _, own = parse_wheel_filename(wheel.name)
        fits = name == canonicalize_name(requirement.name) and specifier.contains(
            version, prereleases=True
        )
        if (
            fits
            and own & tags
            and (target.cuda or name != "torch" or not _needs_cuda(wheel, target))
        ):
            return wheel
    return None


def _needs_cuda(wheel: Path, target: Target) -> bool:
    return any(text.startswith(("nvidia-", "cuda-")) for text in needs(wheel, target))


def pins_of(target: Target) -> list[str]:
    return [*PINS[""], *PINS.get(target.python, ())]


def _download(folder: Path, requirement: Requirement, target: Target) -> Path:
    """Download one wheel as it is; on Linux PyTorch's CPU build, unless the target may have
    another."""
    folder.mkdir(parents=True, exist_ok=True)
    bare = f"{requirement.name}{requirement.specifier}"
    if requirement.name != "torch" or target.platform != "linux-x64":
        return _pip_download(folder, bare, target)
    build = next(pin for pin in pins_of(target) if pin.startswith("torch==")) + "+cpu"
    for more in ([], ["--index-url", TORCH_CPU_INDEX, "--retries", "0"]):
        try:
            return _pip_download(folder, build, target, more)
        except StgaError as error:
            failure = error
    if target.cuda:
        return _pip_download(folder, bare, target)
    raise StgaError(
        f"{failure}; expected {build} where pip is configured to look, at {TORCH_CPU_INDEX}, or in "
        f"{folder}; with --allow-cuda (make: CUDA=1) the zip has the CUDA build, and gigabytes "
        "that nothing uses"
    )


def _pip_download(folder: Path, wanted: str, target: Target, more: Sequence[str] = ()) -> Path:
    with tempfile.TemporaryDirectory(dir=folder) as scratch:
        pins = Path(scratch) / "pins.txt"
        pins.write_text("\n".join(pins_of(target)), encoding="utf-8")
        tags = [part for tag in PLATFORM_TAGS[target.platform] for part in ("--platform", tag)]
        options = [
            "--no-deps",
            "--only-binary=:all:",
            "--python-version",
            target.python,
            "--implementation",
            "cp",
            *tags,
        ]
        command = [
            sys.executable,
            "-m",
            "pip",
            "download",
            "--quiet",
            "--disable-pip-version-check",
            *options,
        ]
        done = subprocess.run(
            [*command, "-c", str(pins), "-d", scratch, *more, wanted],
            capture_output=True,
            text=True,
            check=False,
        )
        found = sorted(Path(scratch).glob("*.whl"))
        if done.returncode or len(found) != 1:
            # The first error: the last one of several is about how to ask for help.
            reason = next(
                (line for line in done.stderr.splitlines() if line.startswith("ERROR: ")),
                "pip failed",
            )
            raise StgaError(
                f"{target.name}: pip could not download {wanted} ({reason.removeprefix('ERROR: ')})"
            )
        return found[0].replace(folder / found[0].name)
