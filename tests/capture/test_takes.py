"""Several takes of one head as one capture."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.testing import assert_array_equal
from refusal import refusal

from stga_addon.capture.takes import first_timesteps, join_takes


def moved(capture, offset):
    """Another take: the same head, elsewhere."""
    mesh = capture.mesh
    return replace(capture, root=Path("other"), mesh=lambda timestep: mesh(timestep) + offset)


def turned(camera):
    """Another camera, upside down."""
    upside_down = np.diag([-1.0, -1.0, 1.0, 1.0])
    return replace(camera, world_to_camera=upside_down @ camera.world_to_camera)


def test_timesteps_follow_each_other(toy):
    """Catches one take's mesh, image or rate in another's place, and another person's head."""
    other = moved(toy, 0.1)
    joined = join_takes([toy, other])
    (start,) = first_timesteps([toy, other])[1:]
    assert start == max(toy.timesteps) + 1
    assert joined.timesteps == (*toy.timesteps, *(start + timestep for timestep in toy.timesteps))
    for timestep in toy.timesteps:
        assert_array_equal(joined.mesh(timestep), toy.mesh(timestep))
        assert_array_equal(joined.mesh(start + timestep), toy.mesh(timestep) + 0.1)
        found = joined.expression_mesh(start + timestep, "head")
        assert_array_equal(found, toy.expression_mesh(timestep, "head"))
    for split, views in toy.views.items():
        both = joined.views[split]
        assert both[: len(views)] == views
        assert [view.image for view in both[len(views) :]] == [view.image for view in views]
        timesteps = [view.timestep - start for view in both[len(views) :]]
        assert timesteps == [view.timestep for view in views]
    for first, second, expected in (
        (60.0, 60.0, 60.0),
        (60.0, None, 60.0),
        (60.0, 25.0, None),
    ):
        joined = join_takes([replace(toy, fps=first), replace(moved(toy, 0.1), fps=second)])
        assert joined.fps == expected, (first, second)
    with refusal(r"^other: its neutral mesh is up to 1\.7 mm from that of"):
        join_takes([toy, replace(toy, root=Path("other"), neutral=toy.neutral + 0.001)])
    with refusal(r"^other: its mesh has other triangles than"):
        join_takes([toy, replace(toy, root=Path("other"), faces=toy.faces[::-1])])
    join_takes([toy, replace(toy, neutral=toy.neutral + 1e-6)])


def test_cameras_keep_their_index_only_where_they_are_the_same(toy):
    """Catches exposure of one camera corrected in another's images, and two that count as one."""
    views = []
    train = toy.views["train"]
    for view in train:
        camera = turned(view.camera) if view.camera_index == 1 else view.camera
        views.append(replace(view, camera=camera))
    joined = join_takes([toy, replace(toy, views={"train": views})])
    new = joined.views["train"][len(views) :]
    before = {view.camera_index for members in toy.views.values() for view in members}
    kept = {old.camera_index: view.camera_index for old, view in zip(views, new, strict=True)}
    assert kept[0] == 0
    assert kept[1] not in before
    start = max(toy.timesteps) + 1
    (view,) = (view for view in toy.views["train"] if (view.timestep, view.camera_index) == (0, 0))
    away = [replace(view, camera=turned(view.camera), camera_index=n) for n in (start, 0)]
    second, third = (replace(toy, views={"train": (only,)}) for only in away)
    joined = join_takes([toy, second, third])
    indices = [found.camera_index for found in joined.views["train"][-2:]]
    assert len({*indices, *(found.camera_index for found in toy.views["train"])}) == 2 + 3
    assert indices[0] == 4 + 2 * start  # as in the identities of runs that have been extended
