"""ARKit's 52 shapes: controls on a FLAME rig, and heads with shape keys of these names."""

from typing import Any

import numpy as np

from ...driving.head_map import PRODUCTS, HeadMap
from ...driving.performance import ARKIT_SHAPES, COLUMN, COUNT, arkit_name
from ...driving.shapes import MOUTH_CLOSE
from ...errors import StgaError
from ..arrays import add_driver, write_curve
from ..compat import action_curves, push_down_action
from .keyframes import (
    check_keyable,
    expression_key,
    key_turns,
    key_value_path,
    property_path,
    rotation_path,
    start_action,
)

SUMS = "stga_arkit_sums"
"""Property of the rig: partial sums of the expressions, and the axis-angles of jaw and eyes."""
JOINT_ROWS = {"jaw": (0, 1, 2), "left_eye": (3, 4, 5), "right_eye": (6, 7, 8)}
MAX_EXPRESSION = 255
"""Characters of a driver's expression, by Blender's limit."""
VARIABLES = "abcdefghijklmnpqrstuvwxyz"
"""Of the shapes in a partial sum; o is jawOpen."""
NEGLIGIBLE = 1e-4
"""Coefficient of a shape that is left out of an expression's sum."""


def has_controls(rig: Any) -> bool:
    """Whether a rig has the 52 controls."""
    return SUMS in rig


def add_controls(head: Any, rig: Any, found: HeadMap) -> None:
    """Add a slider per ARKit shape to the rig, which drives expressions, jaw and eyes by arithmetic
    alone.

    Driven sliders and bones take their values from the controls, not from keyframes;
    `remove_controls` gives them back. Controls that are there already keep their values and
    keyframes.
    """
    remove_drivers(head, rig)
    for name, reach in zip(ARKIT_SHAPES, found.reach.tolist(), strict=True):
        if name not in rig:
            rig[name] = 0.0
        rig.id_properties_ui(name).update(
            min=-1.0, max=2.0, soft_min=0.0, soft_max=1.0, default=0.0,
            description=f"ARKit's {name}; this head does {100 * reach:.0f} % of it",
        )  # fmt: skip
    linear = np.concatenate([found.expressions[:COUNT], found.jaw, found.eyes], axis=1)
    products = np.zeros_like(linear)
    products[PRODUCTS, : found.expressions.shape[1]] = found.expressions[COUNT:]
    parts = [_parts(linear[:, column], products[:, column]) for column in range(linear.shape[1])]
    rig[SUMS] = [0.0] * sum(map(len, parts))
    slot, sums = 0, list[dict[str, tuple[Any, str]]]()
    for column_parts in parts:
        sums.append({})
        for letter, (text, columns) in zip(VARIABLES, column_parts, strict=False):
            shapes = ["jawOpen", *(ARKIT_SHAPES[column] for column in columns)]
            sources = [(rig, property_path(shape)) for shape in shapes]
            variables = dict(zip("o" + VARIABLES, sources, strict=False))
            add_driver(rig, property_path(SUMS), slot, text, variables)
            sums[-1][letter] = rig, f"{property_path(SUMS)}[{slot}]"
            slot += 1
    count, keys = found.expressions.shape[1], head.data.shape_keys
    for component, variables in enumerate(sums[:count]):
        key = expression_key(head, component)
        if variables and key in keys.key_blocks:
            add_driver(keys, key_value_path(key), -1, "+".join(variables), variables)
    for joint, rows in JOINT_ROWS.items():
        # A quaternion by its axis-angle, each of whose components is at most one sum.
        terms = zip("abc", (sums[count + row] for row in rows), strict=True)
        variables = {letter: term["a"] for letter, term in terms if term}
        if variables:
            squared = "+".join(f"{letter}*{letter}" for letter in variables)
            length, path = f"sqrt({squared}+1e-12)", rotation_path(joint)
            add_driver(rig, path, 0, f"cos({length}/2)", variables)
            for element, letter in enumerate("abc", 1):
                text = f"{letter}*sin({length}/2)/{length}" if letter in variables else "0"
                add_driver(rig, path, element, text, variables)


def remove_controls(head: Any, rig: Any) -> None:
    """Remove the controls: expressions, jaw and eyes play their own again."""
    remove_drivers(head, rig)
    if rig.animation_data is not None and rig.animation_data.action is not None:
        curves, controls = action_curves(rig), control_paths().values()
        for curve in [curve for curve in curves if curve.data_path in controls]:
            curves.remove(curve)
    for name in ARKIT_SHAPES:
        rig.pop(name, None)


def remove_drivers(head: Any, rig: Any) -> None:
    """Remove the drivers of `add_controls`, where there are any."""
    if not has_controls(rig):
        return
    for owner in (rig, head.data.shape_keys):
        for driver in [] if owner.animation_data is None else list(owner.animation_data.drivers):
            paths = [target.data_path for v in driver.driver.variables for target in v.targets]
            if any(path.startswith(property_path(SUMS)) for path in [driver.data_path, *paths]):
                owner.animation_data.drivers.remove(driver)
    del rig[SUMS]


def shape_key_names(head: Any) -> dict[int, str]:
    """Column of the 52 -> shape key that has its name in any spelling."""
    keys = head.data.shape_keys if head.type == "MESH" else None
    blocks = [] if keys is None else [block.name for block in keys.key_blocks[1:]]
    return {COLUMN[name]: block for block in reversed(blocks) if (name := arkit_name(block))}


def apply_weights(
    owner: Any, paths: dict[int, str], weights: np.ndarray, start: int, name: str,
    as_strip: bool = False, neck: np.ndarray | None = None,
) -> None:  # fmt: skip
    """Animate the values at `paths` (column -> data path) of the data-block `owner` by weights (T,
    52), one row per Blender frame from `start` on.

    neck  (T, 3) axis-angle of the neck, where the owner is a rig; None: it keeps its own animation
    The previous animation is kept as `rig.motion.apply_motion` keeps it. Raises StgaError as
    `check_keyable` does.
    """
    bones = [] if neck is None else ["neck"]
    check_keyable(owner, bones)
    replaced = {*paths.values(), *map(rotation_path, bones)}
    start_action(owner, f"{owner.name} {name}", lambda path: path in replaced, as_strip)
    numbers = range(start, start + len(weights))
    curves, at = action_curves(owner), np.asarray(numbers)
    for column, path in paths.items():
        values = weights[:, column]
        # a shape that never moves: once
        keyed = slice(None) if (values != values[0]).any() else slice(1)
        write_curve(curves, path, 0, at[keyed], values[keyed])
    if neck is not None:
        key_turns(owner, "neck", numbers, neck)
    owner.animation_data.action.use_fake_user = True
    if as_strip:
        push_down_action(owner, extrapolation="NOTHING")


def control_paths() -> dict[int, str]:
    """Column of the 52 -> data path of its control on the rig."""
    return {column: property_path(name) for name, column in COLUMN.items()}


def checked_shape_keys(head: Any) -> dict[int, str]:
    """Column -> data path of the keys with ARKit names. Raises StgaError without any."""
    names = shape_key_names(head)
    if not names:
        raise StgaError(
            f"{head.name}: has neither a FLAME rig nor shape keys with ARKit's names (jawOpen)"
        )
    return {column: key_value_path(name) for column, name in names.items()}


def _parts(linear: np.ndarray, products: np.ndarray) -> list[tuple[str, list[int]]]:
    """Expressions within Blender's limit that add up to a parameter, and their variables."""
    found: list[tuple[str, list[int]]] = []
    text = ""
    columns: list[int] = []
    for column in np.flatnonzero(np.abs(linear) + np.abs(products) > NEGLIGIBLE).tolist():
        factor, product = float(linear[column]), float(products[column])
        for _ in range(2):
            variable = VARIABLES[len(columns)]
            # mouthClose counts up to jawOpen (`effective_weights`).
            value = f"min({variable},max(o,0))" if column == MOUTH_CLOSE else variable
            term = f"{factor:+.4e}*{value}"
            if abs(product) > NEGLIGIBLE:
                term = f"+{value}*({factor:.4e}{product:+.4e}*o)"
            if len(text) + len(term) <= MAX_EXPRESSION and len(columns) + 1 < len(VARIABLES):
                break
            found.append((text, columns))
            text, columns = "", []
        text, columns = text + term, [*columns, column]
    return [*found, (text, columns)] if columns else found
