// Stable radix sort of keys with a value each, DIGITS at a time in three steps: `count` how often a block of keys has
// each digit, `place` the blocks' shares of a digit one after the other, `scatter` the keys.
//
// Within a block a key's place is found by comparison with the keys before it, 256 at a time, so that neither the
// order of atomic operations nor the width of subgroups plays a part.

override SHIFT: u32 = 0u; // of the digit
override FIRST: bool = true; // the values are the keys' own numbers
override OF_PAIRS: bool = false; // sort as many keys as there are pairs, instead of splats

var<storage> keys: array<u32>;
var<storage> values: array<u32>;
var<storage> sorted_keys: array<u32>;
var<storage> sorted_values: array<u32>;
// (blocks, DIGITS): how often, then how often in the blocks before.
var<storage> block_digits: array<u32>;
var<storage> digit_totals: array<u32>;

const ROUNDS: u32 = SORT_BLOCK / WORKGROUP;
const DIGITS_PER_THREAD: u32 = DIGITS / WORKGROUP;

var<workgroup> bins: array<atomic<u32>, DIGITS>;
var<workgroup> next_place: array<u32, DIGITS>;
var<workgroup> round_digits: array<u32, WORKGROUP>;

fn key_count() -> u32 {
  if OF_PAIRS {
    return counts[PAIRS];
  }
  return view.splats;
}

fn digit_of(key: u32) -> u32 {
  return (key >> SHIFT) & (DIGITS - 1u);
}

@compute @workgroup_size(WORKGROUP)
fn count(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
  for (var k = 0u; k < DIGITS_PER_THREAD; k++) {
    atomicStore(&bins[local + k * WORKGROUP], 0u);
  }
  workgroupBarrier();
  for (var round = 0u; round < ROUNDS; round++) {
    let n = workgroup.x * SORT_BLOCK + round * WORKGROUP + local;
    if n < key_count() {
      atomicAdd(&bins[digit_of(keys[n])], 1u);
    }
  }
  workgroupBarrier();
  for (var k = 0u; k < DIGITS_PER_THREAD; k++) {
    let digit = local + k * WORKGROUP;
    block_digits[workgroup.x * DIGITS + digit] = atomicLoad(&bins[digit]);
  }
}

// A thread a digit.
@compute @workgroup_size(WORKGROUP)
fn place(@builtin(global_invocation_id) thread: vec3u) {
  let blocks = (key_count() + SORT_BLOCK - 1u) / SORT_BLOCK;
  var total = 0u;
  for (var block = 0u; block < blocks; block++) {
    let at = block * DIGITS + thread.x;
    let found = block_digits[at];
    block_digits[at] = total;
    total += found;
  }
  digit_totals[thread.x] = total;
}

@compute @workgroup_size(WORKGROUP)
fn scatter(@builtin(workgroup_id) workgroup: vec3u, @builtin(local_invocation_index) local: u32) {
  find_places(workgroup.x, local);
  for (var round = 0u; round < ROUNDS; round++) {
    let n = workgroup.x * SORT_BLOCK + round * WORKGROUP + local;
    let exists = n < key_count();
    var key = 0u;
    var digit = DIGITS; // of no key
    if exists {
      key = keys[n];
      digit = digit_of(key);
    }
    workgroupBarrier();
    round_digits[local] = digit;
    workgroupBarrier();
    var before = 0u;
    var after = 0u;
    for (var other = 0u; other < WORKGROUP; other++) {
      let equal = u32(round_digits[other] == digit);
      before += select(0u, equal, other < local);
      after += select(0u, equal, other > local);
    }
    var target_place = 0u;
    if exists {
      target_place = next_place[digit] + before;
      sorted_keys[target_place] = key;
      var value = n;
      if !FIRST {
        value = values[n];
      }
      sorted_values[target_place] = value;
    }
    workgroupBarrier();
    if exists && after == 0u {
      next_place[digit] = target_place + 1u;
    }
  }
}

// Where this block's first key of each digit goes: behind all smaller digits, and behind its own in earlier blocks.
fn find_places(block: u32, local: u32) {
  let first = local * DIGITS_PER_THREAD;
  var own = 0u;
  for (var k = 0u; k < DIGITS_PER_THREAD; k++) {
    own += digit_totals[first + k];
  }
  var smaller = sum_until(own, local) - own;
  for (var k = 0u; k < DIGITS_PER_THREAD; k++) {
    let digit = first + k;
    next_place[digit] = smaller + block_digits[block * DIGITS + digit];
    smaller += digit_totals[digit];
  }
}
