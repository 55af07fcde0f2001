"""Splats and their light as attributes of Blender meshes: names, how they are written, how they are
read back."""

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any
from uuid import uuid4

import numpy as np

from ...avatar.embedding import face_areas
from ...avatar.file import Avatar, AvatarLight
from ...avatar.offsets import OFFSETS
from ...avatar.splats import SH_C0, Splats
from ...avatar.strain import STRAIN_COMPONENTS, StrainBasis, strain_basis
from ...capture.color import srgb_to_linear
from .. import tags
from ..arrays import flat_floats, read_values

# On the vertices of a splat object.
XYZ = "stga_xyz"
ROTATION = "stga_rotation"
SCALE = "stga_scale"  # standard deviations, linear
OPACITY = "stga_opacity"  # 0 to 1
# constant part, scene-linear: all the nodes need for splats of SH degree 0 without strain
COLOR = "stga_color"
# scene-linear, of one frame (`render.scene_splats`): where it is there, it counts
RELIT_COLOR = "stga_relit_color"
SH = "stga_sh_{}"  # sRGB coefficients, by index
STRAIN_COLOR = "stga_strain_color_{}"
FACE = "stga_face"
# of the splat's triangle, m²; also on the faces that have driven offsets
NEUTRAL_AREA = "stga_neutral_area"

# On the faces of the neutral mesh, from `StrainBasis`. A symmetric tensor is two vectors: xx yy zz
# and xy yz zx.
TENSOR_HALVES = ("stga_strain_squares", "stga_strain_products")
GRAM, TENSOR, PLANE = "stga_gram", "stga_tensor_{}_{}", "stga_plane_{}_{}"
RANGE = ("stga_strain_lowest", "stga_strain_highest")
DRIVEN_OFFSET = "stga_{}_{}"  # by name and component of the signal, as in `Avatar.driven_offsets`

Attributes = dict[str, tuple[str, str, np.ndarray]]
"""Name -> (data type, name of the element's field, flat values)."""


@dataclass(frozen=True)
class SplatAttributes:
    """Attributes for the vertices of a splat object, and for the faces of its neutral mesh; light
    of the avatar."""

    splats: Attributes
    neutral: Attributes
    light: AvatarLight | None = None


def avatar_attributes(avatar: Avatar) -> SplatAttributes:
    """What displaying an avatar writes into Blender; uses no bpy, so that a thread can compute
    it."""
    areas = face_areas(avatar.neutral, avatar.faces)
    splats = {
        **splat_attributes(avatar.splats),
        FACE: ("INT", "value", np.ascontiguousarray(avatar.splats.face, np.int32)),
        NEUTRAL_AREA: ("FLOAT", "value", flat_floats(areas[avatar.splats.face])),
    }
    return SplatAttributes(splats, _neutral_attributes(avatar, areas), avatar.light)


def _neutral_attributes(avatar: Avatar, areas: np.ndarray) -> Attributes:
    """What nodes need to have splats follow strain; areas (F,) of the neutral triangles, in m²."""
    if not avatar.follows_strain:
        return {}
    vectors = dict(_strain_vectors(strain_basis(avatar.neutral, avatar.faces, avatar.strain_range)))
    for offset, coefficients in avatar.driven_offsets.items():
        for index in range(coefficients.shape[1]):
            vectors[DRIVEN_OFFSET.format(offset, index)] = coefficients[:, index]
    attributes: Attributes = {
        name: ("FLOAT_VECTOR", "vector", flat_floats(vector)) for name, vector in vectors.items()
    }
    if avatar.driven_offsets:
        attributes[NEUTRAL_AREA] = ("FLOAT", "value", flat_floats(areas))
    return attributes


def splat_attributes(splats: Splats) -> Attributes:
    """The splats' activated values: unit rotations, linear scales, opacities of 0 to 1."""
    norm = np.linalg.norm(splats.rotation, axis=-1, keepdims=True)
    rotation = np.where(
        norm > 0, splats.rotation / np.where(norm > 0, norm, 1.0), [1.0, 0.0, 0.0, 0.0]
    )
    attributes = {
        XYZ: ("FLOAT_VECTOR", "vector", flat_floats(splats.xyz)),
        ROTATION: ("QUATERNION", "value", flat_floats(rotation)),
        SCALE: ("FLOAT_VECTOR", "vector", flat_floats(np.exp(splats.log_scale.astype(np.float64)))),
        OPACITY: (
            "FLOAT",
            "value",
            flat_floats(1 / (1 + np.exp(-splats.opacity.astype(np.float64)))),
        ),
        COLOR: ("FLOAT_COLOR", "color", flat_floats(_base_color(splats.sh[:, 0]))),
    }
    for name, coefficients in ((SH, splats.sh), (STRAIN_COLOR, splats.strain_color)):
        for index in range(coefficients.shape[1]):
            attributes[name.format(index)] = (
                "FLOAT_VECTOR",
                "vector",
                flat_floats(coefficients[:, index]),
            )
    return attributes


def write_splats(mesh: Any, attributes: Attributes) -> None:
    """Give the mesh one vertex per splat, with these attributes; overwrites what there is in
    place."""
    positions = attributes[XYZ][2]
    if len(mesh.vertices) != len(positions) // 3:
        mesh.clear_geometry()
        mesh.vertices.add(len(positions) // 3)
    # Through the attribute, which takes all values at once; `MeshVertex.co` takes them one by one.
    write_attributes(
        mesh, {"position": ("FLOAT_VECTOR", "vector", positions), **attributes}, "POINT"
    )
    mesh[tags.REVISION] = uuid4().hex
    mesh.update()


def write_attributes(mesh: Any, attributes: Attributes, domain: str) -> None:
    """Set attributes of a mesh on one domain ("POINT", "FACE"); makes those that it lacks."""
    for name, (data_type, field, values) in attributes.items():
        attribute = mesh.attributes.get(name) or mesh.attributes.new(name, data_type, domain)
        attribute.data.foreach_set(field, values)


def read_splats(mesh: Any) -> Splats:
    """The splats stored in a splat object's mesh, with unit rotations; all count as bound to their
    triangles."""
    attributes = mesh.attributes
    count = len(mesh.vertices)

    def coefficients(name: str) -> np.ndarray:
        found: list[np.ndarray] = []
        while name.format(len(found)) in attributes:
            found.append(read_values(attributes[name.format(len(found))].data, "vector", 3))
        return np.stack(found, 1) if found else np.zeros((count, 0, 3), np.float32)

    opacity = read_values(attributes[OPACITY].data, "value", 1)[:, 0].astype(np.float64)
    scale = read_values(attributes[SCALE].data, "vector", 3).astype(np.float64)
    face = (
        read_values(attributes[FACE].data, "value", 1, np.int32)[:, 0]
        if FACE in attributes
        else None
    )
    # opacities of 0 and 1 are logits of −∞ and ∞, which the kernels accept
    with np.errstate(divide="ignore"):
        return Splats(
            xyz=read_values(attributes[XYZ].data, "vector", 3),
            rotation=read_values(attributes[ROTATION].data, "value", 4),
            log_scale=np.log(scale).astype(np.float32),
            opacity=np.log(opacity / (1 - opacity)).astype(np.float32),
            sh=coefficients(SH),
            face=np.zeros(count, np.int32) if face is None else face,
            unbound=np.zeros(count, bool),
            strain_color=coefficients(STRAIN_COLOR),
        )


def read_driven_offsets(neutral: Any) -> dict[str, np.ndarray]:
    """`Avatar.driven_offsets` as stored in a neutral mesh."""
    found = {
        name: read_vectors(
            neutral, [DRIVEN_OFFSET.format(name, index) for index in range(offset.signals)]
        )
        for name, offset in OFFSETS.items()
    }
    return {name: coefficients for name, coefficients in found.items() if coefficients is not None}


def read_vectors(mesh: Any, names: Sequence[str]) -> np.ndarray | None:
    """(F, len(names), 3) of vector attributes; None where the mesh lacks one."""
    if not all(name in mesh.attributes for name in names):
        return None
    return np.stack([read_values(mesh.attributes[name].data, "vector", 3) for name in names], 1)


def _base_color(dc: np.ndarray) -> np.ndarray:
    """(N, 4) scene-linear RGBA, as color attributes are stored; the SH coefficients (N, 3) give
    sRGB."""
    linear = srgb_to_linear(np.clip(0.5 + SH_C0 * np.asarray(dc, np.float64), 0.0, 1.0))
    return np.concatenate([linear, np.ones((len(dc), 1))], axis=-1)


def _strain_vectors(basis: StrainBasis) -> Iterator[tuple[str, np.ndarray]]:
    """What nodes need to compute strain: name and vector (F, 3)."""
    yield GRAM, basis.gram
    yield from zip(RANGE, basis.range.transpose(1, 0, 2), strict=True)
    for name, tensors in ((TENSOR, basis.to_tensor), (PLANE, basis.to_plane)):
        for index in range(STRAIN_COMPONENTS):
            for start, half in zip((0, 3), TENSOR_HALVES, strict=True):
                yield name.format(index, half), tensors[:, index, start : start + 3]


PROPERTY = "stga_light"
"""On the neutral mesh: JSON of what is not by vertex."""
VECTORS = ("stga_transfer_0", "stga_transfer_1", "stga_transfer_2", "stga_irradiance")
NUMBERS = ("stga_occlusion", "stga_roughness")
REST = ("residual", "damping", "source")


def write_light(mesh: Any, light: AvatarLight | None) -> None:
    """Store the light in a neutral mesh; None removes what it has."""
    if light is None:
        for name in (*VECTORS, *NUMBERS):
            if name in mesh.attributes:
                mesh.attributes.remove(mesh.attributes[name])
        if PROPERTY in mesh:
            del mesh[PROPERTY]
        return
    transfer = light.transfer
    vectors = transfer[:, :3], transfer[:, 3:6], transfer[:, 6:], light.irradiance
    for name, values in zip(VECTORS, vectors, strict=True):
        _write(mesh, name, "FLOAT_VECTOR", "vector", values)
    for name, values in zip(NUMBERS, (light.occlusion, light.roughness), strict=True):
        _write(mesh, name, "FLOAT", "value", values)
    rest: dict[str, Any] = {name: getattr(light, name) for name in REST}
    mesh[PROPERTY] = json.dumps(rest | {"radiance": light.radiance.ravel().tolist()})


def read_light(mesh: Any) -> AvatarLight | None:
    """What `write_light` stored; None where it is not there."""
    names = (*VECTORS, *NUMBERS)
    if PROPERTY not in mesh or not all(name in mesh.attributes for name in names):
        return None
    rest = json.loads(mesh[PROPERTY])
    vectors = [read_values(mesh.attributes[name].data, "vector", 3) for name in VECTORS]
    occlusion, roughness = (
        read_values(mesh.attributes[name].data, "value", 1)[:, 0] for name in NUMBERS
    )
    return AvatarLight(
        radiance=np.array(rest["radiance"], np.float32).reshape(9, 3),
        transfer=np.concatenate(vectors[:3], axis=1),
        occlusion=occlusion,
        irradiance=vectors[3],
        roughness=roughness,
        **{name: rest[name] for name in REST},
    )


def _write(mesh: Any, name: str, data_type: str, field: str, values: np.ndarray) -> None:
    attribute = mesh.attributes.get(name) or mesh.attributes.new(name, data_type, "POINT")
    attribute.data.foreach_set(field, flat_floats(values))
