"""The performance of the demo's shot: a generated face that says "Hello! I'm made of splats." and
smiles, in ARKit's shapes, as a phone would record it."""

import numpy as np

from .performance import COLUMN, COUNT, Performance, smoothed

SPEECH_FILE = "speech.csv"
"""Name of the take's file."""
FPS = 60.0
"""Rows per second, as phones record."""
SECONDS = 4.0
"""Length of the take."""
COARTICULATION_S = 0.028
"""Standard deviation of the Gaussian by which each sound's mouth passes into the next one's."""
LOUDEST_JAW = 0.45
"""jawOpen of the most open vowel."""
BOTH_SIDES = ("mouthStretch", "mouthSmile", "mouthLowerDown", "mouthUpperUp", "mouthPress")
"""Shapes that a sound moves on both sides."""
MOUTHS = {
    "rest": {},
    "a": {"jawOpen": LOUDEST_JAW, "mouthStretch": 0.15, "mouthLowerDown": 0.25},
    "e": {"jawOpen": 0.26, "mouthStretch": 0.2, "mouthSmile": 0.15, "mouthLowerDown": 0.2},
    "i": {"jawOpen": 0.14, "mouthSmile": 0.3, "mouthStretch": 0.2, "mouthLowerDown": 0.15},
    "o": {"jawOpen": 0.28, "mouthFunnel": 0.5, "mouthPucker": 0.25},
    "schwa": {"jawOpen": 0.2, "mouthLowerDown": 0.1},
    "h": {"jawOpen": 0.18},
    "l": {"jawOpen": 0.2, "mouthLowerDown": 0.15, "mouthUpperUp": 0.1},
    "s": {"jawOpen": 0.07, "mouthStretch": 0.2, "mouthLowerDown": 0.2, "mouthUpperUp": 0.1},
    "v": {"jawOpen": 0.07, "mouthRollLower": 0.4, "mouthUpperUp": 0.15},
    "m": {"jawOpen": 0.04, "mouthClose": 0.04, "mouthPress": 0.3, "mouthRollLower": 0.15},
    "smile": {"mouthSmile": 0.6, "cheekSquintLeft": 0.35, "cheekSquintRight": 0.35},
}
"""Sound -> weights of shapes that its mouth has."""
SOUNDS = (
    "rest 0.30  h 0.06 e 0.10 l 0.08 o 0.28 rest 0.16"  # Hello
    "  a 0.12 i 0.08 m 0.14 e 0.10 i 0.09 s 0.07"  # I'm made
    "  schwa 0.08 v 0.09  s 0.12 m 0.10 l 0.07 a 0.20 s 0.20 rest 0.10"  # of splats
)
"""Sounds and how long each lasts, in seconds; a smile follows."""
LIDS = 0.1
"""eyeBlink of both eyes at rest."""
NOD_RAD = 0.05
"""Pitch of the head on the stressed vowels, downwards."""
BROW = 0.35
"""browInnerUp with a nod."""


def demo_speech() -> Performance:
    """The take, at even times."""
    words = SOUNDS.split()
    names = [*words[::2], "smile"]
    ends = np.cumsum([float(word) for word in words[1::2]])
    times = np.arange(round(FPS * SECONDS)) / FPS
    mouths = np.stack([_weights(MOUTHS[name]) for name in names])
    weights = mouths[np.searchsorted(ends, times, side="right")]
    nod = np.exp(-0.5 * ((times[:, None] - _stressed(names, ends)) / 0.12) ** 2).max(1)
    weights[:, COLUMN["browInnerUp"]] = BROW * nod
    weights[:, [COLUMN["eyeBlinkLeft"], COLUMN["eyeBlinkRight"]]] = LIDS
    yaw = 0.05 * np.sin(2 * np.pi * times / SECONDS)
    head = np.stack([yaw, NOD_RAD * nod, 0.5 * yaw], axis=1)
    return smoothed(Performance(times, weights, head, FPS), COARTICULATION_S)


def _weights(mouth: dict[str, float]) -> np.ndarray:
    row = np.zeros(COUNT)
    for name, weight in mouth.items():
        sides = ("Left", "Right") if name in BOTH_SIDES else ("",)
        row[[COLUMN[name + side] for side in sides]] = weight
    return row


def _stressed(names: list[str], ends: np.ndarray) -> np.ndarray:
    """Seconds at which vowels end that the voice stresses."""
    return np.array([end for name, end in zip(names, ends, strict=False) if name in ("o", "a")])
