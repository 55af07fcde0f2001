"""The repository on loopback, in a real Blender: install, and update from a lower version."""

import functools
import http.server
import json
import os
import threading
import tomllib

import pytest
from refusal import refusal

from stga_addon import __version__
from stga_addon.development.package import ROOT
from stga_addon.development.repository import INDEX, PAGE, write_repository

from .zips import BLENDERS, OLD_VERSION, name_of, output_of, with_version

pytestmark = pytest.mark.skipif(
    not BLENDERS, reason="STGA_BLENDER does not say how to start a Blender"
)


@pytest.fixture(scope="module")
def zips(zip_file, tmp_path_factory):
    """The built zip, after one that says that it is older."""
    old = tmp_path_factory.mktemp("old") / f"stga-{OLD_VERSION}.zip"
    return with_version(zip_file, OLD_VERSION, old), zip_file


@pytest.fixture
def served(tmp_path):
    """A folder on loopback, and its address."""
    folder = tmp_path / "served"
    folder.mkdir()
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield folder, f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


def extension(blender, profile, *arguments):
    command = [*blender, "--background", "--online-mode", "--command", "extension", *arguments]
    variables = {**os.environ, "BLENDER_USER_RESOURCES": str(profile)}
    return output_of(command, cwd=ROOT, env=variables, timeout=600)


@pytest.mark.nightly
@pytest.mark.parametrize("blender", BLENDERS, ids=name_of)
def test_install_and_update(blender, zips, served, tmp_path):
    """Catches an index that Blender cannot read, and an update that fails."""
    (folder, address) = served
    profile = tmp_path / "profile"
    (old, new) = zips
    index = write_repository([old], folder / "stga", blender)
    assert index == folder / "stga" / INDEX
    extension(blender, profile, "repo-add", "stga_test", "--url", f"{address}/stga/{INDEX}")
    extension(blender, profile, "install", "--sync", "--enable", "stga")
    installed = next(profile.rglob("stga/blender_manifest.toml"))
    assert tomllib.loads(installed.read_text())["version"] == OLD_VERSION

    write_repository([new], folder / "stga", blender)
    extension(blender, profile, "update", "--sync")
    assert tomllib.loads(installed.read_text())["version"] == __version__


@pytest.mark.parametrize("blender", BLENDERS[:1], ids=name_of)
def test_index_and_page(blender, zips, tmp_path):
    """Catches a page that names other files than the index, and a repository left half-written."""
    _, new = zips
    index = write_repository([new], tmp_path / "repository", blender)
    entries = json.loads(index.read_text())["data"]
    assert [entry["version"] for entry in entries] == [__version__]
    assert new.name in (tmp_path / "repository" / PAGE).read_text()
    assert (tmp_path / "repository" / new.name).read_bytes() == new.read_bytes()
    with refusal("no zips"):
        write_repository([], tmp_path / "repository", blender)
    (tmp_path / "broken.zip").write_bytes(b"no zip")
    with refusal("index"):
        write_repository([tmp_path / "broken.zip"], tmp_path / "repository", blender)
    assert index.is_file()
