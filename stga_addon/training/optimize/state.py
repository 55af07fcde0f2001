"""State of the splats in training: parameters, moments, statistics for density control."""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from ...avatar.file import Avatar
from ...avatar.splats import Splats
from ...avatar.strain import STRAIN_COMPONENTS
from ...raster.cpu.layout import Parameters, rows_by_triangle
from ...raster.cpu.optimizer import AdamTables


@dataclass
class OffsetState:
    """Coefficients of a driven offset (`Avatar.driven_offsets`) of a mesh's F triangles in
    training: as in `TrainState`, (F, 3, 3) float32 and (F,) int32."""

    value: np.ndarray
    first: np.ndarray
    second: np.ndarray
    average: np.ndarray
    steps: np.ndarray


def new_offset(coefficients: np.ndarray) -> OffsetState:
    """A copy of coefficients (F, 3, 3), with zero moments."""
    value = np.array(coefficients, np.float32)
    zeros = np.zeros_like(value)
    steps = np.zeros(len(value), np.int32)
    return OffsetState(value, zeros, zeros.copy(), value.copy(), steps)


@dataclass
class TrainState:
    """N splats in training: arrays with N rows each.

    parameters, gradients, first, second  values, latest gradients and Adam's two moments, shaped as
                                          in `Splats`
    average  exponential moving average of the parameters over their steps, from which the avatar is
             made
    steps    (N,) int32 Adam steps per row
    face, unbound    (N,) int32 and (N,) bool, as in `Splats`
    unseen_share     (N,) float32 fraction of the cameras that did not see an unbound splat where
                     training put it or its parent; 0 for bound splats
    screen_gradient  (N,) float32 sum of screen-space gradient lengths since the latest density
                     control
    gradient_count   (N,) float32 number of summands
    driven_offsets   by name, of the mesh's triangles, not of the splats
    """

    parameters: Parameters
    gradients: Parameters
    first: Parameters
    second: Parameters
    average: Parameters
    steps: np.ndarray
    face: np.ndarray
    unbound: np.ndarray
    unseen_share: np.ndarray
    screen_gradient: np.ndarray
    gradient_count: np.ndarray
    driven_offsets: dict[str, OffsetState] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.steps)

    @cached_property
    def tables(self) -> dict[str, AdamTables]:
        """Parameter -> values, gradient, moments, average as views (N, D); room for rates (D,)."""
        kept = self.parameters, self.gradients, self.first, self.second, self.average
        found = {}
        for name, arrays in zip(self.parameters._fields, zip(*kept, strict=True), strict=True):
            tables = [array.reshape(len(array), math.prod(array.shape[1:])) for array in arrays]
            found[name] = AdamTables._make((*tables, np.empty(tables[0].shape[1], np.float32)))
        return found

    @cached_property
    def rows_by_triangle(self) -> tuple[np.ndarray, np.ndarray]:
        """The rows of the splats on each triangle that a driven offset moves."""
        triangles = len(next(iter(self.driven_offsets.values())).steps)
        return rows_by_triangle(self.face, triangles)

    @cached_property
    def has_unseen(self) -> bool:
        """Whether a splat has a fraction of cameras that did not see it."""
        return bool(self.unseen_share.any())

    def splats(self, averaged: bool = False) -> Splats:
        """A copy of the current splats, or of their exponential moving average."""
        kept = self.average if averaged else self.parameters
        arrays = {name: array.copy() for name, array in kept._asdict().items()}
        return Splats(**arrays, face=self.face.copy(), unbound=self.unbound.copy())


_SPLAT_FIELDS = [field.name for field in fields(TrainState) if field.name != "driven_offsets"]
_HARMONICS = [f"{kind}/sh" for kind in ("parameters", "gradients", "first", "second", "average")]


def new_state(splats: Splats, unseen_share: np.ndarray | None = None) -> TrainState:
    """A copy of the splats with zero moments; unseen_share (N,), zeros if None."""
    values = [getattr(splats, name).astype(np.float32, order="C") for name in Parameters._fields]
    gradients, first, second = (Parameters(*map(np.zeros_like, values)) for _ in range(3))
    fraction, screen, count = np.zeros((3, len(splats)), np.float32)
    if unseen_share is not None:
        fraction = unseen_share.astype(np.float32)
    average = Parameters(*(v.copy() for v in values))
    steps = np.zeros(len(splats), np.int32)
    return TrainState(
        Parameters(*values),
        gradients,
        first,
        second,
        average,
        steps,
        splats.face.astype(np.int32),
        splats.unbound.astype(bool),
        fraction,
        screen,
        count,
    )


def state_of_avatar(avatar: Avatar) -> TrainState:
    """A copy of an avatar's splats, as trained, and driven offsets with zero moments."""
    offsets = {name: new_offset(values) for name, values in avatar.driven_offsets.items()}
    return replace(new_state(avatar.as_trained.splats), driven_offsets=offsets)


def keep_rows(state: TrainState, keep: np.ndarray) -> TrainState:
    """The rows at `keep`, a mask (N,) or indices, of every array."""
    kept = state_of({name: array[keep] for name, array in arrays_of(state).items()})
    return replace(kept, driven_offsets=state.driven_offsets)


def opacity_of(logit: np.ndarray) -> np.ndarray:
    """(N,) float64 opacity 0…1 of logits (N,)."""
    return np.asarray(1 / (1 + np.exp(-logit.astype(np.float64))))


PRUNED_BY = ("face", "unbound", "parameters/opacity")
"""Columns that `prunable` needs."""


def prunable(columns: Mapping[str, np.ndarray], unwanted: np.ndarray) -> np.ndarray:
    """(N,) bool: the unwanted splats (N,) bool; a triangle that would lose all bound ones keeps the
    most opaque."""
    face = columns["face"]
    opacity = columns["parameters/opacity"]
    bound = np.flatnonzero(~columns["unbound"])
    order = bound[np.lexsort((-opacity[bound], unwanted[bound], face[bound]))]
    first = np.ones(len(order), bool)
    first[1:] = face[order][1:] != face[order][:-1]
    prunable = unwanted.copy()
    prunable[order[first]] = False
    return prunable


def with_offsets(state: TrainState, offsets: Collection[str], triangles: int) -> TrainState:
    """The state with these driven offsets of so many triangles, too; those that it lacked begin by
    zero."""
    zeros = {name: new_offset(np.zeros((triangles, STRAIN_COMPONENTS, 3))) for name in offsets}
    return replace(state, driven_offsets={**zeros, **state.driven_offsets})


def assign_rows(
    state: TrainState, rows: np.ndarray, values: Mapping[str, np.ndarray | float]
) -> None:
    """Write to rows of the columns of `columns_of`, in place."""
    columns = columns_of(state)
    for name, value in values.items():
        columns[name][rows] = value


def columns_of(state: TrainState) -> dict[str, np.ndarray]:
    """The arrays of `arrays_of`, and the constant coefficients of harmonics alone, such as
    "average/color" (N, 3), as views."""
    columns = arrays_of(state)
    for name in _HARMONICS:
        columns[name.removesuffix("sh") + "color"] = columns[name][:, 0]
    return columns


def parameters_and_average(values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray | float]:
    """The columns that give splats these values at once, in the avatar as well."""
    kinds = ("parameters", "average")
    return {f"{kind}/{name}": value for kind in kinds for name, value in values.items()}


def arrays_of(state: TrainState) -> dict[str, np.ndarray]:
    """The splats' arrays by a flat name such as "first/xyz"; inverse of `state_of`."""
    flat = {}
    for name in _SPLAT_FIELDS:
        value = getattr(state, name)
        if isinstance(value, np.ndarray):
            flat[name] = value
        else:
            flat.update({f"{name}/{part}": array for part, array in value._asdict().items()})
    return flat


def state_of(arrays: Mapping[str, np.ndarray]) -> TrainState:
    """Rebuild a state from `arrays_of`. Raises KeyError with the name of a missing array."""
    values: dict[str, Any] = {}
    for name in _SPLAT_FIELDS:
        values[name] = (
            arrays[name]
            if name in arrays
            else Parameters(*(arrays[f"{name}/{part}"] for part in Parameters._fields))
        )
    return TrainState(**values)
