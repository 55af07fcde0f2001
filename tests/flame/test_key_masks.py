"""Eyes, mouth and nose that are found on FLAME's real mesh."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from stga_addon.capture.mesh_geometry import head_axes
from stga_addon.flame.key_masks import found_masks
from stga_addon.flame.model import faces_within
from stga_addon.flame.parts import flame_model, found_regions, key_regions

from .mouths import open_flame


def in_the_head(model):
    """Key region -> the middle (3,) and the half extent (3,) of its triangles, seen from the eyes,
    in their height over the mouth."""
    centers = model.v_template[model.faces].mean(1)
    regions = key_regions(model)
    eyes, axes, unit = head_axes(centers, regions)
    found = {}
    for name, region in regions.items():
        at = (centers[region] - eyes) @ axes.T / unit
        low, high = np.quantile(at, (0.05, 0.95), axis=0)
        found[name] = (low + high) / 2, (high - low) / 2
    return found


@pytest.mark.parametrize("turn", [None, [0.3, -2.0, 0.8]], ids=["upright", "turned"])
def test_regions_are_where_another_head_has_them(shared_data, turn):
    """Catches regions of a head without masks that are swapped, elsewhere or much smaller: those of
    the bundled head were named by its makers. And a mesh that looks elsewhere than along z."""
    model = open_flame(shared_data)
    at = model.v_template
    if turn is not None:
        at = 7 * Rotation.from_rotvec(turn).apply(at) + (3, -2, 9)
    model = replace(model, masks=found_masks(at, model.faces))
    found = in_the_head(model)
    named = in_the_head(flame_model(None))
    assert found.keys() == named.keys()
    for name, (middle, half) in named.items():
        assert np.abs(found[name][0] - middle).max() < 0.3  # its mouth is named further in
        assert 0.7 < found[name][1][0] / half[0] < 1.3


def test_eyeballs_are_the_mesh_s_own(shared_data):
    """Catches an eyeball that is cut, and skin that counts as one where a head has none."""
    model = open_flame(shared_data)
    masks = found_masks(model.v_template, model.faces)
    assert [len(masks[f"{side}_eyeball"]) for side in ("left", "right")] == [546, 546]
    without = ~np.isin(model.faces, masks["left_eyeball"]).any(1)
    assert not found_masks(model.v_template, model.faces[without])
    flat = np.zeros_like(model.v_template)  # of FLAME's triangles, but no head
    assert not any(region.any() for region in found_regions(flat, model.faces).values())


def test_heads_look_ahead_however_much_of_a_mouth_is_known(shared_data):
    """Catches axes that lean with a mouth's depth: hair then ended 3 cm too low on FLAME's neck."""
    bundled = flame_model(None)
    flame = open_flame(shared_data)
    regions = key_regions(bundled)
    lips = faces_within(bundled.faces, bundled.masks["lips"])
    heads = (
        (bundled, regions),
        (bundled, {**regions, "mouth": lips}),
        (flame, found_regions(flame.v_template, flame.faces)),
    )
    for model, known in heads:
        _, axes, _ = head_axes(model.v_template[model.faces].mean(1), known)
        assert np.degrees(np.arccos(axes[1, 1])) < 10  # from where the model's own axis points up
