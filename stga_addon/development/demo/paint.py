"""Vertex colors of the synthetic head, as functions of position."""

import numpy as np

from .head import Head
from .head_mesh import PARTS
from .skin import EYE, EYE_RADIUS, MOUTH, above_hairline

SKIN = np.array([0.56, 0.33, 0.235])  # linear RGB, as all colors here
LIPS = np.array([0.40, 0.115, 0.100])
HAIR = np.array([0.035, 0.020, 0.012])
GUMS = np.array([0.22, 0.035, 0.035])
TEETH = np.array([0.80, 0.74, 0.62])
IRISES = np.array([[0.10, 0.20, 0.30], [0.12, 0.20, 0.09], [0.13, 0.055, 0.02]])
LIMBUS, PUPIL = 0.0061, 0.0026  # radii of iris and pupil, meters


def paint(head: Head, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Linear RGB (V, 3), roughness (V,) and how much fine skin texture shows (V,), 0 to 1."""
    rng = np.random.default_rng([seed, 1])
    tint = _skin(head.rest, SKIN * rng.uniform(0.75, 1.1), HAIR * rng.uniform(0.6, 2.0), rng)
    iris = IRISES[rng.integers(len(IRISES))]
    part = {name: head.part == index for index, name in enumerate(PARTS)}
    tint[part["mouth"]] = GUMS
    tint[part["lid"]] *= 0.72
    tint[part["eyeball"]] = _eye(head.rest[part["eyeball"]], iris)
    tint[part["teeth"]] = _teeth(head.rest[part["teeth"]])
    shiny = part["eyeball"] | part["teeth"]
    roughness = np.where(part["eyeball"], 0.08, np.where(part["teeth"], 0.25, 0.48))
    return tint, roughness, np.where(shiny | part["mouth"], 0.0, 1.0)


def _mix(tint: np.ndarray, color: np.ndarray, amount: np.ndarray) -> np.ndarray:
    return np.asarray(tint + np.clip(amount, 0, 1)[:, None] * (color - tint))


def _spot(at: np.ndarray, center: tuple[float, float], size: tuple[float, float]) -> np.ndarray:
    return np.asarray(np.exp(-(((abs(at[:, 0]) - center[0]) / size[0]) ** 2) - ((at[:, 1] - center[1]) / size[1]) ** 2))


def _skin(at: np.ndarray, skin: np.ndarray, hair: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    x, y, z = at.T
    side, front = abs(x), np.clip((z - 0.03) / 0.02, 0, 1)
    tint = np.tile(skin, (len(at), 1))
    flush = _spot(at, (0.040, -0.012), (0.017, 0.015)) + 0.8 * _spot(at, (0.0, -0.018), (0.012, 0.010))
    tint = _mix(tint, skin * [1.05, 0.72, 0.70], 0.75 * front * flush)
    beard = _spot(at, (0.0, -0.075), (0.045, 0.022)) + _spot(at, (0.0, -0.037), (0.022, 0.006))
    tint = _mix(tint, skin * [0.80, 0.80, 0.84], rng.uniform(0, 0.7) * front * beard)
    tint = _mix(tint, skin * [0.72, 0.60, 0.58], 0.6 * front * _spot(at, (EYE[0], EYE[1]), (0.020, 0.012)))
    for _ in range(60):  # moles and freckles
        where, size = rng.uniform([-0.055, -0.09], [0.055, 0.08]), rng.uniform(0.0008, 0.0018)
        near = np.exp(-((x - where[0]) ** 2 + (y - where[1]) ** 2) / size**2)
        tint = _mix(tint, skin * [0.50, 0.38, 0.32], rng.uniform(0.3, 0.9) * front * near)
    height = np.where(y > MOUTH[1], 0.0078, 0.0098) * np.clip(1 - (side / 0.0268) ** 2, 0, 1) ** 0.7
    height -= np.where(y > MOUTH[1], 0.0014 * np.exp(-((side / 0.0035) ** 2)), 0)
    lips = np.clip((height - abs(y - MOUTH[1])) / 0.0012 + 0.5, 0, 1) * (side < 0.027)
    tint = _mix(tint, LIPS, 0.9 * front * lips)
    tint = _mix(tint, skin * 0.12, front * 0.95 * _spot(at, (0.0065, -0.0290), (0.0040, 0.0016)))  # nostrils
    ear = np.exp(-(((z + 0.016) / 0.006) ** 2) - ((y - 0.007) / 0.013) ** 2) * (side > 0.06)
    tint = _mix(tint, skin * [0.55, 0.42, 0.40], 0.8 * ear)
    lash = np.hypot((side - EYE[0]) / 0.0160, (y - EYE[1] - 0.001) / 0.0062)
    tint = _mix(tint, hair, front * (y > EYE[1]) * np.clip(1 - abs(lash - 1.05) / 0.13, 0, 1))
    arch = 0.0375 + 0.0075 * np.sin(np.clip((side - 0.010) / 0.036, 0, 1) * 2.3)
    thickness = 0.0036 * np.clip((side - 0.010) / 0.006, 0, 1) * np.clip((0.047 - side) / 0.020, 0, 1) ** 0.6
    strands = 0.75 + 0.25 * np.sin(side * 2600 + y * 1500)
    brow = np.clip((thickness - abs(y - arch)) / 0.0012 + 0.3, 0, 1) * (thickness > 0)
    tint = _mix(tint, hair, front * brow * strands)
    around = np.arctan2(x, z + 0.012)
    streak = 1 + 0.45 * np.sin(around * 70 + 3 * np.sin(y * 90)) + 0.25 * np.sin(around * 163 + y * 60)
    tint = np.where((above_hairline(at) > 0)[:, None], _mix(tint, hair, above_hairline(at) / 0.004), tint)
    combed = np.clip(above_hairline(at) / 0.004, 0, 1)[:, None]
    return np.asarray(tint * (1 + combed * (streak[:, None] - 1)))


def _eye(at: np.ndarray, iris: np.ndarray) -> np.ndarray:
    away = at - EYE * np.stack([np.sign(at[:, 0]), np.ones(len(at)), np.ones(len(at))], 1)
    radius = np.where(away[:, 2] > 0, np.hypot(away[:, 0], away[:, 1]), EYE_RADIUS)
    spokes = 1 + 0.3 * np.sin(12 * np.arctan2(away[:, 1], away[:, 0]))
    tint = np.tile([0.78, 0.74, 0.70], (len(at), 1))
    tint = _mix(tint, iris, np.clip((LIMBUS - radius) / 0.0009 + 0.5, 0, 1))
    tint *= np.where(radius < LIMBUS, spokes, 1)[:, None]
    return _mix(tint, np.full(3, 0.004), np.clip((PUPIL - radius) / 0.0006 + 0.5, 0, 1))


def _teeth(at: np.ndarray) -> np.ndarray:
    bow = np.arcsin(np.clip(at[:, 0] / 0.0232, -1, 1))
    gap = abs((bow * 5.2) % 1 - 0.5) > 0.44
    root = np.clip((abs(at[:, 1] - MOUTH[1] + 0.0026) - 0.0075) / 0.002, 0, 1)
    return _mix(TEETH * np.where(gap, 0.45, 1.0)[:, None], GUMS, root)
