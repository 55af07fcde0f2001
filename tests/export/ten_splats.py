"""The test vector of docs/formats.md: ten splats on four triangles, and where they are.

    PYTHONPATH=tests:. python -m export.ten_splats

writes the file and its splats beside the page.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from kept_formats import make
from numpy.linalg import norm
from scipy.spatial.transform import Rotation

from export.web.web_data import posed_mesh, read_web_data, splats_of
from stga_addon.avatar.splats import Splats
from stga_addon.export.playback import Playback
from stga_addon.export.skinned_gltf import skinned_glb

FILE = Path(__file__).parents[2] / "docs" / "ten-splats.glb"
PLACED = FILE.with_suffix(".csv")
COUNT = 10
FRAME = 1
CAMERA = np.array([0.0, 0.0, 1.0])


def ten_splats():
    """The file's bytes."""
    rng = np.random.default_rng(1)
    rigged = make.rigged()
    splats = Splats(
        xyz=rng.normal(0, 0.02, (COUNT, 3)).astype(np.float32),
        rotation=rng.normal(0, 1, (COUNT, 4)).astype(np.float32),
        log_scale=rng.normal(-4, 0.3, (COUNT, 3)).astype(np.float32),
        opacity=rng.normal(0, 1, COUNT).astype(np.float32),
        sh=rng.normal(0, 0.3, (COUNT, 4, 3)).astype(np.float32),
        face=np.sort(rng.integers(0, 4, COUNT)).astype(np.int32),
        unbound=np.zeros(COUNT, bool),
    )
    avatar = replace(rigged.avatar, splats=splats, driven_offsets={}, strain_range=None, light=None)
    return skinned_glb(replace(rigged, avatar=avatar), Playback("Ten splats", 10.0))


def placed(data):
    """(N, 13): position, rotation wxyz, deviations and color of each splat at FRAME, as seen from
    CAMERA, by the rules of the page."""
    header, arrays = read_web_data(data)
    splats = splats_of(arrays)
    pose = arrays["coefficients"][FRAME], arrays["pose"][FRAME], FRAME
    posed = posed_mesh(header, arrays, *pose)
    rows = []
    for number, face in enumerate(splats.face):
        corners = posed[arrays["faces"][face]]
        origin = corners.mean(axis=0)
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        before = arrays["neutral"][arrays["faces"][face]]
        rest = norm(np.cross(before[1] - before[0], before[2] - before[0]))
        size = np.sqrt(norm(normal) / rest)
        normal /= norm(normal)
        first = (corners[0] - origin) / norm(corners[0] - origin)
        axes = np.column_stack([first, np.cross(normal, first), normal])
        position = origin + size * axes @ splats.xyz[number]
        own = Rotation.from_quat(splats.rotation[number], scalar_first=True)
        turn = (Rotation.from_matrix(axes) * own).as_quat(canonical=True, scalar_first=True)
        x, y, z = (position - CAMERA) / norm(position - CAMERA)
        basis = np.array([0.28209479, -0.48860251 * y, 0.48860251 * z, -0.48860251 * x])
        color = np.maximum(0, 0.5 + basis @ splats.sh[number])
        deviations = size * np.exp(splats.log_scale[number])
        rows.append([*position, *turn, *deviations, *color])
    return np.array(rows)


if __name__ == "__main__":
    FILE.write_bytes(ten_splats())
    names = PLACED.read_text(encoding="utf-8").splitlines()[0]
    rows = placed(FILE.read_bytes())
    np.savetxt(PLACED, rows, "%.4f", ",", header=names, comments="")
