"""Memory layout of the GPU's arrays, in Python and as the WGSL prelude that every kernel begins
with.

A table is a flat array of 32-bit words, row by row, without padding: word c of row i is table[i *
stride + c]. N splats, F triangles, K SH coefficients, S strain colors, P (tile, splat) pairs, image
H × W.

splats          11 + 3K + 3S f32  the fields of `cpu.layout.Parameters` in order; also gradients
                and moments
frames          12 + columns f32  a triangle's origin (3), matrix (3, 3) by rows, strain, in camera
                space
projected       PROJECTED f32     a splat on the screen: the columns of `cpu.layout`
rect            4 i32             tile bounds x0, y0, x1, y1 of a splat, as in `Projection`
depth_key       1 u32             bits of a splat's depth; HIDDEN where it is not visible
slots           2 u32             a splat's first slot and how many it has: one a pair
slot_splat      1 u32             the splat of a slot, with WANTED
pair_gradients  PROJECTED f32     by slot: the pair's gradient of the projected columns
wanted          1 u32             1 for visible splats in focus: only their gradients are written
touched         1 u32             1 for the tiles that a splat in focus reaches
rendered        1 u32             1 for those and the tiles that their gradient depends on
tile_range      2 u32             a tile's first pair and one past its last
pair_slot       1 u32             a pair's slot; by tile, near to far
pixels          2 words           transmittance f32, and one past the last contributing pair
"""

import math

import numpy as np

from ...avatar import embedding, strain
from ..cpu import blend, image_loss, layout, optimizer, splat_block
from ..cpu.layout import Parameters

WORKGROUP = 256
"""Threads of a workgroup: a tile's pixels, and the largest size that every adapter has."""
HIDDEN = 0xFFFFFFFF
WANTED = 0x80000000
"""Marks the pairs of wanted splats in `slot_splat`, beside the splat's number."""
MAX_GROUPS = 65535
"""Workgroups along one dimension of a dispatch."""
DIGIT_BITS = 11
SORT_BLOCK = 2048
"""Keys that a workgroup sorts."""
SORT_GROUPS, PAIR_GROUPS, PAIRS, NEEDED, OVERFLOWED, COUNTS = 0, 3, 6, 7, 8, 9
"""Words of `counts`: workgroups to sort the pairs and to visit each; pairs in the lists, found, and
1 if they did not fit since the host last cleared it."""
XYZ, ROTATION, LOG_SCALE, OPACITY_LOGIT, SH = 0, 3, 7, 10, 11
"""Columns of a splat; its strain colors begin after the SH coefficients."""
FRAME_ORIGIN, FRAME_MATRIX, FRAME_STRAIN = 0, 3, 12

VIEW = np.dtype(
    [(name, np.float32) for name in ("fl_x", "fl_y", "cx", "cy")]
    + [(name, np.uint32) for name in ("width", "height", "tiles_x", "tiles_y")]
    + [(f"to_world_{row}{column}", np.float32) for row in range(3) for column in range(3)]
    + [(f"background_{channel}", np.float32) for channel in "rgb"]
    + [
        (name, np.uint32)
        for name in (
            "splats",  # N
            "coefficients",  # K, stored
            "strain_colors",  # S, stored
            "degree",  # of the spherical harmonics in use
            "strains",  # strain colors in use
            "frame_strains",  # columns of strain in `frames`
            "depth_as_color",
            "antialiased",
            "focused",  # 0 where every splat is in focus
            "ring",  # tiles that are rendered around those which the focus touches
            "capacity",  # pairs that the buffers hold
            "first",  # row of the first of these splats in the tables of projected ones
        )
    ]
)
"""The uniform `view` of an iteration: camera, sizes and rendering options."""

_OWN = (
    "WORKGROUP HIDDEN WANTED MAX_GROUPS SORT_BLOCK SORT_GROUPS PAIR_GROUPS PAIRS NEEDED OVERFLOWED"
    " XYZ ROTATION LOG_SCALE OPACITY_LOGIT SH FRAME_ORIGIN FRAME_MATRIX FRAME_STRAIN"
)
_COLUMNS = "MEAN_X MEAN_Y PRECISION_X SHEAR PRECISION_Y OPACITY RED GREEN BLUE"
_CPU = {
    layout: f"TILE PIXELS PROJECTED {_COLUMNS}",
    blend: "MAX_ALPHA MIN_ALPHA MIN_TRANSMITTANCE",
    splat_block: "LOW_PASS_PX2 NEAR_M QUATERNION_LIFT",
    embedding: "MIN_AREA_RATIO UPRIGHT_COSINE",
    strain: "STRAIN_GAIN STRAIN_COMPONENTS",
    image_loss: "WINDOW_RADIUS_PX",
    optimizer: "MAX_GRADIENT",
}
CONSTANTS: dict[str, int | float] = {
    **{name: globals()[name] for name in _OWN.split()},
    **{name: getattr(module, name) for module, names in _CPU.items() for name in names.split()},
    **{f"WINDOW_{k}": float(getattr(image_loss, f"W{5 - k}")) for k in range(6)},
    "DIGITS": 1 << DIGIT_BITS,
    "SSIM_C1": float(image_loss.C1),
    "SSIM_C2": float(image_loss.C2),
}


def splat_rows(splats: Parameters) -> np.ndarray:
    """Numpy arrays of splats as one table (N, stride) float32."""
    parts = [np.asarray(part, np.float32) for part in splats if part is not None]
    flat = [part.reshape(len(part), math.prod(part.shape[1:])) for part in parts]
    return np.concatenate(flat, axis=1)


def list_words(lists: strain.IndexLists) -> np.ndarray:
    """Where each list begins in this same array, and the last one ends; then the lists."""
    return np.asarray(np.concatenate([lists.indptr + len(lists.indptr), lists.indices]), np.uint32)


def split_rows(rows: np.ndarray, coefficients: int) -> Parameters:
    """The opposite of `splat_rows`: copies of its columns; coefficients: K."""
    n, end = len(rows), SH + 3 * coefficients
    return Parameters(
        xyz=rows[:, XYZ:ROTATION].copy(),
        rotation=rows[:, ROTATION:LOG_SCALE].copy(),
        log_scale=rows[:, LOG_SCALE:OPACITY_LOGIT].copy(),
        opacity=rows[:, OPACITY_LOGIT].copy(),
        sh=rows[:, SH:end].reshape(n, coefficients, 3).copy(),
        strain_color=rows[:, end:].reshape(n, (rows.shape[1] - end) // 3, 3).copy(),
    )


def struct_wgsl(name: str, fields: np.dtype) -> str:
    """A WGSL struct with the memory layout of a numpy record of 32-bit scalars."""
    kinds = {"f": "f32", "u": "u32", "i": "i32"}
    lines = [f"  {field}: {kinds[fields[field].kind]}," for field in fields.names or ()]
    return "\n".join([f"struct {name} {{", *lines, "}", ""])


def constants_wgsl() -> str:
    """Every constant that Python and WGSL share."""
    return "".join(
        f"const {name}: {'u32' if isinstance(value, int) else 'f32'} = "
        f"{f'{value}u' if isinstance(value, int) else float(np.float32(value)).hex() + 'f'};\n"
        for name, value in CONSTANTS.items()
    )
