"""Cameras of RealityCapture and RealityScan: the CSV of internal and external parameters, XMP."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from ...capture.camera import GL_TO_CV
from ...capture.lens import Lens
from ...errors import StgaError, listed, shorten
from ...files import LINES_BEFORE_COLUMNS, read_table, table_rows
from ...flame.forward import axis_angle_matrices
from .shots import Calibrated, ImageSize, Shot, numbers, pinhole, read_xml

FILM_WIDTH_MM = 36.0
"""Width of the 35 mm film to which focal lengths refer; it stands for the image's longer side."""
REQUIRED_COLUMNS = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
"""Columns without which a table is refused: name, position, angles and focal length."""
LENS_COLUMNS = ("k1", "k2", "k3", "k4", "t1", "t2")
"""Columns of Brown's lens distortion: radial, then tangential."""
OTHER_SPELLINGS = {
    "yaw": "heading",
    "f_35mm": "f",
    "px_norm": "px",
    "py_norm": "py",  # RealityScan 2's
    "z": "alt",
    "altitude": "alt",
    "image": "name",
    "imagename": "name",
    "image_name": "name",
    "filename": "name",
    "file_name": "name",
    "label": "name",
    "camera": "name",
}
"""Column as other versions and people name it -> as it is read. RealityScan's users say that its
columns mean the same (nerfstudio's pull request 3758)."""
OF_CALIBRATIONS = {
    *("heading", "pitch", "roll", "f", *LENS_COLUMNS, "px", "py", "fx", "fy", "cx", "cy", "f_pix"),
    *("px_pix", "py_pix", "focal", "focal_length", "tx", "ty", "tz", "rx", "ry", "rz", "qw", "qx"),
    *("qy", "qz", "omega", "phi", "kappa", "r00", "r01", "r02", "r11", "r12", "r13"),
}
"""Columns of any program's cameras, but for their positions."""
MIN_COLUMNS = 3  # Least number of these columns with which a table is one of cameras
NAMESPACE = "{http://www.capturingreality.com/ns/xcr/1.1#}"
XMP_MODELS = ("perspective", "brown3", "brown4", "brown3t2", "brown4t2")
Rows = Sequence[tuple[int, list[str]]]


def is_table_of_cameras(head: str) -> bool:
    """Whether a file begins as a table of camera parameters, of this program or another one."""
    try:
        rows = table_rows("", head)
    except StgaError:
        return False
    return any(_is_of_cameras(row) for _, row in rows[:LINES_BEFORE_COLUMNS])


def is_xmp(path: Path) -> bool:
    """Whether an XMP file is of these programs; others write theirs beside images, too."""
    with path.open("rb") as stream:
        return NAMESPACE.strip("{}").encode() in stream.read(1 << 16)


def read_realitycapture_csv(path: Path, image_size: ImageSize) -> Calibrated:
    """One shot a line, labelled with the image's name. Columns: name, x, y, alt, heading, pitch,
    roll (degrees), f (35 mm film), and, where they are there, px, py (fractions of the longer
    side), k1 to k4, t1, t2; or `OTHER_SPELLINGS`. Raises StgaError that names file and line."""
    rows = read_table(path)
    first = _row_of_names(rows)
    columns = _columns(rows[first][1]) if rows else []
    missing = [name for name in REQUIRED_COLUMNS if name not in columns]
    if missing:
        raise StgaError(
            f"{path}: has no column {', '.join(missing)}; expected internal and external "
            "camera parameters"
        )
    shots = []
    for number, line in rows[first + 1 :]:
        where = f"{path}: line {number}"
        if len(line) < len(columns):
            raise StgaError(f"{where}: expected {len(columns)} columns, not {len(line)}")
        row = dict(zip(reversed(columns), reversed(line[: len(columns)]), strict=True))
        label = row.pop("name").strip()
        given = {
            name: text
            for name, text in row.items()
            if name in REQUIRED_COLUMNS or (name in ("px", "py", *LENS_COLUMNS) and text.strip())
        }
        values = {name: numbers([text], f"{where}: {name}", 1)[0] for name, text in given.items()}
        shots.append(_csv_shot(label, values, image_size(label), where))
    return shots, ()


def _csv_shot(label: str, values: dict[str, float], size: tuple[int, int], where: str) -> Shot:
    # With all angles zero, the camera looks down and north (y) is up in the image. Heading
    # turns clockwise.
    heading, pitch, roll = (np.deg2rad(values[name]) for name in ("heading", "pitch", "roll"))
    turns = axis_angle_matrices(np.array([[0, 0, -heading], [pitch, 0, 0], [0, roll, 0]]))
    rotation = GL_TO_CV[:3, :3] @ (turns[0] @ turns[1] @ turns[2]).T
    position = np.array([values[name] for name in ("x", "y", "alt")])
    scale = max(size)
    focal = values["f"] / FILM_WIDTH_MM * scale
    cx, cy = (values.get(name, 0.0) * scale for name in ("px", "py"))
    center = size[0] / 2 + cx, size[1] / 2 + cy
    camera = pinhole(size, (focal, focal), center, rotation, position, where)
    lens = _lens([values.get(name, 0.0) for name in LENS_COLUMNS])
    return Shot(label, camera, lens, where)


def read_realitycapture_xmp(
    paths: Iterable[Path], image_size: ImageSize, folder: Path
) -> Calibrated:
    """One shot an XMP file with a pose, labelled with its path below the folder, without suffix.
    Raises StgaError that names file and field."""
    shots = []
    without_pose = []
    for path in sorted(paths):
        fields: dict[str, str] = {}  # as attributes or as elements, by the version
        for element in read_xml(path).iter():
            named = {**element.attrib, element.tag: element.text or ""}
            tags = {key: text for key, text in named.items() if key.startswith(NAMESPACE)}
            fields |= {key.removeprefix(NAMESPACE): text for key, text in tags.items()}
        label = path.relative_to(folder).with_suffix("").as_posix()
        if "Rotation" in fields and "Position" in fields:
            shots.append(_xmp_shot(path, label, fields, image_size(label)))
        else:
            without_pose.append(label)
    if not without_pose:
        return shots, ()
    return shots, (f"left out cameras without a pose: {listed(without_pose)}",)


def _row_of_names(rows: Rows) -> int:
    """The first row that is of names; some versions write a comment (#cameras 8) before it."""
    heads = enumerate(rows[:LINES_BEFORE_COLUMNS])
    return next((place for place, (_, row) in heads if _is_of_cameras(row)), 0)


def _is_of_cameras(names: Iterable[str]) -> bool:
    columns = _columns(names)
    return "name" in columns and len(OF_CALIBRATIONS.intersection(columns)) >= MIN_COLUMNS


def _columns(names: Iterable[str]) -> list[str]:
    plain = [name.strip().lstrip("#").strip().lower() for name in names]
    return [OTHER_SPELLINGS.get(name, name) for name in plain]


def _xmp_shot(path: Path, label: str, fields: dict[str, str], size: tuple[int, int]) -> Shot:
    def values(name: str, default: str, count: int | None = 1) -> list[float]:
        return numbers(fields.get(name, default).split(), f"{path}: xcr:{name}", count)

    coefficients = values("DistortionCoeficients", "0", None)  # so spelled
    coefficients += [0.0] * (6 - len(coefficients))
    model = fields.get("DistortionModel", "perspective")
    if model not in XMP_MODELS and any(coefficients):
        raise StgaError(
            f"{path}: xcr:DistortionModel {shorten(model)} is not one of "
            f"{', '.join(XMP_MODELS)}; choose one of these in RealityCapture's alignment "
            "settings and export again"
        )
    if "FocalLength35mm" not in fields:
        raise StgaError(f"{path}: xcr:FocalLength35mm is missing")
    scale = max(size)
    fraction = values("FocalLength35mm", "")[0] / FILM_WIDTH_MM
    lens = _lens(coefficients, values("Skew", "0")[0] / fraction if fraction else 0.0)
    focal = fraction * scale, fraction * scale * values("AspectRatio", "1")[0]
    cx, cy = (values(f"PrincipalPoint{axis}", "0")[0] * scale for axis in "UV")
    rotation = np.array(values("Rotation", "", 9)).reshape(3, 3)  # world to camera, OpenCV axes
    position = np.array(values("Position", "", 3))
    center = (size[0] / 2 + cx, size[1] / 2 + cy)
    camera = pinhole(size, focal, center, rotation, position, str(path))
    return Shot(label, camera, lens, str(path))


def _lens(coefficients: list[float], skew: float = 0.0) -> Lens:
    """coefficients: k1 to k4, t1, t2; RealityCapture's t1 belongs to x, OpenCV's p1 to y."""
    k1, k2, k3, k4, t1, t2 = coefficients[:6]
    return Lens(radial=(k1, k2, k3, k4), tangential=(t2, t1), affine=(0.0, skew))
