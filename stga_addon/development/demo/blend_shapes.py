"""Blend shapes of the synthetic head: identity and expression displacements as functions of position."""

import numpy as np

from .skin import EYE, MOUTH, Skin, bump, lid_opening, push_outside_eyeball, side_sign, smooth_step

IDENTITY = ("width", "length", "jaw", "nose", "cheekbones", "lips", "brow", "chin", "nostrils", "ears")
EXPRESSIONS = (
    "smile",
    "pucker",
    "frown",
    "brows_up",
    "brows_down",
    "cheek_puff",
    "blink_left",
    "blink_right",
    "lips_open",
    "squint",
)


def _vector(
    skin: Skin, x: np.ndarray | float = 0.0, y: np.ndarray | float = 0.0, z: np.ndarray | float = 0.0
) -> np.ndarray:
    return np.stack([np.broadcast_to(part, skin.x.shape) for part in (x, y, z)], 1)


def skin_components(skin: Skin) -> np.ndarray:
    """(N, 3, 20): identity, then expression displacements of the skin for a coefficient of 1."""
    return np.stack([*_identity(skin), *_expressions(skin)], -1)


def _identity(skin: Skin) -> list[np.ndarray]:
    x, y, side = skin.x, skin.y, abs(skin.x)
    front = smooth_step(skin.z, -0.01, 0.05)
    cheek = front * bump(side, y, (0.046, -0.006), (0.022, 0.018))
    chin = front * bump(side, y, (0.0, -0.088), (0.028, 0.020))
    nose = front * bump(side, y, (0.0, -0.014), (0.013, 0.016))
    lips = front * bump(side, y, (0.0, MOUTH[1]), (0.020, 0.009))
    ears = bump(skin.z, y, (-0.020, 0.006), (0.016, 0.030)) * smooth_step(side, 0.06, 0.08)
    return [
        _vector(skin, x=0.030 * x),
        _vector(skin, y=0.035 * (y - EYE[1])),
        _vector(skin, x=0.075 * x * smooth_step(-y, 0.025, 0.075) * smooth_step(y, -0.13, -0.09)),
        _vector(skin, z=0.0035 * nose, y=-0.0012 * nose),
        _vector(skin, x=side_sign(x) * 0.0022 * cheek, z=0.0026 * cheek),
        _vector(skin, z=0.0018 * lips, y=np.where(skin.above_mouth >= 0, 0.0005, -0.0006) * lips),
        _vector(skin, z=0.0024 * front * bump(side, y, (0.0, 0.056), (0.05, 0.022))),
        _vector(skin, z=0.0036 * chin, y=-0.0024 * chin),
        _vector(skin, x=0.10 * x * front * bump(side, y, (0.012, -0.022), (0.010, 0.010))),
        _vector(skin, x=side_sign(x) * 0.0045 * ears),
    ]


def _expressions(skin: Skin) -> list[np.ndarray]:
    x, y, side, sign = skin.x, skin.y, abs(skin.x), side_sign(skin.x)
    front = smooth_step(skin.z, 0.0, 0.045)
    corner = front * bump(side, y, (0.025, MOUTH[1]), (0.014, 0.017))
    cheek = front * bump(side, y, (0.040, -0.018), (0.017, 0.016))
    mouth = front * bump(side, y, (0.0, MOUTH[1]), (0.027, 0.021))
    brow = front * bump(side, y, (0.026, 0.046), (0.026, 0.017)) * smooth_step(y, 0.024, 0.038)
    forehead = front * bump(side, y, (0.0, 0.062), (0.055, 0.022)) * smooth_step(y, 0.030, 0.045)
    inner_brow = front * bump(side, y, (0.012, 0.042), (0.013, 0.013)) * smooth_step(y, 0.020, 0.036)
    bulge = front * bump(side, y, (0.040, -0.046), (0.016, 0.018)) * smooth_step(side, 0.018, 0.034)
    lip = front * np.clip(1 - (side / 0.026) ** 2, 0, 1) * np.exp(-((y - MOUTH[1]) ** 2) / 0.012**2)
    parted = np.where(skin.above_mouth >= 0, 0.0042, -0.0058) * lip
    lower_lid = lid_opening(skin) * (skin.above_eyes < 0)
    return [
        _vector(
            skin,
            sign * 0.0085 * corner + sign * 0.002 * cheek,
            0.0085 * corner + 0.004 * cheek,
            0.004 * cheek - 0.0045 * corner,
        ),
        _vector(skin, -0.42 * x * mouth, 0.0, 0.0085 * mouth),
        _vector(skin, sign * 0.002 * corner, -0.0085 * corner, -0.001 * corner),
        _vector(skin, 0.0, 0.0085 * brow + 0.0035 * forehead, 0.001 * brow),
        _vector(skin, -sign * 0.0035 * inner_brow, -0.0055 * brow - 0.003 * inner_brow, 0.0022 * inner_brow),
        _vector(skin, sign * 0.0085 * bulge, 0.0, 0.0055 * bulge),
        _blink(skin, EYE),
        _blink(skin, EYE * [-1, 1, 1]),
        _vector(skin, 0.0, parted, 0.0012 * lip),
        _vector(skin, 0.0, 0.0028 * cheek + 0.0022 * lower_lid, 0.0035 * cheek + 0.0008 * lower_lid),
    ]


def _blink(skin: Skin, eye: np.ndarray) -> np.ndarray:
    """The upper lid slides over the eyeball down to the lower one."""
    lid = lid_opening(skin) * (skin.above_eyes >= 0) * (skin.x * eye[0] > 0)
    closed = skin.at + _vector(skin, y=-0.0088 * lid)
    return np.asarray((push_outside_eyeball(closed, eye) - skin.at) * (lid > 0)[:, None])


def rigid_components(center: np.ndarray, count: int) -> np.ndarray:
    """Components of a piece at `center`: it is carried along by identity, and untouched by expression."""
    where = Skin(center[None], np.zeros(1), np.ones(1), np.ones(1))
    identity = np.stack(_identity(where), -1)
    rigid = np.concatenate([identity, np.zeros((1, 3, len(EXPRESSIONS)))], -1)
    return np.tile(rigid, (count, 1, 1))
