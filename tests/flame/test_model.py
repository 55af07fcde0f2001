"""Reading FLAME model files: every pickle dialect they come in, and everything that must be
refused."""

import codecs
import os
import pickle
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse
from PIL import Image
from refusal import refusal

from stga_addon.capture.images import image_size
from stga_addon.files import read_npy
from stga_addon.flame.model import read_flame
from stga_addon.flame.parts import key_regions
from stga_addon.flame.unpickle import _RestrictedUnpickler, read_pickled_arrays

from .conftest import random_arrays


def _assert_model(path, arrays):
    model = read_flame(path)
    named = {"j_regressor": "J_regressor", "faces": "f"}
    for name in ("v_template", "shapedirs", "posedirs", "j_regressor", "weights", "faces"):
        np.testing.assert_allclose(getattr(model, name), arrays[named.get(name, name)], rtol=1e-14)
    assert model.parents.tolist() == [-1, 0, 1, 1, 1]
    assert model.faces.dtype == np.int32
    assert (model.n_identity, model.n_expression) == (9, 3)


def test_the_dialect_of_the_published_files():
    """Catches latin1, chumpy leaves, a sparse regressor, order of bytes or axes read wrongly.

    Of `random_arrays`: by Python 2's rules, with what is no array, and must not be looked at.
    """
    _assert_model(Path(__file__).with_name("python2.pkl"), random_arrays(vertices=6))


@pytest.mark.parametrize("protocol", range(6))
def test_every_pickle_protocol(tmp_path, protocol):
    """Catches a protocol, sparse layout or numpy module name that is not understood."""
    arrays = random_arrays()
    path = tmp_path / "model.pkl"
    layout = ("csc_matrix", "csr_matrix", "coo_matrix")[protocol % 3]
    sparse = getattr(scipy.sparse, layout)(arrays["J_regressor"])
    stored = dict(arrays, J_regressor=sparse, n_identity=np.int64(9))
    path.write_bytes(pickle.dumps(stored, protocol=protocol))
    _assert_model(path, arrays)
    data = pickle.dumps(arrays, protocol=0)
    for old, new in ((b"numpy.core.", b"numpy._core."), (b"numpy._core.", b"numpy.core.")):
        path.write_bytes(data.replace(old, new))
        _assert_model(path, arrays)


def test_npz_with_masks_and_identity_count(tmp_path):
    """Catches npz models whose own masks or identity count are ignored, eye regions that miss the
    eyeballs, and a wrong split of FLAME's published layout."""
    arrays = random_arrays()
    path = tmp_path / "model.npz"
    np.savez(path, **random_arrays(vertices=10, components=400))
    model = read_flame(path)
    assert (model.n_identity, model.n_expression) == (300, 100)
    corners = np.unique(arrays["f"][:20])
    names = "nose", "left_eye_region", "left_eyeball", "right_eyeball"
    masks = dict(zip(names, arrays["f"][3:7], strict=True)) | {"lips": corners}
    masks = {f"masks/{name}": ids for name, ids in masks.items()}
    np.savez(path, **arrays, n_identity=5, **masks)
    model = read_flame(path)
    assert (model.n_identity, model.n_expression) == (5, 7)
    regions = key_regions(model)
    assert set(regions) == {"nose", "mouth", "left_eye", "right_eye"}
    expected = [set(face) <= set(corners) for face in arrays["f"].tolist()]
    assert regions["mouth"].tolist() == expected
    assert regions["nose"][3]
    assert regions["left_eye"][[4, 5]].all()
    assert regions["right_eye"][6]


def python2_masks(end="\n"):
    """FLAME_masks.pkl as Python 2's pickle.dump(masks, file) wrote the published one."""
    text = "(dp0\n"
    for name, ids in (("nose", [0, 128, 200]), ("left_ear", [10, 13, 34])):
        data = "".join(f"\\x{byte:02x}" for byte in np.array(ids, "<i8").tobytes())
        text += f"S'{name}'\np1\ncnumpy.core.multiarray\n_reconstruct\np2\n(cnumpy\nndarray\n"
        text += f"p3\n(I0\ntS'b'\ntRp4\n(I1\n(I{len(ids)}\ntcnumpy\ndtype\np5\n(S'i8'\nI0\nI1\n"
        text += f"tRp6\n(I3\nS'<'\nNNNI-1\nI-1\nI0\ntbI00\nS'{data}'\ntbs"
    return (text + ".").replace("\n", end).encode()


def test_masks_as_published(tmp_path):
    """Catches Python 2's text pickles, whose strings are not ASCII, being refused, as Python 3.10
    to 3.13's own list of opcodes does: and with the masks the whole capture."""
    path = tmp_path / "FLAME_masks.pkl"
    path.write_bytes(python2_masks())
    masks = read_pickled_arrays(path)
    assert {name: ids.tolist() for name, ids in masks.items()} == {
        "nose": [0, 128, 200],
        "left_ear": [10, 13, 34],
    }


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"
PAGE = b"\r\n<!DOCTYPE html>\n<html><head><title>Sign in</title></head></html>"


@pytest.mark.parametrize(
    ("name", "read"),
    [("a.pkl", read_flame), ("a.npz", read_flame), ("a.npy", read_npy), ("a.png", image_size)],
)
def test_what_stands_in_the_place_of_a_file(tmp_path, name, read):
    """Catches a checkout without Git LFS, a download that was a login page, and a transfer as text,
    told as an unknown opcode or a broken archive."""
    path = tmp_path / name
    if name == "a.npy":
        np.save(path, np.arange(10_000))
    elif name == "a.npz":
        np.savez(path, **random_arrays())
    elif name == "a.png":
        Image.fromarray(np.random.default_rng(0).integers(0, 255, (64, 64), np.uint8)).save(path)
    else:
        path.write_bytes(pickle.dumps(random_arrays(), 2))
    read(path)
    as_text = path.read_bytes().replace(b"\n", b"\r\n")
    for data, sentence in (
        (POINTER, "is a Git LFS pointer"),
        (PAGE, "is a web page"),
        (as_text, "was carried over as text"),
    ):
        path.write_bytes(data)
        with refusal(f"{name}: {sentence}"):
            read(path)
    (tmp_path / "masks.pkl").write_bytes(python2_masks("\r\n"))
    with refusal(r"masks\.pkl: was carried over as text"):
        read_pickled_arrays(tmp_path / "masks.pkl")


class _Attack:
    def __init__(self, call, *arguments):
        self.call = call
        self.arguments = arguments

    def __reduce__(self):
        return self.call, self.arguments


@pytest.mark.parametrize(
    ("attack", "name"),
    [
        (_Attack(os.system, "touch {}"), "posix.system"),
        (_Attack(getattr, "text", "format"), "builtins.getattr"),
        (_Attack(np.load, "{}"), "numpy.load"),
        (_Attack(scipy.sparse.load_npz, "{}"), "load_npz"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_other_classes_are_refused_by_name(tmp_path, attack, name, protocol):
    """Catches a pickle that gets anything executed: the witness file must not appear, and the class
    must be named."""
    witness = tmp_path / "witness"
    texts = (a.format(witness) if isinstance(a, str) else a for a in attack.arguments)
    attack.arguments = tuple(texts)
    path = tmp_path / "model.pkl"
    stored = dict(random_arrays(), extra=attack)
    path.write_bytes(pickle.dumps(stored, protocol=protocol, fix_imports=False))
    with refusal(f"model.pkl.*{name.replace('.', '[.]')}"):
        read_flame(path)
    assert not witness.exists()


@pytest.mark.parametrize("name", ["_codecs\nencode", "numpy.core.multiarray\n_reconstruct"])
@pytest.mark.parametrize("state", [b"}S'left'\nI1\ns", b"N}S'_call'\nI1\ns\x86"])
def test_functions_cannot_be_changed(tmp_path, name, state):
    """Catches a pickle that sets attributes of a function by BUILD, which would outlive its
    reading."""
    path = tmp_path / "model.pkl"
    path.write_bytes(b"\x80\x02c" + name.encode() + b"\n" + state + b"b.")
    with refusal("sets attributes of a function"):
        read_pickled_arrays(path)
    for method in (vars(_RestrictedUnpickler)[name] for name in ("encode", "rebuild")):
        assert vars(method) == {}
    assert not hasattr(codecs.encode, "left")
