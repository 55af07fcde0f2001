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
