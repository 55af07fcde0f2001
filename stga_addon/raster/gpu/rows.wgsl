// Rows of tables between steps: columns of listed rows are packed into a table of their own, or written from it.

var<uniform> part: Part;
var<storage> table: array<u32>; // (N, stride)
var<storage> numbers: array<u32>; // (M,) of rows of the table
var<storage> packed: array<u32>; // (M, width), from word `at` on

// Word of the table for that of the packed columns.
fn table_word(i: u32) -> u32 {
  var row = i / part.width;
  if part.listed == 1u {
    row = numbers[row];
  }
  return row * part.stride + part.first + i % part.width;
}

@compute @workgroup_size(WORKGROUP)
fn gather(thread: Thread) {
  let i = thread_number(thread);
  if i < part.rows * part.width {
    packed[part.at + i] = table[table_word(i)];
  }
}

@compute @workgroup_size(WORKGROUP)
fn scatter(thread: Thread) {
  let i = thread_number(thread);
  if i < part.rows * part.width {
    table[table_word(i)] = packed[part.at + select(i, 0u, part.alike == 1u)];
  }
}
