"""The recording of a moving head: its footage, its FLAME file and exact landmarks."""

import numpy as np
from flame.small_head import write_flame
from PIL import Image

from stga_addon.capture.camera import look_at
from stga_addon.files import write_json, write_npz
from stga_addon.flame.forward import flame_forward
from stga_addon.tracking.landmarks import write_places

from .test_fit import frame_at, places_on

SIZE = 64
LANDMARKS = 120


def rig(count=5, size=SIZE):
    eyes = [(np.sin(a), 0.1, np.cos(a)) for a in np.linspace(-0.6, 0.6, count)]
    return [look_at(eye, (0, -0.02, 0), size, size, 2.6 * size) for eye in eyes]


def write_footage(folder, cameras, timesteps, picture):
    """transforms.json with one entry an image; picture(camera, timestep) gives its pixels."""
    frames = []
    for number, camera in enumerate(cameras):
        for timestep in range(timesteps):
            name = f"images/{number}_{timestep}.png"
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(picture(camera, timestep)).save(folder / name)
            entry = {"file_path": name, "timestep_index": timestep, "camera_id": f"cam{number}"}
            entry |= {name: getattr(camera, name) for name in ("fl_x", "fl_y", "cx")}
            entry |= {"w": camera.width, "h": camera.height, "cy": camera.height - camera.cy}
            frames.append({**entry, "transform_matrix": camera.camera_to_world_gl.tolist()})
    write_json(folder / "transforms.json", {"frames": frames})
    return folder


def seen_landmarks(head, places, meshes, camera):
    """(T, N, 2) exact pixels."""
    return np.stack([camera.project(places.on(mesh, head.model.faces))[0] for mesh in meshes])


def record(
    folder, head, picture=lambda mesh, camera: np.zeros((SIZE, SIZE, 3), np.uint8), timesteps=5
):
    """Footage, a FLAME file, and exact landmarks of a moving head, none of them at timestep 2;
    returns its meshes. picture(mesh, camera) gives the pixels."""
    cameras = rig()
    places = places_on(head, LANDMARKS)
    shape = np.zeros(head.model.n_identity)
    frames = [frame_at(head, timestep) for timestep in range(timesteps)]
    meshes = [flame_forward(head.model, shape, frame) for frame in frames]
    write_footage(folder / "footage", cameras, timesteps, lambda c, t: picture(meshes[t], c))
    write_flame(head.model, folder / "head.npz")
    write_places(folder / "points/head_model.npz", places, np.ones(LANDMARKS, bool))
    for number, camera in enumerate(cameras):
        points = seen_landmarks(head, places, meshes, camera)
        confidence = np.ones(points.shape[:2])
        confidence[2] = 0
        arrays = {"timesteps": np.arange(timesteps), "points": points, "confidence": confidence}
        write_npz(folder / f"points/cam{number}.npz", arrays)
    return meshes
