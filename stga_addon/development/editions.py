"""Editions of the extension: what each bundles, and what its manifest says.

small     tracks and trains in an interpreter that the user chooses
complete  in Blender's own: with the wheels that this needs and a demo capture
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from .wheels import Target

DEMO_FOLDER = "demo_capture"


@dataclass(frozen=True)
class Edition:
    """What an edition's zip holds.

    suffix        of the file's name, after the version
    target        of the wheels that the edition bundles for training; None: only those that every
                  edition has
    """

    suffix: str = ""
    target: Target | None = None


SMALL = Edition()


def complete(target: Target) -> Edition:
    """The complete edition for a target."""
    return Edition(suffix=f"-{target.name}", target=target)


def edition_manifest(manifest: Mapping[str, Any], edition: Edition, wheels: Sequence[str]) -> str:
    """Text of the edition's manifest: that of the checkout, with the edition's wheels and range."""
    values = {
        name: value for name, value in manifest.items() if name not in ("build", "permissions")
    }
    values["wheels"] = [f"./wheels/{name}" for name in wheels]
    if edition.target is not None:
        values["platforms"] = [edition.target.platform]
        first, end = edition.target.blender
        values["blender_version_min"] = first
        values |= {"blender_version_max": end} if end else {}
    lines = [f"{name} = {_toml(value)}" for name, value in values.items()]
    lines += [
        "",
        "[permissions]",
        *(f"{name} = {_toml(text)}" for name, text in manifest["permissions"].items()),
    ]
    return "\n".join(lines) + "\n"


def _toml(value: str | Sequence[str]) -> str:
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    return "[\n" + "".join(f"  {_toml(item)},\n" for item in value) + "]"
