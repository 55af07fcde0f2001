"""Synthetic head in FLAME's format, so that demo and tests need no download.

`level` 1 is the density that a tracker fits, a higher level what the camera sees. Meters, y up, facing +z.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...files import write_npz
from ...flame.model import JOINTS, MASK_PREFIX, POSE_FEATURES, FlameModel
from .blend_shapes import IDENTITY, rigid_components, skin_components
from .head_mesh import PARTS, SkinGrid, eyeball_mesh, tooth_row_mesh
from .skin import EYE, MOUTH, ROWS, Skin, above_hairline, bump, side_sign, smooth_step

JOINT_POSITIONS = np.array([[0, -0.150, -0.035], [0, -0.075, -0.035], [0, -0.012, 0.000], EYE, EYE * [-1, 1, 1]])


@dataclass(frozen=True)
class Head:
    """A head at one density: the model, each vertex's place on the average person, and its part (index of `PARTS`)."""

    model: FlameModel
    rest: np.ndarray
    part: np.ndarray


def synthetic_flame(seed: int) -> FlameModel:
    """A made-up person in FLAME's format: 10 identity and 10 expression components (`IDENTITY`, `EXPRESSIONS`).

    About 2,100 vertices and 4,000 triangles, with vertex masks; a coefficient of 1 is one full action.
    """
    return synthetic_head(seed, 1).model


def write_flame(model: FlameModel, path: Path) -> None:
    """Write a model as .npz with FLAME's keys; `n_identity` and `masks/<region>` are stored beside them."""
    parents = model.parents.astype(np.int64) % (1 << 32)  # FLAME spells the root's parent 2**32 - 1
    arrays = {
        "v_template": model.v_template,
        "shapedirs": model.shapedirs,
        "posedirs": model.posedirs,
        "J_regressor": model.j_regressor,
        "kintree_table": np.stack([parents, np.arange(len(parents))]).astype(np.uint32),
        "weights": model.weights,
        "f": model.faces.astype(np.uint32),
        "n_identity": np.array(model.n_identity),
    }
    write_npz(path, arrays | {MASK_PREFIX + name: ids for name, ids in model.masks.items()}, compressed=True)


def synthetic_head(seed: int, level: int) -> Head:
    """The head of `synthetic_flame` with `level` times as many rows and columns; the motion is the same function."""
    grid = SkinGrid(level)
    skin, source = grid.skin, grid.source
    base, faces, part = [grid.positions], [grid.faces], [grid.part]
    directions, correctives = [skin_components(skin)[source]], [_correctives(skin)[source]]
    weights = [_skin_weights(skin)[source]]
    pieces: dict[str, np.ndarray] = {}
    start = len(grid.positions)
    for name, points, triangles, joint in (
        ("left_eyeball", *eyeball_mesh(EYE, level), "left_eye"),
        ("right_eyeball", *eyeball_mesh(EYE * [-1, 1, 1], level), "right_eye"),
        ("upper_teeth", *tooth_row_mesh(level, 1), "neck"),
        ("lower_teeth", *tooth_row_mesh(level, -1), "jaw"),
    ):
        pieces[name] = np.arange(start, start + len(points))
        base.append(points)
        faces.append(triangles + start)
        part.append(np.full(len(points), PARTS.index("eyeball" if "eye" in name else "teeth")))
        weights.append(np.tile(np.eye(len(JOINTS))[JOINTS.index(joint)], (len(points), 1)))
        correctives.append(np.zeros((len(points), 3, POSE_FEATURES)))
        directions.append(rigid_components(points.mean(0), len(points)))
        start += len(points)
    rest, shapedirs = np.concatenate(base), np.concatenate(directions)
    person = 0.6 * np.random.default_rng(seed).normal(size=len(IDENTITY))
    model = FlameModel(
        v_template=rest + shapedirs[:, :, : len(IDENTITY)] @ person,
        shapedirs=shapedirs,
        n_identity=len(IDENTITY),
        posedirs=np.concatenate(correctives),
        j_regressor=_joint_regressor(rest, grid.coarse, pieces),
        parents=np.array([-1, 0, 1, 1, 1]),
        weights=np.concatenate(weights),
        faces=np.concatenate(faces).astype(np.int32),
        masks=_masks(grid, pieces),
    )
    return Head(model, rest, np.concatenate(part))


def _skin_weights(skin: Skin) -> np.ndarray:
    """(N, 5) skinning weights: the neck carries the head, the jaw everything below the line from hinge to lips."""
    hinge = JOINT_POSITIONS[2]
    line = np.arctan2(MOUTH[1] - hinge[1], MOUTH[2] - hinge[2])
    below = line - np.arctan2(skin.y - hinge[1], np.maximum(skin.z - hinge[2], 1e-3))
    jaw = smooth_step(below, -0.22, 0.22) * smooth_step(skin.z, -0.015, 0.045) * smooth_step(skin.y, -0.135, -0.095)
    lip = np.clip(1 - (skin.x / 0.0245) ** 2, 0, 1) * np.exp(-((skin.y - MOUTH[1]) ** 2) / 0.016**2)
    lip = np.sqrt(lip) * smooth_step(skin.z, 0.04, 0.06)
    jaw = np.where(skin.above_mouth >= 0, jaw * (1 - lip), jaw + (1 - jaw) * lip)
    root = 1 - smooth_step(skin.y, -0.160, -0.085)
    weights = np.zeros((len(jaw), 5))
    weights[:, 0], weights[:, 2] = root * (1 - jaw), jaw
    weights[:, 1] = 1 - weights[:, 0] - weights[:, 2]
    return weights


def _correctives(skin: Skin) -> np.ndarray:
    """(N, 3, 36): cheeks hollow as the jaw opens, the throat gives way as the neck bends."""
    out = np.zeros((len(skin.x), 3, POSE_FEATURES))
    sine = 7  # entry (2, 1) of a rotation about x is the sine of its angle
    side = abs(skin.x)
    cheek = smooth_step(skin.z, 0.0, 0.04) * bump(side, skin.y, (0.044, -0.040), (0.018, 0.022))
    throat = smooth_step(skin.z, -0.03, 0.01) * bump(side, skin.y, (0.0, -0.115), (0.035, 0.016))
    out[:, 0, 9 + sine] = -side_sign(skin.x) * 0.006 * cheek
    out[:, 2, 9 + sine] = -0.004 * cheek
    out[:, 2, 0 + sine] = -0.006 * throat
    return out


def _joint_regressor(base: np.ndarray, coarse: np.ndarray, pieces: dict[str, np.ndarray]) -> np.ndarray:
    """(5, V): each joint as a weighted mean of skin around it, or of its eyeball. The same at every level."""
    regressor = np.zeros((5, len(base)))
    for joint, eyeball in ((3, "left_eyeball"), (4, "right_eyeball")):
        regressor[joint, pieces[eyeball]] = 1 / len(pieces[eyeball])
    for joint in range(3):
        band = coarse[abs(base[coarse, 1] - JOINT_POSITIONS[joint, 1]) < 0.02]
        # Closest to the plain mean among the weights that hit the joint exactly.
        conditions = np.vstack([base[band].T, np.ones(len(band))])
        even = np.full(len(band), 1 / len(band))
        miss = np.append(JOINT_POSITIONS[joint], 1) - conditions @ even
        regressor[joint, band] = even + conditions.T @ np.linalg.solve(conditions @ conditions.T, miss)
    return regressor


def _masks(grid: SkinGrid, pieces: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """FLAME's regions by name -> vertex ids; pockets belong to the region of the edge they continue."""
    skin = grid.skin
    x, y, side = skin.x, skin.y, abs(skin.x)
    front = skin.z > 0.03
    hair = above_hairline(skin.at) > 0
    eye = front & (((side - EYE[0]) / 0.024) ** 2 + ((y - EYE[1]) / 0.018) ** 2 < 1)
    lips = front & ((x / 0.0275) ** 2 + ((y - MOUTH[1]) / 0.0125) ** 2 < 1)
    ear = (side > 0.06) & (abs(y - 0.006) < 0.034) & (abs(skin.z + 0.024) < 0.020)
    neck = (y < -0.100) | ((y < -0.06) & (skin.z < -0.02))
    regions = {
        "lips": lips,
        "nose": front & (side < 0.020) & (y > -0.033) & (y < 0.016) & ~eye & ~lips,
        "eye_region": eye,
        "left_eye_region": eye & (x > 0),
        "right_eye_region": eye & (x < 0),
        "left_ear": ear & (x > 0),
        "right_ear": ear & (x < 0),
        "forehead": front & (y > 0.042) & ~hair,
        "scalp": hair & ~ear,
        "neck": neck,
        "face": front & (y > -0.105) & ~hair,
        "boundary": grid.row == len(ROWS) - 1,
    }
    masks = {name: np.flatnonzero(inside[grid.source]) for name, inside in regions.items()}
    teeth = np.concatenate([pieces["upper_teeth"], pieces["lower_teeth"]])
    return masks | {name: pieces[name] for name in ("left_eyeball", "right_eyeball")} | {"teeth": teeth}
