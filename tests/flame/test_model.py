"""Reading FLAME model files: every pickle dialect they come in, and everything that must be
refused."""

import codecs
import io
import os
import pickle
import struct
import sys
import types
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import scipy.sparse

from stga_addon.errors import StgaError
from stga_addon.flame.model import key_regions, read_flame
from stga_addon.flame.unpickle import _RestrictedUnpickler, read_pickled_arrays

from .conftest import random_arrays


class _Python2Pickler(pickle._Pickler):  # type: ignore[name-defined,misc]
    """Writes bytes and str as Python 2 did: as one kind of string, which a reader must decode as
    latin1."""

    dispatch: ClassVar = dict(pickle._Pickler.dispatch)  # type: ignore[attr-defined]

    def _save_string(self, value: bytes | str) -> None:
        raw = value if isinstance(value, bytes) else value.encode("latin1")
        self.write(b"T" + struct.pack("<i", len(raw)) + raw)
        self.memoize(value)

    dispatch[bytes] = dispatch[str] = _save_string

    def save_global(self, obj: Any, name: str | None = None) -> None:
        old = {"numpy._core.multiarray": "numpy.core.multiarray"}
        old |= {"copyreg": "copy_reg", "builtins": "__builtin__"}
        module = old.get(obj.__module__, obj.__module__)
        self.write(f"c{module}\n{name or obj.__qualname__}\n".encode())
        self.memoize(obj)

    dispatch |= dict.fromkeys((type, types.FunctionType, types.BuiltinFunctionType), save_global)


def _python2_pickle(value: Any) -> bytes:
    out = io.BytesIO()
    _Python2Pickler(out, protocol=2, fix_imports=False).dump(value)
    return out.getvalue()


@pytest.fixture
def chumpy(monkeypatch: pytest.MonkeyPatch) -> dict[str, type]:
    """Classes that pickle under chumpy's names; the library itself imports on no current Python."""
    made = {}
    for name, module in {"Ch": "ch", "Select": "reordering", "add": "ch_ops"}.items():
        made[name] = type(name, (), {"__module__": f"chumpy.{module}"})
        monkeypatch.setitem(sys.modules, f"chumpy.{module}", types.ModuleType(f"chumpy.{module}"))
        setattr(sys.modules[f"chumpy.{module}"], name, made[name])
    return made


def _with(kind: type, **state: Any) -> Any:
    made = kind()
    made.__dict__.update(state)
    return made


def _assert_model(path: Path, arrays: dict[str, np.ndarray]) -> None:
    model = read_flame(path)
    named = {"j_regressor": "J_regressor", "faces": "f"}
    for name in ("v_template", "shapedirs", "posedirs", "j_regressor", "weights", "faces"):
        np.testing.assert_array_equal(getattr(model, name), arrays[named.get(name, name)])
    assert model.parents.tolist() == [-1, 0, 1, 1, 1]
    assert model.faces.dtype == np.int32
    assert (model.n_identity, model.n_expression) == (9, 3)


@pytest.mark.parametrize("layout", ["csc_matrix", "csr_matrix", "coo_matrix"])
def test_python2_pickle_with_chumpy_and_sparse(tmp_path, chumpy, layout):
    # Catches anything wrong in the dialect of the published files: latin1 strings, chumpy leaves,
    # sparse regressor, Fortran order, big-endian data, and keys that are no arrays (which must not
    # be looked at).
    arrays = random_arrays()
    stored: dict[str, Any] = dict(arrays)
    stored["v_template"] = _with(chumpy["Ch"], x=arrays["v_template"], _dirty_vars={"x"})
    stored["shapedirs"] = _with(chumpy["Ch"], x=np.asfortranarray(arrays["shapedirs"]))
    flat = np.arange(arrays["posedirs"].size)[::-1]
    leaf, shape = arrays["posedirs"].ravel()[::-1].copy(), arrays["posedirs"].shape
    leaf = _with(chumpy["Ch"], x=leaf)
    stored["posedirs"] = _with(chumpy["Select"], a=leaf, idxs=flat, preferred_shape=shape)
    stored["J_regressor"] = getattr(scipy.sparse, layout)(arrays["J_regressor"])
    stored["weights"] = arrays["weights"].astype(">f8")
    stored["bs_style"] = "lbs"
    stored["J"] = _with(chumpy["add"], a=1, b=2)
    path = tmp_path / "generic_model.pkl"
    data = _python2_pickle(stored)
    assert b"copy_reg" in data or b"__builtin__" in data or b"chumpy.ch\nCh" in data
    path.write_bytes(data)
    _assert_model(path, arrays)


@pytest.mark.parametrize("protocol", range(6))
def test_every_pickle_protocol(tmp_path: Path, protocol: int) -> None:
    """Catches a protocol whose way of storing arrays (text, codecs, buffers) is not understood, and
    a reader that knows only one numpy's private module names."""
    arrays, path = random_arrays(), tmp_path / "model.pkl"
    sparse = scipy.sparse.csc_matrix(arrays["J_regressor"])
    stored = dict(arrays, J_regressor=sparse, n_identity=np.int64(9))
    path.write_bytes(pickle.dumps(stored, protocol=protocol))
    _assert_model(path, arrays)
    data = pickle.dumps(arrays, protocol=0)
    for old, new in ((b"numpy.core.", b"numpy._core."), (b"numpy._core.", b"numpy.core.")):
        path.write_bytes(data.replace(old, new))
        _assert_model(path, arrays)


def test_npz_with_masks_and_identity_count(tmp_path: Path) -> None:
    """Catches npz models whose own masks or identity count are ignored, and a wrong split of
    FLAME's published layout."""
    arrays = random_arrays()
    path = tmp_path / "model.npz"
    np.savez(path, **random_arrays(vertices=10, components=400))
    model = read_flame(path)
    assert (model.n_identity, model.n_expression) == (300, 100)
    corners = np.unique(arrays["f"][:20])
    np.savez(path, **arrays, n_identity=5, **{"masks/nose": arrays["f"][3], "masks/lips": corners})
    model = read_flame(path)
    assert (model.n_identity, model.n_expression) == (5, 7)
    regions = key_regions(model)
    assert set(regions) == {"nose", "mouth"}
    expected = [set(face) <= set(corners) for face in arrays["f"].tolist()]
    assert regions["mouth"].tolist() == expected
    assert regions["nose"][3]


def test_mask_file_beside_the_model(tmp_path: Path) -> None:
    # Catches masks that are not picked up, and eye regions that miss the eyeballs.
    arrays = random_arrays()
    path = tmp_path / "model.pkl"
    path.write_bytes(pickle.dumps(arrays))
    names = "left_eye_region", "left_eyeball", "right_eyeball"
    regions = dict(zip(names, arrays["f"][:3], strict=True))
    (tmp_path / "FLAME_masks.pkl").write_bytes(_python2_pickle(regions))
    keys = key_regions(read_flame(path))
    assert keys["left_eye"][[0, 1]].all()
    assert keys["right_eye"][2]
    assert "mouth" not in keys


class _Attack:
    def __init__(self, call: Any, *arguments: Any) -> None:
        self.call, self.arguments = call, arguments

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        return self.call, self.arguments


@pytest.mark.parametrize(("attack", "name"), [
    (_Attack(os.system, "touch {}"), "posix.system"),
    (_Attack(eval, "open('{}', 'w')"), "builtins.eval"),
    (_Attack(getattr, "text", "format"), "builtins.getattr"),
    (_Attack(np.load, "{}"), "numpy.load"), (_Attack(scipy.sparse.load_npz, "{}"), "load_npz"),
    (_Attack(pickle.loads, b"N."), "_pickle.loads"),
    (_Attack(bytearray, 10**15), "builtins.bytearray"),
], ids=lambda value: value if isinstance(value, str) else "")  # fmt: skip
@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_other_classes_are_refused_by_name(tmp_path, attack, name, protocol):
    # Catches a pickle that gets anything executed: the witness file must not appear, and the class
    # must be named.
    witness = tmp_path / "witness"
    texts = (a.format(witness) if isinstance(a, str) else a for a in attack.arguments)
    attack.arguments, path = tuple(texts), tmp_path / "model.pkl"
    stored = dict(random_arrays(), extra=attack)
    path.write_bytes(pickle.dumps(stored, protocol=protocol, fix_imports=False))
    with pytest.raises(StgaError, match=f"model.pkl.*{name.replace('.', '[.]')}"):
        read_flame(path)
    assert not witness.exists()


@pytest.mark.parametrize("name", [
    "_codecs\nencode", "copy_reg\n_reconstructor", "numpy.core.multiarray\n_reconstruct",
    "__builtin__\nset",
])  # fmt: skip
@pytest.mark.parametrize("state", [b"}S'left'\nI1\ns", b"N}S'_call'\nI1\ns\x86"])
def test_functions_cannot_be_changed(tmp_path: Path, name: str, state: bytes) -> None:
    """Catches a pickle that sets attributes of a function by BUILD, which would outlive its
    reading."""
    path = tmp_path / "model.pkl"
    path.write_bytes(b"\x80\x02c" + name.encode() + b"\n" + state + b"b.")
    with pytest.raises(StgaError, match="sets attributes of a function"):
        read_pickled_arrays(path)
    for method in (vars(_RestrictedUnpickler)[name] for name in ("encode", "rebuild")):
        assert vars(method) == {}
    assert not hasattr(codecs.encode, "left")
