"""GLSL that projects splats and fades them as the rasterizers do, for Blender and the web page."""

from pathlib import Path

from .shader_constants import printed_constants

MIN_ALPHA = 1 / 255  # a splat adds nothing to a pixel where its alpha is less
LOW_PASS_PX2 = 0.3  # added to the variance of splats on the screen
_CONSTANTS = {
    "MIN_ALPHA": MIN_ALPHA,
    "MAX_ALPHA": 0.999,
    "LOW_PASS_PX2": LOW_PASS_PX2,
    "SLOPE_MARGIN": 0.15,
}
SPLAT_DEFINES = printed_constants(_CONSTANTS, "glsl")
SPLAT_FUNCTIONS = Path(__file__).with_name("splat.glsl").read_text(encoding="utf-8")
