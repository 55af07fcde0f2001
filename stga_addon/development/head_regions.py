"""Makes `flame/head_regions.npz`: in which region of a head the triangles of the bundled head and
of FLAME lie.

python -m stga_addon.development.head_regions FLAME.npz
"""

import argparse
from pathlib import Path

import numpy as np

from ..capture.model import Capture
from ..files import read_npz, write_npz
from ..flame.parts import flame_model, found_regions, key_regions
from ..training.optimize.semantic_regions import (
    BROWS_LEVEL,
    CHIN_LEVEL,
    JAW_LEVEL,
    REGIONS_FILE,
    Region,
    checksum,
    head_coordinates,
)
from ..training.optimize.surface import Surface

SCALP_ANGLE_DEG = 66.0
"""Angle from straight ahead, from the middle of the head, behind which hair grows."""
SCALP_ELEVATION_DEG = 38.0
"""Elevation above which hair grows."""
NECK_ANGLE_DEG = 60.0
"""Angle from straight ahead behind which the neck begins."""
JAW_DEG = (76.0, 90.0)
"""Angles from straight ahead between which the jaw's lower end rises to what is behind it."""
JAW = (-1.0, JAW_LEVEL)
"""Heights over the eyes at JAW_DEG below which the neck begins, in distances of the eyes from the
mouth, the unit of all lengths here."""
HAIRLINE_DEG = (84.0, 112.0, 140.0)
"""Angles from straight ahead of the hairline's points."""
HAIRLINE = (0.15, -0.55, -1.15)
"""Heights over the eyes at HAIRLINE_DEG below which no hair grows; it begins above the ears."""
LONG_HAIRLINE = (-1.0, -2.3, -2.3)
"""Heights over the eyes at HAIRLINE_DEG below which no long hair hangs."""
LONG_HAIR_SIDE = 1.1
"""Distance from the middle plane beyond which long hair does not hide shoulders."""
EAR_SIDE = 0.93
"""Distance of ears from the middle plane at least."""
EAR_LEVEL = -0.33
"""Height of the ears' middle over the eyes."""
EAR_HEIGHT = 0.57
"""Half the height of an ear."""
EAR_ANGLE_DEG = 90.0
"""Angle of the ears' middle from straight ahead."""
EAR_WIDTH_DEG = 14.0
"""Half the angle that an ear takes up."""
LINING_REACH = 1.3
"""Distance from the mouth's middle within which its lining and throat lie."""
LINING_LEVEL = -0.4
"""Height over the eyes below which they lie; the sockets of the eyes are as near."""


def main() -> None:
    """Write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("flame", type=Path, help="npz with FLAME's v_template and faces")
    flame = flame_head(parser.parse_args().flame)
    arrays = {}
    for name, head in (("bundled", bundled_head()), ("flame", flame)):
        arrays[f"{name}/region"] = regions_of(head)
        arrays[f"{name}/checksum"] = np.array(checksum(head.faces))
    write_npz(REGIONS_FILE, arrays, compressed=True)


def regions_of(head: Capture) -> np.ndarray:
    """`Region` (F,) uint8 of a head's triangles."""
    centers = head.neutral[head.faces].mean(1)
    at = head_coordinates(head)
    assert at is not None
    angle = at.angle_deg
    x, y, z = at.axes @ (centers - at.middle).T
    elevation = np.degrees(np.arctan2(y, np.hypot(x, z)))
    side = abs(x) / at.unit
    ear = (side > EAR_SIDE) & (abs(angle - EAR_ANGLE_DEG) < EAR_WIDTH_DEG)
    ear &= abs(at.level - EAR_LEVEL) < EAR_HEIGHT
    hairline = np.interp(angle, HAIRLINE_DEG, HAIRLINE)
    hairy = (angle > SCALP_ANGLE_DEG) | (elevation > SCALP_ELEVATION_DEG)
    beside = (angle > NECK_ANGLE_DEG) | (at.level < CHIN_LEVEL)
    mouth = head.regions["mouth"]
    away = np.linalg.norm(centers - centers[mouth].mean(0), axis=1) / at.unit
    lining = (away < LINING_REACH) & (at.level < LINING_LEVEL) & ~Surface(head).outside
    in_front = (angle < NECK_ANGLE_DEG) & (at.level > CHIN_LEVEL)
    under_hair = hairy & (at.level > np.interp(angle, HAIRLINE_DEG, LONG_HAIRLINE))
    under_hair &= (side < LONG_HAIR_SIDE) | (at.level > JAW_LEVEL)
    # a triangle belongs to the last of the regions that it lies in
    lies_in = {
        Region.FACE: in_front & (at.level < BROWS_LEVEL),
        Region.BODY: beside & (at.level < np.interp(angle, JAW_DEG, JAW)),
        Region.SIDE: under_hair & (angle < HAIRLINE_DEG[0]),
        Region.NAPE: under_hair & (angle >= HAIRLINE_DEG[0]),
        Region.SCALP: hairy & (at.level > hairline),
        Region.EAR: ear,
        Region.MOUTH: mouth | lining,
    }
    region = np.full(len(centers), Region.OTHER, np.uint8)
    for name, own in lies_in.items():
        region[own] = name
    return region


def bundled_head() -> Capture:
    """The bundled head as a capture without views."""
    model = flame_model(None)
    return _head(model.v_template, model.faces, key_regions(model))


def flame_head(path: Path) -> Capture:
    """FLAME without grafts as a capture without views."""
    arrays = read_npz(path)
    neutral = arrays["v_template"]
    faces = arrays["faces"].astype(np.int32)
    return _head(neutral, faces, found_regions(neutral, faces))


def _head(neutral: np.ndarray, faces: np.ndarray, regions: dict[str, np.ndarray]) -> Capture:
    neutral = np.asarray(neutral, np.float64)
    return Capture(
        root=Path(),
        layout="flame",
        faces=faces,
        neutral=neutral,
        views={},
        timesteps=(0,),
        regions=regions,
        mesh=lambda timestep: neutral,
        expression_mesh=lambda timestep, zero_pose: neutral,
    )


if __name__ == "__main__":
    main()
