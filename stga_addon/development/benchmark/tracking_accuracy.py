"""Accuracy of `stga track`: distances of the tracked head from a capture's own meshes.

    python -m stga_addon.development.benchmark.tracking_accuracy CAPTURE [--model HEAD]
        [--flame FILE] [--timesteps 8] [--cameras 4]

CAPTURE gives images and cameras as the only input, and its meshes as the truth; --flame is the
model that they were made with. HEAD is what is fitted: a FLAME model, a linear model, or an .npz of
FLAME's open template (`v_template`, `shapedirs`, `faces`); without it, the bundled head. Prints in
millimeters, within 9 cm of the landmarks' center: how far what the cameras see of the capture's
mesh, by its triangles' centers, is from the tracked surface and, where both have the same topology,
vertices from each other. Of several timesteps with the bundled head, also how the true motion about
its mean shows in the tracked one, the head held still: the fraction that is followed, correlation
and median error of what moves by brows, lids, lips and jaw. Landmarks are detected, or read from
the folder of --landmarks; --cameras: as many of those nearest to the middle, every second one.
"""

import argparse
import tempfile
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np

from ...capture.mesh_geometry import facing, similarity, vertex_normals
from ...capture.open import open_capture
from ...files import read_npz, write_npz
from ...flame.teeth import TEETH_VERTICES
from ...tracking.correspondence import nearest_points
from ...tracking.folder import LANDMARKS_FOLDER, PLACES_FILE
from ...tracking.footage.open import open_footage
from ...tracking.footage.sequences import FrameRange
from ...tracking.head_model import read_head_model
from ...tracking.landmarks import read_places
from ...tracking.observed_surface import in_sight
from ...tracking.opened import TrackingOptions
from ...tracking.track import track

SHAPES = {"brows": "brow", "lids": "eyeBlink", "lips": "mouth", "jaw": "jaw"}
"""Part of the face -> first letters of the ARKit shapes that move it."""
MIN_MOTION = 0.5
"""Least motion of a vertex that belongs to a part, relative to the part's largest motion."""
STILL_FRACTION = 0.35
"""Fraction of the face, the part that moves least, by which heads are aligned."""
MAX_DISTANCE_M = 0.006
"""Largest distance from the tracked surface of a true vertex that lies on it."""
FACE_RADIUS_M = 0.09
"""Radius of the face about its middle."""
MIN_COSINE = 0.2
"""Least cosine of the angle between a triangle's normal and a camera that sees it."""


def head_file(path: Path | None, folder: Path) -> Path | None:
    """The head model, or FLAME's open template written as a linear model."""
    if path is not None and path.suffix == ".npz":
        arrays = read_npz(path)
        if "v_template" in arrays and "posedirs" not in arrays:
            linear = {
                "mean": arrays["v_template"],
                "faces": arrays["faces"],
                "identity": arrays["shapedirs"],
            }
            write_npz(folder / "head.npz", linear)
            return folder / "head.npz"
    return path


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("capture", type=Path)
    parser.add_argument("--model", type=Path)
    parser.add_argument("--flame", type=Path)
    parser.add_argument("--landmarks", type=Path)
    parser.add_argument("--timesteps", type=int)
    parser.add_argument("--cameras", type=int)
    options = parser.parse_args()
    if options.cameras is not None and options.cameras < 1:
        parser.error(f"--cameras: expected 1 or more, got {options.cameras}")
    with tempfile.TemporaryDirectory() as name:
        measure(options, Path(name))


def measure(options: argparse.Namespace, folder: Path) -> None:
    """Track, and print a row in Markdown for each timestep."""
    footage = open_footage(options.capture, frames=FrameRange(stop=options.timesteps))
    if options.cameras is not None:
        at = np.array([each.camera.position for each in footage.cameras])
        order = np.argsort(np.linalg.norm(at - at.mean(0), axis=1), kind="stable")
        chosen = order[: 2 * options.cameras : 2].tolist()
        footage = replace(footage, cameras=tuple(footage.cameras[row] for row in chosen))
    true = open_capture(options.capture, options.flame)
    file = head_file(options.model, folder)
    begin = perf_counter()
    result = track(footage, file, folder / "out", TrackingOptions(options.landmarks, mattes=False))
    seconds = perf_counter() - begin
    found = open_capture(folder / "out", file)
    places, used = read_places(
        (options.landmarks or folder / "out" / LANDMARKS_FOLDER) / PLACES_FILE, len(found.faces)
    )
    template = read_head_model(file).model.v_template
    center = places.on(template, found.faces)[used].mean(0)
    face = np.flatnonzero(np.linalg.norm(template - center, axis=1) < FACE_RADIUS_M)
    # The true world is the footage's: cameras are in both, so that they give the way back.
    first = {
        view.camera_index: view.camera for view in (*found.views["train"], *found.views["val"])
    }
    print("| timestep | surface: median | 90 % | vertices: mean |")
    print("| --- | --- | --- | --- |")
    meshes = []
    for timestep in footage.timesteps:
        camera = first[0]
        known = footage.cameras[0].camera
        local = (
            found.mesh(timestep) @ camera.world_to_camera[:3, :3].T + camera.world_to_camera[:3, 3]
        )
        local = (local / result.scale - known.world_to_camera[:3, 3]) @ known.world_to_camera[
            :3, :3
        ]
        meshes.append((true.mesh(timestep), local))
        mesh = true.mesh(timestep)
        middle = places.on(local, found.faces)[used].mean(0)
        centers = mesh[true.faces].mean(1)
        normals = vertex_normals(mesh, true.faces)[true.faces].mean(1)
        visible = np.zeros(len(centers), bool)
        for view in (each.camera for each in footage.cameras if timestep in each.timesteps):
            visible |= (facing(view, centers, normals) > MIN_COSINE) & in_sight(
                view, mesh, true.faces, centers
            )
        visible &= np.linalg.norm(centers - middle, axis=1) < FACE_RADIUS_M / result.scale
        distance = 1000 * nearest_points(local, found.faces, centers[visible])[1]
        same = len(found.faces) == len(true.faces) or len(mesh) - len(local) == TEETH_VERTICES
        shift = 1000 * np.linalg.norm(local[face] - mesh[face], axis=1).mean() if same else np.nan
        median = np.median(distance)
        most = np.percentile(distance, 90)
        print(f"| {timestep} | {median:.2f} | {most:.2f} | {shift:.2f} |")
    if options.model is None and len(meshes) > 2:
        heads, tracked = (np.stack(every) for every in zip(*meshes, strict=True))
        report_motion(heads, tracked, found.faces, result.scale)
    print(f"\n{len(list(footage.views()))} images, {seconds:.1f} s")
    print(f"reprojection {result.median_px:.2f} px, scale {result.scale:.4f}")


def report_motion(true: np.ndarray, tracked: np.ndarray, faces: np.ndarray, scale: float) -> None:
    """Print a row in Markdown for each part of the face: true meshes (T, V, 3), tracked ones of the
    bundled head (T, W, 3)."""
    model = read_head_model(None).model
    places, away = nearest_points(tracked[0], faces, true[0])
    followed = np.stack([places.on(mesh, faces) for mesh in tracked])
    shapes = np.square(model.shapedirs[:, :, model.n_identity :]).sum(1)
    parts = {}
    for part, start in SHAPES.items():
        named = [name.startswith(start) for name in model.expression_names]
        moved = places.on(np.sqrt(shapes[:, named].sum(1)), faces)
        parts[part] = (away * scale < MAX_DISTANCE_M) & (moved > MIN_MOTION * moved.max())
    middle = np.mean([true[0][part].mean(0) for part in parts.values()], axis=0)
    face = away * scale < MAX_DISTANCE_M
    face &= np.linalg.norm(true[0] - middle, axis=1) * scale < FACE_RADIUS_M
    parts["face"] = face
    moved = places.on(np.sqrt(shapes.sum(1)), faces)
    still = face & (moved <= np.quantile(moved[face], STILL_FRACTION))
    motion = []
    for heads in (true, followed):
        first = heads[0][still]
        laid = [similarity(head[still], first, metric=True).apply(head) for head in heads]
        motion.append(np.stack(laid) - np.mean(laid, axis=0))
    print("\n| part | followed | correlation | median error, mm |\n| --- | --- | --- | --- |")
    for part, where in parts.items():
        one, other = (meshes[:, where] for meshes in motion)
        both = (one * other).sum()
        size = np.square(one).sum()
        error = 1000 * scale * np.median(np.linalg.norm(one - other, axis=2))
        correlation = both / np.sqrt(size * np.square(other).sum())
        print(f"| {part} | {both / size:.2f} | {correlation:.2f} | {error:.2f} |")


if __name__ == "__main__":
    main()
