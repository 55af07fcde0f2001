"""What a format's writer is given: an avatar, what poses it, and how it plays."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ..avatar.embedding import to_world
from ..avatar.file import Avatar
from ..avatar.splats import Splats
from ..errors import StgaError
from ..flame.sequence import FlameSequence
from .playback import Playback

Meshes = Iterable[tuple[int, np.ndarray]]
"""Pairs of a number and a posed mesh (V, 3) meters."""


@dataclass(frozen=True)
class Content:
    """An avatar to be exported; `meshes` and `sequence` as `export_avatar` takes them."""

    avatar: Avatar
    meshes: Meshes = ()
    sequence: FlameSequence | None = None
    playback: Playback = field(default_factory=Playback)

    def frames(self, path: Path) -> Iterator[tuple[int, Splats]]:
        """The splats in world space on each mesh, with its number.

        Raises StgaError naming `path` where there is no mesh or no splat.
        """
        if not len(self.avatar.splats):
            raise StgaError(f"{path}: the avatar has no splats to export")
        number = None
        for number, mesh in self.meshes:
            yield number, to_world(self.avatar.splats, self.avatar.frames(mesh))
        if number is None:
            raise StgaError(f"{path}: there is no posed mesh to export")

    def first_frame(self, path: Path) -> Splats:
        """The splats in world space on the first mesh. Raises StgaError as `frames`."""
        return next(self.frames(path))[1]
