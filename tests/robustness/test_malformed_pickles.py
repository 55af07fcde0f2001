"""Pickles of FLAME models made to break their reader: lies about size, code that must not be
executed."""

import pickle
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flame.conftest import random_arrays

from stga_addon.flame.model import read_flame
from stga_addon.flame.unpickle import read_pickled_arrays

from .limits import behaves


def pickled(value: bytes, key: bytes = b"v_template") -> bytes:
    return b"\x80\x02}U" + bytes([len(key)]) + key + value + b"s."


PICKLES = {
    "list of itself": pickled(b"]q\x01h\x01a"),
    "changes a function": pickled(b"c_codecs\nencode\nN}U\x0c__defaults__K\x05\x85s\x86b"),
    "bytes of gigabytes": pickled(b"\x8e" + struct.pack("<Q", 10**15)),
    "array of gigabytes": pickled(b"\x96" + struct.pack("<Q", 10**12)),
    "frame of gigabytes": b"\x80\x04\x95" + struct.pack("<Q", 10**15) + b"N.",
    "number of megabytes": pickled(b"\x8b" + struct.pack("<L", 2_000_000) + b"\x7f" * 2_000_000),
    "number as text": pickled(b"L" + b"9" * 1_000_000 + b"L\n"),
    "runs a command": pickled(b"cos\nsystem\nU\x0dtouch witness\x85R"),
    "runs a command by another name": pickled(b"cnumpy.core.multiarray\n_reconstruct.__globals__\n"),
    "runs by inheritance": pickled(b"cposix\nsystem\nU\x0dtouch witness\x85\x81"),
    "extension registry": pickled(b"\x82\x01"),
}  # fmt: skip


@pytest.mark.parametrize("name", PICKLES)
def test_pickles(tmp_path: Path, name: str) -> None:
    """Catches pickles whose size is a lie, that run what they name, or that never end."""
    path = tmp_path / "a.pkl"
    path.write_bytes(PICKLES[name])
    assert behaves(lambda: read_flame(path), tmp_path)
    behaves(lambda: read_pickled_arrays(path), tmp_path)
    assert not Path("witness").exists()


class Sparse:
    """Pickles as a scipy.sparse matrix of whatever state."""

    __module__, __qualname__ = "scipy.sparse._csc", "csc_matrix"

    def __init__(self, **state: Any) -> None:
        self.__dict__.update(state)


@pytest.mark.parametrize("shape", [(10**5, 10**5), (20_000, 10_000), (5, 10**18), (10**4, -1)])
def test_sparse_matrices_that_would_be_large(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int]
) -> None:
    """Catches a matrix of a few entries filled in to gigabytes."""
    import scipy.sparse

    monkeypatch.setattr(scipy.sparse._csc, "csc_matrix", Sparse)
    empty = np.zeros(0, np.int32)
    matrix = Sparse(_shape=shape, data=empty, indices=empty, indptr=np.zeros(1, np.int32))
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps({"v_template": matrix}, 4))
    assert "v_template" in behaves(lambda: read_pickled_arrays(path, ("v_template",)), tmp_path)


@pytest.mark.parametrize("shape", [(-1, -6), ("a",), (10**400,), (2, 3, None), (1,) * 70])
def test_shapes_that_are_none(tmp_path: Path, shape: tuple[Any, ...]) -> None:
    """Catches arithmetic on shapes that are not numbers, not positive or of too many axes."""
    path = tmp_path / "a.pkl"
    code = pickle.dumps({"v_template": np.arange(6.0)}, 2)
    path.write_bytes(code.replace(pickle.dumps((6,), 2)[2:-1], pickle.dumps(shape, 2)[2:-1]))
    behaves(lambda: read_flame(path), tmp_path)


def test_a_pickle_leaves_nothing_behind(tmp_path: Path) -> None:
    """Catches a file that changes how later files are read: pickles may set attributes of functions
    they name."""
    good, bad = tmp_path / "good.pkl", tmp_path / "bad.pkl"
    good.write_bytes(pickle.dumps(random_arrays(), 2))
    bad.write_bytes(PICKLES["changes a function"])
    before = read_flame(good)
    behaves(lambda: read_flame(bad), tmp_path)
    np.testing.assert_array_equal(read_flame(good).v_template, before.v_template)
