"""Rules of CONTRIBUTING.md, "How we write", that ruff has no rule for."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("stga_addon", "operators", "ui", "tests")
FILES = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").glob("*.md"))]
MAX_FUNCTION_LINES = 60
DIALECT = r"dust|strays?|backing|inner layer|likeness|crew|team|usual|tells?|told|make exact"
"""Words for which the field has others: floaters, outliers, occlusion layer, semantic regions,
workers, typical, report, bake for linear blending."""
KEPT_NAMES = {
    "stray_limit",
    "stray_reset_interval",
    "stray_reset_share",
    "make_exact",
    "MakeExact",
    "MakeExactRequest",
}
"""Names that files and scripts of earlier versions contain: settings, and a request."""


def names(node):
    return {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}


def packed_values(nodes):
    """Lines that assign independent values at once, `a, b = c, d`, and swap or unpack nothing."""
    for node in nodes:
        if isinstance(node, ast.Assign) and isinstance(node.value, ast.Tuple):
            target = node.targets[0]
            if isinstance(target, ast.Tuple) and not names(target) & names(node.value):
                yield node.lineno


def long_functions(nodes):
    for node in nodes:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            lines = (node.end_lineno or node.lineno) - node.lineno + 1
            if lines > MAX_FUNCTION_LINES:
                yield f"{node.name} ({lines} lines)"


def described_in_groups(nodes):
    """Lines of docstrings that follow several constants, of which but one can be meant."""
    for node in nodes:
        body = getattr(node, "body", None)
        for group in zip(body, body[1:], body[2:], strict=False) if isinstance(body, list) else ():
            first, second, text = group
            constants = all(isinstance(each, ast.Assign | ast.AnnAssign) for each in group[:2])
            is_text = isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant)
            if constants and is_text and second.lineno - first.end_lineno == 1:
                yield text.lineno


def fragments(nodes):
    """Lines of docstrings that begin with "Of", and leave out what they describe."""
    for node in nodes:
        is_text = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if is_text and str(node.value.value).startswith("Of "):
            yield node.lineno


def dialect(nodes):
    """Names with a word of DIALECT that are defined, not those of other libraries."""
    for node in nodes:
        name = None
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            name = node.name
        elif isinstance(node, ast.arg):
            name = node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            name = node.id
        if name and name not in KEPT_NAMES and has_dialect(name):
            yield f"{name} (line {node.lineno})"


def has_dialect(text):
    words = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|_", " ", text)
    return re.search(rf"\b({DIALECT})\b", words, re.IGNORECASE) is not None


RULES = (described_in_groups, packed_values, long_functions, fragments, dialect)


@cache
def broken_rules(path):
    """What each of RULES finds in a file, by its function; a file is read, and its syntax walked
    through, once for all of them."""
    nodes = list(ast.walk(ast.parse(path.read_text())))
    return {rule: list(rule(nodes)) for rule in RULES}


def breaking(rule, folder):
    """(file, what the rule finds) of a folder, where it finds something."""
    files = [path for path in FILES if path.is_relative_to(ROOT / folder)]
    assert files
    found = ((path.relative_to(ROOT).as_posix(), broken_rules(path)[rule]) for path in files)
    return [(path, places) for path, places in found if places]


@pytest.mark.parametrize("folder", FOLDERS[:3])
def test_a_docstring_describes_one_constant(folder):
    """Catches a paragraph for several constants, whose parts nobody can map to their names."""
    assert not breaking(described_in_groups, folder)


@pytest.mark.parametrize("folder", FOLDERS[:3])
def test_docstrings_name_what_they_describe(folder):
    """Catches fragments that make sense only together with the name, such as "Of a frame."."""
    assert not breaking(fragments, folder)


@pytest.mark.parametrize("folder", FOLDERS[:3])
def test_names_are_the_fields_terms(folder):
    """Catches a word of the project's own where engineers know another."""
    assert not breaking(dialect, folder)


def test_pages_use_the_fields_terms():
    """Catches the same words on a page."""
    lines = [
        f"{page.name}: {line}" for page in PAGES for line in page.read_text("utf-8").splitlines()
    ]
    assert not [line for line in lines if has_dialect(line.replace("make-exact", ""))]


@pytest.mark.parametrize("folder", FOLDERS)
def test_one_assignment_a_line(folder):
    """Catches values packed into one line to save lines, which then read slower."""
    assert not breaking(packed_values, folder)


@pytest.mark.parametrize("folder", FOLDERS)
def test_functions_fit_on_a_screen(folder):
    """Catches a function that has become several."""
    assert not breaking(long_functions, folder)
