"""Writes the section Quality of docs/benchmarks.md: tables, each with the version and the command
that measured it.

    python -m stga_addon.development.benchmark.results CAPTURE [--fraction 1]
        [--out docs/benchmarks.md] [--folder out/results]

CAPTURE: one with a tracked mesh and the splits val and test, as `studio_head`. Takes less than 25
minutes on two otherwise idle cores. What was measured stays in --folder and is not measured again.
--fraction 0.05 tries it with a twentieth of all budgets. STGA_LPIPS names the weights of LPIPS
(docs/dependencies.md).
"""

import argparse
import json
import os
import platform
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ... import __version__

HEADER = """# Benchmarks

## Quality

Written by `python -m stga_addon.development.benchmark.results {capture}`, on {machine}.
RUN is a new folder. Compare figures within a table.

PSNR in dB; LPIPS, lower is better; means over views. *val*: the held-out camera, which chooses the
run's avatar. *test*: held-out expressions, all cameras. *head*: inside the head mask. *moving*:
triangles that the default selection (2 mm) picks in that frame. ±: standard deviation over seeds.
`studio_head`, not in this repository: a path-traced head with 12 training timesteps, 15 training
cameras at 275×401 and a tracked mesh of 10,696 triangles.
"""
"""Beginning of the page, with the names of capture and machine to fill in."""

EXTENDING = """
The training timesteps become two takes. *before* is an avatar of the first, which the arms continue
for the same time: *extend* trains all splats in views of both takes; *anew* trains another avatar
on both, three times as long; *refine* trains the mouth (*region*) alone, *all* everything. *s to
same*: seconds until the region is as good as *all* leaves it; *s to 98 %*: until both takes have
98 % of the PSNR of *anew*.
"""
"""Note that explains the columns of the table on extending an avatar."""

END = "\n<!-- What benchmark.results writes ends here. -->\n"
"""Mark at the end of what is written; the page keeps what follows it."""
PARTS = (("whole image", ""), ("head", "_mask"), ("moving", "_moving"))
"""Row of the table, and suffix of the metrics as `stga eval` writes them."""


@dataclass(frozen=True)
class Section:
    """A table: its commands as they are shown, whose RUN is a folder, and what reads the table from
    that; note: on what is compared."""

    title: str
    commands: tuple[str, ...]
    table: Callable[[Path], str]
    note: str = ""


def sections(capture: str, fraction: float) -> dict[str, Section]:
    """Folder -> section; fraction: of the budgets."""

    def seconds(budget: float) -> str:
        return f"{budget * fraction:g}"

    extend = (
        f"python -m stga_addon.development.benchmark.extend {capture}"
        f" --base {round(1200 * fraction)} --seconds {seconds(20)} --seeds 0 1 --refine mouth"
        " --folder RUN --report RUN/report.txt"
    )
    return {
        "default": Section(
            "Default settings",
            (
                f"stga train {capture} --out RUN --budget {seconds(120)}s",
                "stga eval RUN --split val",
                "stga eval RUN --split test",
            ),
            quality_table,
        ),
        "benchmark": Section(
            "Presets and strategies at equal time",
            (f"stga benchmark {capture} --budget {seconds(30)}s --seeds 2 --out RUN",),
            report,
        ),
        "extend": Section("Extending and refining an avatar", (extend,), report, EXTENDING),
    }


def report(run: Path) -> str:
    """The tables of a report, without what docs/benchmarks.md shows as curves or the tables say
    already; tables' rules are short, as docs are counted in words."""
    text = (run / "report.txt").read_text(encoding="utf-8")
    beside = r"^(Pareto front|Evaluation while|.* dB apart).*\n"
    text = re.sub(beside, "", text, flags=re.MULTILINE)
    return re.sub(r"(?<=\|) -+ (?=\|)", "---", text)


def quality_table(run: Path) -> str:
    rows = ["| split | pixels | PSNR | SSIM | LPIPS |", "|---|---|---|---|---|"]
    for split in ("val", "test"):
        quality = json.loads((run / f"quality_{split}.json").read_text(encoding="utf-8"))
        for name, suffix in PARTS:
            if f"psnr{suffix}" in quality:
                lpips = f"{quality[f'lpips{suffix}']:.4f}" if f"lpips{suffix}" in quality else ""
                psnr = f"{quality[f'psnr{suffix}']:.2f}"
                ssim = f"{quality[f'ssim{suffix}']:.4f}"
                rows.append(
                    f"| {split}, {quality['views']} views | {name} | {psnr} | {ssim} | {lpips} |"
                )
    return "\n".join(rows)


def measure(commands: tuple[str, ...], run: Path, capture: Path) -> None:
    """Carry out commands as they are shown."""
    meant = {
        "stga": [sys.executable, "-m", "stga_addon"],
        "python": [sys.executable],
        "RUN": [str(run)],
        "RUN/report.txt": [str(run / "report.txt")],
        capture.name: [str(capture)],
    }
    for command in commands:
        print(command, flush=True)
        subprocess.run(
            [given for word in command.split() for given in meant.get(word, [word])], check=True
        )


def machine() -> str:
    """Processor, cores and interpreter, in words."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text(encoding="utf-8").splitlines() if info.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    name = [*names, platform.machine()][0]
    python = platform.python_version()
    return f"{os.cpu_count()} cores of {name}, Python {python}"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("capture", type=Path)
    parser.add_argument("--fraction", "--share", type=float, default=1.0, help="of all budgets")
    parser.add_argument("--out", type=Path, default=Path("docs/benchmarks.md"))
    parser.add_argument("--folder", type=Path, default=Path("out/results"))
    options = parser.parse_args()
    capture = options.capture.resolve()
    folder = options.folder.resolve()
    text = [HEADER.format(capture=capture.name, machine=machine())]
    for name, section in sections(capture.name, options.fraction).items():
        done = folder / f"{name}.md"
        if not done.exists():
            measure(section.commands, folder / name, capture)
            commands = "\n".join(section.commands)
            table = section.table(folder / name).strip()
            source = f"Version {__version__}:\n\n```\n{commands}\n```\n{section.note}"
            done.write_text(f"### {section.title}\n\n{source}\n{table}\n", encoding="utf-8")
        text.append(done.read_text(encoding="utf-8"))
    before = options.out.read_text(encoding="utf-8") if options.out.exists() else ""
    kept = before.partition(END)[2]
    options.out.write_text("\n".join(text) + END + kept, encoding="utf-8")


if __name__ == "__main__":
    main()
