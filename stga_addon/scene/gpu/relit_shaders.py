"""GLSL that lights splats as `light.relight.Relighter` does, and draws shadow maps.

Textures of `relit_packing.py`, read by texel index like those of `shaders.py`:
    surface   per splat: recorded sRGB without what depends on the view, roughness; irradiance of the capture,
              occlusion; corners of its triangle; their weights
    vertices  per vertex: position; normal; irradiance of the world and of skin around
    lights    per layer RELIT_TEXELS; rows of `light.lamps.light_rows`; shadow maps
    shadows   depth of all shadow maps, MAP_COLUMNS beside each other
"""

from typing import Any

import gpu
from gpu.types import GPUShaderCreateInfo, GPUStageInterfaceInfo

from ...light.lamps import BIAS_M, LIFT_M, MAP_SIZE, MAX_BIAS_M, TAP_STEP
from ...light.relight import (
    ALIKE_AT_SPLAT,
    HIGHLIGHT_SHARE,
    MIN_DIFFUSE_SHARE,
    REFLECTANCE,
    UNLIKE_AT_SPLAT,
    WET_HIGHLIGHT_SHARE,
)
from .relit_packing import LIGHT_TEXELS, MAP_TEXELS, RELIT_TEXELS, SURFACE_TEXELS, VERTEX_TEXELS

RELIT_TEXTURES = ("surface", "vertices", "lights", "shadows")
MAP_COLUMNS = 4
NOTHING = 1e30
"""Depth of a shadow map where nothing is."""

RELIT_DEFINES = f"""
#define SURFACE_TEXELS {SURFACE_TEXELS}
#define VERTEX_TEXELS {VERTEX_TEXELS}
#define LIGHT_TEXELS {LIGHT_TEXELS}
#define MAP_TEXELS {MAP_TEXELS}
#define RELIT_TEXELS {RELIT_TEXELS}
#define MAP_COLUMNS {MAP_COLUMNS}
#define MAP_SIZE {MAP_SIZE}
#define LIFT {LIFT_M!r}
#define BIAS {BIAS_M!r}
#define MAX_BIAS {MAX_BIAS_M!r}
#define TAP_STEP {TAP_STEP!r}
#define REFLECTANCE {REFLECTANCE!r}
#define HIGHLIGHT_SHARE {HIGHLIGHT_SHARE!r}
#define WET_HIGHLIGHT_SHARE {WET_HIGHLIGHT_SHARE!r}
#define MIN_DIFFUSE_SHARE {MIN_DIFFUSE_SHARE!r}
#define ALIKE_AT_SPLAT {ALIKE_AT_SPLAT!r}
#define UNLIKE_AT_SPLAT {UNLIKE_AT_SPLAT!r}
#define PI 3.14159265358979
"""

RELIT_FUNCTIONS = """
vec3 srgb_to_linear(vec3 srgb)
{
  vec3 curve = pow((max(srgb, vec3(0.04045)) + 0.055) / 1.055, vec3(2.4));
  return mix(curve, max(srgb, vec3(0.0)) / 12.92, vec3(lessThanEqual(srgb, vec3(0.04045))));
}

vec3 linear_to_srgb(vec3 linear)
{
  vec3 curve = 1.055 * pow(max(linear, vec3(0.0031308)), vec3(1.0 / 2.4)) - 0.055;
  return mix(curve, linear * 12.92, vec3(lessThanEqual(linear, vec3(0.0031308))));
}

float lit_share(int map_index, int first, vec3 point, float cosine)
{
  int row = first + MAP_TEXELS * map_index;
  vec4 p = vec4(point, 1.0), lens = texelFetch(lights, at(row + 3), 0);
  vec3 local = vec3(dot(texelFetch(lights, at(row), 0), p), dot(texelFetch(lights, at(row + 1), 0), p),
                    dot(texelFetch(lights, at(row + 2), 0), p));
  vec2 place = local.xy;
  if (lens.y < 0.5) {
    if (local.z <= 1e-4) {
      return 1.0;
    }
    place /= local.z;
  }
  place = place * lens.x + 0.5 * float(MAP_SIZE);
  float c = clamp(cosine, 0.05, 1.0);
  float bias = min(BIAS + (TAP_STEP + 1.0) * lens.z * sqrt(1.0 - c * c) / c, MAX_BIAS);
  ivec2 corner = MAP_SIZE * ivec2(map_index % MAP_COLUMNS, map_index / MAP_COLUMNS);
  float found = 0.0, z = local.z - bias;
  for (int tap = 0; tap < 9; tap++) {
    vec2 where = place - 0.5 + TAP_STEP * vec2(float(tap % 3 - 1), float(tap / 3 - 1));
    vec2 low = floor(where), share = where - low;
    for (int k = 0; k < 4; k++) {
      ivec2 texel = ivec2(low) + ivec2(k & 1, k >> 1);
      bool outside = texel.x < 0 || texel.y < 0 || texel.x >= MAP_SIZE || texel.y >= MAP_SIZE;
      texel = corner + clamp(texel, ivec2(0), ivec2(MAP_SIZE - 1));
      if (outside || z <= texelFetch(shadows, texel, 0).r) {
        found += ((k & 1) == 1 ? share.x : 1.0 - share.x) * ((k >> 1) == 1 ? share.y : 1.0 - share.y);
      }
    }
  }
  return found / 9.0;
}

float ggx(float facing, float toward_eye, float half_cosine, float fresnel_cosine, float square)
{
  float spread = half_cosine * half_cosine * (square - 1.0) + 1.0;
  float distribution = square / (PI * spread * spread);
  float shadowing = facing * sqrt(toward_eye * toward_eye * (1.0 - square) + square)
                  + toward_eye * sqrt(facing * facing * (1.0 - square) + square);
  float fresnel = REFLECTANCE + (1.0 - REFLECTANCE) * pow(1.0 - fresnel_cosine, 5.0);
  return 0.5 * distribution * fresnel / shadowing;
}

vec3 sky_highlight(int row, vec3 normal, vec3 view, float roughness, float occlusion)
{
  float cosine = max(dot(normal, view), 0.02);
  vec3 d = 2.0 * cosine * normal - view;
  row += 4;
  vec3 seen = 0.28209479177387814 * texelFetch(lights, at(row), 0).rgb;
  seen += 0.4886025119029199 * (d.y * texelFetch(lights, at(row + 1), 0).rgb
          + d.z * texelFetch(lights, at(row + 2), 0).rgb + d.x * texelFetch(lights, at(row + 3), 0).rgb);
  seen += 1.0925484305920792 * (d.x * d.y * texelFetch(lights, at(row + 4), 0).rgb
          + d.y * d.z * texelFetch(lights, at(row + 5), 0).rgb + d.x * d.z * texelFetch(lights, at(row + 7), 0).rgb);
  seen += 0.31539156525252005 * (3.0 * d.z * d.z - 1.0) * texelFetch(lights, at(row + 6), 0).rgb
          + 0.5462742152960396 * (d.x * d.x - d.y * d.y) * texelFetch(lights, at(row + 8), 0).rgb;
  float x = 1.0 - roughness, y = 0.0425 - 0.0275 * roughness;
  float z = 1.04 - 0.572 * roughness, w = 0.022 * roughness - 0.04;
  float share = min(x * x, exp2(-9.28 * cosine)) * x + y;
  return max(seen, vec3(0.0)) * occlusion * (REFLECTANCE * (z - 1.04 * share) + 1.04 * share + w);
}

vec3 relit(int splat, int layer, vec3 recorded, vec3 strain_color)
{
  int row = RELIT_TEXELS * layer;
  vec4 factor = texelFetch(lights, at(row), 0), settings = texelFetch(lights, at(row + 1), 0);
  vec4 eye = texelFetch(lights, at(row + 2), 0), typical = texelFetch(lights, at(row + 3), 0);
  if (factor.x <= 0.0) {
    return recorded;
  }
  int first = SURFACE_TEXELS * splat;
  vec4 color = texelFetch(surface, at(first), 0), old = texelFetch(surface, at(first + 1), 0);
  ivec3 corners = VERTEX_TEXELS * ivec3(texelFetch(surface, at(first + 2), 0).xyz + 0.5);
  vec3 weights = texelFetch(surface, at(first + 3), 0).xyz, means[3];
  for (int k = 0; k < 3; k++) {
    means[k] = weights.x * texelFetch(vertices, at(corners.x + k), 0).xyz
             + weights.y * texelFetch(vertices, at(corners.y + k), 0).xyz
             + weights.z * texelFetch(vertices, at(corners.z + k), 0).xyz;
  }
  vec3 normal = means[1] / max(length(means[1]), 1e-12), point = means[0] + LIFT * normal;
  vec3 arriving = means[2], highlight = vec3(0.0), view = normalize(eye.xyz - point);
  float roughness = color.a > 0.0 ? color.a : settings.x, alpha = roughness * roughness;
  float toward_eye = max(dot(normal, view), 0.05);
  for (int n = 0; n < int(settings.w); n++) {
    int texel = int(settings.z) + LIGHT_TEXELS * n;
    vec4 a = texelFetch(lights, at(texel), 0), b = texelFetch(lights, at(texel + 1), 0);
    vec4 c = texelFetch(lights, at(texel + 2), 0), d = texelFetch(lights, at(texel + 3), 0);
    vec3 shining = b.xyz, light_color = vec3(b.w, c.xy), toward = -shining;
    float strength = 1.0, width = d.w;
    int kind = int(a.x + 0.5);
    if (kind != 0) {
      toward = a.yzw - point;
      float square = max(dot(toward, toward), 1e-8), away = inversesqrt(square);
      toward *= away;
      strength = 1.0 / square;
      width *= away;
      float along = -dot(toward, shining);
      if (kind == 3) {
        strength *= max(along, 0.0);
      }
      else if (kind == 2) {
        float inside = clamp((along - c.z) / c.w, 0.0, 1.0);
        strength *= inside * inside * (3.0 - 2.0 * inside);
      }
    }
    float facing = dot(normal, toward);
    if (facing <= 0.0 || strength <= 0.0) {
      continue;
    }
    if (d.x > -0.5) {
      strength *= lit_share(int(d.x + 0.5), int(typical.w + 0.5), point, facing);
    }
    vec3 light = light_color * strength * facing, between = normalize(toward + view);
    float wide = min(alpha * alpha + 0.125 * width * width, 1.0);
    arriving += light * d.y;
    highlight += light * d.z * ggx(facing, toward_eye, clamp(dot(normal, between), 0.0, 1.0),
                                   clamp(dot(view, between), 0.0, 1.0), wide);
  }
  vec3 sky_view = normalize(eye.xyz - means[0]);
  highlight += sky_highlight(row, normal, sky_view, roughness, old.a);
  vec3 base = srgb_to_linear(max(color.rgb + strain_color, vec3(0.0)));
  vec3 glossy = (color.a > 0.0 ? WET_HIGHLIGHT_SHARE : HIGHLIGHT_SHARE) / PI * old.rgb;
  vec3 albedo = PI * max(base - glossy, MIN_DIFFUSE_SHARE * base) / max(old.rgb, vec3(1e-6));
  if (eye.w > 0.0) {
    albedo = pow(max(albedo, vec3(1e-4)), vec3(1.0 - eye.w)) * pow(typical.rgb, vec3(eye.w));
  }
  vec3 lit = albedo * arriving / PI + settings.y * highlight, was = srgb_to_linear(max(recorded, vec3(0.0)));
  vec4 kept = texelFetch(lights, at(row + 13), 0);
  if (kept.a > 0.0) {
    vec3 same = kept.rgb * old.rgb;
    float off = length(arriving - same) / max(length(same), 1e-6);
    lit = mix(lit, kept.rgb * was, kept.a * (1.0 - smoothstep(ALIKE_AT_SPLAT, UNLIKE_AT_SPLAT, off)));
  }
  return linear_to_srgb(mix(was, lit * factor.yzw, factor.x));
}
"""

_MAP_VERTEX = """
void main()
{
  vec3 local = vec3(dot(row_x, vec4(position, 1.0)), dot(row_y, vec4(position, 1.0)), dot(row_z, vec4(position, 1.0)));
  distance_out = local.z;
  vec2 place = local.xy * lens.x;
  /* Depths from lens.z to infinity before a light, and 1 km around a sun's center. */
  gl_Position = lens.y > 0.5 ? vec4(place, local.z * 1e-3, 1.0) : vec4(place, local.z - 2.0 * lens.z, local.z);
}
"""

_MAP_FRAGMENT = """
void main()
{
  depth_out = distance_out;
}
"""


def shadow_map_shader() -> Any:
    """Draws triangles into a shadow map: depth in meters along the light's axis.

    row_x, row_y, row_z: as packed by `relit_packing`; lens: scale to normalized device coordinates, whether parallel,
    least depth in perspective.
    """
    info = GPUShaderCreateInfo()
    info.vertex_in(0, "VEC3", "position")
    passed = GPUStageInterfaceInfo("stga_shadow")
    # In perspective, depth itself is interpolated as it should be: linear in space.
    passed.smooth("FLOAT", "distance_out")
    info.vertex_out(passed)
    info.fragment_out(0, "FLOAT", "depth_out")
    for name in ("row_x", "row_y", "row_z", "lens"):
        info.push_constant("VEC4", name)
    info.vertex_source(_MAP_VERTEX)
    info.fragment_source(_MAP_FRAGMENT)
    return gpu.shader.create_from_info(info)
