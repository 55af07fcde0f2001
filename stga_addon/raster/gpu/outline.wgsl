// Which tiles a splat reaches: of those within its bounds the rendered ones whose pixels its outline, the ellipse on
// which alpha = MIN_ALPHA, may touch. See `cpu/outline.py`.
//
// Needs numbers.wgsl, the uniform `view` and the tables `projected` and `rendered`.

struct Outline {
  mean: vec2f,
  extent_y: f32, // half height, pixels
  lean: f32, // x of its highest point
  rate: f32, // of the middle of a chord along y, by x
  chord: f32, // square of half the chord through the mean
  cut: f32, // what that loses, by x²
  slack: f32, // pixels, so that rounding loses none
}

fn outline_of(i: u32) -> Outline {
  let at = i * PROJECTED;
  let precision_x = projected[at + PRECISION_X];
  let shear = projected[at + SHEAR];
  let precision_y = projected[at + PRECISION_Y];
  let reach = reach_of(projected[at + OPACITY]);
  let shrink = 1.0 / (precision_x * shear * shear + precision_y);
  var o: Outline;
  o.mean = vec2f(projected[at + MEAN_X], projected[at + MEAN_Y]);
  o.extent_y = sqrt(reach / precision_y);
  o.lean = shear * o.extent_y;
  o.rate = precision_x * shear * shrink;
  o.chord = reach * shrink;
  o.cut = precision_x * precision_y * shrink * shrink;
  o.slack = 0.01 + 1.0e-3 * sqrt(o.chord) + 1.0e-6 * o.extent_y;
  return o;
}

// Whether a pixel's center of a tile lies within an outline.
fn touches(o: Outline, tile: vec2u) -> bool {
  let mean = o.mean - vec2f(tile * TILE) - 0.5; // from the center of the tile's first pixel
  let last = f32(TILE - 1u);
  let low = -mean.x;
  let high = low + last;
  let nearest = clamp(0.0, low, high);
  if o.cut * nearest * nearest > 1.00001 * o.chord {
    return false;
  }
  // Between the tile's outermost columns the ellipse is highest where it is highest altogether, or else at the nearer
  // edge, and likewise lowest.
  let top = clamp(-o.lean, low, high);
  let bottom = clamp(o.lean, low, high);
  let up = o.rate * top - sqrt(max(0.0, o.chord - o.cut * top * top)) - o.slack;
  let down = o.rate * bottom + sqrt(max(0.0, o.chord - o.cut * bottom * bottom)) + o.slack;
  let height = o.extent_y + 1.0e-3;
  let first = ceil(max(0.0, mean.y + max(up, -height)));
  return first <= min(last, mean.y + min(down, height));
}

fn is_listed(o: Outline, tile: vec2u) -> bool {
  return rendered[tile.y * view.tiles_x + tile.x] == 1u && touches(o, tile);
}
