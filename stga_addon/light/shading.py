"""GLSL that lights splats as `relight.Relighter` does, for Blender and the web page."""

from pathlib import Path

from ..raster.shader_constants import printed_constants
from . import lamps, relight, values

_CONSTANTS = {"MAP_SIZE": lamps.MAP_SIZE, "LIFT": lamps.LIFT_M, "BIAS": lamps.BIAS_M}
_CONSTANTS |= {
    "MAX_BIAS": lamps.MAX_BIAS_M,
    "TAP_STEP": float(lamps.TAP_STEP),
    "PI": 3.14159265358979,
}
_FRACTIONS = "HIGHLIGHT_FRACTION", "WET_HIGHLIGHT_FRACTION", "MIN_DIFFUSE_FRACTION"
for _name in ("REFLECTANCE", *_FRACTIONS, "ALIKE_AT_SPLAT", "UNLIKE_AT_SPLAT"):
    _CONSTANTS[_name] = getattr(relight, _name)
_CONSTANTS |= {name: getattr(values, name) for name in ("SKIN_ROUGHNESS", "HAIR_ROUGHNESS")}
_CONSTANTS |= {f"VIEW_MEAN_{degree}": mean for degree, mean in enumerate(relight.VIEW_MEANS)}
SHADING_DEFINES = printed_constants(_CONSTANTS, "glsl")
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
