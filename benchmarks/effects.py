"""Whether Auto is right: the effects that a capture calls for, against all of them, at the same number of iterations.

    python benchmarks/effects.py CAPTURE [--flame FILE] [--iterations 1500] [--only full static one-camera] [--each]

Derives two captures from CAPTURE, its first training timestep and its middle training camera, and trains each with the
effects decided by Auto and with all that can be on. Prints the held-out view's PSNR and the seconds of training.
--each instead trains the full capture with all effects but one, for what each of them costs. Selection is left to
Auto throughout: it is another way to train, not something more to compute. Run it on an idle machine.
"""

import argparse
import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stga_addon.avatar.file import read_avatar
from stga_addon.capture.model import Capture
from stga_addon.capture.open import open_capture
from stga_addon.effects.facts import Facts
from stga_addon.effects.plan import plan_effects
from stga_addon.effects.rules import EFFECTS
from stga_addon.training.evaluations import read_metrics
from stga_addon.training.folder import Run
from stga_addon.training.metrics import measure
from stga_addon.training.run import train
from stga_addon.training.settings import make_settings
from stga_addon.training.tracking import refined

LEFT_TO_AUTO = ("selection",)


def derive(root: Path, folder: Path, keep: Callable[[str, dict[str, Any]], bool]) -> Path:
    """A capture of those frames of another that `keep(split, frame)` chooses; its files are links."""
    folder.mkdir()
    for item in root.iterdir():
        if not item.name.startswith("transforms"):
            (folder / item.name).symlink_to(item)
    for split in ("train", "val", "test"):
        path = root / f"transforms_{split}.json"
        document = json.loads(path.read_text("utf-8")) if path.exists() else {"frames": []}
        document["frames"] = [frame for frame in document["frames"] if keep(split, frame)]
        (folder / path.name).write_text(json.dumps(document), "utf-8")
    return folder


def captures(root: Path, folder: Path) -> dict[str, Path]:
    """Name -> folder: the capture itself, one timestep of it, one camera of it."""
    frames = json.loads((root / "transforms_train.json").read_text("utf-8"))["frames"]
    first = min(frame["timestep_index"] for frame in frames)
    cameras = sorted({frame["camera_index"] for frame in frames})
    middle = cameras[len(cameras) // 2]
    return {
        "full": root,
        "static": derive(root, folder / "static", lambda split, frame: frame["timestep_index"] == first),
        "one-camera": derive(
            root, folder / "one-camera", lambda split, frame: split != "train" or frame["camera_index"] == middle
        ),
    }


def possible(capture: Capture, iterations: int) -> list[str]:
    """The effects that can be on."""
    facts = Facts(capture, make_settings(iterations=iterations))
    looked = {effect.name: effect.look(facts) for effect in EFFECTS if effect.name not in LEFT_TO_AUTO}
    return [name for name, verdict in looked.items() if verdict is not None and (verdict.on or not verdict.only)]


def trained(capture: Capture, flame: Path | None, iterations: int, choices: dict[str, str]) -> tuple[float, float, str]:
    """PSNR of the held-out view, seconds of training, and the effects that were on."""
    settings, plan = plan_effects(capture, make_settings(iterations=iterations, effects=choices))
    with tempfile.TemporaryDirectory() as folder:
        avatar = read_avatar(train(capture, Path(folder), Run(capture.root, flame, "vhap", settings, plan)))
        seconds = read_metrics(Path(folder))[-1]["seconds"]
        capture = refined(capture, Path(folder))
    names = ", ".join(decision.effect for decision in plan if decision.on)
    return measure(avatar, capture, "val").psnr, seconds, names


def report(name: str, result: tuple[float, float, str], iterations: int) -> None:
    psnr, seconds, names = result
    print(f"{name:<24}{psnr:8.2f} dB{seconds:8.1f} s{1000 * seconds / iterations:8.1f} ms/it  {names}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--flame", type=Path)
    parser.add_argument("--iterations", type=int, default=1500)
    parser.add_argument("--only", nargs="+", choices=("full", "static", "one-camera"))
    parser.add_argument("--each", action="store_true")
    options = parser.parse_args()
    iterations = options.iterations
    with tempfile.TemporaryDirectory() as folder:
        for name, root in captures(options.capture.resolve(), Path(folder)).items():
            if name not in (options.only or (["full"] if options.each else [name])):
                continue
            capture = open_capture(root, options.flame)
            everything = dict.fromkeys(possible(capture, iterations), "on")
            runs = {"Auto": {}, "all": everything}
            if options.each:
                runs.update({f"all but {effect}": {**everything, effect: "off"} for effect in everything})
            for variant, choices in runs.items():
                report(f"{name}, {variant}", trained(capture, options.flame, iterations, choices), iterations)


if __name__ == "__main__":
    main()
