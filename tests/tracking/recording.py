"""The recording of a moving head: its footage, its FLAME file and exact landmarks."""

import numpy as np
from flame.small_head import write_flame
from PIL import Image

from stga_addon.capture.camera import look_at
from stga_addon.files import write_json, write_npz
from stga_addon.flame.forward import flame_forward
from stga_addon.tracking.folder import PLACES_FILE
from stga_addon.tracking.landmarks import write_places

from .test_calibrations import entry
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
            moment = {"timestep_index": timestep, "camera_id": f"cam{number}"}
            frames.append(entry(camera, name, **moment, cy=camera.height - camera.cy))
    write_json(folder / "transforms.json", {"frames": frames})
    return folder


def seen_landmarks(head, places, meshes, camera):
    """(T, N, 2) exact pixels."""
    return np.stack([camera.project(places.on(mesh, head.model.faces))[0] for mesh in meshes])


def gray_with_a_lintel(mesh, camera):
    """Without detail where a head is, so that landmarks alone are tracked."""
    image = np.full((SIZE, SIZE, 3), 96, np.uint8)
    image[: SIZE // 8] = 160
    return image


def record(folder, head, picture=gray_with_a_lintel, timesteps=5):
    """Footage, a FLAME file, and exact landmarks of a moving head, none of them at timestep 2;
    returns its meshes. picture(mesh, camera) gives the pixels."""
    cameras = rig()
    places = places_on(head, LANDMARKS)
    shape = np.zeros(head.model.n_identity)
    frames = [frame_at(head, timestep) for timestep in range(timesteps)]
    meshes = [flame_forward(head.model, shape, frame) for frame in frames]
    write_footage(folder / "footage", cameras, timesteps, lambda c, t: picture(meshes[t], c))
    write_flame(head.model, folder / "head.npz")
    seen = [seen_landmarks(head, places, meshes, camera) for camera in cameras]
    confidence = np.ones((timesteps, LANDMARKS))
    confidence[2] = 0
    named = {f"cam{number}": points for number, points in enumerate(seen)}
    write_points(folder / "points", places, named, confidence=confidence)
    return meshes


def write_points(folder, places, named, **more):
    """Landmark files of cameras' names -> pixels (T, N, 2) at all timesteps; more: other arrays."""
    write_places(folder / PLACES_FILE, places, np.ones(len(places), bool))
    for name, points in named.items():
        arrays = {"timesteps": np.arange(len(points)), "points": points, **more}
        write_npz(folder / f"{name}.npz", arrays)
