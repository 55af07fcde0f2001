"""Packages that tracking and training need, with bounds; `pyproject.toml` repeats them, which a test compares."""

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
    "cv2": "opencv-python-headless>=4.12,<5",
}
"""Imported module -> requirement."""
GPU_REQUIREMENT = "wgpu>=0.32,<1"
"""Trains on a GPU; without it, or where it has no driver, the CPU trains."""


def package_name(requirement: str) -> str:
    return requirement.partition(">=")[0]
