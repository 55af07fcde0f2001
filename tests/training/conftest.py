"""A head whose tracking is off, one that is tracked right, and an avatar trained on the latter."""

from functools import cached_property

import numpy as np
import pytest

from stga_addon.avatar.file import Avatar
from stga_addon.capture.images import read_view
from stga_addon.training.optimize.avatar_tracking import TrainedAvatar
from stga_addon.training.optimize.semantic_regions import teeth_of
from stga_addon.training.optimize.surface import Surface
from stga_addon.training.optimize.trainer import Trainer
from stga_addon.training.schedule import view_order

from .heads import write_head
from .toys import few_renderings, quick_settings


@pytest.fixture(autouse=True, scope="session")
def outsides():
    """Which triangles are seen from around a mesh is found once for all captures that share it."""
    found = {}
    outside = Surface.outside.func

    def known(surface):
        meshes = surface.capture.neutral, surface.capture.faces
        key = *map(id, meshes), teeth_of(surface.capture).tobytes()
        if key not in found:
            found[key] = meshes, outside(surface)  # which keeps the arrays, and so their names
        return found[key][1]

    shared = cached_property(known)
    shared.__set_name__(Surface, "outside")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Surface, "outside", shared)
        yield


@pytest.fixture
def hasty():
    with few_renderings():
        yield


@pytest.fixture(scope="session")
def lost(tmp_path_factory):
    """Tracked a few millimeters and degrees off."""
    return write_head(tmp_path_factory.mktemp("lost"))


@pytest.fixture(scope="session")
def right(tmp_path_factory):
    return write_head(tmp_path_factory.mktemp("right"), error=0.0)


@pytest.fixture(scope="session")
def person(right):
    """An avatar whose training saw the right meshes."""
    capture = right[0]
    settings = quick_settings("global", iterations=300, lattice=1, sh_degree=0, sh_steps=())
    trainer = Trainer(capture, settings, {})
    views = capture.views["train"]
    ready = {view.name: read_view(view) for view in views}
    for n, view in zip(range(300), view_order(views, 1, 0), strict=False):
        small, image, mask = ready[view.name]
        trainer.step(small, image, n / 300, mask)
    neutral = capture.neutral.astype(np.float32)
    splats = trainer.state.splats(averaged=True)
    avatar = Avatar(splats, settings.convention, neutral, capture.faces)
    return TrainedAvatar(avatar, settings)
