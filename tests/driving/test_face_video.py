"""A performance from a video, with given scores in place of the networks'."""

import numpy as np
import pytest
from command_line import refused, stga
from numpy.testing import assert_allclose

from stga_addon.driving.face_video import CAMERA_FIELD_OF_VIEW_DEG
from stga_addon.driving.head_map import head_turns
from stga_addon.driving.performance import COLUMN
from stga_addon.driving.performers import read_performance
from stga_addon.driving.shapes import face_shapes
from stga_addon.flame.quaternions import from_axis_angle, to_matrices
from stga_addon.render.video import video_writer
from stga_addon.tracking.face_networks import FaceNetworks, FaceScores

pytest.importorskip("av")


@pytest.fixture
def network(monkeypatch):
    """A gray of g means jawOpen = g / 255 and a yaw of as many radians; black: no face."""
    shapes = face_shapes()

    def score(self, image):
        gray = float(image.mean()) / 255
        if gray < 0.02:
            return None
        turn = to_matrices(from_axis_angle(head_turns(np.array([[gray, 0, 0]]))))[0]
        at = 1e3 * shapes.points @ turn.T + [0, 0, -1e4]  # far away: without perspective
        focal = 32 / np.tan(np.radians(CAMERA_FIELD_OF_VIEW_DEG) / 2)
        points = np.column_stack([at[:, 0], -at[:, 1], -at[:, 2]]) * focal / 1e4 + [32, 32, 0]
        return FaceScores({"_neutral": 0.3, "jawOpen": gray}, points)

    monkeypatch.setattr(FaceNetworks, "score", score)


def test_a_video_becomes_a_performance(network, tmp_path):
    """Catches another rate, a missing face taken for a resting one, and an absolute rotation."""
    video = tmp_path / "face.mp4"  # ten frames at 25 a second, the sixth black
    with video_writer(video, 25) as append:
        for number in range(10):
            append(np.full((64, 64, 3), 0 if number == 5 else 60 + 10 * number, np.uint8))
    assert stga("drive", video, "--out", tmp_path / "a.csv") == 0
    take = read_performance(tmp_path / "a.csv")
    assert take.fps == pytest.approx(25, rel=1e-4)
    assert_allclose(take.times, np.arange(10) / 25, atol=1e-4)
    expected = (60 + 10 * np.arange(10)) / 255
    assert_allclose(take.weights[:, COLUMN["jawOpen"]], expected, atol=0.015)
    assert_allclose(take.head[:, 0], expected - expected[0], atol=0.02)


def test_a_video_without_a_face(tmp_path, capsys):
    """Catches a traceback, and a video without a face that becomes an empty file."""
    pytest.importorskip("cv2")
    with video_writer(tmp_path / "dark.mp4", 25) as append:
        append(np.zeros((64, 64, 3), np.uint8))
    assert "no face was found in any of its 1 frames" in refused(
        capsys, "drive", tmp_path / "dark.mp4", "--out", tmp_path / "a.csv"
    )
    assert not (tmp_path / "a.csv").exists()
