"""Colors of splats under a scene's light, and how much of the recorded ones that light keeps."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from ..avatar.file import Avatar
from ..avatar.offsets import COLOR, OFFSETS
from ..avatar.splats import SH_C0, sh_color
from ..capture.color import linear_to_srgb, srgb_to_linear
from ..capture.mesh_geometry import vertex_normals, weighted_procrustes
from ..errors import StgaError
from .harmonics import COUNT, GLOSSY, LAMBERT, basis, least_squares, rotated
from .lamps import LIFT_M, Lamps, distant_light
from .surface import Bounce, Lashes, at_splats, find_lashes, row_dot, surface_points
from .values import HAIR_ROUGHNESS, SKIN_ROUGHNESS, Caster, Lighting, is_wet

UNLIKE_LIGHT = 0.2
"""Relative difference of two lights from which on nothing is kept."""
ALIKE_AT_SPLAT = 0.25
"""Difference between what arrives at a splat, now and in the capture, up to which all is kept:
other objects' shadows."""
UNLIKE_AT_SPLAT = 0.75
"""The same from which on nothing is kept."""
RIDGE = 1e-6  # Ridge for meshes without light in some harmonics


class Kept(NamedTuple):
    """Colors are fraction · gain · recorded + (1 − fraction) · relit, all linear.

    fraction  0…1, of splats at which about as much arrives as in the capture (`kept_fractions`)
    gain   (3,) the scene's light over the capture's
    """

    fraction: float
    gain: np.ndarray


def kept(recorded: np.ndarray, distant: np.ndarray) -> Kept:
    """The part of recorded colors that is kept, from the capture's and the scene's light (9, 3) of
    lamps far away. They are compared as irradiance by direction, each channel up to a factor."""
    old, new = (LAMBERT[:COUNT, None] * light for light in (recorded, distant))
    gain = np.maximum((old * new).sum(0) / np.maximum((old * old).sum(0), 1e-12), 0)
    same = gain * old
    difference = np.linalg.norm(new - same) / max(float(np.linalg.norm(same)), 1e-12)
    return Kept(1 - float(_smooth_step(np.asarray(difference / UNLIKE_LIGHT))), gain)


def kept_fractions(kept: Kept, arriving: np.ndarray, irradiance: np.ndarray) -> np.ndarray:
    """(N,) float32 of what arrives at splats now, and of what arrived in the capture (N, 3)."""
    same = np.asarray(kept.gain, np.float32) * irradiance
    square = row_dot(arriving - same, arriving - same)
    unlike = np.sqrt(square / np.maximum(row_dot(same, same), np.float32(1e-12)))
    step = _smooth_step((unlike - ALIKE_AT_SPLAT) / (UNLIKE_AT_SPLAT - ALIKE_AT_SPLAT))
    return np.asarray(kept.fraction * (1 - step), np.float32)


def _smooth_step(values: np.ndarray) -> np.ndarray:
    """From 0 to 1 between 0 and 1."""
    values = np.clip(values, 0, 1)
    return values * values * (3 - 2 * values)


def _unit(vectors: np.ndarray) -> np.ndarray:
    # np.linalg.norm is slow where the last axis is short
    length = np.sqrt(row_dot(vectors, vectors))
    return vectors / np.maximum(length, np.float32(1e-12))[:, None]


REFLECTANCE = 0.04
"""Reflectance of skin, eyes and teeth seen straight on: a refractive index of 1.5."""
COVERED_WEIGHT = 1e-3
"""Weight of covered vertices where the turn of the head is found; open ones have 1 more."""
MIN_IRRADIANCE = 0.15
"""Least irradiance that color is divided by, as a fraction of its mean: noise."""
HIGHLIGHT_FRACTION = 0.034
"""Fraction of what arrived in the capture that came back as highlights from skin; it is taken from
recorded colors."""
WET_HIGHLIGHT_FRACTION = 0.14
"""The same from wet eyes."""
MIN_DIFFUSE_FRACTION = 0.1
"""Fraction of recorded colors that remains at least."""
VIEW_MEANS = (1.0, 0.65, 0.195, -0.089375)
"""Degree -> mean of its harmonics over directions that see a surface (cosine above 0.3), relative
to their value straight from the front. Recorded colors are such means."""


class Relighter:
    """An avatar in a scene's light; properties are float32, by splat. Raises StgaError without
    light."""

    def __init__(self, avatar: Avatar) -> None:
        if avatar.light is None:
            raise StgaError(
                "the avatar does not know the light of its capture; `stga relight RUN` estimates it"
            )
        self.avatar = avatar
        self.light = avatar.light
        self.face, self.weights = surface_points(avatar)
        self.corners = np.ascontiguousarray(avatar.faces[self.face])

    @cached_property
    def transfer(self) -> np.ndarray:
        """(N, 9) as `AvatarLight.transfer`."""
        return self._at_splats(self.light.transfer)

    @cached_property
    def occlusion(self) -> np.ndarray:
        """(N,) fraction of the sky that is open."""
        return self._at_splats(self.light.occlusion[:, None])[:, 0]

    @cached_property
    def roughness(self) -> np.ndarray:
        """(N,) of highlights; 0: that of the lighting. Between hair and skin, the nearer counts."""
        corners = self.light.roughness[self.corners]
        mean = self._at_splats(self.light.roughness[:, None])[:, 0]
        hair = np.float32(HAIR_ROUGHNESS) * (mean > HAIR_ROUGHNESS / 2)
        return np.where(corners.max(1) > HAIR_ROUGHNESS / 2, hair, mean)

    @cached_property
    def irradiance(self) -> np.ndarray:
        """(N, 3) of the capture, which recorded colors are divided by."""
        arriving = self._at_splats(self.light.irradiance)
        return np.maximum(arriving, MIN_IRRADIANCE * self.light.irradiance.mean(0))

    @cached_property
    def albedo(self) -> np.ndarray:
        """(N, 3) linear, of the neutral mesh (without what is driven)."""
        return self._albedo(self.diffuse_color)

    @cached_property
    def typical_albedo(self) -> np.ndarray:
        """(3,) to which damping draws albedo; damping keeps it as it is. 1 without."""
        return np.exp(np.log(self.albedo).mean(0)) if self.light.damping else np.ones(3)

    @cached_property
    def diffuse_color(self) -> np.ndarray:
        """(N, 3) recorded sRGB, mean over directions from which a splat is seen."""
        sh = self.avatar.splats.sh
        means = np.repeat(VIEW_MEANS, (1, 3, 5, 7))[: sh.shape[1], None].astype(np.float32)
        normals = vertex_normals(self.avatar.neutral.astype(np.float64), self.avatar.faces)
        inward = -_unit(self._at_splats(normals))
        return sh_color(means * sh, inward).astype(np.float32)

    @cached_property
    def recorded_light(self) -> np.ndarray:
        """(9, 3) of the capture's light in the neutral mesh's axes, mean over time."""
        direct = np.repeat(self.light.transfer.T[..., None].astype(np.float64), 3, axis=2)
        columns = np.stack([each + self.bounce.light(each) for each in direct], axis=1)
        channels = zip(np.moveaxis(columns, 2, 0), self.light.irradiance.T, strict=True)
        return np.stack([least_squares(*each, RIDGE) for each in channels], axis=1)

    @cached_property
    def lashes(self) -> Lashes:
        """What throws shadows beside the mesh."""
        return find_lashes(self.avatar, self.corners, self.weights, self.roughness, self.albedo)

    def lash_casters(self, mesh: np.ndarray, lighting: Lighting) -> tuple[Caster, ...]:
        """The lashes of a head posed as `mesh` (V, 3), if a light throws shadows."""
        shadowed = lighting.shadows and any(light.casts_shadow for light in lighting.lights)
        return (self.lashes.caster(mesh),) if shadowed and len(self.lashes.face) else ()

    def colors(
        self, mesh: np.ndarray, eye: np.ndarray, lighting: Lighting, casters: Sequence[Caster] = ()
    ) -> np.ndarray:
        """(N, 3) float32 sRGB of the splats, (color − 0.5) / SH_C0 their `sh`, not clipped above 1,
        on a posed mesh (V, 3) seen from eye (3,), in meters."""
        return linear_to_srgb(self.radiance(mesh, eye, lighting, casters)).astype(np.float32)

    def radiance(
        self, mesh: np.ndarray, eye: np.ndarray, lighting: Lighting, casters: Sequence[Caster] = ()
    ) -> np.ndarray:
        """(N, 3) float32: the same before sRGB's curve, for a scene's own color management."""
        fraction = {"recorded": 0.0, "mix": lighting.mix, "scene": 1.0}[lighting.mode]
        if not fraction:
            return self._recorded(mesh, eye)
        mesh, eye = (np.asarray(points, np.float64) for points in (mesh, eye))
        lit = self._lit(mesh, eye, lighting, casters)
        lit *= np.float32(2**lighting.exposure) / np.asarray(lighting.white, np.float32)
        return lit if fraction == 1 else fraction * lit + (1 - fraction) * self._recorded(mesh, eye)

    def distant_in_head(self, mesh: np.ndarray, lighting: Lighting) -> tuple[np.ndarray, Kept]:
        """(9, 6) of the world, and of it with lamps far away, in the neutral mesh's axes for a
        posed `mesh`; and what is kept."""
        center = (mesh.max(0) + mesh.min(0)) / 2
        lamps = [distant_light(light, center) for light in lighting.lights]
        distant = lighting.world + sum(lamps, np.zeros((9, 3)))
        # Open vertices, which the jaw moves least, say how the head is turned.
        weights = self.light.occlusion + np.float64(COVERED_WEIGHT)
        mesh = np.asarray(mesh, np.float64)
        turn, _ = weighted_procrustes(mesh, self.avatar.neutral, weights)
        # Both at once: turning them into the head's axes takes longer than the rest.
        both = rotated(np.concatenate([lighting.world, distant], axis=1), turn)
        found = kept(self.recorded_light, both[:, 3:])
        # Other highlights than the capture's are asked for.
        for factor in (lighting.specular, lighting.roughness / SKIN_ROUGHNESS):
            found = found._replace(fraction=found.fraction * max(0.0, 1 - abs(factor - 1)))
        return both.astype(np.float32), found

    def _lit(
        self, mesh: np.ndarray, eye: np.ndarray, lighting: Lighting, casters: Sequence[Caster]
    ) -> np.ndarray:
        vertex_normal = vertex_normals(mesh, self.avatar.faces)
        distant, kept = self.distant_in_head(mesh, lighting)
        world = distant[:, :3]
        casters = (*casters, *self.lash_casters(mesh, lighting))
        lamps = Lamps(lighting, mesh, self.avatar.faces, casters)
        at_vertices = np.maximum(self.light.transfer @ world, 0)
        at_vertices += lamps.irradiance(mesh + LIFT_M * vertex_normal, vertex_normal)
        # All at once, because the places of the vertices in memory are what takes time.
        bounced = self.bounce.light(at_vertices)
        at_splats = self._at_splats(np.concatenate([mesh, vertex_normal, bounced], axis=1))
        points = np.ascontiguousarray(at_splats[:, :3])
        normals = _unit(at_splats[:, 3:6])
        skin = np.float32(max(lighting.roughness, 0.05))
        roughness = np.where(self.roughness > 0, self.roughness, skin)
        lifted = points + LIFT_M * normals
        arriving, highlight = lamps.shade(lifted, normals, eye, roughness, REFLECTANCE)
        arriving += np.maximum(self.transfer @ world, 0) + at_splats[:, 6:]
        if np.any(lighting.world):  # its radiance around the mirrored direction (Karis 2014)
            view = _unit(eye.astype(np.float32) - points)
            cosine = np.maximum(row_dot(normals, view), np.float32(0.02))
            glossy = (GLOSSY[:, None] * lighting.world).astype(np.float32)
            reflection = np.maximum(basis(2 * cosine[:, None] * normals - view) @ glossy, 0)
            x = 1 - roughness
            y = 0.0425 - 0.0275 * roughness
            z = 1.04 - 0.572 * roughness
            w = 0.022 * roughness - 0.04
            part = np.minimum(x * x, np.exp2(np.float32(-9.28) * cosine)) * x + y
            reflected = REFLECTANCE * (z - 1.04 * part) + 1.04 * part + w
            highlight += np.asarray(reflection * (reflected * self.occlusion)[:, None], np.float32)
        color = _with_driven(self.diffuse_color, self.avatar.without_light, mesh)
        albedo = self.albedo if color is self.diffuse_color else self._albedo(color)
        lit = albedo * arriving * np.float32(1 / np.pi)
        lit += np.float32(lighting.specular) * highlight
        if kept.fraction > 0:
            same = np.asarray(kept.gain, np.float32) * self._recorded(mesh, eye)
            lit += kept_fractions(kept, arriving, self.irradiance)[:, None] * (same - lit)
        return lit

    def _albedo(self, color: np.ndarray) -> np.ndarray:
        """(N, 3) of recorded sRGB (N, 3) without what depends on the view."""
        linear = srgb_to_linear(np.maximum(color, 0))
        wet = np.float32(WET_HIGHLIGHT_FRACTION)
        skin = np.float32(HIGHLIGHT_FRACTION)
        fraction = np.where(is_wet(self.roughness), wet, skin)
        highlight = fraction[:, None] * self.irradiance / np.pi
        diffuse = np.maximum(linear - highlight, MIN_DIFFUSE_FRACTION * linear)
        albedo = np.pi * diffuse / self.irradiance
        damping = self.light.damping
        if damping:
            albedo = np.maximum(albedo, 1e-4)
            albedo = albedo ** (1 - damping) * np.exp(np.log(albedo).mean(0)) ** damping
        return albedo.astype(np.float32)

    def _recorded(self, mesh: np.ndarray, eye: np.ndarray) -> np.ndarray:
        """(N, 3) linear colors as trained, seen from `eye`."""
        splats = self.avatar.splats
        direction = _unit(self._at_splats(mesh) - np.asarray(eye, np.float32))
        color = _with_driven(sh_color(splats.sh, direction), self.avatar, mesh)
        return srgb_to_linear(np.maximum(color, 0)).astype(np.float32)

    @cached_property
    def bounce(self) -> Bounce:
        """Light that the head reflects onto itself."""
        return Bounce(self.avatar.neutral, self.avatar.faces, self.light.occlusion)

    def _at_splats(self, values: np.ndarray) -> np.ndarray:
        return at_splats(values, self.corners, self.weights)


def _with_driven(color: np.ndarray, avatar: Avatar, mesh: np.ndarray) -> np.ndarray:
    """Splats' color (N, 3) with that of their triangles on a posed mesh, where there is any; else
    the same array."""
    if not avatar.follows_strain:
        return color
    driven = avatar.frames(mesh).color
    return np.asarray(color + driven[avatar.splats.face]) if driven.shape[1] else color


def albedo_avatar(avatar: Avatar) -> Avatar:
    """The avatar whose colors are albedo in sRGB, whatever the view; without light. Raises
    StgaError."""
    color = linear_to_srgb(np.clip(Relighter(avatar).albedo, 0, 1))
    sh = ((color[:, None] - 0.5) / SH_C0).astype(np.float32)
    moving = {n: each for n, each in avatar.driven_offsets.items() if OFFSETS[n].target != COLOR}
    splats = replace(avatar.splats, sh=sh)
    return replace(avatar, splats=splats, driven_offsets=moving, light=None, linear_base=None)
