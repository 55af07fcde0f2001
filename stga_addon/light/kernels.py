"""What computes lights and shadows: Numba's kernels, or NumPy's where there is no Numba."""

from importlib.util import find_spec
from typing import Any


def shade_kernels() -> Any:
    """The module with `add_lights`."""
    if find_spec("numba") is None:
        from . import array_kernels

        return array_kernels
    from ..raster.cpu import shade

    return shade


def shadow_kernels() -> Any:
    """The module with `add_depths` and `lit_shares`."""
    if find_spec("numba") is None:
        from . import array_kernels

        return array_kernels
    from ..raster.cpu import shadow

    return shadow
