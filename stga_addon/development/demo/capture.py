"""Synthetic capture: a multi-view capture of the synthetic head, path-traced in Blender.

The layout is that of VHAP and GaussianAvatars. The pictures show a denser head than the tracked mesh, with texture,
hair strands, teeth and eyes that the tracked mesh lacks, as in a real capture.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from ...capture.camera import Camera, camera_from_gl
from ...capture.transforms import camera_entry
from ...errors import StgaError
from ...files import replacing, write_json, write_npz
from ...flame.forward import FlameFrame, flame_forward, neutral_frame
from .blend_shapes import EXPRESSIONS
from .head import Head, synthetic_head, write_flame
from .paint import paint
from .skin import hair_offset

DENSITY = 4  # rows and columns of the pictured head for each of the tracked one
STRANDS = 0.0012  # meters of relief in the hair that the tracker does not see
DISTANCE, AIM = 1.05, np.array([0.0, -0.012, -0.010])
FOCAL = 3.7  # image widths
OFF_CENTER = np.array([0.031, -0.022])  # principal point off the image center, in image widths

# Strong actions, so that every region moves somewhere in training; the jaw's opening is in radians.
TRAIN_ACTIONS: tuple[dict[str, float], ...] = (
    {},
    {"smile": 1.0, "jaw": 0.10, "squint": 0.6},
    {"brows_up": 1.0, "pucker": 0.9},
    {"blink_left": 1.0, "blink_right": 1.0, "frown": 0.9},
    {"jaw": 0.30, "brows_down": 1.0, "lips_open": 0.4},
    {"cheek_puff": 1.0, "brows_up": 0.5, "smile": 0.2},
    {"lips_open": 1.0, "smile": 0.5, "blink_left": 1.0},
    {"pucker": 0.6, "jaw": 0.15, "brows_down": 0.6},
)
TEST_ACTIONS: tuple[dict[str, float], ...] = (
    {"smile": 0.8, "jaw": 0.22, "brows_up": 0.8},
    {"lips_open": 0.8, "squint": 0.8, "brows_down": 0.5},
    {"blink_right": 1.0, "smile": 0.6, "cheek_puff": 0.4},
    {"frown": 0.7, "brows_up": 0.6, "jaw": 0.08},
)


@dataclass(frozen=True)
class CaptureOptions:
    """Size of a synthetic capture.

    train, test   timesteps to train on, and timesteps of unseen expressions
    cameras       of which the middle one is held out as `val`
    width, height pixels
    samples       light paths a pixel
    """

    train: int = 6
    test: int = 2
    cameras: int = 8
    width: int = 200
    height: int = 280
    samples: int = 8


def make_capture(
    folder: Path,
    seed: int,
    options: CaptureOptions | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> Path:
    """Write a capture of the synthetic person `seed` into `folder`; returns its FLAME model file.

    Needs Blender's bpy; `progress(done, total)` is called after each image. The same seed and options give the same
    cameras, parameters and meshes. Raises StgaError where the folder cannot be written or the sizes make no sense.
    """
    options = options or CaptureOptions()
    if min(options.train, options.test) < 1 or options.cameras < 2 or min(options.width, options.height) < 16:
        raise StgaError(f"demo capture: {options} is too small, expected 1 + 1 timesteps, 2 cameras and 16 pixels")
    from .studio import StudioHead, render_poses

    folder = Path(folder)
    rng = np.random.default_rng([seed, 2])
    tracked, pictured = synthetic_head(seed, 1), synthetic_head(seed, DENSITY)
    shape = 0.5 * rng.normal(size=tracked.model.n_identity)
    frames = _frames(options, rng)
    cameras = _cameras(options)
    model_file = folder / "flame_model.npz"
    write_flame(tracked.model, model_file)
    _write_parameters(folder, tracked, shape, frames)

    subject = StudioHead(pictured.model.faces, pictured.rest, *paint(pictured, seed))
    offset = hair_offset(pictured.rest) * _strands(pictured.rest)[:, None]
    poses = [flame_forward(pictured.model, shape, frame, offset) for frame in frames]
    total = len(frames) * len(cameras)

    def keep(timestep: int, camera: int, rgba: np.ndarray) -> None:
        _write_image(folder, timestep, camera, rgba)
        progress(timestep * len(cameras) + camera + 1, total)

    render_poses(subject, poses, cameras, keep, options.samples, seed)
    _write_transforms(folder, cameras, options)  # last, so that an interrupted capture is not opened
    return model_file


def _frames(options: CaptureOptions, rng: np.random.Generator) -> list[FlameFrame]:
    actions = [TRAIN_ACTIONS[i % len(TRAIN_ACTIONS)] for i in range(options.train)]
    actions += [TEST_ACTIONS[i % len(TEST_ACTIONS)] for i in range(options.test)]
    frames = []
    for action in actions:
        expr = np.array([action.get(name, 0.0) for name in EXPRESSIONS])
        expr = np.where(expr > 0, expr * rng.uniform(0.85, 1.0, len(expr)), 0.0)
        gaze = np.tile([*rng.uniform(-0.15, 0.15, 2), 0.0], 2)
        frames.append(
            FlameFrame(
                expr=expr,
                rotation=rng.normal(0, 0.06, 3) * [1, 1, 0.5],
                neck_pose=rng.normal(0, 0.03, 3),
                jaw_pose=np.array([action.get("jaw", 0.0), 0.0, 0.0]),
                translation=rng.normal(0, 0.004, 3),
                eyes_pose=gaze,
            )
        )
    return frames


def _cameras(options: CaptureOptions) -> list[Camera]:
    """An arc in front of the head, alternately from below and above, all off-center by `OFF_CENTER`."""
    width, height = options.width, options.height
    cx, cy = np.array([width, height]) / 2 + OFF_CENTER * width
    cameras = []
    for index, azimuth in enumerate(np.radians(np.linspace(-62, 62, options.cameras))):
        elevation = math.radians((-9, 15)[index % 2])
        ahead = np.array(
            [np.sin(azimuth) * math.cos(elevation), math.sin(elevation), np.cos(azimuth) * math.cos(elevation)]
        )
        pose = _look_at(AIM + DISTANCE * ahead, AIM)
        cameras.append(camera_from_gl(pose, width, height, FOCAL * width, FOCAL * width, float(cx), float(cy)))
    return cameras


def _look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Camera-to-world (4, 4), OpenGL axes, upright in a y-up world."""
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross([0.0, 1.0, 0.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, eye], 1)
    return pose


def _strands(rest: np.ndarray) -> np.ndarray:
    """(N,) factor on the hair's offset: combed relief."""
    around = np.arctan2(rest[:, 0], rest[:, 2] + 0.012)
    comb = np.sin(around * 70 + 3 * np.sin(rest[:, 1] * 90))
    return np.asarray(1 + STRANDS / 0.007 * comb)


def _write_parameters(folder: Path, head: Head, shape: np.ndarray, frames: list[FlameFrame]) -> None:
    offset = hair_offset(head.rest)
    named = [(folder / "flame_param" / f"{index:05d}.npz", frame) for index, frame in enumerate(frames)]
    for path, frame in [*named, (folder / "canonical_flame_param.npz", neutral_frame(head.model))]:
        arrays = {
            "expr": frame.expr[None],
            "rotation": frame.rotation[None],
            "neck_pose": frame.neck_pose[None],
            "jaw_pose": frame.jaw_pose[None],
            "eyes_pose": frame.eyes_pose[None],
            "translation": frame.translation[None],
            "shape": shape,
            "static_offset": offset[None],
        }
        write_npz(path, {name: np.asarray(value, np.float32) for name, value in arrays.items()})


def _write_image(folder: Path, timestep: int, camera: int, rgba: np.ndarray) -> None:
    from PIL import Image

    alpha = rgba[..., 3:].astype(float) / 255
    white = (rgba[..., :3] * alpha + 255 * (1 - alpha)).round().astype(np.uint8)
    for kind, pixels in (("images", white), ("fg_masks", rgba[..., 3])):
        with replacing(folder / kind / f"{timestep:05d}_{camera:02d}.png") as partial, partial.open("wb") as out:
            Image.fromarray(pixels).save(out, format="PNG")


def _write_transforms(folder: Path, cameras: list[Camera], options: CaptureOptions) -> None:
    held_out = options.cameras // 2
    entries = [
        _entry(timestep, index, camera)
        for timestep in range(options.train + options.test)
        for index, camera in enumerate(cameras)
    ]
    shared = {
        key: entries[0][key] for key in ("fl_x", "fl_y", "cx", "cy", "w", "h", "camera_angle_x", "camera_angle_y")
    }
    splits: dict[str, Callable[[int, int], bool]] = {
        "train": lambda timestep, camera: timestep < options.train and camera != held_out,
        "val": lambda timestep, camera: timestep < options.train and camera == held_out,
        "test": lambda timestep, camera: timestep >= options.train,
    }
    for name, chosen in splits.items():
        frames = [e for e in entries if chosen(e["timestep_index"], e["camera_index"])]
        indices = {
            "timestep_indices": sorted({e["timestep_index"] for e in frames}),
            "camera_indices": sorted({e["camera_index"] for e in frames}),
        }
        write_json(folder / f"transforms_{name}.json", {**shared, **indices, "frames": frames})
    write_json(folder / "transforms.json", {**shared, "frames": entries})


def _entry(timestep: int, index: int, camera: Camera) -> dict[str, Any]:
    name = f"{timestep:05d}_{index:02d}.png"
    return {
        "timestep_index": timestep,
        "camera_index": index,
        "camera_id": f"{index:02d}",
        "file_path": f"images/{name}",
        "fg_mask_path": f"fg_masks/{name}",
        "flame_param_path": f"flame_param/{timestep:05d}.npz",
        **camera_entry(camera),
        "camera_angle_x": 2 * math.atan(camera.width / 2 / camera.fl_x),
        "camera_angle_y": 2 * math.atan(camera.height / 2 / camera.fl_y),
    }
