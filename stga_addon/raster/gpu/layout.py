"""Memory layout of the GPU's arrays, and the WGSL prelude that every kernel begins with: constants
and structs; the tables are in common.wgsl."""

import math

import numpy as np

from ...avatar import embedding, strain
from ..cpu import blend, image_loss, layout, optimizer, splat_block
from ..cpu.layout import Parameters
from ..shader_constants import printed_constants

WORKGROUP = 256
"""Threads of a workgroup: a tile's pixels, and the largest size that every adapter has."""
HIDDEN = 0xFFFFFFFF
"""Marks splats that no pixel shows."""
WANTED = 0x80000000
"""Marks the pairs of wanted splats in `slot_splat`, beside the splat's number."""
MAX_GROUPS = 65535
"""Workgroups along one dimension of a dispatch."""
DIGIT_BITS = 11
"""Bits of a key by which one pass of the radix sort sorts."""
SORT_BLOCK = 1024
"""Keys that a workgroup sorts."""
SEGMENT_PAIRS = 512
"""Pairs of a tile that a workgroup looks at on the way back; a multiple of WORKGROUP."""
SORT_GROUPS = 0
"""Words of `counts`: workgroups to sort the pairs."""
PAIR_GROUPS = 3
"""Words of `counts`: workgroups to visit each pair."""
PAIRS = 6
"""Word of `counts`: pairs in the lists."""
NEEDED = 7
"""Word of `counts`: pairs found."""
OVERFLOWED = 8
"""Word of `counts`: 1 if they did not fit since the host last cleared it."""
COUNTS = 9
"""Words of `counts`."""
XYZ = 0
"""First column of a splat's position."""
ROTATION = 3
"""First column of its rotation."""
LOG_SCALE = 7
"""First column of its scales."""
OPACITY_LOGIT = 10
"""Column of its opacity."""
SH = 11
"""First column of its harmonics."""
FRAME_ORIGIN = 0
"""First column of a triangle's frame: its origin."""
FRAME_MATRIX = 3
"""First column of its rotation and scale."""
FRAME_COLOR = 12
"""First column of its color."""
FRAME_STRIDE = 15
"""Columns of a triangle's frame."""

UNIFORMS = {
    "View": np.dtype(
        [
            ("to_world", "f4", (3, 4)),  # rotation, by rows
            ("background", "f4", 4),
            *((name, "f4") for name in ("fl_x", "fl_y", "cx", "cy")),
            *((name, "u4") for name in ("width", "height", "tiles_x", "tiles_y")),
            ("splats", "u4"),  # N
            ("coefficients", "u4"),  # K, stored
            ("degree", "u4"),  # of the spherical harmonics in use
            ("depth_as_color", "u4"),
            ("antialiased", "u4"),
            ("focused", "u4"),  # 0 where every splat is in focus
            ("ring", "u4"),  # tiles that are rendered around those which the focus touches
            ("capacity", "u4"),  # pairs that the buffers hold
            ("first", "u4"),  # row of the first of these splats in the tables of projected ones
            *((f"padding_{n}", "u4") for n in range(3)),
        ]
    ),
    "Pose": np.dtype(
        [
            ("rows", "f4", (3, 4)),  # from the mesh, relative to its first vertex, to the camera
            ("triangles", "u4"),
            ("follows", "u4"),  # 1 where colors or positions follow the deformation
            ("area_scales", "u4"),  # 1: the convention "stga", 0: "gaussian_avatars"
            ("padding", "u4"),
        ]
    ),
    "Loss": np.dtype(
        [
            ("change", "f4", 4),  # the background's new color less the old one, in 0…255
            ("ssim_weight", "f4"),
            ("masked", "u4"),  # 1: the background is exchanged where the mask leaves it free
            ("padding", "u4", 2),
        ]
    ),
    "Part": np.dtype(
        [
            *((name, "u4") for name in ("stride", "first", "width", "rows")),  # of a table
            ("at", "u4"),  # word at which the packed columns begin
            ("listed", "u4"),  # 1: of listed rows, 0: of the first ones
            ("alike", "u4"),  # 1: one value for all
            ("padding", "u4"),
        ]
    ),
    "Step": np.dtype(
        [
            (
                "rates",
                "f4",
                (2, 4),
            ),  # by field, see `field_of`; then harmonics above the first, colors by the pose
            *((name, "f4") for name in ("beta1", "beta2", "log_beta1", "log_beta2", "epsilon")),
            ("ahead", "f4"),  # by how much of the way from the first moment to the gradient it goes
            ("ema_share", "f4"),  # least fraction of a step in the exponential moving average
            *((name, "f4") for name in ("scale_weight", "distance_weight")),
            ("opacity_weight", "f4"),  # already divided by the number of splats
            ("statistics", "u4"),  # 1: collect what density control asks for
            ("triangles", "u4"),  # whose splats driven offsets move
        ]
    ),
}
"""Structs of the kernels: of an image (camera, sizes, options), a mesh, a target, some columns of a
table, and a step."""

_LOCAL = (
    "WORKGROUP HIDDEN WANTED MAX_GROUPS SORT_BLOCK SEGMENT_PAIRS SORT_GROUPS PAIR_GROUPS PAIRS"
    " NEEDED OVERFLOWED XYZ ROTATION LOG_SCALE OPACITY_LOGIT SH FRAME_ORIGIN FRAME_MATRIX"
    " FRAME_COLOR FRAME_STRIDE"
)
_COLUMNS = "MEAN_X MEAN_Y PRECISION_X SHEAR PRECISION_Y OPACITY RED GREEN BLUE"
_CPU = {
    layout: f"TILE PIXELS PROJECTED {_COLUMNS}",
    blend: "MAX_ALPHA MIN_ALPHA MIN_TRANSMITTANCE",
    splat_block: "LOW_PASS_PX2 NEAR_M QUATERNION_LIFT C0 C1 C2 C3 C4 C5 C6 C7 C8 C9",
    embedding: "MIN_AREA_RATIO UPRIGHT_COSINE",
    strain: "STRAIN_GAIN STRAIN_COMPONENTS MIN_SQUARED_NORMAL",
    image_loss: "WINDOW_RADIUS_PX",
    optimizer: "MAX_GRADIENT",
}
CONSTANTS: dict[str, int | float] = {
    **{name: globals()[name] for name in _LOCAL.split()},
    **{name: getattr(module, name) for module, names in _CPU.items() for name in names.split()},
    **{f"WINDOW_{k}": float(getattr(image_loss, f"W{5 - k}")) for k in range(6)},
    "DIGITS": 1 << DIGIT_BITS,
    "SSIM_C1": float(image_loss.C1),
    "SSIM_C2": float(image_loss.C2),
}


def splat_rows(splats: Parameters) -> np.ndarray:
    """Numpy arrays of splats as one table (N, stride) float32."""
    parts = [np.asarray(part, np.float32) for part in splats]
    flat = [part.reshape(len(part), math.prod(part.shape[1:])) for part in parts]
    return np.concatenate(flat, axis=1)


def list_words(lists: strain.IndexLists) -> np.ndarray:
    """Where each list begins in this same array, and the last one ends; then the lists."""
    return np.asarray(np.concatenate([lists.indptr + len(lists.indptr), lists.indices]), np.uint32)


def prelude_wgsl() -> str:
    """The structs and every constant that Python and WGSL share."""
    kinds = {"f": "f32", "u": "u32"}
    lines = list[str]()
    for struct, record in UNIFORMS.items():
        lines.append(f"struct {struct} {{")
        for name in record.names or ():
            item, shape = record[name].subdtype or (record[name], ())
            kind = f"vec{shape[-1]}{item.kind}" if shape else kinds[item.kind]
            lines.append(f"  {name}: {f'array<{kind}, {shape[0]}>' if len(shape) > 1 else kind},")
        lines.append("}")
    lines.append(printed_constants(CONSTANTS, "wgsl"))
    return "\n".join(lines)
