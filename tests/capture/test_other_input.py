"""What is no capture: what it is, and the command for it."""

import json

import numpy as np
import pytest
from PIL import Image
from refusal import refusal

from stga_addon.capture.open import is_capture, open_capture
from stga_addon.cli.main import main
from stga_addon.export.ply import write_ply
from stga_addon.export.splat_files import SPLAT_ROW, read_splats

PACKED = (
    "ply\nformat binary_little_endian 1.0\nelement chunk 1\nproperty float min_x\n"
    "element vertex 1\nproperty uint packed_position\nend_header\n"
)
PLY_HEAD = "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\n"
ROW = np.array([(np.zeros(3), np.ones(3), [255] * 4, [255, 128, 128, 128])], SPLAT_ROW).tobytes()


def photo(path):
    Image.new("RGB", (8, 8)).save(path)


def splats(path):
    raw = path.with_suffix(".splat")
    raw.write_bytes(ROW)
    write_ply(path, read_splats(raw))
    raw.unlink()


SHOT = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
FILES = {
    "photos/a.png": photo,
    "model/sparse/0/cameras.bin": b"",
    "model/sparse/0/images.bin": b"",
    "model/images/a.png": photo,
    "scene/transforms.json": json.dumps({"w": 8, "h": 8, "fl_x": 9.0, "frames": [SHOT]}).encode(),
    "scene/a.png": photo,
    "clips/left/take.mp4": b"",
    "clip.mov": b"",
    "gs/point_cloud/iteration_30000/point_cloud.ply": splats,
    "gs/input.ply": PLY_HEAD.encode(),
    "gs/cameras.json": b'[{"id": 0, "position": [], "rotation": [], "fx": 1}]',
    "splats.ply": splats,
    "packed.ply": PACKED.encode(),
    "head.splat": 3 * ROW,
    "head.spz": b"hello",
    "face.csv": b"Timecode,jawOpen\n",
    "face.jsonl": b"{}\n",
    "body.bvh": b"HIERARCHY\n",
    "sound/voice.wav": b"",
    "avatar/run/run.json": b"{}",
}


@pytest.mark.parametrize(
    ("path", "what"),
    [
        ("photos", "a folder of 1 photos.*stga avatar photos --out photos_avatar"),
        ("model", "a folder of 1 photos with a COLMAP model.*stga track model --out model_capture"),
        ("scene", "a folder of 1 photos with a transforms file.*stga avatar scene"),
        ("clips", "a folder of 1 video.*stga track clips"),
        ("clip.mov", "a video.*stga avatar clip.mov --out clip_avatar"),
        ("gs", "the output of 3D Gaussian Splatting.*stga render gs --turntable"),
        ("gs/cameras.json", "file of cameras.*stga render gs --cameras gs/cameras.json"),
        ("splats.ply", "a file of splats.*stga render splats.ply"),
        ("head.splat", "a file of splats.*splats 3 next"),
        ("face.csv", "a performance.*stga drive face.csv"),
        ("face.jsonl", "a performance.*stga drive face.jsonl"),
        ("body.bvh", "a body's motion.*ARKit"),
        ("sound", "a folder with sound.*Audio2Face"),
        ("avatar", "a folder of `stga avatar`.*stga info avatar/run"),
    ],
)
def test_what_is_no_capture_is_told(tmp_path, monkeypatch, capsys, path, what):
    """Catches "is not a capture" without a way, in `stga info` and where a capture is expected; and
    a folder of splats opened as one of meshes."""
    for name, content in FILES.items():
        file = tmp_path / name
        file.parent.mkdir(parents=True, exist_ok=True)
        content(file) if callable(content) else file.write_bytes(content)
    monkeypatch.chdir(tmp_path)
    assert not is_capture(tmp_path / path)
    for unread in ("head.spz", "packed.ply"):
        assert main(["info", unread]) == 2
    assert main(["info", path]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 5
    told = " ".join(" ".join(lines).split())
    first, _, command = what.partition(".*")
    assert first in told
    assert command in told
    with refusal(first):
        open_capture(tmp_path / path)
