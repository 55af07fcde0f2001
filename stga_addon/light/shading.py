"""GLSL that lights splats as `relight.Relighter` does, for Blender and the web page."""

from pathlib import Path

from . import lamps, relight

SHADING_DEFINES = f"""
#define MAP_SIZE {lamps.MAP_SIZE}
#define LIFT {lamps.LIFT_M!r}
#define BIAS {lamps.BIAS_M!r}
#define MAX_BIAS {lamps.MAX_BIAS_M!r}
#define TAP_STEP {lamps.TAP_STEP!r}
#define REFLECTANCE {relight.REFLECTANCE!r}
#define HIGHLIGHT_SHARE {relight.HIGHLIGHT_SHARE!r}
#define WET_HIGHLIGHT_SHARE {relight.WET_HIGHLIGHT_SHARE!r}
#define MIN_DIFFUSE_SHARE {relight.MIN_DIFFUSE_SHARE!r}
#define ALIKE_AT_SPLAT {relight.ALIKE_AT_SPLAT!r}
#define UNLIKE_AT_SPLAT {relight.UNLIKE_AT_SPLAT!r}
#define PI 3.14159265358979
"""
SRGB_FUNCTIONS = """
vec3 srgb_to_linear(vec3 srgb)
{
  vec3 curve = pow((max(srgb, vec3(0.04045)) + 0.055) / 1.055, vec3(2.4));
  return mix(curve, max(srgb, vec3(0.0)) / 12.92, vec3(lessThanEqual(srgb, vec3(0.04045))));
}

vec3 linear_to_srgb(vec3 light)
{
  vec3 curve = 1.055 * pow(max(light, vec3(0.0031308)), vec3(1.0 / 2.4)) - 0.055;
  return mix(curve, light * 12.92, vec3(lessThanEqual(light, vec3(0.0031308))));
}
"""
SHADING_FUNCTIONS = SRGB_FUNCTIONS + Path(__file__).with_suffix(".glsl").read_text(encoding="utf-8")
