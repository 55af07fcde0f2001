"""What the rules ask of a capture, looked up once and only if asked."""

from functools import cached_property

import numpy as np

from ..avatar.strain import GAIN
from ..capture.model import Capture
from ..flame.forward import FlameFrame
from ..flame.sequence import turns
from ..flame.teeth import LOWER_LIP, TEETH_VERTICES, TEMPLATE_VERTICES, UPPER_LIP
from ..selection import select_capture
from ..training.settings import TrainingSettings
from .evidence import CameraColors, Evidence, calm, camera_evidence, fit_cameras, linear_evidence
from .samples import Samples, take_samples

MOST_FRAMES = 64
"""Tracked frames that are looked at for what moves, evenly spread."""


LARGEST = 4.0
"""Errors of more than this many median ones are not the view's doing: lids, lips, teeth."""


class CaptureFacts:
    """A capture with training views, and the settings it is to be trained with."""

    def __init__(self, capture: Capture, settings: TrainingSettings, device: str = "cpu") -> None:
        """device: one of `choose_device`."""
        self.capture, self.settings, self.device = capture, settings, device
        self.views = capture.views["train"]

    @cached_property
    def samples(self) -> Samples:
        return take_samples(self.capture)

    @cached_property
    def cameras(self) -> int:
        """How many cameras there are to train on."""
        return len({view.camera_index for view in self.views})

    @cached_property
    def timesteps(self) -> int:
        """How many timesteps there are to train on."""
        return len({view.timestep for view in self.views})

    @cached_property
    def calm(self) -> np.ndarray:
        """(S, K, 3) sampled colours of the triangles that change little."""
        return calm(self.samples.color.astype(np.float64))

    @cached_property
    def camera_colors(self) -> CameraColors:
        return fit_cameras(self.samples, self.calm)

    @cached_property
    def even(self) -> np.ndarray:
        """(S, K, 3) sampled colours without what the cameras differ by."""
        return self.camera_colors.undo(self.samples.color.astype(np.float64), self.samples.camera)

    @cached_property
    def camera_difference(self) -> Evidence:
        return camera_evidence(self.samples, self.calm)

    @cached_property
    def view_dependence(self) -> Evidence:
        """What the mesh does not follow counts little, because it is no view's doing."""
        each = np.arange(len(self.samples.camera))
        return linear_evidence(self.even, self.samples.direction, each, LARGEST)

    @cached_property
    def strain_dependence(self) -> Evidence:
        return linear_evidence(self.even, self.samples.strain, self.samples.timestep)

    @cached_property
    def pixel_range(self) -> float:
        """How many times wider the widest pixel is than the narrowest, at the head, over the views looked at."""
        return float(self.samples.ground.max() / self.samples.ground.min())

    def pixels_per_splat(self, percentile: float) -> float:
        """Of the triangles that are seen, at the size trained at; 0 where none is."""
        lattice = self.settings.lattice
        pixels = self.samples.pixels[~np.isnan(self.samples.pixels)] * self.settings.scale**2
        return float(np.percentile(pixels, percentile)) / ((lattice + 1) * (lattice + 2) / 2) if len(pixels) else 0.0

    @cached_property
    def beside(self) -> float:
        """Share of the foreground that lies beside the mesh; NaN without masks."""
        return float(self.samples.beside.sum() / max(self.samples.covered.sum(), 1))

    @cached_property
    def outside(self) -> float:
        """Share of the mesh that sticks out of the foreground by two pixels or more; NaN without masks."""
        return float(self.samples.outside.sum() / max(self.samples.mesh.sum(), 1))

    @cached_property
    def selected(self) -> float:
        """Share of the triangles that a frame selects by the settings' rule, on average."""
        chosen = select_capture(self.capture, self.settings.selection)
        return float(np.mean([faces.mean() for faces in chosen.values()]))

    @cached_property
    def strain(self) -> float:
        """Root mean square of how the triangles' stretch changes with time, as a share of their size."""
        strain = self.samples.strain
        return float(np.sqrt(((strain - strain.mean(0)) ** 2).mean())) / GAIN

    @cached_property
    def frames(self) -> list[FlameFrame]:
        """Some of the tracked frames; none without FLAME's parameters."""
        sequence = self.capture.flame
        if sequence is None:
            return []
        count = len(sequence.timesteps)
        chosen = np.unique(np.linspace(0, count - 1, min(count, MOST_FRAMES)).round().astype(int)).tolist()
        return [sequence.frame(sequence.timesteps[n]) for n in chosen]

    def turns(self, *joints: int) -> float:
        """Largest angle in degrees by which one of FLAME's joints is turned."""
        return float(turns(self.frames)[list(joints)].max())

    @cached_property
    def lips(self) -> float:
        """Millimetres by which the lips part at most, beyond what they do in the neutral mesh."""
        capture, upper, lower = self.capture, list(UPPER_LIP), list(LOWER_LIP)
        chosen = capture.timesteps[:: max(1, len(capture.timesteps) // MOST_FRAMES)]
        meshes = [capture.neutral, *(capture.expression_mesh(timestep, "head") for timestep in chosen)]
        gaps = [float(np.linalg.norm(mesh[upper] - mesh[lower], axis=1).max()) for mesh in meshes]
        return 1000 * (max(gaps) - gaps[0])

    @property
    def has_teeth(self) -> bool:
        """Whether the mesh has the rows of teeth that are added to FLAME's."""
        flame = self.capture.flame
        return flame is not None and len(flame.model.v_template) == TEMPLATE_VERTICES + TEETH_VERTICES
