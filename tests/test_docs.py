"""README, docs, comments and docstrings: what they refer to exists, and the commands they show
parse."""

import re
import shlex
from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from avatar.conftest import splats_of
from fuzz.arguments import COMMANDS as FUZZED
from PIL import Image

from stga_addon import api
from stga_addon.avatar import lattice, strain
from stga_addon.avatar.splats import SH_C0
from stga_addon.capture import visual_hull
from stga_addon.capture.selection import SelectionOptions
from stga_addon.cli.main import make_parser
from stga_addon.export.formats import FORMATS
from stga_addon.export.ply import write_ply
from stga_addon.training.optimize import (
    floaters,
    hidden_layers,
    initial_splats,
    outlines,
    surface,
    surface_prior,
    unseen_hair,
    unseen_sides,
)
from stga_addon.training.optimize import occlusion_layer as layer
from stga_addon.training.optimize.density import DensityControl
from stga_addon.training.settings import MAX_FINE_TRIANGLES, PRESETS, TrainingSettings

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "CHANGELOG.md",
    ROOT / "THIRD_PARTY.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").glob("*.md")),
]
FOR_DEVELOPERS = ("CONTRIBUTING.md", "architecture.md", "dependencies.md")
TEXTS = {page: page.read_text(encoding="utf-8") for page in PAGES}
FOLDERS = ("stga_addon", "operators", "ui", "tests", "docs", ".ci")
FILES = [
    *ROOT.glob("*.*"),
    *(path for folder in FOLDERS for path in (ROOT / folder).rglob("*") if path.suffix != ".pyc"),
]
PROSE = {".py": r'(?:^|\s)#\s.*|"""[\s\S]*?"""'} | dict.fromkeys(
    (".wgsl", ".glsl", ".js", ".ts"), r"//.*|/\*[\s\S]*?\*/"
)
"""Suffix of a source -> its comments and docstrings."""
SOURCES = {path: path.read_text(encoding="utf-8") for path in FILES if path.suffix in PROSE}
BY_PATH = defaultdict(list)
"""What is meant by a path whose folders may be left out, "run.py" or "jobs/batch/run.py"."""
for _path in FILES:
    _parts = _path.relative_to(ROOT).parts
    for _start in range(len(_parts)):
        BY_PATH["/".join(_parts[_start:])].append(_path)
REFERENCE = r"`([^`\s]+)`"
SOURCE_PATH = (
    r"(?<![\w/.{}$<>*-])((?:\w[\w.-]*/)*\w[\w-]*\.(?:py|wgsl|glsl|js)\b)(?:::?([A-Za-z_]\w*))?"
)
DEFINITION = (
    r"(?:\b(?:def|class|struct|fn|function|const|let)|^)\s+{0}\b|^{0}\s*[:=]|self\.{0}\s*[:=]"
)
EVERY_WORD = {
    word for text in SOURCES.values() for word in re.findall(r"\w+", re.sub(REFERENCE, "", text))
}
"""Of sources, but for references."""
OTHERS = {
    "_torch_impl.py": "gsplat's",
    "read_buffer": "wgpu's",
    "smplx": "a package that is not used",
    "t00012": "a shape key",
    "numba": "its compiler's",
    "blendShapes": "Live Link Face's",
    "cc_psnr": "nerfstudio's",
    "truth_A": "a folder",
    "truth_E": "a folder",
}
"""References to what is not ours, though it looks so."""


def name_of(page):
    return page.relative_to(ROOT).as_posix()


def anchors(text):
    """Anchors of a page's headings, as Git hosts make them."""
    headings = re.findall(r"^#+ (.+)$", text, re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def prose(path):
    """Comments and docstrings of a source."""
    return "\n".join(re.findall(PROSE[path.suffix], SOURCES[path]))


def defines(path, name):
    return re.search(DEFINITION.format(name), SOURCES.get(path, ""), re.MULTILINE) is not None


def stale_paths(text):
    """Sources that are named with a folder or in backticks and are not there, and functions
    (`test_docs.py:stale_paths`) that are not in theirs."""
    quoted = set(re.findall(REFERENCE, text))
    for found in re.finditer(SOURCE_PATH, text):
        path, name = found.groups()
        if path.rpartition("/")[2] in OTHERS or ("/" not in path and found[0] not in quoted):
            continue
        files = BY_PATH.get(path, [])
        if not files or (name and not any(defines(file, name) for file in files)):
            yield found[0]


def stale_names(text, code=""):
    """Names in backticks that no source has: alone, of a module or class of ours
    (`module.function`), or of what the code beside the text uses."""
    used = set(re.findall(r"\w+", code))
    for reference in re.findall(REFERENCE, text):
        is_name = re.fullmatch(r"\w*[a-zA-Z]\w*(\.\w+)*(\(\))?", reference)
        if not is_name or reference.endswith((".json", ".npz")) or reference in BY_PATH:
            continue
        names = reference.removesuffix("()").split(".")
        if used.issuperset(names) or not OTHERS.keys().isdisjoint(names):
            continue
        if len(names) == 1:
            if names[0] not in EVERY_WORD and not names[0].endswith("_"):
                yield reference
        elif not is_there(names, used):
            yield reference


def is_there(names, used):
    """Whether `module.function` or `Class.member` is there, or begins with what the code uses and
    is not ours."""
    for count in range(len(names), 0, -1):
        module = "/".join(names[:count])
        files = BY_PATH.get(f"{module}.py", []) + BY_PATH.get(f"{module}/__init__.py", [])
        if files:
            return count == len(names) or any(defines(file, names[count]) for file in files)
    classes = [text for text in SOURCES.values() if f"class {names[0]}" in text]
    if classes:
        return any(re.search(rf"\b{names[1]}\b", text) for text in classes)
    return names[0] in used or names[0][0].isupper()


@pytest.mark.parametrize("folder", ["stga_addon", "operators", "ui", "tests"])
def test_what_comments_and_docstrings_name_is_there(folder):
    """Catches references that a move or another name made stale."""
    sources = [path for path in SOURCES if path.is_relative_to(ROOT / folder)]
    assert sources
    stale = []
    for path in sources:
        text = prose(path)
        code = re.sub(PROSE[path.suffix], "", SOURCES[path])
        found = (*stale_paths(text), *stale_names(text, code))
        stale += [f"{name_of(path)}: {reference}" for reference in found]
    assert not stale


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
    stale = [*stale_paths(TEXTS[page])]
    if page.name in FOR_DEVELOPERS:
        stale += stale_names(TEXTS[page])
    assert not stale, name_of(page)
    for line in re.findall(r"^stga .*$", TEXTS[page], re.MULTILINE):
        words = shlex.split(line.partition("#")[0])[1:]
        make_parser().parse_args(words)  # exits where a word is unknown
    assert not re.search(r"pythonhosted|pypi\.org", TEXTS[page])


def test_every_format_is_documented_and_fuzzed():
    """Catches an export format that formats.md or the fuzz lacks, and one that is gone."""
    page = TEXTS[ROOT / "docs/formats.md"].partition("\n# Output\n")[2]
    words = set(re.findall(r"`(?:--format )?([a-z-]+)`", page))
    assert words.issuperset(FORMATS)
    assert set(re.findall(r"`--format ([a-z-]+)`", page)) <= set(FORMATS)
    assert set(FORMATS) <= set(re.findall(r"'([a-z-]+)'", str(FUZZED["export"])))


def test_every_section_of_the_method_names_code_test_and_benchmark():
    """Catches a section without the three files, and a file of another kind in their place."""
    _, *sections = re.split(r"^## ", TEXTS[ROOT / "docs/method.md"], flags=re.MULTILINE)
    for section in sections:
        title, _, text = section.partition("\n\n")
        line = re.match(r"\*`(.+?)`, `(.+?)`, `(.+?)`\*\n", text)
        assert line, title
        code, test, benchmark = (only(BY_PATH[path]) for path in line.groups())
        assert code.is_relative_to(ROOT / "stga_addon"), title
        assert test.is_relative_to(ROOT / "tests"), title
        assert benchmark.is_relative_to(ROOT / "stga_addon/development/benchmark"), title


def only(items):
    (item,) = items
    return item


def degrees(cosine):
    return f"{np.degrees(np.arccos(cosine)):.0f}°"


def percent(fraction):
    return f"{100 * fraction:g} %"


def test_figures_of_the_method_are_those_of_the_code():
    """Catches a threshold that was changed in the code and not on the page."""
    page = " ".join(TEXTS[ROOT / "docs/method.md"].split())
    missing = [
        figure for figure in (*figures_of_training(), *figures_of_priors()) if figure not in page
    ]
    assert not missing


def figures_of_training():
    settings = TrainingSettings()
    density = DensityControl(*([0] * 5))
    grid_mm = 1000 * visual_hull.VOXEL_SIZE_M
    yield f"up to {MAX_FINE_TRIANGLES:,} triangles"
    yield f"moved {percent(lattice.INSET)} toward the centroid"
    yield f"Standard deviation: {lattice.SCALE}·ℓ/n"
    yield f"on a {grid_mm:g} mm grid"
    yield f"more than {1000 * initial_splats.MIN_MESH_DISTANCE_M:g} mm from the mesh"
    yield f"its scale limit is {settings.unbound_scale_limit * grid_mm:g} mm"
    yield f"mean offset exceeds {1000 * SelectionOptions().threshold:g} mm"
    yield f"after {percent(settings.warm_up_share)} of the budget"
    yield f"{1 - settings.ssim_weight}·L1 + {settings.ssim_weight}·(1 − SSIM)"
    yield f"s − {settings.scale_limit:g}ℓ"
    yield f"{settings.unseen_opacity_weight} · mean over all splats"
    yield f"every {settings.stray_reset_interval} iterations, splats farther than"
    yield f"farther than {settings.stray_limit:g}ℓ"
    yield " and ".join(f"{100 * time:g}" for time in floaters.PRUNING_TIMES) + " % of the budget"
    yield f"up to {floaters.MAX_WEIGHED_VIEWS} views"
    yield f"or {floaters.MIN_WEIGHT_FRACTION} of the median"
    yield f"more than {percent(outlines.TOLERANCE_FRACTION)} of the image height"
    yield f"most of {outlines.MAX_OUTLINES} views"
    yield f"β 0.9 / {settings.adam_beta2}"
    yield f"ε is {settings.adam_epsilon} of the weight"
    yield f"The first {percent(settings.coarse_share)} of the budget"
    yield f"positions to {percent(settings.rates.position_end)}"
    yield f"all others to {percent(settings.rates.end)}"
    yield "{:.0f}, {:.0f} and {:.0f} %".format(*(100 * step for step in settings.sh_steps))
    yield f"decay {1 - settings.ema_share}"
    yield f"runs every {settings.density_interval} iterations"
    yield "between {:.0f} and {:.0f} % of the budget".format(
        *(100 * end for end in settings.density_span)
    )
    yield f"until there are {percent(settings.growth)} more splats"
    yield f"preset `final`: {percent(PRESETS['final'].changes['growth'])}"
    yield f"each half is 1/{density.narrowing} as long"
    yield f"has {density.narrowing / 2} of the opacity"
    yield f"opacity below {density.min_opacity}"
    yield f"times {strain.STRAIN_GAIN:g}, clipped at ±{strain.MAX_STRAIN:g}"
    yield f"both stretches at −{strain.MIN_COMPRESSION} from above"
    yield f"to {strain.RANGE_MARGIN} times the range"
    yield f"by less than {1000 * surface.OPEN_MOUTH_M:g} mm"
    yield f"in {percent(surface.OPEN_QUANTILE)} of the timesteps"


def figures_of_priors():
    grid_mm = 1000 * visual_hull.VOXEL_SIZE_M
    yield f"Every {surface_prior.SurfacePrior.interval} iterations"
    yield f"halfway at {surface_prior.DOUBT} of the gradient"
    yield f"up to {visual_hull.FEW_CAMERAS} cameras"
    yield f"fixed beyond {degrees(surface.UNSEEN_COSINE)}"
    yield f"pulled beyond {degrees(surface.GRAZING_COSINE)}"
    yield f"up to {surface.MAX_HEIGHT_VOXELS * grid_mm / 10:g} cm above"
    yield f"limited to {surface_prior.FLAT_VOXELS * grid_mm:g} mm"
    yield f"{hidden_layers.HIDDEN_SPACING_VOXELS * grid_mm:g} mm apart"
    yield f"at least {surface_prior.LEAST_WIDTH_FRACTION} of their width"
    least_mm = layer.DEPTH_VOXELS * grid_mm
    yield f"lies {least_mm:g} to {layer.MAX_DEPTHS * least_mm:g} mm behind"
    yield f"(beyond {degrees(unseen_sides.VIEW_INDEPENDENT_COSINE)})"
    yield f"{unseen_sides.OFF_AXIS_WEIGHT} · sin²"
    yield f"(cosine {unseen_sides.SOURCE_COSINE})"
    yield f"the {unseen_sides.NEIGHBORS} nearest of"
    yield f"few cameras, below {degrees(unseen_sides.WELL_VISIBLE_COSINE)}"
    yield f"(beyond {degrees(unseen_hair.STRAND_COSINE)})"


def test_readme_trains_exports_and_renders(toy_root, tmp_path, monkeypatch):
    """Catches requests that do not do what the README shows."""
    (example,) = re.findall(r"```python\n(.*?)```", TEXTS[ROOT / "README.md"], re.DOTALL)
    (tmp_path / "captures").mkdir()
    (tmp_path / "captures/anna").symlink_to(toy_root)
    monkeypatch.chdir(tmp_path)
    exec(example.replace('preset="draft"', "iterations=2"), {})
    assert Path("anna.html").read_text(encoding="utf-8").startswith("<!")
    assert Path("anna.mp4").read_bytes()[4:8] == b"ftyp"


def test_api_renders_a_ply(tmp_path, monkeypatch):
    """Catches a public rendering function that is not the one which api.py shows."""
    splats = splats_of(np.zeros((1, 3)), log_scale=np.log(0.05), opacity=5, sh=-0.5 / SH_C0)
    write_ply(tmp_path / "splats.ply", splats)
    monkeypatch.chdir(tmp_path)
    example = str(api.__doc__).partition("Work that takes long")[0]
    exec("\n".join(re.findall(r">>> (.*)", example)), {})
    pixels = np.asarray(Image.open("splats.png"))
    assert pixels.shape == (480, 640, 3)
    assert pixels[240, 320].max() < 10, "a black splat at the camera's target"
    assert pixels[0, 0].min() == 255, "on a white background"
