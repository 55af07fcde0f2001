"""Selection: regions by their mean offset, other triangles by their own, and whose word is last."""

from pathlib import Path

import numpy as np
import pytest
from refusal import refusal

from stga_addon.capture.model import Capture
from stga_addon.capture.selection import KEY_REGIONS, SelectionOptions, select_capture, select_faces
from stga_addon.flame.parts import KEY_MASKS
from stga_addon.schema import validate

THRESHOLD = 0.01
COUNT = 8
# separate triangles, so that each can be moved alone
FACES = np.arange(3 * COUNT).reshape(COUNT, 3)
NEUTRAL = np.random.default_rng(0).normal(size=(3 * COUNT, 3))


def moved(offsets):
    """The neutral mesh with some triangles shifted by so many meters, each in its own direction."""
    mesh = NEUTRAL.copy()
    rng = np.random.default_rng(1)
    for face, distance in offsets.items():
        direction = rng.normal(size=3)
        mesh[FACES[face]] += distance * direction / np.linalg.norm(direction)
    return mesh


def region(*faces):
    return np.isin(np.arange(COUNT), faces)


TWO = {"mouth": region(0, 4), "nose": region(3, 4, 5, 6)}
RULES = [
    # a triangle outside of regions by its own offset
    ({1: 0.011, 2: 0.0099, 5: 0.5}, {}, [1, 5]),
    ({}, {}, []),
    # a region by its mean: 0.021 over two triangles is 0.0105, which alone decides
    ({0: 0.021}, {"mouth": region(0, 1)}, [0, 1]),
    ({0: 0.019}, {"mouth": region(0, 1)}, []),
    ({0: 0.03, 7: 0.03}, {"mouth": region(0, 1, 2, 3)}, [7]),
    # a triangle of two regions by either, whichever comes later
    ({0: 0.03}, TWO, [0, 4]),
    ({0: 0.03}, dict(reversed(TWO.items())), [0, 4]),
    # none by a region without triangles, whose mean is NaN
    ({1: 0.02}, {"mouth": region()}, [1]),
]


@pytest.mark.parametrize(("offsets", "regions", "expected"), RULES)
def test_rules(offsets, regions, expected):
    """Catches another mean, threshold or rule in a region, and a later one that unselects."""
    with np.errstate(all="raise"):
        chosen = select_faces(moved(offsets), NEUTRAL, FACES, regions, THRESHOLD)
    assert np.flatnonzero(chosen).tolist() == expected


def test_offsets_are_distances_of_centers():
    """Catches opposite movements, as of the two lips, that cancel each other, and vertex distances:
    a triangle that turns about its center has not moved."""
    mesh = NEUTRAL.copy()
    mesh[FACES[0], 1] += 0.02
    mesh[FACES[1], 1] -= 0.02
    mesh[FACES[2]] = np.roll(mesh[FACES[2]], 1, axis=0)
    chosen = select_faces(mesh, NEUTRAL, FACES, {"mouth": region(0, 1)}, THRESHOLD)
    assert np.flatnonzero(chosen).tolist() == [0, 1]


def capture(given_selection, asked):
    def expression_mesh(timestep, zero_pose):
        asked.append((timestep, zero_pose))
        return moved({timestep: 0.03})

    return Capture(
        root=Path(),
        layout="test",
        faces=FACES,
        neutral=NEUTRAL,
        views={},
        timesteps=(1, 4, 6),
        regions={"mouth": region(1, 2), "ears": region(3, 4, 5)},
        mesh=lambda timestep: pytest.fail("selection must not look at the mesh with head motion"),
        expression_mesh=expression_mesh,
        given_selection=given_selection,
    )


def numbers(chosen):
    return {timestep: np.flatnonzero(mask).tolist() for timestep, mask in chosen.items()}


def test_every_timestep_is_selected_from_its_expression_mesh():
    """Catches regions not named, the wrong zero pose, and the authors' own faces overruled."""
    asked = []
    options = SelectionOptions(threshold=THRESHOLD, zero_pose="all")
    chosen = select_capture(capture({}, asked), options)
    assert numbers(chosen) == {1: [1, 2], 4: [4], 6: [6]}
    assert asked == [(1, "all"), (4, "all"), (6, "all")]
    asked = []
    given = {4: region(0, 7), 6: region()}
    chosen = select_capture(capture(given, asked), SelectionOptions(threshold=THRESHOLD))
    assert numbers(chosen) == {1: [1, 2], 4: [0, 7], 6: []}
    assert asked == [(1, "head")]


def test_options():
    """Catches a threshold that selects nothing, or everything, without saying so, one of zero that
    is refused, a misspelled zero pose that is found only where the first FLAME mesh is posed, and a
    key region under another name than captures give it."""
    for threshold in (float("nan"), -1.0, float("inf"), "5", None):
        with refusal("threshold: expected a finite number from 0, got"):
            validate(SelectionOptions(threshold=threshold))
    validate(SelectionOptions(threshold=0.0))
    with refusal("zero_pose: expected one of head, all, got 'face'"):
        validate(SelectionOptions(zero_pose="face"))
    assert set(KEY_REGIONS) == set(KEY_MASKS)
