"""Reading arrays from a pickle without running any code that it names.

FLAME's model files are Python 2 pickles of numpy arrays, scipy.sparse matrices and chumpy objects.
A pickle may name any function and have it called. Here every global of a short list is replaced by
an inert class or function defined in this module, and any other is refused by name. Neither numpy's
own reconstruction nor scipy or chumpy is used.
"""

import io
import math
import pickle
import re
from collections import OrderedDict
from collections.abc import Callable
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from ..errors import StgaError
from ..files import CHANGED_LINE_ENDS, line_ends_changed, read_bytes

MAX_FILE_BYTES = 2 << 30
MAX_DENSE_ELEMENTS = 1 << 22  # Elements of a sparse matrix; FLAME's joint regressor has 25,115
MAX_LISTED = 1 << 18  # Values in lists; FLAME has 29,928 corners of triangles
MAX_OPCODES = 1 << 20  # FLAME has some 200,000; one of a byte may make an object of 216 bytes
MAX_DEPTH = 32  # Largest depth of nested tuples, and of nested lists
SPARSE_CLASS = re.compile(
    r"scipy\.sparse(\._?(csc|csr|coo))?\.(?P<format>csc|csr|coo)_(matrix|array)"
)
CHUMPY_CLASS = re.compile(r"chumpy(\.\w+)+")


class _NotAnArray(pickle.UnpicklingError):
    """A pickled value that cannot become an array; the message completes 'is ...'."""


class _Inert:
    """Stands for an object of the class `source`: keeps its arguments and state, does nothing."""

    source = "object"
    arguments: tuple[Any, ...] = ()
    state: Any = None

    def __new__(cls, *arguments: Any, **keywords: Any) -> "_Inert":
        made = super().__new__(cls)
        made.arguments = arguments
        return made

    def __init__(self, *arguments: Any, **keywords: Any) -> None:
        pass

    def __setstate__(self, state: Any) -> None:
        self.state = state


@cache
def _inert(source: str) -> type[_Inert]:
    return type("_Inert", (_Inert,), {"source": source})


ARRAY = "numpy.ndarray"
DTYPE = "numpy.dtype"
SCALAR = "numpy.scalar"
BUFFER = "numpy.frombuffer"  # an array of pickle protocol 5: buffer, dtype, shape, order
CORES = ("numpy.core", "numpy._core")
BUILTINS = ("__builtin__", "builtins")
CLASSES = {
    ARRAY: ARRAY,
    DTYPE: DTYPE,
    **{f"{core}.multiarray.scalar": SCALAR for core in CORES},
    **{f"{core}.numeric._frombuffer": BUFFER for core in CORES},
    **{f"{module}.object": "object" for module in BUILTINS},
}


class _Refused(Exception):
    """A global outside the list; the message is its name."""


class _Function:
    """A function that a pickle may call but not change: BUILD would write into its `__dict__`."""

    __slots__ = ("_call",)

    def __init__(self, call: Callable[..., Any]) -> None:
        self._call = call

    def __call__(self, *arguments: Any) -> Any:
        return self._call(*arguments)

    def __setstate__(self, state: Any) -> None:
        raise pickle.UnpicklingError("sets attributes of a function")


def _bounded(load: Callable[[Any], None]) -> Callable[[Any], None]:
    """The opcode of a tuple, which Python would hash recursively and without end in C."""

    def load_bounded(unpickler: Any) -> None:
        load(unpickler)
        _check_nested(unpickler.stack[-1], tuple)

    return load_bounded


def _load_bytearray(unpickler: Any) -> None:
    """Load at most as many bytes as the file holds; the library allocates what the opcode
    promises."""
    unpickler.append(bytearray(unpickler.read(int.from_bytes(unpickler.read(8), "little"))))


class _Counted(dict[int, Any]):
    """Opcodes, of which a limited number is carried out."""

    left = MAX_OPCODES

    def __getitem__(self, opcode: int) -> Any:
        self.left -= 1
        if self.left < 0:
            raise pickle.UnpicklingError(f"more than {MAX_OPCODES} opcodes")
        return super().__getitem__(opcode)


class _RestrictedUnpickler(pickle._Unpickler):
    """The one in Python: that in C allocates memo slots by their numbers, gigabytes of them."""

    dispatch: ClassVar[Any] = {
        **pickle._Unpickler.dispatch,
        **{
            opcode[0]: _bounded(pickle._Unpickler.dispatch[opcode[0]])
            for opcode in (pickle.TUPLE, pickle.TUPLE1, pickle.TUPLE2, pickle.TUPLE3)
        },
        pickle.BYTEARRAY8[0]: _load_bytearray,
    }

    def __init__(self, data: bytes) -> None:
        super().__init__(io.BytesIO(data), encoding="latin1")
        vars(self)["dispatch"] = _Counted(self.dispatch)
        functions: dict[str, Callable[..., Any]] = {
            "_codecs.encode": self.encode,
            "collections.OrderedDict": OrderedDict,
            # numpy's own would allocate the shape at once; the contents arrive with the state
            **{f"{core}.multiarray._reconstruct": lambda *_: _inert(ARRAY)() for core in CORES},
            **{f"{module}._reconstructor": self.rebuild for module in ("copy_reg", "copyreg")},
            **{f"{module}.set": set for module in BUILTINS},
        }
        self.functions = {name: _Function(call) for name, call in functions.items()}

    def find_class(self, module: str, name: str) -> Any:
        wanted = f"{module}.{name}"
        if wanted in self.functions:
            return self.functions[wanted]
        if wanted in CLASSES or SPARSE_CLASS.fullmatch(wanted) or CHUMPY_CLASS.fullmatch(wanted):
            return _inert(CLASSES.get(wanted, wanted))
        raise _Refused(wanted)

    def persistent_load(self, pid: Any) -> Any:
        raise pickle.UnpicklingError("asks for objects outside the file")

    def rebuild(self, kind: Any, base: Any, state: Any) -> _Inert:
        if not (isinstance(kind, type) and issubclass(kind, _Inert)):
            raise pickle.UnpicklingError("rebuilds an object that is not an array")
        return kind()

    def encode(self, text: str, encoding: str = "latin1") -> bytes:
        if encoding not in ("latin1", "latin-1"):
            raise pickle.UnpicklingError(f"encodes bytes as {encoding}")
        return text.encode("latin1")


def read_pickled_arrays(path: Path, names: tuple[str, ...] | None = None) -> dict[str, np.ndarray]:
    """The arrays of a pickled dictionary, dense, by key; `names` limits which entries are looked
    at.

    A name such as "a/b" means the entry b of the dictionary a. scipy.sparse matrices are densified
    and chumpy objects replaced by their value. Raises StgaError where the file is missing,
    truncated, too large, no dictionary of arrays, or asks for any other class (named in the
    message).
    """
    data = read_bytes(path, MAX_FILE_BYTES)
    try:
        loaded = _RestrictedUnpickler(data).load()
    except _Refused as error:
        if line_ends_changed(data):
            raise StgaError(f"{path}: {CHANGED_LINE_ENDS}") from error
        refused = f"asks for the class {error}, refused: only arrays are read"
        raise StgaError(f"{path}: {refused}") from error
    except Exception as error:  # a damaged pickle raises anything from the opcodes that it spells
        if line_ends_changed(data):
            raise StgaError(f"{path}: {CHANGED_LINE_ENDS}") from error
        reason = str(error) if isinstance(error, pickle.UnpicklingError) else "damaged, or cut off"
        raise StgaError(f"{path}: is not a readable pickle of arrays ({reason})") from error
    if not isinstance(loaded, dict):
        raise StgaError(f"{path}: holds a {type(loaded).__name__}, expected a dictionary of arrays")
    arrays = {}
    for key in names if names is not None else [name for name in loaded if isinstance(name, str)]:
        folder, _, name = ("", "", key) if key in loaded else key.rpartition("/")
        entries = loaded
        for part in folder.split("/") if folder else ():
            found = entries.get(part)
            entries = found if isinstance(found, dict) else {}
        if name not in entries:
            continue
        try:
            arrays[key] = _dense(entries[name])
        except Exception as error:  # shapes, indices and states are whatever the file says
            wrong = error if isinstance(error, _NotAnArray) else f"malformed ({error})"
            raise StgaError(f"{path}: {key} is {wrong}, expected an array of numbers") from error
    return arrays


def _check_nested(value: Any, kind: Any) -> None:
    """Raise _NotAnArray for tuples or lists in each other that unfold to too many values, or are
    too deep."""
    level: list[Any] = [value]
    for _ in range(MAX_DEPTH):
        inner = [each for each in level if isinstance(each, kind)]
        if not inner:
            return
        if sum(map(len, inner)) > MAX_LISTED:
            break
        level = list(chain.from_iterable(inner))
    raise _NotAnArray("a list of lists that are too many, or too deep")


def _plain(value: Any) -> Any:
    """Lists in lists, with numpy's numbers and arrays in them as such."""
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return _leaf(value) if isinstance(value, _Inert) else value


def _dense(value: Any) -> np.ndarray:
    source = value.source if isinstance(value, _Inert) else ""
    if sparse := SPARSE_CLASS.fullmatch(source):
        return _sparse(value, sparse["format"])
    return _chumpy(value) if CHUMPY_CLASS.fullmatch(source) else _leaf(value)


def _leaf(value: Any) -> np.ndarray:
    """The array in a value that refers to no other value. Parts of matrices must be such: chains of
    references could take for ever."""
    source = value.source if isinstance(value, _Inert) else type(value).__name__
    if source == ARRAY:
        if not isinstance(value.state, tuple) or len(value.state) < 4:
            raise _NotAnArray("an incomplete array")
        shape, dtype, fortran, raw = value.state[-4:]
        return _from_bytes(raw, _dtype(dtype), shape, "F" if fortran else "C")
    if source == BUFFER:
        if len(value.arguments) != 4:
            raise _NotAnArray("an incomplete array")
        raw, dtype, shape, order = value.arguments
        return _from_bytes(raw, _dtype(dtype), shape, "F" if order == "F" else "C")
    if source == SCALAR and len(value.arguments) == 2:
        return _from_bytes(value.arguments[1], _dtype(value.arguments[0]), (), "C")
    if isinstance(value, list | tuple | int | float):
        _check_nested(value, list | tuple)
        try:
            plain = np.asarray(_plain(value))
        except (ValueError, OverflowError) as error:
            raise _NotAnArray("a ragged list") from error
        if plain.dtype.kind in "biuf":
            return plain
    raise _NotAnArray(f"a {source}")


def _from_bytes(raw: Any, dtype: np.dtype[Any], shape: Any, order: str) -> np.ndarray:
    if isinstance(raw, str):  # Python 2 bytes, read as latin1
        raw = raw.encode("latin1")
    if not isinstance(raw, bytes | bytearray):
        raise _NotAnArray("an array of objects")
    if not isinstance(shape, tuple) or not all(isinstance(n, int) and n >= 0 for n in shape):
        raise _NotAnArray("an array without a shape")
    if len(raw) != math.prod(shape) * dtype.itemsize:
        raise _NotAnArray(f"an array of shape {shape} with {len(raw)} bytes of data")
    flat = np.frombuffer(raw, dtype).astype(dtype.newbyteorder("="))
    return flat.reshape(shape[::-1]).T if order == "F" else flat.reshape(shape)


def _dtype(value: Any) -> np.dtype[Any]:
    is_dtype = isinstance(value, _Inert) and value.source == DTYPE
    code = value.arguments[0] if is_dtype and value.arguments else None
    if not isinstance(code, str):
        raise _NotAnArray("an array of unknown type")
    if not re.fullmatch(r"[iu][1248]|f[248]|b1", code):
        raise _NotAnArray(f"an array of type {code}")
    order = value.state[1] if isinstance(value.state, tuple) and len(value.state) > 1 else "="
    return np.dtype(code).newbyteorder(">" if order == ">" else "<")


def _sparse(value: _Inert, form: str) -> np.ndarray:
    """Dense (rows, columns) matrix of a pickled compressed (csc, csr) or coordinate (coo) one."""
    state = value.state if isinstance(value.state, dict) else {}
    shape: Any = state.get("_shape", state.get("shape"))
    is_shape = isinstance(shape, tuple) and len(shape) == 2
    if not is_shape or not all(isinstance(n, int) and n >= 0 for n in shape):
        raise _NotAnArray("a sparse matrix without a shape")
    if math.prod(shape) > MAX_DENSE_ELEMENTS:
        raise _NotAnArray(f"a sparse matrix of shape {shape}, too large to fill in")
    data = _leaf(state.get("data"))
    if form == "coo":
        coords = state.get("coords", ())
        pair = coords if len(coords) == 2 else (state.get("row"), state.get("col"))
        rows, columns = map(_integers, pair)
    else:
        inner = _integers(state.get("indices"))
        starts = _integers(state.get("indptr"))
        counts = np.diff(starts)
        if len(starts) == 0 or (counts < 0).any() or counts.sum() != len(inner):
            raise _NotAnArray("a sparse matrix whose index pointers do not match its indices")
        outer = np.repeat(np.arange(len(counts)), counts)
        rows, columns = (inner, outer) if form == "csc" else (outer, inner)
    if not (data.shape == rows.shape == columns.shape):
        raise _NotAnArray("a sparse matrix whose indices do not match its data")
    for indices, size in zip((rows, columns), shape, strict=True):
        if len(data) and not 0 <= indices.min() <= indices.max() < size:
            raise _NotAnArray("a sparse matrix with indices outside its shape")
    dense = np.zeros(shape, np.float64)
    np.add.at(dense, (rows, columns), data)  # an entry may be there twice, meaning their sum
    return dense


def _integers(value: Any) -> np.ndarray:
    array = _leaf(value)
    if array.dtype.kind not in "iu" or array.ndim != 1:
        raise _NotAnArray("a sparse matrix with broken indices")
    return array.astype(np.int64)


def _chumpy(value: _Inert) -> np.ndarray:
    """The value of a chumpy leaf (`x`) or of a selection of a leaf's elements (`a`, `idxs`)."""
    state = value.state if isinstance(value.state, dict) else {}
    if "x" in state:
        return _dense(state["x"])
    if "a" in state and "idxs" in state:
        source = _dense(state["a"]).ravel()
        chosen = _leaf(state["idxs"])
        inside = not chosen.size or 0 <= chosen.min() <= chosen.max() < source.size
        if chosen.dtype.kind not in "iu" or not inside:
            raise _NotAnArray(f"a {value.source} with indices outside its array")
        picked: np.ndarray = source[chosen]
        shape: Any = state.get("preferred_shape")
        fits = isinstance(shape, tuple) and math.prod(shape) == picked.size
        return picked.reshape(shape) if fits else picked
    raise _NotAnArray(f"a {value.source}, whose value is not stored in the file")
