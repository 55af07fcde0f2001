"""Density control: splats where the error asks for them, none where they do nothing (STGA, training)."""

from dataclasses import replace

import numpy as np
import torch

from ...avatar.splats import Splats
from .state import TrainState, join, keep_rows, new_state

FAINT = 0.005
"""Opacity under which a splat is pruned."""
SHRINK = np.log(1.6)
"""How much smaller, as a logarithm, both halves of a split splat are along the axis it is split on."""


def control_density(state: TrainState, room: int, share: float, rng: np.random.Generator) -> TrainState:
    """Split the splats that the image pulls at hardest and prune the faint ones.

    room: how many splats may still be added; share: at most this share of the splats is split at once. Every triangle
    that has splats keeps one. Children inherit triangle and looseness, lie within the parent's Gaussian in local
    units, and keep Adam's second moment, without which their first steps would all be as long as the rate.
    """
    screen_gradient = (state.screen_gradient / state.gradient_count.clamp_min(1)).numpy()
    count = max(0, min(room, int(share * len(state))))
    hardest = np.argsort(-screen_gradient, kind="stable")[:count]
    hardest = hardest[screen_gradient[hardest] > 0]
    parents = keep_rows(state, torch.from_numpy(hardest))
    pairs = join(parents, parents)
    children = replace(new_state(_halves(parents.splats(), rng)), second=pairs.second, steps=pairs.steps)
    keep = ~_dispensable(state)
    keep[hardest] = False
    state = join(keep_rows(state, torch.from_numpy(keep)), children)
    return replace(state, screen_gradient=torch.zeros(len(state)), gradient_count=torch.zeros(len(state)))


def _halves(parents: Splats, rng: np.random.Generator) -> Splats:
    """Two smaller splats per parent, on either side of its centre along its longest axis."""
    axes = _rotation_matrices(parents.rotation)
    longest = np.argmax(parents.log_scale, axis=1)
    n = np.arange(len(parents))
    offset = axes[n, :, longest] * np.exp(parents.log_scale[n, longest])[:, None] * 0.5
    jitter = 1 + 0.1 * rng.standard_normal((len(parents), 1))
    log_scale = parents.log_scale.copy()
    log_scale[n, longest] -= SHRINK
    # Two splats of opacity a cover as one of opacity o where 1 − (1 − a)² = o.
    opacity = 1 - np.sqrt(1 - np.clip(_sigmoid(parents.opacity), 0, 0.999))
    opacity = np.maximum(opacity, 2 * FAINT)
    both = []
    for side in (-1, 1):
        moved = replace(
            parents,
            xyz=(parents.xyz + side * offset * jitter).astype(np.float32),
            log_scale=log_scale,
            opacity=np.log(opacity / (1 - opacity)).astype(np.float32),
        )
        both.append(moved)
    return Splats(*(np.concatenate(pair) for pair in zip(*(_values(s) for s in both), strict=True)))


def _dispensable(state: TrainState) -> np.ndarray:
    """(N,) bool: faint splats, but never the last (most opaque) bound one of a triangle."""
    opacity, face, unbound = state.parameters.opacity.numpy(), state.face.numpy(), state.unbound.numpy()
    faint = _sigmoid(opacity) < FAINT
    bound = np.flatnonzero(~unbound)
    order = bound[np.lexsort((-opacity[bound], face[bound]))]
    first = np.ones(len(order), bool)
    first[1:] = face[order][1:] != face[order][:-1]
    faint[order[first]] = False
    return np.asarray(faint)


def _values(splats: Splats) -> tuple[np.ndarray, ...]:
    return tuple(vars(splats).values())


def _sigmoid(x: np.ndarray) -> np.ndarray:
    return np.asarray(1 / (1 + np.exp(-x.astype(np.float64))))


def _rotation_matrices(q: np.ndarray) -> np.ndarray:
    q = q / np.maximum(np.linalg.norm(q, axis=1, keepdims=True), 1e-12)
    w, x, y, z = q.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, -1) for row in rows], -2)
