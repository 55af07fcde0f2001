"""Rendering and encoding of images that Blender has recorded."""

from contextlib import AbstractContextManager
from typing import Any

from ..progress import Report, Say, counted
from ..render.device import Composer
from ..render.video import finished, is_video, recorded_images, sequence_writer, video_writer
from ..requests.results import Written
from ..requests.values import RenderRecording


def render_recording(request: RenderRecording, report: Report, say: Say) -> Written:
    """Render the recorded images and write them; the recording is removed.

    A cancelled video is not written; images of a sequence that are finished stay. Raises StgaError.
    """
    try:
        composer = Composer(request.device)
        with _output(request) as write:
            images = recorded_images(request.recording, request.images, composer)
            for image in counted(images, request.images, report, "Rendering", "Image"):
                write(finished(image, request.background, is_video(request.output)))
    finally:
        request.recording.unlink(missing_ok=True)
    return Written(request.output)


def _output(request: RenderRecording) -> AbstractContextManager[Any]:
    return video_writer(request.output, request.fps) if is_video(request.output) else sequence_writer(request.output)
