// @ts-check
// Performances in CSV: Live Link Face, Audio2Face, and any table with a column per shape. The
// rules are those of STGA for Blender's performance_files.py.

/** @import { Performance } from './types.js' */

import { DataError } from './data.js';

const MAX_ROWS = 1 << 18;
const MAX_WEIGHT = 10;
const MAX_HEAD_ANGLE = 4 * Math.PI;
const DEFAULT_FPS = 60;
const MAX_FPS = 1000; // and at least 1
const TIMECODE = /^(\d{1,3}):(\d{1,2}):(\d{1,2})([:;.])(\d{1,3})(\.\d{1,6})?$/;
const TIMECODE_BASES = [24, 25, 30, 48, 50, 60, 100, 120, 240];
const TYPICAL_BASE = 60; // of a take whose frame numbers do not show it, as within a second
const EVEN_TOLERANCE_S = 1e-6; // of unevenness, within which bases explain the numbers equally well
const DROP_RATIO = 1000 / 1001; // of drop-frame timecodes, with a semicolon: frames come slower
const DAY_S = 86400;
const SECONDS = ['timecode', 'time', 'timestamp', 'seconds'];
const HEAD = ['headyaw', 'headpitch', 'headroll'];
const OPTIONAL = ['tongueOut']; // shapes that sources of 51 lack; they stay zero
const MAX_NAMED = 8; // names that an error lists

// The performance in a text, with a column per known shape (-1: it has none). recordedFps: the rate
// of a file without one. Throws DataError in one sentence.
/** @type {(text: string, names: string[], recordedFps?: number | null) => Performance} */
export function readPerformance(text, names, recordedFps = null) {
  const performance = performanceIn(text, names);
  if (recordedFps === null) return performance;
  if (!(recordedFps >= 1 && recordedFps <= MAX_FPS))
    throw new DataError(`The rate of a performance is 1 to ${MAX_FPS} frames a second.`);
  if (performance.guessedFps === null)
    throw new DataError('The performance has times, so that no rate is taken.');
  return { ...performance, fps: (performance.fps * recordedFps) / performance.guessedFps };
}

/** @type {(text: string, names: string[]) => Performance} */
function performanceIn(text, names) {
  const [titles = [], ...table] = cellsOf(text.replace(/^\uFEFF/, ''));
  const header = titles.map(title => title.trim());
  const columns = columnsOf(header, names);
  const plain = header.map(name => name.slice(name.lastIndexOf('.') + 1).toLowerCase());
  const counts = plain.indexOf('blendshapecount'); // 0 in rows without a face, or they end after it
  const cells = table.filter(
    row => counts < 0 || (row.length > counts + 1 && !['', '0'].includes(row[counts].trim())),
  );
  if (!cells.length) throw new DataError('The performance has no row with a face.');
  if (cells.length > MAX_ROWS)
    throw new DataError(`The performance has more than ${MAX_ROWS} rows.`);
  const rows = cells.map(row => Float64Array.from(header, (_, column) => number(row[column])));
  const head = HEAD.map(name => plain.indexOf(name));
  const angles = head.includes(-1) ? [] : head;
  const code = plain.indexOf(SECONDS[0]);
  const isCoded = code >= 0 && cells.some(row => row[code].includes(':'));
  const at = plain.indexOf(SECONDS.find(name => plain.includes(name)) ?? '');
  checkNumbers(header, cells, rows, [...columns, ...angles, ...(isCoded ? [] : [at])]);
  if (!rows.every(row => columns.every(column => !(Math.abs(row[column]) > MAX_WEIGHT))))
    throw new DataError('The performance holds weights that are no numbers from 0 to 1.');
  if (!rows.every(row => angles.every(column => Math.abs(row[column]) <= MAX_HEAD_ANGLE)))
    throw new DataError('The head of the performance turns more than two turns.');
  const performance = { columns, head, rows, fps: DEFAULT_FPS, guessedFps: null };
  if (isCoded) {
    const { seconds, guessedFps } = secondsOf(cells.map(row => row[code]));
    return evenly({ ...performance, guessedFps }, seconds);
  }
  if (at < 0) return { ...performance, guessedFps: DEFAULT_FPS };
  const seconds = rows.map(row => row[at]);
  return evenly(performance, seconds);
}

// Rows that are not empty, of cells that may be quoted.
/** @param {string} text */
function cellsOf(text) {
  const cell = /(?:"([^"]*(?:""[^"]*)*)(?:"|$))?([^,\r\n]*)(,|\r\n?|\n|$)/y;
  /** @type {string[][]} */
  const rows = [[]];
  while (cell.lastIndex < text.length) {
    const [, quoted = '', bare, end] = cell.exec(text) ?? [];
    rows[rows.length - 1].push(quoted.replaceAll('""', '"') + bare);
    if (end !== ',') rows.push([]);
  }
  return rows.filter(row => row.some(each => each.trim()));
}

// Column of each shape. Throws DataError where some are missing.
/** @type {(header: string[], names: string[]) => number[]} */
function columnsOf(header, names) {
  const plain = header.map(plainName);
  const columns = names.map(name => plain.indexOf(name.toLowerCase()));
  const missing = names.filter((name, k) => columns[k] < 0 && !OPTIONAL.includes(name));
  if (missing.length > names.length / 2)
    throw new DataError('This file is no table of face shapes (Live Link Face or Audio2Face CSV).');
  if (!missing.length) return columns;
  const more = missing.length > MAX_NAMED ? ` and ${missing.length - MAX_NAMED} more` : '';
  throw new DataError(`The performance lacks ${missing.slice(0, MAX_NAMED).join(', ')}${more}.`);
}

// mouthsmileleft of blendshapes.mouthSmile_L, mouth_smile_left, …
/** @param {string} name */
function plainName(name) {
  const last = name.slice(name.lastIndexOf('.') + 1).toLowerCase();
  const side = /^(.*)[_\- ]([lr])$/.exec(last);
  return (side ? side[1] + (side[2] === 'l' ? 'left' : 'right') : last).replace(/[_\- ]/g, '');
}

const number = (text = '') => (text.trim() ? Number(text) : NaN);

// Throw a DataError unless the columns (-1: none) hold numbers, or infinity.
/** @type {(header: string[], cells: string[][], rows: Float64Array[], columns: number[]) => void} */
function checkNumbers(header, cells, rows, columns) {
  for (const [row, values] of rows.entries()) {
    const column = columns.find(each => Number.isNaN(values[each]));
    if (column === undefined) continue;
    const found = `${header[column]} is "${cells[row][column] ?? ''}"`;
    throw new DataError(`Row ${row + 1} of the performance: ${found}, expected a number.`);
  }
}

// Seconds of timecodes HH:MM:SS:FF.sub, over midnight too, and the rate that FF was taken to count
// where the numbers do not determine it. Throws DataError for other text.
/** @type {(texts: string[]) => { seconds: number[], guessedFps: number | null }} */
function secondsOf(texts) {
  const fields = texts.map((text, row) => {
    const [found, hour, minute, second, separator, frame, part] = TIMECODE.exec(text.trim()) ?? [];
    if (!found)
      throw new DataError(`Row ${row + 1}: Timecode is "${text}", expected HH:MM:SS:FF.sub.`);
    const minutes = 60 * Number(hour) + Number(minute);
    const frames = Number(frame) + Number(part ?? 0);
    return { minutes, second: Number(second), frames, isDropping: separator === ';' };
  });
  const { base, isDetermined } = baseOf(fields);
  const isDropping = fields.some(field => field.isDropping);
  let days = 0;
  const elapsed = fields.map(({ minutes, second, frames }) => {
    const whole = 60 * minutes + second;
    if (!isDropping) return whole + frames / base;
    const leftOut = Math.round(base / 15) * (minutes - Math.floor(minutes / 10));
    return (whole * base + frames - leftOut) / (base * DROP_RATIO);
  });
  const seconds = elapsed.map((time, row) => {
    if (row && time - elapsed[row - 1] < -DAY_S / 2) days += DAY_S;
    return time + days;
  });
  return { seconds, guessedFps: isDetermined ? null : base };
}

// Frames a second that timecodes count, with which the rows come most evenly; and whether their
// numbers determine it.
/** @param {{ minutes: number, second: number, frames: number }[]} fields */
function baseOf(fields) {
  const largest = fields.reduce((most, { frames }) => Math.max(most, frames), 0);
  let bases = TIMECODE_BASES.filter(base => base > largest);
  if (!bases.length) bases = [10 ** String(Math.floor(largest)).length];
  const seconds = fields.map(({ minutes, second }) => 60 * minutes + second);
  if (new Set(seconds).size > 1) {
    const spreads = bases.map(base =>
      unevenness(seconds.map((second, row) => second + fields[row].frames / base)),
    );
    const most = Math.min(...spreads) + EVEN_TOLERANCE_S;
    bases = bases.filter((_, k) => spreads[k] <= most);
  }
  const base = bases.includes(TYPICAL_BASE) ? TYPICAL_BASE : bases[0];
  const isDetermined =
    bases.length === 1 || fields.every(({ frames }) => frames === fields[0].frames);
  return { base, isDetermined };
}

/** @param {number[]} times */
function unevenness(times) {
  const steps = times.slice(1).map((time, row) => time - times[row]);
  const frameSteps = steps.filter(step => step > 0 && step < 1);
  if (!frameSteps.length) return 0;
  const middle = median(frameSteps);
  const mean =
    frameSteps.reduce((sum, step) => sum + Math.abs(step - middle), 0) / frameSteps.length;
  return Math.round(1e6 * mean) / 1e6;
}

/** @param {number[]} values */
function median(values) {
  const sorted = [...values].sort((one, other) => one - other);
  const half = sorted.length / 2;
  return (sorted[Math.ceil(half) - 1] + sorted[Math.floor(half)]) / 2;
}

// The performance in the order of its times, at even ones, with rows that are missing interpolated;
// of rows with the same time the first.
/** @type {(performance: Performance, seconds: number[]) => Performance} */
function evenly(performance, seconds) {
  const ordered = [...seconds.keys()].sort((one, other) => seconds[one] - seconds[other]);
  const kept = ordered.filter((row, k) => !k || seconds[row] > seconds[ordered[k - 1]]);
  const times = kept.map(row => seconds[row] - seconds[kept[0]]);
  if (times.length < 2) return { ...performance, rows: [performance.rows[kept[0]]] };
  const rate = 1 / median(times.slice(1).map((time, k) => time - times[k]));
  const count = Math.floor(times[times.length - 1] * rate + 1e-6) + 1;
  if (!(rate >= 1 && rate <= MAX_FPS && count <= MAX_ROWS))
    throw new DataError('The times of the performance are not usable.');
  const rows = [];
  for (let number = 0, k = 0; number < count; number++) {
    const time = number / rate;
    while (k < times.length - 2 && times[k + 1] <= time) k++;
    const share = Math.min((time - times[k]) / (times[k + 1] - times[k]), 1);
    const [before, after] = [performance.rows[kept[k]], performance.rows[kept[k + 1]]];
    rows.push(before.map((value, column) => value + share * (after[column] - value)));
  }
  return { ...performance, rows, fps: rate };
}
