"""A video drawn by Blender's GPU and encoded by Blender's FFmpeg, without a rasterizer."""

import shutil
import struct
import zlib
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import bpy
import numpy as np

from ...errors import StgaError
from ...files import replacing
from ...raster.posed_splats import ComposedImage, with_holdouts
from ...render.video import finished, is_video, sequence_files
from ..compat import choose_format, sequencer_strips
from ..gpu.packing import View
from ..layers import SceneLayer
from ..objects import set_frames_per_second
from .engine import draw_image


class DrawnVideo:
    """Draws the images into a folder as PNGs, one call each; `encode` makes the output of them.
    background: sRGB in 0…1; None: transparent in PNGs, black in a video."""

    def __init__(
        self, folder: Path, output: Path, background: tuple[float, float, float] | None
    ) -> None:
        self._folder = folder
        self._output = output
        self._background = background
        self._images: list[Path] = []

    def add(self, layers: Sequence[SceneLayer], view: View) -> None:
        """Draw an image. Raises StgaError where the GPU cannot, or the disk is full."""
        image = with_holdouts(layers, partial(_drawn, view=view))
        path = self._folder / f"{len(self._images) + 1:04d}.png"
        pixels = finished(image, self._background, is_video(self._output))
        with replacing(path) as file:
            file.write_bytes(png_bytes(pixels))
        self._images.append(path)

    def encode(self, fps: float) -> None:
        """Write the video, or copy the PNGs to the output folder, where they replace an earlier
        sequence. Raises StgaError."""
        if is_video(self._output):
            video = self._encoded(fps)
            with replacing(self._output) as file:
                shutil.copyfile(video, file)
            return
        with sequence_files(self._output) as next_file:
            for image in self._images:
                with next_file() as file:
                    shutil.copyfile(image, file)

    def _encoded(self, fps: float) -> Path:
        """The video, encoded beside the images in a scene of its own, which is removed."""
        size = bpy.data.images.load(str(self._images[0]))
        width, height = size.size
        bpy.data.images.remove(size)
        video = self._folder / "video.mp4"
        scene = bpy.data.scenes.new("STGA video")
        render = scene.render
        settings = scene.render.image_settings
        try:
            strips = sequencer_strips(scene)
            strip = strips.new_image("images", str(self._images[0]), 1, 1)
            for image in self._images[1:]:
                strip.elements.append(image.name)
            scene.frame_start = 1
            scene.frame_end = len(self._images)
            # even, as the format needs
            render.resolution_x = width + width % 2
            render.resolution_y = height + height % 2
            render.resolution_percentage = 100
            set_frames_per_second(scene, fps)
            render.use_sequencer = True
            render.use_file_extension = True
            choose_format(settings, "VIDEO", "FFMPEG")
            render.ffmpeg.format = "MPEG4"
            render.ffmpeg.codec = "H264"
            render.ffmpeg.constant_rate_factor = "HIGH"
            scene.view_settings.view_transform = "Standard"
            render.filepath = str(video)
            bpy.ops.render.render(animation=True, scene=scene.name)
        except RuntimeError as error:
            problem = f"Blender could not encode the video ({str(error).strip()})"
            raise StgaError(problem) from error
        finally:
            bpy.data.scenes.remove(scene)
        if not video.is_file():
            raise StgaError("Blender could not encode the video; see the console")
        return video


def _drawn(layers: list[SceneLayer], view: View) -> ComposedImage:
    image = draw_image(layers, view)
    if image is None:
        raise StgaError("The video cannot be drawn: Blender has no GPU context, or it fails")
    return image


def png_bytes(pixels: np.ndarray) -> bytes:
    """A PNG (ISO/IEC 15948) of (H, W, 3 or 4) uint8 sRGB; no pillow is needed."""
    height, width, channels = pixels.shape
    rows = np.zeros((height, 1 + width * channels), np.uint8)  # the filter of each row: none
    rows[:, 1:] = pixels.reshape(height, -1)
    header = struct.pack(">IIBBBBB", width, height, 8, {3: 2, 4: 6}[channels], 0, 0, 0)
    data = zlib.compress(rows.tobytes(), 6)
    chunks = (b"IHDR", header), (b"sRGB", b"\0"), (b"IDAT", data), (b"IEND", b"")
    packed = b"\x89PNG\r\n\x1a\n"
    for kind, data in chunks:
        packed += struct.pack(">I", len(data)) + kind + data
        packed += struct.pack(">I", zlib.crc32(kind + data))
    return packed
