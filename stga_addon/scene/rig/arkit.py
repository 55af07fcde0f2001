"""ARKit's 52 shapes: shape keys of these names, which FLAME heads are given."""

from typing import Any

import numpy as np

from ...driving.head_map import PRODUCTS, HeadMap, features
from ...driving.performance import ARKIT_SHAPES, COLUMN, COUNT, Performance, arkit_name
from ...driving.shapes import JAW_OPEN
from ...errors import StgaError
from ...flame.forward import flame_forward
from ...flame.sequence import FlameSequence
from ..arrays import add_driver, flat_floats, key_points, write_curve
from ..compat import action_curves, push_down_action
from .keyframes import check_keyable, key_value_path, start_action

ARKIT_MAP = "stga_arkit_map"
"""Property of a FLAME head that was given the shapes: parameters (expression, jaw, eyes) by
feature of their weights (`head_map.features`)."""
NEGLIGIBLE_M = 1e-5
"""Displacement of a product of two shapes that gets no shape key."""


def has_shapes(head: Any) -> bool:
    """Whether a FLAME head was given ARKit's shapes."""
    return ARKIT_MAP in head


def head_shapes(sequence: FlameSequence, found: HeadMap) -> tuple[np.ndarray, np.ndarray]:
    """Displacements (52, V, 3) of a person's neutral mesh by each shape at 1, and (PRODUCTS, V, 3)
    by what each of PRODUCTS at 1 adds to jawOpen at 1, or takes from it; meters."""
    open_jaw = np.eye(COUNT)[JAW_OPEN]
    weights = np.concatenate([np.zeros((1, COUNT)), np.eye(COUNT), np.eye(COUNT)[PRODUCTS]])
    weights[1 + COUNT :] += open_jaw
    frames = found.frames(Performance(np.arange(len(weights)), weights, None, 1.0))
    meshes = np.stack(
        [
            flame_forward(sequence.model, sequence.shape, frame, sequence.static_offset)
            for frame in frames
        ]
    )
    alone, pairs = meshes[1 : 1 + COUNT] - meshes[0], meshes[1 + COUNT :] - meshes[0]
    pairs = pairs - alone[PRODUCTS] - alone[JAW_OPEN]
    pairs[PRODUCTS == JAW_OPEN] = 0
    return alone, pairs


def add_shapes(head: Any, found: HeadMap, alone: np.ndarray, pairs: np.ndarray) -> None:
    """Give a FLAME head the shape keys of `head_shapes`, beside its own animation; those of
    products are driven. Sliders that it has already keep their values and keyframes."""
    keys = head.data.shape_keys
    basis = key_points(keys.reference_key)
    named = list(zip(ARKIT_SHAPES, alone, strict=True))
    named += [
        (f"{ARKIT_SHAPES[column]} * jawOpen", displacement)
        for column, displacement in zip(PRODUCTS.tolist(), pairs, strict=True)
        if np.abs(displacement).max() > NEGLIGIBLE_M
    ]
    for name, displacement in named:
        key = keys.key_blocks.get(name)
        if key is None:
            key = head.shape_key_add(name=name, from_mix=False)
            key.value = 0.0  # a key made from a script starts at 1
            factors = [(keys, key_value_path(factor)) for factor in name.split(" * ")]
            if len(factors) == 2:
                variables = dict(zip("ab", factors, strict=True))
                add_driver(keys, key_value_path(name), -1, "a*b", variables)
        key.points.foreach_set("co", flat_floats(basis + displacement))
    rows = np.zeros((len(found.expressions), found.expressions.shape[1] + 9))
    rows[:, :-9] = found.expressions
    rows[:COUNT, -9:] = np.concatenate([found.jaw, found.eyes], axis=1)
    head[ARKIT_MAP] = rows.ravel().tolist()


def shape_parameters(head: Any) -> np.ndarray | None:
    """(E + 9,) expression, and axis-angles of jaw and eyes, that the sliders of `add_shapes` stand
    for; None without them."""
    if not has_shapes(head):
        return None
    keys = head.data.shape_keys.key_blocks
    weights = np.array([[keys[name].value if name in keys else 0.0 for name in ARKIT_SHAPES]])
    found = features(weights)[0]
    return np.asarray(found @ np.reshape(head[ARKIT_MAP], (len(found), -1)))


def key_shapes(head: Any, start: int, weights: np.ndarray) -> None:
    """Add keyframes of weights (T, 52), one row per Blender frame from `start` on, to the action of
    a head's shape keys."""
    paths = {column: key_value_path(name) for name, column in COLUMN.items()}
    _write_weights(action_curves(head.data.shape_keys), paths, start, weights)


def shape_key_names(head: Any) -> dict[int, str]:
    """Column of the 52 -> shape key that has its name in any spelling."""
    keys = head.data.shape_keys if head.type == "MESH" else None
    blocks = [] if keys is None else [block.name for block in keys.key_blocks[1:]]
    return {COLUMN[name]: block for block in reversed(blocks) if (name := arkit_name(block))}


def apply_weights(
    owner: Any,
    paths: dict[int, str],
    weights: np.ndarray,
    start: int,
    name: str,
    as_strip: bool = False,
) -> None:
    """Animate the values at `paths` (column -> data path) of the data-block `owner` by weights (T,
    52), one row per Blender frame from `start` on.

    The previous animation is kept as `rig.motion.apply_motion` keeps it. Raises StgaError as
    `check_keyable` does.
    """
    check_keyable(owner)
    replaced = set(paths.values())
    start_action(owner, f"{owner.name} {name}", lambda path: path in replaced, as_strip)
    _write_weights(action_curves(owner), paths, start, weights)
    owner.animation_data.action.use_fake_user = True
    if as_strip:
        push_down_action(owner, extrapolation="NOTHING")


def _write_weights(curves: Any, paths: dict[int, str], start: int, weights: np.ndarray) -> None:
    at = np.arange(start, start + len(weights))
    for column, path in paths.items():
        values = weights[:, column]
        # a shape that never moves: once
        keyed = slice(None) if (values != values[0]).any() else slice(1)
        write_curve(curves, path, 0, at[keyed], values[keyed])


def checked_shape_keys(head: Any) -> dict[int, str]:
    """Column -> data path of the keys with ARKit names. Raises StgaError without any."""
    names = shape_key_names(head)
    if not names:
        raise StgaError(
            f"{head.name}: has neither a FLAME rig nor shape keys with ARKit's names (jawOpen)"
        )
    return {column: key_value_path(name) for column, name in names.items()}
