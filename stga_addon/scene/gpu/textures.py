"""Lists of texels as textures."""

from typing import Any

import numpy as np
from gpu.types import Buffer, GPUTexture

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
    pixels = Buffer("FLOAT", padded.size, padded.reshape(-1))
    return GPUTexture((TEXTURE_WIDTH, rows), format=texel_format, data=pixels)
