// @ts-check
// Printed by stga_addon.export.web.shared_constants from Python's values.

export const STRAIN_GAIN = 5;
export const MAX_DEFORMATION = 2;
export const AVERAGING_ROUNDS = 3;
export const MIN_SQUARED_NORMAL = 1e-24;
export const MIN_AREA_RATIO = 0.0001;
export const UPRIGHT_COSINE = 0.8;
export const MAP_SIZE = 512;
export const LIFT_M = 0.001;
export const CELL_M = 0.02;
export const MAX_CELLS = 40;
export const SKIN = [0.5, 0.33, 0.25];
export const MIN_OPEN = 0.3;
export const LAMBERT = [3.141592653589793, 2.0943951023931953, 2.0943951023931953, 2.0943951023931953, 0.7853981633974483, 0.7853981633974483, 0.7853981633974483, 0.7853981633974483, 0.7853981633974483];
export const GLOSSY = [1, 0.85, 0.85, 0.85, 0.62, 0.62, 0.62, 0.62, 0.62];
export const UNLIKE_LIGHT = 0.2;
export const COVERED_WEIGHT = 0.001;
export const MIN_IRRADIANCE = 0.15;
export const HAIR_ROUGHNESS = 1;
