"""Density control and stray resets: splitting, pruning and moving splats between steps (STGA,
training)."""

from dataclasses import replace

import numpy as np

from ...avatar.splats import joined
from ...flame.quaternions import to_matrices
from .state import TrainState, join, keep_rows, new_state

MIN_OPACITY = 0.02
"""Splats with a lower opacity are pruned."""
SPLIT_SCALE = 1.6
"""By which both halves of a split splat are narrower along the axis it is split on."""


def control_density(
    state: TrainState,
    budget: int,
    rng: np.random.Generator,
    max_share: float,
    region: np.ndarray | None = None,
) -> TrainState:
    """Split the splats with the largest mean screen gradient and prune those of low opacity.

    budget: how many splats may be added; max_share: largest share of the splats that is split;
    region (F,) bool: the triangles whose splats may change, None for all. Every triangle with bound
    splats keeps one. Children, on either side of the parent's center along its longest axis,
    inherit triangle, binding and unseen share, lie within the parent's Gaussian in local units, and
    keep Adam's second moment and step count, without which their first steps would all be as long
    as the rate.
    """
    gradient = state.screen_gradient / np.maximum(state.gradient_count, 1)
    within = np.ones(len(state), bool) if region is None else region[state.face]
    gradient[~within] = 0.0
    count = max(0, min(budget, int(max_share * within.sum())))
    split = np.argsort(-gradient, kind="stable")[:count]
    split = split[gradient[split] > 0]
    kept = keep_rows(state, split)
    parents, pairs, n = kept.splats(), join(kept, kept), np.arange(len(split))
    longest = np.argmax(parents.log_scale, axis=1)
    length = np.exp(parents.log_scale[n, longest])[:, None]
    offset = to_matrices(parents.rotation)[n, :, longest] * length * 0.5
    jitter = 1 + 0.1 * rng.standard_normal((len(parents), 1))
    parents.log_scale[n, longest] -= np.log(SPLIT_SCALE)
    # of two Gaussians beside each other, so much narrower, that cover as much as one
    opacity = np.maximum(SPLIT_SCALE / 2 * _sigmoid(parents.opacity), 2 * MIN_OPACITY)
    parents.opacity[:] = np.log(opacity / (1 - opacity))
    sides = [(parents.xyz + side * offset * jitter).astype(np.float32) for side in (-1, 1)]
    halves = joined([replace(parents, xyz=xyz) for xyz in sides])
    children = new_state(halves, pairs.unseen_share)
    children.second, children.steps = pairs.second, pairs.steps
    faint = _sigmoid(state.parameters.opacity) < MIN_OPACITY
    keep = ~prunable(state, faint & within)
    keep[split] = False
    state = join(keep_rows(state, keep), children)
    zero = np.zeros(len(state), np.float32)
    return replace(state, screen_gradient=zero, gradient_count=zero.copy())


def reset_strays(state: TrainState, limit: np.ndarray, share: float) -> int:
    """Move bound splats farther than `limit` from their triangle's origin back to `share` of it;
    returns how many.

    limit (F,) in local units, infinite where none is moved. Works in place. (STGA, training, which
    moves them onto the origin: share = 0.) Adam's first moment of the position is reset. The second
    moment is kept: with it at zero and the step count of the row, which all its parameters share,
    in the thousands, the bias correction would make the next step 3.2 times as long as the learning
    rate (0.1 / √0.001).
    """
    distance = np.linalg.norm(state.parameters.xyz, axis=1)
    allowed = limit[state.face]
    strays = np.flatnonzero(~state.unbound & (distance > allowed))
    # Rounding must not leave them just beyond the limit, or they would be strays again.
    factor = (share * (1 - 1e-6) * allowed[strays] / distance[strays])[:, None]
    state.parameters.xyz[strays] = np.where(factor > 0, factor * state.parameters.xyz[strays], 0)
    state.first.xyz[strays] = 0
    state.average.xyz[strays] = state.parameters.xyz[strays]
    return len(strays)


def prunable(state: TrainState, unwanted: np.ndarray) -> np.ndarray:
    """(N,) bool: the unwanted splats (N,) bool but for a bound one of each triangle that would have
    none left: the most opaque one."""
    face, bound = state.face, np.flatnonzero(~state.unbound)
    order = bound[np.lexsort((-state.parameters.opacity[bound], unwanted[bound], face[bound]))]
    first = np.ones(len(order), bool)
    first[1:] = face[order][1:] != face[order][:-1]
    prunable = unwanted.copy()
    prunable[order[first]] = False
    return prunable


def _sigmoid(x: np.ndarray) -> np.ndarray:
    """In float64."""
    return np.asarray(1 / (1 + np.exp(-x.astype(np.float64))))
