"""Captures and FLAME sequences made by hand, so that the scene is tested, not readers."""

from dataclasses import replace

import bpy
import numpy as np
from flame.conftest import model_of, random_arrays, random_frame
from flame.small_head import small_head, write_flame
from numpy.random import default_rng

from stga_addon.capture.model import Capture
from stga_addon.flame.sequence import FlameSequence, expression_mesh, neutral_mesh, sequence_mesh
from stga_addon.scene.arrays import evaluated_vertices

from .session import ops, panel


def at_frame(head, frame):
    """(V, 3) of an object's evaluated mesh."""
    whole = int(np.floor(frame))
    bpy.context.scene.frame_set(whole, subframe=frame - whole)
    return evaluated_vertices(head)


def mesh_at(frame):
    """That of the panel's head."""
    return at_frame(panel().head, frame)


def strip(vertices):
    """(vertices - 2, 3) triangles of a strip."""
    first = np.arange(vertices - 2)
    return np.stack([first, first + 1, first + 2], 1).astype(np.int32)


def closure(selected, faces):
    """(F,) bool: triangles (F, 3) whose vertices all belong to a selected triangle."""
    return np.isin(faces, faces[selected]).all(axis=1)


def mesh_capture(
    root,
    timesteps=(2, 3, 7),
    vertices=60,
    views=None,
    seed=0,
):
    """A mesh capture of random vertices; the mesh of each timestep is another draw."""
    neutral = default_rng(seed).normal(0, 0.1, (vertices, 3))
    faces = strip(vertices)

    def mesh(timestep):
        return neutral + default_rng([seed, timestep]).normal(0, 0.02, neutral.shape)

    regions = {"mouth": np.arange(len(faces)) % 3 == 0}
    head = {"faces": faces, "neutral": neutral, "regions": regions, "mesh": mesh}
    still = lambda timestep, zero_pose: mesh(timestep)  # noqa: E731
    times = {"timesteps": tuple(timesteps), "expression_mesh": still}
    return Capture(root=root, layout="mesh", views=views or {}, **head, **times)


def flame_model(vertices=80, components=40, identity=10, seed=0):
    """A random model whose joints depend on more terms than one driver holds."""
    return model_of(random_arrays(seed, vertices, components) | {"f": strip(vertices)}, identity)


def flame_sequence(model, timesteps=(4, 5, 9), seed=0, dynamic=False):
    """Large random poses, so that a transposed rotation or a wrong pivot is centimeters off."""
    rng = default_rng(seed)
    size = len(model.v_template)
    frames = {t: random_frame(seed + t, model.n_expression) for t in timesteps}
    if dynamic:
        for t, frame in frames.items():
            frames[t] = replace(frame, dynamic_offset=rng.normal(0, 0.01, (size, 3)))
    shape = rng.normal(size=model.n_identity)
    offset = rng.normal(0, 0.002, (size, 3))
    return FlameSequence(model, shape, offset, tuple(timesteps), frames.__getitem__)


def motion_capture(sequence, source):
    """The sequence as what `open_capture` makes of a motion file."""
    return Capture(
        root=source,
        layout="flame",
        faces=sequence.model.faces,
        neutral=neutral_mesh(sequence),
        views={},
        timesteps=sequence.timesteps,
        regions={},
        mesh=lambda timestep: sequence_mesh(sequence, timestep),
        expression_mesh=lambda timestep, zero_pose: expression_mesh(sequence, timestep, zero_pose),
        flame=sequence,
    )


def import_small_head(folder, **motion):
    """The small head in the scene, by an importer's files in the folder, with a motion of its own;
    its identity as a sequence without frames."""
    model = small_head(0)
    write_flame(model, folder / "flame.npz")
    shape = np.linspace(-0.5, 0.5, model.n_identity)
    np.savez(folder / "own.npz", shape=shape, **motion)
    files = {"filepath": folder / "own.npz", "flame": folder / "flame.npz"}
    ops.import_motion(**files)
    return FlameSequence(model, shape, None, (), {}.__getitem__)
