"""Rasterizer: splats and a camera to an image and its gradient.

`reference` is the oracle of the kernels in `cpu/` (needs numba) and `gpu/`.
"""
