"""A repository for Blender from built zips: `python -m stga_addon.development.repository dist --out
dist/repository`.

A static folder that any web server can hold: the zips, index.json as Blender reads it, and a page
for people.
"""

import argparse
import html
import json
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..errors import StgaError, exit_code

INDEX = "index.json"
PAGE = "index.html"
TEXT = """<!DOCTYPE html>
<html lang="en">
<meta charset="utf-8">
<title>STGA Head Avatars for Blender</title>
<h1>STGA Head Avatars for Blender</h1>
<p>In Blender: Edit → Preferences → Get Extensions → Repositories → Add Remote Repository, with the
address of <a href="index.json">index.json</a> on this server. Updates then come from here. Or
download a zip and choose Install from Disk.</p>
<table>
<tr><th>File</th><th>Version</th><th>Platform</th><th>Blender</th><th>Size</th></tr>
{rows}
</table>
</html>
"""


def write_repository(zips: Sequence[Path], out: Path, blender: Sequence[str]) -> Path:
    """Write the repository of the zips into the folder `out`; returns its index.json.

    An earlier repository there is replaced once the new one is complete.
    blender: the command that starts a Blender. Raises StgaError where there is no zip or Blender
    fails.
    """
    if not zips:
        raise StgaError(
            "no zips for the repository; "
            "build one with `make extension` or `make extension-complete`"
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=out.parent) as scratch:
        made = Path(scratch) / "made"
        made.mkdir()
        for path in zips:
            shutil.copy2(path, made / path.name)
        command = [*blender, "--command", "extension", "server-generate", "--repo-dir", str(made)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
        except OSError as error:
            raise StgaError(f"{blender[0]}: cannot be started ({error.strerror})") from error
        if done.returncode or not (made / INDEX).is_file():
            reason = (done.stderr or done.stdout).strip().splitlines()[-1:] or ["no reason given"]
            raise StgaError(f"{shlex.join(blender)}: could not make the index ({reason[0]})")
        entries = json.loads((made / INDEX).read_text(encoding="utf-8"))["data"]
        missing = {path.name for path in zips} - {
            Path(entry["archive_url"]).name for entry in entries
        }
        if missing:
            raise StgaError(
                f"{shlex.join(blender)}: left {', '.join(sorted(missing))} out of the index"
            )
        (made / PAGE).write_text(TEXT.format(rows="\n".join(map(_row, entries))), encoding="utf-8")
        if out.exists():
            out.replace(Path(scratch) / "earlier")
        made.replace(out)
    return out / INDEX


def _row(entry: dict[str, Any]) -> str:
    name = Path(entry["archive_url"]).name
    end = entry.get("blender_version_max")
    blender = f"{entry['blender_version_min']} or newer" + (f", before {end}" if end else "")
    size = f"{entry['archive_size'] / 1e6:.1f} MB"
    cells = (entry["version"], ", ".join(entry.get("platforms", ["any"])), blender, size)
    link = f'<a href="{html.escape(name)}">{html.escape(name)}</a>'
    return (
        "<tr>" + "".join(f"<td>{cell}</td>" for cell in (link, *map(html.escape, cells))) + "</tr>"
    )


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m stga_addon.development.repository", description=__doc__
    )
    parser.add_argument(
        "zips",
        type=Path,
        help="folder of the built zips: the complete edition's where there are, else the small",
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the repository")
    parser.add_argument("--blender", default="blender", help="command that starts a Blender")
    options = parser.parse_args(arguments)
    built = sorted(
        path for path in options.zips.glob("*.zip") if not path.stem.endswith("-platform")
    )
    # One edition: Blender takes two zips of one version, platform and range for a mistake.
    zips = [path for path in built if "-py" in path.stem] or built
    return exit_code(
        lambda: print(write_repository(zips, options.out, shlex.split(options.blender)))
    )


if __name__ == "__main__":
    raise SystemExit(main())
