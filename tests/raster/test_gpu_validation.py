"""A whole iteration and a rendering under Vulkan's validation layers."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

LAYER = "VK_LAYER_KHRONOS_validation"
SCRIPT = """
import sys
from pathlib import Path
from render.test_compose import CAMERA, scene
from stga_addon.capture.open import open_capture
from stga_addon.raster.gpu import compose
from training.test_gpu_backend import batch_of, disturbed, settings_of
from stga_addon.training.optimize.make_backend import make_backend
from stga_addon.training.optimize.frames import FrameStore

adapter, root = sys.argv[1:]
compose.compose(adapter, scene(), CAMERA, True)
toy, settings = open_capture(Path(root)), settings_of()
frames = FrameStore(toy, settings.convention, True)
backend = make_backend(f"gpu:{adapter}", settings, frames, disturbed(toy, settings))
for part in (None, toy.regions["mouth"]):
    backend.step(batch_of(toy, settings, selected=part))
assert len(backend.state.steps)
assert "libVkLayer_khronos_validation" in Path("/proc/self/maps").read_text()
"""


@pytest.mark.nightly
@pytest.mark.needs("adapter", "vulkan-validation")
def test_vulkan_validation_has_nothing_to_say(device, toy_root, tmp_path):
    """Catches a race between dispatches, or a buffer's use, that one driver forgives and another
    does not."""
    log = tmp_path / "validation.log"
    settings = tmp_path / "vk_layer_settings.txt"
    log.touch()
    settings.write_text(
        "khronos_validation.debug_action = VK_DBG_LAYER_ACTION_LOG_MSG\n"
        "khronos_validation.report_flags = error,warn\n"
        f"khronos_validation.log_filename = {log}\n"
    )
    tests = Path(__file__).parents[1]
    environment = {
        **os.environ,
        "VK_INSTANCE_LAYERS": LAYER,
        "VK_LAYER_SETTINGS_PATH": str(settings),
        "PYTHONPATH": os.pathsep.join(map(str, (tests, tests.parent))),
    }
    command = [sys.executable, "-c", SCRIPT, device.name, str(toy_root)]
    ran = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert ran.returncode == 0, ran.stderr
    messages = [
        line
        for line in (log.read_text() + ran.stdout + ran.stderr).splitlines()
        if "alidation" in line
    ]
    assert not messages, "\n".join(messages)
