"""A small head of a made-up person in FLAME's format, with a jaw, pose correctives and regions; and
model files.

small_head.npz: v_template of the average person, in 2,100 vertices and 4,000 triangles, the model's
other arrays, and
colors (V, 3), linear RGB.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from stga_addon.files import read_npz, write_npz
from stga_addon.flame.model import MASK_PREFIX, read_flame

FILE = Path(__file__).with_name("small_head.npz")
EXPRESSIONS = (
    "smile",
    "pucker",
    "frown",
    "brows_up",
    "brows_down",
    "cheek_puff",
    "blink_left",
    "blink_right",
    "lips_open",
    "squint",
)
"""Of which a coefficient of 1 is one full action. Ten components of identity come before them."""


def small_head(person):
    """The model whose template is a person's, one for each number."""
    model = read_flame(FILE)
    own = 0.6 * np.random.default_rng(person).normal(size=model.n_identity)
    moved = model.shapedirs[:, :, : model.n_identity] @ own
    return replace(model, v_template=model.v_template + moved)


def small_head_colors():
    """(V, 3) linear RGB."""
    return read_npz(FILE)["colors"].astype(np.float64)


def subdivided(model, *values):
    """The same surface with a vertex in the middle of each edge; and values (V, …) of its
    vertices."""
    edges = np.sort(model.faces[:, [[0, 1], [1, 2], [2, 0]]], axis=2)
    ends, middle = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
    a, b, c = model.faces.T
    ab, bc, ca = len(model.v_template) + middle.reshape(-1, 3).T
    corners = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]

    def more(array):
        return np.concatenate([array, array[ends].mean(axis=1)])

    fine = replace(
        model,
        v_template=more(model.v_template),
        shapedirs=more(model.shapedirs),
        posedirs=more(model.posedirs),
        weights=more(model.weights),
        j_regressor=np.pad(model.j_regressor, ((0, 0), (0, len(ends)))),
        faces=np.concatenate([np.stack(of, axis=1) for of in corners]).astype(np.int32),
    )
    return fine, *map(more, values)


def write_flame(model, path):
    """Write a model as .npz with FLAME's keys; `n_identity` and `masks/<region>` are stored beside
    them."""
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
    masks = {MASK_PREFIX + name: ids for name, ids in model.masks.items()}
    write_npz(path, arrays | masks, compressed=True)
