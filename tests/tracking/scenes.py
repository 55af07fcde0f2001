"""Calibrated rigs and their recordings, for the tests of footage."""

import numpy as np
from PIL import Image

from stga_addon.capture.camera import look_at

WIDTH = 40
HEIGHT = 30


def rig(count=3, width=WIDTH, height=HEIGHT):
    """Cameras on an arc about the origin."""
    return [
        look_at((np.sin(a), 0.2, np.cos(a)), (0, 0, 0), width, height, 50.0)
        for a in 0.4 * np.arange(count)
    ]


def write_image(path, value=128, size=(WIDTH, HEIGHT)):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.new("RGB", size, (value, 10, 20)).save(path)


def rewrite(path, *changes):
    """Change a text in place: what is found in it, and what stands there then."""
    text = path.read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path.write_text(text, encoding="utf-8")


def encode(path, frames, codec="libx264", options=None, rate=25, times=None, set_up=None):
    """A video of images (H, W, 3) uint8, or of PyAV's frames; times: of each, in frames; set_up: of
    the encoder."""
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate, options=dict(options or {}))
        stream.pix_fmt = "yuv420p"
        for number, frame in enumerate(frames):
            if isinstance(frame, np.ndarray):
                frame = av.VideoFrame.from_ndarray(frame, format="rgb24")
            if number == 0:
                stream.width = frame.width
                stream.height = frame.height
                if set_up is not None:
                    set_up(stream)
            frame.pts = number if times is None else times[number]
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


def write_video(path, values, size=(WIDTH, HEIGHT), rate=25, gop=5):
    """A video whose frames are gray of the given values; every fifth is a key frame, and some refer
    to later ones."""
    frames = (np.full((size[1], size[0], 3), value, np.uint8) for value in values)
    encode(path, frames, options={"g": str(gop), "bf": "2", "crf": "10"}, rate=rate)


def quaternion(rotation):
    """wxyz of a rotation matrix."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return w, x, y, z


def write_colmap_text(folder, cameras, names, model="PINHOLE", parameters=None):
    """A COLMAP model in text, one camera an image, as COLMAP writes it (comments, lines of
    points)."""
    folder.mkdir(parents=True, exist_ok=True)
    lines = ["# Camera list"]
    images = ["# Image list with two lines of data per image:"]
    for number, (camera, name) in enumerate(zip(cameras, names, strict=True), start=1):
        values = parameters or (camera.fl_x, camera.fl_y, camera.cx, camera.cy)
        words = " ".join(map(repr, map(float, values)))
        lines.append(f"{number} {model} {camera.width} {camera.height} {words}")
        pose = *quaternion(camera.world_to_camera[:3, :3]), *camera.world_to_camera[:3, 3]
        images += [
            f"{number} {' '.join(map(repr, map(float, pose)))} {number} {name}",
            "1.5 2.5 -1" * (number % 2),
        ]
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")
    (folder / "images.txt").write_text("\n".join(images) + "\n", encoding="utf-8")
