"""What lights add to surface points: irradiance, and highlights towards the eye."""

import math

import numpy as np

from . import part_jit
from .threads import call_helpers, parallel, pieces

ZERO, EIGHTH, HALF, ONE, TWO, PI = (
    np.float32(value) for value in (0.0, 0.125, 0.5, 1.0, 2.0, np.pi)
)
# Kinds of lights.
SUN = 0
POINT = 1
SPOT = 2
AREA = 3

# Columns of a table of lights (L, COLUMNS) float32.
KIND = 0
"""SUN, POINT, SPOT or AREA."""
POSITION = 1
"""Position, 3 columns."""
DIRECTION = 4
"""Direction in which the light shines, 3 columns."""
COLOR = 7
"""Color, 3 columns: irradiance of a sun, else intensity in W/sr towards what faces the light."""
CONE = 10
"""Cosine of half a spot's cone."""
FADE = 11
"""How far above CONE the cosine has risen where a spot no longer fades."""
MAP = 12
"""Row of the table of visibility; -1: the light is visible from every point."""
DIFFUSE = 13
"""Factor of diffuse light."""
SPECULAR = 14
"""Factor of specular light."""
WIDTH = 15
"""Tangent of half the angle that a sun takes, else half the light's width in meters."""
COLUMNS = 16
"""Number of columns."""
MIN_FACING = np.float32(0.05)
"""Least cosine between a highlight's normal and the direction to the eye; smaller ones are
raised."""


@part_jit
def ggx(facing, toward_eye, half, fresnel_cosine, square, reflectance):
    """Reflected fraction per steradian and cosine of a GGX lobe with Smith's shadowing and
    Schlick's Fresnel term.

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
