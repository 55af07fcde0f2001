// Performances of CSV texts as the player reads them, as JSON: node performances.mjs PLAYER_FOLDER FILE
// FILE: JSON of [names of shapes, text or [text, rate], …]
import { readFile } from 'node:fs/promises';
import { pathToFileURL } from 'node:url';

const [folder, file] = process.argv.slice(2);
const { readPerformance } = await import(pathToFileURL(`${folder}/performance.js`));
const [names, ...texts] = JSON.parse(await readFile(file));
const results = texts.map(each => {
  const [text, rate] = [each].flat();
  try {
    const { columns, head, rows, fps, guessedFps } = readPerformance(text, names, rate);
    const of = wanted => rows.map(row => wanted.map(column => (column < 0 ? 0 : row[column])));
    return { fps, guessedFps, weights: of(columns), head: of(head) };
  } catch (error) {
    return { error: `${error.constructor.name}: ${error.message}` };
  }
});
console.log(JSON.stringify(results));
