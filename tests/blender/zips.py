"""Real Blenders, built zips that say that they are of another version, and what programs print."""

import json
import os
import shlex
import subprocess
import zipfile

from stga_addon import __version__

BLENDERS = [
    shlex.split(each) for each in os.environ.get("STGA_BLENDER", "").split(" ; ") if each.strip()
]
"""Commands that start a Blender, one after another, separated by " ; " in the variable."""
OLD_VERSION = "0.1.9"


def name_of(command):
    return "-".join(command[-2:])


def with_version(archive, version, out):
    """Copy a built zip to the path `out`, with another version in its manifest."""
    own, other = (f'version = "{each}"'.encode() for each in (__version__, version))
    with zipfile.ZipFile(archive) as source, zipfile.ZipFile(out, "w") as made:
        for entry in source.infolist():
            data = source.read(entry)
            is_manifest = entry.filename == "blender_manifest.toml"
            made.writestr(entry, data.replace(own, other, 1) if is_manifest else data)
    return out


def output_of(command, **options):
    """What a program prints, which must not fail."""
    done = subprocess.run([*map(str, command)], capture_output=True, text=True, **options)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout


def result_of(command, **options):
    """The JSON after RESULT of what a program prints."""
    lines = output_of(command, **options).splitlines()
    line = next(line for line in lines if line.startswith("RESULT "))
    return json.loads(line.removeprefix("RESULT "))
