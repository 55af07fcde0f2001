"""Build of the extension's zip from a checkout: `python -m stga_addon.development.package --out
dist`."""

import argparse
import shlex
import subprocess
import tomllib
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path
from typing import Any

from ..errors import StgaError, exit_code
from ..files import replacing
from .compiled_kernels import compile_kernels
from .demo.capture import unpack_capture
from .editions import BARE, DEMO_FOLDER, SMALL, Edition, complete, edition_manifest
from .wheels import (
    PYTHONS,
    TARGETS,
    Target,
    collect_wheels,
    download_locked,
    is_locked,
    this_platform,
)

ROOT = Path(__file__).resolve().parents[2]
"""Folder of the checkout."""
MANIFEST = "blender_manifest.toml"
"""File that describes the extension to Blender, at the top of the checkout."""

WHEELS = (
    "filelock-4.2.11-py3-none-any.whl",
    "trimesh-5.2.0-py3-none-any.whl",
    "tqdm-4.70.1-py3-none-any.whl",
)
"""Wheels that the manifest names. They are pure Python: one serves every platform and version of
Blender."""
KERNELS_FOLDER = "stga_addon/raster/cpu/compiled"
"""Folder of the compiled kernels in the zip: `raster.cpu.bundled.BUNDLE`."""
ENTRY_TIME = (1980, 1, 1, 0, 0, 0)
"""Modification time of every entry, the earliest that a zip can hold: equal sources give an equal
zip."""


def build_zip(
    out: Path,
    root: Path = ROOT,
    edition: Edition = SMALL,
    demo: Path | None = None,
    kernels: Sequence[Path] = (),
) -> Path:
    """Write `<id>-<version><suffix>.zip` into the folder `out`, atomically; equal sources give
    equal bytes.

    demo: a capture to put into the zip. kernels: files of compiled kernels (`raster.cpu.bundled`).
    Downloads the wheels into `root/wheels` where they are missing. Raises StgaError where `root` is
    not a checkout or a wheel cannot be downloaded.
    """
    manifest = read_manifest(root)
    wheels = edition_wheels(root / "wheels", edition)
    files = {file.relative_to(root).as_posix(): file for file in extension_files(root, manifest)}
    files = {name: file for name, file in files.items() if edition.holds(name)}
    files |= {f"wheels/{wheel.name}": wheel for wheel in wheels}
    if demo is not None:
        files |= {
            f"{DEMO_FOLDER}/{file.relative_to(demo).as_posix()}": file
            for file in _walk(demo, demo, [])
        }
    files |= {f"{KERNELS_FOLDER}/{file.name}": file for file in kernels}
    path = out / f"{manifest['id']}-{manifest['version']}{edition.suffix}.zip"
    with (
        replacing(path) as partial,
        zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive,
    ):
        _add(
            archive,
            MANIFEST,
            edition_manifest(manifest, edition, [wheel.name for wheel in wheels]).encode(),
        )
        for name, file in sorted(files.items()):
            _add(archive, name, file.read_bytes())
    return path


def _add(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    entry = zipfile.ZipInfo(name, ENTRY_TIME)
    entry.compress_type = (
        zipfile.ZIP_STORED if name.endswith((".whl", ".png", ".webp")) else zipfile.ZIP_DEFLATED
    )
    entry.external_attr = 0o644 << 16
    archive.writestr(entry, data)


def wheel_folder(target: Target) -> Path:
    """Where the wheels of a complete edition lie: not in `wheels`, all of which Blender's own build
    takes."""
    return ROOT / "build/wheels" / target.name


def edition_wheels(folder: Path, edition: Edition) -> list[Path]:
    """The wheels of an edition in `folder`, downloaded where they are missing. Raises StgaError
    where pip fails."""
    if edition.target is not None:
        return collect_wheels(wheel_folder(edition.target), edition.target)
    fetch_wheels(folder)
    return [folder / name for name in WHEELS]


def read_manifest(root: Path) -> dict[str, Any]:
    """The extension's manifest. Raises StgaError where the file is missing."""
    try:
        return tomllib.loads((root / MANIFEST).read_text(encoding="utf-8"))
    except OSError as error:
        raise StgaError(
            f"{root / MANIFEST}: cannot be read ({error.strerror}); expected a checkout"
        ) from error


def extension_files(root: Path, manifest: dict[str, Any]) -> list[Path]:
    """The files of the zip from the checkout, sorted: what `paths_exclude_pattern` leaves."""
    patterns = manifest["build"]["paths_exclude_pattern"]
    return sorted(_walk(root, root, [*patterns, f"/{MANIFEST}", "/wheels/"]))


def fetch_wheels(folder: Path) -> None:
    """Download WHEELS with pip into `folder` where they are missing. Raises StgaError where pip
    fails."""
    missing = [name for name in WHEELS if not is_locked(folder / name)]
    if missing:
        download_locked(folder, missing)


def _walk(folder: Path, root: Path, patterns: Sequence[str]) -> Iterator[Path]:
    for entry in folder.iterdir():
        if _is_excluded(entry, root, patterns):
            continue
        if entry.is_dir():
            yield from _walk(entry, root, patterns)
        else:
            yield entry


def _is_excluded(entry: Path, root: Path, patterns: Sequence[str]) -> bool:
    """Implements the .gitignore rules that the manifest uses: a leading / anchors, a trailing /
    means a folder."""
    for pattern in patterns:
        if pattern.endswith("/") and not entry.is_dir():
            continue
        name = entry.relative_to(root).as_posix() if pattern.startswith("/") else entry.name
        if fnmatchcase(name, pattern.strip("/")):
            return True
    return False


def target_of(blender: Sequence[str]) -> Target:
    """The target that a Blender is: its Python on this platform, and its own version alone.

    blender: the command that starts it. Raises StgaError where it does not answer.
    """
    asking = (
        "import bpy, sys; print('PYTHON', *sys.version_info[:2], *bpy.app.version[:2], flush=True)"
    )
    command = [*blender, "--background", "--factory-startup", "--python-expr", asking]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise StgaError(f"{blender[0]}: cannot be started ({error.strerror})") from error
    answer = next(
        (line.split()[1:] for line in done.stdout.splitlines() if line.startswith("PYTHON ")), None
    )
    if answer is None:
        raise StgaError(
            f"{shlex.join(blender)}: did not say which Python it has "
            f"(exit status {done.returncode})"
        )
    python = ".".join(answer[:2])
    (major, minor) = map(int, answer[2:])
    if python not in PYTHONS:
        known = ", ".join(PYTHONS)
        raise StgaError(
            f"{shlex.join(blender)}: has Python {python}; wheels are locked for {known}"
        )
    return Target(this_platform(), python, (f"{major}.{minor}.0", f"{major}.{minor + 1}.0"))


def build_editions(options: argparse.Namespace) -> Iterator[Path]:
    """Build the edition that was asked for, the complete one for each of its targets. Raises
    StgaError."""
    if options.edition != "complete":
        yield build_zip(options.out, edition=BARE if options.edition == "bare" else SMALL)
        return
    here = this_platform()
    targets = [target_of(shlex.split(options.blender))] if options.blender else list(TARGETS)
    if not (options.blender or options.all):
        targets = [target for target in targets if target.platform == here]
    demo = options.out / DEMO_FOLDER
    log = partial(print, flush=True)
    for target in [replace(target, cuda=options.allow_cuda) for target in targets]:
        collect_wheels(wheel_folder(target), target, log)
        unpack_capture(demo)
        log(f"{target.name}: compiling kernels, minutes where they are not there")
        kernels = compile_kernels(target, wheel_folder(target), shlex.split(options.blender))
        if not kernels:
            log(f"{target.name}: no Python of it is here; kernels are compiled when first used")
        log(f"{target.name}: writing the zip")
        yield build_zip(options.out, edition=complete(target), demo=demo, kernels=kernels)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m stga_addon.development.package", description=__doc__
    )
    parser.add_argument(
        "--out", type=Path, default=ROOT / "dist", help="folder that receives the zip"
    )
    parser.add_argument("--edition", choices=("bare", "small", "complete"), default="small")
    parser.add_argument(
        "--blender", default="", help="complete: for the Python of this Blender, and no other"
    )
    parser.add_argument(
        "--all", action="store_true", help="complete: for every platform, not only this one"
    )
    parser.add_argument(
        "--allow-cuda",
        action="store_true",
        help="complete: PyTorch's CUDA build where its CPU build cannot be had",
    )
    options = parser.parse_args(arguments)

    def build() -> None:
        for path in build_editions(options):
            print(f"{path}: {path.stat().st_size / 1e6:.1f} MB")

    return exit_code(build)


if __name__ == "__main__":
    raise SystemExit(main())
