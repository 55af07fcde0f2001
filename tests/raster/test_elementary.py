"""Exponential and logarithm of the kernels against numpy in float64."""

import numpy as np

from stga_addon.raster.cpu import jit
from stga_addon.raster.cpu.elementary import exponential, logarithm


@jit
def exponentials(x, out):
    for n in range(np.uint64(len(x))):
        out[n] = exponential(x[n])


@jit
def logarithms(x, out):
    for n in range(np.uint64(len(x))):
        out[n] = logarithm(x[n])


def test_exponential_and_logarithm_are_numpys():
    """Catches a wrong coefficient, digits lost far from zero, and NaN that becomes a number."""
    x = np.concatenate([np.linspace(-86, 88, 20_001), np.arange(-120, 120) * np.log(2) / 2]).astype(
        np.float32
    )
    x = x[(x > -86) & (x < 88)]
    found = np.empty_like(x)
    exponentials(x, found)
    exact = np.exp(x.astype(np.float64))
    assert np.abs(found / exact - 1).max() < 3e-7
    positive = np.concatenate(
        [exact.astype(np.float32), np.linspace(0.5, 2, 20_001, dtype=np.float32)]
    )
    found = np.empty_like(positive)
    logarithms(positive, found)
    exact = np.log(positive.astype(np.float64))
    assert (np.abs(found - exact) / np.maximum(1, np.abs(exact))).max() < 3e-7
    x = np.array([np.nan, np.inf, 1e30, -np.inf, -1e30], np.float32)
    found = np.empty(5, np.float32)
    exponentials(x, found)
    assert np.isnan(found[0])
    assert np.isposinf(found[1:3]).all()
    assert (found[3:] < 1e-37).all()
