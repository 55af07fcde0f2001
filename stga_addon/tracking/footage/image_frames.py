"""Frames of one camera that are image files."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...capture.images import image_size, is_plain, read_image, read_mask
from ...capture.model import View
from ...errors import StgaError


@dataclass(frozen=True)
class ImageFrames:
    """`views`: timestep -> the image as recorded, ascending; its camera says how large the image
    must be."""

    views: Mapping[int, View]

    @property
    def timesteps(self) -> tuple[int, ...]:
        return tuple(self.views)

    def require_sizes(self, name: str) -> None:
        """Read the headers of all images. Raises StgaError for one of another size than camera
        `name` has."""
        for timestep, view in self.views.items():
            size, camera = image_size(view.image), view.camera
            if size != (camera.width, camera.height):
                found, expected = f"{size[0]} x {size[1]}", f"{camera.width} x {camera.height}"
                raise StgaError(
                    f"{view.image}: has {found} pixels at timestep {timestep}, but camera {name} has {expected}"
                )

    def image(self, timestep: int) -> np.ndarray:
        return read_image(self.views[timestep])

    def mask(self, timestep: int) -> np.ndarray | None:
        return read_mask(self.views[timestep])

    def source(self, timestep: int) -> str:
        return str(self.views[timestep].image)

    @property
    def files(self) -> tuple[Path, ...]:
        return tuple(view.image for view in self.views.values())

    def file(self, timestep: int) -> Path | None:
        image = self.views[timestep].image
        return image if is_plain(image) else None
