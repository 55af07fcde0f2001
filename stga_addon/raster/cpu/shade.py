"""What lights add to surface points: irradiance, and highlights towards the eye."""

import math

import numpy as np

from . import part_jit
from .threads import call_helpers, parallel, pieces

ZERO, EIGHTH, HALF, ONE, TWO, PI = (
    np.float32(value) for value in (0.0, 0.125, 0.5, 1.0, 2.0, np.pi)
)
SUN = 0
POINT = 1
SPOT = 2
AREA = 3
KIND = 0
POSITION = 1
DIRECTION = 4
COLOR = 7
CONE = 10
FADE = 11
MAP = 12
DIFFUSE = 13
SPECULAR = 14
WIDTH = 15
COLUMNS = 16
"""Columns of a table of lights (L, COLUMNS) float32: kind; position (3); direction in which it
shines (3); color (3), irradiance of a sun, else intensity in W/sr towards what faces it; cosine of
half a spot's cone, and how far above the cosine has risen where the spot no longer fades; row of
the shares that are lit, -1: all; factors of diffuse and specular light; tangent of half the angle
that a sun takes, else half the width in meters."""
MIN_FACING = np.float32(0.05)
"""Cosine that a highlight's normal is taken to have at least towards the eye."""


@part_jit
def ggx(facing, toward_eye, half, fresnel_cosine, square, reflectance):
    """Reflected share per steradian and cosine of a GGX lobe with Smith's shadowing and Schlick's
    Fresnel term.

    facing, toward_eye, half: cosines of the normal to light, eye and the direction half between
    them. square: α².
    """
    spread = half * half * (square - ONE) + ONE
    distribution = square / (PI * spread * spread)
    shadowing = facing * math.sqrt(toward_eye * toward_eye * (ONE - square) + square)
    shadowing += toward_eye * math.sqrt(facing * facing * (ONE - square) + square)
    fade = ONE - fresnel_cosine
    fresnel = reflectance + (ONE - reflectance) * fade * fade * fade * fade * fade
    return distribution * fresnel * HALF / shadowing


@part_jit
def _toward_light(light, px, py, pz):
    """Unit vector from a point to a light, factor of its color there, and the light's width as
    WIDTH has a sun's."""
    if int(light[KIND]) == SUN:
        return -light[4], -light[5], -light[6], ONE, light[WIDTH]
    dx = light[1] - px
    dy = light[2] - py
    dz = light[3] - pz
    square = max(dx * dx + dy * dy + dz * dz, np.float32(1e-8))
    away = ONE / math.sqrt(square)
    dx = dx * away
    dy = dy * away
    dz = dz * away
    strength = ONE / square
    along = -(dx * light[4] + dy * light[5] + dz * light[6])
    if int(light[KIND]) == AREA:
        strength *= max(along, ZERO)
    elif int(light[KIND]) == SPOT:
        inside = min(max((along - light[CONE]) / light[FADE], ZERO), ONE)
        strength *= inside * inside * (np.float32(3.0) - TWO * inside)
    return dx, dy, dz, strength, light[WIDTH] * away


@parallel(lambda points, *_: len(points), piece=256)
def add_lights(
    work, points, normals, eye, roughness, reflectance, lights, lit, irradiance, highlight
):
    """Add what lights (L, COLUMNS) give to irradiance and highlight (N, 3) float32 of points with
    normals (N, 3).

    eye (3,). roughness, reflectance (N,): of the highlight; a roughness of 0 has none. lit (maps,
    N): see MAP.
    """
    call_helpers(work)
    for begin, end in pieces(work):
        for n in range(begin, end):
            px = points[n, 0]
            py = points[n, 1]
            pz = points[n, 2]
            nx = normals[n, 0]
            ny = normals[n, 1]
            nz = normals[n, 2]
            vx = eye[0] - px
            vy = eye[1] - py
            vz = eye[2] - pz
            scale = ONE / math.sqrt(max(vx * vx + vy * vy + vz * vz, np.float32(1e-20)))
            vx = vx * scale
            vy = vy * scale
            vz = vz * scale
            toward_eye = max(nx * vx + ny * vy + nz * vz, MIN_FACING)
            alpha = roughness[n] * roughness[n]
            for s in range(len(lights)):
                light = lights[s]
                row = int(light[MAP])
                dx, dy, dz, strength, width = _toward_light(light, px, py, pz)
                facing = nx * dx + ny * dy + nz * dz
                if row >= 0:
                    strength *= lit[row, n]
                if not (facing > ZERO and strength > ZERO):
                    continue
                gloss = ZERO
                if alpha > ZERO and light[SPECULAR] > ZERO:
                    hx = dx + vx
                    hy = dy + vy
                    hz = dz + vz
                    scale = ONE / math.sqrt(max(hx * hx + hy * hy + hz * hz, np.float32(1e-12)))
                    half = min(max((nx * hx + ny * hy + nz * hz) * scale, ZERO), ONE)
                    fresnel_cosine = min(max((vx * hx + vy * hy + vz * hz) * scale, ZERO), ONE)
                    # Slopes by roughness and by the light's size.
                    wide = min(alpha * alpha + EIGHTH * width * width, ONE)
                    gloss = ggx(facing, toward_eye, half, fresnel_cosine, wide, reflectance[n])
                for k in range(3):
                    arriving = light[COLOR + k] * strength * facing
                    irradiance[n, k] += arriving * light[DIFFUSE]
                    highlight[n, k] += arriving * light[SPECULAR] * gloss
