"""Measurements of a capture that the rules of effects ask for, each made once and only if asked."""

from collections import Counter
from collections.abc import Collection
from dataclasses import replace
from functools import cache, cached_property

import numpy as np

from ...avatar.lattice import splats_per_triangle
from ...capture.mesh_geometry import triangle_normals
from ...capture.model import Capture, View, cameras_at_once, evenly_spread
from ...capture.selection import select_capture
from ...capture.usable_views import without_training_views
from ...flame.forward import FlameFrame
from ...flame.model import JOINTS
from ...flame.parts import PARTS
from ...flame.quaternions import unit
from ...flame.sequence import joint_angles
from ...flame.teeth import lip_gap_m, lip_pairs
from ..settings import TrainingSettings
from . import evidence
from .evidence import CameraColors, Evidence
from .occlusions import covered_views
from .samples import Samples, take_samples

MAX_TIMESTEPS = 64
"""Timesteps that are posed to measure motion, evenly spread."""
MIN_WHITE_FRACTION = 0.1
"""Least fraction of white pixels beside the mesh with which the background is white."""


class CaptureFacts:
    """A capture with training views, and the settings and the device (`choose_device`) it is to be
    trained with; cameras, timesteps: how many there are to train on; has_one_camera: at a time."""

    def __init__(self, capture: Capture, settings: TrainingSettings, device: str = "cpu") -> None:
        self.capture = capture
        self.settings = settings
        self.device = device
        self.views = capture.views["train"]
        self.cameras = len({view.camera_index for view in self.views})
        self.timesteps = len({view.timestep for view in self.views})
        self.has_one_camera = cameras_at_once(self.views) == 1

    @cached_property
    def samples(self) -> Samples:
        return take_samples(self.capture)

    @cached_property
    def covered_views(self) -> list[View]:
        """Training views in which something covers the head."""
        return covered_views(self.capture, self.samples)

    def without(self, left_out: Collection[tuple[int, ...]]) -> "CaptureFacts":
        """The same of the capture without some training views, by (camera index, timestep)."""
        capture = without_training_views(self.capture, left_out)
        facts = CaptureFacts(capture, self.settings, self.device)
        sampled = zip(self.samples.camera.tolist(), self.samples.timestep.tolist(), strict=True)
        rows = np.array([each not in left_out for each in sampled])
        facts.samples = self.samples.of_views(rows)
        return facts

    @cached_property
    def stable_colors(self) -> np.ndarray:
        """(S, K, 3) sampled colors of the triangles that change little."""
        return evidence.stable_colors(self.samples.color.astype(np.float64))

    @cached_property
    def camera_colors(self) -> CameraColors:
        """Against the mean of the cameras that filmed most moments, so that an avatar of photos all
        around and a talk looks as in the talk."""
        found = evidence.fit_cameras(self.samples, self.stable_colors)
        moments = Counter(view.camera_index for view in self.views)
        counts = np.array([moments[camera] for camera in found.camera.tolist()])
        return found.against(counts > counts.max() / 2)

    @cached_property
    def drift(self) -> np.ndarray:
        """(S, 3) gains of the sampled views against their camera's mean."""
        return evidence.fit_drift(self.samples, self._evenly_lit)

    @cached_property
    def drifts(self) -> Evidence:
        return evidence.drift_evidence(self.samples, self._evenly_lit)

    @cached_property
    def _evenly_lit(self) -> np.ndarray:
        """(S, K, 3) stable colors without the differences between cameras, and without what light
        that stays does to a head that turns."""
        colors = self.camera_colors.undo(self.stable_colors, self.samples.camera)
        corners = self.capture.neutral[self.capture.faces[self.samples.faces]]
        normal = unit(triangle_normals(corners), 1e-20)
        return colors / evidence.fit_turning_light(self.samples, colors, normal)

    @cached_property
    def matched_colors(self) -> np.ndarray:
        """(S, K, 3) sampled colors without the differences between cameras, and in time."""
        colors = self.camera_colors.undo(self.samples.color.astype(np.float64), self.samples.camera)
        drifts = self.drifts.gain >= evidence.MIN_EXPOSURE_LEVELS
        return colors / self.drift[:, None] if drifts else colors

    @cached_property
    def strain_dependence(self) -> dict[str, Evidence]:
        """Evidence that colors depend on the strain around their triangle, in the range that the
        other views would train: in left-out "frames", as unseen expressions, and in left-out
        "cameras", as other views of known expressions. A single camera is not left out."""
        samples = self.samples
        strain = samples.signals["smoothed_strain"]
        folds = {"frames": evidence.consecutive_folds(samples.timestep)}
        if not self.has_one_camera:
            folds["cameras"] = evidence.scattered_folds(samples.camera)
        return {
            kind: evidence.linear_evidence(
                self.matched_colors, strain, kind_folds, rest=np.zeros_like(strain[0])
            )
            for kind, kind_folds in folds.items()
        }

    def pixels_per_splat(self, percentile: float) -> float:
        """Percentile over the visible triangles, in trained images; 0 where none is visible."""
        lattice = self.settings.lattice_order(len(self.capture.faces))
        pixels = self.samples.pixels[~np.isnan(self.samples.pixels)] * self.settings.scale**2
        splats = splats_per_triangle(lattice)
        return float(np.percentile(pixels, percentile)) / splats if len(pixels) else 0.0

    @cached_property
    def shows_backdrop(self) -> bool:
        """Whether sampled views without a mask show something else than white behind the head."""
        return bool(
            (self.samples.white[np.isnan(self.samples.foreground)] < MIN_WHITE_FRACTION).any()
        )

    @cached_property
    def backdrop_spread(self) -> float | None:
        """Difference, of 255 levels, of pixels outside the masks within a sampled view and between
        views; None where views have no mask or nothing lies outside."""
        known = ~np.isnan(self.samples.background_spread)
        if np.isnan(self.samples.foreground).any() or not known.any():
            return None
        within = self.samples.background_spread[known]
        backgrounds = self.samples.background[known]
        return float(max(within.max(), abs(backgrounds - backgrounds.mean(0)).max()))

    @property
    def sampled_timesteps(self) -> tuple[int, ...]:
        """At most MAX_TIMESTEPS of the tracked timesteps, evenly spread."""
        return tuple(evenly_spread(self.capture.timesteps, MAX_TIMESTEPS))

    @cached_property
    def sampled(self) -> Capture:
        """The capture at these only; meshes of a head with parts are kept, for its lips."""
        pose = self.capture.expression_mesh
        pose = cache(pose) if self.parts else pose
        return replace(self.capture, timesteps=self.sampled_timesteps, expression_mesh=pose)

    @cached_property
    def selected_fraction(self) -> float:
        """Mean fraction of the triangles that the settings' rule selects in a sampled timestep."""
        chosen = select_capture(self.sampled, self.settings.selection)
        return float(np.mean([faces.mean() for faces in chosen.values()]))

    def signal_change(self, name: str) -> float:
        """Root mean square change of a signal of the triangles over time."""
        signal = self.samples.signals[name]
        return float(np.sqrt(((signal - signal.mean(0)) ** 2).mean()))

    @cached_property
    def frames(self) -> list[FlameFrame]:
        """FLAME's parameters in the sampled timesteps; none for other captures."""
        sequence = self.capture.flame
        return [] if sequence is None else [sequence.frame(t) for t in self.sampled_timesteps]

    def joint_angle(self, *joints: str) -> float:
        """Largest angle in degrees by which one of these of `JOINTS` turns."""
        return float(joint_angles(self.frames)[[JOINTS.index(name) for name in joints]].max())

    @cached_property
    def lip_gap_mm(self) -> float:
        """How far the lips part at most, beyond their distance in the neutral mesh."""
        assert self.capture.flame is not None
        lips = lip_pairs(self.capture.flame.model)
        pose = self.sampled.expression_mesh
        zero_pose = self.settings.selection.zero_pose
        meshes = [self.capture.neutral, *(pose(t, zero_pose) for t in self.sampled_timesteps)]
        gaps = [lip_gap_m(lips, mesh) for mesh in meshes]
        return 1000 * (max(gaps) - gaps[0])

    @property
    def parts(self) -> list[str]:
        """Names of `PARTS` that the head has."""
        flame = self.capture.flame
        return [] if flame is None else [name for name in PARTS if name in flame.model.masks]
