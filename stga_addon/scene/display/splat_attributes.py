"""Splats and their light as attributes of Blender meshes, written and read back."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any
from uuid import uuid4

import numpy as np

from ...avatar.embedding import face_areas
from ...avatar.file import UNSEEN_REGION, Avatar, AvatarLight
from ...avatar.offsets import OFFSETS
from ...avatar.splats import SH_C0, Splats, in_world, logits
from ...avatar.strain import STRAIN_COMPONENTS, strain_basis
from ...capture.color import srgb_to_linear
from ...flame.quaternions import normalized
from ...light.relight import Relighter
from ...light.values import SKIN_ROUGHNESS
from .. import tags
from ..arrays import flat_floats, read_values

# On the vertices of a splat object.
XYZ = "stga_xyz"
"""Center in the frame of the splat's triangle; without one, in world space in meters."""
ROTATION = "stga_rotation"
"""Unit quaternion wxyz, in the frame of the splat's triangle."""
SCALE = "stga_scale"
"""Standard deviations along the axes, linear, in the unit of XYZ."""
OPACITY = "stga_opacity"
"""Opacity, 0 to 1."""
COLOR = "stga_color"
"""Constant part of the color, scene-linear."""
RELIT_COLOR = "stga_relit_color"
"""Scene-linear color of one frame; where it is there, it counts."""
SH = "stga_sh_{}"
"""sRGB coefficients of the spherical harmonics, by index."""
LINEAR_SH = "stga_linear_sh"
"""Coefficient 0 in place of that in SH, fitted for linear light (`Avatar.linear_base`)."""
LINEAR_OPACITY = "stga_linear_opacity"
"""Opacity in place of OPACITY, fitted for linear light."""
ALBEDO = "stga_albedo"
"""Linear albedo and, as alpha, roughness; only where the capture's light is known."""
FACE = "stga_face"
"""Index of the triangle that the splat is bound to."""
UNSEEN = "stga_unseen"
"""Whether the splat is on a triangle of `UNSEEN_REGION`; only where the avatar knows it."""
NEUTRAL_AREA = "stga_neutral_area"
"""Area of the splat's neutral triangle, m²; also on faces with driven offsets."""
DISPLAY_COLOR = "stga_display_color"
"""Scene-linear color, stored by the nodes."""
WORLD_ROTATION = "rotation"
"""Posed rotation, by the name that Blender's native splats use."""
WORLD_SCALE = "scale"
"""Posed scale, by the name that Blender's native splats use."""
# What else those are drawn from.
RADIANCE = "radiance:base"
"""Coefficient of degree 0, and opacity."""
RADIANCE_SH = "radiance:sh_{}"
"""Coefficients of degrees 1 to 3."""
MIN_OPACITY = 1e-6
"""Least opacity, and least transparency, of what becomes a logit."""
_FIELDS = {
    "FLOAT": ("value", 1),
    "INT": ("value", 1),
    "BOOLEAN": ("value", 1),
    "FLOAT_VECTOR": ("vector", 3),
    "QUATERNION": ("value", 4),
    "FLOAT4": ("vector", 4),
    "FLOAT_COLOR": ("color", 4),
}
"""Data type of an attribute -> name and width of its element's field."""

# On the faces of the neutral mesh, from `StrainBasis`.
TENSOR_HALVES = ("stga_strain_squares", "stga_strain_products")
"""Halves of a symmetric tensor, a vector each: xx yy zz, and xy yz zx."""
GRAM = "stga_gram"
"""Squared lengths and product of the neutral edges, `StrainBasis.gram`."""
TENSOR = "stga_tensor_{}_{}"
"""`StrainBasis.to_tensor`, by component of the Gram matrix's change and half of the tensor."""
PLANE = "stga_plane_{}_{}"
"""`StrainBasis.to_plane`, by component of strain and half of the tensor."""
NEUTRAL_NORMAL = "stga_neutral_normal"
"""Unit normal of the neutral mesh; 0 without area."""
STRAIN_RANGE = "stga_strain_lowest", "stga_strain_highest"
"""Lowest and highest strain that splats follow."""
NORMAL_RANGE = "stga_normal_lowest", "stga_normal_highest"
"""Lowest and highest change of the normal that splats follow."""
_RANGE = tuple(name for ends in zip(STRAIN_RANGE, NORMAL_RANGE, strict=True) for name in ends)
"""Both ranges, in the order of `StrainBasis.range`: the lowest ends, then the highest."""
DRIVEN_OFFSET = "stga_{}_{}"
"""Coefficients of `Avatar.driven_offsets`, by the offset's name and component of its signal."""
Attributes = dict[str, tuple[str, str, np.ndarray]]
"""Name -> (data type, name of the element's field, flat values)."""


@dataclass(frozen=True)
class SplatAttributes:
    """Attributes of vertices of a splat object and of faces of its neutral mesh; light of the
    avatar."""

    splats: Attributes
    neutral: Attributes
    light: AvatarLight | None = None


def avatar_attributes(avatar: Avatar) -> SplatAttributes:
    """What displaying an avatar writes into Blender, found without bpy, so in any thread."""
    areas = face_areas(avatar.neutral, avatar.faces)
    splats = splat_attributes(avatar.splats)
    splats[FACE] = "INT", "value", np.ascontiguousarray(avatar.splats.face, np.int32)
    splats[NEUTRAL_AREA] = _number(areas[avatar.splats.face])
    unseen = avatar.regions.get(UNSEEN_REGION)
    if unseen is not None:
        splats[UNSEEN] = "BOOLEAN", "value", unseen[avatar.splats.face]
    splats |= linear_attributes(avatar) | albedo_attribute(avatar)
    neutral: Attributes = {}  # what nodes need to have splats follow the deformation
    if avatar.follows_strain:
        basis = strain_basis(avatar.neutral, avatar.faces, avatar.strain_range)
        neutral[GRAM] = _vector(basis.gram)
        neutral[NEUTRAL_NORMAL] = _vector(basis.normal.T)
        neutral[NEUTRAL_AREA] = _number(areas)
        ends = basis.range.reshape(-1, 4, 3).swapaxes(0, 1)
        neutral |= {name: _vector(end) for name, end in zip(_RANGE, ends, strict=True)}
        for name, tensors in ((TENSOR, basis.to_tensor), (PLANE, basis.to_plane)):
            for index in range(STRAIN_COMPONENTS):
                for start, half in zip((0, 3), TENSOR_HALVES, strict=True):
                    vector = tensors[:, index, start : start + 3]
                    neutral[name.format(index, half)] = _vector(vector)
        for offset, coefficients in avatar.driven_offsets.items():
            for index, name in enumerate(_offset_names(offset)):
                neutral[name] = _vector(coefficients[:, index])
    return SplatAttributes(splats, neutral, avatar.light)


def linear_attributes(avatar: Avatar) -> Attributes:
    """Attributes of vertices of a splat object that the native display draws in place of the
    trained ones; none where the avatar has none."""
    if avatar.linear_base is None:
        return {}
    opacity = _number(avatar.for_linear_light.splats.opacities())
    return {LINEAR_SH: _vector(avatar.linear_base[:, :3]), LINEAR_OPACITY: opacity}


def albedo_attribute(avatar: Avatar) -> Attributes:
    """Attribute of vertices of a splat object with the albedo that the scene lights; none without a
    light."""
    if avatar.light is None:
        return {}
    relighter = Relighter(avatar)
    roughness = np.where(relighter.roughness > 0, relighter.roughness, SKIN_ROUGHNESS)
    values = np.column_stack([relighter.albedo, roughness])
    return {ALBEDO: ("FLOAT_COLOR", "color", flat_floats(values))}


def _vector(values: np.ndarray) -> tuple[str, str, np.ndarray]:
    return "FLOAT_VECTOR", "vector", flat_floats(values)


def _number(values: np.ndarray) -> tuple[str, str, np.ndarray]:
    return "FLOAT", "value", flat_floats(values)


def splat_attributes(splats: Splats) -> Attributes:
    """The splats' activated values: unit rotations, linear scales, opacities of 0 to 1."""
    dc = np.asarray(splats.sh[:, 0], np.float64)
    linear = srgb_to_linear(np.clip(0.5 + SH_C0 * dc, 0.0, 1.0))
    attributes = {
        XYZ: _vector(splats.xyz),
        ROTATION: ("QUATERNION", "value", flat_floats(normalized(splats.rotation))),
        SCALE: _vector(np.exp(splats.log_scale.astype(np.float64))),
        OPACITY: _number(splats.opacities()),
        COLOR: ("FLOAT_COLOR", "color", flat_floats(with_alpha(linear))),
    }
    for index in range(splats.sh.shape[1]):
        attributes[SH.format(index)] = _vector(splats.sh[:, index])
    return attributes


def with_alpha(color: np.ndarray) -> np.ndarray:
    """(N, 4) of colors (N, 3), as color attributes are stored; opaque."""
    return np.concatenate([color, np.ones((len(color), 1))], axis=1)


def write_splats(mesh: Any, attributes: Attributes) -> None:
    """Give the mesh one vertex per splat, with these attributes, in place."""
    positions = attributes[XYZ][2]
    if len(mesh.vertices) != len(positions) // 3:
        mesh.clear_geometry()
        mesh.vertices.add(len(positions) // 3)
    # Through the attribute, which takes all values at once; `MeshVertex.co` takes them one by one.
    write_attributes(mesh, attributes | {"position": attributes[XYZ]}, "POINT")
    of_earlier_splats = {LINEAR_SH, LINEAR_OPACITY, ALBEDO, UNSEEN, RELIT_COLOR}
    for name in of_earlier_splats - attributes.keys():
        if name in mesh.attributes:
            mesh.attributes.remove(mesh.attributes[name])
    mesh.pop(tags.RELIT_FRAME, None)
    mesh[tags.REVISION] = uuid4().hex
    mesh.update()


def write_attributes(mesh: Any, attributes: Attributes, domain: str) -> None:
    """Set attributes of a mesh on one domain ("POINT", "FACE"); makes those that it lacks."""
    for name, (data_type, field, values) in attributes.items():
        attribute = mesh.attributes.get(name) or mesh.attributes.new(name, data_type, domain)
        attribute.data.foreach_set(field, values)


def read_splats(mesh: Any) -> Splats:
    """The splats in a splat object's mesh, with unit rotations, all bound to their triangles."""
    count = len(mesh.vertices)
    sh = list[np.ndarray]()
    while (name := SH.format(len(sh))) in mesh.attributes:
        sh.append(read_attribute(mesh, name))
    face = FACE in mesh.attributes
    with np.errstate(divide="ignore"):
        return Splats(
            xyz=read_attribute(mesh, XYZ),
            rotation=read_attribute(mesh, ROTATION),
            log_scale=np.log(read_attribute(mesh, SCALE).astype(np.float64)).astype(np.float32),
            opacity=logits(read_attribute(mesh, OPACITY)),
            sh=np.stack(sh, 1),
            face=read_attribute(mesh, FACE) if face else np.zeros(count, np.int32),
            unbound=np.zeros(count, bool),
        )


def read_linear_base(mesh: Any) -> np.ndarray | None:
    """`Avatar.linear_base` as stored in a splat object's mesh."""
    if LINEAR_SH not in mesh.attributes:
        return None
    opacity = logits(read_attribute(mesh, LINEAR_OPACITY))
    return np.column_stack([read_attribute(mesh, LINEAR_SH), opacity])


def read_unseen(mesh: Any) -> np.ndarray | None:
    """(N,) bool: splats on unseen triangles; None where the avatar does not know them."""
    return read_attribute(mesh, UNSEEN) if UNSEEN in mesh.attributes else None


def read_native_splats(cloud: Any) -> Splats | None:
    """The splats of a point cloud, in its object's space; None where Blender draws no splats of
    it. What it lacks is as Blender draws it: no turn, gray, opaque."""
    names = set(cloud.attributes.keys())
    count = len(cloud.points)
    if getattr(cloud, "type", "") != "GAUSSIAN_SPLAT" or WORLD_SCALE not in names or not count:
        return None
    base = np.tile(np.array([0, 0, 0, 1], np.float32), (count, 1))
    rotation = np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1))
    if RADIANCE in names:
        base = read_attribute(cloud, RADIANCE)
    if WORLD_ROTATION in names:
        rotation = read_attribute(cloud, WORLD_ROTATION)
    degree = next(n for n in (3, 2, 1, 0) if n == 0 or RADIANCE_SH.format(n * (n + 2) - 1) in names)
    rest = [read_attribute(cloud, RADIANCE_SH.format(n)) for n in range(degree * (degree + 2))]
    opacity = np.clip(base[:, 3], MIN_OPACITY, 1 - MIN_OPACITY)
    with np.errstate(divide="ignore", invalid="ignore"):
        log_scale = np.log(np.abs(read_attribute(cloud, WORLD_SCALE)))
    return in_world(
        read_attribute(cloud, "position"),
        rotation,
        log_scale,
        logits(opacity),
        np.stack([base[:, :3], *rest], 1),
    )


def read_driven_offsets(neutral: Any) -> dict[str, np.ndarray]:
    """`Avatar.driven_offsets` as stored in a neutral mesh."""
    stored = {name: read_vectors(neutral, _offset_names(name)) for name in OFFSETS}
    return {name: found for name, found in stored.items() if found is not None}


def read_strain_range(neutral: Any) -> np.ndarray | None:
    """`Avatar.strain_range` as stored in a neutral mesh."""
    ends = read_vectors(neutral, _RANGE)
    return None if ends is None else ends.reshape(-1, 2, 6)


def _offset_names(offset: str) -> list[str]:
    return [DRIVEN_OFFSET.format(offset, index) for index in range(STRAIN_COMPONENTS)]


def read_attribute(mesh: Any, name: str) -> np.ndarray:
    """(N,) of an attribute of numbers, (N, 3) of one of vectors, (N, 4) of one of rotations or
    colors."""
    attribute = mesh.attributes[name]
    field, width = _FIELDS[attribute.data_type]
    dtype = {"INT": np.int32, "BOOLEAN": bool}.get(attribute.data_type, np.float32)
    values = read_values(attribute.data, field, width, dtype)
    return values[:, 0] if width == 1 else values


def read_vectors(mesh: Any, names: Sequence[str]) -> np.ndarray | None:
    """(F, len(names), 3) of vector attributes; None where the mesh lacks one."""
    if not all(name in mesh.attributes for name in names):
        return None
    return np.stack([read_attribute(mesh, name) for name in names], 1)


PROPERTY = "stga_light"  # on the neutral mesh: JSON of what is not by vertex
VECTORS = ("stga_transfer_0", "stga_transfer_1", "stga_transfer_2", "stga_irradiance")
NUMBERS = ("stga_occlusion", "stga_roughness")


def write_light(mesh: Any, light: AvatarLight | None) -> None:
    """Store the light in a neutral mesh; None removes what it has."""
    if light is None:
        for name in (*VECTORS, *NUMBERS):
            if name in mesh.attributes:
                mesh.attributes.remove(mesh.attributes[name])
        mesh.pop(PROPERTY, None)
        return
    vectors = *np.split(light.transfer, 3, axis=1), light.irradiance
    attributes = dict(zip(VECTORS, map(_vector, vectors), strict=True))
    numbers = map(_number, (light.occlusion, light.roughness))
    write_attributes(mesh, attributes | dict(zip(NUMBERS, numbers, strict=True)), "POINT")
    rest = {"residual": light.residual, "damping": light.damping, "source": light.source}
    mesh[PROPERTY] = json.dumps(rest | {"radiance": light.radiance.ravel().tolist()})


def read_light(mesh: Any) -> AvatarLight | None:
    """What `write_light` stored; None where it is not there."""
    vectors = read_vectors(mesh, VECTORS)
    if PROPERTY not in mesh or vectors is None or any(n not in mesh.attributes for n in NUMBERS):
        return None
    rest = json.loads(mesh[PROPERTY])
    return AvatarLight(
        radiance=np.array(rest.pop("radiance"), np.float32).reshape(9, 3),
        transfer=vectors[:, :3].reshape(-1, 9),
        occlusion=read_attribute(mesh, NUMBERS[0]),
        irradiance=vectors[:, 3],
        roughness=read_attribute(mesh, NUMBERS[1]),
        **rest,
    )
