"""Splats and a camera to an image and its gradient. Importing `render` needs numba and torch."""
