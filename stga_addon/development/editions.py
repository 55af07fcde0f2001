"""Editions of the extension: what each leaves out of the checkout, and what its manifest says.

small     chooses an interpreter for training, or makes an environment with pip
platform  the small edition without any way to install or download something
complete  the small edition without the installer, with the wheels that training needs and a demo capture
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from .wheels import Target

INSTALLER_FILES = ("/operators/make_environment.py", "/stga_addon/requests/environment_make.py")
DEMO_FOLDER = "demo_capture"


@dataclass(frozen=True)
class Edition:
    """What an edition's zip holds.

    suffix        of the file's name, after the version
    left_out      files of the checkout, as the manifest's patterns
    permissions   texts of the manifest; those missing are not asked for
    target        of the wheels that the edition bundles for training; None: only those that every edition has
    """

    suffix: str = ""
    left_out: tuple[str, ...] = ()
    permissions: Mapping[str, str] = field(default_factory=dict)
    target: Target | None = None


FILES_PERMISSION = "Read captures and FLAME models, write avatars and renderings"
LIVE_PERMISSION = "Receive faces live, only when asked to"
DOWNLOAD_PERMISSION = "Receive faces live, download PyTorch; only when asked to"

SMALL = Edition(permissions={"files": FILES_PERMISSION, "network": DOWNLOAD_PERMISSION})
PLATFORM = Edition(
    suffix="-platform",
    left_out=INSTALLER_FILES,
    permissions={"files": FILES_PERMISSION, "network": LIVE_PERMISSION},
)


def complete(target: Target) -> Edition:
    """The complete edition for a target."""
    return Edition(
        suffix=f"-{target.name}",
        left_out=INSTALLER_FILES,
        permissions={"files": FILES_PERMISSION, "network": LIVE_PERMISSION},
        target=target,
    )


def edition_manifest(manifest: Mapping[str, Any], edition: Edition, wheels: Sequence[str]) -> str:
    """Text of the edition's manifest: that of the checkout, with the edition's wheels, permissions and range."""
    values = {name: value for name, value in manifest.items() if name not in ("build", "permissions")}
    values["wheels"] = [f"./wheels/{name}" for name in wheels]
    if edition.target is not None:
        values["platforms"] = [edition.target.platform]
        first, end = edition.target.blender
        values["blender_version_min"] = first
        values |= {"blender_version_max": end} if end else {}
    lines = [f"{name} = {_toml(value)}" for name, value in values.items()]
    lines += ["", "[permissions]", *(f"{name} = {_toml(text)}" for name, text in edition.permissions.items())]
    return "\n".join(lines) + "\n"


def _toml(value: str | Sequence[str]) -> str:
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    return "[\n" + "".join(f"  {_toml(item)},\n" for item in value) + "]"
