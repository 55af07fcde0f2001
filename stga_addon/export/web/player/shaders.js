// @ts-check
// GLSL: splats as quads, then the picture over its background; and a pass that computes the color
// of each splat under a light once, with the shadow map of the sun.

/** @import { Arrays } from './types.js' */

export const TEXTURE_WIDTH = 2048;
export const SPLAT_TEXELS = 4; // xyz, triangle | rotation | scale, opacity | color
export const FACE_TEXELS = 5; // rows of the frame in camera space | color, selected | light
export const SURFACE_TEXELS = 4; // normal, roughness | irradiance, occlusion | corners | weights
export const VERTEX_TEXELS = 3; // position | normal | irradiance of the world and of skin around
/** Of the recorded color without what depends on the view, by degree from 1. */
const VIEW_MEANS = ['VIEW_MEAN_1', 'VIEW_MEAN_2', 'VIEW_MEAN_3'];

const PREAMBLE = `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
ivec2 texel(int index) {
  return ivec2(index & ${TEXTURE_WIDTH - 1}, index >> ${Math.log2(TEXTURE_WIDTH)});
}`;

const SPLAT = `
{{splat}}`;

/** Of degree 1 on, by x, y, z and their squares: what the export writes here. */
const SH = '{{harmonics}}'.split('; ');

// How many harmonics splats' colors have besides the constant one, and the texels for them.
/** @type {(arrays: Arrays) => [number, number]} */
export function tailSizes({ sh }) {
  const size = sh?.shape[1] ?? 0;
  return [size / 3, Math.ceil(size / 4)];
}

/** @param {number} k */
const tailTriple = k =>
  `vec3(${[3 * k, 3 * k + 1, 3 * k + 2].map(at => `t${at >> 2}.${'xyzw'[at & 3]}`)})`;

// Add coefficients times basis functions of a direction to a variable, unrolled: dynamic indices
// are slow on many GPUs.
/** @type {(count: number, direction: string, sum: string, factors?: string[]) => string} */
function harmonicsSum(count, direction, sum, factors = ['1.0', '1.0', '1.0']) {
  const terms = SH.slice(0, count).map((term, k) => {
    const factor = factors[Math.floor(Math.sqrt(k + 1)) - 1];
    return `${sum} += ${factor} * (${term}) * ${tailTriple(k)};`;
  });
  return `{
    float x = ${direction}.x, y = ${direction}.y, z = ${direction}.z;
    float xx = x * x, yy = y * y, zz = z * z;
    ${terms.join('\n    ')}
  }`;
}

// Add what is seen of the tail in a direction to a variable.
/** @type {(arrays: Arrays, direction: string, sum: string) => string} */
function tailColor(arrays, direction, sum) {
  const [harmonics, texels] = tailSizes(arrays);
  const lines = [];
  for (let t = 0; t < texels; t++)
    lines.push(`vec4 t${t} = texelFetch(uTail, texel(splat * ${texels} + ${t}), 0);`);
  lines.push(`vec3 toward = normalize(${direction});`, harmonicsSum(harmonics, 'toward', sum));
  return lines.join('\n  ');
}

// isLit: whether colors come from the light pass.
/** @type {(arrays: Arrays, isLit: boolean) => string} */
export function splatVertexShader(arrays, isLit) {
  const lit = 'color = texelFetch(uColors, texel(splat), 0).rgb;';
  return `${PREAMBLE}${SPLAT}
uniform sampler2D uFaces;
uniform sampler2D uSplats;
uniform sampler2D ${isLit ? 'uColors' : 'uTail'};
uniform mat3 uToWorld;
uniform vec2 uFocal, uCenter, uSize;
uniform bool uAntialiased, uShowSelection;
in uint splatIndex;
flat out vec2 vCenter;
flat out mat2 vToUnit;
flat out vec4 vColor;

// Pixels: more than a corner moves to the driver's grid, of 1/16 pixel at the coarsest.
const float SNAP = 0.07;
const float NEAR = 0.01;

mat3 rotation(vec4 q) {
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
    2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
    2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0); // outside: draws nothing
  int splat = int(splatIndex);
  vec4 place = texelFetch(uSplats, texel(splat * ${SPLAT_TEXELS}), 0);
  int at = int(place.w) * ${FACE_TEXELS};
  vec4 rowX = texelFetch(uFaces, texel(at), 0);
  vec4 rowY = texelFetch(uFaces, texel(at + 1), 0);
  vec4 rowZ = texelFetch(uFaces, texel(at + 2), 0);
  vec3 center = vec3(dot(rowX.xyz, place.xyz), dot(rowY.xyz, place.xyz), dot(rowZ.xyz, place.xyz));
  center += vec3(rowX.w, rowY.w, rowZ.w);
  if (center.z < NEAR) return;

  vec4 turn = texelFetch(uSplats, texel(splat * ${SPLAT_TEXELS} + 1), 0);
  vec4 shape = texelFetch(uSplats, texel(splat * ${SPLAT_TEXELS} + 2), 0);
  mat3 axes = rotation(turn);
  axes[0] *= shape.x;
  axes[1] *= shape.y;
  axes[2] *= shape.z;
  // Rows of Jacobian · frame: the affine map from the local frame to pixels.
  vec2 slope = limited_slope(center, uFocal, uCenter, uSize);
  vec3 a = (uFocal.x / center.z * (rowX.xyz - slope.x * rowZ.xyz)) * axes;
  vec3 b = (uFocal.y / center.z * (rowY.xyz - slope.y * rowZ.xyz)) * axes;
  vec4 covariance = screen_covariance(a, b);
  float opacity = shape.w;
  if (uAntialiased) opacity = antialiased_opacity(opacity, covariance);
  if (!(opacity >= MIN_ALPHA)) return;

  vec4 ellipse = ellipse_axes(covariance);
  vec2 axis = ellipse.xy, deviation = ellipse.zw;
  vec2 corner = vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1)) * 2.0 - 1.0;
  vec2 reach = corner * (splat_reach(opacity) * deviation + SNAP);
  vec2 pixel = uFocal * center.xy / center.z + uCenter;
  vCenter = vec2(pixel.x, uSize.y - pixel.y); // gl_FragCoord counts from below
  vToUnit = mat2(vec2(axis.x, -axis.y) / deviation.x, -axis.yx / deviation.y);
  pixel += reach.x * axis + reach.y * vec2(-axis.y, axis.x);

  vec4 face = texelFetch(uFaces, texel(at + 3), 0);
  vec3 color = texelFetch(uSplats, texel(splat * ${SPLAT_TEXELS} + 3), 0).rgb + face.rgb;
  if (uShowSelection && face.w < 0.5) {
    color = vec3(0.25 + 0.4 * dot(color, vec3(0.299, 0.587, 0.114)));
  } else {
  ${isLit ? lit : tailColor(arrays, 'uToWorld * center', 'color')}
  }
  vColor = vec4(max(color, 0.0), opacity);
  gl_Position = vec4(2.0 * pixel.x / uSize.x - 1.0, 1.0 - 2.0 * pixel.y / uSize.y, 0.0, 1.0);
}`;
}

// From the pixel's own place: an interpolated offset would move with the corners, which drivers
// round to a grid.
export const SPLAT_FRAGMENT_SHADER = `#version 300 es
precision highp float;${SPLAT}
flat in vec2 vCenter;
flat in mat2 vToUnit;
flat in vec4 vColor;
out vec4 result;
void main() {
  vec2 offset = (gl_FragCoord.xy - vCenter) * vToUnit; // in standard deviations
  float alpha = splat_alpha(vColor.a, offset);
  if (alpha < MIN_ALPHA) discard;
  result = vec4(vColor.rgb * alpha, alpha);
}`;

/** A triangle over everything. */
export const OVER_VERTEX_SHADER = `#version 300 es
void main() {
  gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0);
}`;

export const OVER_FRAGMENT_SHADER = `#version 300 es
precision highp float;
uniform sampler2D uPicture;
uniform vec4 uBackground; // premultiplied
out vec4 result;
void main() {
  vec4 picture = texelFetch(uPicture, ivec2(gl_FragCoord.xy), 0);
  result = vec4(min(picture.rgb, 1.0), picture.a) + (1.0 - picture.a) * uBackground;
}`;

// Vertices by their index, as the sun sees them: depth from 0 to 1 within twice the radius of the
// head.
export const SHADOW_VERTEX_SHADER = `${PREAMBLE}
uniform sampler2D uVertices;
uniform mat3 uToSun;
uniform vec3 uMiddle;
uniform float uRadius;
void main() {
  vec3 vertex = texelFetch(uVertices, texel(gl_VertexID * ${VERTEX_TEXELS}), 0).xyz;
  vec3 local = uToSun * (vertex - uMiddle);
  gl_Position = vec4(local / uRadius, 1.0);
}`;

export const SHADOW_FRAGMENT_SHADER = `#version 300 es
void main() {}`;

// A texel a splat: its color in sRGB, not clipped.
/** @param {Arrays} arrays */
export function lightFragmentShader(arrays) {
  return `${PREAMBLE}
uniform sampler2D uSplats, uTail, uFaces, uSurface, uVertices, uShadows;
uniform mat3 uToSun;
uniform vec3 uMiddle, uEye, uSunColor, uWorld[9];
uniform vec4 uKept, uTypical;
uniform float uRadius, uTexel, uFactor;
out vec4 result;
#define SHADOW_DEPTH(cell) texelFetch(uShadows, cell, 0).r
#define WORLD(first, k) uWorld[k]
{{shading}}
vec3 mean(ivec3 corners, vec3 weights, int k) {
  return weights.x * texelFetch(uVertices, texel(corners.x + k), 0).xyz
    + weights.y * texelFetch(uVertices, texel(corners.y + k), 0).xyz
    + weights.z * texelFetch(uVertices, texel(corners.z + k), 0).xyz;
}

void main() {
  int splat = int(gl_FragCoord.x) + ${TEXTURE_WIDTH} * int(gl_FragCoord.y);
  vec4 surface = texelFetch(uSurface, texel(splat * ${SURFACE_TEXELS}), 0);
  vec4 old = texelFetch(uSurface, texel(splat * ${SURFACE_TEXELS} + 1), 0);
  vec4 vertices = texelFetch(uSurface, texel(splat * ${SURFACE_TEXELS} + 2), 0);
  ivec3 corners = ${VERTEX_TEXELS} * ivec3(vertices.xyz + 0.5);
  vec3 weights = texelFetch(uSurface, texel(splat * ${SURFACE_TEXELS} + 3), 0).xyz;
  vec3 normal = mean(corners, weights, 1);
  normal /= max(length(normal), 1e-12);
  vec3 point = mean(corners, weights, 0), lifted = point + LIFT * normal;
  vec3 arriving = mean(corners, weights, 2);
  float roughness = surface.a > 0.0 ? surface.a : SKIN_ROUGHNESS;
  vec3 highlight = sky_highlight(0, normal, normalize(uEye - point), roughness, old.a);
  vec3 view = normalize(uEye - lifted), towardSun = -vec3(uToSun[0].z, uToSun[1].z, uToSun[2].z);
  float facing = dot(normal, towardSun);
  if (facing > 0.0 && uSunColor != vec3(0.0)) {
    vec3 local = uToSun * (lifted - uMiddle);
    float depth = (local.z - shadow_bias(facing, uTexel)) / uRadius * 0.5 + 0.5;
    vec2 place = (local.xy / uRadius * 0.5 + 0.5) * float(MAP_SIZE);
    vec3 light = uSunColor * facing * lit_fraction(ivec2(0), place, depth);
    arriving += light;
    highlight += light * ggx(normal, towardSun, view, pow(roughness, 4.0));
  }
  int face = int(texelFetch(uSplats, texel(splat * ${SPLAT_TEXELS}), 0).w) * ${FACE_TEXELS};
  vec3 color = texelFetch(uSplats, texel(splat * ${SPLAT_TEXELS} + 3), 0).rgb;
  color += texelFetch(uFaces, texel(face + 3), 0).rgb;
  vec3 recorded = color;
  ${tailColor(arrays, 'point - uEye', 'recorded')}
  color -= texelFetch(uFaces, texel(face + 4), 0).rgb;
  vec3 inward = -surface.xyz / max(length(surface.xyz), 1e-12);
  ${harmonicsSum(tailSizes(arrays)[0], 'inward', 'color', VIEW_MEANS)}
  vec4 albedo = vec4(color, surface.a);
  vec3 lit = lit_color(albedo, old.rgb, arriving, highlight, recorded, uTypical, uKept);
  result = vec4(linear_to_srgb(uFactor * lit), 1.0);
}`;
}
