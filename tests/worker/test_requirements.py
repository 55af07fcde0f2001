"""One list of requirements: the training Python and pyproject.toml."""

import re
import tomllib
from pathlib import Path

from stga_addon.worker.training_python import GPU_REQUIREMENT, REQUIREMENTS, package_name

PROJECT = tomllib.loads((Path(__file__).resolve().parents[2] / "pyproject.toml").read_text())[
    "project"
]


def test_environment_and_project_require_the_same():
    """Catches a training Python with other versions than an installation by pip."""
    extras = PROJECT["optional-dependencies"]
    assert sorted(REQUIREMENTS.values()) == sorted([*PROJECT["dependencies"], *extras["train"]])
    assert GPU_REQUIREMENT in extras["gpu"]


def test_requirements_are_bounded():
    """Catches a release of a package, with other behavior, that reaches users untested."""
    for requirement in [*REQUIREMENTS.values(), GPU_REQUIREMENT]:
        assert re.fullmatch(r"[a-z-]+>=[\d.]+,<\d+", requirement)
        assert re.fullmatch(r"[a-z-]+", package_name(requirement))
