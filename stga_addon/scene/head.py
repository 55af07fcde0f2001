"""The tracked head as an animated Blender mesh: shape keys for any topology, a rig for FLAME."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..capture.model import Capture
from ..flame.sequence import FlameSequence, neutral_mesh
from . import compat, tags
from .hierarchy import Warn, capture_root, log_warning, place, triangle_mesh
from .rig import add_rig, remove_rig


def import_head(
    capture: Capture, name: str | None = None, warn: Warn = log_warning, all_expressions: bool = False
) -> Any:
    """The capture's head as a mesh object, animated so that Blender's frame number is the capture's timestep.

    A FLAME capture becomes a rig (see `rig.add_rig`); any other gets one shape key a timestep, `t00012`, which is 1 at
    its own frame, so that the evaluated mesh of that frame is the timestep's mesh; between frames the two neighbours
    blend. Object coordinates are the capture's (metres, y-up). Regions become boolean face attributes
    `stga_region_<name>`. Importing the same folder again replaces what the last import made. Raises StgaError where a
    timestep cannot be read; the scene is then unchanged. `warn` receives one sentence for each thing worth knowing;
    `all_expressions` makes a key for every expression component of FLAME, used or not.
    """
    if capture.flame is not None:
        return _import_flame(capture.flame, capture.root, name, capture.neutral, capture.regions, warn, all_expressions)
    meshes = np.empty((len(capture.timesteps), *capture.neutral.shape), np.float32)
    for row, timestep in enumerate(capture.timesteps):
        meshes[row] = capture.mesh(timestep)
    head = _place_head(capture.root, name, capture.neutral, capture.faces, capture.regions, capture.timesteps)
    remove_rig(head)
    _add_timestep_keys(head, capture.timesteps, meshes)
    return head


def import_motion(
    sequence: FlameSequence,
    source: Path,
    name: str | None = None,
    warn: Warn = log_warning,
    all_expressions: bool = False,
) -> Any:
    """A FLAME motion without images as a rigged head mesh object; `source` is the file it came from.

    Otherwise as `import_head`.
    """
    return _import_flame(sequence, source, name, neutral_mesh(sequence), {}, warn, all_expressions)


def _import_flame(
    sequence: FlameSequence,
    source: Path,
    name: str | None,
    neutral: np.ndarray,
    regions: Mapping[str, np.ndarray],
    warn: Warn,
    all_expressions: bool,
) -> Any:
    frames = [sequence.frame(timestep) for timestep in sequence.timesteps]
    head = _place_head(source, name, neutral, sequence.model.faces, regions, sequence.timesteps)
    add_rig(head, sequence, frames, warn, all_expressions)
    return head


def _place_head(
    source: Path,
    name: str | None,
    neutral: np.ndarray,
    faces: np.ndarray,
    regions: Mapping[str, np.ndarray],
    timesteps: Sequence[int],
) -> Any:
    root = capture_root(source, name)
    title = f"{root.name} head"
    mesh = triangle_mesh(title, neutral, faces)
    for region, members in regions.items():
        attribute = mesh.attributes.new(tags.REGION_PREFIX + region, "BOOLEAN", "FACE")
        attribute.data.foreach_set("value", np.ascontiguousarray(members, bool))
    head = place(root, tags.HEAD, title, mesh, next(iter(tags.find(tags.HEAD, source)), None))
    head[tags.TIMESTEPS] = [int(timestep) for timestep in timesteps]
    head.shape_key_add(name="Basis", from_mix=False)
    return head


def _add_timestep_keys(head: Any, timesteps: Sequence[int], meshes: np.ndarray) -> None:
    """meshes (T, V, 3) float32 in object space."""
    names = [f"t{timestep:05d}" for timestep in timesteps]
    for key_name, mesh in zip(names, meshes, strict=True):
        head.shape_key_add(name=key_name, from_mix=False).points.foreach_set("co", mesh.ravel())
    compat.write_hat_curves(head.data.shape_keys, names, timesteps)
