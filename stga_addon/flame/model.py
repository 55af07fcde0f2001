"""FLAME head models: template, blend shapes, skeleton of five joints, regions of triangles."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ..errors import StgaError
from ..files import NpzFile, converted, file_digest, open_npz
from .unpickle import read_pickled_arrays

Arrays = Mapping[str, np.ndarray]
"""Name -> array of a model's or a motion's file."""
Shape = tuple[int | None, ...]
"""Expected sizes of an array; None: any number of them."""
JOINTS = ("root", "neck", "jaw", "left_eye", "right_eye")
"""FLAME's joints, in its order."""
POSE_FEATURES = 9 * (len(JOINTS) - 1)
"""Numbers that drive FLAME's pose correctives: 3x3 rotations of all joints but the root."""
FULL_COMPONENTS = 400
"""Identity and expression components of the published FLAME 2020 and 2023."""
FULL_IDENTITY = 300
"""How many of these are identity components, which come first."""

MASK_FILE = "FLAME_masks.pkl"
"""File of vertex masks that FLAME's authors publish, looked for beside the model."""

MASK_PREFIX = "masks/"
"""Prefix of the vertex masks that an npz model may carry itself."""
MAX_MODEL_NUMBERS = 1 << 25
"""Numbers of a head model with all that is filled in, each 8 bytes in memory: five times FLAME."""
FILLED_NUMBERS_PER_VERTEX = 3 * POSE_FEATURES + 2 * len(JOINTS)
"""Correctives, joint regressor and skinning weights, which a file may leave out."""
TEMPLATE_KEYS = ("v_template", "mean")
"""Keys of the neutral head, in FLAME's form and in a linear model's."""
MODEL_KEYS = ("v_template", "shapedirs", "posedirs", "J_regressor", "kintree_table", "weights", "f")
"""Arrays of a FLAME model."""
BUNDLED_HEAD = Path(__file__).with_name("head.npz")
"""The head model of this package: ICT-FaceKit (MIT License, Copyright (c) 2020 USC Institute for
Creative Technologies) in FLAME's form, made by `development/bundled_head.py`."""
EXPRESSION_NAMES = "expression_names"
"""Key of the names in model files, and in motions of the bundled head."""
SHAPE_STEP_M = 1e-5
"""Step of the whole numbers `shape_steps` (K, V, 3), which a file may have in place of
shapedirs."""
EYEBALL_WEIGHT = 0.9
"""Skinning weight by an eye's joint, above which a vertex belongs to the eyeball."""
MIN_TORSO_WEIGHT = 0.7
"""Skinning weight of the root joint at the torso; the published FLAME's last ring has 0.9."""


@dataclass(frozen=True)
class FlameModel:
    """FLAME's parameters as float64 arrays; V vertices, F triangles, K shape components, joints as
    in `JOINTS`.

    v_template   (V, 3) meters
    shapedirs    (V, 3, K): the first `n_identity` are identity, the others expression
    posedirs     (V, 3, 36): correctives, linear in the entries of the rotations of joints 1 to 4
                 minus identity
    j_regressor  (5, V): shaped vertices to joint positions
    parents      (5,) int, -1 for the root
    weights      (V, 5) skinning weights
    faces        (F, 3) int32
    masks        region name -> vertex ids
    has_found_masks  whether these are of no file, but found on the mesh
    expression_names  ARKit's name of each expression, whose coefficient is then a weight from 0 to
                      1; else ()
    file_digest  SHA-256 of the file; "": of none
    """

    v_template: np.ndarray
    shapedirs: np.ndarray
    n_identity: int
    posedirs: np.ndarray
    j_regressor: np.ndarray
    parents: np.ndarray
    weights: np.ndarray
    faces: np.ndarray
    masks: Mapping[str, np.ndarray] = field(default_factory=dict)
    expression_names: tuple[str, ...] = ()
    has_found_masks: bool = False
    file_digest: str = ""

    @property
    def n_expression(self) -> int:
        """Number of expression components."""
        return int(self.shapedirs.shape[2]) - self.n_identity


def read_flame(path: Path) -> FlameModel:
    """Read a FLAME model from the published .pkl or from an .npz with the same keys.

    Vertex masks come from an npz model's own `masks/<region>` entries, else from FLAME_masks.pkl
    beside the model where there is one. Any sizes that agree with each other are accepted. An npz
    may name its expressions (`expression_names`), have `shape_steps` in place of shapedirs, and no
    posedirs. Raises StgaError naming the file and key that is missing, of the wrong shape or not
    finite, and any class in a pickle that is not an array.
    """
    arrays, digest = _model_arrays(path)
    model = model_of(path, arrays)
    masks = _masks(path, arrays, len(model.v_template))
    return replace(model, masks=masks, file_digest=digest)


def model_of(path: Path, arrays: Arrays) -> FlameModel:
    """The model in the arrays of a file, without masks, as `read_flame` reads it; errors name
    `path`."""
    for key in MODEL_KEYS:
        if key not in arrays:
            raise StgaError(f"{path}: has no {key}, which a FLAME model needs")
        if not arrays[key].size:
            raise StgaError(f"{path}: {key} is empty")
    _check_size(path, arrays)
    template = finite(path, arrays, "v_template", (None, 3))
    vertices = len(template)
    shapedirs = finite(path, arrays, "shapedirs", (vertices, 3, None))
    n_identity = _identity_count(path, arrays, shapedirs.shape[2])
    return FlameModel(
        v_template=template,
        shapedirs=shapedirs,
        n_identity=n_identity,
        posedirs=finite(path, arrays, "posedirs", (vertices, 3, POSE_FEATURES)),
        j_regressor=finite(path, arrays, "J_regressor", (len(JOINTS), vertices)),
        parents=_parents(path, arrays),
        weights=finite(path, arrays, "weights", (vertices, len(JOINTS))),
        faces=_faces(path, arrays, vertices),
        expression_names=_expression_names(path, arrays, shapedirs.shape[2] - n_identity),
    )


def _model_arrays(path: Path) -> tuple[Arrays, str]:
    """Those of MODEL_KEYS, what else the file has of a model, and the file's digest."""
    if path.suffix.lower() == ".npz":
        keys = (*MODEL_KEYS, "n_identity", "shape_steps", EXPRESSION_NAMES)
        with open_npz(path) as file:
            digest = file.digest()
            arrays = model_arrays(file, keys)
        if "shape_steps" in arrays and "v_template" in arrays:
            steps = finite(path, arrays, "shape_steps", (None, len(arrays["v_template"]), 3))
            arrays["shapedirs"] = np.moveaxis(SHAPE_STEP_M * steps, 0, -1)
        if "v_template" in arrays:
            arrays.setdefault("posedirs", np.zeros((len(arrays["v_template"]), 3, POSE_FEATURES)))
    else:
        arrays = read_pickled_arrays(path, (*MODEL_KEYS, "n_identity"))  # which refuses pipes
        digest = file_digest(path)
    return arrays, digest


def model_arrays(file: NpzFile, names: Collection[str]) -> dict[str, np.ndarray]:
    """Arrays of a head model, `names` and vertex masks. Raises StgaError before it is unpacked
    where a model of these would have more than MAX_MODEL_NUMBERS."""
    outlines = file.outlines()
    chosen = [name for name in outlines if name in names or name.startswith(MASK_PREFIX)]
    _check_size(file.path, {name: outlines[name] for name in chosen})
    return file.arrays(chosen)


def _check_size(path: Path, arrays: Arrays) -> None:
    template = next((arrays[name] for name in TEMPLATE_KEYS if name in arrays), np.zeros(0))
    vertices = len(template) if template.ndim else 0
    numbers = sum(array.size for array in arrays.values()) + FILLED_NUMBERS_PER_VERTEX * vertices
    if numbers > MAX_MODEL_NUMBERS:
        problem = f"is a head model of {numbers} numbers; expected up to {MAX_MODEL_NUMBERS}"
        raise StgaError(f"{path}: {problem}")


def _identity_count(path: Path, arrays: Arrays, components: int) -> int:
    if components == FULL_COMPONENTS:
        return FULL_IDENTITY
    if "n_identity" not in arrays:
        return components * 3 // 4
    given = _integers(path, "n_identity", arrays["n_identity"]).ravel().tolist()
    if len(given) != 1 or not 0 <= given[0] <= components:
        expected = f"one number from 0 to {components}"
        found = arrays["n_identity"].tolist()
        raise StgaError(f"{path}: n_identity is {found}, expected {expected}")
    return int(given[0])


def _parents(path: Path, arrays: Arrays) -> np.ndarray:
    _check_shape(path, "kintree_table", arrays["kintree_table"], (2, len(JOINTS)))
    parents = np.array(_integers(path, "kintree_table", arrays["kintree_table"])[0], np.int64)
    parents[0] = -1  # the published files write the root's parent as 2**32 - 1
    if not all(0 <= parent < joint for joint, parent in enumerate(parents.tolist()) if joint):
        wrong = f"names the parents {parents.tolist()}, expected each before its child"
        raise StgaError(f"{path}: kintree_table {wrong}")
    return parents


def _faces(path: Path, arrays: Arrays, vertices: int) -> np.ndarray:
    _check_shape(path, "f", arrays["f"], (None, 3))
    faces = _integers(path, "f", arrays["f"]).astype(np.int64)
    if faces.min() < 0 or faces.max() >= vertices:
        expected = f"expected 0 to {vertices - 1}"
        raise StgaError(f"{path}: f names vertices {faces.min()} to {faces.max()}, {expected}")
    return faces.astype(np.int32)


def _expression_names(path: Path, arrays: Arrays, count: int) -> tuple[str, ...]:
    names = arrays.get(EXPRESSION_NAMES, np.zeros(0, "U1"))
    named = names.dtype.kind == "U" and len(set(names.ravel().tolist())) == count
    if EXPRESSION_NAMES in arrays and not (named and names.shape == (count,)):
        expected = f"expected {count} different names, one per expression"
        raise StgaError(f"{path}: {EXPRESSION_NAMES}: {expected}")
    return tuple(names.tolist())


def _check_shape(path: Path, key: str, array: np.ndarray, expected: Shape) -> None:
    sizes = zip(expected, array.shape, strict=False)
    if array.ndim != len(expected) or any(want not in (None, size) for want, size in sizes):
        wanted = ", ".join("any" if size is None else str(size) for size in expected)
        raise StgaError(f"{path}: {key} has shape {array.shape}, expected ({wanted})")


def floats(
    path: Path,
    arrays: Arrays,
    key: str,
    expected: Shape,
    kinds: str = "iuf",
    numbers: str = "numbers",
) -> np.ndarray:
    """An array of a file as float64, finite or not. Raises StgaError where it is missing, has not
    the expected shape, or is of no dtype of these kinds, which are `numbers`."""
    if key not in arrays:
        raise StgaError(f"{path}: has no {key}")
    array = arrays[key]
    _check_shape(path, key, array, expected)
    if array.dtype.kind not in kinds:
        raise StgaError(f"{path}: {key} holds {array.dtype}, expected {numbers}")
    return np.ascontiguousarray(converted(array, np.float64))


def finite(path: Path, arrays: Arrays, key: str, expected: Shape) -> np.ndarray:
    """`floats` that are finite. Raises StgaError where one is not."""
    values = floats(path, arrays, key, expected)
    if not np.isfinite(values).all():
        raise StgaError(f"{path}: {key} holds values that are not finite")
    return values


def _integers(path: Path, key: str, array: np.ndarray) -> np.ndarray:
    if array.dtype.kind == "f" and (abs(array) < 2**53).all() and (array == np.round(array)).all():
        array = array.astype(np.int64)
    if array.dtype.kind not in "iu":
        raise StgaError(f"{path}: {key} holds {array.dtype}, expected whole numbers")
    return array


def _masks(path: Path, arrays: Arrays, vertices: int) -> dict[str, np.ndarray]:
    named = {key: value for key, value in arrays.items() if key.startswith(MASK_PREFIX)}
    found = {key.removeprefix(MASK_PREFIX): value for key, value in named.items()}
    source = path
    beside = path.with_name(MASK_FILE)
    if not found and beside.is_file():
        source = beside
        found = read_pickled_arrays(beside)
    masks = {}
    for name, ids in found.items():
        flat = _integers(source, name, ids).astype(np.int64)
        if flat.ndim != 1 or (flat.size and not 0 <= flat.min() <= flat.max() < vertices):
            expected = f"a list of vertex ids from 0 to {vertices - 1}"
            raise StgaError(f"{source}: mask {name} is not {expected}")
        masks[name] = np.unique(flat)
    return masks


def faces_within(faces: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """(F,) bool: triangles (F, 3) whose three corners are all among `vertices` (ids)."""
    return np.isin(faces, vertices).all(axis=1)


def torso_faces(model: FlameModel) -> np.ndarray:
    """(F,) bool: triangles at the end of the neck, which the root joint carries."""
    torso = model.weights[:, JOINTS.index("root")] > MIN_TORSO_WEIGHT
    return torso[model.faces].all(axis=1)
