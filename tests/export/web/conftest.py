"""A FLAME head with splats on it, in a motion of three frames."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from avatar.conftest import random_splats
from flame.small_head import small_head

from export.web.browser import Browser, find_browser
from stga_addon.avatar.file import Avatar
from stga_addon.avatar.offsets import OFFSETS
from stga_addon.avatar.strain import observed_range, strain_basis
from stga_addon.capture.camera import Camera, look_at
from stga_addon.export.playback import Playback
from stga_addon.export.rig import RiggedAvatar, flame_rig
from stga_addon.export.skinned_gltf import skinned_glb
from stga_addon.export.web.page import page
from stga_addon.flame.forward import FlameFrame
from stga_addon.flame.sequence import FlameSequence, neutral_mesh, sequence_mesh

SPLATS = 1500
SIZE = 120
READY = """new Promise((done) => {
  const avatar = document.querySelector('stga-avatar');
  const failed = () => avatar.shadowRoot?.querySelector('p').textContent;
  const look = () => (avatar.info || failed() ? done() : setTimeout(look, 20));
  look();
})"""


# not longer: the page would go on playing, on software graphics, beside other tests
@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    opened = Browser(str(find_browser()), tmp_path_factory.mktemp("profile"), (500, 400))
    yield opened
    opened.close()


def show(browser, folder, data):
    """Open the page of a data file from disk."""
    (folder / "a.html").write_text(page("Zoë", "", data), encoding="utf-8")
    browser.open((folder / "a.html").as_uri())
    browser.evaluate(READY)


@dataclass(frozen=True)
class Head:
    """An avatar, its motion, the meshes (T, V, 3) of it and a camera."""

    avatar: Avatar
    sequence: FlameSequence
    meshes: np.ndarray
    camera: Camera

    @property
    def rig(self):
        return flame_rig(self.sequence)

    def data(self, rig=None, exact=False, controls=None):
        playback = Playback("Zoë", 2.0, {"front": self.camera}, selection=self.selection)
        rigged = RiggedAvatar(self.avatar, rig or self.rig, controls)
        return skinned_glb(rigged, playback, exact)

    @property
    def selection(self):
        faces = np.arange(len(self.avatar.faces))
        return [faces % (number + 2) == 0 for number in range(len(self.meshes))]


def make_head(convention="stga", sh_degree=3, antialiased=True, offsets=tuple(OFFSETS), size=1.0):
    """offsets: names of driven offsets, which the ranges of most triangles cut off; splats move as
    far as they spread. size: of the head, in heads."""
    model = small_head(0)
    model = replace(
        model,
        v_template=size * model.v_template,
        shapedirs=size * model.shapedirs,
        posedirs=size * model.posedirs,
    )
    rng = np.random.default_rng(3)
    frames = [
        FlameFrame(
            expr=rng.normal(0, 0.5, model.n_expression),
            rotation=rng.normal(0, 0.1, 3),
            neck_pose=rng.normal(0, 0.1, 3),
            jaw_pose=np.array([0.2, 0.02, 0.0]),
            translation=size * rng.normal(0, 0.01, 3),
            eyes_pose=rng.normal(0, 0.2, 6),
            dynamic_offset=rng.normal(0, 2e-4, model.v_template.shape) if number == 1 else None,
        )
        for number in range(3)
    ]
    shape = rng.normal(0, 0.5, model.n_identity)
    offset = rng.normal(0, 1e-4, model.v_template.shape)
    sequence = FlameSequence(model, shape, offset, (0, 1, 2), frames.__getitem__)
    unit = 1.0 if convention == "gaussian_avatars" else 0.005 * size
    splats = random_splats(5, SPLATS, len(model.faces), sh_degree)
    splats = replace(
        splats,
        xyz=splats.xyz * np.float32(0.3 * unit),
        log_scale=splats.log_scale * np.float32(0.3) + np.float32(np.log(0.8 * unit) + 1.2),
        sh=splats.sh * np.float32(0.3),
    )
    neutral = neutral_mesh(sequence).astype(np.float32)
    meshes = np.stack([sequence_mesh(sequence, timestep) for timestep in sequence.timesteps])
    limits = observed_range(strain_basis(neutral, model.faces), 0.5 * (meshes[:1] + neutral))
    spreads = {"strain_position": 0.3 * unit, "strain_scale": 0.1, "strain_color": 0.1}
    spreads |= {"normal_color": 0.5}
    driven = {
        name: rng.normal(0, spread, (len(model.faces), 3, 3)).astype(np.float32)
        for name, spread in spreads.items()
    }
    avatar = Avatar(splats, convention, neutral, model.faces, antialiased=antialiased)
    if offsets:
        kept = {name: driven[name] for name in offsets}
        avatar = replace(avatar, strain_range=limits, driven_offsets=kept)
    camera = look_at((0.15 * size, 0.05 * size, size), (0, 0, 0), SIZE, SIZE, 3.0 * SIZE)
    return Head(avatar, sequence, meshes, camera)


@pytest.fixture(scope="session")
def head():
    return make_head()


@pytest.fixture
def shown(browser, head, tmp_path):
    """The page of the head, in the browser."""
    show(browser, tmp_path, head.data())
