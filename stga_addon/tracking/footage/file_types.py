"""Names of files that footage consists of."""

from pathlib import Path

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".bmp")
VIDEO_SUFFIXES = (".mp4", ".mov", ".mkv", ".avi", ".m4v", ".webm", ".mts", ".mxf")


def is_video(path: Path) -> bool:
    """Whether a path has the name of a video file."""
    return path.suffix.lower() in VIDEO_SUFFIXES
