"""A small mesh with splats on it."""

from dataclasses import replace

import numpy as np
import pytest

from stga_addon.avatar.file import Avatar
from stga_addon.avatar.splats import Splats
from stga_addon.capture.camera import look_at


def splats_of(xyz, rotation=(1, 0, 0, 0), log_scale=-4.0, opacity=0.0, sh=0.0, face=0):
    """Bound splats, of these values or of one for all: sh (3,) is a color's."""
    count = len(xyz)

    def each(value, *shape, dtype=np.float32):
        whole = np.broadcast_shapes(np.shape(value), (count, *shape))
        return np.array(np.broadcast_to(value, whole), dtype)

    return Splats(
        xyz=each(xyz, 3),
        rotation=each(rotation, 4),
        log_scale=each(log_scale, 3),
        opacity=each(opacity),
        sh=each(sh, 1, 3),
        face=each(face, dtype=np.int32),
        unbound=np.zeros(count, bool),
    )


def random_splats(seed, count, faces, sh_degree=3):
    rng = np.random.default_rng(seed)

    def normal(*shape):
        return rng.normal(size=shape).astype(np.float32)

    bound = splats_of(
        normal(count, 3),
        rotation=normal(count, 4) * 3,
        log_scale=normal(count, 3) - 4,
        opacity=normal(count),
        sh=normal(count, (sh_degree + 1) ** 2, 3),
        face=rng.integers(0, faces, count),
    )
    return replace(bound, unbound=rng.random(count) < 0.3)


def world_splats(xyz, rotation, log_scale, opacity, sh):
    """Splats of another program's numbers; opacity from 0 to 1."""
    logit = np.log(opacity / (1 - opacity))
    nothing = np.zeros(len(xyz), np.int32)
    values = (np.asarray(each, np.float32) for each in (xyz, rotation, log_scale, logit, sh))
    return Splats(*values, face=nothing, unbound=nothing.astype(bool))


def random_mesh(seed, vertices=20, faces=30):
    """Vertices (V, 3) float64 and faces (F, 3) int32 of different corners: a soup of well-shaped
    triangles."""
    rng = np.random.default_rng(seed)
    corners = rng.permuted(np.tile(np.arange(vertices, dtype=np.int32), (faces, 1)), axis=1)[:, :3]
    return rng.normal(size=(vertices, 3)) * 0.1, np.ascontiguousarray(corners)


def rendered(world):
    """(3, 48, 64) picture of world-space splats."""
    from stga_addon.render.render import render

    return np.asarray(
        render(world, look_at((0.3, 0.2, 1), (0, 0, 0), width=64, height=48, focal_length=90))
    )


@pytest.fixture
def avatar():
    neutral, faces = random_mesh(0)
    return Avatar(
        splats=random_splats(1, 50, len(faces)),
        convention="stga",
        neutral=neutral.astype(np.float32),
        faces=faces,
        settings={
            "lattice": 2,
            "rates": {"xyz": 1e-4},
            "name": "Zoë",
            "steps": [1, 2, 3],
            "resume": None,
        },
        regions={"mouth": np.arange(30) < 4, "left eye": np.arange(30) % 5 == 0},
        background=(1.0, 0.5, 0.0),
    )
