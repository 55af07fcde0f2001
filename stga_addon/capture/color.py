"""sRGB, linear light, and colors of videos and PNG's cICP by the codes of ITU-T H.273 as sRGB."""

from collections.abc import Callable
from functools import lru_cache

import numpy as np

CHROMATICITIES = {
    1: ((0.640, 0.330), (0.300, 0.600), (0.150, 0.060)),  # BT.709, sRGB
    9: ((0.708, 0.292), (0.170, 0.797), (0.131, 0.046)),  # BT.2020, BT.2100
    12: ((0.680, 0.320), (0.265, 0.690), (0.150, 0.060)),  # Display P3
}
"""Code of color primaries -> CIE xy of red, green and blue (white: D65). Others are sRGB's."""
D65 = (0.3127, 0.3290)
"""CIE xy of the white point that all of these primaries have."""
SRGB = 1
"""Code of sRGB's and BT.709's primaries (ITU-T H.273, table 2)."""
LINEAR = 8
"""Code of the linear transfer characteristic (ITU-T H.273, table 3)."""
PQ = 16
"""Code of the perceptual quantizer, SMPTE ST 2084 (ITU-T H.273, table 3)."""
HLG = 18
"""Code of hybrid log-gamma, ARIB STD-B67 (ITU-T H.273, table 3)."""
Conversion = Callable[[np.ndarray], np.ndarray]
"""Function of the pixels in some rows of an image, which returns their colors from 0 to 255."""

GAMMAS = {4: 2.2, 5: 2.8}
"""Code of transfer characteristics -> exponent. Codes that are not named here are sRGB's curve."""

REFERENCE_WHITE_CD_M2 = 203.0
"""Luminance of diffuse white in HDR (ITU-R BT.2408), which becomes sRGB's; brighter values are
clipped."""
HLG_PEAK = 1000.0 / REFERENCE_WHITE_CD_M2
"""Luminance of the brightest HLG signal on a display of 1000 cd/m², where 1 is diffuse white."""
HLG_SYSTEM_GAMMA = 1.2
"""Exponent between the light of the scene and that of such a display (ITU-R BT.2100, table 5)."""
BT2020_LUMINANCE = np.array([0.2627, 0.6780, 0.0593])
"""Luminance of linear red, green and blue (ITU-R BT.2020)."""

BAND_PIXELS = 1 << 18
"""Pixels converted at a time: wide intermediate numbers of a large image would fill the memory."""


def is_srgb(primaries: int, transfer: int) -> bool:
    """Whether colors of these codes are shown as sRGB without a conversion."""
    return primaries not in (9, 12) and transfer not in (LINEAR, PQ, HLG, *GAMMAS)


def to_srgb(pixels: np.ndarray, primaries: int, transfer: int) -> np.ndarray:
    """Colors (H, W, 3), uint8 or uint16 full range, as uint8 sRGB. primaries, transfer: codes of
    ITU-T H.273. What sRGB cannot hold is clipped."""
    if is_srgb(primaries, transfer):
        return pixels if pixels.dtype == np.uint8 else (pixels >> 8).astype(np.uint8)
    table = _linear(transfer, np.iinfo(pixels.dtype).max + 1)
    known = primaries if primaries in CHROMATICITIES else SRGB
    matrix = np.asarray(np.linalg.inv(_to_xyz(SRGB)) @ _to_xyz(known), np.float32)

    def convert(band: np.ndarray) -> np.ndarray:
        light = table[band]
        if transfer == HLG:  # light of the scene to a display's, where 1 is diffuse white (OOTF)
            luminance = np.maximum(light @ BT2020_LUMINANCE.astype(light.dtype), 1e-6)
            light = HLG_PEAK * (luminance ** (HLG_SYSTEM_GAMMA - 1))[..., None] * light
        return 255 * linear_to_srgb(np.clip(light @ matrix.T, 0, 1)) + 0.5

    return in_bands(pixels, 3, convert)


def in_bands(pixels: np.ndarray, channels: int, convert: Conversion) -> np.ndarray:
    """(H, W, channels) uint8 of `convert` applied to the rows of an image, some at a time."""
    converted = np.empty((*pixels.shape[:2], channels), np.uint8)
    step = max(1, BAND_PIXELS // max(1, pixels.shape[1]))
    for start in range(0, len(pixels), step):
        converted[start : start + step] = convert(pixels[start : start + step])
    return converted


def srgb_to_linear(srgb: np.ndarray) -> np.ndarray:
    """sRGB to linear light, both 0…1 (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: np.ndarray) -> np.ndarray:
    """Linear light to sRGB, both 0…1 (IEC 61966-2-1)."""
    curve = 1.055 * np.maximum(linear, 0.0031308) ** (1 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, linear * 12.92, curve)


def with_gamma(pixels: np.ndarray, gamma: float) -> np.ndarray:
    """uint8 pixels that are light to the power of `gamma` (PNG's gAMA), as sRGB."""
    levels = linear_to_srgb((np.arange(256) / 255) ** (1 / gamma))
    return (255 * levels + 0.5).astype(np.uint8)[pixels]


@lru_cache(maxsize=8)
def _linear(transfer: int, levels: int) -> np.ndarray:
    """(levels,) light of each signal: 1 is diffuse white; of HLG: light of the scene."""
    signal = np.arange(levels) / (levels - 1)
    if transfer == LINEAR:
        light = signal
    elif transfer == PQ:  # SMPTE ST 2084
        root = signal ** (32 / 2523)
        ratio = np.maximum(root - 107 / 128, 0) / (2413 / 128 - 2392 / 128 * root)
        light = 10000 / REFERENCE_WHITE_CD_M2 * ratio ** (16384 / 2610)
    elif transfer == HLG:  # ITU-R BT.2100, table 5
        a = 0.17883277
        b = 0.28466892
        c = 0.55991073
        light = np.where(signal <= 0.5, signal**2 / 3, (np.exp((signal - c) / a) + b) / 12)
    elif transfer in GAMMAS:
        light = signal ** GAMMAS[transfer]
    else:
        light = srgb_to_linear(signal)
    return np.asarray(light, np.float32)


def _to_xyz(primaries: int) -> np.ndarray:
    """(3, 3) from linear light to CIE XYZ (SMPTE RP 177)."""
    x, y = np.array([*CHROMATICITIES[primaries], D65]).T
    xyz = np.stack([x / y, np.ones(4), (1 - x - y) / y])
    return xyz[:, :3] * np.linalg.solve(xyz[:, :3], xyz[:, 3])
