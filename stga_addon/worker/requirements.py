"""Packages that training needs, with bounds; `pyproject.toml` repeats them, which a test compares."""

REQUIREMENTS = {
    "numpy": "numpy>=1.26,<3",
    "torch": "torch>=2.4,<3",
    "numba": "numba>=0.60,<1",
    "scipy": "scipy>=1.11,<2",
    "PIL": "pillow>=10,<14",
    "platformdirs": "platformdirs>=4,<5",
    "trimesh": "trimesh>=4,<6",
    "tqdm": "tqdm>=4.60,<5",
    "filelock": "filelock>=4,<5",
    "matplotlib": "matplotlib>=3.8,<4",
    "av": "av>=14,<19",
}
"""Imported module -> requirement."""
TRACKING_REQUIREMENTS = (
    "numpy>=1.26,<2; python_version < '3.13'",
    "opencv-python-headless>=4.9,<5",
    "absl-py>=2.3,<3",
    "flatbuffers>=25.9,<26",
    "attrs>=23,<27; python_version < '3.13'",
    "certifi>=2024; python_version >= '3.13'",
    "protobuf>=4.25.3,<5; python_version < '3.13'",
)
"""What tracking needs besides: OpenCV for distorted lenses, and what the landmark detector imports."""
DETECTOR_REQUIREMENTS = ("mediapipe==0.10.21; python_version < '3.13'", "mediapipe>=1,<2; python_version >= '3.13'")
"""Installed without dependencies: most of what MediaPipe lists, 600 MB, it imports for other tasks only. 0.10.21 is the
last version with the network in its wheel; newer ones need the user's `face_landmarker.task`."""
GPU_REQUIREMENT = "wgpu>=0.32,<1"
"""Trains on a GPU; without it, or where it has no driver, the CPU trains."""


def package_name(requirement: str) -> str:
    return requirement.partition(">=")[0]
