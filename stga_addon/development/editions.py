"""Editions of the extension: what each bundles, and what its manifest says.

bare      as small, without what others made that is neither code nor in the public domain
small     tracks and trains in an interpreter that the user chooses
complete  in Blender's own: with the wheels that this needs and a demo capture
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from .wheels import Target

DEMO_FOLDER = "demo_capture"
"""Folder of the demo's capture in the zip."""
ASSETS = {
    "ICT-FaceKit": ("stga_addon/flame/head.npz", "stga_addon/driving/arkit_shapes.npz"),
    "MediaPipe": ("stga_addon/tracking/networks/",),
}
"""Data of others, by their name in the manifest's copyright -> files and folders in the zip."""


@dataclass(frozen=True)
class Edition:
    """What an edition's zip holds.

    suffix        of the file's name, after the version
    target        of the wheels that the edition bundles for training; None: only those that every
                  edition has
    has_assets    whether it holds ASSETS
    """

    suffix: str = ""
    target: Target | None = None
    has_assets: bool = True

    def holds(self, name: str) -> bool:
        """Whether a file of the checkout, by its name in the zip, is in the edition."""
        assets = tuple(each for files in ASSETS.values() for each in files)
        return self.has_assets or not name.startswith(assets)


SMALL = Edition()
BARE = Edition("-bare", has_assets=False)


def complete(target: Target) -> Edition:
    """The complete edition for a target."""
    return Edition(suffix=f"-{target.name}", target=target)


def edition_manifest(manifest: Mapping[str, Any], edition: Edition, wheels: Sequence[str]) -> str:
    """Text of the edition's manifest: that of the checkout, with the edition's wheels and range."""
    values = {
        name: value for name, value in manifest.items() if name not in ("build", "permissions")
    }
    values["wheels"] = [f"./wheels/{name}" for name in wheels]
    if not edition.has_assets:
        holders = values["copyright"]
        values["copyright"] = [each for each in holders if not any(name in each for name in ASSETS)]
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
