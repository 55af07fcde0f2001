"""Demo: train an avatar on the demo's capture, show it in Blender and compare the pictures."""

from argparse import ArgumentParser
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from itertools import cycle
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from PIL import Image

from ...avatar.embedding import to_world
from ...avatar.file import Avatar, read_avatar
from ...avatar.splats import SH_C0
from ...capture.camera import UP, Camera, orbited
from ...capture.images import read_image
from ...capture.model import Capture
from ...capture.open import open_capture
from ...capture.selection import SelectionOptions, select_capture
from ...cli.commands import carry_out
from ...driving.demo_speech import SPEECH_FILE, demo_speech
from ...driving.inverse import write_performance
from ...driving.open_motion import MotionOptions, performed
from ...errors import StgaError
from ...export.formats import export_avatar
from ...export.playback import Playback
from ...files import replacing, write_json
from ...flame.sequence import sequence_mesh
from ...jobs.export import capture_views
from ...jobs.track import RUN_FOLDER
from ...jobs.train import Train
from ...raster.cpu.precompile import begin_compiling
from ...render.render import render, render_avatar, to_uint8
from ...training.evaluate.metrics import evaluate_avatar
from ...training.run.folder import AVATAR, RUN, open_refined
from ...training.settings import make_settings
from .capture import unpack_capture, unpack_takes

SEED = 0
"""Seed of the demo's tracking and training."""

POSES_PER_SECOND = 1.5
"""Rate at which the web page plays the capture's expressions, which are single poses."""
FRAMES_PER_SECOND = 8
"""Frame rate of demo.blend: its capture has a second of motion at this rate."""
MOVING_PICTURE_FPS = 6
"""Frame rate of phone.webp, near that of the takes."""
MOVING_PICTURE_ROWS = 0.7
"""Upper fraction of the talk's frames that phone.webp shows: the rendered person has no body."""
MAX_POSITION_ERROR_M = 1e-5
"""Largest distance between a splat in Blender and in numpy."""


def run_demo(
    out: Path, budget: Mapping[str, Any], device: str = "cpu", with_shot: bool = False
) -> None:
    """Unpack the demo's capture, import it into Blender, select, train, and show the avatar.

    budget: the setting that limits training, `seconds` or `iterations`; device: one of
    `choose_device`; with_shot: also write shot.blend, a film scene around the avatar,
    and speech.csv, the performance that it speaks from.

    Leaves avatar.npz, avatar.html, demo.blend, comparison.png, selection.png and metrics.json in
    `out`. Needs Blender's bpy. Raises StgaError where the folder cannot be written or Blender
    places a splat elsewhere than numpy does.
    """
    begin = perf_counter()
    if device == "cpu":
        begin_compiling()  # while Blender opens the capture
    folder = out / "capture"
    unpack_capture(folder)
    capture = open_capture(folder)
    head, selection = _import_and_select(capture)
    avatar = _train(capture, out, budget, selection, device)
    error = _show(capture, avatar, head, out / "demo.blend")
    if with_shot:
        from .in_blender import make_shot

        assert capture.flame is not None
        write_performance(out / SPEECH_FILE, demo_speech())
        make_shot(out, capture.flame)
    _picture(capture, avatar, selection, out)
    _page(capture, avatar, selection, out / "avatar.html")
    metrics = {
        split: evaluate_avatar(avatar, capture, split).as_json() for split in ("val", "test")
    }
    write_json(
        out / "metrics.json",
        {**metrics, "splats": len(avatar.splats), "blender_position_error_m": error},
    )
    for split, values in metrics.items():
        fitted = (
            f" (exposure fitted; {values['psnr_unmatched']:.2f} without)"
            if "psnr_unmatched" in values
            else ""
        )
        print(f"{split}: PSNR {values['psnr']:.2f} dB{fitted}, SSIM {values['ssim']:.4f}")
    print(f"Blender places the splats within {error:.1e} m of numpy")
    print(f"{out}: avatar.npz, avatar.html, demo.blend, comparison.png, selection.png", end=" ")
    print(f"({perf_counter() - begin:.0f} s)")


def avatar_from_footage(out: Path, budget: Mapping[str, Any], device: str = "cpu") -> None:
    """Make an avatar in OUT/footage from the images and cameras of the demo's capture, without its
    meshes. budget: as of `run_demo`.

    Raises StgaError.
    """
    footage = [str(out / "capture"), "--cameras", str(out / "capture/transforms.json")]
    _avatar_command(footage, out / "footage", budget, device)


def avatar_from_phone(out: Path, budget: Mapping[str, Any], device: str = "cpu") -> None:
    """Make an avatar in OUT/phone from two videos as a phone films them, one around a still head
    and one of a talk, and phone.webp: the talk, the avatar in the same views, and the avatar driven
    by the demo's speech before a camera that circles it. budget: as of `run_demo`.

    Raises StgaError.
    """
    takes = unpack_takes(out / "takes")
    _avatar_command([str(take) for take in takes], out / "phone", budget, device)
    _moving_picture(out / "phone" / RUN_FOLDER, out / "phone.webp")
    print(f"{out / 'phone.webp'}: the talk, its avatar, and the avatar driven by a performance")


def _moving_picture(run: Path, path: Path) -> None:
    """Write the moving picture of `avatar_from_phone`."""
    capture = open_refined(run)
    assert capture.flame is not None
    views = capture.views["train"]
    ((most, _),) = Counter(view.camera_index for view in views).most_common(1)
    camera_views = [view for view in views if view.camera_index == most]
    talk = sorted(camera_views, key=lambda view: view.timestep)
    avatar = read_avatar(run / AVATAR)
    fps = float(MOVING_PICTURE_FPS)
    driven = performed(demo_speech(), capture.flame, SPEECH_FILE, MotionOptions(), fps=fps)
    rows = slice(round(MOVING_PICTURE_ROWS * talk[0].camera.height))
    frames: list[Image.Image] = []
    for view, timestep in zip(talk, cycle(driven.sequence.timesteps), strict=False):
        mesh = sequence_mesh(driven.sequence, timestep)
        angle = 2 * np.pi * len(frames) / len(talk)
        around = orbited(talk[0].camera, (mesh.min(0) + mesh.max(0)) / 2, UP, angle)
        same = render_avatar(avatar, capture.mesh(view.timestep), view.camera)
        pictures = [read_image(view), to_uint8(same), to_uint8(render_avatar(avatar, mesh, around))]
        frames.append(Image.fromarray(side_by_side([picture[rows] for picture in pictures])))
    with replacing(path) as partial:
        duration = round(1000 / fps)
        options = {"append_images": frames[1:], "duration": duration, "loop": 0, "method": 6}
        frames[0].save(partial, format="WEBP", save_all=True, **options)


def _avatar_command(footage: list[str], out: Path, budget: Mapping[str, Any], device: str) -> None:
    """Carry out `stga avatar FOOTAGE --out OUT` with the demo's budget."""
    from ...cli.commands import COMMANDS

    given = [*footage, "--out", str(out), "--seed", str(SEED), "--device", device]
    for name, value in budget.items():
        given += ["--budget", f"{value}s"] if name == "seconds" else [f"--{name}", str(value)]
    parser = ArgumentParser()
    COMMANDS["avatar"].add_arguments(parser, None)
    COMMANDS["avatar"].carry_out(parser.parse_args(given), None)


def _import_and_select(capture: Capture) -> tuple[object, dict[int, np.ndarray]]:
    """Make a Blender scene with head, cameras and a vertex group per frame; returns head and
    selection read back."""
    from ...scene.avatar_scene import set_up_head
    from ...scene.vertex_groups import read_selection, write_selection
    from .in_blender import new_file

    new_file()
    head = set_up_head(capture)
    write_selection(head, select_capture(capture, SelectionOptions()))
    return head, read_selection(head)


def _train(
    capture: Capture,
    out: Path,
    budget: Mapping[str, Any],
    selection: dict[int, np.ndarray],
    device: str,
) -> Avatar:
    # The capture's heads are exact, and Blender shows them unrefined.
    settings = make_settings(**budget, seed=SEED, effects={"tracking": "off"})
    folder = out / "run"
    (folder / RUN).unlink(missing_ok=True)  # the demo always starts a new run
    carry_out(Train(folder, capture.root, settings, device=device, selection=selection))
    path = folder / AVATAR
    with replacing(out / AVATAR) as partial:
        partial.write_bytes(path.read_bytes())
    return read_avatar(path)


def _show(capture: Capture, avatar: Avatar, head: object, path: Path) -> float:
    """Show the avatar, save and reopen the file; returns the largest distance (meters) of a splat
    from numpy's."""
    from ...scene.avatar_scene import show_on_head
    from ...scene.objects import go_to_frame, save_file
    from .in_blender import evaluated_splats, object_named, open_file

    name = show_on_head(avatar, head, "//run/avatar.npz", FRAMES_PER_SECOND).name
    save_file(path)
    open_file(path)
    worst = 0.0
    for timestep in capture.timesteps:
        go_to_frame(timestep)
        frames = avatar.frames(capture.mesh(timestep))
        expected = to_world(avatar.splats, frames).xyz
        worst = max(worst, float(np.abs(evaluated_splats(object_named(name))[0] - expected).max()))
    if worst > MAX_POSITION_ERROR_M:
        raise StgaError(
            f"{path}: a splat is {worst:.1e} m from its position in numpy, "
            f"more than {MAX_POSITION_ERROR_M:g} m"
        )
    return worst


def _picture(capture: Capture, avatar: Avatar, selection: dict[int, np.ndarray], out: Path) -> None:
    """Write comparison.png (ground truth and rendering of a held-out view and of an unseen
    expression) and
    selection.png (the held-out view of the frame that selects most)."""
    pictures = []
    for view in (capture.views["val"][-1], capture.views["test"][len(capture.views["test"]) // 2]):
        image = render_avatar(avatar, capture.mesh(view.timestep), view.camera, avatar.background)
        pictures += [read_image(view), to_uint8(image)]
    _save(out / "comparison.png", side_by_side(pictures))
    busiest = max(capture.views["val"], key=lambda view: selection[view.timestep].sum())
    selected = selection[busiest.timestep]
    picture = selection_picture(avatar, capture.mesh(busiest.timestep), busiest.camera, selected)
    _save(out / "selection.png", to_uint8(picture))


def _page(capture: Capture, avatar: Avatar, selection: dict[int, np.ndarray], path: Path) -> None:
    """Write the web page, which blends from one of the capture's few poses to the next."""
    playback = Playback(
        title="STGA demo head",
        fps=POSES_PER_SECOND,
        views=capture_views(capture),
        selection=[selection[timestep] for timestep in capture.timesteps],
    )
    export_avatar(path, avatar, "web", sequence=capture.flame, playback=playback)


def _save(path: Path, pixels: np.ndarray) -> None:
    with replacing(path) as partial:
        Image.fromarray(pixels).save(partial, format="PNG")


def selection_picture(
    avatar: Avatar, mesh: np.ndarray, camera: Camera, selected: np.ndarray
) -> np.ndarray:
    """The avatar with splats of selected triangles in color and all others gray; (3, H, W) float32
    on white.

    mesh (V, 3) drives the avatar; selected (F,) bool.
    """
    splats = avatar.splats
    gray = ~selected[avatar.splats.face]
    sh = splats.sh.copy()
    luminance = 0.5 + SH_C0 * sh[:, 0] @ np.array([0.299, 0.587, 0.114], np.float32)
    sh[gray] = 0
    sh[gray, 0] = ((0.25 + 0.4 * luminance[gray]) - 0.5)[:, None] / SH_C0
    frames = avatar.frames(mesh)
    frames = replace(frames, color=frames.color * selected[:, None])
    splats = replace(splats, sh=sh)
    return render(splats, camera, frames=frames, antialiased=avatar.antialiased)


def side_by_side(pictures: list[np.ndarray]) -> np.ndarray:
    """Pictures (H, W, 3) uint8 of one height in a row, with a white gap of six pixels between
    them."""
    gap = np.full((len(pictures[0]), 6, 3), 255, np.uint8)
    spaced = [part for picture in pictures for part in (picture, gap)]
    return np.concatenate(spaced[:-1], axis=1)
