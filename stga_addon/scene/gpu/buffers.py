"""Arrays in the GPU's memory: textures that shaders read by index, and batches of triangles."""

from typing import Any

import gpu
import numpy as np

TEXTURE_WIDTH = 2048
EXACT = "RGBA32F"


def texture_rows(count: int) -> int:
    """Rows of a texture TEXTURE_WIDTH wide for `count` texels."""
    return max(1, -(-count // TEXTURE_WIDTH))


def texture(texels: np.ndarray, texel_format: str = EXACT) -> Any:
    """Texels (M, C) as a texture TEXTURE_WIDTH wide, its last row filled with zeros."""
    rows = texture_rows(len(texels))
    padded = np.zeros((rows * TEXTURE_WIDTH, texels.shape[1]), np.float32)
    padded[: len(texels)] = texels
    pixels = gpu.types.Buffer("FLOAT", padded.size, padded.reshape(-1))
    return gpu.types.GPUTexture((TEXTURE_WIDTH, rows), format=texel_format, data=pixels)


def read_pixels(texture: Any, channels: int) -> np.ndarray:
    """(H, W, channels) float32, bottom row first."""
    buffer = texture.read()
    # Of several axes, a buffer reports wrong strides to numpy in some versions; copied while it
    # lives.
    buffer.dimensions = (texture.height * texture.width * channels,)
    return np.array(buffer, np.float32).reshape(texture.height, texture.width, channels)


def triangle_batch(name: str, vertices: np.ndarray, faces: np.ndarray) -> Any:
    """A batch of triangles (F, 3) with one attribute (V, 2 or 3) of their vertices."""
    layout = gpu.types.GPUVertFormat()
    layout.attr_add(id=name, comp_type="F32", len=vertices.shape[1], fetch_mode="FLOAT")
    buffer = gpu.types.GPUVertBuf(len=len(vertices), format=layout)
    buffer.attr_fill(id=name, data=np.ascontiguousarray(vertices, np.float32))
    indices = gpu.types.GPUIndexBuf(type="TRIS", seq=np.ascontiguousarray(faces, np.uint32))
    return gpu.types.GPUBatch(type="TRIS", buf=buffer, elem=indices)


def rectangle_batch(count: int) -> Any:
    """`count` rectangles in one batch, each with its own four vertices at ±1."""
    corners = np.tile([[-1, -1], [1, -1], [-1, 1], [1, 1]], (count, 1))
    faces = 4 * np.arange(count)[:, None, None] + np.array([[0, 1, 2], [2, 1, 3]])
    return triangle_batch("corner", corners, faces.reshape(-1, 3))
