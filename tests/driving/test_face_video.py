"""A performance from a video, with a network in place of MediaPipe's, whose file is not part of the tests."""

import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from stga_addon.cli.main import main
from stga_addon.driving.head_map import head_turns
from stga_addon.driving.names import ARKIT_SHAPES, COLUMN
from stga_addon.driving.read_performance import read_performance
from stga_addon.flame.quaternions import from_axis_angle, to_matrices
from stga_addon.render.video import video_writer

pytest.importorskip("av")


@pytest.fixture
def network(monkeypatch):
    """Mediapipe's Tasks API: a gray of g means jawOpen = g / 255 and a yaw of as many radians; black: no face."""
    asked = {}

    def detect(image):
        gray = float(image.data.mean()) / 255
        if gray < 0.02:
            return SimpleNamespace(face_landmarks=[], face_blendshapes=[], facial_transformation_matrixes=[])
        names = ["_neutral", *(name for name in ARKIT_SHAPES if name != "tongueOut")]
        scores = [SimpleNamespace(category_name=n, score=gray if n == "jawOpen" else 0.0) for n in names]
        matrix = np.eye(4)
        matrix[:3, :3] = 1.02 * to_matrices(from_axis_angle(head_turns(np.array([[gray, 0, 0]]))))[0]
        return SimpleNamespace(face_landmarks=[], face_blendshapes=[scores], facial_transformation_matrixes=[matrix])

    def make(options):
        asked.update(options)
        return SimpleNamespace(detect=detect)

    vision = SimpleNamespace(
        FaceLandmarkerOptions=lambda **options: options,
        FaceLandmarker=SimpleNamespace(create_from_options=make),
    )
    package = SimpleNamespace(
        tasks=SimpleNamespace(vision=vision, BaseOptions=lambda **options: options),
        Image=lambda image_format, data: SimpleNamespace(data=data),
        ImageFormat=SimpleNamespace(SRGB=1),
        __version__="0",
    )
    monkeypatch.setitem(sys.modules, "mediapipe", package)
    return asked


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """Ten frames at 25 a second, the sixth black."""
    path = tmp_path / "face.mp4"
    with video_writer(path, 25) as append:
        for number in range(10):
            append(np.full((64, 64, 3), 0 if number == 5 else 60 + 10 * number, np.uint8))
    return path


def test_a_video_becomes_a_performance(network, video, tmp_path):
    """Catches another rate or time, a frame without a face that is taken as a face at rest, names in another order, and
    a rotation that is not relative to the first frame."""
    (tmp_path / "face.task").write_bytes(b"network")
    assert main(["drive", str(video), "--out", str(tmp_path / "a.csv"), "--detector", str(tmp_path / "face.task")]) == 0
    take = read_performance(tmp_path / "a.csv")
    assert take.fps == pytest.approx(25, rel=1e-4)
    np.testing.assert_allclose(take.times, np.arange(10) / 25, atol=1e-4)
    expected = (60 + 10 * np.arange(10)) / 255
    np.testing.assert_allclose(take.weights[:, COLUMN["jawOpen"]], expected, atol=0.015)
    np.testing.assert_allclose(take.head[:, 0], expected - expected[0], atol=0.02)
    assert network["output_face_blendshapes"]
    assert network["base_options"]["model_asset_buffer"] == b"network"


def test_mistakes(network, video, tmp_path, capsys):
    """Catches a traceback, and a video without a face that becomes an empty file."""
    assert main(["drive", str(video), "--out", str(tmp_path / "a.csv")]) == 2
    assert "needs Google's face_landmarker.task" in capsys.readouterr().err
    (tmp_path / "face.task").write_bytes(b"network")
    with video_writer(tmp_path / "dark.mp4", 25) as append:
        append(np.zeros((64, 64, 3), np.uint8))
    options = ["--out", str(tmp_path / "a.csv"), "--detector", str(tmp_path / "face.task")]
    assert main(["drive", str(tmp_path / "dark.mp4"), *options]) == 2
    assert "no face was found in any of its 1 frames" in capsys.readouterr().err
    assert not (tmp_path / "a.csv").exists()
