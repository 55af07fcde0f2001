// @ts-check
// Performances in CSV: Live Link Face, Audio2Face, and any table with a column per shape.
// The rules are those of STGA for Blender's read_performance.py.

/** @import { Performance } from './types.js' */

import { DataError } from './data.js';

const MAX_ROWS = 1 << 18;
const MAX_WEIGHT = 10;
const DEFAULT_FPS = 60;
const TIMECODE_BASES = [24, 25, 30, 48, 50, 60, 100, 120];
const USUAL_BASE = 60; // of a take of less than a second, whose frame numbers do not tell
const DAY_S = 86400;
const HEAD = ['headyaw', 'headpitch', 'headroll'];
const MIN_SHAPES = 10; // of a table that holds a performance

// The performance in a text, with a column per known shape (-1: it has none). Throws DataError in
// one sentence.
/** @type {(text: string, names: string[]) => Performance} */
export function readPerformance(text, names) {
  const lines = text
    .replace(/^\uFEFF/, '')
    .split(/\r?\n/)
    .filter((line) => line.trim());
  const header = (lines[0] ?? '').split(',').map((cell) => cell.trim());
  const plain = header.map(plainName);
  const columns = names.map((name) => plain.indexOf(name.toLowerCase()));
  if (columns.filter((column) => column >= 0).length < MIN_SHAPES)
    throw new DataError(
      'This file is no table of face shapes (CSV of Live Link Face or Audio2Face).',
    );
  const counts = header.findIndex((name) => name.toLowerCase() === 'blendshapecount');
  const cells = lines
    .slice(1, MAX_ROWS + 1)
    .map((line) => line.split(','))
    .filter((row) => row.length === header.length && (counts < 0 || Number(row[counts]) > 0));
  if (!cells.length) throw new DataError('The performance has no row with a face.');
  const rows = cells.map((row) => Float64Array.from(row, Number));
  const used = columns.filter((column) => column >= 0);
  if (!rows.every((row) => used.every((column) => Math.abs(row[column]) <= MAX_WEIGHT)))
    throw new DataError('The performance holds weights that are no numbers from 0 to 1.');
  const head = HEAD.map((name) => plain.indexOf(name));
  return evenly({ columns, head, rows, fps: DEFAULT_FPS }, times(header, cells));
}

// mouthsmileleft of blendShapes.MouthSmile_L, mouth_smile_left, …
/** @param {string} name */
function plainName(name) {
  const last = name.slice(name.lastIndexOf('.') + 1).toLowerCase();
  const side = /^(.*)[_\- ]([lr])$/.exec(last);
  return (side ? side[1] + (side[2] === 'l' ? 'left' : 'right') : last).replace(/[_\- ]/g, '');
}

// Seconds of each row from the first, or null where the table has none.
/** @type {(header: string[], cells: string[][]) => number[] | null} */
function times(header, cells) {
  const names = header.map((name) => name.toLowerCase());
  const at = names.findIndex((name) => ['timecode', 'time', 'timestamp', 'seconds'].includes(name));
  if (at < 0) return null;
  const texts = cells.map((row) => row[at].trim());
  const found = texts.map((text) => /^(\d+):(\d+):(\d+)[:;.](\d+)(\.\d+)?$/.exec(text));
  if (!found.every((match) => match)) {
    const numbers = texts.map(Number);
    return numbers.every(Number.isFinite) ? numbers.map((time) => time - numbers[0]) : null;
  }
  const seconds = found.map(
    (match) => 3600 * Number(match?.[1]) + 60 * Number(match?.[2]) + Number(match?.[3]),
  );
  const frames = found.map((match) => Number(match?.[4]) + Number(match?.[5] ?? 0));
  const largest = Math.max(...frames);
  const spread = (/** @type {number} */ base) =>
    unevenness(seconds.map((second, row) => second + frames[row] / base));
  const possible = TIMECODE_BASES.filter((base) => base > largest);
  let base = possible[0] ?? largest + 1;
  if (new Set(seconds).size < 2) base = possible.includes(USUAL_BASE) ? USUAL_BASE : base;
  else for (const next of possible) if (spread(next) < spread(base)) base = next;
  let days = 0;
  const elapsed = seconds.map((second, row) => second + frames[row] / base);
  return elapsed.map((time, row) => {
    if (row && time - elapsed[row - 1] < -DAY_S / 2) days += DAY_S;
    return time + days - elapsed[0];
  });
}

/** @param {number[]} values */
function unevenness(values) {
  const steps = values.slice(1).map((value, row) => value - values[row]);
  const usual = steps.filter((step) => step > 0 && step < 1);
  if (!usual.length) return 0;
  const middle = median(usual);
  const mean = usual.reduce((sum, step) => sum + Math.abs(step - middle), 0) / usual.length;
  return Math.round(1e6 * mean) / 1e6;
}

/** @param {number[]} values */
function median(values) {
  return [...values].sort((one, other) => one - other)[Math.floor(values.length / 2)];
}

// The performance at even times, with rows that are missing interpolated.
/** @type {(performance: Performance, seconds: number[] | null) => Performance} */
function evenly(performance, seconds) {
  if (!seconds || seconds.length < 2) return performance;
  const steps = seconds.slice(1).map((second, row) => second - seconds[row]);
  const step = median(steps.filter((length) => length > 0));
  const count = Math.floor((seconds.at(-1) ?? 0) / step + 1.001);
  if (!(step >= 1e-3 && step <= 1) || count > MAX_ROWS)
    throw new DataError('The times of the performance are not usable.');
  const rows = [];
  for (let number = 0, row = 0; number < count; number++) {
    while (row < seconds.length - 2 && seconds[row + 1] <= number * step) row++;
    const span = seconds[row + 1] - seconds[row];
    const share = span > 0 ? Math.min(Math.max((number * step - seconds[row]) / span, 0), 1) : 0;
    const [before, after] = [performance.rows[row], performance.rows[row + 1]];
    rows.push(before.map((value, column) => value + share * (after[column] - value)));
  }
  return { ...performance, rows, fps: 1 / step };
}
