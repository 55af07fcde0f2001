"""Every reader of files: the name of its file, a writer of a valid one, and the reader."""

import json
import pickle
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse
from avatar.conftest import random_mesh, random_splats
from capture import factory
from driving.live.wire import facial_mocap
from driving.test_performance_files import codes_of, write_csv
from export.ten_splats import ten_splats
from flame.conftest import model_of, random_arrays
from numpy.random import default_rng
from PIL import Image
from tracking import scenes, test_calibrations, test_head_model
from tracking.test_field_footage import write_colmap_binary
from training.test_folder import make_checkpoint, make_run

from stga_addon.avatar.file import Avatar, read_avatar, write_avatar
from stga_addon.capture.camera import Camera
from stga_addon.capture.images import read_image, read_mask
from stga_addon.capture.lens import undistortion
from stga_addon.capture.meshes import read_mesh, read_regions
from stga_addon.capture.model import View
from stga_addon.capture.open import read_face_ids, read_soup
from stga_addon.capture.transforms import read_transforms
from stga_addon.driving.performance import ARKIT_SHAPES
from stga_addon.driving.performers import read_performance
from stga_addon.export.ply import PROPERTIES, splat_columns, write_ply
from stga_addon.export.skinned_reader import read_skinned_splats
from stga_addon.export.splat_files import read_splats
from stga_addon.export.spz import write_spz
from stga_addon.flame.model import read_flame
from stga_addon.flame.sequence import read_frame, read_identity, read_motion
from stga_addon.flame.unpickle import read_pickled_arrays
from stga_addon.tracking.footage.colmap import read_colmap
from stga_addon.tracking.footage.metashape import read_metashape
from stga_addon.tracking.footage.model import FootageCamera, ImageFrames
from stga_addon.tracking.footage.nerfstudio import read_nerfstudio
from stga_addon.tracking.footage.realitycapture import (
    read_realitycapture_csv,
    read_realitycapture_xmp,
)
from stga_addon.tracking.footage.sources import Sources, sequence_names
from stga_addon.tracking.head_model import read_head_model
from stga_addon.tracking.landmarks import read_camera, read_places
from stga_addon.training.run import checkpoint as checkpoints
from stga_addon.training.run import folder as run_folder
from stga_addon.training.run import metrics_log

MODEL = model_of(random_arrays(), 9)
FACES = np.arange(12).reshape(4, 3)
LINE = {"seconds": 1.0, "splats": 80, "evaluation_s": 0.1, "wall_s": 1.0}
"""Of a run's metrics, besides the iteration."""


@dataclass(frozen=True)
class Target:
    name: str
    write: Callable[[Path], Any]
    read: Callable[[Path], Any]


def avatar(path):
    neutral, faces = random_mesh(1, 20)
    regions = {"nose": np.ones(len(faces), bool)}
    splats = random_splats(2, 6, len(faces))
    write_avatar(path, Avatar(splats, "stga", neutral.astype(np.float32), faces, regions=regions))


def ascii_splats(path):
    head = ["ply", "format ascii 1.0", "element vertex 3"]
    head += [*(f"property float {name}" for name in PROPERTIES), "end_header"]
    rows = [" ".join(f"{v:g}" for v in row) for row in splat_columns(random_splats(4, 3, 1))]
    path.write_text("\n".join([*head, *rows, ""]))


def flame_frame(path):
    sizes = {"expr": 3, "shape": 9, "rotation": 3, "jaw_pose": 3, "eyes_pose": 6, "translation": 3}
    np.savez(path, **{name: np.ones((1, size), np.float32) for name, size in sizes.items()})


def flame_motion(path):
    sizes = {"expr": 3, "rotation": 3, "translation": 3}
    arrays = {name: np.ones((4, size), np.float32) for name, size in sizes.items()}
    np.savez_compressed(path, shape=np.ones(9), dynamic_offset=np.zeros((4, 40, 3)), **arrays)


def flame_pickle(protocol):
    arrays = random_arrays(vertices=6)
    arrays["J_regressor"] = scipy.sparse.csc_matrix(arrays["J_regressor"])
    return lambda path: path.write_bytes(pickle.dumps(arrays, protocol))


def transforms(path):
    frames = [factory.frame(0, camera, mesh_path="meshes/0.obj") for camera in range(2)]
    path.write_text(json.dumps({"frames": frames, "w": 40, "h": 60, "camera_angle_x": 0.5}))


def mesh(path):
    factory.write_mesh(path, default_rng(0).normal(size=(12, 3)), FACES)


def picture(path):
    image = Image.fromarray(default_rng(0).integers(0, 255, (6, 5, 4), np.uint8))
    image.convert("RGB" if path.suffix == ".jpg" else "RGBA").save(path)


def seen(path):
    view = View(0, 0, Camera(5, 6, 10.0, 10.0, 2.0, 2.0, np.eye(4)), "x", path)
    read_mask(view)
    read_image(view)


def metrics(path):
    for n in range(3):
        metrics_log.append_metrics(path.parent, {"iteration": n, **LINE, "psnr": 20.5, "ssim": 0.9})


RIG = scenes.rig(2)
NAMES = ["cam0.png", "cam1.png"]
LANDMARK_CAMERA = FootageCamera("cam0", RIG[0], ImageFrames(dict.fromkeys(range(4))))
ROW = "{},1,2,3,10,20,30,24.3,0.01,-0.01,0.1,0.02,0,0,0.001,0\n"


def colmap_target(file):
    """A door of COLMAP's model; the other of its two files is whole."""
    suffix = Path(file).suffix

    def write(path, alone=True):
        scenes.write_colmap_text(path.parent, RIG, NAMES)
        if suffix == ".bin":
            write_colmap_binary(path.parent, RIG, NAMES, 4, (0.1, 0.0, 0.0, 0.0))
        for other in path.parent.iterdir():
            if (alone and other != path) or other.suffix != suffix:
                other.unlink()

    def read(path):
        with tempfile.TemporaryDirectory() as folder:
            write(Path(folder) / file, alone=False)
            shutil.copyfile(path, Path(folder) / file)
            undistorted(read_colmap(Path(folder))[0])

    return Target(file, write, read)


def undistorted(shots):
    """Look for the images of the shots, and prepare their undistortion, as opening footage does."""
    sequence_names(Sources(Path("/nowhere")), (shot.label for shot in shots))
    for shot in shots:
        undistortion(shot.camera, shot.lens, shot.where)


def size_of(label):
    return 40, 30


def nerfstudio(path):
    frames = [
        test_calibrations.entry(
            camera, f"images/{name}", k1=0.1, p2=0.001, mask_path=f"masks/{name}"
        )
        for camera, name in zip(RIG, NAMES, strict=True)
    ]
    path.write_text(json.dumps({"frames": frames, "camera_model": "OPENCV"}))


def landmarks(path):
    points = default_rng(0).uniform(0, 40, (4, 6, 2)).astype(np.float32)
    np.savez(path, timesteps=np.arange(4), points=points, confidence=np.ones((4, 6), np.float32))


def places(path):
    np.savez(path, face=np.array([0, 3, -1, 2, 1, 3]), barycentric=np.full((6, 3), 1 / 3))


def linear_head(path):
    skeleton = {"J_regressor": np.full((5, 4), 0.25), "weights": np.eye(4, 5)}
    bases = {"identity": np.ones((4, 3, 2)), "expression": np.ones((4, 3, 1))}
    np.savez(path, mean=np.eye(4, 3), faces=np.array([[0, 1, 2]]), **bases, **skeleton)


def performance(path):
    found = read_performance(path)
    assert np.isfinite(found.weights).all()
    assert np.isfinite(found.times).all()


TAKE = {"fps": 25, "names": ARKIT_SHAPES, "frames": np.full((3, 52), 0.3).tolist()}
COLMAP = ("cameras.txt", "images.txt", "cameras.bin", "images.bin")
TARGETS = {
    name: Target(*row)
    for name, row in {
        "metashape": (
            "cameras.xml",
            lambda p: test_calibrations.write_export(p, RIG, NAMES),
            lambda p: undistorted(read_metashape(p)[0]),
        ),
        "realitycapture csv": (
            "cameras.csv",
            lambda p: p.write_text("\n".join([test_calibrations.HEADER, *map(ROW.format, NAMES)])),
            lambda p: undistorted(read_realitycapture_csv(p, size_of)[0]),
        ),
        "realitycapture xmp": (
            "a.xmp",
            lambda p: test_calibrations.write_xmp(p, RIG[0]),
            lambda p: undistorted(read_realitycapture_xmp([p], size_of, p.parent)[0]),
        ),
        "nerfstudio": ("transforms.json", nerfstudio, lambda p: undistorted(read_nerfstudio(p)[0])),
        "landmarks": ("cam0.npz", landmarks, lambda p: read_camera(p, LANDMARK_CAMERA)),
        "places": ("head_model.npz", places, lambda p: read_places(p, 4)),
        "head model npz": ("head.npz", linear_head, read_head_model),
        "head model glb": (
            "head.glb",
            lambda p: p.write_bytes(test_head_model.simple()),
            read_head_model,
        ),
        "performance csv": (
            "a.csv",
            lambda p: write_csv(p, codes_of(6), np.full((6, 52), 0.3)),
            performance,
        ),
        "performance json": ("a.json", lambda p: p.write_text(json.dumps(TAKE)), performance),
        "performance text": (
            "a.txt",
            lambda p: p.write_bytes(facial_mocap({"jawOpen": 0.5}, (1, 2, 3))),
            performance,
        ),
        "avatar": ("a.npz", avatar, read_avatar),
        "skinned splats": (
            "a.glb",
            lambda p: p.write_bytes(ten_splats()),
            read_skinned_splats,
        ),
        "splats": ("a.ply", lambda p: write_ply(p, random_splats(1, 4, 1)), read_splats),
        "splats as text": ("a.ply", ascii_splats, read_splats),
        "splats as spz": ("a.spz", lambda p: write_spz(p, random_splats(1, 4, 1)), read_splats),
        "splats as splat": ("a.splat", lambda p: p.write_bytes(bytes(range(128))), read_splats),
        "flame npz": ("a.npz", lambda p: np.savez(p, **random_arrays(vertices=6)), read_flame),
        "flame pickle 2": ("a.pkl", flame_pickle(2), read_flame),
        "flame pickle 5": ("a.pkl", flame_pickle(5), read_flame),
        "flame masks": (
            "a.pkl",
            lambda p: p.write_bytes(pickle.dumps({"nose": np.arange(5), "lips": [1, 2, 3]}, 2)),
            read_pickled_arrays,
        ),
        "flame masks as text": (
            "a.pkl",
            lambda p: p.write_bytes(pickle.dumps({"nose": np.arange(5), "lips": [1, 2, 3]}, 0)),
            read_pickled_arrays,
        ),
        "flame frame": (
            "a.npz",
            flame_frame,
            lambda p: (read_frame(p, MODEL), read_identity(p, MODEL)),
        ),
        "flame motion": ("a.npz", flame_motion, lambda p: read_motion(p, MODEL)),
        "transforms": ("transforms.json", transforms, read_transforms),
        "regions": (
            "r.json",
            lambda p: p.write_text('{"nose": [0, 1, 2], "lips": []}'),
            lambda p: read_regions(p, FACES, 12),
        ),
        "soup": (
            "a.json",
            lambda p: p.write_text(
                json.dumps({"triangles": [{"Vertices": np.eye(3).tolist()}] * 3})
            ),
            read_soup,
        ),
        "face ids": ("a.npy", lambda p: np.save(p, np.arange(4)), lambda p: read_face_ids(p, 5)),
        "run": (
            "run.json",
            lambda p: run_folder.write_run(p.parent, make_run()),
            lambda p: run_folder.read_run(p.parent),
        ),
        "checkpoint": (
            "checkpoint.npz",
            lambda p: checkpoints.write_checkpoint(p.parent, make_checkpoint()),
            lambda p: checkpoints.read_checkpoint(p.parent),
        ),
        "selection": (
            "selection.npz",
            lambda p: checkpoints.write_selection(p.parent, {7: np.ones(5, bool)}, "a"),
            lambda p: checkpoints.read_selection(p.parent, 5),
        ),
        "metrics": ("metrics.jsonl", metrics, lambda p: metrics_log.read_metrics(p.parent)),
    }.items()
}
TARGETS |= {f"colmap {file}": colmap_target(file) for file in COLMAP}
for kind in ("obj", "ply", "glb", "stl"):
    TARGETS[f"mesh {kind}"] = Target(f"a.{kind}", mesh, read_mesh)
for kind in ("png", "jpg", "webp", "tiff", "bmp"):
    TARGETS[f"image {kind}"] = Target(f"a.{kind}", picture, seen)
