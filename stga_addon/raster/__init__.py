"""Rasterizer: splats and a camera to an image and its gradient.

`render` (needs numba) renders splats and avatars; `reference` is the oracle of the kernels in `cpu/` and `gpu/`.
"""
