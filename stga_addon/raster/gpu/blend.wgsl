// What blending forward and backward share. A workgroup is a tile, in the forward a thread a pixel.
//
// Needs the uniform `view` and the tables `projected`, `pair_slot` and `slot_splat`.

struct Splat {
  mean: vec2f, // from the tile's corner
  precision_x: f32,
  shear: f32,
  precision_y: f32,
  opacity: f32,
  color: vec3f,
}

fn fetch(i: u32, corner: vec2f) -> Splat {
  let at = i * PROJECTED;
  return Splat(
    vec2f(projected[at + MEAN_X], projected[at + MEAN_Y]) - corner,
    projected[at + PRECISION_X],
    projected[at + SHEAR],
    projected[at + PRECISION_Y],
    projected[at + OPACITY],
    vec3f(projected[at + RED], projected[at + GREEN], projected[at + BLUE]),
  );
}

// The splat of a pair, with WANTED.
fn marked_splat(pair: u32) -> u32 {
  return slot_splat[pair_slot[pair]];
}

fn tile_corner(tile: u32) -> vec2u {
  return vec2u(tile % view.tiles_x, tile / view.tiles_x) * TILE;
}

fn is_inside(pixel: vec2u) -> bool {
  return pixel.x < view.width && pixel.y < view.height;
}

// Center of a tile's pixel, from the tile's corner.
fn pixel_center(number: u32) -> vec2f {
  return vec2f(vec2u(number % TILE, number / TILE)) + 0.5;
}

// Opacity · density at an offset from the splat's center: squares, whose sign rounding cannot turn.
fn raw_alpha(splat: Splat, dx: f32, dy: f32) -> f32 {
  let along = dx - splat.shear * dy;
  return splat.opacity * exp(-0.5 * (splat.precision_x * along * along + splat.precision_y * dy * dy));
}
