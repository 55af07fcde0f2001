"""GLSL that projects, lights and draws splats and puts them into a viewport, and shaders made of
it.

Textures of `packing.py`, each 2048 texels wide and read by texel index:
    orders   per splat drawn, farthest first: index of the splat (one channel)
    centers  per splat: xyz in its triangle's frame, index of the triangle
    axes     per splat: three axes times standard deviations; beside them opacity, random
             percentage, layer
    colors   per splat: spherical harmonics
    frames   three rows of the triangles' maps to camera space (all triangles' first rows, then
             second, …), then color and 1 where frozen plus 2 where unseen, then color where the
             scene lights them
    table    the view: focal lengths and principal point; width, height, number of clip planes; 6
             clip planes; per layer: first color, first splat, colors per splat, degree;
             antialiased, size, opacity threshold, 0; three rows of the matrix to directions,
             with percentage, how frozen and how unseen splats are shown (1: painted, 2: not)
Where the scene lights splats, as `light.relight.Relighter` does:
    surface   per splat: recorded sRGB without what depends on the view, roughness; irradiance of
              the capture, occlusion; corners of its triangle; their weights
    vertices  per vertex: position; normal; irradiance of the world and of skin around
    lights    per layer RELIT_TEXELS; rows of `light.lamps.light_rows`; shadow maps
    shadows   depth of all shadow maps, MAP_COLUMNS beside each other

From these, a first pass computes what is drawn of each splat, once for the four corners of its
rectangle; a second pass draws the rectangles. In between are textures as wide, in the order of
drawing:
    places   center in normalized device coordinates, depth in meters, standard deviations up to the
             rectangle's sides (0: the splat is not drawn)
    sides    the rectangle's two half axes in normalized device coordinates
    shades   color in sRGB, opacity
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import gpu

from ...avatar.splats import harmonics_text
from ...light.shading import SHADING_DEFINES, SHADING_FUNCTIONS, SRGB_FUNCTIONS
from ...raster.shader_constants import printed_constants
from ...raster.splat_shader import SPLAT_DEFINES, SPLAT_FUNCTIONS
from ..compat import allow_depth_write
from ..layers import FROZEN_COLOR_SRGB, UNSEEN_COLOR_SRGB
from . import packing
from .buffers import TEXTURE_WIDTH

PACKED_TEXTURES = ("orders", "centers", "axes", "colors", "frames", "table")
"""Samplers of the first pass: `drawing_order`, `StaticSplats.texels`, `PosedFrames.texels` and
`packing.table`."""
PROJECTED_TEXTURES = ("places", "sides", "shades")
"""Textures that the first pass writes and the second reads, a texel for each splat."""
BLOCK_SPLATS = 128
"""Splats drawn by one instance: GPUs are slow at instances of four vertices. A divisor of
TEXTURE_WIDTH: the last instance then reads no further than the last row."""
MAP_COLUMNS = 4
NOTHING = 1e30  # depth of a shadow map where nothing is

_CONSTANTS = {name: value for name, value in vars(packing).items() if name.endswith("_TEXELS")}
_CONSTANTS |= {"WIDTH": TEXTURE_WIDTH, "BLOCK_SPLATS": BLOCK_SPLATS}
_CONSTANTS |= {"CLIP_PLANES": packing.CLIP_PLANES}
_DEFINES = f"""{printed_constants(_CONSTANTS, "glsl")}{SPLAT_DEFINES}
#define FROZEN_COLOR vec3{FROZEN_COLOR_SRGB}
#define UNSEEN_COLOR vec3{UNSEEN_COLOR_SRGB}
#define TEXEL(image, k) texelFetch(image, ivec2((k) % WIDTH, (k) / WIDTH), 0)
"""
RELIT_DEFINES = f"""
#define RELIT
#define MAP_COLUMNS {MAP_COLUMNS}
#define SHADOW_DEPTH(cell) texelFetch(shadows, cell, 0).r
#define WORLD(first, k) TEXEL(lights, first + k).rgb
{SHADING_DEFINES}"""
RELIT_FUNCTIONS = """
float lit_fraction_of(int map_index, int first, vec3 point, float cosine)
{
  int row = first + MAP_TEXELS * map_index;
  vec4 p = vec4(point, 1.0), lens = TEXEL(lights, row + 3);
  vec4 x = TEXEL(lights, row), y = TEXEL(lights, row + 1);
  vec3 local = vec3(dot(x, p), dot(y, p), dot(TEXEL(lights, row + 2), p));
  vec2 place = local.xy;
  if (lens.y < 0.5) {
    if (local.z <= 1e-4) {
      return 1.0;
    }
    place /= local.z;
  }
  place = place * lens.x + 0.5 * float(MAP_SIZE);
  ivec2 corner = MAP_SIZE * ivec2(map_index % MAP_COLUMNS, map_index / MAP_COLUMNS);
  return lit_fraction(corner, place, local.z - shadow_bias(cosine, lens.z));
}

vec3 relit(int splat, int layer, vec3 recorded, vec3 face_color)
{
  int row = RELIT_TEXELS * layer;
  vec4 factor = TEXEL(lights, row), settings = TEXEL(lights, row + 1);
  vec4 eye = TEXEL(lights, row + 2), typical = TEXEL(lights, row + 3);
  if (factor.x <= 0.0) {
    return recorded;
  }
  int first = SURFACE_TEXELS * splat;
  vec4 color = TEXEL(surface, first), old = TEXEL(surface, first + 1);
  ivec3 corners = VERTEX_TEXELS * ivec3(TEXEL(surface, first + 2).xyz + 0.5);
  vec3 weights = TEXEL(surface, first + 3).xyz, means[3];
  for (int k = 0; k < 3; k++) {
    means[k] = weights.x * TEXEL(vertices, corners.x + k).xyz
             + weights.y * TEXEL(vertices, corners.y + k).xyz
             + weights.z * TEXEL(vertices, corners.z + k).xyz;
  }
  vec3 normal = means[1] / max(length(means[1]), 1e-12), point = means[0] + LIFT * normal;
  vec3 arriving = means[2], highlight = vec3(0.0), view = normalize(eye.xyz - point);
  float roughness = color.a > 0.0 ? color.a : settings.x, alpha = roughness * roughness;
  for (int n = 0; n < int(settings.w); n++) {
    int texel = int(settings.z) + LIGHT_TEXELS * n;
    vec4 a = TEXEL(lights, texel), b = TEXEL(lights, texel + 1);
    vec4 c = TEXEL(lights, texel + 2), d = TEXEL(lights, texel + 3);
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
      strength *= lit_fraction_of(int(d.x + 0.5), int(typical.w + 0.5), point, facing);
    }
    vec3 light = light_color * strength * facing;
    float wide = min(alpha * alpha + 0.125 * width * width, 1.0);
    arriving += light * d.y;
    highlight += light * d.z * ggx(normal, toward, view, wide);
  }
  highlight += sky_highlight(row + 4, normal, normalize(eye.xyz - means[0]), roughness, old.a);
  color.rgb += face_color;
  typical.a = eye.w;
  vec4 kept = TEXEL(lights, row + 13);
  vec3 lit = lit_color(color, old.rgb, arriving, settings.y * highlight, recorded, typical, kept);
  return linear_to_srgb(mix(srgb_to_linear(max(recorded, vec3(0.0))), lit * factor.yzw, factor.x));
}
"""

_MAP_VERTEX = """
void main()
{
  vec4 p = vec4(position, 1.0);
  float z = distance_out = dot(row_z, p);
  /* Depths from lens.z to infinity before a light, and 1 km around a sun's center. */
  vec2 depth = lens.y > 0.5 ? vec2(z * 1e-3, 1.0) : vec2(z - 2.0 * lens.z, z);
  gl_Position = vec4(dot(row_x, p) * lens.x, dot(row_y, p) * lens.x, depth);
}
"""

_MAP_FRAGMENT = """
void main()
{
  depth_out = distance_out;
}
"""


def shadow_map_shader() -> Any:
    """Draws triangles into a shadow map, depth in meters along the light's axis. rows: as packed;
    lens: scale to device coordinates, whether parallel, least depth in perspective."""
    return _Source(
        vertex=_MAP_VERTEX,
        fragment=_MAP_FRAGMENT,
        outputs={"depth_out": "FLOAT"},
        constants=dict.fromkeys(("row_x", "row_y", "row_z", "lens"), "VEC4"),
        defines="",
        # in perspective, depth itself is interpolated as it should be: linear in space
        passed={"distance_out": ("smooth", "FLOAT")},
        attribute=("VEC3", "position"),
    ).compiled()


@dataclass(frozen=True)
class _Source:
    """What a shader is compiled from.

    vertex, fragment, defines  GLSL
    outputs  of the fragment, name -> type, in the order of the targets
    constants  push constants, name -> type
    samplers  names of textures
    passed  from vertex to fragment, name -> qualifier and type
    attribute  type and name of that of vertices; by default of rectangles, at ±1
    """

    vertex: str
    fragment: str
    outputs: Mapping[str, str]
    constants: Mapping[str, str]
    samplers: Sequence[str] = ()
    defines: str = _DEFINES
    passed: Mapping[str, tuple[str, str]] = field(default_factory=dict)
    attribute: tuple[str, str] = ("VEC2", "corner")

    def compiled(self) -> Any:
        info = gpu.types.GPUShaderCreateInfo()
        info.typedef_source(self.defines)
        info.vertex_in(0, *self.attribute)
        for slot, (name, kind) in enumerate(self.outputs.items()):
            info.fragment_out(slot, kind, name)
        for slot, name in enumerate(self.samplers):
            info.sampler(slot, "FLOAT_2D", name)
        for name, kind in self.constants.items():
            info.push_constant(kind, name)
        if self.passed:
            stage = gpu.types.GPUStageInterfaceInfo("stga_stage")
            for name, (qualifier, kind) in self.passed.items():
                getattr(stage, qualifier)(kind, name)
            info.vertex_out(stage)
        if "gl_FragDepth" in self.fragment:
            allow_depth_write(info)
        info.vertex_source(self.vertex)
        info.fragment_source(self.fragment)
        return gpu.shader.create_from_info(info)


_TERMS = "\n".join(
    f"  if (degree >= {math.isqrt(k)})\n    color += {term} * TEXEL(colors, first + {k}).rgb;"
    for k, term in enumerate(harmonics_text())
)
_HARMONICS = f"""
vec3 spherical_harmonics(int first, int degree, vec3 d)
{{
  float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;
  vec3 color = vec3(0.5);
{_TERMS}
  return color;
}}
"""

_PROJECTION_FRAGMENT = """
void main()
{
  place_out = sides_out = shade_out = vec4(0.0);
  ivec2 texel = ivec2(gl_FragCoord.xy);
  if (texel.y * WIDTH + texel.x >= count) {
    return;
  }
  int splat = int(texelFetch(orders, texel, 0).r);
  vec4 center = TEXEL(centers, splat), axis0 = TEXEL(axes, 3 * splat);
  vec4 axis1 = TEXEL(axes, 3 * splat + 1), axis2 = TEXEL(axes, 3 * splat + 2);
  int face = int(center.w), row = VIEW_TEXELS + LAYER_TEXELS * int(axis2.w);
  vec4 color_rows = TEXEL(table, row), display = TEXEL(table, row + 1);
  vec4 turn0 = TEXEL(table, row + 2), turn1 = TEXEL(table, row + 3);
  vec4 turn2 = TEXEL(table, row + 4), face_color = TEXEL(frames, 3 * faces + face);
  float opacity = axis0.w;
  int kinds = int(face_color.w + 0.5);
  float frozen = (kinds & 1) != 0 ? turn1.w : 0.0, unseen = (kinds & 2) != 0 ? turn2.w : 0.0;
  if (opacity < display.z || axis1.w >= turn0.w || max(frozen, unseen) > 1.5) {
    return;
  }
  vec4 r0 = TEXEL(frames, face), r1 = TEXEL(frames, faces + face);
  vec4 r2 = TEXEL(frames, 2 * faces + face), local = vec4(center.xyz, 1.0);
  vec3 p = vec3(dot(r0, local), dot(r1, local), dot(r2, local));
  vec4 lens = TEXEL(table, 0), image = TEXEL(table, 1);
  for (int plane = 0; plane < CLIP_PLANES; plane++) {
    if (plane < int(image.z) && dot(TEXEL(table, 2 + plane), vec4(p, 1.0)) < 0.0) {
      return;
    }
  }
  vec2 focal = lens.xy, principal = lens.zw, zoom = focal / p.z;
  vec2 slope = limited_slope(p, focal, principal, image.xy);
  vec3 u = zoom.x * (r0.xyz - slope.x * r2.xyz), v = zoom.y * (r1.xyz - slope.y * r2.xyz);
  vec3 a = display.y * vec3(dot(u, axis0.xyz), dot(u, axis1.xyz), dot(u, axis2.xyz));
  vec3 b = display.y * vec3(dot(v, axis0.xyz), dot(v, axis1.xyz), dot(v, axis2.xyz));
  vec4 covariance = screen_covariance(a, b);
  if (display.x > 0.5) {
    opacity = antialiased_opacity(opacity, covariance);
  }
  bool is_finite = covariance_determinant(covariance) < 1e30;
  if (!(opacity >= MIN_ALPHA) || !is_finite || display.y <= 0.0) {
    return;
  }
  vec3 toward = normalize(p);
  vec3 direction = vec3(dot(turn0.xyz, toward), dot(turn1.xyz, toward), dot(turn2.xyz, toward));
  int first = int(color_rows.x) + (splat - int(color_rows.y)) * int(color_rows.z);
  vec3 color = face_color.rgb + spherical_harmonics(first, int(color_rows.w), direction);
#ifdef RELIT
  color = relit(splat, int(axis2.w), color, TEXEL(frames, 4 * faces + face).rgb);
#endif
  if (!(abs(color.r) + abs(color.g) + abs(color.b) < 1e30)) {
    return;
  }
  if (max(frozen, unseen) > 0.5) {
    color = unseen > 0.5 ? UNSEEN_COLOR : FROZEN_COLOR;
  }
  /* A rectangle along the ellipse's axes, up to where alpha falls below MIN_ALPHA. */
  vec4 ellipse = ellipse_axes(covariance);
  float reach = splat_reach(opacity) * 1.001;
  vec2 pixel = focal * p.xy / p.z + principal, to_device = vec2(2.0, -2.0) / image.xy;
  place_out = vec4(to_device * pixel + vec2(-1.0, 1.0), p.z, reach);
  vec2 major = ellipse.xy, minor = vec2(-major.y, major.x);
  sides_out = reach * vec4(ellipse.z * to_device * major, ellipse.w * to_device * minor);
  shade_out = vec4(max(color, vec3(0.0)), opacity);
}
"""

_SPLAT_VERTEX = """
void main()
{
  int index = (first_block + gl_InstanceID) * BLOCK_SPLATS + gl_VertexID / 4;
  ivec2 texel = ivec2(index % WIDTH, index / WIDTH);
  vec4 place = texelFetch(places, texel, 0), half_axes = texelFetch(sides, texel, 0);
  offset = place.w * corner;
  depth = place.z;
  shade = texelFetch(shades, texel, 0);
  vec2 position = place.xy + corner.x * half_axes.xy + corner.y * half_axes.zw;
  gl_Position = vec4(position, place.w > 0.0 ? 0.0 : 2.0, 1.0);
}
"""

_SPLAT_MAIN = """
void main()
{
  float alpha = splat_alpha(shade.a, offset);
  if (alpha < MIN_ALPHA) {
    discard;
  }
  color_out = vec4(shade.rgb * alpha, alpha);
  depth_out = vec4(depth * alpha, alpha, 0.0, alpha); /* the fourth is what blending reads */
}
"""
_SPLAT_FRAGMENT = SPLAT_FUNCTIONS + _SPLAT_MAIN

_SCREEN_VERTEX = """
void main()
{
  gl_Position = vec4(corner, 0.0, 1.0);
}
"""

_COMPOSITE_FRAGMENT = """
bool is_near_bone(vec2 pixel)
{
  for (int bone = 0; bone < int(part.y); bone++) {
    vec4 ends = texelFetch(bones, ivec2(0, bone), 0);
    vec2 along = ends.zw - ends.xy, to = pixel - ends.xy;
    float fraction = clamp(dot(to, along) / max(dot(along, along), 1e-6), 0.0, 1.0);
    if (distance(to, fraction * along) < texelFetch(bones, ivec2(1, bone), 0).r) {
      return true;
    }
  }
  return false;
}

void main()
{
  ivec2 texel = ivec2(gl_FragCoord.xy) - ivec2(corner_px.xy);
  vec4 splats = texelFetch(color_image, texel, 0), distances = texelFetch(depth_image, texel, 0);
  if (splats.a < MIN_ALPHA || is_near_bone(vec2(texel) + 0.5) != (part.x > 0.5)) {
    discard;
  }
  /* From z along the view axis to the projection's depth: (x + y·z) / (z + w·z), by its matrix. */
  float z = distances.r / max(distances.g, 1e-9);
  float depth = (to_depth.x + to_depth.y * z) / (to_depth.z + to_depth.w * z);
  gl_FragDepth = clamp(0.5 + 0.5 * depth, 0.0, 1.0);
  if (part.x > 1.5) {
    color_final = vec4(splats.a * srgb_to_linear(behind.rgb), 0.0);
    return;
  }
  if (behind.a < 0.5) {
    color_final = vec4(srgb_to_linear(splats.rgb / splats.a) * splats.a, splats.a);
    return;
  }
  /* Splats are blended in sRGB, the viewport blends linear: exact where `behind` lies behind. */
  vec3 goal = srgb_to_linear(clamp(splats.rgb + (1.0 - splats.a) * behind.rgb, 0.0, 1.0));
  vec3 back = srgb_to_linear(behind.rgb);
  vec3 most = min(vec3(1.0 - splats.a), goal / max(back, vec3(1e-6)));
  float through = min(most.r, min(most.g, most.b));
  color_final = vec4(goal - through * back, 1.0 - through);
}
"""


def projection_shader(relit: bool = False) -> Any:
    """First pass: fills PROJECTED_TEXTURES, a texel for each of the `count` splats in `orders`;
    others become 0. relit: for layers of which at least one is lit by the scene."""
    defines = _DEFINES
    functions = SPLAT_FUNCTIONS + _HARMONICS
    samplers: tuple[str, ...] = PACKED_TEXTURES
    if relit:
        defines += RELIT_DEFINES
        functions += SHADING_FUNCTIONS + RELIT_FUNCTIONS
        samplers += "surface", "vertices", "lights", "shadows"
    return _Source(
        vertex=_SCREEN_VERTEX,
        fragment=functions + _PROJECTION_FRAGMENT,
        outputs=dict.fromkeys(("place_out", "sides_out", "shade_out"), "VEC4"),
        constants={"faces": "INT", "count": "INT"},
        samplers=samplers,
        defines=defines,
    ).compiled()


def splat_shader() -> Any:
    """Second pass: draws PROJECTED_TEXTURES, a rectangle for each splat, in instances of
    BLOCK_SPLATS of them, beginning with the instance `first_block`. Two color targets: sRGB
    premultiplied, and (depth · alpha, alpha).

    In Blender 5.3 on OpenGL, binding a texture also writes its slot to a shader's first uniform:
    to its first sampler, which then reads another texture, if there is no push constant. Hence
    `first_block`, which has to be set after the textures.
    """
    return _Source(
        vertex=_SPLAT_VERTEX,
        fragment=_SPLAT_FRAGMENT,
        outputs=dict.fromkeys(("color_out", "depth_out"), "VEC4"),
        constants={"first_block": "INT"},
        samplers=PROJECTED_TEXTURES,
        passed={
            "offset": ("no_perspective", "VEC2"),
            "shade": ("flat", "VEC4"),
            "depth": ("flat", "FLOAT"),
        },
    ).compiled()


def composite_shader() -> Any:
    """Puts the two targets of `splat_shader` into a viewport, with depth; outputs display-linear,
    premultiplied. part.x: 0 all that is not near a bone; 1 what is; 2 what is, as the light of
    `behind` that it covers. part.y: how many bones; bones: for each, two texels as `front_bones`
    returns them."""
    return _Source(
        vertex=_SCREEN_VERTEX,
        fragment=SRGB_FUNCTIONS + _COMPOSITE_FRAGMENT,
        outputs={"color_final": "VEC4"},
        constants=dict.fromkeys(("corner_px", "to_depth", "behind", "part"), "VEC4"),
        samplers=("color_image", "depth_image", "bones"),
    ).compiled()
