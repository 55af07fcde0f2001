"""Head models that can be tracked: FLAME, any linear model in an npz, or a GLB with morph
targets."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..capture.camera import MAX_COORDINATE_M
from ..errors import StgaError
from ..files import open_npz, write_npz
from ..flame.model import JOINTS, POSE_FEATURES, FlameModel, finite, model_arrays
from ..flame.parts import flame_model
from .glb import read_glb

IDENTITY_PREFIX = "identity"
"""Begins the names of shapes that make another person; all others are expressions."""
LINEAR_KEYS = ("mean", "faces")
"""Arrays that a linear head model needs."""
LINEAR_MODEL_KEYS = (*LINEAR_KEYS, "identity", "expression", "J_regressor", "weights")
"""Arrays of a linear head model: those that it needs, and those that it may have."""
MIN_EXTENT_M = 0.1
"""Least extent of a head model along its longest axis; below, the file is in other units."""
MAX_EXTENT_M = 2.0
"""Largest extent of a head model along its longest axis."""
MAX_COMPONENT_M = 100.0
"""Displacement of a vertex by a component at coefficient 1; scales of components differ from model
to model."""
MAX_JOINT_FRACTION = 100.0
"""Largest weight of a vertex in a joint's position, and of a joint in a vertex's motion."""
MIN_JOINT_WEIGHT = 0.5  # Skinning weight that some vertex must have for a joint to count as present


@dataclass(frozen=True)
class HeadModel:
    """A head with identity and expression components, in meters, y up, looking along +z.

    model   its arrays in FLAME's form; a linear model without joints has all its weight on the root
    layout  layout of the capture to write: "flame" or "mesh"
    """

    model: FlameModel
    layout: str

    @property
    def joints(self) -> tuple[bool, ...]:
        """Which of FLAME's joints the model has; the root always."""
        present = (self.model.weights > MIN_JOINT_WEIGHT).any(axis=0)
        return (True, *(bool(value) for value in present[1:]))


def read_head_model(path: Path | None) -> HeadModel:
    """Read a FLAME model (.pkl or .npz), a linear model from an .npz, or morph targets from a .glb
    (`shape_arrays`);
    None: the bundled head.

    A linear model has `mean` (V, 3) meters and `faces` (F, 3), and optionally `identity` (V, 3, I),
    `expression` (V, 3, E), and `J_regressor` (5, V) with `weights` (V, 5) for the joints root,
    neck, jaw, left and right eye. Components are scaled so that a coefficient is of the order of 1.
    Raises StgaError naming the file and the field.
    """
    if path is None:
        return HeadModel(flame_model(None), "flame")
    suffix = path.suffix.lower()
    arrays = dict[str, np.ndarray]()
    if suffix == ".glb":
        mesh = read_glb(path)
        arrays = shape_arrays(mesh.positions, mesh.faces, mesh.names, mesh.targets)
    elif suffix == ".npz":
        with open_npz(path) as file:
            arrays = model_arrays(file, LINEAR_MODEL_KEYS)
    if "mean" in arrays:
        return checked(path, HeadModel(linear_model(path, arrays), "mesh"))
    return checked(path, HeadModel(flame_model(path), "flame"))


def shape_arrays(
    mean: np.ndarray, faces: np.ndarray, names: Sequence[str], shapes: np.ndarray
) -> dict[str, np.ndarray]:
    """The arrays of a linear model from K named displacements: mean (V, 3), faces (F, 3), shapes
    (V, 3, K)."""
    identity = np.array([name.lower().startswith(IDENTITY_PREFIX) for name in names], bool)
    return {
        "mean": mean,
        "faces": faces.astype(np.int32),
        "identity": shapes[:, :, identity],
        "expression": shapes[:, :, ~identity],
    }


def write_linear_model(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write a linear model as an npz. Raises StgaError where it is none that `read_head_model`
    would take."""
    checked(path, HeadModel(linear_model(path, arrays), "mesh"))
    small = {
        name: array.astype(np.float32) for name, array in arrays.items() if array.dtype.kind == "f"
    }
    write_npz(path, {**arrays, **small})


def linear_model(path: Path, arrays: dict[str, np.ndarray]) -> FlameModel:
    """The linear model with these arrays (`read_head_model`) in FLAME's form; `path` is named in
    errors."""
    for key in LINEAR_KEYS:
        if key not in arrays:
            raise StgaError(f"{path}: has no {key}, which a linear head model needs")
    mean = finite(path, arrays, "mean", (None, 3))
    count = len(mean)
    none = dict.fromkeys(("identity", "expression"), np.zeros((count, 3, 0)))
    bases = [finite(path, {**none, **arrays}, key, (count, 3, None)) for key in none]
    if not sum(base.shape[2] for base in bases):
        raise StgaError(
            f"{path}: has neither identity nor expression, components that a head is fitted with"
        )
    faces = arrays["faces"]
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu" or not len(faces):
        found = f"{faces.dtype} of shape {faces.shape}"
        raise StgaError(f"{path}: faces is {found}, expected whole numbers (any, 3)")
    if faces.min() < 0 or faces.max() >= count:
        found = f"{faces.min()} to {faces.max()}"
        raise StgaError(f"{path}: faces names vertices {found}, expected 0 to {count - 1}")
    given = [key for key in ("J_regressor", "weights") if key in arrays]
    if len(given) == 1:
        raise StgaError(f"{path}: has {given[0]} alone; joints need both J_regressor and weights")
    weights = np.eye(len(JOINTS))[np.zeros(count, int)]
    regressor = np.full((len(JOINTS), count), 1 / count)
    if given:
        regressor = finite(path, arrays, "J_regressor", (len(JOINTS), count))
        weights = finite(path, arrays, "weights", (count, len(JOINTS)))
    return FlameModel(
        v_template=mean,
        shapedirs=np.concatenate(bases, axis=2),
        n_identity=bases[0].shape[2],
        posedirs=np.zeros((count, 3, POSE_FEATURES)),
        j_regressor=regressor,
        parents=np.array([-1, 0, 1, 1, 1]),
        weights=weights,
        faces=np.ascontiguousarray(faces, np.int32),
    )


def checked(path: Path, head: HeadModel) -> HeadModel:
    """The head model. Raises StgaError where it is not of a head's size in meters, or holds numbers
    that none has."""
    model = head.model
    if head.layout == "flame":
        template = "v_template"
        shapes = {"shapedirs": model.shapedirs, "posedirs": model.posedirs}
    else:
        identity, expression = np.split(model.shapedirs, [model.n_identity], axis=2)
        template = "mean"
        shapes = {"identity": identity, "expression": expression}
    bounds = {
        template: (model.v_template, MAX_COORDINATE_M),
        **{name: (array, MAX_COMPONENT_M) for name, array in shapes.items()},
        "J_regressor": (model.j_regressor, MAX_JOINT_FRACTION),
        "weights": (model.weights, MAX_JOINT_FRACTION),
    }
    for name, (array, limit) in bounds.items():
        largest = float(np.abs(array).max(initial=0))
        if largest > limit:
            raise StgaError(f"{path}: {name} reaches {largest:.3g}, expected at most {limit:.0f}")
    extent = float(np.ptp(model.v_template, axis=0).max())
    if not MIN_EXTENT_M <= extent <= MAX_EXTENT_M:
        raise StgaError(
            f"{path}: the head measures {extent:.3g}, expected {MIN_EXTENT_M} to "
            f"{MAX_EXTENT_M} meters"
        )
    return head
