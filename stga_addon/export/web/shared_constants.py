"""Constants that the page's JavaScript shares with Python, in `player/constants.js`.

python -m stga_addon.export.web.shared_constants writes that file.
"""

from ...avatar import embedding, strain
from ...light import harmonics, lamps, relight, surface, values
from ...raster.shader_constants import printed_constants
from .page import PLAYER

FILE = PLAYER / "constants.js"
CONSTANTS = {
    "STRAIN_GAIN": strain.STRAIN_GAIN,
    "MAX_DEFORMATION": strain.MAX_STRAIN,
    "AVERAGING_ROUNDS": strain.AVERAGING_ROUNDS,
    "MIN_SQUARED_NORMAL": strain.MIN_SQUARED_NORMAL,
    "MIN_AREA_RATIO": embedding.MIN_AREA_RATIO,
    "UPRIGHT_COSINE": embedding.UPRIGHT_COSINE,
    "MAP_SIZE": lamps.MAP_SIZE,
    "LIFT_M": lamps.LIFT_M,
    "CELL_M": surface.CELL_M,
    "MAX_CELLS": surface.MAX_CELLS,
    "SKIN": surface.SKIN,
    "MIN_OPEN": surface.MIN_OPEN,
    "LAMBERT": harmonics.LAMBERT,
    "GLOSSY": harmonics.GLOSSY,
    "UNLIKE_LIGHT": relight.UNLIKE_LIGHT,
    "COVERED_WEIGHT": relight.COVERED_WEIGHT,
    "MIN_IRRADIANCE": relight.MIN_IRRADIANCE,
    "HAIR_ROUGHNESS": values.HAIR_ROUGHNESS,
}


def script() -> str:
    """Content of FILE."""
    note = f"// @ts-check\n// Printed by {__package__}.shared_constants from Python's values.\n\n"
    return note + printed_constants(CONSTANTS, "javascript")


if __name__ == "__main__":
    FILE.write_text(script(), encoding="utf-8")
