"""Fuzzing of every file reader: a file damaged by hypothesis either loads or raises StgaError.

Catches any other exception, crashes, hangs and excessive memory. Quick in the normal suite;
`STGA_FUZZ_SECONDS=600 pytest tests/fuzz` shares that time among the targets.
"""

import json
import pickle
import shutil
import struct
import tempfile
import time
import tracemalloc
import warnings
import zipfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.sparse
from avatar.conftest import random_mesh, random_splats
from capture import factory
from flame.conftest import model_of, random_arrays
from hypothesis import given, seed, settings
from hypothesis import strategies as st
from PIL import Image
from tracking import scenes, test_head_model, test_metashape, test_nerfstudio, test_realitycapture
from training.test_folder import make_checkpoint, make_run

from stga_addon.avatar.file import Avatar, read_avatar, write_avatar
from stga_addon.capture.camera import Camera
from stga_addon.capture.images import read_image, read_mask
from stga_addon.capture.meshes import read_mesh, read_regions
from stga_addon.capture.model import View
from stga_addon.capture.open import read_face_ids, read_soup
from stga_addon.capture.transforms import read_transforms
from stga_addon.errors import StgaError
from stga_addon.export.ply import PROPERTIES, read_ply, splat_columns, write_ply
from stga_addon.flame.model import read_flame
from stga_addon.flame.sequence import read_frame, read_identity, read_motion
from stga_addon.flame.unpickle import read_pickled_arrays
from stga_addon.tracking.footage.calibrations import read_nerfstudio
from stga_addon.tracking.footage.colmap import read_colmap
from stga_addon.tracking.footage.lens import undistortion
from stga_addon.tracking.footage.model import FootageCamera, ImageFrames
from stga_addon.tracking.footage.photogrammetry import (
    read_metashape,
    read_realitycapture_csv,
    read_realitycapture_xmp,
)
from stga_addon.tracking.footage.shots import Shot
from stga_addon.tracking.footage.sources import Sources, sequence_names
from stga_addon.tracking.head_model import read_head_model
from stga_addon.tracking.landmarks import read_camera, read_places
from stga_addon.training.run import checkpoint as checkpoints
from stga_addon.training.run import folder as run_folder
from stga_addon.training.run import metrics_log

from .conftest import SECONDS

MAX_READ_S, MAX_READ_BYTES = 2.0, 200e6
MODEL = model_of(random_arrays(), 9)
FACES = np.arange(12).reshape(4, 3)


@dataclass(frozen=True)
class Target:
    """File name, writer of a valid file, and reader."""

    name: str
    write: Callable[[Path], Any]
    read: Callable[[Path], Any]


def small_avatar() -> Avatar:
    neutral, faces = random_mesh(1, 20)
    splats = random_splats(2, 6, len(faces))
    return Avatar(
        splats,
        "stga",
        neutral.astype(np.float32),
        faces,
        regions={"nose": np.ones(len(faces), bool)},
    )


def ascii_splats(path: Path) -> None:
    rows = splat_columns(random_splats(4, 3, 1))
    head = [
        "ply",
        "format ascii 1.0",
        "element vertex 3",
        *(f"property float {n}" for n in PROPERTIES),
        "end_header",
    ]
    path.write_text("\n".join([*head, *(" ".join(f"{v:g}" for v in row) for row in rows), ""]))


def flame_frame(path: Path) -> None:
    sizes = {"expr": 3, "shape": 9, "rotation": 3, "jaw_pose": 3, "eyes_pose": 6, "translation": 3}
    np.savez(path, **{name: np.ones((1, size), np.float32) for name, size in sizes.items()})


def flame_motion(path: Path) -> None:
    sizes = {"expr": 3, "rotation": 3, "translation": 3}
    arrays = {name: np.ones((4, size), np.float32) for name, size in sizes.items()}
    np.savez_compressed(path, shape=np.ones(9), dynamic_offset=np.zeros((4, 40, 3)), **arrays)


def flame_pickle(protocol: int) -> Callable[[Path], Any]:
    arrays: dict[str, Any] = random_arrays(vertices=6)
    arrays["J_regressor"] = scipy.sparse.csc_matrix(arrays["J_regressor"])
    return lambda path: path.write_bytes(pickle.dumps(arrays, protocol))


def flame_masks(path: Path) -> None:
    path.write_bytes(pickle.dumps({"nose": np.arange(5), "lips": [1, 2, 3]}, 2))


def transforms(path: Path) -> None:
    frames = [factory.frame(0, camera, mesh_path="meshes/0.obj") for camera in range(2)]
    path.write_text(json.dumps({"frames": frames, "w": 40, "h": 60, "camera_angle_x": 0.5}))


def soup(path: Path) -> None:
    path.write_text(json.dumps({"triangles": [{"Vertices": np.eye(3).tolist()}] * 3}))


def mesh(path: Path) -> None:
    factory.write_mesh(path, np.random.default_rng(0).normal(size=(12, 3)), FACES)


def picture(path: Path) -> None:
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (6, 5, 4), np.uint8)).convert(
        "RGB" if path.suffix == ".jpg" else "RGBA"
    ).save(path)


def seen(path: Path) -> None:
    view = View(0, 0, Camera(5, 6, 10.0, 10.0, 2.0, 2.0, np.eye(4)), "x", path)
    read_mask(view)
    read_image(view)


def metrics(path: Path) -> None:
    for n in range(3):
        times = {"seconds": float(n), "splats": 80, "evaluation_s": 0.1, "wall_s": 1.0}
        metrics_log.append_metrics(
            path.parent, {"iteration": n, **times, "psnr": 20.5, "ssim": 0.9}
        )


RIG = scenes.rig(2)
NAMES = ["cam0.png", "cam1.png"]
LANDMARK_CAMERA = FootageCamera("cam0", RIG[0], ImageFrames(dict.fromkeys(range(4))))  # type: ignore[arg-type]
ROW = "{},1,2,3,10,20,30,24.3,0.01,-0.01,0.1,0.02,0,0,0.001,0\n"


def colmap_target(file: str) -> Target:
    """A door of COLMAP's model; the other of its two files is whole."""
    suffix = Path(file).suffix

    def write(path: Path) -> None:
        scenes.write_colmap_text(path.parent, RIG, NAMES)
        if suffix == ".bin":
            write_colmap_binary(path.parent)

    def read(path: Path) -> None:
        with tempfile.TemporaryDirectory() as folder:
            write(Path(folder) / file)
            if suffix == ".bin":
                for text in Path(folder).glob("*.txt"):
                    text.unlink()
            shutil.copyfile(path, Path(folder) / file)
            undistorted(read_colmap(Path(folder)))

    return Target(file, lambda path: (write(path), keep_only(path)), read)


def keep_only(path: Path) -> None:
    """The folder with this file alone."""
    for other in path.parent.iterdir():
        if other != path:
            other.unlink()


def write_colmap_binary(folder: Path) -> None:
    cameras, images = [struct.pack("<Q", 2)], [struct.pack("<Q", 2)]
    for number, (camera, name) in enumerate(zip(RIG, NAMES, strict=True), start=1):
        values = camera.fl_x, camera.fl_y, camera.cx, camera.cy, 0.1, 0.0, 0.0, 0.0
        cameras.append(struct.pack("<IiQQ8d", number, 4, camera.width, camera.height, *values))
        pose = *scenes.quaternion(camera.world_to_camera[:3, :3]), *camera.world_to_camera[:3, 3]
        images.append(
            struct.pack("<I7dI", number, *pose, number)
            + name.encode()
            + b"\0"
            + struct.pack("<Q", 0)
        )
    (folder / "cameras.bin").write_bytes(b"".join(cameras))
    (folder / "images.bin").write_bytes(b"".join(images))


def undistorted(shots: list[Shot]) -> None:
    """Look for the images of the shots, and prepare their undistortion, as opening footage does."""
    sources = Sources(Path("/nowhere"))
    sequence_names(sources, (shot.label for shot in shots))
    for shot in shots:
        undistortion(shot.camera, shot.lens, shot.where)


def metashape(path: Path) -> None:
    test_metashape.write_export(path, RIG, NAMES, intrinsics=test_metashape.INTRINSICS)


def nerfstudio(path: Path) -> None:
    frames = [
        test_nerfstudio.entry(camera, f"images/{name}", k1=0.1, p2=0.001, mask_path=f"masks/{name}")
        for camera, name in zip(RIG, NAMES, strict=True)
    ]
    path.write_text(json.dumps({"frames": frames, "camera_model": "OPENCV"}))


def landmarks(path: Path) -> None:
    points = np.random.default_rng(0).uniform(0, 40, (4, 6, 2)).astype(np.float32)
    np.savez(path, timesteps=np.arange(4), points=points, confidence=np.ones((4, 6), np.float32))


def places(path: Path) -> None:
    np.savez(path, face=np.array([0, 3, -1, 2, 1, 3]), barycentric=np.full((6, 3), 1 / 3))


def linear_head(path: Path) -> None:
    skeleton = {"J_regressor": np.full((5, 4), 0.25), "weights": np.eye(4, 5)}
    bases = {"identity": np.ones((4, 3, 2)), "expression": np.ones((4, 3, 1))}
    np.savez(path, mean=np.eye(4, 3), faces=np.array([[0, 1, 2]]), **bases, **skeleton)


CALIBRATIONS = {
    **{
        f"colmap {file}": colmap_target(file)
        for file in ("cameras.txt", "images.txt", "cameras.bin", "images.bin")
    },
    "metashape": Target(
        "cameras.xml", metashape, lambda path: undistorted(read_metashape(path)[0])
    ),
    "realitycapture csv": Target(
        "cameras.csv",
        lambda path: path.write_text(
            f"{test_realitycapture.HEADER}\n" + "".join(map(ROW.format, NAMES))
        ),
        lambda path: undistorted(read_realitycapture_csv(path, lambda label: (40, 30))),
    ),
    "realitycapture xmp": Target(
        "a.xmp",
        lambda path: test_realitycapture.write_xmp(path, RIG[0]),
        lambda path: undistorted(read_realitycapture_xmp([path], lambda label: (40, 30))[0]),
    ),
    "nerfstudio": Target(
        "transforms.json", nerfstudio, lambda path: undistorted(read_nerfstudio(path))
    ),
}

TARGETS = {
    **CALIBRATIONS,
    "landmarks": Target("cam0.npz", landmarks, lambda path: read_camera(path, LANDMARK_CAMERA)),
    "places": Target("head_model.npz", places, lambda path: read_places(path, 4)),
    "head model npz": Target("head.npz", linear_head, read_head_model),
    "head model glb": Target(
        "head.glb", lambda path: path.write_bytes(test_head_model.simple()), read_head_model
    ),
    "avatar": Target("a.npz", lambda path: write_avatar(path, small_avatar()), read_avatar),
    "splats": Target("a.ply", lambda path: write_ply(path, random_splats(1, 4, 1)), read_ply),
    "splats as text": Target("a.ply", ascii_splats, read_ply),
    "flame npz": Target(
        "a.npz", lambda path: np.savez(path, **random_arrays(vertices=6)), read_flame
    ),
    "flame pickle 2": Target("a.pkl", flame_pickle(2), read_flame),
    "flame pickle 5": Target("a.pkl", flame_pickle(5), read_flame),
    "flame masks": Target("a.pkl", flame_masks, read_pickled_arrays),
    "flame frame": Target(
        "a.npz", flame_frame, lambda path: (read_frame(path, MODEL), read_identity(path, MODEL))
    ),
    "flame motion": Target("a.npz", flame_motion, lambda path: read_motion(path, MODEL)),
    "transforms": Target("transforms.json", transforms, read_transforms),
    "regions": Target(
        "r.json",
        lambda path: path.write_text('{"nose": [0, 1, 2], "lips": []}'),
        lambda p: read_regions(p, FACES, 12),
    ),
    "soup": Target("a.json", soup, read_soup),
    "face ids": Target(
        "a.npy", lambda path: np.save(path, np.arange(4)), lambda path: read_face_ids(path, 5)
    ),
    **{
        f"mesh {kind}": Target(f"a.{kind}", mesh, read_mesh)
        for kind in ("obj", "ply", "glb", "stl")
    },
    **{
        f"image {kind}": Target(f"a.{kind}", picture, seen)
        for kind in ("png", "jpg", "webp", "tiff", "bmp")
    },
    "run": Target(
        "run.json",
        lambda p: run_folder.write_run(p.parent, make_run()),
        lambda p: run_folder.read_run(p.parent),
    ),
    "checkpoint": Target(
        "checkpoint.npz",
        lambda path: checkpoints.write_checkpoint(path.parent, make_checkpoint()),
        lambda path: checkpoints.read_checkpoint(path.parent),
    ),
    "selection": Target(
        "selection.npz",
        lambda path: checkpoints.write_selection(
            path.parent, {0: np.ones(5, bool), 7: np.zeros(5, bool)}, "a"
        ),
        lambda path: checkpoints.read_selection(path.parent, 5),
    ),
    "metrics": Target("metrics.jsonl", metrics, lambda path: metrics_log.read_metrics(path.parent)),
}

INTERESTING = [
    b"\xff\xff\xff\xff",
    b"\x7f\xff\xff\xff",
    b"\0" * 8,
    b"-1",
    b"1e999",
    b"99999999999",
    b"NaN",
    b"[",
    b"]",
]
INTERESTING += [b'"', b"\xff\xfe", b"../", b"null", b"{}", b"true", b"\n", b"."]


def damaged(draw: Callable[[st.SearchStrategy[Any]], Any], content: bytes) -> bytes:
    """A few replacements, insertions, deletions and repetitions, and sometimes an early end."""
    for _ in range(draw(st.integers(0, 4))):
        at = draw(st.integers(0, len(content)))
        length = draw(st.sampled_from([0, 1, 2, 4, 8, 40]))
        kind = draw(st.integers(0, 3))
        if kind == 0:
            content = (
                content[:at] + draw(st.binary(min_size=1, max_size=4)) + content[at + length :]
            )
        elif kind == 1:
            content = content[:at] + draw(st.sampled_from(INTERESTING)) + content[at + length :]
        elif kind == 2:
            content = (
                content[:at]
                + content[at : at + length] * draw(st.sampled_from([0, 2, 50]))
                + content[at + length :]
            )
        elif at < len(content):
            content = (
                content[:at]
                + bytes([content[at] ^ (1 << draw(st.integers(0, 7)))])
                + content[at + 1 :]
            )
    return (
        content[: draw(st.integers(0, len(content)))] if draw(st.integers(0, 9)) == 0 else content
    )


def rewrap(draw: Callable[[st.SearchStrategy[Any]], Any], path: Path) -> bytes:
    """A valid archive with damaged arrays: otherwise its checksums detect nearly all damage."""
    out = path.with_suffix(".wrapped")
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(out, "w") as new:
        victim = draw(st.sampled_from(old.namelist()))
        for name in old.namelist():
            content = old.read(name)
            new.writestr(name, damaged(draw, content) if name == victim else content)
    return out.read_bytes()


@pytest.mark.parametrize("name", TARGETS)
def test_reader(tmp_path: Path, name: str) -> None:
    """Catches a reader that neither loads a damaged file nor raises StgaError."""
    target = TARGETS[name]
    path, broken = tmp_path / "good" / target.name, tmp_path / "broken" / target.name
    path.parent.mkdir()
    broken.parent.mkdir()
    target.write(path)
    target.read(path)
    whole = path.read_bytes()
    end = time.monotonic() + SECONDS / len(TARGETS)
    fuzz(target, whole, path, broken, 0)
    while time.monotonic() < end:
        fuzz(target, whole, path, broken, time.monotonic_ns())


def fuzz(target: Target, whole: bytes, path: Path, broken: Path, number: int) -> None:
    """Run the examples of one profile, seeded with `number`."""

    @seed(number)
    @settings(settings.get_profile("stga-fuzz" if SECONDS else "stga-quick"))
    @given(data=st.data())
    def once(data: st.DataObject) -> None:
        wrapped = path.suffix == ".npz" and data.draw(st.booleans())
        broken.write_bytes(rewrap(data.draw, path) if wrapped else damaged(data.draw, whole))
        begin = time.process_time()  # of this process: other programs may keep it waiting
        tracemalloc.start()
        try:
            with suppress(StgaError), warnings.catch_warnings():
                # NumPy's, for numbers that are not checked
                warnings.simplefilter("error", RuntimeWarning)
                target.read(broken)
            peak = tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()
        assert time.process_time() - begin < MAX_READ_S
        assert peak < MAX_READ_BYTES
        assert [entry.name for entry in broken.parent.iterdir()] == [broken.name]

    once()
