"""How much of an avatar's recorded colors a scene's light keeps: all of it where it is the light of the capture."""

from dataclasses import dataclass

import numpy as np

from .bounce import Bounce
from .harmonics import COUNT, LAMBERT

UNLIKE_LIGHT = 0.2
"""Difference between two lights from which on nothing is kept, as a share of the capture's light."""
ALIKE_AT_SPLAT, UNLIKE_AT_SPLAT = 0.25, 0.75
"""Difference between what arrives at a splat, now and in the capture, up to which all is kept and from which on
nothing, as a share: other objects' shadows."""
RIDGE = 1e-6
"""Of the mean of a matrix's diagonal, added to it: meshes that receive no light in some harmonics."""


@dataclass(frozen=True)
class Kept:
    """Colors are share · gain · recorded + (1 − share) · relit, all linear.

    share  0…1, of splats at which about as much arrives as in the capture (`kept_shares`)
    gain   (3,) the scene's light over the capture's
    """

    share: float
    gain: np.ndarray


def recorded_light(transfer: np.ndarray, bounce: Bounce, irradiance: np.ndarray) -> np.ndarray:
    """(9, 3) harmonics of the light that gave vertices of the neutral mesh irradiance (V, 3); transfer (V, 9)."""
    direct = np.repeat(transfer.T[..., None].astype(np.float64), 3, axis=2)
    columns = np.stack([each + bounce.light(each) for each in direct], axis=1)
    found = np.empty((COUNT, 3))
    for k in range(3):
        matrix = columns[..., k].T @ columns[..., k]
        matrix += RIDGE * np.trace(matrix) / COUNT * np.eye(COUNT)
        found[:, k] = np.linalg.solve(matrix, columns[..., k].T @ irradiance[:, k])
    return found


def kept(recorded: np.ndarray, distant: np.ndarray) -> Kept:
    """By the light of the capture and of the scene, both (9, 3) in the same axes, lamps as if they were far away.

    They are compared as irradiance by direction, each channel but for a factor.
    """
    old, new = (LAMBERT[:COUNT, None] * light for light in (recorded, distant))
    gain = np.maximum((old * new).sum(0) / np.maximum((old * old).sum(0), 1e-12), 0)
    difference = float(np.linalg.norm(new - gain * old) / max(float(np.linalg.norm(gain * old)), 1e-12))
    return Kept(1 - float(_smooth_step(np.array(difference / UNLIKE_LIGHT))), gain)


def kept_shares(kept: Kept, arriving: np.ndarray, irradiance: np.ndarray) -> np.ndarray:
    """(N,) float32 of what arrives at splats now, and of what arrived in the capture (N, 3)."""
    same = np.asarray(kept.gain, np.float32) * irradiance
    off = arriving - same
    square = np.einsum("nk,nk->n", off, off) / np.maximum(np.einsum("nk,nk->n", same, same), np.float32(1e-12))
    share = 1 - _smooth_step((np.sqrt(square) - ALIKE_AT_SPLAT) / (UNLIKE_AT_SPLAT - ALIKE_AT_SPLAT))
    return np.asarray(kept.share * share, np.float32)


def _smooth_step(values: np.ndarray) -> np.ndarray:
    """From 0 to 1 between 0 and 1."""
    values = np.clip(values, 0, 1)
    return np.asarray(values * values * (3 - 2 * values))
