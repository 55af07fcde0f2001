"""The matte of one image, against true coverage."""

import numpy as np
import pytest
from numpy.random import default_rng
from scipy.ndimage import gaussian_filter, shift

from stga_addon.capture.images import read_image, read_mask
from stga_addon.capture.mesh_geometry import silhouette
from stga_addon.capture.open import open_capture
from stga_addon.tracking.face_networks import PersonNetwork
from stga_addon.tracking.mattes import by_plate, find_matte

pytest.importorskip("cv2")

WIDTH = 200
HEIGHT = 260


def room(height=HEIGHT, width=WIDTH, seed=0):
    """A wall in shades with blurred things before it, and noise: levels (height, width, 3)."""
    rng = default_rng(seed)
    x = np.linspace(-0.5, 0.5, width)[None, :, None]
    things = gaussian_filter(rng.normal(size=(height, width)), width / 12)[..., None]
    shades = rng.uniform(90, 190, 3) + 50 * x + 25 * things / things.std()
    return np.clip(shades + rng.normal(0, 3, shades.shape), 0, 255)


def person(softness=3.0):
    """Coverage (HEIGHT, WIDTH) in 0…1 of a head on shoulders, (H, W) bool of the head alone, and
    their colors."""
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    head = 1 - np.hypot((x - 100) / 48, (y - 100) / 62)
    body = 1 - np.hypot((x - 100) / 90, (y - 262) / 120)
    coverage = np.clip(0.5 + 48 * np.maximum(head, 1.9 * body) / softness, 0, 1)
    skin = np.stack([40 + 0.3 * x, 30 + 0.1 * y, 25 + 0 * x], -1)
    return coverage, head > 0.1, skin + default_rng(1).normal(0, 4, skin.shape)


def filmed(coverage, colors, backdrop):
    alpha = coverage[..., None]
    return np.clip(alpha * colors + (1 - alpha) * backdrop, 0, 255).round().astype(np.uint8)


def overlap(found, true):
    """Intersection over union of masks (H, W) in 0…1, at half coverage."""
    return ((found > 0.5) & (true > 0.5)).sum() / ((found > 0.5) | (true > 0.5)).sum()


@pytest.mark.parametrize("has_plate", [False, True])
def test_an_outline_that_is_off_is_drawn_to_the_person(has_plate):
    """Catches a network's coarse outline, six pixels off, that is taken for the person's, and a
    clean plate that is not used in place of a network."""
    coverage, head, colors = person()
    wall = room().round().astype(np.uint8)
    noise = default_rng(2).normal(0, 2, wall.shape)
    image = np.clip(filmed(coverage, colors, wall) + noise, 0, 255).round().astype(np.uint8)
    coarse = gaussian_filter(shift(coverage, (4, 5), order=1, mode="nearest"), 4).astype(np.float32)
    assert overlap(coarse, coverage) < 0.95
    matte = find_matte(image, by_plate(image, wall) if has_plate else coarse, head) / 255
    assert overlap(matte, coverage) > 0.985


def test_hair_is_soft():
    """Catches a hard edge where hair lets the wall through."""
    coverage, head, colors = person(softness=4.0)
    matte = find_matte(filmed(coverage, colors, room()), coverage.astype(np.float32), head) / 255
    edge = (coverage > 0.1) & (coverage < 0.9)
    hard = np.abs((coverage > 0.5) - coverage)[edge].mean()
    assert np.abs(matte - coverage)[edge].mean() < 0.6 * hard


def test_a_papered_wall():
    """Catches an outline that the stains of a wall fray: the mean colors of both sides say little
    about a pixel there, but the image has an edge."""
    coverage, head, colors = person(softness=2.0)
    errors = []
    for seed in range(2):
        stains = gaussian_filter(default_rng(seed).normal(size=(HEIGHT, WIDTH)), 2.5)
        wall = np.clip(110 + 60 * stains[..., None] / stains.std() - [0, 5, 15], 0, 255)
        image = filmed(coverage, colors, wall)
        errors.append(np.abs(find_matte(image, coverage.astype(np.float32), head) / 255 - coverage))
    edge = np.abs(gaussian_filter(coverage, 3) - 0.5) < 0.45
    hard = np.abs((coverage > 0.5) - coverage)[edge].mean()
    assert np.mean(errors, axis=0)[edge].mean() < 0.8 * hard


def test_the_wall_is_seen_between_strands():
    """Catches hair that stands off the head as an opaque lump in the wall's color: a network and
    GrabCut see one person there. Gloss on hair beside it stays opaque."""
    coverage, head, colors = person()
    colors[:] = np.where(head[..., None], colors, 30)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    off = np.hypot((x - 100) / 48, (y - 100) / 62)
    hair = (off > 1) & (off < 1.25) & (y < 100)
    strands = hair & (x < 90)
    true = np.where(strands, 0.5 + 0.5 * np.sin(1.2 * x + 0.9 * y), np.maximum(coverage, hair))
    gloss = hair & (np.abs(x - 130) < 6) & (off < 1.1)
    colors[gloss] = 70
    wall = np.full((HEIGHT, WIDTH, 3), 200.0)
    whole = np.maximum(coverage, hair).astype(np.float32)
    matte = find_matte(filmed(true, colors, wall), whole, head) / 255
    rim = strands & (off > 1.08) & (off < 1.22)
    assert np.abs(matte - true)[rim].mean() < 0.6 * np.abs(1 - true)[rim].mean()
    assert matte[gloss & (off < 1.05)].min() > 0.95


def test_somebody_else_in_the_room():
    """Catches a second person who becomes part of the first: only what hangs together with the
    tracked head is kept."""
    coverage, head, colors = person()
    other = np.zeros_like(coverage)
    other[20:70, 4:34] = 1
    both = np.maximum(coverage, other)
    matte = find_matte(filmed(both, colors, room()), both.astype(np.float32), head)
    assert matte[:75, :36].max() < 30
    assert overlap(matte / 255, coverage) > 0.97


@pytest.mark.parametrize("likely", [0.0, 1.0])
def test_a_network_that_sees_nobody_or_everybody(likely):
    """Catches an error of GrabCut without one of its two sides; the tracked head stays."""
    coverage, head, colors = person()
    probability = np.full((HEIGHT, WIDTH), likely, np.float32)
    matte = find_matte(filmed(coverage, colors, room()), probability, head)
    assert matte[70:120, 80:120].min() == 255


@pytest.mark.slow
def test_a_rendered_head_before_a_wall(shared_data, tmp_path):
    """Catches a network that is asked wrongly: true masks of a path-traced head before generated
    walls."""
    capture = open_capture(shared_data / "studio_head")
    network = PersonNetwork()
    found = []
    for number, view in enumerate(capture.views["train"][2:80:13]):
        image, mask = with_a_body(read_image(view), read_mask(view))
        alpha = mask[..., None] / 255
        behind = (room(*mask.shape, seed=number) - 255) * (1 - alpha)
        shown = np.clip(image + behind, 0, 255).round().astype(np.uint8)
        head = silhouette(np.asarray(capture.mesh(view.timestep)), capture.faces, view.camera)
        matte = find_matte(shown, network.probability(shown), head)
        found.append(overlap(matte / 255, mask / 255))
    assert np.mean(found) > 0.97, found


def with_a_body(image, mask):
    """The bust's lower edge continued to the image's: nobody ends in the air."""
    image = image.copy()
    mask = mask.copy()
    for x in range(mask.shape[1]):
        rows = np.flatnonzero(mask[:, x] > 127)
        if len(rows) and rows[-1] > 0.75 * len(mask):
            image[rows[-1] - 3 :, x] = image[rows[-1] - 3, x]
            mask[rows[-1] - 3 :, x] = 255
    return image, mask
