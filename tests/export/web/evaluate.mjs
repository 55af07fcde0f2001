// Vertices, frames and signals of every recorded frame of data files, a line of JSON each:
// node evaluate.mjs PLAYER_FOLDER FILE...
import { readFile } from 'node:fs/promises';
import { pathToFileURL } from 'node:url';

const [folder, ...files] = process.argv.slice(2);
const load = (name) => import(pathToFileURL(`${folder}/${name}`));
const [{ readData }, { Motion, Rig }, { FaceFrames, FACE_FLOATS }, { DepthSort }] = await Promise.all(
  ['data.js', 'motion.js', 'face_frames.js', 'renderer.js'].map(load),
);
for (const file of files) {
  try {
    const data = await readData(new Uint8Array(await readFile(file)));
    const { header, arrays } = data;
    const [motion, rig] = [new Motion(data), new Rig(data)];
    const frames = new FaceFrames(arrays, header.convention, header.offsets);
    const camera = header.views[0]?.world_to_camera ?? [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1];
    const texels = new Float32Array(FACE_FLOATS * frames.count);
    const results = [];
    for (let frame = 0; frame < motion.frames; frame++) {
      motion.sample(frame);
      frames.update(rig.pose(motion));
      frames.annotate(null, texels);
      frames.compose(camera, texels);
      const order = new DepthSort(arrays.xyz.values, arrays.splats_per_face.values).sort(texels);
      results.push({
        vertices: Array.from(rig.vertices),
        frames: Array.from(frames.world),
        texels: Array.from(texels),
        order: Array.from(order),
      });
    }
    console.log(JSON.stringify({ results }));
  } catch (error) {
    console.log(JSON.stringify({ error: `${error.constructor.name}: ${error.message}` }));
  }
}
