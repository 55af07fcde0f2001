"""An avatar's light (`AvatarLight`) as attributes of its neutral mesh in Blender."""

import json
from typing import Any

import numpy as np

from ...avatar.file import AvatarLight
from ..arrays import flat_floats, read_values

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
    occlusion, roughness = (read_values(mesh.attributes[name].data, "value", 1)[:, 0] for name in NUMBERS)
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
