// Which tiles are rendered, and every tile's list of pairs, near to far.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> rect: array<vec4i>;
@group(0) @binding(2) var<storage, read> focus: array<u32>;
@group(0) @binding(3) var<storage, read_write> touched: array<atomic<u32>>; // (tiles,) a splat in focus reaches it
@group(0) @binding(4) var<storage, read_write> rendered: array<u32>; // (tiles,)
@group(0) @binding(5) var<storage, read_write> tile_range: array<vec2u>; // (tiles,) first pair, one past the last

// A thread a splat; `touched` is zero before.
@compute @workgroup_size(WORKGROUP)
fn mark(thread: Thread) {
  let i = thread_number(thread);
  if i >= view.splats || focus[i] == 0u {
    return;
  }
  let r = rect[i];
  for (var y = r.y; y < r.w; y++) {
    for (var x = r.x; x < r.z; x++) {
      atomicStore(&touched[u32(y) * view.tiles_x + u32(x)], 1u);
    }
  }
}

// A thread a tile: render the touched tiles and those at most view.ring tiles away, or all without a focus.
@compute @workgroup_size(WORKGROUP)
fn choose(thread: Thread) {
  let tile = thread_number(thread);
  if tile >= view.tiles_x * view.tiles_y {
    return;
  }
  tile_range[tile] = vec2u(0u);
  if view.focused == 0u {
    atomicStore(&touched[tile], 1u);
    rendered[tile] = 1u;
    return;
  }
  let x = tile % view.tiles_x;
  let y = tile / view.tiles_x;
  var near = 0u;
  for (var row = y - min(y, view.ring); row < min(view.tiles_y, y + view.ring + 1u); row++) {
    for (var column = x - min(x, view.ring); column < min(view.tiles_x, x + view.ring + 1u); column++) {
      near |= atomicLoad(&touched[row * view.tiles_x + column]);
    }
  }
  rendered[tile] = near;
}
