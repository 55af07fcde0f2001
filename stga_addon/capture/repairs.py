"""Captures whose mesh misses their images: measured, and read in the way that fits."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from ..errors import StgaError
from ..files import is_file, read_json, write_json
from .camera import GL_TO_CV, Camera, scaled_to
from .mesh_geometry import pixels_of, silhouette
from .model import Capture, View, Views, evenly_spread
from .transforms import Frame, Transforms

REPAIR_OPTION = "--repair"
"""Option that has a capture read in the way that fits; sentences name it."""
REPAIRS_FILE = "stga_repairs.json"
"""File in a capture's folder that holds how the capture is read differently from how it is
written."""
MAX_MEASURED_VIEWS = 4
"""Views that are measured."""
MEASURED_HEIGHT_PX = 160
"""Height of the small masks that are compared with the mesh."""
MAX_BESIDE_MESH = 0.4
"""Fraction of the foreground beside the mesh, above which other ways of reading are tried: hair and
shoulders take as much."""
MIN_MESH_IN_MASK = 0.8
"""Fraction of the mesh within the masks, below which they are tried as well."""
MIN_FIT = 0.4
"""Least intersection of mesh and foreground over their union, where a way of reading fits."""
MIN_BETTER = 1.4
"""Factor by which its fit must exceed that of reading the capture as it is written."""
MIN_IN_IMAGES = 0.9
"""Fraction of the mesh within images that have no masks, where a way of reading fits."""
MAX_BESIDE_IMAGES = 0.1
"""Fraction of it up to which images without masks do not show the mesh."""
MAX_FIT_OF_MISS = 0.05
"""Fit of the capture as it is written up to which a warning says that no way of reading fits."""
CENTIMETERS = (10.0, 99.0)
"""Extents of a head's mesh, with its shoulders, in centimeters."""
MILLIMETERS = (100.0, 990.0)
"""Extents of a head's mesh, with its shoulders, in millimeters."""
MIN_VISIBLE = 0.2
"""Fraction of the mesh within images, from which mesh and cameras have one unit."""
Z_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Turns a vertex (x, y, z) with z up to y up."""


@dataclass(frozen=True)
class Repair:
    """Another way to read a capture.

    about     what is wrong with the files, in the words of a message
    camera    the camera as it is meant, of the one as it was read
    turn      (3, 3) that turns the mesh's vertices, or the cameras' world back; None: none
    inverted  whether masks are 255 outside
    """

    about: str
    camera: Callable[[Camera], Camera] | None = None
    turn: np.ndarray | None = None
    inverted: bool = False


def _posed(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Camera], Camera]:
    return lambda camera: replace(camera, world_to_camera=change(camera.world_to_camera))


def _written(pose: np.ndarray) -> np.ndarray:
    """The file's matrix of a camera that was read as camera-to-world with OpenGL axes."""
    return np.linalg.inv(GL_TO_CV @ pose)


REPAIRS: dict[str, Repair] = {
    "opencv-axes": Repair(
        "transform_matrix has OpenCV axes (y down, looking along +z) instead of OpenGL's",
        _posed(lambda pose: GL_TO_CV @ pose),
    ),
    "world-to-camera": Repair(
        "transform_matrix leads from world to camera, with OpenGL axes",
        _posed(lambda pose: GL_TO_CV @ _written(pose)),
    ),
    "world-to-camera-opencv": Repair(
        "transform_matrix leads from world to camera, with OpenCV axes", _posed(_written)
    ),
    "masks-inverted": Repair("masks are 255 outside of the head", inverted=True),
    "z-up": Repair("meshes and cameras differ by 90° about x: one has z up", turn=Z_UP),
    "z-down": Repair("meshes and cameras differ by -90° about x", turn=Z_UP.T),
    "y-down": Repair("meshes and cameras differ by 180° about x", turn=np.diag([1.0, -1, -1])),
    "cy-flipped": Repair(
        "cy is counted from the other side",
        lambda camera: replace(camera, cy=camera.height - camera.cy),
    ),
    "cx-cy-swapped": Repair(
        "cx and cy are swapped", lambda camera: replace(camera, cx=camera.cy, cy=camera.cx)
    ),
}
"""Name in the file -> what it does, the likeliest first."""


def read_repairs(root: Path) -> tuple[str, ...] | None:
    """Names of the repairs that the folder's file holds; None without one, where the mesh is to be
    measured. Raises StgaError for others."""
    path = root / REPAIRS_FILE
    if not is_file(path):
        return None
    values = read_json(path)
    names = values.get("repairs") if isinstance(values, dict) else None
    if not isinstance(names, list) or not all(name in REPAIRS for name in names):
        raise StgaError(f"{path}: repairs: expected some of {', '.join(REPAIRS)}")
    return tuple(names)


def write_repairs(root: Path, names: Sequence[str]) -> None:
    """Keep repairs in the capture's folder, where `open_capture` finds them. Raises StgaError."""
    write_json(root / REPAIRS_FILE, {"repairs": list(names)})


def repaired(capture: Capture, names: Iterable[str]) -> Capture:
    """The capture as it is meant."""
    for name in names:
        repair = REPAIRS[name]
        cameras = _turned(capture, repair)
        if repair.turn is not None and cameras is None:
            capture = _with_vertices(capture, repair.turn.T)
        capture = replace(capture, views=_changed(capture.views, repair, cameras))
    return capture


def in_meters(capture: Capture) -> tuple[Capture, str | None]:
    """The capture in meters, where its meshes are in centimeters or millimeters, as their size
    says, with its cameras, unless these are in meters; and a sentence about that."""
    size = float(np.ptp(capture.neutral, axis=0).max()) if len(capture.neutral) else 0.0
    for (low, high), factor, unit in ((CENTIMETERS, 0.01, "centi"), (MILLIMETERS, 0.001, "milli")):
        if capture.flame is None and low <= size <= high:

            def scaled(camera: Camera, factor: float = factor) -> Camera:
                pose = camera.world_to_camera.copy()
                pose[:3, 3] *= factor
                return replace(camera, world_to_camera=pose)

            meters = _with_vertices(capture, factor * np.eye(3))
            what = "meshes"
            if _in_images(capture) >= MIN_VISIBLE or _in_images(meters) < MIN_VISIBLE:
                what = "meshes and cameras"
                meters = replace(meters, views=_changed(capture.views, Repair("", scaled), None))
            sentence = f"the neutral mesh measures {size:.3g}: {what} are read as {unit}meters"
            return meters, f"{capture.root}: {sentence}, divided by {1 / factor:g}"
    return capture, None


def in_image_size(transforms: Transforms) -> tuple[Transforms, str | None]:
    """The frames with cameras of the images' size, where all images of a camera have another one of
    its shape; and a sentence about the first. Nothing is measured without Pillow, which Blender
    lacks. Raises StgaError."""
    if find_spec("PIL") is None:
        return transforms, None
    from .images import image_size

    alike: dict[tuple[float, ...], list[Frame]] = {}
    for frame in transforms.frames:
        alike.setdefault(frame.view.camera.intrinsics, []).append(frame)
    sizes = {}
    sentences = []
    for key, frames in alike.items():
        camera = frames[0].view.camera
        images = [frame.view.image for frame in frames]
        size = camera.width, camera.height
        first = image_size(images[0])
        if size in (first, first[::-1]) or scaled_to(camera, first) is None:
            continue
        if all(image_size(path) == first for path in images):
            sizes[key] = first
            both = f"has {first[0]} x {first[1]} pixels, its camera {size[0]} x {size[1]}"
            factor = f"scaled by {first[0] / size[0]:.4g}"
            sentences.append(f"{images[0]}: {both}; the calibration is {factor}")

    def fitted(frame: Frame) -> Frame:
        camera = frame.view.camera
        size = sizes.get(camera.intrinsics)
        found = None if size is None else scaled_to(camera, size)
        if found is None:
            return frame
        cx, cy = frame.principal
        principal = cx * found.width / camera.width, cy * found.height / camera.height
        return replace(frame, view=replace(frame.view, camera=found), principal=principal)

    splits = {name: tuple(map(fitted, members)) for name, members in transforms.splits.items()}
    return replace(transforms, splits=splits), next(iter(sentences), None)


def _in_images(capture: Capture) -> float:
    """Fraction of the mesh that lies within the images of a few views."""
    views = evenly_spread(capture.all_views, MAX_MEASURED_VIEWS)
    fractions = [pixels_of(capture.mesh(view.timestep), view.camera)[2].mean() for view in views]
    return float(np.mean(fractions)) if fractions else 0.0


def find_repair(capture: Capture) -> tuple[str | None, str | None]:
    """Name of the repair with which the capture's mesh fits its images, and a sentence; None and
    None where it fits as it is. Nothing is measured without Pillow, which Blender lacks."""
    views = evenly_spread(capture.views.get("train", ()) or capture.all_views, MAX_MEASURED_VIEWS)
    if not views or find_spec("PIL") is None or find_spec("cv2") is None:
        return None, None
    try:
        measured = [_Measured(capture, view) for view in views]
    except StgaError:  # what needs the file says so
        return None, None
    has_masks = all(each.mask is not None for each in measured)
    now, problem = _fit(measured, None, has_masks)
    if problem is None:
        return None, None
    fits = {}
    for name, repair in REPAIRS.items():
        if has_masks or not repair.inverted:
            fits[name] = _fit(measured, _resolved(capture, repair), has_masks)[0]
    best = max(fits, key=lambda name: fits[name])
    least = max(MIN_FIT, MIN_BETTER * now) if has_masks else MIN_IN_IMAGES
    if fits[best] >= least:
        about = REPAIRS[best].about
        cure = f"with {REPAIR_OPTION}, it is read so ({best})"
        return best, f"{capture.root}: {problem}; {about}, by which they fit: {cure}"
    if now <= MAX_FIT_OF_MISS:
        tried = "neither other axes, inverse matrices, a turn by 90° nor inverted masks fit better"
        return None, f"{capture.root}: {problem}, and {tried}: check transform_matrix and meshes"
    return None, None


class _Measured:
    """A view made small, its mesh, and (H, W) bool: its foreground, None without a mask."""

    def __init__(self, capture: Capture, view: View) -> None:
        from .images import read_view

        scale = min(1.0, MEASURED_HEIGHT_PX / view.camera.height)
        small, _, mask = read_view(view, scale)
        self.camera = small.camera
        self.mask = None if mask is None else mask > 127
        self.vertices = capture.mesh(view.timestep)
        self.faces = capture.faces


def _fit(
    measured: Sequence[_Measured], repair: Repair | None, has_masks: bool
) -> tuple[float, str | None]:
    """How well the mesh fits, 0 to 1, and what is wrong, None where nothing is."""
    scores = []
    beside = []
    within = []
    for each in measured:
        camera = (
            each.camera if repair is None or repair.camera is None else repair.camera(each.camera)
        )
        vertices = each.vertices
        if repair is not None and repair.turn is not None:
            vertices = vertices @ repair.turn.T
        if not has_masks:
            scores.append(float(pixels_of(vertices, camera)[2].mean()))
            continue
        assert each.mask is not None
        mask = ~each.mask if repair is not None and repair.inverted else each.mask
        covered = silhouette(vertices, each.faces, camera)
        both = int((covered & mask).sum())
        scores.append(both / max(int((covered | mask).sum()), 1))
        if mask.any():
            beside.append(1 - both / int(mask.sum()))
            within.append(both / max(int(covered.sum()), 1))
    score = float(np.mean(scores))
    if not has_masks:
        missed = score <= MAX_BESIDE_IMAGES
        return score, f"{1 - score:.0%} of the mesh lies beside the images" if missed else None
    outside = float(np.mean(beside)) if beside else 0.0
    inside = float(np.mean(within)) if within else 1.0
    if outside <= MAX_BESIDE_MESH and inside >= MIN_MESH_IN_MASK:
        return score, None
    foreground = f"{outside:.0%} of the foreground lies beside the mesh"
    return score, f"{foreground}, and {1 - inside:.0%} of the mesh beside the foreground"


def _resolved(capture: Capture, repair: Repair) -> Repair:
    """The repair with a turn that goes to the cameras, where it does."""
    cameras = _turned(capture, repair)
    return repair if cameras is None else replace(repair, camera=cameras, turn=None)


def _turned(capture: Capture, repair: Repair) -> Callable[[Camera], Camera] | None:
    """What turns the cameras' world instead of the mesh: that of FLAME, which has y up, and where
    the cameras have not."""
    if repair.turn is None:
        return repair.camera
    ups = [-view.camera.world_to_camera[1, :3] for view in capture.all_views]
    if capture.flame is None and (not ups or np.mean(ups, axis=0)[1] > np.sqrt(0.5)):
        return None
    turn = np.eye(4)
    turn[:3, :3] = repair.turn
    return _posed(lambda pose: pose @ turn)


def _changed(views: Views, repair: Repair, cameras: Callable[[Camera], Camera] | None) -> Views:
    change = cameras or repair.camera or (lambda camera: camera)

    def changed(view: View) -> View:
        inverted = view.is_mask_inverted != repair.inverted
        return replace(view, camera=change(view.camera), is_mask_inverted=inverted)

    return {split: tuple(map(changed, members)) for split, members in views.items()}


def _with_vertices(capture: Capture, matrix: np.ndarray) -> Capture:
    """The capture with all vertices (N, 3) times `matrix` (3, 3)."""
    return replace(
        capture,
        neutral=capture.neutral @ matrix,
        mesh=lambda timestep: capture.mesh(timestep) @ matrix,
        expression_mesh=lambda timestep, pose: capture.expression_mesh(timestep, pose) @ matrix,
    )
