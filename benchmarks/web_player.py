"""What the web page's player computes in JavaScript for one frame, and how soon a page shows its first.

    python benchmarks/web_player.py [--splats 65536] [--repeats 40]

A rig of FLAME's full size (5,143 vertices, 100 expressions, 5 joints, 36 pose correctives), all coefficients in motion,
splats of SH degree 3 whose colors and positions follow strain, in a headless Chromium with software WebGL 2. *Floor*:
the bytes that the part must at least move, at the copy bandwidth of JavaScript measured in the same page. Upload and
draw calls are what the calls take until they return; what the graphics card does afterwards is not in them. Run it on
an idle machine.
"""

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))

from export.web.browser import Browser, find_browser
from redraw import head_mesh

from stga_addon.avatar.embedding import face_frames
from stga_addon.avatar.file import Avatar
from stga_addon.avatar.splats import Splats
from stga_addon.capture.camera import look_at
from stga_addon.export.playback import Playback
from stga_addon.export.web.data_file import data_file
from stga_addon.export.web.page import page
from stga_addon.export.web.rig import WebRig
from stga_addon.flame.model import JOINTS

GRID = 37, 139
"""Rings and vertices around, of a closed grid with FLAME's 5,143 vertices, and 10,008 triangles."""
EXPRESSIONS, FRAMES = 100, 60
FIRST_FRAME_SPLATS = 30_000
WINDOW_PX = (900, 700)

ON_LOAD = """document.addEventListener('load', (event) => {
  if (event.target.localName !== 'stga-avatar') return;
  requestAnimationFrame(() => setTimeout(() => { // in which it is drawn
    const { gl } = document.querySelector('stga-avatar').player;
    gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4)); // waits until the picture is there
    window.firstFrame = performance.now(); // since the page was opened
  }));
}, true)"""
FIRST_FRAME = """new Promise((done) => {
  const look = () => (window.firstFrame ? done(window.firstFrame) : setTimeout(look, 20));
  look();
})"""

MEASURE = """(async (repeats) => {
  const avatar = document.querySelector('stga-avatar');
  avatar.pause();
  await new Promise((done) => setTimeout(done, 300));
  const { player } = avatar;
  const { gl, motion, rig, faceFrames, depthSort, renderer } = player;
  const values = renderer.frameValues;
  const camera = player.camera;
  renderer.count = 1024; // instances of the draw call: software would draw all of them for seconds
  let moment = 0;
  const median = (times) => times.sort((a, b) => a - b)[times.length >> 1];
  // The first repetitions are compiled on the way, and do not count.
  const computed = (work) => {
    const times = [];
    for (let k = 0; k < repeats + 10; k++) {
      const begin = performance.now();
      for (let i = 0; i < 5; i++) work(); // several, as clocks of browsers are coarse
      if (k >= 10) times.push((performance.now() - begin) / 5);
    }
    return median(times);
  };
  const submitted = (work) => {
    const times = [];
    for (let k = 0; k < 12; k++) {
      gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4)); // until nothing is left to draw
      const begin = performance.now();
      work();
      if (k >= 3) times.push(performance.now() - begin);
    }
    return median(times);
  };
  const pose = () => {
    moment = (moment + 0.37) % (motion.frames - 1);
    motion.sample(moment);
    rig.pose(motion.coefficients, motion.pose, motion.translation);
  };
  const order = depthSort.sort(values);
  const draw = () => renderer.draw(order, camera, player.background, false);
  const block = new Float32Array(1 << 21);
  const copy = new Float32Array(1 << 21);
  const bytes = (...arrays) => arrays.reduce((sum, array) => sum + array.byteLength, 0);
  const { strain, offsets: [{ signal: smoothed, components, coefficients }] } = faceFrames;
  const still = faceFrames.world.slice(); // moved again and again, triangles would leave the head
  const frame = () => {
    moment = (moment + 0.37) % (motion.frames - 1);
    player.frame = moment;
    player.draw();
  };
  const parts = [
    ['rig', computed(pose), bytes(rig.basis, rig.correctives, rig.weights, rig.vertices)],
    ['face frames', computed(() => faceFrames.placeFrames(rig.vertices)),
      bytes(rig.vertices, faceFrames.faces, faceFrames.world)],
    ['strain', computed(() => strain.update(rig.vertices)),
      bytes(rig.vertices, strain.faces, strain.gram, strain.toTensor, strain.toPlane, strain.atVertex, strain.values)],
    ['smoothed strain', computed(() => smoothed.update()),
      bytes(strain.values, smoothed.rest,
        ...Array(3).fill([smoothed.values, smoothed.edges, smoothed.edgeSum]).flat())],
    ['driven offsets', computed(() => {
      faceFrames.world.set(still);
      faceFrames.moveOrigins(smoothed.values, components, coefficients);
    }), bytes(faceFrames.world, still, coefficients, smoothed.values)],
    ['in camera space', computed(() => (faceFrames.compose(camera.matrix, values), faceFrames.annotate(null, values))),
      bytes(faceFrames.world, strain.values, values)],
    ['sort', computed(() => depthSort.sort(values)),
      bytes(depthSort.xyz, depthSort.depth, depthSort.key, depthSort.byLow, depthSort.order)],
    ['upload', submitted(() => renderer.upload(order)), bytes(values, order)],
    ['upload and draw calls', submitted(draw), bytes(values, order)],
    ['whole frame', submitted(frame), 0],
  ];
  const bandwidth = (2 * block.byteLength) / computed(() => copy.set(block)); // bytes read and written a millisecond
  return { parts, bandwidth };
})"""


def head_rig(vertices: np.ndarray) -> WebRig:
    """A rig of FLAME's size in which every coefficient, joint and weight counts."""
    rng = np.random.default_rng(0)
    waves = rng.uniform(0, 6, (EXPRESSIONS, 3, 3))
    weights = rng.random((len(vertices), len(JOINTS)))
    joints = len(JOINTS)
    return WebRig(
        base=vertices,
        basis=np.stack([1e-3 * np.sin(vertices @ (20 * wave) + wave[0]) for wave in waves]),
        correctives=rng.normal(0, 1e-5, (9 * (joints - 1), *vertices.shape)),
        joints=rng.normal(0, 0.02, (joints, 3)),
        joint_basis=rng.normal(0, 1e-4, (EXPRESSIONS, joints, 3)),
        joint_names=JOINTS,
        parents=(-1, 0, 1, 1, 1),
        weights=weights / weights.sum(1, keepdims=True),
        coefficients=rng.normal(0, 0.3, (FRAMES, EXPRESSIONS)),
        pose=rng.normal(0, 0.05, (FRAMES, joints, 3)),
        translation=rng.normal(0, 0.002, (FRAMES, 3)),
        expressions=EXPRESSIONS,
    )


def head_page(count: int) -> str:
    """The page of a head of `count` splats."""
    vertices, faces = head_mesh(*GRID)
    rng = np.random.default_rng(1)
    unit = face_frames(vertices, faces, vertices).scale.max()
    splats = Splats(
        xyz=rng.normal(0, 5e-4 / unit, (count, 3)).astype(np.float32),
        rotation=rng.normal(size=(count, 4)).astype(np.float32),
        log_scale=rng.normal(np.log(1e-3), 0.3, (count, 3)).astype(np.float32),
        opacity=rng.normal(1, 1, count).astype(np.float32),
        sh=rng.normal(0, 0.2, (count, 16, 3)).astype(np.float32),
        face=rng.integers(0, len(faces), count).astype(np.int32),
        unbound=np.zeros(count, bool),
        strain_color=rng.normal(0, 0.1, (count, 3, 3)).astype(np.float32),
    )
    moves = rng.normal(0, 1e-3, (len(faces), 3, 3)).astype(np.float32)
    avatar = Avatar(
        splats, "stga", vertices.astype(np.float32), faces, antialiased=True, driven_offsets={"strain_position": moves}
    )
    views = {"Front": look_at((0, 0, 1), (0, 0, 0), *WINDOW_PX, 2000.0)}
    return page("Benchmark", "", data_file(avatar, head_rig(vertices), Playback(views=views)))


def open_page(browser: Browser, file: Path, splats: int) -> float:
    """Milliseconds from opening the page of a head until its first frame is drawn."""
    file.write_text(head_page(splats), encoding="utf-8")
    browser.open(file.as_uri())
    return float(browser.evaluate(FIRST_FRAME))


def report(measured: dict[str, Any]) -> None:
    """Print the parts of a frame: milliseconds, megabytes, floor and how far above it."""
    per_ms = measured["bandwidth"]
    print("| part | ms | MB | floor ms | ratio |\n|---|---|---|---|---|")
    for name, milliseconds, moved in measured["parts"]:
        floor = moved / per_ms
        ratio = f"{floor:.2f} | {milliseconds / floor:.1f}" if moved else "|"
        print(f"| {name} | {milliseconds:.2f} | {moved / 1e6:.1f} | {ratio} |")
    print(f"\nCopy bandwidth {per_ms / 1e6:.1f} GB/s.")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--splats", type=int, default=65_536)
    parser.add_argument("--repeats", type=int, default=40)
    options = parser.parse_args()
    if options.repeats < 1 or options.splats < 1:
        parser.error("--splats and --repeats must be at least 1")
    executable = find_browser()
    if executable is None:
        parser.error("no Chromium on this machine (apt-get install chromium)")
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:  # the browser may still write
        browser = Browser(executable, Path(folder) / "profile", WINDOW_PX)
        try:
            browser.send("Page.addScriptToEvaluateOnNewDocument", source=ON_LOAD)
            first = open_page(browser, Path(folder) / "first.html", FIRST_FRAME_SPLATS)
            open_page(browser, Path(folder) / "frames.html", options.splats)
            report(browser.evaluate(f"{MEASURE}({options.repeats})"))
        finally:
            browser.close()
    print(f"First frame of {FIRST_FRAME_SPLATS} splats {first / 1000:.2f} s after opening the page.")


if __name__ == "__main__":
    main()
