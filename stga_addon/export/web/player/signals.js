// @ts-check
// Signals of the pose that splats' positions follow.

import { SmoothedStrain } from './strain.js';

/** By the name of their coefficients in a data file (faces, 3·components); of the strain, which is updated first. */
export const SIGNALS = { strain_position: SmoothedStrain };
