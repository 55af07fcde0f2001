"""README and docs: what they refer to exists, and the commands they show parse."""

import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stga_addon.avatar.splats import SH_C0, Splats
from stga_addon.cli.main import make_parser
from stga_addon.export.ply import write_ply

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "CHANGELOG.md",
    ROOT / "THIRD_PARTY.md",
    *sorted((ROOT / "docs").glob("*.md")),
]
TEXTS = {page: page.read_text(encoding="utf-8") for page in PAGES}
PATH_FOLDERS = ("", "stga_addon/", "tests/", "stga_addon/training/")
"""Folders that the docs leave out when they name a file."""


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def anchors(text: str) -> set[str]:
    """Anchors of a page's headings, as Git hosts make them."""
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_what_a_page_names_is_there(page):
    """Catches links, files, tests and commands that are gone, and addresses that go stale."""
    for target in re.findall(r"\]\(([^)\s]+)\)", TEXTS[page]):
        if "://" in target:
            continue
        path, _, anchor = target.partition("#")
        linked = page if not path else (page.parent / path).resolve()
        assert linked.exists(), f"{name_of(page)}: {target}"
        if anchor:
            assert anchor in anchors(linked.read_text(encoding="utf-8")), (
                f"{name_of(page)}: {target}"
            )
    for path in re.findall(r"`([\w./]+/[\w.]+\.py)", TEXTS[page]):
        assert any((ROOT / folder / path).is_file() for folder in PATH_FOLDERS), (
            f"{name_of(page)}: {path}"
        )
    sources = {
        path: path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py")
    }
    for path, test in re.findall(r"`([\w./]+\.py)::(test_\w+)`", TEXTS[page]):
        source = next(text for file, text in sources.items() if file.as_posix().endswith(path))
        assert f"def {test}" in source, f"{name_of(page)}: {path}::{test}"
    every = "\n".join(sources.values())
    for test in re.findall(r"`(test_\w+)`", TEXTS[page]):
        assert f"def {test}(" in every, f"{name_of(page)}: {test}"
    for line in re.findall(r"^stga .*$", TEXTS[page], re.MULTILINE):
        words = shlex.split(line.partition("#")[0])[1:]
        make_parser().parse_args(words)  # exits where a word is unknown
    assert not re.search(r"pythonhosted|pypi\.org", TEXTS[page])


def test_readme_renders_a_ply(tmp_path, monkeypatch):
    """Catches a public rendering function that is not the one which the README shows."""
    splats = Splats(
        xyz=np.zeros((1, 3), np.float32),
        rotation=np.array([[1, 0, 0, 0]], np.float32),
        log_scale=np.full((1, 3), np.log(0.05), np.float32),
        opacity=np.full(1, 5, np.float32),
        sh=np.full((1, 1, 3), -0.5 / SH_C0, np.float32),
        face=np.zeros(1, np.int32),
        unbound=np.zeros(1, bool),
    )
    write_ply(tmp_path / "splats.ply", splats)
    monkeypatch.chdir(tmp_path)
    (example,) = re.findall(r"```python\n(.*?)```", TEXTS[ROOT / "README.md"], re.DOTALL)
    exec(example, {})
    pixels = np.asarray(Image.open("splats.png"))
    assert pixels.shape == (480, 640, 3)
    assert pixels[240, 320].max() < 10, "a black splat at the camera's target"
    assert pixels[0, 0].min() == 255, "on a white background"
