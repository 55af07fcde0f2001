"""A ball under a plate: a small mesh with shadows whose truth can be computed by casting rays."""

import numpy as np
import trimesh
from avatar.conftest import splats_of
from rays import distances

from stga_addon.avatar.file import Avatar, AvatarLight
from stga_addon.avatar.splats import SH_C0
from stga_addon.capture.color import linear_to_srgb
from stga_addon.light.harmonics import uniform
from stga_addon.light.relight import HIGHLIGHT_FRACTION
from stga_addon.light.surface import Bounce, transfer_of

RADIUS = 0.1


def ball_and_plate(subdivisions=3):
    """Vertices and triangles of a ball of 10 cm, and a plate 6 cm above a part of it."""
    ball = trimesh.creation.icosphere(subdivisions, RADIUS)
    place = trimesh.transformations.translation_matrix((0.05, 0.16, 0.0))
    plate = trimesh.creation.box((0.12, 0.01, 0.12), place)
    both = trimesh.util.concatenate([ball, plate])
    return np.array(both.vertices), np.array(both.faces, np.int32)


def blocked(points, directions, vertices, faces):
    """(N,) bool: whether rays from points, each in its direction or all in one, meet a triangle."""
    rays = zip(points, np.broadcast_to(directions, points.shape), strict=True)
    return np.array([(distances(*ray, vertices[faces]) > 1e-6).any() for ray in rays])


def middle_splats(face, log_scale, coefficients=1):
    """A gray splat in the middle of each of the triangles."""
    return splats_of(
        np.zeros((len(face), 3)),
        log_scale=log_scale,
        opacity=3,
        sh=np.zeros((1, coefficients, 3)),
        face=face,
    )


def lit_avatar(albedo=(0.5, 0.3, 0.2), radiance=0.5, degree=0):
    """The ball and plate as an avatar: a splat in the middle of each triangle, recorded in even
    light; its colors are those of a surface of this albedo without highlights."""
    vertices, faces = ball_and_plate()
    transfer, occlusion = transfer_of(vertices, faces, 64)
    light = uniform(np.full(3, radiance))
    arriving = transfer @ light
    arriving = arriving + Bounce(vertices, faces, occlusion).light(arriving)
    skin = np.zeros(len(vertices), np.float32)
    recorded = arriving.astype(np.float32)
    avatar_light = AvatarLight(light.astype(np.float32), transfer, occlusion, recorded, skin, 0.0)
    splats = middle_splats(np.arange(len(faces)), -6, (degree + 1) ** 2)
    color = linear_to_srgb(
        arriving[faces].mean(1) / np.pi * (np.array(albedo) + HIGHLIGHT_FRACTION)
    )
    splats.sh[:, 0] = (color - 0.5) / SH_C0
    return Avatar(splats, "stga", vertices.astype(np.float32), faces, light=avatar_light)
