"""Measure PSNR, SSIM and LPIPS of a run's avatar on a split; print them and write them into the run's folder."""

from argparse import ArgumentParser, Namespace
from typing import TYPE_CHECKING

from ..errors import StgaError
from ..files import write_json
from ..requests.open_head import OpenHead
from .arguments import usable_path
from .inputs import open_avatar

if TYPE_CHECKING:
    from ..training.evaluate.metrics import Quality

NAME, HELP = "eval", "PSNR, SSIM and LPIPS on held-out views"


def add_arguments(parser: ArgumentParser, head: OpenHead | None) -> None:
    parser.add_argument("run_folder", type=usable_path, metavar="RUN", help="folder of a run")
    parser.add_argument(
        "--split", choices=("train", "val", "test"), default="val", help="views to measure on (default val)"
    )
    parser.add_argument("--flame", type=usable_path, metavar="FILE", help="FLAME model file, if it has moved")


def run(options: Namespace) -> None:
    from ..training.evaluate.lpips import MIN_SIDE_PX
    from ..training.evaluate.metrics import evaluate_avatar

    folder = options.run_folder
    if not folder.is_dir():
        raise StgaError(f"{folder}: is not a folder; expected that of a run")
    avatar, capture = open_avatar(folder, options)
    assert capture is not None  # a run names one
    views = capture.views.get(options.split, ())
    if not views:
        raise StgaError(f"{capture.root}: has no views in the split '{options.split}'")
    quality = evaluate_avatar(avatar, capture, options.split, perceptual=True)
    print(f"{options.split}: {len(views)} views, {_describe(quality)}")
    for region, name in (("mask", "inside the head mask"), ("moving", "in the moving region")):
        if region in quality.regions:
            print(f"  {name}: {_describe(quality.regions[region])}")
    if quality.psnr_unmatched is not None:
        print(f"  exposure of each view fitted inside the mask; without: PSNR {quality.psnr_unmatched:.3f} dB")
    if quality.lpips is None:
        print("LPIPS was not measured: it needs its weights, whose file STGA_LPIPS names (docs/dependencies.md),")
        print(f"and images of at least {MIN_SIDE_PX} x {MIN_SIDE_PX} pixels")
    write_json(folder / f"quality_{options.split}.json", {"views": len(views), **quality.as_json()})


def _describe(quality: "Quality") -> str:
    lpips = "" if quality.lpips is None else f", LPIPS {quality.lpips:.4f}"
    return f"PSNR {quality.psnr:.3f} dB, SSIM {quality.ssim:.4f}{lpips}"
