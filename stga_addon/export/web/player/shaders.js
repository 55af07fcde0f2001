// @ts-check
// GLSL of the renderer: splats as quads, then the picture over its background.

export const TEXTURE_WIDTH = 2048;
export const SPLAT_TEXELS = 4; // xyz, triangle | rotation | scale, opacity | color
export const FACE_TEXELS = 4; // rows of the frame in camera space | strain, selected
const MIN_ALPHA = 1 / 255;

const SH = [
  '-0.4886025119029199 * y',
  '0.4886025119029199 * z',
  '-0.4886025119029199 * x',
  '1.0925484305920792 * x * y',
  '-1.0925484305920792 * y * z',
  '0.31539156525252005 * (2.0 * zz - xx - yy)',
  '-1.0925484305920792 * x * z',
  '0.5462742152960396 * (xx - yy)',
  '-0.5900435899266435 * y * (3.0 * xx - yy)',
  '2.890611442640554 * x * y * z',
  '-0.4570457994644658 * y * (4.0 * zz - xx - yy)',
  '0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)',
  '-0.4570457994644658 * x * (4.0 * zz - xx - yy)',
  '1.445305721320277 * z * (xx - yy)',
  '-0.5900435899266435 * x * (xx - 3.0 * yy)',
];

/**
 * Texels a splat needs for its view-dependent and strain-dependent colors.
 * @param {number} harmonics
 * @param {number} strains
 */
export function tailTexels(harmonics, strains) {
  return Math.ceil((3 * (harmonics + strains)) / 4);
}

/**
 * Sum of coefficients times basis functions, unrolled: dynamic indices are slow on many GPUs.
 * @param {number} harmonics
 * @param {number} strains
 * @param {string} [direction] in which the eye sees the splat
 * @param {string} [byView] variable that is added to
 * @param {string} [byStrain] the same of what depends on strain
 */
export function tailColor(harmonics, strains, direction = 'uToWorld * center', byView = 'color', byStrain = 'color') {
  const texels = tailTexels(harmonics, strains);
  const lines = [];
  for (let t = 0; t < texels; t++) lines.push(`vec4 t${t} = texelFetch(uTail, texel(splat * ${texels} + ${t}), 0);`);
  const part = (/** @type {number} */ k) => `t${k >> 2}.${'xyzw'[k & 3]}`;
  const triple = (/** @type {number} */ k) => `vec3(${part(3 * k)}, ${part(3 * k + 1)}, ${part(3 * k + 2)})`;
  if (harmonics) {
    lines.push(`vec3 d = normalize(${direction});`);
    lines.push('float x = d.x, y = d.y, z = d.z, xx = x * x, yy = y * y, zz = z * z;');
  }
  for (let k = 0; k < harmonics; k++) lines.push(`${byView} += (${SH[k]}) * ${triple(k)};`);
  for (let k = 0; k < strains; k++) lines.push(`${byStrain} += face.${'xyz'[k]} * ${triple(harmonics + k)};`);
  return lines.join('\n  ');
}

/**
 * The limits and constants are those of the kernels that trained the splats (raster/cpu).
 * @param {number} harmonics
 * @param {number} strains
 * @param {boolean} [isLit] whether colors come from the light pass
 */
export function splatVertexShader(harmonics, strains, isLit = false) {
  return `#version 300 es
precision highp float;
precision highp int;
precision highp sampler2D;
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

const float SNAP = 0.07; // pixels: more than a corner moves to the driver's grid, of 1/16 pixel at the coarsest
const float NEAR = 0.01, LOW_PASS = 0.3, MARGIN = 0.15;

ivec2 texel(int index) {
  return ivec2(index & ${TEXTURE_WIDTH - 1}, index >> ${Math.log2(TEXTURE_WIDTH)});
}

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
  vec2 slope = clamp(center.xy / center.z, -uCenter / uFocal - MARGIN * uSize / uFocal,
    (uSize - uCenter) / uFocal + MARGIN * uSize / uFocal);
  vec3 a = (uFocal.x / center.z * (rowX.xyz - slope.x * rowZ.xyz)) * axes;
  vec3 b = (uFocal.y / center.z * (rowY.xyz - slope.y * rowZ.xyz)) * axes;
  float xx = dot(a, a) + LOW_PASS, xy = dot(a, b), yy = dot(b, b) + LOW_PASS;
  vec3 minors = cross(a, b);
  float sharp = dot(minors, minors);
  float det = sharp + LOW_PASS * (xx + yy - LOW_PASS); // never cancels to zero or below
  float opacity = shape.w;
  if (uAntialiased) opacity *= sqrt(sharp / det);
  if (!(opacity >= ${MIN_ALPHA})) return;

  float middle = 0.5 * (xx + yy);
  float longer = middle + length(vec2(0.5 * (xx - yy), xy));
  vec2 axis = xx >= yy ? vec2(longer - yy, xy) : vec2(xy, longer - xx);
  axis = dot(axis, axis) > 0.0 ? normalize(axis) : vec2(1.0, 0.0);
  vec2 corner = vec2(float(gl_VertexID & 1), float(gl_VertexID >> 1)) * 2.0 - 1.0;
  vec2 deviation = vec2(sqrt(longer), sqrt(det / longer));
  vec2 reach = corner * (sqrt(2.0 * log(opacity / ${MIN_ALPHA})) * deviation + SNAP);
  vec2 pixel = uFocal * center.xy / center.z + uCenter;
  vCenter = vec2(pixel.x, uSize.y - pixel.y); // gl_FragCoord counts from below
  vToUnit = mat2(vec2(axis.x, -axis.y) / deviation.x, -axis.yx / deviation.y);
  pixel += reach.x * axis + reach.y * vec2(-axis.y, axis.x);

  vec3 color = texelFetch(uSplats, texel(splat * ${SPLAT_TEXELS} + 3), 0).rgb;
  vec4 face = texelFetch(uFaces, texel(at + 3), 0);
  if (uShowSelection && face.w < 0.5) {
    color = vec3(0.25 + 0.4 * dot(color, vec3(0.299, 0.587, 0.114)));
  } else {
  ${isLit ? 'color = texelFetch(uColors, texel(splat), 0).rgb;' : tailColor(harmonics, strains)}
  }
  vColor = vec4(max(color, 0.0), opacity);
  gl_Position = vec4(2.0 * pixel.x / uSize.x - 1.0, 1.0 - 2.0 * pixel.y / uSize.y, 0.0, 1.0);
}`;
}

// From the pixel's own place: an interpolated offset would move with the corners, which drivers round to a grid.
export const SPLAT_FRAGMENT_SHADER = `#version 300 es
precision highp float;
flat in vec2 vCenter;
flat in mat2 vToUnit;
flat in vec4 vColor;
out vec4 result;
void main() {
  vec2 offset = (gl_FragCoord.xy - vCenter) * vToUnit; // in standard deviations
  float alpha = min(0.999, vColor.a * exp(-0.5 * dot(offset, offset)));
  if (alpha < ${MIN_ALPHA}) discard;
  result = vec4(vColor.rgb * alpha, alpha);
}`;

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
