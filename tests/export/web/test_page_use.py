"""The page in use in a real browser: touch, keys, sliders, a lost graphics context, long play,
embedding."""

import functools
import json
import re
import threading
from dataclasses import replace
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import numpy as np
import pytest
from numpy.testing import assert_allclose

from stga_addon.development.package import ROOT
from stga_addon.driving.head_map import head_map, page_controls
from stga_addon.driving.inverse import write_performance
from stga_addon.driving.performance import ARKIT_SHAPES, COLUMN, COUNT, Performance
from stga_addon.export.formats import export_avatar
from stga_addon.export.playback import Playback
from stga_addon.export.web.page import ELEMENT
from stga_addon.flame.forward import flame_forward

from .conftest import show
from .test_page import psnr

pytestmark = pytest.mark.needs("chromium")

PLAY_S = 600
PLAY_RATE = 4
"""Length of the long play, and pictures drawn in each second of it."""
BATCH = 200
"""Pictures drawn at once."""
MAX_HEAP_GROWTH = 300_000
"""Bytes that may be left over from a run of pictures: compiled code and the browser's own
bookkeeping."""
INPUT = """[...document.querySelectorAll('.slider')]
  .find((row) => row.firstChild.textContent === name).querySelector('input')"""
CAMERA = "[...document.querySelector('stga-avatar').camera.matrix]"
MIDDLE_IN_CAMERA = """(() => {
  const { player, camera } = document.querySelector('stga-avatar');
  const p = [...player.middle, 1];
  const m = camera.matrix;
  return [0, 1, 2].map((row) => p.reduce((sum, value, k) => sum + m[4 * row + k] * value, 0));
})()"""
# Counts WebGL objects alive, draws one splat, and lets the test turn the clock of
# requestAnimationFrame.
INSTRUMENTS = """
window.alive = 0;
const prototype = WebGL2RenderingContext.prototype;
for (const kind of ['Texture', 'Buffer', 'Framebuffer', 'VertexArray', 'Program', 'Shader']) {
  for (const [verb, by] of [['create', 1], ['delete', -1]]) {
    const original = prototype[verb + kind];
    prototype[verb + kind] = function (...values) {
      window.alive += by;
      return original.apply(this, values);
    };
  }
}
const draw = prototype.drawArraysInstanced;
prototype.drawArraysInstanced = function (mode, first, count) {
  draw.call(this, mode, first, count, 1); // of all splats one: software draws them slowly
};
window.waiting = [];
window.requestAnimationFrame = (callback) => window.waiting.push(callback);
window.playFor = (pictures, rate) => {
  const avatar = document.querySelector('stga-avatar');
  let wraps = 0;
  for (let k = 0; k < pictures; k++) {
    const before = avatar.frame;
    window.now = (window.now ?? 0) + 1000 / rate;
    for (const callback of window.waiting.splice(0)) callback(window.now);
    if (avatar.frame < before) wraps++;
  }
  return wraps;
};"""


def touch(browser, *paths):
    """Fingers that go along `paths` of equal length together (pixels)."""
    for step, places in enumerate(zip(*paths, strict=True)):
        points = [{"x": x, "y": y, "id": finger} for finger, (x, y) in enumerate(places)]
        kind = "touchMove" if step else "touchStart"
        browser.send("Input.dispatchTouchEvent", type=kind, touchPoints=points)
    browser.send("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])


def line(start, end):
    return [tuple(place) for place in np.linspace(start, end, 6).tolist()]


def press(browser, key):
    text = {"text": key} if len(key) == 1 else {}
    browser.send("Input.dispatchKeyEvent", type="keyDown", key=key, **text)
    browser.send("Input.dispatchKeyEvent", type="keyUp", key=key)


def of_avatar(browser, member):
    return browser.evaluate(f"document.querySelector('stga-avatar').{member}")


def forward(head, frame):
    sequence = head.sequence
    return flame_forward(sequence.model, sequence.shape, frame, sequence.static_offset)


def test_touch(browser, shown):
    """Catches fingers that do nothing, scroll the page, or move the head the wrong way."""
    first = np.reshape(browser.evaluate(CAMERA), (4, 4))
    middle = browser.evaluate(MIDDLE_IN_CAMERA)
    touch(browser, line((200, 120), (260, 120)))
    turned = np.reshape(browser.evaluate(CAMERA), (4, 4))
    assert turned[2, 0] != pytest.approx(first[2, 0], abs=0.1)  # the viewing direction has turned
    assert browser.evaluate(MIDDLE_IN_CAMERA) == pytest.approx(middle, abs=1e-9)  # about the head
    touch(browser, line((200, 120), (150, 120)), line((300, 120), (350, 120)))
    nearer = browser.evaluate(MIDDLE_IN_CAMERA)
    assert nearer[2] == pytest.approx(middle[2] / 2, rel=0.05)
    touch(browser, line((200, 120), (240, 120)), line((300, 120), (340, 120)))
    panned = browser.evaluate(MIDDLE_IN_CAMERA)
    assert panned[0] > nearer[0] + 0.01
    assert panned[1:] == pytest.approx(nearer[1:], abs=1e-3)
    assert browser.errors == []


def test_keyboard(browser, shown):
    """Catches a key of docs/web.md that does nothing, or something else."""
    loop = of_avatar(browser, "loop")
    press(browser, " ")
    assert of_avatar(browser, "playing")
    press(browser, " ")
    assert not of_avatar(browser, "playing")
    for key, frame in (("End", 2), ("ArrowLeft", 1), ("ArrowRight", 2), ("Home", 0)):
        press(browser, key)
        assert of_avatar(browser, "frame") == frame, key
    press(browser, "l")
    assert of_avatar(browser, "loop") is not loop
    press(browser, "s")
    assert of_avatar(browser, "showSelection")
    before = browser.evaluate(CAMERA)
    touch(browser, line((200, 120), (260, 120)))
    for key in ("r", "1"):
        press(browser, key)
        assert browser.evaluate(CAMERA) == before, key
    for key, expression in (
        ("c", "document.getElementById('panel').hidden"),
        ("h", "document.body.classList.contains('bare')"),
        ("t", "document.documentElement.dataset.theme"),
    ):
        state = browser.evaluate(expression)
        press(browser, key)
        assert browser.evaluate(expression) != state, key
    of_avatar(browser, "setExpression(0, 0.5)")
    press(browser, "x")
    assert of_avatar(browser, "player.motion.pinnedCoefficients.every(isNaN)")
    assert browser.errors == []


def click(browser, selector):
    """A click of the mouse on the middle of an element."""
    box = f"document.querySelector('{selector}').getBoundingClientRect().toJSON()"
    found = browser.evaluate(box)
    middle = found["x"] + found["width"] / 2, found["y"] + found["height"] / 2
    place = {"x": middle[0], "y": middle[1], "button": "left", "clickCount": 1}
    for kind in ("mousePressed", "mouseReleased"):
        browser.send("Input.dispatchMouseEvent", type=kind, **place)


def test_keys_press_the_control_that_has_the_focus(browser, shown):
    """Catches a checkbox, a button or a slider that the keyboard reaches, but whose keys play the
    motion; and a clicked button that keeps Space from playing it."""
    of_avatar(browser, "pause()")
    press(browser, "c")
    for selector, member in (("#show-selection", "showSelection"), ("#loop", "loop")):
        before = of_avatar(browser, member)
        browser.evaluate(f"document.querySelector('{selector}').focus()")
        press(browser, " ")
        assert of_avatar(browser, member) is not before, selector
        assert not of_avatar(browser, "playing"), selector
    of_avatar(browser, "frame = 1")
    browser.evaluate("document.querySelector('#pose .slider input').focus()")
    press(browser, "Home")
    assert of_avatar(browser, "frame") == 1
    loop = of_avatar(browser, "loop")
    click(browser, "#loop")
    assert of_avatar(browser, "loop") is not loop
    press(browser, " ")
    assert of_avatar(browser, "playing")
    assert of_avatar(browser, "loop") is not loop
    assert browser.errors == []


def test_sliders_are_flames(browser, head, tmp_path):
    """Catches a slider that moves another shape, joint or axis, or another first camera."""
    show(browser, tmp_path, head.data(exact=True))
    assert np.allclose(browser.evaluate(CAMERA), head.camera.world_to_camera.ravel())
    shown, component = browser.evaluate("""(() => {
      const avatar = document.querySelector('stga-avatar');
      document.getElementById('panel').hidden = false;
      avatar.frame = 2;
      const value = document.querySelector('.slider .value').textContent;
      return [Number(value), avatar.info.sliders[0].component];
    })()""")
    assert shown == pytest.approx(head.rig.coefficients[2, component], abs=0.006)
    assert browser.evaluate("document.getElementById('number').textContent") == "3 / 3"
    of_avatar(browser, "frame = 0")
    rng = np.random.default_rng(1)
    expressions = rng.uniform(-0.9, 0.9, head.sequence.model.n_expression)
    jaw = [0.25, 0.05, -0.03]
    found = browser.evaluate(f"""(() => {{
      const avatar = document.querySelector('stga-avatar');
      for (const [k, value] of Object.entries({expressions.tolist()})) {{
        const name = `Expression ${{k}}`;
        const input = {INPUT};
        input.value = value;
        input.dispatchEvent(new Event('input'));
      }}
      avatar.setPose('jaw', {jaw});
      avatar.player.draw();
      return Array.from(avatar.player.rig.vertices);
    }})()""")
    count = "document.querySelectorAll('.pinned').length"
    assert browser.evaluate(count) == len(expressions)
    recorded = head.sequence.frame(0)
    wanted = replace(recorded, expr=expressions, jaw_pose=np.array(jaw))
    assert np.abs(np.reshape(found, (-1, 3)) - forward(head, wanted)).max() < 1e-5


def test_a_lost_graphics_context_comes_back(browser, head, shown):
    """Catches a blank page, or another camera and pose, after the graphics driver was restarted."""
    of_avatar(browser, "setExpression(1, 0.9)")
    message = "shadowRoot.querySelector('p')"
    player = "document.querySelector('stga-avatar').player"
    pictures = f"Array.from({player}.read({player}.camera))"
    before = browser.evaluate(pictures)
    context = "player.gl.getExtension('WEBGL_lose_context')"
    browser.evaluate(f"{{ window.extension = document.querySelector('stga-avatar').{context}; }}")

    def send(kind, action):
        """Lose or restore the context, and wait for its event."""
        browser.evaluate(f"""new Promise((done) => {{
          const canvas = document.querySelector('stga-avatar').shadowRoot.querySelector('canvas');
          canvas.addEventListener('webglcontext{kind}', done);
          window.extension.{action}Context();
        }}).then(() => null)""")

    send("lost", "lose")
    assert "restarted" in of_avatar(browser, f"{message}.textContent")
    assert not of_avatar(browser, f"{message}.hidden")
    send("restored", "restore")
    assert of_avatar(browser, f"{message}.hidden")
    assert browser.evaluate(pictures) == before
    of_avatar(browser, "release()")
    assert psnr(browser, head, 0) > 47
    assert browser.errors == []


def test_a_removed_element_stops_and_goes_on_where_it_is_put_back(browser, shown):
    """Catches avatars of an application's earlier views that play on unseen and keep their graphics
    memory, until the browser takes the context of one that is seen; and a move within the page that
    stops one."""
    of_avatar(browser, "setExpression(1, 0.9)")
    found = browser.evaluate("""(async () => {
      const avatar = document.querySelector('stga-avatar');
      const pause = (time) => new Promise((done) => setTimeout(done, time));
      const picture = () => String(avatar.player.read(avatar.player.camera));
      const before = picture();
      const { gl } = avatar.player;
      document.querySelector('nav').append(avatar);
      await pause(50);
      const moved = [gl.isContextLost(), avatar.player.gl === gl];
      avatar.loop = true;
      avatar.play();
      avatar.remove();
      await pause(50);
      const frame = avatar.frame;
      await pause(100);
      const removed = [gl.isContextLost(), avatar.frame === frame];
      document.body.prepend(avatar);
      await pause(300);
      const back = [avatar.player.gl.isContextLost(), avatar.playing && avatar.frame !== frame];
      avatar.pause();
      avatar.frame = 0;
      const hidden = avatar.shadowRoot.querySelector('p').hidden;
      const canvases = avatar.shadowRoot.querySelectorAll('canvas').length;
      return { moved, removed, back, hidden, canvases, same: picture() === before };
    })()""")
    states = {"moved": [False, True], "removed": [True, True], "back": [False, True]}
    assert found == states | {"hidden": True, "canvases": 1, "same": True}
    before = browser.evaluate(CAMERA)
    touch(browser, line((200, 120), (260, 120)))
    assert browser.evaluate(CAMERA) != before
    assert browser.errors == []


@pytest.mark.nightly
def test_ten_minutes_of_play_leave_nothing_behind(browser, head, tmp_path):
    """Catches textures, buffers and objects that pile up, on an accelerated clock."""
    added = browser.send("Page.addScriptToEvaluateOnNewDocument", source=INSTRUMENTS)
    try:
        show(browser, tmp_path, head.data())
    finally:
        browser.send("Page.removeScriptToEvaluateOnNewDocument", **added)
    browser.evaluate("""(() => {
      const avatar = document.querySelector('stga-avatar');
      avatar.style.cssText = 'width: 32px; height: 32px'; // software draws
      document.getElementById('panel').hidden = false; // its sliders follow
      avatar.loop = true;
      avatar.play();
    })()""")

    def played(pictures):
        """Rounds of the motion, WebGL objects alive and bytes of JavaScript afterwards."""
        play = f"window.playFor({BATCH}, {PLAY_RATE})"
        rounds = sum(browser.evaluate(play) for _ in range(pictures // BATCH))
        browser.send("HeapProfiler.collectGarbage")
        used = browser.send("Runtime.getHeapUsage")["usedSize"]
        return rounds, browser.evaluate("window.alive"), used

    _, alive_before, heap_before = played(4 * BATCH)  # compiled by then
    rounds, alive, heap = played(PLAY_S * PLAY_RATE)
    # two recorded frames a second, three in a round
    assert rounds == pytest.approx(PLAY_S * 2 / 3, abs=2)
    assert alive == alive_before
    assert heap < heap_before + MAX_HEAP_GROWTH
    assert browser.errors == []


@pytest.fixture
def server(tmp_path):
    """Address of a plain web server of the folder `site`."""
    (tmp_path / "site").mkdir()

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, format, *values): ...

    handler = functools.partial(Quiet, directory=str(tmp_path / "site"))
    made = ThreadingHTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=made.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{made.server_port}"
    made.shutdown()
    made.server_close()


def test_the_documented_embedding_works(browser, head, tmp_path, server):
    """Catches a snippet of docs/web.md that does not work as it stands, and an element that loads
    something else."""
    site = tmp_path / "site"
    playback = Playback(title="Anna")
    export_avatar(site / "anna.glb", head.avatar, "web", (), head.sequence, playback)
    text = (ROOT / "docs/web.md").read_text(encoding="utf-8")
    markup, script = (re.search(rf"```{k}\n(.*?)```", text, re.DOTALL)[1] for k in ("html", "js"))
    own = '<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,"><h1>Our team</h1>'
    (site / "index.html").write_text(f"{own}{markup}<script>{script}</script>", encoding="utf-8")
    browser.open(f"{server}/index.html")
    found = browser.evaluate("""new Promise((done) => {
      const look = () => {
        const avatar = document.querySelector('stga-avatar');
        if (!avatar.info || !avatar.playing) return setTimeout(look, 20);
        const { coefficients } = avatar.player.motion;
        done({ title: avatar.info.title, height: avatar.clientHeight, width: avatar.clientWidth,
          loop: avatar.loop, background: avatar.background, expression: coefficients[3],
          jaw: avatar.getPose('jaw')[0] });
      };
      look();
    })""")
    assert found["title"] == "Anna"
    assert (found["height"], found["loop"], found["background"]) == (480, True, "#202020")
    assert found["expression"] == pytest.approx(0.8)
    assert found["jaw"] == pytest.approx(0.2)
    assert browser.requests == [f"{server}/{name}" for name in ("index.html", ELEMENT, "anna.glb")]
    assert browser.errors == []


def driven_mesh(head, weights, angles=None):
    """Where ARKit weights (52,) put the head in its first recorded place; angles: yaw, pitch, roll
    of the neck."""
    turned = None if angles is None else angles[None]
    performance = Performance(np.zeros(1), weights[None], turned, 60.0)
    (found,) = head_map(head.sequence, "head").frames(performance)
    first = head.sequence.frame(0)
    neck = first.neck_pose if angles is None else found.neck_pose
    frame = replace(found, rotation=first.rotation, translation=first.translation, neck_pose=neck)
    return forward(head, frame)


def vertices(browser, script):
    """The mesh after a script about `avatar`."""
    found = browser.evaluate(f"""(() => {{
      const avatar = document.querySelector('stga-avatar');
      avatar.pause();
      {script}
      avatar.player.frame = avatar.frame;
      avatar.player.draw();
      return Array.from(avatar.player.rig.vertices);
    }})()""")
    return np.reshape(found, (-1, 3))


def test_face_shapes_and_a_performance(browser, head, tmp_path):
    """Catches ARKit's sliders that move a head otherwise than Blender does, closed lips without an
    open jaw, rows of a CSV that come at the wrong time, and a recording that does not come back."""
    show(browser, tmp_path, head.data(exact=True, controls=page_controls(head.sequence)))
    before = vertices(browser, "avatar.frame = 0;")
    rng = np.random.default_rng(2)
    weights = rng.random(COUNT) * (rng.random(COUNT) < 0.5)
    weights[[COLUMN["jawOpen"], COLUMN["mouthClose"]]] = 0.4, 0.9
    chosen = dict(zip(ARKIT_SHAPES, weights.tolist(), strict=True))
    script = f"""for (const [name, value] of Object.entries({chosen})) {{
        const input = {INPUT};
        input.value = value;
        input.dispatchEvent(new Event('input'));
      }}"""
    found = vertices(browser, script)
    assert_allclose(found, driven_mesh(head, weights), atol=1e-5)
    assert_allclose(vertices(browser, "avatar.release();"), before, atol=1e-12)

    rows = rng.random((4, COUNT)) * 0.5
    turns = rng.normal(0, 0.2, (4, 3))
    take = Performance(np.array([0, 1, 2, 4]) / 30, rows, turns, 30.0)
    write_performance(tmp_path / "take.csv", take)
    text = json.dumps((tmp_path / "take.csv").read_text())
    for frame, row, turn in (
        (0, rows[0], turns[0]),
        (1.5, (rows[1] + rows[2]) / 2, (turns[1] + turns[2]) / 2),
        (3, (rows[2] + rows[3]) / 2, (turns[2] + turns[3]) / 2),  # was lost
        (4, rows[3], turns[3]),
    ):
        found = vertices(browser, f"avatar.setPerformance({text}); avatar.frame = {frame};")
        assert_allclose(found, driven_mesh(head, row, turn), atol=1e-5)
    assert of_avatar(browser, "fps") == pytest.approx(30, rel=1e-3)
    assert browser.evaluate("document.querySelector('#scrub').max") == "4"
    with pytest.raises(AssertionError, match="This file is no table of face shapes"):
        of_avatar(browser, "setPerformance('a,b')")
    found = vertices(browser, "avatar.setPerformance(null);")
    assert_allclose(found, before, atol=1e-12)
