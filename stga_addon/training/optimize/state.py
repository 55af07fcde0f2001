"""State of the splats in training: parameters, optimizer moments and statistics for density
control."""

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import Field, dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np

from ...avatar.offsets import OFFSETS
from ...avatar.splats import ADDED, Splats
from ...raster.cpu.layout import Parameters
from ...raster.cpu.optimizer import AdamTables


@dataclass
class OffsetState:
    """Coefficients of a driven offset (`Avatar.driven_offsets`) of a mesh's F triangles in
    training.

    value, first, second, average  (F, S, 3) float32 coefficients, Adam's two moments, and the
                                   exponential moving average from which the avatar is made
    steps                          (F,) int32 Adam steps of each triangle
    """

    value: np.ndarray
    first: np.ndarray
    second: np.ndarray
    average: np.ndarray
    steps: np.ndarray


def new_offset(coefficients: np.ndarray) -> OffsetState:
    """A copy of coefficients (F, S, 3), with zero moments."""
    value = np.array(coefficients, np.float32)
    zeros, steps = np.zeros_like(value), np.zeros(len(value), np.int32)
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
    unseen_share     (N,) float32 share of the cameras that did not see an unbound splat where
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
        """Parameter -> its values, gradient, moments and average as views (N, D), and room for
        learning rates (D,)."""
        kept = self.parameters, self.gradients, self.first, self.second, self.average
        found = {}
        for name, arrays in zip(self.parameters._fields, zip(*kept, strict=True), strict=True):
            tables = [array.reshape(len(array), math.prod(array.shape[1:])) for array in arrays]
            found[name] = AdamTables._make((*tables, np.empty(tables[0].shape[1], np.float32)))
        return found

    @cached_property
    def has_unseen(self) -> bool:
        """Whether a splat has a share of cameras that did not see it."""
        return bool(self.unseen_share.any())

    def splats(self) -> Splats:
        """A copy of the current splats."""
        return self._copy(self.parameters)

    def averaged(self) -> Splats:
        """A copy of the splats' exponential moving average."""
        return self._copy(self.average)

    def _copy(self, parameters: Parameters) -> Splats:
        arrays = {name: array.copy() for name, array in parameters._asdict().items()}
        return Splats(**arrays, face=self.face.copy(), unbound=self.unbound.copy())


def new_state(splats: Splats, unseen_share: np.ndarray | None = None) -> TrainState:
    """A copy of the splats with zero moments; unseen_share (N,), zeros if None."""
    values = [getattr(splats, name).astype(np.float32, order="C") for name in Parameters._fields]
    n = len(splats)

    def zeros() -> Parameters:
        return Parameters(*map(np.zeros_like, values))

    return TrainState(
        parameters=Parameters(*values),
        gradients=zeros(),
        first=zeros(),
        second=zeros(),
        average=Parameters(*(v.copy() for v in values)),
        steps=np.zeros(n, np.int32),
        face=splats.face.astype(np.int32),
        unbound=splats.unbound.astype(bool),
        unseen_share=np.zeros(n, np.float32)
        if unseen_share is None
        else unseen_share.astype(np.float32),
        screen_gradient=np.zeros(n, np.float32),
        gradient_count=np.zeros(n, np.float32),
    )


def keep_rows(state: TrainState, keep: np.ndarray) -> TrainState:
    """The rows at `keep`, a mask (N,) or indices, of every array."""
    return _map(lambda arrays: arrays[0][keep], state)


def with_added(state: TrainState, names: Collection[str]) -> TrainState:
    """The state with these arrays of ADDED; they and their moments are zero where there were
    none."""
    zeros = {name: np.zeros((len(state), ADDED[name], 3), np.float32) for name in names}
    zeros = {
        name: array for name, array in zeros.items() if not getattr(state.parameters, name).shape[1]
    }

    def added(arrays: Parameters) -> Parameters:
        return arrays._replace(**{name: array.copy() for name, array in zeros.items()})

    return replace(
        state,
        parameters=added(state.parameters),
        gradients=added(state.gradients),
        first=added(state.first),
        second=added(state.second),
        average=added(state.average),
    )


def with_offsets(state: TrainState, names: Collection[str], triangles: int) -> TrainState:
    """The state with these driven offsets of so many triangles too; those that it lacked begin by
    zero."""
    zeros = {
        name: new_offset(np.zeros((triangles, OFFSETS[name].signals, 3), np.float32))
        for name in names
    }
    return replace(state, driven_offsets={**zeros, **state.driven_offsets})


def join(state: TrainState, other: TrainState) -> TrainState:
    """All rows of both states, in order."""
    return _map(np.concatenate, state, other)


def arrays_of(state: TrainState) -> dict[str, np.ndarray]:
    """Every array of the splats under a flat name such as "first/xyz"; the inverse of
    `state_of`."""
    flat = {}
    for f in _splat_fields():
        value = getattr(state, f.name)
        if isinstance(value, np.ndarray):
            flat[f.name] = value
        else:
            flat.update({f"{f.name}/{name}": array for name, array in value._asdict().items()})
    return flat


def state_of(arrays: Mapping[str, np.ndarray]) -> TrainState:
    """Rebuild a state from `arrays_of`. Raises KeyError with the name of a missing array."""
    values: dict[str, Any] = {}
    for f in _splat_fields():
        if f.name in arrays:
            values[f.name] = arrays[f.name]
        else:
            values[f.name] = Parameters(
                *(arrays[f"{f.name}/{name}"] for name in Parameters._fields)
            )
    return TrainState(**values)


def _splat_fields() -> list[Field[Any]]:
    return [f for f in fields(TrainState) if f.name != "driven_offsets"]


def _map(function: Callable[[list[np.ndarray]], np.ndarray], *states: TrainState) -> TrainState:
    """The first state with other splats."""
    flat = [arrays_of(s) for s in states]
    mapped = state_of({name: function([f[name] for f in flat]) for name in flat[0]})
    return replace(mapped, driven_offsets=states[0].driven_offsets)
