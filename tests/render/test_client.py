"""Layers rendered together, in this process and by a render server in another interpreter."""

import io
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from avatar.conftest import splats_of
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from refusal import refusal

from stga_addon.avatar.embedding import WORLD, face_frames
from stga_addon.capture.camera import Camera
from stga_addon.errors import StgaError
from stga_addon.raster.cpu.compose import compose
from stga_addon.raster.posed_splats import PosedSplats
from stga_addon.render import client as render_client
from stga_addon.render.client import RenderClient
from stga_addon.render.render import render, render_layers
from stga_addon.worker.messages import receive

HERE = np.eye(4)
AHEAD = np.array([0, 0, 1.2])
CAMERA = Camera(50, 40, 60.0, 60.0, 25.0, 20.0, HERE)


def cloud(count=200, seed=0, face=1):
    rng = default_rng(seed)
    return splats_of(
        rng.normal(0, 0.2, (count, 3)) + AHEAD,
        rotation=rng.normal(0, 1, (count, 4)),
        log_scale=rng.normal(-3.5, 0.4, (count, 3)),
        opacity=rng.normal(0, 1.5, count),
        sh=rng.normal(0, 0.15, (count, 9, 3)),
        face=rng.integers(0, face, count),
    )


def world(splats, place=HERE):
    return PosedSplats(splats, WORLD, place)


def embedded():
    rng = default_rng(1)
    faces = np.array([[0, 1, 2], [1, 3, 2]])
    neutral = rng.normal(0, 0.2, (4, 3)) + AHEAD
    frames = face_frames(1.1 * neutral, faces, neutral)
    frames = replace(frames, color=rng.normal(0, 0.3, (2, 3)).astype(np.float32))
    splats = cloud(60, 2, 2)
    return PosedSplats(replace(splats, xyz=0.05 * splats.xyz), frames, HERE, True)


def test_one_layer_gives_the_pixels_of_render():
    """Catches differences between `compose` and `render`, and colors in the scene's directions."""
    splats = cloud()
    picture = compose([world(splats)], CAMERA)
    expected = render(splats, CAMERA, (1.0, 0.5, 0.0))
    behind = (1 - picture.alpha) * np.array([1.0, 0.5, 0.0])[:, None, None]
    assert_allclose(np.clip(picture.rgb + behind, 0, 1), expected, atol=2e-6)
    assert picture.depth is None
    turn = np.eye(4)
    turn[:3, :3] = np.linalg.qr(default_rng(3).normal(size=(3, 3)))[0]
    turn[:3, :3] *= np.sign(np.linalg.det(turn[:3, :3]))
    camera = replace(CAMERA, world_to_camera=np.linalg.inv(turn))
    splats = cloud()
    for size in (1.0, 2.0):
        log_scale = splats.log_scale - np.float32(np.log(size))
        small = replace(splats, xyz=splats.xyz / np.float32(size), log_scale=log_scale)
        picture = compose([world(small, turn @ np.diag([size, size, size, 1]))], camera)
        assert_allclose(picture.rgb, compose([world(splats)], CAMERA).rgb, atol=1e-4)


def test_layers_are_sorted_together():
    """Catches layers composited one over the other, depth that is not divided by alpha, and a
    background that is only behind a single layer."""
    splats = cloud()
    half = np.arange(len(splats)) % 2 == 0
    whole, halves = (
        compose(layers, CAMERA, True)
        for layers in ([world(splats)], [world(splats.rows(half)), world(splats.rows(~half))])
    )
    assert_allclose(halves.rgb, whole.rgb, atol=2e-6)
    assert_allclose(halves.depth, whole.depth, atol=1e-5)
    green = 0.2, 0.9, 0.4
    found = render_layers([world(splats.rows(half)), world(splats.rows(~half))], CAMERA, green)
    assert_allclose(found, render(splats, CAMERA, green), atol=2e-6)
    xyz = np.array([[0, 0, 3]], np.float32)
    log_scale = np.full((1, 3), -1, np.float32)
    splats = replace(cloud(1), xyz=xyz, log_scale=log_scale)
    depth = compose([world(splats)], CAMERA, True).depth
    assert_allclose(depth[depth > 0], 3, rtol=1e-5)
    assert compose([], CAMERA, True).alpha.max() == 0


@pytest.mark.slow
def test_the_server_renders_the_same(monkeypatch):
    """Catches a server that renders something else, or is left running."""
    monkeypatch.setattr(render_client, "missing_packages", lambda: ["numba"])
    remote = RenderClient(lambda: sys.executable)
    layers = [embedded(), world(cloud())]
    for camera in (CAMERA, CAMERA.scaled(0.5)):
        here = compose(layers, camera, True)
        there = remote.compose(layers, camera, True)
        for name in ("rgb", "alpha", "depth"):
            assert_array_equal(getattr(there, name), getattr(here, name))
    assert remote._server is not None
    _, server = remote._server
    with refusal("could not render"):
        remote.compose(layers, replace(CAMERA, world_to_camera=np.zeros(3)))
    server.kill()
    server.wait()
    with refusal("exited unexpectedly"):
        remote.compose(layers, CAMERA)
    assert remote.compose([world(cloud())], CAMERA).alpha.max() > 0
    remote.close()
    assert subprocess.Popen.poll(server) is not None


def test_what_cannot_render_is_one_sentence(monkeypatch):
    """Catches a traceback without numba, and a wait for ever for foreign output."""

    def nobody():
        raise StgaError("no training Python")

    monkeypatch.setattr(render_client, "missing_packages", lambda: ["numba", "platformdirs"])
    with refusal("Rendering splats needs numba and platformdirs .*or another Python"):
        RenderClient(nobody).compose([], CAMERA)
    with refusal("/no/such/python: cannot be started"):
        RenderClient(lambda: "/no/such/python").compose([], CAMERA)
    with pytest.raises(ValueError, match="begins with"):
        receive(io.BytesIO(b"Loading something, please wait"))
