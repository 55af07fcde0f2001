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

from ...light.shading import SHADING_DEFINES, SHADING_FUNCTIONS
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
#define SHADOW_DEPTH(cell) texelFetch(shadows, cell, 0).r
#define WORLD(first, k) texelFetch(lights, at(first + k), 0).rgb
{SHADING_DEFINES}"""

RELIT_FUNCTIONS = (
    SHADING_FUNCTIONS
    + """
float lit_share_of(int map_index, int first, vec3 point, float cosine)
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
  ivec2 corner = MAP_SIZE * ivec2(map_index % MAP_COLUMNS, map_index / MAP_COLUMNS);
  return lit_share(corner, place, local.z - shadow_bias(cosine, lens.z));
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
      strength *= lit_share_of(int(d.x + 0.5), int(typical.w + 0.5), point, facing);
    }
    vec3 light = light_color * strength * facing;
    float wide = min(alpha * alpha + 0.125 * width * width, 1.0);
    arriving += light * d.y;
    highlight += light * d.z * ggx(normal, toward, view, wide);
  }
  highlight += sky_highlight(row + 4, normal, normalize(eye.xyz - means[0]), roughness, old.a);
  color.rgb += strain_color;
  typical.a = eye.w;
  vec4 kept = texelFetch(lights, at(row + 13), 0);
  vec3 lit = lit_color(color, old.rgb, arriving, settings.y * highlight, recorded, typical, kept);
  return linear_to_srgb(mix(srgb_to_linear(max(recorded, vec3(0.0))), lit * factor.yzw, factor.x));
}
"""
)

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
