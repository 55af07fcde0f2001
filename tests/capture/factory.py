"""Tiny captures written to disk by the tests: a ball of 10 cm seen by cameras around it."""

import json

import numpy as np
import trimesh
from numpy.random import default_rng
from PIL import Image

from stga_addon.avatar.file import Avatar, write_avatar
from stga_addon.avatar.lattice import lattice_splats

WIDTH = 40
HEIGHT = 60
FOCAL = 200.0
# OpenCV; the files hold HEIGHT − CY
CX = 19.0
CY = 36.0
RADIUS = 0.1
SPLITS = ("train", "val", "test")


def ball():
    """(162, 3) vertices and (320, 3) triangles."""
    sphere = trimesh.creation.icosphere(2, RADIUS)
    return np.array(sphere.vertices), np.array(sphere.faces)


def pose(camera):
    """Camera-to-world, OpenGL axes, one meter from the ball and looking at it."""
    angle = 0.4 * camera - 0.5
    cos = np.cos(angle)
    sin = np.sin(angle)
    return np.array([[cos, 0, sin, sin], [0, 1, 0, 0], [-sin, 0, cos, cos], [0, 0, 0, 1]])


def silhouette():
    """(HEIGHT, WIDTH) bool: which pixels' rays meet the ball; the same from every camera."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    off_axis = np.hypot(columns - CX, rows - CY)
    return off_axis / np.hypot(off_axis, FOCAL) < RADIUS


def picture(timestep, camera):
    """(HEIGHT, WIDTH, 3) uint8 on white, of a color that only this view has."""
    color = np.array([10 * timestep, 10 * camera, 128]).astype(np.uint8)
    return np.where(silhouette()[..., None], color, np.uint8(255))


def moved(timestep, vertices):
    """The ball's lower part stretched by 1 mm a timestep."""
    return vertices - np.where(vertices[:, 1:2] < -0.06, [[0.0, 0.001 * timestep, 0.0]], 0.0)


def frame(timestep, camera, **more):
    name = f"{timestep:05d}_{camera:02d}.png"
    return {
        "timestep_index": timestep,
        "camera_index": camera,
        "camera_id": f"cam{camera}",
        "file_path": f"images/{name}",
        "fg_mask_path": f"fg_masks/{name}",
        "transform_matrix": pose(camera).tolist(),
        "fl_x": FOCAL,
        "fl_y": FOCAL,
        "cx": CX,
        "cy": HEIGHT - CY,
        "w": WIDTH,
        "h": HEIGHT,
        **more,
    }


def write_images(root, timesteps, cameras):
    for folder in ("images", "fg_masks"):
        (root / folder).mkdir(parents=True, exist_ok=True)
    for timestep in timesteps:
        for camera in cameras:
            name = f"{timestep:05d}_{camera:02d}.png"
            Image.fromarray(picture(timestep, camera)).save(root / "images" / name)
            Image.fromarray(silhouette().astype(np.uint8) * 255).save(root / "fg_masks" / name)


def write_splits(root, frames, **shared):
    """The last camera is `val`, the last timestep `test`, all else `train`."""
    last_camera = max(f["camera_index"] for f in frames)
    last_timestep = max(f["timestep_index"] for f in frames)
    splits = {name: [] for name in SPLITS}
    for entry in frames:
        name = "val" if entry["camera_index"] == last_camera else "train"
        splits["test" if entry["timestep_index"] == last_timestep else name].append(entry)
    for name, entries in splits.items():
        (root / f"transforms_{name}.json").write_text(json.dumps({**shared, "frames": entries}))


def write_mesh_capture(root, timesteps=(0, 1, 3), cameras=(0, 1, 2), suffix=".obj"):
    """Layout "mesh" with a canonical mesh and one region, `mouth`."""
    write_images(root, timesteps, cameras)
    (root / "meshes").mkdir()
    vertices, faces = ball()
    write_mesh(root / f"meshes/neutral{suffix}", vertices, faces)
    for timestep in timesteps:
        write_mesh(root / f"meshes/{timestep:05d}{suffix}", moved(timestep, vertices), faces)
    mouth = np.flatnonzero(vertices[:, 1] < -0.06).tolist()
    (root / "regions.json").write_text(json.dumps({"mouth": mouth}))
    frames = [frame(t, c, mesh_path=f"meshes/{t:05d}{suffix}") for t in timesteps for c in cameras]
    named = {"canonical_mesh_path": f"meshes/neutral{suffix}", "regions_path": "regions.json"}
    write_splits(root, frames, **named)
    return root


def write_mesh(path, vertices, faces):
    if path.suffix == ".obj":
        points = "".join(f"v {x:.9f} {y:.9f} {z:.9f}\n" for x, y, z in vertices)
        path.write_text(points + "".join(f"f {a} {b} {c}\n" for a, b, c in faces + 1))
    else:
        trimesh.Trimesh(vertices, faces, process=False).export(path)


def write_flame_model(path, seed=0, mesh=None):
    """A model file in FLAME's format with the ball as template, or another mesh's vertices and
    faces, four identity and two expression components."""
    random = default_rng(seed)
    vertices, faces = mesh or ball()
    weights = random.random((len(vertices), 5))
    regressor = random.random((5, len(vertices)))
    masks = {"masks/nose": np.flatnonzero(vertices[:, 2] > 0.07)}
    masks["masks/lips"] = np.flatnonzero(vertices[:, 1] < -0.06)
    np.savez(
        path,
        v_template=vertices,
        shapedirs=0.002 * random.normal(size=(len(vertices), 3, 6)),
        n_identity=4,
        posedirs=0.0005 * random.normal(size=(len(vertices), 3, 36)),
        J_regressor=regressor / regressor.sum(1, keepdims=True),
        kintree_table=np.array([[-1, 0, 1, 1, 1], [0, 1, 2, 3, 4]]),
        weights=weights / weights.sum(1, keepdims=True),
        f=faces,
        **masks,
    )
    return path


def flame_parameters(timestep):
    """One timestep's file as VHAP writes it, with a leading 1."""
    random = default_rng(100 + timestep)
    vertices = len(ball()[0])
    return {
        "shape": np.full(4, 0.3, np.float32),
        "expr": random.normal(size=(1, 2)).astype(np.float32),
        "rotation": np.array([[0, 0.05 * timestep, 0]], np.float32),
        "neck_pose": np.zeros((1, 3), np.float32),
        "jaw_pose": np.array([[0.02 * timestep, 0, 0]], np.float32),
        "eyes_pose": np.zeros((1, 6), np.float32),
        "translation": np.array([[0.001 * timestep, 0, 0]], np.float32),
        "static_offset": np.full((1, vertices, 3), 0.0005, np.float32),
    }


def write_flame_capture(root, timesteps=(0, 1, 3), cameras=(0, 1, 2)):
    """Layout "flame": the capture's folder and the model's file."""
    write_images(root, timesteps, cameras)
    (root / "flame_param").mkdir()
    for timestep in timesteps:
        np.savez(root / f"flame_param/{timestep:05d}.npz", **flame_parameters(timestep))
    np.savez(root / "canonical_flame_param.npz", **flame_parameters(timesteps[0]))
    paths = {t: f"flame_param/{t:05d}.npz" for t in timesteps}
    frames = [frame(t, c, flame_param_path=paths[t]) for t in timesteps for c in cameras]
    write_splits(root, frames)
    return root, write_flame_model(root / "model.npz")


def write_release(root, timesteps=(0, 1), cameras=(0, 1)):
    """The layout of the STGA authors' release; the first timestep trains triangles 0, 2 and 5,
    others name none."""
    write_images(root, timesteps, cameras)
    (root / "meshes").mkdir()
    (root / "training_faces").mkdir()
    vertices, faces = ball()
    for timestep in timesteps:
        corners = moved(timestep, vertices)[faces]
        document = {"triangles": [{"Vertices": triangle.tolist()} for triangle in corners]}
        (root / f"meshes/mesh_{timestep:04d}.json").write_text(json.dumps(document))
    np.save(root / "training_faces" / f"{timesteps[0]:04d}.npy", np.array([0, 2, 5]))
    frames = [frame(t, c, keyframe=t) for t in timesteps for c in cameras]
    for entry in frames:
        del entry["timestep_index"]
    (root / "transforms_train.json").write_text(json.dumps({"frames": frames}))
    return root


def write_avatar_of(capture, path, is_colored=False, **lattice):
    """An avatar of a capture's head; is_colored: each splat has a color of its own."""
    splats = lattice_splats(capture.neutral, capture.faces, **{"order": 0, **lattice})
    if is_colored:
        splats.sh[:, 0] = default_rng(0).normal(0, 1.5, (len(splats), 3))
    neutral = capture.neutral.astype(np.float32)
    faces = capture.faces.astype(np.int32)
    write_avatar(path, Avatar(splats, "stga", neutral, faces))
    return path


def edit(path, change):
    """Change a JSON file in place."""
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
