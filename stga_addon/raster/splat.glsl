/* Splats on the screen, as in cpu/splat_block.py: for Blender's shaders and for the web page's player. Needs what
   splat_shader.py puts before it. Lengths are pixels. */

/* Slopes x / z and y / z of a place in camera space where its projection is linearized: not far outside the image. */
vec2 limited_slope(vec3 place, vec2 focal, vec2 principal, vec2 size)
{
  vec2 margin = SLOPE_MARGIN * size / focal;
  return clamp(place.xy / place.z, -principal / focal - margin, (size - principal) / focal + margin);
}

/* Covariance xx, xy, yy, and last its determinant without LOW_PASS_PX2. a, b: a splat's three axes along x and y. */
vec4 screen_covariance(vec3 a, vec3 b)
{
  vec3 minors = cross(a, b); /* the determinant without cancellation */
  return vec4(dot(a, a) + LOW_PASS_PX2, dot(a, b), dot(b, b) + LOW_PASS_PX2, dot(minors, minors));
}

/* Never cancels to zero or below. */
float covariance_determinant(vec4 covariance)
{
  return covariance.w + LOW_PASS_PX2 * (covariance.x + covariance.z - LOW_PASS_PX2);
}

/* Without what LOW_PASS_PX2 adds to the area, of splats that were trained so. */
float antialiased_opacity(float opacity, vec4 covariance)
{
  return opacity * sqrt(covariance.w / covariance_determinant(covariance));
}

/* Direction of the ellipse's longer axis; standard deviations along it and across. */
vec4 ellipse_axes(vec4 covariance)
{
  float xx = covariance.x, xy = covariance.y, yy = covariance.z;
  float longer = 0.5 * (xx + yy) + length(vec2(0.5 * (xx - yy), xy));
  vec2 axis = xx >= yy ? vec2(longer - yy, xy) : vec2(xy, longer - xx); /* the part that does not cancel */
  axis = dot(axis, axis) > 0.0 ? normalize(axis) : vec2(1.0, 0.0);
  return vec4(axis, sqrt(longer), sqrt(covariance_determinant(covariance) / longer));
}

/* Standard deviations from the center to where alpha falls below MIN_ALPHA. */
float splat_reach(float opacity)
{
  return sqrt(2.0 * log(opacity / MIN_ALPHA));
}

/* offset: standard deviations from the center. */
float splat_alpha(float opacity, vec2 offset)
{
  return min(MAX_ALPHA, opacity * exp(-0.5 * dot(offset, offset)));
}
