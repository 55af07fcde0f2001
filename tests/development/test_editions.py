"""The editions' wheels, manifests and files; Blender's part is in tests/blender."""

import hashlib
import os
import re
import sys
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name, parse_wheel_filename
from refusal import refusal

from stga_addon.development.editions import BARE, SMALL, complete, edition_manifest
from stga_addon.development.package import (
    ROOT,
    build_zip,
    main,
    read_manifest,
    target_of,
    wheel_folder,
)
from stga_addon.development.wheels import (
    PLATFORM_TAGS,
    PYTHONS,
    TARGETS,
    Target,
    check_wheels,
    collect_wheels,
    download_locked,
    locked_wheels,
    needs,
)
from stga_addon.driving.shapes import face_shapes
from stga_addon.tracking.face_networks import PersonNetwork
from stga_addon.worker.training_python import CAMERAS_REQUIREMENT, GPU_REQUIREMENT, REQUIREMENTS

LINUX = Target("linux-x64", "3.11", ("4.2.0", "5.1.0"))
WINDOWS = Target("windows-x64", "3.13", ("5.1.0", ""))
NATIVE = {
    "linux-x64": "cp{0}-cp{0}-manylinux_2_27_x86_64.manylinux_2_28_x86_64",
    "windows-x64": "cp{0}-cp{0}-win_amd64",
    "macos-arm64": "cp{0}-cp{0}-macosx_12_0_arm64",
}


def make_wheel(folder, name, version, tag, *requirements):
    stem = f"{name.replace('-', '_')}-{version}"
    path = folder / f"{stem}-{tag}.whl"
    text = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n"
    text += "".join(f"Requires-Dist: {requirement}\n" for requirement in requirements)
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{stem}.dist-info/METADATA", text)
        archive.writestr(f"{stem}.dist-info/WHEEL", "Wheel-Version: 1.0\n")
    return path


@pytest.fixture
def lock(monkeypatch):
    """Folder -> its wheels become those that an edition may hold."""

    def lock_folders(*folders):
        wheels = [wheel for folder in folders for wheel in folder.glob("*.whl")]
        found = {wheel.name: hashlib.sha256(wheel.read_bytes()).hexdigest() for wheel in wheels}
        monkeypatch.setattr("stga_addon.development.wheels.locked_wheels", lambda: found)

    return lock_folders


def wheel_set(folder, target):
    """A wheel of the pinned version for each package that training needs."""
    pins = {name.split("-")[0].replace("_", "-"): name.split("-")[1] for name in locked_wheels()}
    tag = NATIVE[target.platform].format(target.python.replace(".", ""))
    extra = {
        "torch": ("sympy", 'nvidia-things; platform_system == "Linux" and extra == "cuda"'),
        "numba": ("llvmlite",),
    }
    names = {text.split(">=")[0] for text in REQUIREMENTS.values()} - {"numpy"} | {"llvmlite"}
    wheels = [
        make_wheel(folder, name, pins[name], tag, *extra.get(name, ())) for name in sorted(names)
    ]
    return [*wheels, make_wheel(folder, "sympy", "1.14.0", "py3-none-any")]


@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_wheels_of_a_target(target, tmp_path):
    """Catches wheels of another system or Python, and a missing or too old dependency."""
    wheels = wheel_set(tmp_path, target)
    check_wheels(wheels, target)
    for other in TARGETS:
        if other != target:
            with refusal("does not run on"):
                check_wheels(wheels, other)
    with refusal("needs sympy"):
        check_wheels(wheels[:-1], target)
    with refusal("training needs av"):
        check_wheels([wheel for wheel in wheels if not wheel.name.startswith("av-")], target)
    torch = next(wheel for wheel in wheels if wheel.name.startswith("torch-"))
    old = make_wheel(tmp_path, "torch", "1.0", torch.name.split("-", 2)[2].removesuffix(".whl"))
    with refusal(r"needs torch.*hold 1\.0"):
        check_wheels([wheel for wheel in wheels if wheel != torch] + [old], target)


LOCKED = [
    *TARGETS,
    *(Target(name, python, ("9.0.0", "")) for name in PLATFORM_TAGS for python in PYTHONS[2:]),
]


@pytest.mark.parametrize("target", LOCKED, ids=lambda target: target.name)
def test_the_lock_has_what_each_target_needs(target):
    """Catches a target that was forgotten when versions were changed, and two versions at once of
    what training asks for."""
    tags = target.tags()
    versions = {}
    for wheel, digest in locked_wheels().items():
        assert re.fullmatch("[0-9a-f]{64}", digest)
        name, version, _, own = parse_wheel_filename(wheel)
        if own & tags:
            versions.setdefault(name, set()).add(version.public)
    for text in (*REQUIREMENTS.values(), GPU_REQUIREMENT, CAMERAS_REQUIREMENT):
        requirement = Requirement(text)
        if requirement.name != "numpy":
            (version,) = versions[canonicalize_name(requirement.name)]
            assert requirement.specifier.contains(version)
    assert all(len(found) == 1 for found in versions.values())


@pytest.mark.parametrize("python", ["3.12", "3.14"])
def test_a_blender_with_another_python(tmp_path, python):
    """Catches a Python without locked wheels that is refused for cffi, and one that has them."""
    blender = tmp_path / "blender"
    blender.write_text(f"#!/bin/sh\necho PYTHON {python.replace('.', ' ')} 5 4\n")
    blender.chmod(0o755)
    if python in PYTHONS:
        assert target_of([str(blender)]).python == python
        return
    with refusal("has Python 3.12; wheels are locked for 3.11, 3.13, 3.14$"):
        target_of([str(blender)])


def test_wheels_are_known_by_their_hash(tmp_path, monkeypatch, lock):
    """Catches a wheel of the right name and other content, in the folder or where pip looks, which
    every user of the edition would run."""
    offered = tmp_path / "offered"
    folder = tmp_path / "wheels"
    for path in (offered, folder):
        path.mkdir()
    wheel = make_wheel(offered, "filelock", "4.2.11", "py3-none-any")
    lock(offered)
    make_wheel(offered, "filelock", "4.2.11", "py3-none-any", "malware")
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    monkeypatch.setenv("PIP_INDEX_URL", folder.as_uri())
    monkeypatch.setenv("PIP_FIND_LINKS", str(offered))
    with refusal("could not download filelock"):
        download_locked(folder, [wheel.name])
    assert not list(folder.iterdir())
    monkeypatch.setattr(
        "stga_addon.development.wheels.REQUIREMENTS", {"filelock": "filelock>=4,<5"}
    )
    for name in ("GPU_REQUIREMENT", "CAMERAS_REQUIREMENT"):
        monkeypatch.setattr(f"stga_addon.development.wheels.{name}", "filelock>=4,<5")
    make_wheel(folder, "filelock", "4.2.11", "py3-none-any", "malware")
    with refusal("could not download filelock"):
        collect_wheels(folder, LINUX)


@pytest.mark.nightly
@pytest.mark.skipif(sys.platform != "linux", reason="only PyPI's torch for Linux needs CUDA")
def test_only_when_told_to_does_a_zip_have_cuda(tmp_path, monkeypatch, capsys, lock):
    """Catches gigabytes that nothing uses, silent minutes, and a bare refusal."""
    monkeypatch.setattr("stga_addon.development.package.ROOT", tmp_path)
    wheels = wheel_folder(LINUX)
    offered = tmp_path / "offered"
    index = tmp_path / "index"
    for folder in (wheels, offered, index):
        folder.mkdir(parents=True)
    wheel_set(wheels, LINUX)
    next(wheels.glob("torch-*")).unlink()
    make_wheel(wheels, "wgpu", "0.32.0", "py3-none-any")
    make_wheel(wheels, "pycolmap", "4.2.1", "py3-none-any")
    tag = NATIVE["linux-x64"].format("311")
    cpu = make_wheel(offered, "torch", "2.13.0+cpu", tag, "sympy")
    with_cuda = {
        make_wheel(offered, "torch", "2.13.0", tag, "sympy", "nvidia-things").name,
        make_wheel(offered, "nvidia-things", "1.0", "py3-none-any").name,
    }
    lock(wheels, offered)
    monkeypatch.setenv("PIP_CONFIG_FILE", os.devnull)
    monkeypatch.setenv("PIP_INDEX_URL", index.as_uri())
    monkeypatch.setenv("PIP_FIND_LINKS", str(offered))
    monkeypatch.setattr("stga_addon.development.wheels.TORCH_CPU_INDEX", index.as_uri())
    package = "stga_addon.development.package"
    monkeypatch.setattr(f"{package}.TARGETS", [LINUX])
    monkeypatch.setattr(f"{package}.compile_kernels", lambda *_: [])

    def built(name, *more):
        assert main(["--edition", "complete", "--out", str(tmp_path / name), *more]) == 0
        with zipfile.ZipFile(next((tmp_path / name).glob("*.zip"))) as archive:
            names = {
                Path(entry).name for entry in archive.namelist() if entry.startswith("wheels/")
            }
        return {wheel for wheel in names if wheel.startswith(("torch", "nvidia"))}

    def said_instead():
        assert main(["--edition", "complete", "--out", str(tmp_path / "refused")]) == 2
        assert not (tmp_path / "refused").exists()
        return capsys.readouterr().err

    assert built("seen") == {cpu.name}
    assert "downloading torch" in capsys.readouterr().out
    cpu.unlink()
    (wheels / cpu.name).unlink()
    said = said_instead()
    assert all(
        part in said for part in ("torch==2.13.0+cpu", str(wheels), "--allow-cuda", "CUDA=1")
    )
    assert built("allowed", "--allow-cuda") == with_cuda
    assert said_instead() == said


def test_manifest_of_an_edition(tmp_path):
    """Catches a zip for another platform or Python, or with this computer's dependencies."""
    manifest = read_manifest(ROOT)
    for target in TARGETS:
        made = tomllib.loads(edition_manifest(manifest, complete(target), ["a.whl"]))
        assert (made["platforms"], made["wheels"]) == ([target.platform], ["./wheels/a.whl"])
        assert made["blender_version_min"] == target.blender[0]
        assert made.get("blender_version_max", "") == target.blender[1]
    small = tomllib.loads(
        edition_manifest(manifest, SMALL, [Path(name).name for name in manifest["wheels"]])
    )
    assert small == {name: value for name, value in manifest.items() if name != "build"}
    wheel = make_wheel(
        tmp_path,
        "torch",
        "2.13.0",
        "py3-none-any",
        'cuda; platform_system == "Linux"',
        'dll; os_name == "nt"',
        'old; python_version < "3.12"',
        'more; extra == "more"',
    )
    assert needs(wheel, LINUX) == ["cuda", "old"]
    assert needs(wheel, WINDOWS, {"more"}) == ["dll", "more"]


def test_the_bare_edition_has_no_data_of_others(tmp_path, monkeypatch):
    """Catches others' data that are not told in the manifest, or stay in the zip without them; and
    a traceback where they are missing."""
    monkeypatch.setattr("stga_addon.development.package.edition_wheels", lambda folder, edition: [])
    names = {}
    holders = {}
    for edition in (SMALL, BARE):
        with zipfile.ZipFile(build_zip(tmp_path, edition=edition)) as archive:
            names[edition] = set(archive.namelist())
            manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
        holders[edition] = " ".join(manifest["copyright"])
    kinds = (".npz", ".task", ".tflite", ".zip")
    own = {Path(name).name for name in names[BARE] if name.endswith(kinds)}
    assert own == {"head_regions.npz"}
    left_out = names[SMALL] - names[BARE]
    assert {Path(name).name for name in left_out if name.endswith(kinds)} == {
        *("head.npz", "arkit_shapes.npz", "bundled_head_places.npz", "landmark_bias.npz"),
        *("face_landmarker.task", "selfie_segmentation.tflite"),
    }
    assert names[BARE] < names[SMALL]
    for holder in ("ICT-FaceKit", "MediaPipe"):
        assert holder in holders[SMALL]
        assert holder not in holders[BARE]
    monkeypatch.setattr("stga_addon.tracking.face_networks.PERSON_FILE", tmp_path / "none.tflite")
    with refusal(r"none\.tflite: cannot be read"):
        assert PersonNetwork()._network
    face_shapes.cache_clear()
    monkeypatch.setattr("stga_addon.driving.shapes.SHAPES_FILE", tmp_path / "none.npz")
    with refusal("the bare edition leaves out; install the small"):
        face_shapes()


@pytest.mark.parametrize("edition", [SMALL, complete(LINUX)], ids=["small", "complete"])
def test_no_way_to_install_packages(edition, tmp_path, monkeypatch):
    """Catches code in a zip that installs packages, downloads, or runs what it downloaded."""
    monkeypatch.setattr("stga_addon.development.package.edition_wheels", lambda folder, edition: [])
    forbidden = re.compile(r"\bpip\b|ensurepip|\"venv\"|urllib|http\.client|import requests\b")
    assert forbidden.search((ROOT / "stga_addon/development/wheels.py").read_text()), (
        "the search finds what is there"
    )
    with zipfile.ZipFile(build_zip(tmp_path, edition=edition)) as archive:
        texts = {
            name: archive.read(name).decode() for name in archive.namelist() if name.endswith(".py")
        }
        manifest = tomllib.loads(archive.read("blender_manifest.toml").decode())
    assert {name: found for name, text in texts.items() if (found := forbidden.search(text))} == {}
    assert "ownload" not in str(manifest["permissions"])
