"""The GPU display in a Blender with a window, as on screen, against the CPU rasterizer."""

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import filelock
import numpy as np
import pytest
from blender.test_gpu_renderer import avatar, check_shadow_map, psnr_db
from PIL import Image

from stga_addon.avatar.file import AvatarLight, write_avatar
from stga_addon.capture.camera import Camera
from stga_addon.capture.color import linear_to_srgb, srgb_to_linear
from stga_addon.light.harmonics import uniform
from stga_addon.light.lamps import ShadowMap
from stga_addon.light.surface import transfer_of
from stga_addon.light.values import Light
from stga_addon.raster.cpu.compose import compose
from stga_addon.raster.posed_splats import PosedSplats

from .conftest import BLENDER

ROOT = Path(__file__).resolve().parents[2]
MIN_PSNR_DB = 42.0
BORDER_PX = 40
"""Of the viewport, where Blender draws rounded corners and arrows."""
BEHIND = linear_to_srgb(np.array([0.2, 0.3, 0.4]))
PROBE = (
    "import bpy, gpu, os; print('BACKEND', gpu.platform.backend_type_get(), flush=True); "
    "os._exit(0)"
)


def has_vulkan():
    """Whether Blender starts with Vulkan and does not fall back to OpenGL."""
    command = [*BLENDER, "--factory-startup", "--gpu-backend", "vulkan", "--python-expr", PROBE]
    return (
        "BACKEND VULKAN"
        in subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300).stdout
    )


@pytest.fixture(scope="module", params=["opengl", "vulkan"])
def shown(request, tmp_path_factory):
    """The folder with the pictures, and what display_script.py saw, by each GPU backend."""
    backend = request.param
    if backend == "vulkan" and not has_vulkan():
        pytest.skip("Blender does not start with Vulkan here: too old, or no driver")
    folder = tmp_path_factory.mktemp("display")
    of = avatar(3)
    transfer, occlusion = transfer_of(of.neutral, of.faces, 64)
    world = uniform(np.ones(3)).astype(np.float32)
    skin = np.zeros(len(of.neutral), np.float32)
    light = AvatarLight(
        world, transfer, occlusion, (transfer @ world).astype(np.float32), skin, 0.0
    )
    write_avatar(folder / "avatar.npz", replace(of, light=light))
    shutil.copytree(Path(filelock.__file__).parent, folder / "packages/filelock")
    script = Path(__file__).with_name("display_script.py")
    command = [*BLENDER, "--factory-startup", "--gpu-backend", backend]
    command += ["--python", str(script), "--", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=900)
    assert (folder / "result.json").exists(), done.stdout[-3000:] + done.stderr[-3000:]
    result = json.loads((folder / "result.json").read_text())
    print({name: result[name] for name in ("version", "device", "pictures")})
    assert "traceback" not in result, result["traceback"]
    assert result["device"] == backend.upper()
    return folder, result


def on_screen(folder, result, name):
    """(3, H, W) sRGB of the viewport in the screenshot, less its border, and its camera."""
    with np.load(folder / "views.npz") as views:
        width, height, *lens = views[name].tolist()
        camera = Camera(int(width), int(height), *lens, views[f"{name} pose"])
    x, y = result["pictures"][name]
    with Image.open(folder / f"{name}.png") as screenshot:
        pixels = np.asarray(screenshot.convert("RGB"), np.float32)[
            y : y + camera.height, x : x + camera.width
        ]
    width = camera.width - 2 * BORDER_PX
    height = camera.height - 2 * BORDER_PX
    m = BORDER_PX
    middle = replace(camera, width=width, height=height, cx=camera.cx - m, cy=camera.cy - m)
    return pixels[m:-m, m:-m].transpose(2, 0, 1) / 255, middle


@pytest.mark.parametrize("name", ["solid", "wireframe", "orthographic", "filmic", "engine"])
def test_viewport_equals_the_rasterizer(shown, name):
    """Catches colors that a view transform, a blend or an offset of the viewport changes."""
    folder, result = shown
    found, camera = on_screen(folder, result, name)
    with np.load(folder / "views.npz") as views:
        pose = views["pose"]
    expected = avatar(3)
    layer = PosedSplats(
        expected.splats, expected.frames(expected.neutral), pose, expected.antialiased
    )
    image = compose([layer], camera)
    behind = np.zeros(3) if name == "engine" else BEHIND
    picture = np.clip(image.rgb + (1 - image.alpha) * behind[:, None, None], 0, 1)
    print(f"{name}: {psnr_db(found, picture):.1f} dB")
    assert image.alpha.mean() > 0.02, "nothing to compare"
    assert psnr_db(found, picture) >= MIN_PSNR_DB


@pytest.mark.parametrize("name", ["material agx", "engine filmic", "engine filmic points"])
def test_view_transforms_leave_colors(shown, name):
    """Catches splats that AgX or Filmic changes, in any mode."""
    folder, result = shown
    found, plain = (on_screen(folder, result, which)[0] for which in (name, "solid"))
    same_view = {which: on_screen(folder, result, which)[1] for which in (name, "solid")}
    assert np.allclose(same_view[name].world_to_camera, same_view["solid"].world_to_camera)
    colored = np.ptp(plain, axis=0) > 0.4  # little of the background is seen there
    assert colored.sum() > 1000
    assert np.median(np.abs(found - plain)[:, colored]) < 3 / 255


def test_shadow_maps(shown):
    """Catches a head that throws no shadow on itself."""
    folder, result = shown
    atlas = np.load(folder / "shadows.npy")
    of = avatar(3)
    assert set(result["lights"]) == {"sun", "point"}
    for index, (kind, place) in enumerate(result["lights"].items()):
        light = Light(kind, np.ones(3), place[:3], direction=place[3:])
        check_shadow_map(atlas, index, ShadowMap(of.neutral, of.faces, light).depth)


def test_bones_in_front(shown):
    """Catches splats that cover bones drawn in front, and holes around such bones."""
    folder, result = shown
    names = ("bone and splats", "bone", "hidden", "solid")
    both, bone, nothing, splats = (on_screen(folder, result, name)[0] for name in names)
    is_bone = np.abs(bone - nothing).max(0) > 0.1
    is_covered = is_bone & (np.ptp(splats, axis=0) > 0.25)
    assert is_covered.sum() > 300
    # by the background's light
    darker = linear_to_srgb(np.maximum(srgb_to_linear(bone) - srgb_to_linear(nothing), 0))
    assert np.median(np.abs(both - darker).max(0)[is_covered]) < 0.05
    away = ~is_bone
    assert np.median(np.abs(both - splats).max(0)[away & (np.ptp(splats, axis=0) > 0.25)]) < 2 / 255
    assert psnr_db(np.where(away, both, 0), np.where(away, splats, 0)) > 30


def test_what_else_is_displayed(shown):
    """Catches splats where they are hidden or clipped, ignored depth, and modes without."""
    folder, result = shown
    assert result["problem"] == ""
    pictures = {name: on_screen(folder, result, name)[0] for name in result["pictures"]}
    assert np.ptp(pictures["hidden"], axis=(1, 2)).max() < 0.02
    for name in ("material", "material with overlays", "engine filmic"):
        assert (np.ptp(pictures[name], axis=0) > 0.25).sum() > 1000, name
    with_quad = np.abs(pictures["quad"] - pictures["solid"]).max(0) > 0.1
    splats = np.abs(pictures["solid"] - pictures["hidden"]).max(0) > 0.05
    assert 0.2 < (with_quad & splats).sum() / splats.sum() < 0.8, "the quad cuts the ball in half"
    colored = {name: np.ptp(picture, axis=0) > 0.25 for name, picture in pictures.items()}
    assert colored["solid"].sum() > 1000
    assert not colored["local view"].any()
    assert 0.3 < colored["clipped"].sum() / colored["solid"].sum() < 0.85
    with Image.open(folder / "four views.png") as screenshot:
        whole = np.ptp(np.asarray(screenshot.convert("RGB"), np.float32) / 255, axis=2) > 0.5
    height = whole.shape[0] * 9 // 10
    width = whole.shape[1] * 8 // 10
    assert all(
        whole[y : y + height // 2, x : x + width // 2].sum() > 100
        for y in (0, height // 2)
        for x in (0, width // 2)
    )


def test_errors_and_the_end(shown):
    """Catches an endless error or wait, what outlives its use, and splats lost to undo."""
    folder, result = shown
    failed, removed, problem = result["failed"]
    assert failed
    assert removed
    assert "out of memory" in problem
    assert result["reports"] == 2, "a traceback and a sentence"
    assert result["unregistered"] == [True, True]
    assert result["after load"] == [True, True, ""]
    assert result["drawn"] == [1, 1, 1, 1], "at first, after undo, after off, and in the next file"
    assert result["drawn without"] == 0
    ended = dict.fromkeys(("off", "removed", "disabled", "loaded"), True)
    assert result["freed"] == {"while drawn": False, **ended}
    assert result["undone"]
    before, after = (on_screen(folder, result, name)[0] for name in ("solid", "after undo"))
    assert psnr_db(after, before) > MIN_PSNR_DB
    assert result["rendered"], "without the view transform, which the main thread measures"
