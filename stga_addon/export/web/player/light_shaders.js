// @ts-check
// GLSL that lights splats: the shadow map of the sun, and a pass that computes the color of each splat once. The rules are
// those of STGA for Blender's light/relight.py, light/lamps.py and raster/cpu/shade.py.

import { FACE_TEXELS, SPLAT_TEXELS, TEXTURE_WIDTH, tailColor } from './shaders.js';
import { ALIKE_AT_SPLAT, UNLIKE_AT_SPLAT } from './likeness.js';
import { HIGHLIGHT_SHARE, MIN_DIFFUSE_SHARE, WET_HIGHLIGHT_SHARE } from './surface.js';

export const SURFACE_TEXELS = 4; // color, roughness | irradiance, occlusion | corners | weights
export const VERTEX_TEXELS = 3; // position | normal | irradiance of the world and of skin around
export const MAP_SIZE = 512;
export const LIFT_M = 0.001;

const PREAMBLE = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
ivec2 texel(int index) {
  return ivec2(index & ${TEXTURE_WIDTH - 1}, index >> ${Math.log2(TEXTURE_WIDTH)});
}`;

/** Vertices by their index, as the sun sees them: depth from 0 to 1 within twice the radius of the head. */
export const SHADOW_VERTEX_SHADER = `${PREAMBLE}
uniform sampler2D uVertices;
uniform mat3 uToSun;
uniform vec3 uMiddle;
uniform float uRadius;
void main() {
  vec3 local = uToSun * (texelFetch(uVertices, texel(gl_VertexID * ${VERTEX_TEXELS}), 0).xyz - uMiddle);
  gl_Position = vec4(local / uRadius, 1.0);
}`;

export const SHADOW_FRAGMENT_SHADER = `#version 300 es
void main() {}`;

const SURFACE_FUNCTIONS = `
const float PI = 3.14159265358979;
const float REFLECTANCE = 0.04, SKIN_ROUGHNESS = 0.45;
const float BIAS = 0.001, MAX_BIAS = 0.006, TAP_STEP = 1.0;

vec3 linear(vec3 srgb) {
  vec3 curve = pow((max(srgb, 0.04045) + 0.055) / 1.055, vec3(2.4));
  return mix(curve, max(srgb, 0.0) / 12.92, vec3(lessThanEqual(srgb, vec3(0.04045))));
}

vec3 display(vec3 radiance) {
  vec3 curve = 1.055 * pow(max(radiance, 0.0031308), vec3(1.0 / 2.4)) - 0.055;
  return mix(curve, radiance * 12.92, vec3(lessThanEqual(radiance, vec3(0.0031308))));
}

float litShare(vec3 point, float cosine) {
  vec3 local = uToSun * (point - uMiddle);
  vec2 place = (local.xy / uRadius * 0.5 + 0.5) * ${MAP_SIZE}.0;
  float c = clamp(cosine, 0.05, 1.0);
  float bias = min(BIAS + (TAP_STEP + 1.0) * uTexel * sqrt(1.0 - c * c) / c, MAX_BIAS);
  float depth = (local.z - bias) / uRadius * 0.5 + 0.5;
  float found = 0.0;
  for (int tap = 0; tap < 9; tap++) {
    vec2 at = place - 0.5 + TAP_STEP * vec2(float(tap % 3 - 1), float(tap / 3 - 1));
    vec2 low = floor(at), share = at - low;
    for (int k = 0; k < 4; k++) {
      ivec2 cell = clamp(ivec2(low) + ivec2(k & 1, k >> 1), ivec2(0), ivec2(${MAP_SIZE - 1})); // the border is empty
      if (depth <= texelFetch(uShadows, cell, 0).r) {
        found += ((k & 1) == 1 ? share.x : 1.0 - share.x) * (k > 1 ? share.y : 1.0 - share.y);
      }
    }
  }
  return found / 9.0;
}

// GGX with Smith's shadowing and Schlick's Fresnel term, over the cosine towards the light.
float ggx(float facing, float towardEye, float between, float fresnelCosine, float square) {
  float spread = between * between * (square - 1.0) + 1.0;
  float shadowing = facing * sqrt(towardEye * towardEye * (1.0 - square) + square)
    + towardEye * sqrt(facing * facing * (1.0 - square) + square);
  float fresnel = REFLECTANCE + (1.0 - REFLECTANCE) * pow(1.0 - fresnelCosine, 5.0);
  return 0.5 * square / (PI * spread * spread) * fresnel / shadowing;
}

// The world's radiance around the mirrored direction times the lobe's reflectance (Karis 2014).
vec3 worldHighlight(vec3 normal, vec3 view, float roughness, float occlusion) {
  float cosine = max(dot(normal, view), 0.02);
  vec3 d = 2.0 * cosine * normal - view;
  vec3 seen = 0.28209479177387814 * uWorld[0];
  seen += 0.4886025119029199 * (d.y * uWorld[1] + d.z * uWorld[2] + d.x * uWorld[3]);
  seen += 1.0925484305920792 * (d.x * d.y * uWorld[4] + d.y * d.z * uWorld[5] + d.x * d.z * uWorld[7]);
  seen += 0.31539156525252005 * (3.0 * d.z * d.z - 1.0) * uWorld[6];
  seen += 0.5462742152960396 * (d.x * d.x - d.y * d.y) * uWorld[8];
  float x = 1.0 - roughness, y = 0.0425 - 0.0275 * roughness;
  float z = 1.04 - 0.572 * roughness, w = 0.022 * roughness - 0.04;
  float share = min(x * x, exp2(-9.28 * cosine)) * x + y;
  return max(seen, 0.0) * occlusion * (REFLECTANCE * (z - 1.04 * share) + 1.04 * share + w);
}

vec3 albedoOf(vec3 recorded, vec3 irradiance, bool isWet) {
  vec3 base = linear(recorded);
  vec3 highlight = (isWet ? ${WET_HIGHLIGHT_SHARE} : ${HIGHLIGHT_SHARE}) / PI * irradiance;
  vec3 albedo = PI * max(base - highlight, ${MIN_DIFFUSE_SHARE} * base) / irradiance;
  if (uDamping == 0.0) return albedo;
  return pow(max(albedo, 1e-4), vec3(1.0 - uDamping)) * pow(uTypical, vec3(uDamping));
}`;

export const LIGHT_VERTEX_SHADER = `#version 300 es
void main() {
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0);
}`;

/**
 * A texel a splat: its color in sRGB, not clipped.
 * @param {number} harmonics of splats whose color depends on the view
 * @param {number} strains 3 where it depends on strain
 */
export function lightFragmentShader(harmonics, strains) {
  return `${PREAMBLE}
uniform sampler2D uSplats, uTail, uFaces, uSurface, uVertices, uShadows;
uniform mat3 uToSun;
uniform vec3 uMiddle, uEye, uSunColor, uTypical, uWorld[9];
uniform vec4 uKept;
uniform float uRadius, uTexel, uFactor, uDamping;
out vec4 result;
${SURFACE_FUNCTIONS}

vec3 mean(ivec3 corners, vec3 weights, int k) {
  return weights.x * texelFetch(uVertices, texel(corners.x + k), 0).xyz
    + weights.y * texelFetch(uVertices, texel(corners.y + k), 0).xyz
    + weights.z * texelFetch(uVertices, texel(corners.z + k), 0).xyz;
}

void main() {
  int splat = int(gl_FragCoord.x) + ${TEXTURE_WIDTH} * int(gl_FragCoord.y);
  vec4 surface = texelFetch(uSurface, texel(splat * ${SURFACE_TEXELS}), 0);
  vec4 old = texelFetch(uSurface, texel(splat * ${SURFACE_TEXELS} + 1), 0);
  ivec3 corners = ${VERTEX_TEXELS} * ivec3(texelFetch(uSurface, texel(splat * ${SURFACE_TEXELS} + 2), 0).xyz + 0.5);
  vec3 weights = texelFetch(uSurface, texel(splat * ${SURFACE_TEXELS} + 3), 0).xyz;
  vec3 normal = mean(corners, weights, 1);
  normal /= max(length(normal), 1e-12);
  vec3 point = mean(corners, weights, 0), lifted = point + ${LIFT_M} * normal;
  vec3 arriving = mean(corners, weights, 2);
  float roughness = surface.a > 0.0 ? surface.a : SKIN_ROUGHNESS;
  vec3 highlight = worldHighlight(normal, normalize(uEye - point), roughness, old.a);
  vec3 view = normalize(uEye - lifted), towardSun = -vec3(uToSun[0].z, uToSun[1].z, uToSun[2].z);
  float facing = dot(normal, towardSun);
  if (facing > 0.0 && uSunColor != vec3(0.0)) {
    vec3 light = uSunColor * facing * litShare(lifted, facing), between = normalize(towardSun + view);
    arriving += light;
    highlight += light * ggx(facing, max(dot(normal, view), 0.05), clamp(dot(normal, between), 0.0, 1.0),
      clamp(dot(view, between), 0.0, 1.0), pow(roughness, 4.0));
  }
  vec3 byView = vec3(0.0), byStrain = vec3(0.0);
  int triangle = int(texelFetch(uSplats, texel(splat * ${SPLAT_TEXELS}), 0).w);
  vec4 face = texelFetch(uFaces, texel(triangle * ${FACE_TEXELS} + 3), 0);
  ${tailColor(harmonics, strains, 'point - uEye', 'byView', 'byStrain')}
  vec3 albedo = albedoOf(surface.rgb + byStrain, old.rgb, surface.a > 0.0);
  vec3 lit = albedo * arriving / PI + highlight, same = uKept.rgb * old.rgb;
  if (uKept.a > 0.0) {
    vec3 recorded = texelFetch(uSplats, texel(splat * ${SPLAT_TEXELS} + 3), 0).rgb + byView + byStrain;
    float off = length(arriving - same) / max(length(same), 1e-6);
    float share = uKept.a * (1.0 - smoothstep(${ALIKE_AT_SPLAT}, ${UNLIKE_AT_SPLAT}, off));
    lit = mix(lit, uKept.rgb * linear(recorded), share);
  }
  result = vec4(display(uFactor * lit), 1.0);
}`;
}
