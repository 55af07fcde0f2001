"""The training loop's body: one view in, one step of the splats out."""

from dataclasses import replace

import numpy as np
import torch

from ..avatar.embedding import face_areas
from ..avatar.lattice import lattice_splats
from ..avatar.splats import Splats
from ..avatar.strain import STRAINS
from ..capture.model import Capture, View
from ..raster.kernels.image_loss import change_background
from ..raster.kernels.rows import distance_limit, scale_limit
from ..raster.render import (
    Parameters,
    Rendering,
    Scratch,
    camera_frames,
    render_backward,
    render_forward,
    touched_tiles,
)
from . import adam
from .density import control_density
from .folder import Checkpoint
from .frames import FrameStore
from .losses import REACH, image_gradient, tile_rectangles, whole_image
from .schedule import learning_rates, sh_degree, trains_globally
from .seeds import hull_seeds
from .settings import Settings
from .state import TrainState, new_state

SPLIT_SHARE = 0.02
"""Largest share of the splats that one round of density control splits."""


class Trainer:
    """A capture's splats in training.

    state      the splats and their optimiser, replaced by density control
    iteration  how many steps were made
    selection  timestep -> (F,) bool triangles that local iterations train; empty or missing means a global one
    """

    def __init__(
        self, capture: Capture, settings: Settings, selection: dict[int, np.ndarray], state: TrainState | None = None
    ) -> None:
        self.capture, self.settings, self.selection = capture, settings, selection
        self.frames = FrameStore(capture, settings.convention, settings.strain_color)
        self.state = new_state(initial_splats(capture, settings)) if state is None else state
        self.iteration, self.visit = 0, -1
        self.initial_count = len(self.state)
        self._scratch = Scratch()
        self._background = np.array(settings.background, np.float32)
        self._lengths = _face_lengths(capture, settings.convention)
        self.last_timestep: int | None = None

    def continue_from(self, checkpoint: Checkpoint) -> None:
        """Take over everything that a step depends on."""
        self.state, self.iteration, self.visit = checkpoint.state, checkpoint.iteration, checkpoint.visit
        self.last_timestep, self.initial_count = checkpoint.last_timestep, checkpoint.initial_count

    def step(self, view: View, target: np.ndarray, progress: float, mask: np.ndarray | None = None) -> float | None:
        """Train one view.

        target (H, W, 3) uint8 over the settings' background; progress is the share of the budget spent; mask (H, W)
        uint8, with which the background may be exchanged.

        Returns the image loss of a global iteration; a local one sees only part of the image and returns None.
        """
        settings, state = self.settings, self.state
        self.visit += view.timestep != self.last_timestep
        self.last_timestep = view.timestep
        focus = None if trains_globally(settings, self.iteration, self.visit, progress) else self._focus(view.timestep)
        background = self._background
        if mask is not None and settings.any_background:
            background = np.random.default_rng([settings.seed, self.iteration]).random(3, np.float32)
            over = self._scratch.take("target", target.shape, np.uint8)
            change_background(target, mask, 255 * self._background, 255 * background, over)
            target = over
        degree = sh_degree(settings, progress)
        rows, screen, loss = self._differentiate(view, target, background, degree, focus)
        self._limit(rows)
        adam.step(state, rows, learning_rates(settings.rates, progress))
        if focus is None:
            state.pull.numpy()[rows] += screen[rows]
            state.seen.numpy()[rows] += 1
        self.iteration += 1
        self._maintain(progress)
        return loss

    def draw(self, view: View, progress: float = 1.0) -> np.ndarray:
        """The view as the splats show it now: a new (3, H, W) float32 image over the background."""
        return self._render(view, self._background, sh_degree(self.settings, progress)).image.copy()

    def _differentiate(
        self, view: View, target: np.ndarray, background: np.ndarray, degree: int, focus: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray, float | None]:
        """Fill the gradients of the rows that matter; returns those rows, their screen pull and the loss."""
        settings, height, width = self.settings, view.camera.height, view.camera.width
        rendering = self._render(view, background, degree, focus)
        if focus is None:
            rectangles = whole_image(height, width)
        else:
            tiles = touched_tiles(rendering, focus)
            rectangles = tile_rectangles(tiles, height, width)
        v_image = self._scratch.take("v_image", (3, height, width))
        l1, ssim = image_gradient(rendering.image, target, rectangles, settings.ssim_weight, v_image)
        rows, screen = render_backward(
            rendering, self.state.arrays(), self.state.face.numpy(), self._seen, v_image,
            Parameters(*(g.numpy() for g in self.state.gradients)), focus=focus, scratch=self._scratch,
        )  # fmt: skip
        loss = (1 - settings.ssim_weight) * l1 + settings.ssim_weight * (1 - ssim)
        return rows, screen, loss if focus is None else None

    def _render(self, view: View, background: np.ndarray, degree: int, focus: np.ndarray | None = None) -> Rendering:
        self._seen = camera_frames(self.frames.of(view.timestep), view.camera)
        return render_forward(
            self.state.arrays(), self.state.face.numpy(), self._seen, degree, background, focus, REACH,
            antialiased=self.settings.antialiased, scratch=self._scratch,
        )  # fmt: skip

    def _focus(self, timestep: int) -> np.ndarray | None:
        """(N,) bool: the splats on this frame's selected triangles; None where nothing is selected."""
        faces = self.selection.get(timestep)
        if faces is None or not faces.any():
            return None
        return np.asarray(faces[self.state.face.numpy()])

    def _limit(self, rows: np.ndarray) -> None:
        settings, state = self.settings, self.state
        face, loose = state.face.numpy(), state.loose.numpy()
        if settings.scale_weight:
            limit = np.float32(settings.scale_limit) * self._lengths
            gradient = state.gradients.log_scale.numpy()
            scale_limit(rows, state.parameters.log_scale.numpy(), face, loose, limit, settings.scale_weight, gradient)
        if settings.distance_weight:
            limit = np.float32(settings.distance_limit) * self._lengths
            gradient = state.gradients.xyz.numpy()
            distance_limit(rows, state.parameters.xyz.numpy(), face, loose, limit, settings.distance_weight, gradient)

    def _maintain(self, progress: float) -> None:
        """Stray resets and density control, when their time has come."""
        settings = self.settings
        if settings.stray_every and self.iteration % settings.stray_every == 0:
            reset_strays(self.state, settings.stray_limit * self._lengths)
        start, end = settings.density_span
        if settings.density_every and self.iteration % settings.density_every == 0 and start <= progress < end:
            room = round(self.initial_count * (1 + settings.growth)) - len(self.state)
            rng = np.random.default_rng([settings.seed, self.iteration])
            self.state = control_density(self.state, room, SPLIT_SHARE, rng)


def initial_splats(capture: Capture, settings: Settings) -> Splats:
    """The lattice on the neutral mesh and, if asked for, hull seeds around it."""
    lattice = lattice_splats(
        capture.neutral, capture.faces, settings.lattice, settings.sh_degree, convention=settings.convention
    )
    strains = STRAINS if settings.strain_color else 0
    lattice = replace(lattice, strain_color=np.zeros((len(lattice), strains, 3), np.float32))
    if not settings.seeds:
        return lattice
    first = capture.views["train"][0].timestep
    views = [view for view in capture.views["train"] if view.timestep == first]
    seeds = hull_seeds(capture, views, settings.convention, settings.sh_degree)
    seeds = replace(seeds, strain_color=np.zeros((len(seeds), strains, 3), np.float32))
    return Splats(*(np.concatenate([getattr(lattice, n), getattr(seeds, n)]) for n in vars(lattice)))


def reset_strays(state: TrainState, limit: np.ndarray) -> int:
    """Put splats that left their triangle's neighbourhood back onto its origin (STGA, training); returns how many.

    limit (F,) in local units. Loose splats may be anywhere. The moments of a position that was reset start anew.
    """
    distance = state.parameters.xyz.norm(dim=1).numpy()
    strays = torch.from_numpy(~state.loose.numpy() & (distance > limit[state.face.numpy()]))
    for tensor in (state.parameters.xyz, state.first.xyz, state.second.xyz):
        tensor[strays] = 0
    return int(strays.sum())


def _face_lengths(capture: Capture, convention: str) -> np.ndarray:
    """Length (F,) that limits are multiples of, in local units."""
    if convention == "gaussian_avatars":
        return np.ones(len(capture.faces), np.float32)
    return np.asarray(np.sqrt(2 * face_areas(capture.neutral, capture.faces)), np.float32)
