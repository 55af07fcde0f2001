"""A generated head in FLAME's topology with expressions, and random ARKit poses."""

from dataclasses import replace

import numpy as np
from flame.mouths import open_flame

from stga_addon.capture.mesh_geometry import connected_parts
from stga_addon.driving.performance import ARKIT_SHAPES, COLUMN, COUNT
from stga_addon.driving.shapes import face_points, face_shapes

KERNEL_M = 0.006
REACH_M = 0.012
RIGID = tuple(name for name in ARKIT_SHAPES if name.startswith("jaw"))
LOOKS = [
    ("Up", "Down", "Left"),
    ("Up", "Down", "Right"),
    ("In", "Out", "Left"),
    ("In", "Out", "Right"),
]
OPPOSITES = (
    ("jawLeft", "jawRight"),
    ("mouthLeft", "mouthRight"),
    *((f"eyeLook{one}{side}", f"eyeLook{other}{side}") for one, other, side in LOOKS),
)
SAMPLES = 400


def generated_flame(shared_data, components):
    """FLAME 2023 Open with 60 identity components, a jaw, eyes, and generated expressions."""
    model = _with_eyes(open_flame(shared_data))
    return with_expressions(replace(model, posedirs=0 * model.posedirs), components)


def with_expressions(model, components):
    """The model with other expressions: FLAME's own are not published openly.

    They are principal components of what random combinations of ICT-FaceKit's shapes other than the
    jaw's do, spread from the face's points over the mesh.
    """
    identity = model.shapedirs[:, :, : model.n_identity]
    places, used = face_points(model, "head")
    points = places.on(model.v_template, model.faces)[used]
    distance = np.linalg.norm(model.v_template[:, None] - points, axis=2)
    spread = np.exp(-0.5 * (distance / KERNEL_M) ** 2)
    spread /= np.maximum(spread.sum(axis=1, keepdims=True), 1e-9)
    beyond = np.maximum(distance.min(axis=1, keepdims=True), REACH_M) - REACH_M
    spread *= np.exp(-((beyond / REACH_M) ** 2))
    spread[model.weights[:, 3:].any(axis=1)] = 0
    kept = [column for column, name in enumerate(ARKIT_SHAPES) if name not in RIGID]
    moved = np.einsum("vp,spc->svc", spread, face_shapes().shapes[kept][:, used])
    moved = moved.reshape(len(kept), -1)
    weights = random_poses(SAMPLES, np.random.default_rng(0))[:, kept]
    samples = weights @ moved
    _, sizes, axes = np.linalg.svd(samples - samples.mean(axis=0), full_matrices=False)
    axes = sizes[:components, None] * axes[:components] / np.sqrt(SAMPLES)
    expressions = axes.T.reshape(-1, 3, len(axes))
    return replace(model, shapedirs=np.concatenate([identity, expressions], axis=2))


def random_poses(count, rng):
    """(count, 52) weights as of a face in motion: no opposites, a third with closed lips."""
    weights = rng.random((count, COUNT)) * (rng.random((count, COUNT)) < 1 / 3)
    for pair in OPPOSITES:
        chosen = rng.integers(0, 2, count)
        for number, name in enumerate(pair):
            weights[:, COLUMN[name]] *= chosen == number
    closed = rng.random(count) < 1 / 3
    weights[closed, COLUMN["jawOpen"]] = rng.random(int(closed.sum()))
    opened = weights[:, COLUMN["jawOpen"]]
    weights[:, COLUMN["mouthClose"]] = np.where(closed, opened * rng.random(count), 0)
    weights[:, COLUMN["tongueOut"]] = 0
    return np.asarray(weights)


def _with_eyes(model):
    """The model whose eyeballs, the smaller parts of the mesh, follow their joints."""
    label = connected_parts(len(model.v_template), model.faces)
    weights = model.weights.copy()
    regressor = model.j_regressor.copy()
    for part in np.unique(label)[1:]:
        inside = label == part
        joint = 3 if model.v_template[inside, 0].mean() > 0 else 4
        weights[inside] = np.eye(5)[joint]
        regressor[joint] = inside / inside.sum()
    return replace(model, weights=weights, j_regressor=regressor)
