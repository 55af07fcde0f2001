// Types of the player, for `make lint-web`; the page holds none of them.

export type Pair = [number, number];
export type Vector = [number, number, number];

/** What the player uses of a Float32Array or Int32Array. */
export interface Values extends ArrayLike<number>, Iterable<number> {
  subarray(begin?: number, end?: number): Values;
  every(test: (value: number) => boolean): boolean;
  [index: number]: number;
  reduce(add: (sum: number, value: number) => number, start: number): number;
}

/** A view of a data file: as a camera, but for the matrix's name. */
export type View = Omit<Camera, 'matrix'> & { name: string; world_to_camera: number[] };

/** Light of the capture (27 harmonics); how much albedo is drawn to its mean, 0 to 1, and that. */
export type LightOfCapture = { damping: number; recorded: number[]; typical: number[] };

/** Header of a data file, checked. Of `shapes`, `limited` counts up to the weight of `opens`. */
export interface Header {
  title: string;
  convention: 'stga' | 'gaussian_avatars';
  antialiased: boolean;
  /** Name of the coefficients -> what drives them, and what they change (face_frames.js). */
  offsets: Record<
    string,
    [keyof typeof import('./face_frames.js').SIGNALS, 'position' | 'scale' | 'color' | 'light']
  >;
  background: Vector;
  fps: number;
  up: Vector;
  joints: string[];
  parents: number[];
  sliders: { name: string; component: number; reach: number }[];
  shapes?: { names: string[]; opens: string; limited: string };
  light?: LightOfCapture;
  views: View[];
}

/** Arrays of a data file, checked: those of `checkData` (data.js). */
export type Arrays = { [name: string]: DataArray };
export type DataArray = { shape: number[]; values: Values };
export type Data = { header: Header; arrays: Arrays };

/** Pixels, and world to camera (16, row-major, OpenCV axes, meters). */
export type Camera = { size: Pair; focal: Pair; center: Pair; matrix: Float64Array };

/** Unit vector to a distant light; what a surface that faces it gets: W/m², linear RGB. */
export type Sun = { toward: Vector; color: Vector };

/** What lights the avatar, in the axes of its meshes; even radiance 1 shows albedo as it is. */
export interface Lighting {
  /** Radiance from everywhere, linear red, green, blue. */
  even?: Vector;
  /** A built-in environment, turned about the upward axis by `turn` radians. */
  environment?: string;
  turn?: number;
  /** Nine spherical harmonics of radiance, red, green, blue of each (light.js). */
  harmonics?: number[];
  /** Throws shadows; takes the place of the environment's sun. */
  sun?: Sun;
  /** Stops. */
  exposure?: number;
}

/** Lighting as the player computes with it. */
export type LitBy = { world: Float64Array; sun: Sun | null; factor: number };

/** Red, green, blue and alpha, 0 to 1. */
export type Color = [number, number, number, number];

/** Behind the splats; and whether those on triangles that the frame did not train are gray. */
export type Look = { background: Color; showSelection: boolean };

export type GL = WebGL2RenderingContext;
export type Uniforms = Record<string, WebGLUniformLocation | null>;
export type Program = { program: WebGLProgram; uniforms: Uniforms };

/**
 * Rows at even times; columns of shapes, and of the head's yaw, pitch, roll in radians, or -1.
 * guessedFps: the rate that was taken of a file that does not tell its own; null: it does.
 */
export type Performance = {
  columns: number[];
  head: number[];
  rows: Float64Array[];
  fps: number;
  guessedFps: number | null;
};
