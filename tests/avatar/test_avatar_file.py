"""The avatar's own file: what goes in comes out, and nothing else is let in."""

import json
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal, assert_equal
from refusal import refusal

from stga_addon.avatar.file import read_avatar, write_avatar
from stga_addon.files import save_npz

SPLAT_FIELDS = ("xyz", "rotation", "log_scale", "opacity", "sh", "face", "unbound")


@pytest.mark.parametrize("is_empty", [False, True])
def test_round_trip_is_exact(is_empty, tmp_path, avatar):
    """Catches a field that is dropped, reordered or changes its type, and special cases of
    nothing."""
    if is_empty:
        nothing = avatar.splats.rows(np.arange(0))
        avatar = replace(avatar, regions={}, settings={}, splats=nothing)
    along = np.full((len(avatar.faces), 3), 0.1, np.float32)
    avatar = replace(avatar, filmed_along=along)
    write_avatar(tmp_path / "a.npz", avatar)
    back = read_avatar(tmp_path / "a.npz")
    for name in SPLAT_FIELDS:
        have = getattr(back.splats, name)
        want = getattr(avatar.splats, name)
        assert have.dtype == want.dtype, name
        assert_array_equal(have, want, err_msg=name)
    for name in ("neutral", "faces", "filmed_along"):
        assert_array_equal(getattr(back, name), getattr(avatar, name), err_msg=name)
    for name in ("convention", "settings", "background"):
        assert getattr(back, name) == getattr(avatar, name)
    assert list(back.regions) == list(avatar.regions)
    assert_equal(back.regions, avatar.regions)


def with_splats(avatar, **changes):
    return replace(avatar, splats=replace(avatar.splats, **changes))


def spoiled(array, value):
    array = array.copy()
    array.flat[3] = value
    return array


BROKEN = {
    "convention": lambda a: replace(a, convention="flame"),
    "neutral": lambda a: replace(a, neutral=spoiled(a.neutral, np.nan)),
    "neutral is float64": lambda a: replace(a, neutral=a.neutral.astype(np.float64)),
    "faces is": lambda a: replace(a, faces=a.faces[:, :2]),
    "faces refers": lambda a: replace(a, faces=spoiled(a.faces, 20)),
    "faces refers to -1": lambda a: replace(a, faces=spoiled(a.faces, -1)),
    "rotation": lambda a: with_splats(a, rotation=a.splats.rotation[:-1]),
    "opacity": lambda a: with_splats(a, opacity=a.splats.opacity[:, None]),
    "sh has 5": lambda a: with_splats(a, sh=a.splats.sh[:, :5]),
    "face refers": lambda a: with_splats(a, face=spoiled(a.splats.face, 30)),
    "strain_range is": lambda a: replace(a, strain_range=np.zeros((29, 2, 6), np.float32)),
    "strain_color is": lambda a: replace(
        a, driven_offsets={"strain_color": np.zeros((29, 3, 3), np.float32)}
    ),
    "region 'mouth'": lambda a: replace(a, regions={"mouth": np.zeros(30, np.int8)}),
    "background": lambda a: replace(a, background=(1.0, 1.0)),
}


@pytest.mark.parametrize("complaint", BROKEN)
def test_avatars_that_do_not_fit_together_are_not_written(tmp_path, avatar, complaint):
    """Catches a file that would only fail when it is opened, and a half-written one."""
    with refusal(rf"a\.npz: .*{complaint}"):
        write_avatar(tmp_path / "a.npz", BROKEN[complaint](avatar))
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"xyz": None}, "'xyz'"),
        ({"region_faces": np.zeros((1, 30), bool)}, "region_faces"),
        ({"xyz": np.float32(0)}, "xyz"),
        ({"header": None}, "no header"),
        ({"header": np.zeros(3, np.uint8)}, "JSON"),
        ({"header": np.frombuffer(b"[" * 100000, np.uint8)}, "JSON"),
        ({"header": np.frombuffer(b"[1]", np.uint8)}, "not an avatar file"),
        ({"header": {"format": "other"}}, "not an avatar file"),
        (
            {"header": {"version": 2}},
            "avatar format version 2, this add-on reads 3; train it again$",
        ),
        ({"header": {"version": 4}}, "version 4, this add-on reads 3; update the add-on$"),
        ({"header": {"convention": None}}, "'convention'"),
        ({"header": {"regions": [1, 2]}}, "'regions'"),
        ({"header": {"background": ["a", 1, 1]}}, "background"),
    ],
)
def test_wrong_arrays_and_header_fields_are_named(tmp_path, avatar, change, complaint):
    """Catches readers that trust an array because it has the right name, and a header of another
    version or type that surfaces later as something else."""
    write_avatar(tmp_path / "a.npz", avatar)
    with np.load(tmp_path / "a.npz") as data:
        content = dict(data)
    if isinstance(change.get("header"), dict):
        header = json.loads(content["header"].tobytes()) | change["header"]
        change = {"header": np.frombuffer(json.dumps(header).encode(), np.uint8)}
    content = {name: array for name, array in (content | change).items() if array is not None}
    np.savez(tmp_path / "a.npz", **content)
    with refusal(rf"a\.npz: .*{complaint}"):
        read_avatar(tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("name", "zeros", "sentence"),
    [
        ("notes", np.zeros(40_000_000, np.uint8), None),
        ("sh", (1 << 18, 16, 3), "sh is float32"),
        ("neutral", (1 << 22, 4), "neutral is"),
        ("light_transfer", (1 << 20, 9), "light_transfer"),
        ("region_faces", (1 << 8, 1 << 16), "region_faces"),
        ("header", (40_000_000,), "header"),
    ],
)
def test_a_small_file_is_not_unpacked_to_gigabytes(tmp_path, avatar, name, zeros, sentence):
    """Catches arrays unpacked before their names and shapes are looked at: 3.6 MB became 3.4 GB."""
    path = tmp_path / "a.npz"
    write_avatar(path, avatar)
    with np.load(path) as data:
        arrays = dict(data)
    if name.startswith("light"):
        header = json.loads(arrays["header"].tobytes()) | {"light": {}}
        arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
        arrays["light_radiance"] = np.zeros((9, 3), np.float16)
    if name == "header":
        arrays[name] = np.zeros(zeros, np.uint8)
    elif sentence:
        arrays[name] = np.broadcast_to(np.zeros((), np.float32), zeros)
    else:
        arrays[name] = zeros
    save_npz(path, arrays, compressed=True)
    tracemalloc.start()
    try:
        if sentence is None:
            assert len(read_avatar(path).splats) == len(avatar.splats)
        else:
            with refusal(rf"a\.npz: {sentence}"):
                read_avatar(path)
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()


def test_an_encrypted_archive_is_refused(tmp_path, avatar):
    """Catches zipfile's RuntimeError where an entry says that it needs a password."""
    write_avatar(tmp_path / "a.npz", avatar)
    content = bytearray((tmp_path / "a.npz").read_bytes())
    content[content.rindex(b"PK\x01\x02") + 8] |= 1
    (tmp_path / "a.npz").write_bytes(content)
    with refusal(r"a\.npz"):
        read_avatar(tmp_path / "a.npz")
