"""Damages of one file of a case: bytes, values of JSON, arrays, pictures, and what is in the file's
place."""

import copy
import json
import os
import warnings
import zipfile

import numpy as np
from PIL import Image

from .arguments import TEXTS

JSON_VALUES = [
    None, True, False, 0, 1, -1, 2.5, 10**30, -(10**400), 1e308, 1e-320, float("nan"),
    float("inf"), -float("inf"), "1", "nan", *TEXTS, "a" * 5000, "vhap", "opencv", "../x",
    "/dev/null", "images", "images/00000_00.png", [], {}, [[]], [None], [0] * 1000, {"": {}},
    [[0, 0, 0, 0]] * 4, [1e300] * 3, {"a": [1, {"b": None}]},
]  # fmt: skip
ARRAYS = [
    lambda a: a[:-1] if a.ndim else a.reshape(1), lambda a: a[None], lambda a: a.astype(np.float16),
    lambda a: np.zeros(0, a.dtype), lambda a: np.zeros((0, *a.shape[1:]), a.dtype),
    lambda a: np.full_like(a, 0),
    lambda a: -a if a.dtype.kind in "if" else ~a if a.dtype.kind == "b" else a,
    lambda a: np.full(a.shape, np.nan), lambda a: np.full(a.shape, 1e30),
    lambda a: np.full(a.shape, np.inf, np.float32), lambda a: np.full(a.shape, 2**62),
    lambda a: np.full(a.shape, "x"), lambda a: a.astype(complex) if a.dtype.kind in "if" else a,
    lambda a: a.astype(bool), lambda a: a.T, lambda a: np.concatenate([a, a]) if a.ndim else a,
]  # fmt: skip
BYTES = [
    b"\xff" * 8, b"\x7f\xff\xff\xff", b"\0" * 8, b"-1", b"1e999", b"99999999999", b"NaN", b"[",
    b"]", b'"', b"\xff\xfe", b"../", b"null", b"{}", b"true", b"\n", b".", b"\x80",
]  # fmt: skip


def damage(rng, case, arguments):
    """Change one file of the case, mostly one that the arguments name; returns what was done to
    it."""
    files = sorted(path for path in case.rglob("*") if path.is_file() and not path.is_symlink())
    given = tuple(argument for argument in arguments if argument.startswith(f"{case}/"))
    named = [path for path in files if str(path).startswith(given)]
    small = [path for path in named if path.suffix in (".json", ".npz", ".ply", ".jsonl", ".obj")]
    path = rng.choice(rng.choice([small, small, named, files]) or files)
    done = replace_file(rng, path) if rng.random() < 0.1 else damage_content(rng, path)
    return f"{path.relative_to(case)}: {done}"


def damage_content(rng, path):
    """Change what a file holds, its bytes or the values in it; returns what was done."""
    change = MUTATIONS.get(path.suffix, mutate_bytes) if rng.random() < 0.7 else mutate_bytes
    return f"{change.__name__} {change(rng, path)}"


def mutate_bytes(rng, path):
    path.write_bytes(mutated(rng, path.read_bytes()))
    return ""


def mutated(rng, content):
    """A replacement, insertion, deletion, repetition or another bit, and sometimes an early end."""
    at = rng.randrange(len(content) + 1)
    length = rng.choice([0, 1, 2, 4, 8, 40])
    part = content[at : at + length]
    flipped = bytes(byte ^ 1 << rng.randrange(8) for byte in part)
    piece = rng.choice([rng.choice(BYTES), rng.randbytes(4), part * 2, part * 50, b"", flipped])
    content = content[:at] + piece + content[at + length :]
    return content if rng.random() < 0.85 else content[: rng.randrange(len(content) + 1)]


def mutate_json(rng, path):
    """Replace, delete, add or copy one value, at any depth."""
    try:
        text = path.read_text(encoding="utf-8")
        lines = text.splitlines() if path.suffix == ".jsonl" else [text]
        document = [json.loads(line) for line in lines]
    except (ValueError, RecursionError):  # an earlier damage
        return mutate_bytes(rng, path)
    node = document
    trail = []
    while True:
        keys = list(node) if isinstance(node, dict) else list(range(len(node)))
        if not keys:
            return "nothing"
        key = rng.choice(keys)
        trail.append(key)
        is_leaf = not isinstance(node[key], (dict, list)) or not node[key]
        if is_leaf or rng.random() < 0.15 * (len(trail) > 1):
            break
        node = node[key]
    kind = rng.choice(["replace"] * 6 + ["delete", "copy", "scale"])
    if kind == "replace":
        node[key] = copy.deepcopy(rng.choice(JSON_VALUES))
    elif kind == "scale" and isinstance(node[key], (int, float)) and abs(node[key]) < 1e308:
        node[key] *= rng.choice([-1, 0, 1e-9, 1e9, 0.5])
    elif kind == "copy":
        node[key] = copy.deepcopy(rng.choice([node[k] for k in keys]))
    elif isinstance(node, dict) or len(trail) > 1:
        del node[key]
    path.write_text("\n".join(json.dumps(value) for value in document))
    return f"{kind} {trail}"


def mutate_npz(rng, path):
    """Change, remove or rename one array of an intact archive, or damage its bytes: otherwise the
    archive's checksums detect nearly all damage."""
    try:
        with np.load(path) as data:
            arrays = dict(data)
        with zipfile.ZipFile(path) as archive:
            stored = {entry: archive.read(entry) for entry in archive.namelist()}
    except Exception:  # an earlier damage
        return mutate_bytes(rng, path)
    if not all(isinstance(array, np.ndarray) for array in arrays.values()):  # an earlier one too
        return mutate_bytes(rng, path)
    if not arrays:
        return "nothing"
    name = rng.choice(list(arrays))
    chance = rng.random()
    if chance > 0.7:
        stored[f"{name}.npy"] = mutated(rng, stored[f"{name}.npy"])
        with zipfile.ZipFile(path, "w") as archive:
            for entry, content in stored.items():
                archive.writestr(entry, content)
        return f"{name} damaged"
    if chance < 0.1:
        del arrays[name]
    elif chance < 0.2:
        arrays[rng.choice(["x", "../x", "0", f"{name}/"])] = arrays.pop(name)
    elif chance < 0.4 and arrays[name].size and arrays[name].dtype.kind in "if":
        flat = arrays[name] = arrays[name].copy()
        worst = [np.nan, np.inf, -1e30, 1e6]
        if flat.dtype.kind == "i":
            worst = [-1, np.iinfo(flat.dtype).max]
        flat.reshape(-1)[rng.randrange(flat.size)] = rng.choice(worst)
    else:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                arrays[name] = rng.choice(ARRAYS)(arrays[name])
            except (ValueError, TypeError):
                del arrays[name]
    with zipfile.ZipFile(path, "w") as archive:
        for entry, array in arrays.items():
            with archive.open(f"{entry}.npy", "w") as stream:
                np.lib.format.write_array(stream, np.asarray(array))
    return f"{name} {arrays[name].dtype if name in arrays else 'gone'}"


def mutate_picture(rng, path):
    """Another size, mode or format in the same file."""
    size = rng.choice([(40, 60), (60, 40), (1, 1), (41, 60), (4000, 4000)])
    mode = rng.choice(["RGB", "RGBA", "L", "LA", "P", "I;16", "1", "F", "CMYK"])
    kind = {"F": "TIFF", "CMYK": "JPEG"}.get(mode, "PNG")
    Image.new(mode, size).save(path, kind)
    return f"{mode} {size}"


def replace_file(rng, path):
    """Nothing, an empty file, a folder, a link to itself, a pipe or another file in its place."""
    kind = rng.choice(["missing", "empty", "folder", "link", "pipe", "other"])
    content = rng.choice(sorted(p for p in path.parent.iterdir() if p.is_file())).read_bytes()
    path.unlink()
    if kind == "empty":
        path.touch()
    elif kind == "folder":
        path.mkdir()
    elif kind == "link":
        path.symlink_to(path.name)
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "other":
        path.write_bytes(content)
    return kind


MUTATIONS = {
    ".json": mutate_json,
    ".jsonl": mutate_json,
    ".npz": mutate_npz,
    ".png": mutate_picture,
}
