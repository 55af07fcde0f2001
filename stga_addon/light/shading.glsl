/* Relit colors, as in relight.py, lamps.py and array_kernels.py: for Blender's shaders and for the web page's player.
   Needs what shading.py puts before it, and two macros: SHADOW_DEPTH(cell), of a texel of all shadow maps beside each other,
   and WORLD(first, k), radiance of the world by harmonics, times GLOSSY. */

/* Meters by which a surface is lifted out of its own shadow: texels of a map, in meters, that it is tilted across. */
float shadow_bias(float cosine, float texel)
{
  float c = clamp(cosine, 0.05, 1.0);
  return min(BIAS + (TAP_STEP + 1.0) * texel * sqrt(1.0 - c * c) / c, MAX_BIAS);
}

/* Share of nine taps that light reaches, at a place and a depth of the shadow map that begins at a corner. */
float lit_fraction(ivec2 corner, vec2 place, float depth)
{
  float found = 0.0;
  for (int tap = 0; tap < 9; tap++) {
    vec2 where = place - 0.5 + TAP_STEP * vec2(float(tap % 3 - 1), float(tap / 3 - 1));
    vec2 low = floor(where), share = where - low;
    for (int k = 0; k < 4; k++) {
      ivec2 cell = ivec2(low) + ivec2(k & 1, k >> 1);
      bool outside = cell.x < 0 || cell.y < 0 || cell.x >= MAP_SIZE || cell.y >= MAP_SIZE;
      cell = corner + clamp(cell, ivec2(0), ivec2(MAP_SIZE - 1));
      if (outside || depth <= SHADOW_DEPTH(cell)) {
        found += ((k & 1) == 1 ? share.x : 1.0 - share.x) * ((k >> 1) == 1 ? share.y : 1.0 - share.y);
      }
    }
  }
  return found / 9.0;
}

/* GGX with Smith's shadowing and Schlick's Fresnel term, over the cosine towards the light; square: of alpha. */
float ggx(vec3 normal, vec3 toward, vec3 view, float square)
{
  vec3 between = normalize(toward + view);
  float facing = dot(normal, toward), toward_eye = max(dot(normal, view), 0.05);
  float half_cosine = clamp(dot(normal, between), 0.0, 1.0);
  float spread = half_cosine * half_cosine * (square - 1.0) + 1.0;
  float distribution = square / (PI * spread * spread);
  float shadowing = facing * sqrt(toward_eye * toward_eye * (1.0 - square) + square)
                  + toward_eye * sqrt(facing * facing * (1.0 - square) + square);
  float fresnel = REFLECTANCE + (1.0 - REFLECTANCE) * pow(1.0 - clamp(dot(view, between), 0.0, 1.0), 5.0);
  return 0.5 * distribution * fresnel / shadowing;
}

/* The world's radiance around the mirrored direction times the lobe's reflectance (Karis 2014). */
vec3 sky_highlight(int first, vec3 normal, vec3 view, float roughness, float occlusion)
{
  float cosine = max(dot(normal, view), 0.02);
  vec3 d = 2.0 * cosine * normal - view;
  vec3 seen = 0.28209479177387814 * WORLD(first, 0);
  seen += 0.4886025119029199 * (d.y * WORLD(first, 1) + d.z * WORLD(first, 2) + d.x * WORLD(first, 3));
  seen += 1.0925484305920792
        * (d.x * d.y * WORLD(first, 4) + d.y * d.z * WORLD(first, 5) + d.x * d.z * WORLD(first, 7));
  seen += 0.31539156525252005 * (3.0 * d.z * d.z - 1.0) * WORLD(first, 6)
        + 0.5462742152960396 * (d.x * d.x - d.y * d.y) * WORLD(first, 8);
  float x = 1.0 - roughness, y = 0.0425 - 0.0275 * roughness;
  float z = 1.04 - 0.572 * roughness, w = 0.022 * roughness - 0.04;
  float share = min(x * x, exp2(-9.28 * cosine)) * x + y;
  return max(seen, vec3(0.0)) * occlusion * (REFLECTANCE * (z - 1.04 * share) + 1.04 * share + w);
}

/* Linear color of a surface that reflects what arrives, and shows some of what was recorded. color: sRGB without what
   depends on the view, roughness (0: skin; HAIR_ROUGHNESS); old: irradiance of the capture; typical: mean albedo,
   damping; kept: gain and share of the recorded sRGB. */
vec3 lit_color(vec4 color, vec3 old, vec3 arriving, vec3 highlight, vec3 recorded, vec4 typical, vec4 kept)
{
  vec3 base = srgb_to_linear(max(color.rgb, vec3(0.0)));
  bool is_wet = color.a > 0.0 && color.a < 0.5 * HAIR_ROUGHNESS;
  vec3 glossy = (is_wet ? WET_HIGHLIGHT_FRACTION : HIGHLIGHT_FRACTION) / PI * old;
  vec3 albedo = PI * max(base - glossy, MIN_DIFFUSE_FRACTION * base) / max(old, vec3(1e-6));
  if (typical.a > 0.0) {
    albedo = pow(max(albedo, vec3(1e-4)), vec3(1.0 - typical.a)) * pow(typical.rgb, vec3(typical.a));
  }
  vec3 lit = albedo * arriving / PI + highlight;
  if (kept.a > 0.0) {
    vec3 same = kept.rgb * old;
    float off = length(arriving - same) / max(length(same), 1e-6);
    vec3 shown = kept.rgb * srgb_to_linear(max(recorded, vec3(0.0)));
    lit = mix(lit, shown, kept.a * (1.0 - smoothstep(ALIKE_AT_SPLAT, UNLIKE_AT_SPLAT, off)));
  }
  return lit;
}
