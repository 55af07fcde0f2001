"""FLAME's forward pass in torch, batched over frames and differentiable: an independent witness of
`flame.forward`."""

from dataclasses import dataclass

import torch

from stga_addon.flame.model import JOINTS, FlameModel


@dataclass(frozen=True)
class FlameTensors:
    """A `FlameModel`'s arrays as tensors of one dtype; shapes as there."""

    v_template: torch.Tensor
    shapedirs: torch.Tensor
    posedirs: torch.Tensor
    j_regressor: torch.Tensor
    weights: torch.Tensor
    parents: tuple[int, ...]


def flame_tensors(model: FlameModel, dtype: torch.dtype = torch.float32) -> FlameTensors:
    """The model's arrays on the CPU."""
    names = ("v_template", "shapedirs", "posedirs", "j_regressor", "weights")
    tensors = {name: torch.as_tensor(getattr(model, name), dtype=dtype) for name in names}
    return FlameTensors(**tensors, parents=tuple(model.parents.tolist()))


def axis_angle_matrices(axis_angle: torch.Tensor) -> torch.Tensor:
    """Rotation matrices (..., 3, 3) of axis-angle vectors (..., 3) in radians; the gradient at zero
    is finite."""
    squared = (axis_angle**2).sum(-1)
    small = squared < 1e-6
    # The slope of sqrt is infinite at zero, and `where` would multiply it by zero, which is NaN.
    angle = torch.where(small, torch.ones_like(squared), squared).sqrt()
    first = torch.where(small, 1 - squared / 6 + squared**2 / 120, angle.sin() / angle)
    half = (angle / 2).sin() / angle
    second = torch.where(small, 0.5 - squared / 24 + squared**2 / 720, 2 * half**2)
    x, y, z = axis_angle.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1)
    cross = cross.reshape(*axis_angle.shape, 3)
    identity = torch.eye(3, dtype=axis_angle.dtype, device=axis_angle.device)
    return identity + first[..., None, None] * cross + second[..., None, None] * (cross @ cross)


def flame_forward(
    flame: FlameTensors, shape: torch.Tensor, expr: torch.Tensor, pose: torch.Tensor,
    translation: torch.Tensor, offset: torch.Tensor,
) -> torch.Tensor:  # fmt: skip
    """Vertices (T, V, 3) in meters of T frames: shape (I,); expr (T, E); pose (T, 5, 3) axis-angle
    of root, neck, jaw, left eye, right eye; translation (T, 3); offset (V, 3), static plus
    dynamic."""
    frames = len(expr)
    coefficients = torch.cat([shape.expand(frames, -1), expr], 1)
    shaped = flame.v_template + torch.einsum("vck,tk->tvc", flame.shapedirs, coefficients) + offset
    joints = flame.j_regressor @ shaped
    rotations = axis_angle_matrices(pose)
    identity = torch.eye(3, dtype=pose.dtype, device=pose.device)
    feature = (rotations[:, 1:] - identity).flatten(1)
    corrected = shaped + torch.einsum("vcp,tp->tvc", flame.posedirs, feature)
    world_rotation = [rotations[:, 0]]
    world_joint = [joints[:, 0]]
    for joint in range(1, len(JOINTS)):
        parent = flame.parents[joint]
        bone = (joints[:, joint] - joints[:, parent])[:, :, None]
        world_joint.append(world_joint[parent] + (world_rotation[parent] @ bone)[:, :, 0])
        world_rotation.append(world_rotation[parent] @ rotations[:, joint])
    rotation, position = torch.stack(world_rotation, 1), torch.stack(world_joint, 1)
    moved = position - (rotation @ joints[..., None])[..., 0]
    skin = torch.einsum("vj,tjab->tvab", flame.weights, rotation)
    posed = (skin @ corrected[..., None])[..., 0] + flame.weights @ moved
    return posed + translation[:, None]
