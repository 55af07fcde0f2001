// Vectors of three numbers.

export function crossed(a, b) {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

export function dotProduct(a, b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

export function difference(a, b) {
  return [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
}

export function scaled(v, factor) {
  return [v[0] * factor, v[1] * factor, v[2] * factor];
}

export function unit(v) {
  return scaled(v, 1 / Math.hypot(...v));
}
