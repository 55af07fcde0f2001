"""How splats on the screen and the image's tiles are stored."""

TILE = 16
PIXELS = TILE * TILE

# Columns of the projected splat (see project.py) and of the gradient of one (tile, splat) pair.
# Its density is 2^power, power = −½·log2(e)·(PRECISION_X·(dx − SHEAR·dy)² + PRECISION_Y·dy²). The usual three entries
# of the inverse covariance lose the small one of a long needle, and with it the sign of the power; squares cannot.
MEAN_X, MEAN_Y, PRECISION_X, SHEAR, PRECISION_Y, OPACITY, RED, GREEN, BLUE = range(9)
PROJECTED = 9
