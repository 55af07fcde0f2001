"""Depth maps of triangles as a light sees them."""

import math

import numpy as np

from . import jit

ZERO = np.float32(0.0)
ONE = np.float32(1.0)
HALF = np.float32(0.5)


@jit
def add_depths(points, faces, depth):
    """Draw triangles into a depth map (S, S) float32, which keeps the least depth at each texel's
    center.

    points (V, 3) float32: x and y in texels, depth, or what grows with it and is linear in texels;
    triangles with a point that is not finite are left out.
    """
    size = len(depth)
    centers = np.arange(size).astype(np.float32) + HALF
    for f in range(len(faces)):
        a = faces[f, 0]
        b = faces[f, 1]
        c = faces[f, 2]
        ax = points[a, 0]
        ay = points[a, 1]
        az = points[a, 2]
        bx = points[b, 0] - ax
        by = points[b, 1] - ay
        bz = points[b, 2] - az
        cx = points[c, 0] - ax
        cy = points[c, 1] - ay
        cz = points[c, 2] - az
        area = bx * cy - by * cx
        if not (abs(area) > np.float32(1e-12)):
            continue
        low_x = ax + min(ZERO, bx, cx)
        high_x = ax + max(ZERO, bx, cx)
        low_y = ay + min(ZERO, by, cy)
        high_y = ay + max(ZERO, by, cy)
        if high_x < ZERO or high_y < ZERO or low_x > size or low_y > size:
            continue
        x0 = max(0, math.ceil(low_x - HALF))
        x1 = min(size - 1, math.floor(high_x - HALF))
        y0 = max(0, math.ceil(low_y - HALF))
        y1 = min(size - 1, math.floor(high_y - HALF))
        inverse = ONE / area
        for y in range(y0, y1 + 1):
            dy = np.float32(y) + HALF - ay
            row = depth[y, x0 : x1 + 1]
            across = centers[x0 : x1 + 1]
            for x in range(len(row)):
                dx = across[x] - ax
                u = (dx * cy - dy * cx) * inverse
                v = (bx * dy - by * dx) * inverse
                z = az + u * bz + v * cz
                is_nearer = (u >= ZERO) & (v >= ZERO) & (u + v <= ONE) & (z < row[x])
                row[x] = z if is_nearer else row[x]
