"""Makes `driving/arkit_shapes.npz`: what ARKit's shapes do to 478 points of ICT-FaceKit's face.

python -m stga_addon.development.arkit_shapes ict_facekit_light.npz. The input holds the light
model's neutral (V, 3) in centimeters, tris (F, 3), expr (57, V, 3) with expr_names, ident (20, V,
3).
"""

import sys
from pathlib import Path

import numpy as np

from ..driving.performance import ARKIT_SHAPES, OPTIONAL
from ..driving.shapes import SHAPES_FILE
from ..files import read_npz, write_npz
from ..tracking.correspondence import calibrate
from ..tracking.face_networks import FaceNetworks
from ..tracking.head_model import linear_model

METERS_PER_UNIT = 0.01
"""ICT-FaceKit's unit is the centimeter."""
BOTH_SIDES = ("browInnerUp", "cheekPuff")
"""Shapes of ARKit that ICT-FaceKit splits in left and right. ICT-FaceKit's cheekRaiser, which is
beside cheekSquint, is not one of ARKit's."""


def main(source: Path) -> None:
    """Write the file for the ICT-FaceKit arrays in `source`."""
    arrays = read_npz(source)
    neutral = METERS_PER_UNIT * arrays["neutral"].astype(np.float64)
    faces = arrays["tris"]
    model = linear_model(
        source, {"mean": neutral, "faces": faces, "expression": np.zeros((*neutral.shape, 1))}
    )
    places, reliable = calibrate(model, FaceNetworks(), str(source))

    def at_points(values: np.ndarray) -> np.ndarray:
        return places.on(METERS_PER_UNIT * values.astype(np.float64), faces)

    row = {str(name): number for number, name in enumerate(arrays["expr_names"])}
    shapes = [
        sum(at_points(arrays["expr"][row[name]]) for name in ict_names(shape))
        for shape in ARKIT_SHAPES
        if shape not in OPTIONAL
    ]
    normals = places.on(_vertex_normals(neutral, faces), faces)
    write_npz(
        SHAPES_FILE,
        {
            "points": places.on(neutral, faces).astype(np.float32),
            "normals": (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(
                np.float32
            ),
            "reliable": reliable,
            "shapes": np.stack(shapes).astype(np.float16),
            "identity": np.stack([at_points(values) for values in arrays["ident"]]).astype(
                np.float16
            ),
        },
        compressed=True,
    )


def ict_names(shape: str) -> tuple[str, ...]:
    if shape in BOTH_SIDES:
        return f"{shape}_L", f"{shape}_R"
    for side in ("Left", "Right"):
        if shape.endswith(side) and shape not in ("jawLeft", "jawRight", "mouthLeft", "mouthRight"):
            return (f"{shape.removesuffix(side)}_{side[0]}",)
    return (shape,)


def _vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corners = vertices[faces]
    normals = np.zeros_like(vertices)
    weighted = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for corner in range(3):
        np.add.at(normals, faces[:, corner], weighted)
    return normals


if __name__ == "__main__":
    main(Path(sys.argv[1]))
