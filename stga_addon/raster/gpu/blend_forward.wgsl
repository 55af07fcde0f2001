// Alpha blending of each rendered tile's splats, near to far, over the background; see `cpu/blend.py`.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> rendered: array<u32>;
@group(0) @binding(2) var<storage, read> tile_range: array<vec2u>;
@group(0) @binding(3) var<storage, read> pair_slot: array<u32>;
@group(0) @binding(4) var<storage, read> slot_splat: array<u32>;
@group(0) @binding(5) var<storage, read> projected: array<f32>;
@group(0) @binding(6) var<storage, read_write> image: array<f32>; // (3, H, W)
@group(0) @binding(7) var<storage, read_write> pixels: array<vec2u>; // (H, W)

// Splats are fetched a workgroup's worth at a time.
var<workgroup> batch: array<Splat, WORKGROUP>;
var<workgroup> open_pixels: atomic<u32>; // that something behind can still be seen through
var<workgroup> is_open: u32;

@compute @workgroup_size(WORKGROUP)
fn main(thread: Thread) {
  let local = thread.local;
  let tile = workgroup_number(thread);
  if tile >= view.tiles_x * view.tiles_y || rendered[tile] == 0u {
    return;
  }
  let corner = tile_corner(tile);
  let pixel = corner + vec2u(local % TILE, local / TILE);
  let center = pixel_center(local);
  var open = is_inside(pixel);
  var color = vec3f(0.0);
  var t = 1.0;
  var last = 0u;
  let range = tile_range[tile];
  for (var begin = range.x; begin < range.y; begin += WORKGROUP) {
    if !anyone_open(open, local) {
      break;
    }
    if begin + local < range.y {
      batch[local] = fetch(marked_splat(begin + local) & ~WANTED, vec2f(corner));
    }
    workgroupBarrier();
    let length = min(WORKGROUP, range.y - begin);
    for (var q = 0u; open && q < length; q++) {
      let splat = batch[q];
      let offset = center - splat.mean;
      let a = min(MAX_ALPHA, raw_alpha(splat, offset.x, offset.y));
      if a < MIN_ALPHA {
        continue;
      }
      let after = t * (1.0 - a);
      if after <= MIN_TRANSMITTANCE {
        open = false;
        break;
      }
      color += a * t * splat.color;
      t = after;
      last = begin + q - range.x + 1u;
    }
  }
  if !is_inside(pixel) {
    return;
  }
  color += t * vec3f(view.background_r, view.background_g, view.background_b);
  let n = pixel.y * view.width + pixel.x;
  let area = view.width * view.height;
  image[n] = color.x;
  image[area + n] = color.y;
  image[2u * area + n] = color.z;
  pixels[n] = vec2u(bitcast<u32>(t), last);
}

// Whether any pixel of the tile is open; also separates the use of one batch from the fetching of the next.
fn anyone_open(open: bool, local: u32) -> bool {
  if local == 0u {
    atomicStore(&open_pixels, 0u);
  }
  workgroupBarrier();
  if open {
    atomicStore(&open_pixels, 1u);
  }
  workgroupBarrier();
  if local == 0u {
    is_open = atomicLoad(&open_pixels);
  }
  return workgroupUniformLoad(&is_open) == 1u;
}
