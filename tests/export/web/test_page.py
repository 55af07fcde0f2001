"""The page in a real browser: its pictures against the renderer, its interface, and damaged
data."""

import base64
import io
import re
import time

import numpy as np
import pytest
from PIL import Image

from stga_addon.export.rig import baked_rig
from stga_addon.export.web.page import page
from stga_addon.render.render import render_avatar, to_uint8

from .conftest import make_head, show

pytestmark = pytest.mark.needs("chromium")

MIN_PSNR = 47.0
MIN_EXCHANGED_PSNR = 44.0
MIN_EXACT_PSNR = 68.0
"""Unquantized. Splats placed on the driver's grid of 1/16 pixel, as interpolated offsets are, lower
it to 58 dB; colors in half floats take some dB of the rest."""
SNAPSHOT = """(async () => {
  const avatar = document.querySelector('stga-avatar');
  avatar.player.frame = avatar.frame = %d;
  avatar.camera = '%s';
  avatar.background = '#ffffff';
  const blob = await avatar.snapshot();
  const reader = new FileReader();
  return new Promise((done) => {
    reader.onload = () => done(reader.result);
    reader.readAsDataURL(blob);
  });
})()"""


def snapshot(browser, frame, camera="front"):
    """What a camera of the page sees, as a data URL."""
    return str(browser.evaluate(SNAPSHOT % (frame, camera)))


def picture(browser, frame, camera="front"):
    """What a camera of the page sees: (H, W, 3) in levels."""
    encoded = snapshot(browser, frame, camera).partition(",")[2]
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(encoded))).convert("RGB"), float)


def difference(one, other):
    """PSNR in dB of two pictures in levels."""
    return float(10 * np.log10(255**2 / np.mean((one - other) ** 2)))


def psnr(browser, head, frame):
    """Of the page's picture against the renderer's, both in eight bits."""
    expected = to_uint8(render_avatar(head.avatar, head.meshes[frame], head.camera))
    return difference(picture(browser, frame), expected)


OTHER = {"convention": "gaussian_avatars", "offsets": ()}


@pytest.mark.parametrize(
    ("options", "exact"),
    [
        ({}, True),
        ({}, False),
        ({**OTHER, "sh_degree": 1, "antialiased": False}, True),
        ({"offsets": ("normal_color",)}, True),
        ({**OTHER, "offsets": ("strain_position",)}, False),
        ({"baked": True}, False),
    ],
)
def test_picture_is_the_renderers(options, exact, browser, tmp_path):
    """Catches a difference of projection, position, color, blending or quantization, a baked motion
    that is not that of the meshes, and any request of the page."""
    baked = options.pop("baked", False)
    head = make_head(**options)
    show(browser, tmp_path, head.data(baked_rig(list(head.meshes)) if baked else None, exact))
    found = sorted(psnr(browser, head, frame) for frame in range(3))
    if exact:
        assert found[0] >= MIN_EXACT_PSNR
    else:  # rounding may exchange two splats that are equally far away, which a picture shows
        assert found[0] >= MIN_EXCHANGED_PSNR
        assert found[1] >= MIN_PSNR
    assert browser.errors == []
    assert browser.requests == [(tmp_path / "a.html").as_uri()]


def cut(text, start, characters=0):
    """The text up to some characters behind the first `start`."""
    at = text.index(start) + len(start) + characters
    assert at < len(text)
    return text[:at]


DATA = r'id="data">[^<]*'
INCOMPLETE = "This page is damaged or incomplete, or the browser is too old for it."
NO_DATA = "This page holds no avatar data."
DAMAGED = "The avatar data is damaged."
DAMAGED_PAGES = {
    "cut in the styles": (lambda page: cut(page, "<style>", 500), INCOMPLETE),
    "cut in the heading": (lambda page: cut(page, '<p id="facts">Load'), INCOMPLETE),
    "cut in the script": (lambda page: cut(page, '<script type="module">', 9000), INCOMPLETE),
    "script altered": (lambda page: page.replace("class Player {", "class Player {{"), INCOMPLETE),
    "a name altered": (lambda page: page.replace("function addViews(", "function a("), INCOMPLETE),
    "no data": (lambda page: re.sub(rf"<script [^>]*{DATA}</script>", "", page), NO_DATA),
    "empty data": (lambda page: re.sub(DATA, 'id="data">', page), NO_DATA),
    "no base 85": (lambda page: re.sub(DATA, "id=\"data\">H4sI''", page), DAMAGED),
    "other data": (lambda page: re.sub(DATA, 'id="data">AAAA', page), "not an avatar data file."),
    "cut at the data": (lambda page: cut(page, 'id="data">'), NO_DATA),
    "cut in the data": (lambda page: cut(page, 'id="data">', 40_000), DAMAGED),
    "cut within five digits": (lambda page: cut(page, 'id="data">', 40_001), DAMAGED),
}
SHOWN = """(() => {
  const message = document.querySelector('stga-avatar')?.shadowRoot?.querySelector('p');
  const said = message && !message.hidden ? message.textContent : '';
  return [document.body?.innerText ?? '', said].join(' ');
})()"""
"""Text that can be read on the page, also within the element."""


@pytest.mark.parametrize("damage", DAMAGED_PAGES)
def test_damaged_pages_show_a_sentence(damage, head, browser, tmp_path):
    """Catches a page that says that it is loading for ever, stays blank, or whose controls
    throw."""
    alter, sentence = DAMAGED_PAGES[damage]
    whole_page = page("Zoë", "", head.data())
    altered = alter(whole_page)
    assert altered != whole_page
    (tmp_path / "a.html").write_text(altered, encoding="utf-8")
    browser.open((tmp_path / "a.html").as_uri())
    deadline = time.monotonic() + 10
    while sentence not in (shown := browser.evaluate(SHOWN)) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert sentence in shown
    assert "Loading" not in shown


def test_a_browser_without_webgl2_is_told(browser, head, tmp_path):
    """Catches a blank page, or an exception, where the graphics driver is blocked."""
    source = "HTMLCanvasElement.prototype.getContext = () => null"
    added = browser.send("Page.addScriptToEvaluateOnNewDocument", source=source)
    try:
        show(browser, tmp_path, head.data())
    finally:
        browser.send("Page.removeScriptToEvaluateOnNewDocument", **added)
    sentence = "This page needs WebGL 2, which this browser or graphics driver does not offer."
    assert sentence in browser.evaluate(SHOWN)
    assert browser.errors == []
