"""The page's light in a real browser: colors and pictures against the Python renderer, and the
controls."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from stga_addon.avatar.embedding import face_frames
from stga_addon.avatar.file import AvatarLight
from stga_addon.export.playback import Playback
from stga_addon.export.rig import RiggedAvatar
from stga_addon.export.skinned_gltf import skinned_glb
from stga_addon.light.harmonics import rotated, uniform
from stga_addon.light.relight import Relighter
from stga_addon.light.surface import Bounce, transfer_of
from stga_addon.light.values import HAIR_ROUGHNESS, Light, Lighting
from stga_addon.render.render import posed_avatar, render_layers, to_uint8

from .conftest import make_head, show
from .test_page import difference, picture, snapshot
from .web_data import read_web_data

pytestmark = pytest.mark.needs("chromium")

LASHES = 40
MIN_PSNR = 55.0
MIN_QUANTIZED_PSNR = 50.0
"""Of relit pictures against the renderer's, which also lets the sun's shadow dim the light between
skin and skin."""
SUN = {"toward": [0.5, 0.6, 0.62], "color": [2.4, 2.1, 1.6]}
COLORS = """(() => {
  const { gl, lightPass } = document.querySelector('stga-avatar').player;
  const { framebuffer, width, height } = lightPass.colors;
  const values = new Float32Array(4 * width * height);
  gl.bindFramebuffer(gl.FRAMEBUFFER, framebuffer);
  gl.readPixels(0, 0, width, height, gl.RGBA, gl.FLOAT, values);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  return Array.from(values.subarray(0, 4 * lightPass.count));
})()"""


def lit_head(damping=0.0, lashes=False, **options):
    """A head whose light is known: brighter from above, with a part of the mesh as wet as eyes, and
    tufts of hair. lashes: around a nose that is wet as well."""
    head = make_head(**options)
    neutral = head.avatar.neutral.astype(np.float64)
    faces = head.avatar.faces
    transfer, occlusion = transfer_of(neutral, faces, 48)
    radiance = uniform((0.5, 0.45, 0.4))
    radiance[1] = 0.3
    arriving = np.maximum(transfer @ radiance, 0.02)
    arriving = arriving + Bounce(neutral, faces, occlusion).light(arriving)
    eye = lashes & (np.linalg.norm(neutral - neutral[neutral[:, 2].argmax()], axis=1) < 0.012)
    wet = np.where((neutral[:, 0] > 0.05) | eye, 0.2, 0).astype(np.float32)
    tufts = (neutral[:, 0] < -0.02) & (np.arange(len(neutral)) % 2 == 0)
    wet[tufts] = HAIR_ROUGHNESS
    radiance = radiance.astype(np.float32)
    arriving = arriving.astype(np.float32)
    light = AvatarLight(radiance, transfer, occlusion, arriving, wet, 0.05, damping)
    splats = with_lashes(head.avatar, eye) if lashes else head.avatar.splats
    return replace(head, avatar=replace(head.avatar, light=light, splats=splats))


def with_lashes(avatar, eye):
    """The splats of an avatar, the first LASHES of them black and 5 mm above the triangles around
    an eye (V,) bool."""
    middle = avatar.neutral[eye].mean(0)
    centers = avatar.neutral[avatar.faces].mean(1)
    near = np.linalg.norm(centers - middle, axis=1) < 0.02
    around = np.flatnonzero(~eye[avatar.faces].any(1) & near)
    unit = face_frames(avatar.neutral, avatar.faces, avatar.neutral, avatar.convention).scale
    splats = avatar.splats.rows(np.arange(len(avatar.splats)))
    chosen = np.resize(around, LASHES)
    splats.face[:LASHES] = chosen
    splats.opacity[:LASHES] = 2
    splats.xyz[:LASHES] = 0
    splats.xyz[:LASHES, 1 if avatar.convention == "gaussian_avatars" else 2] = 0.005 / unit[chosen]
    splats.log_scale[:LASHES] = np.log([0.003, 0.001, 0.0002]) - np.log(unit[chosen])[:, None]
    splats.sh[:LASHES] = 0
    splats.sh[:LASHES, 0] = -1.6
    return splats


def harmonics():
    """(9, 3) of a world that is different in every direction."""
    world = np.random.default_rng(7).normal(0, 0.12, (9, 3))
    world[0] += 1.2
    return world


def set_lighting(browser, lighting):
    browser.evaluate(f"{{ document.querySelector('stga-avatar').lighting = {lighting}; }}")


@pytest.mark.parametrize(
    ("options", "exact"),
    [
        ({}, True),
        ({"damping": 0.3, "convention": "gaussian_avatars", "sh_degree": 0, "offsets": ()}, True),
        ({"sh_degree": 2}, False),
        ({"sh_degree": 2, "alike": True}, True),
    ],
)
def test_colors_are_the_relighters(options, exact, browser, tmp_path):
    """Catches albedo, harmonics, the turn of the head, light between skin and skin, shadows (of
    lashes as well), highlights or a fraction of recorded colors that differ from Python's, and a
    picture that shows other colors."""
    alike = options.pop("alike", False)
    head = lit_head(lashes=True, **options)
    show(browser, tmp_path, head.data(exact=exact))
    world = harmonics()
    sun_light = SUN
    if alike:
        world = head.avatar.light.radiance * np.array([1.2, 1.0, 0.8])
        sun_light = {**SUN, "color": [0.6, 0.45, 0.3]}
    lighting = {"harmonics": world.ravel().tolist(), "sun": sun_light, "exposure": 0.5}
    set_lighting(browser, lighting)
    relighter = Relighter(head.avatar)
    order = np.lexsort((relighter.face, head.avatar.splats.face))
    assert len(relighter.lashes.face) == LASHES
    sun = Light("sun", sun_light["color"], direction=-np.array(SUN["toward"]))
    share = relighter.distant_in_head(head.meshes[0], Lighting(world, (sun,)))[1].fraction
    assert 0.3 < share < 0.95 if alike else share < 0.1
    for frame in (0, 2):
        lighting = Lighting(world, (sun,), exposure=0.5)
        colors = relighter.colors(head.meshes[frame], head.camera.position, lighting)
        shown = picture(browser, frame)
        found = np.reshape(browser.evaluate(COLORS), (-1, 4))[:, :3]
        error = np.abs(found - colors[order]).max(1)
        assert np.quantile(error, 0.5) < (0.002 if exact else 0.006)
        assert np.quantile(error, 0.95) < (0.02 if exact else 0.03)
        layers = [posed_avatar(head.avatar, head.meshes[frame], colors)]
        expected = to_uint8(render_layers(layers, head.camera))
        assert difference(shown, expected) >= (MIN_PSNR if exact else MIN_QUANTIZED_PSNR)
    assert browser.errors == []
    assert browser.requests == [(tmp_path / "a.html").as_uri()]


def test_light_between_skin_of_a_mesh_in_other_units(browser, tmp_path):
    """Catches cells of 2 cm on a mesh that is larger than they are meant for, as one in
    centimeters: millions of them, and no neighbor in the next one."""
    head = lit_head(size=20.0)
    show(browser, tmp_path, head.data(exact=True))
    world = harmonics()
    set_lighting(browser, {"harmonics": world.ravel().tolist()})
    relighter = Relighter(head.avatar)
    order = np.lexsort((relighter.face, head.avatar.splats.face))
    colors = relighter.colors(head.meshes[0], head.camera.position, Lighting(world, ()))
    picture(browser, 0)
    found = np.reshape(browser.evaluate(COLORS), (-1, 4))[:, :3]
    assert np.quantile(np.abs(found - colors[order]).max(1), 0.95) < 0.002


def test_as_recorded_is_what_a_page_without_light_shows(browser, tmp_path):
    """Catches a pixel that changes because the light is known, or because it was on before; and
    data of light in a page of an avatar that has none."""
    head = lit_head()
    dark = replace(head, avatar=replace(head.avatar, light=None))
    show(browser, tmp_path, dark.data())
    encoded = snapshot(browser, 1)
    assert browser.evaluate("document.getElementById('light').hidden")
    assert not browser.evaluate("document.querySelector('stga-avatar').hasLight")
    header, arrays = read_web_data(dark.data())
    assert "light" not in header
    assert not any(name.startswith("light") for name in arrays)
    show(browser, tmp_path, head.data())
    assert snapshot(browser, 1) == encoded
    set_lighting(browser, "{ environment: 'sky' }")
    assert snapshot(browser, 1) != encoded
    set_lighting(browser, "null")
    assert snapshot(browser, 1) == encoded


@pytest.mark.parametrize("up", [(0.0, 1.0, 0.0), (0.0, 0.0, 1.0)])
def test_environments_stand_upright_and_turn(up, browser, tmp_path):
    """Catches an environment that lies on its side, or whose light and sun turn apart."""
    head = lit_head()
    playback = Playback(title="Zoë", fps=2.0, views={"front": head.camera}, up=up)
    show(browser, tmp_path, skinned_glb(RiggedAvatar(head.avatar, head.rig), playback))
    found = []
    for turn in (0.0, np.pi / 2):
        set_lighting(browser, f"{{ environment: 'sunset', turn: {turn} }}")
        picture(browser, 0)
        light = "document.querySelector('stga-avatar').player.lightPass.light"
        world, toward = browser.evaluate(f"[[...{light}.world], {light}.sun.toward]")
        found.append((np.reshape(world, (9, 3)), np.array(toward)))
    (world, toward), (turned_world, turned_toward) = found
    assert toward @ up == pytest.approx(0.28, abs=0.03)
    # x ↦ up × x, and what lies along `up` stays
    quarter = np.cross(up, np.eye(3)).T + np.outer(up, up)
    assert_allclose(turned_toward, quarter @ toward, atol=1e-9)
    assert_allclose(turned_world, rotated(world, quarter), atol=1e-9)


def choose(browser, kind):
    """Choose a light in the page's section; the lighting that the page then has."""
    return browser.evaluate(f"""{{
      const list = document.querySelector('#light select');
      list.value = '{kind}';
      list.dispatchEvent(new Event('change'));
      document.querySelector('stga-avatar').lighting;
    }}""")


def side_of_light(browser):
    """Brightness of the right half of the picture over the left."""
    levels = picture(browser, 0)
    covered = levels.min(2) < 250
    half = covered.shape[1] // 2
    shown = levels.mean(2)
    left, right = (shown[:, k][covered[:, k]].mean() for k in np.s_[:half, half:])
    return float(right / left)


def mouse(browser, kind, x, y, **keys):
    at = {"type": f"mouse{kind}", "x": x, "y": y, "button": "left", "clickCount": 1}
    browser.send("Input.dispatchMouseEvent", **at, **keys)


def test_light_controls(browser, tmp_path):
    """Catches a control of the section Light that does nothing, and a light that is dragged the
    wrong way."""
    head = lit_head()
    show(browser, tmp_path, head.data())
    assert not browser.evaluate("document.getElementById('light').hidden")
    assert choose(browser, "studio") == {"environment": "studio", "turn": 0, "exposure": 0}
    dragged = choose(browser, "dragged")
    assert set(dragged) == {"even", "sun", "exposure"}
    assert browser.evaluate("document.querySelector('#light-dragged').hidden") is False
    left, top, width = browser.evaluate("""(() => {
      document.getElementById('panel').hidden = false;
      const pad = document.getElementById('light-pad');
      pad.scrollIntoView({ block: 'center' });
      const { left, top, width } = pad.getBoundingClientRect();
      return [left, top, width];
    })()""")
    shares = []
    for x in (0.15, 0.85):
        for kind in ("Pressed", "Released"):
            mouse(browser, kind, left + x * width, top + 0.5 * width)
        shares.append(side_of_light(browser))
    assert shares[1] > 1.2 * shares[0]
    browser.evaluate("document.getElementById('panel').hidden = true")
    camera = "document.querySelector('stga-avatar').camera.matrix.join()"
    before = browser.evaluate(camera)
    for kind, x in (("Pressed", 200), ("Moved", 100), ("Released", 100)):
        mouse(browser, kind, x, 150, buttons=1, modifiers=1)  # Alt
    assert side_of_light(browser) < shares[1]
    assert browser.evaluate(camera) == before
    place = "document.getElementById('light-pad').style.getPropertyValue('--x')"
    assert browser.evaluate(place) != "85%"
    for lighting, problem in (
        ("{ environment: 'toString' }", "no environment"),
        ("{ harmonics: [1, 2] }", "finite numbers"),
    ):
        with pytest.raises(AssertionError, match=problem):
            set_lighting(browser, lighting)
    assert choose(browser, "recorded") is None
    assert browser.errors == []
