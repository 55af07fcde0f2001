"""Whole captures of every layout, as written by the tests and as a studio hands them over."""

import json
import re
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from refusal import refusal

from stga_addon.capture.images import read_image, read_mask
from stga_addon.capture.model import format_ranges, summarize_capture
from stga_addon.capture.open import open_capture
from stga_addon.capture.selection import SelectionOptions, select_capture
from stga_addon.flame.forward import flame_forward
from stga_addon.flame.model import read_flame
from stga_addon.flame.sequence import read_frame
from stga_addon.tracking.footage.open import open_footage
from stga_addon.training.effects.samples import take_samples

from . import factory


def no_masks(document):
    for entry in document["frames"]:
        del entry["fg_mask_path"]


def each_split(root, change):
    for split in factory.SPLITS:
        factory.edit(root / f"transforms_{split}.json", change)


@pytest.mark.parametrize("suffix", [".obj", ".ply", ".glb", ".stl"])
def test_mesh_capture(tmp_path, suffix):
    """Catches a timestep paired with another's mesh or image, a lost gap, split or region."""
    capture = open_capture(factory.write_mesh_capture(tmp_path / "capture", suffix=suffix))
    vertices, faces = factory.ball()
    assert (capture.layout, capture.timesteps, capture.flame) == ("mesh", (0, 1, 3), None)
    assert [(name, len(views)) for name, views in capture.views.items()] == [
        ("train", 4),
        ("val", 2),
        ("test", 3),
    ]
    assert_allclose(capture.neutral[capture.faces], vertices[faces], atol=1e-7)
    for timestep in capture.timesteps:
        mesh = capture.mesh(timestep)
        moved = factory.moved(timestep, vertices)
        assert_allclose(mesh[capture.faces], moved[faces], atol=1e-7)
    for view in (view for split in capture.views.values() for view in split):
        expected = factory.picture(view.timestep, view.camera_index)
        assert_array_equal(read_image(view), expected)
        assert_array_equal(read_mask(view), factory.silhouette() * 255)
    if suffix == ".stl":
        assert any("STL" in warning for warning in capture.warnings)
    else:
        assert capture.warnings == ()
        expected = (vertices[:, 1] < -0.06)[faces].all(axis=1)
        assert_array_equal(capture.regions["mouth"], expected)


DISTORTED = [
    ({"camera_model": "OPENCV", "k1": -0.35, "p2": 0.01}, "k1 -0.35, p2 0.01"),
    ({"p2": 0.1}, "p2 0.1"),
    ({"distortion_params": [-0.3, 0, 0, 0, 0, 0]}, "k1 -0.3"),
    ({"camera_model": "OPENCV_FISHEYE"}, "camera_model: is 'OPENCV_FISHEYE'"),
    ({"is_fisheye": True, "k1": 0.01}, "is_fisheye: is True"),
]


@pytest.mark.parametrize(("lens", "says"), DISTORTED)
def test_distorted_images(tmp_path, lens, says):
    """Catches images of a lens that is no pinhole, silently trained on as if they were, or as
    another lens than tracking reads; and labels of a mask that are mixed."""
    root = factory.write_mesh_capture(tmp_path / "capture")
    stored_masks(root, paletted)
    each_split(root, lambda document: document.update(lens))
    # whose `cy` tracking takes for OpenCV's
    convention = "opencv" if {"camera_model", "k1"} & lens.keys() else "vhap"
    capture = open_capture(root, principal_point=convention)
    assert re.search(rf"{re.escape(says)}.*undistorted as they are read", str(capture.warnings))
    tracked = {own.source(t): own for t, own in open_footage(root).views()}
    for view in capture.all_views:
        own = tracked[str(view.image)]
        assert view.camera.fl_x == own.camera.fl_x != own.undistortion.recorded.fl_x
        assert_array_equal(read_image(view), own.image(view.timestep))
        assert_array_equal(read_mask(view), own.mask(view.timestep))
        assert read_mask(view).max() == 255


@pytest.mark.parametrize(
    ("lens", "says"),
    [
        ({"k1": -90.0}, "folds the image"),
        ({"camera_model": "EQUIRECTANGULAR"}, "camera_model: 'EQUIRECTANGULAR' is not one of"),
    ],
)
def test_lenses_that_no_pinhole_stands_for(tmp_path, lens, says):
    """Catches images trained on as if a pinhole had recorded them, and a traceback."""
    root, model = factory.write_flame_capture(tmp_path / "capture")
    factory.edit(root / "transforms_val.json", lambda document: document.update(lens))
    with refusal(rf"_val\.json: frames\[0\].*{re.escape(says)}"):
        open_capture(root, model)


@pytest.mark.parametrize(
    "lens",
    [
        {"camera_model": "PINHOLE", "k1": 0.3},
        {"k1": 0.0, "k4": 0, "p1": 0.0},
        {"camera_model": "OPENCV", "k1": 1e-3, "is_fisheye": False},
    ],
)
def test_lenses_that_show_no_distortion(tmp_path, lens):
    """Catches captures refused for coefficients of nerfstudio's files that bend nothing."""
    root = factory.write_mesh_capture(tmp_path / "capture")
    each_split(root, lambda document: document.update(lens))
    assert open_capture(root).warnings == ()


def stored_masks(root, store):
    for path in (root / "fg_masks").iterdir():
        store(np.asarray(Image.open(path)) > 0).save(path)
    return root


def paletted(mask):
    image = Image.fromarray(mask.astype(np.uint8), mode="P")
    image.putpalette([0, 0, 0, 128, 0, 0])
    return image


@pytest.mark.parametrize(
    ("store", "level"),
    [
        (lambda mask: Image.fromarray(mask.astype(np.uint8)), 1),
        (lambda mask: Image.fromarray(mask.astype(np.uint16)), 1),
        (lambda mask: Image.fromarray(mask.astype(np.uint16) * 255), 255),
        (lambda mask: Image.fromarray(mask), 255),
        (paletted, 128),
        (lambda mask: Image.fromarray(np.dstack([mask.astype(np.uint8)] * 3)), 1),
    ],
)
def test_masks_of_labels(tmp_path, store, level):
    """Catches masks of 0 and 1, as segmentation networks write them, taken for nearly transparent:
    3 dB are silently lost."""
    capture = open_capture(stored_masks(factory.write_mesh_capture(tmp_path / "capture"), store))
    for view in capture.views["train"]:
        assert_array_equal(read_mask(view), factory.silhouette() * 255)
    warnings = [f"only 0 and {level}, which is read as 255"] if level < 255 else []
    assert len(capture.warnings) == len(warnings)
    assert all(each in found for each, found in zip(warnings, capture.warnings, strict=True))


def test_masks_of_parts(tmp_path):
    """Catches a map of many parts' numbers silently taken for a mask; a matte keeps its."""
    root = factory.write_mesh_capture(tmp_path / "capture")
    parts = (factory.silhouette() * (1 + np.arange(factory.WIDTH) % 9)).astype(np.uint8)
    stored_masks(root, lambda _: Image.fromarray(parts))
    capture = open_capture(root)
    assert ["nothing above 9; expected 255" in line for line in capture.warnings] == [True]
    assert_array_equal(read_mask(capture.views["val"][0]), parts)


def test_capture_of_a_monocular_tracker(tmp_path):
    """Catches INSTA's folder refused, its canonical mesh overlooked, and files that it names and
    nobody reads, or a principal point from the other end, passed over."""
    root = factory.write_mesh_capture(tmp_path / "capture", (0, 1, 2), (0,))
    (root / "meshes/neutral.obj").rename(root / "canonical.obj")

    def as_insta(document):
        del document["canonical_mesh_path"]
        for entry in document["frames"]:
            for name in ("timestep_index", "camera_index", "camera_id", "fg_mask_path"):
                del entry[name]
            entry |= {"seg_mask_path": "seg_mask/0.png", "exp_path": "flame/exp/0.txt"}

    each_split(root, as_insta)
    capture = open_capture(root)
    assert capture.timesteps == (0, 1, 2)
    assert_allclose(capture.neutral, factory.ball()[0], atol=1e-8)
    said = "\n".join(capture.warnings)
    for part in (
        "canonical.obj, which lies there",
        "(in 3 of 3 frames)",
        "seg_mask_path, exp_path",
        "--principal-point opencv",
    ):
        assert part in said, part
    assert len(capture.warnings) == 4
    swapped = factory.ball()[1][::-1]
    factory.write_mesh(root / "canonical.obj", factory.ball()[0], swapped)
    assert "00000.obj, the first timestep" in open_capture(root).warnings[0]


def test_images_that_no_frame_names(tmp_path):
    """Catches recorded images that are silently not trained on: a split that is missing, or a
    tracker that lost its frames."""
    root = factory.write_mesh_capture(tmp_path / "capture")
    (root / "transforms_test.json").unlink()
    (root / "images/notes.txt").touch()
    (found,) = open_capture(root).warnings
    assert found.startswith(f"{root}/images: 3 of 9 images are named by no frame: 00003_00.png, ")


def test_one_timestep_and_camera(tmp_path):
    """Catches a capture of a single frame or camera being refused by a division or a split."""
    root, model = factory.write_flame_capture(tmp_path / "flame", (7,), (2,))
    capture = open_capture(root, model)
    assert capture.timesteps == (7,)
    assert len(capture.all_views) == 1
    assert summarize_capture(capture)


def test_flame_capture(tmp_path):
    """Catches parameters of another timestep, a lost offset or shape, and head motion left in the
    expression."""
    root, model_file = factory.write_flame_capture(tmp_path / "capture")
    capture = open_capture(root, model_file)
    assert capture.flame is not None
    model = read_flame(model_file)
    offset = np.full((len(model.v_template), 3), np.float32(0.0005))
    shape = np.full(4, 0.3, "f4")
    assert (capture.layout, capture.timesteps, capture.warnings) == ("flame", (0, 1, 3), ())
    for timestep in capture.timesteps:
        frame = read_frame(root / f"flame_param/{timestep:05d}.npz", model)
        expected = flame_forward(model, shape, frame, offset)
        assert_allclose(capture.mesh(timestep), expected, atol=1e-12)
        still = replace(frame, rotation=np.zeros(3), neck_pose=np.zeros(3), translation=np.zeros(3))
        expected = flame_forward(model, shape, still, offset)
        assert_allclose(capture.expression_mesh(timestep, "head"), expected, atol=1e-12)
    still, whole = (capture.expression_mesh(3, zero_pose) for zero_pose in ("all", "head"))
    assert np.abs(still - whole).max() > 1e-4
    shaped = model.v_template + model.shapedirs[:, :, :4] @ shape + offset
    assert_allclose(capture.neutral, shaped, atol=1e-12)
    assert set(capture.regions) == {"nose", "mouth"}
    assert len(capture.faces) == len(model.faces)


def test_flame_capture_without_paths_or_masks(tmp_path):
    """Catches a capture refused whose frames name no parameters, or without cameras."""
    root, model_file = factory.write_flame_capture(tmp_path / "capture")

    def strip(document):
        for entry in document["frames"]:
            del entry["flame_param_path"]

    each_split(root, strip)
    with np.load(model_file) as data:
        bare = {key: data[key] for key in data.files if not key.startswith("masks/")}
    np.savez(model_file, **bare)
    capture = open_capture(root, model_file)
    assert capture.timesteps == (0, 1, 3)
    assert not capture.regions
    assert "FLAME_masks.pkl" in capture.warnings[0]
    for split in factory.SPLITS:
        (root / f"transforms_{split}.json").unlink()
    capture = open_capture(root, model_file)
    assert (capture.timesteps, dict(capture.views)) == ((0, 1, 3), {})


@pytest.mark.parametrize("rows", [5023, 5143])
def test_published_topology_gets_teeth_and_regions(tmp_path, shared_data, rows):
    """Catches a mesh of 9976 triangles where VHAP tracked 10144, whichever size its offsets have,
    and a head without FLAME_masks.pkl that has no eyes, or has them in silence. The real template
    and triangles; skinning and expressions are filled in, for they are not published openly."""
    with np.load(shared_data / "flame_open/flame2023_open_basis.npz") as data:
        template = data["v_template"].astype(float)
        faces = data["faces"]
    root, model_file = factory.write_flame_capture(tmp_path / "capture", timesteps=(0,))
    factory.write_flame_model(model_file, mesh=(template, faces))
    offset = np.full((1, rows, 3), 0.001, np.float32)
    parameters = factory.flame_parameters(0) | {"static_offset": offset, "shape": np.zeros(4)}
    np.savez(root / "flame_param/00000.npz", **parameters)
    with np.load(model_file) as data:
        bare = {key: data[key] for key in data.files if not key.startswith("masks/")}
    np.savez(model_file, **bare)
    capture = open_capture(root, model_file)
    assert set(capture.regions) == {"left_eye", "right_eye", "mouth", "nose"}
    assert "found on its mesh" in capture.warnings[0]
    assert capture.neutral.shape == (5143, 3)
    assert capture.faces.shape == (10144, 3)
    assert_allclose(capture.neutral[:5023], template + np.float32(0.001), atol=1e-7)


def test_release_layout(tmp_path):
    """Catches keyframes read as something else, and a selection that came with the capture being
    recomputed."""
    capture = open_capture(factory.write_release(tmp_path / "capture"))
    vertices, faces = factory.ball()
    assert (capture.layout, capture.timesteps) == ("release", (0, 1))
    moved = factory.moved(1, vertices)[faces]
    assert_allclose(capture.mesh(1)[capture.faces], moved, atol=1e-12)
    selected = select_capture(capture, SelectionOptions(threshold=0.0005))
    assert np.flatnonzero(selected[0]).tolist() == [0, 2, 5]
    moving = np.abs(moved - vertices[faces]).max(axis=(1, 2)) > 0
    assert selected[1].any()
    assert not (selected[1] & ~moving).any()


def test_bare_folder(tmp_path):
    """Catches frame 10 sorted before frame 9, and the neutral mesh taken for a timestep."""
    vertices, faces = factory.ball()
    for timestep in (9, 10, 12):
        path = tmp_path / f"head_{timestep}.obj"
        factory.write_mesh(path, factory.moved(timestep, vertices), faces)
    capture = open_capture(tmp_path)
    assert (capture.timesteps, dict(capture.views)) == ((9, 10, 12), {})
    assert "first timestep" in capture.warnings[0]
    factory.write_mesh(tmp_path / "Neutral.ply", vertices, faces)
    (tmp_path / "regions.json").write_text('{"nose": []}')
    capture = open_capture(tmp_path)
    assert capture.timesteps == (9, 10, 12)
    assert_allclose(capture.neutral, vertices, atol=1e-7)
    assert_allclose(capture.mesh(10), factory.moved(10, vertices), atol=1e-8)
    assert capture.warnings == (f"{tmp_path / 'regions.json'}: no triangle lies in nose",)
    factory.write_mesh(tmp_path / "last.obj", vertices, faces)
    assert open_capture(tmp_path).timesteps == (0, 1, 2, 3)


def test_principal_point_is_checked_against_the_masks(tmp_path, shared_data):
    """Catches a capture of the other convention opened silently, a warning where all is well, and a
    check too dull for a real head: the principal point 10 pixels off the center, of 401."""
    root = factory.write_mesh_capture(tmp_path / "capture")
    assert open_capture(root, principal_point="vhap").warnings == ()
    for wrong in ("opencv", "center"):
        (warning,) = open_capture(root, principal_point=wrong).warnings
        assert f"read as '{wrong}'" in warning
        assert "with 'vhap'" in warning
    each_split(root, no_masks)
    assert open_capture(root, principal_point="opencv").warnings == ()
    root = tmp_path / "real"
    root.mkdir()
    for entry in (shared_data / "studio_head").iterdir():
        if entry.is_dir():
            (root / entry.name).symlink_to(entry)
        elif entry.suffix == ".json":
            shutil.copy(entry, root)

    def shift(document):
        for entry in document["frames"]:
            entry["cy"] -= 10

    each_split(root, shift)
    (warning,) = open_capture(root, principal_point="opencv").warnings
    assert "with 'center'" in warning


@pytest.mark.parametrize(
    ("factor", "says"), [(1000.0, "200: meshes are read as milli"), (1e-3, "0.0002 m"), (1.0, None)]
)
def test_a_head_that_is_not_in_meters(tmp_path, factor, says):
    """Catches a capture in millimeters that trains to nonsense, or renders nothing, silently."""
    root = factory.write_mesh_capture(tmp_path / "capture")
    vertices, faces = factory.ball()
    for path in (root / "meshes").glob("*.obj"):
        factory.write_mesh(path, factor * vertices, faces)
    each_split(root, no_masks)
    warnings = open_capture(root).warnings
    assert len(warnings) == (says is not None)
    assert says is None or says in warnings[0]


def test_summary(tmp_path):
    """Catches counts, gaps, offsets or warnings that `info` would show wrong, by one at either end
    of a gap, too."""
    root, model_file = factory.write_flame_capture(tmp_path / "capture")
    lines = dict(summarize_capture(open_capture(root, model_file, "opencv")))
    assert lines["timesteps"] == "3: 0–1, 3 (gap 2)"
    expected = "train 4 views (2 timesteps, 2 cameras); val 2 views (2 timesteps, 1 cameras); "
    assert lines["splits"] == expected + "test 3 views (1 timesteps, 3 cameras)"
    assert lines["static offset"] == "up to 0.9 mm"
    release = dict(summarize_capture(open_capture(factory.write_release(tmp_path / "release"))))
    assert release["regions"] == "none"
    assert release["given selection"] == "1 timesteps, 0.9% of the triangles on average"
    assert format_ranges([4]) == "1: 4"
    assert format_ranges([0, 1, 2]) == "3: 0–2"
    assert format_ranges([0, 2, 3, 7]) == "4: 0, 2–3, 7 (gaps 1, 4–6)"


BROKEN_MESH_CAPTURES = r"""
remove images/00001_01.png → 00001_01\.png: .*train\.json: frames\[3\] .*file_path
remove fg_masks/00003_02.png → 00003_02\.png: does not exist, .*test\.json: frames\[2\]
remove meshes/00003.obj → 00003\.obj: does not .*test\.json: frames\[0\] .*mesh_path
remove meshes/neutral.obj → neutral\.obj: cannot be read
remove regions.json → regions\.json: cannot be read
cut transforms_train.json → transforms_train\.json: is not valid JSON
cut meshes/neutral.obj → neutral\.obj:
cut regions.json → regions\.json: is not valid JSON
cut fg_masks/00000_00.png → fg_masks/00000_00\.png: is not a readable image
in_a_point meshes/neutral.obj → neutral\.obj: all vertices of the mesh lie in one point
in_a_point meshes/00001.obj → 00001\.obj: all vertices of the mesh lie in one point
without_mesh 1 → val\.json: frames\[1\]\.mesh_path: is missing
with_mesh_3 0 → val\.json: frames\[0\]\.mesh_path: is .*00003\.obj, but timestep 0 already
"""
BROKEN_FLAME_CAPTURES = r"""
remove flame_param/00003.npz → 00003\.npz: does not exist, but .*flame_param_path
cut flame_param/00000.npz → flame_param/00000\.npz: is not a readable npz
remove model.npz → model\.npz: cannot be read
"""
BROKEN_RELEASES = r"""
remove meshes/mesh_0001.json → mesh_0001\.json: cannot be read
soup [] → 0000\.json: triangles:
soup {"triangles": []} → 0000\.json: triangles:
soup {"triangles": [{"Vertices": [[0, 0], [1, 0], [0, 1]]}]} → 0000\.json: triangles:
soup {"triangles": [{"Vertices": [[NaN, 0, 0], [1, 0, 0], [0, 1, 0]]}]} → json: vertex 0
numbers [0, 320] → 0000\.npy: names triangles 0 to 320, but .* 0 to 319
numbers [-1] → 0000\.npy: names triangles
numbers [0.5] → 0000\.npy: expected a list of triangle numbers
numbers [[1]] → 0000\.npy: expected a list of triangle numbers
"""
"""What is done to a capture, to which of its files or with what, and what is said of it."""


def remove(root, given):
    (root / given).unlink()


def cut(root, given):
    (root / given).write_bytes((root / given).read_bytes()[:40])


def in_a_point(root, given):
    vertices, faces = factory.ball()
    factory.write_mesh(root / given, np.full_like(vertices, 0.1), faces)


def without_mesh(root, given):
    path = root / "transforms_val.json"
    factory.edit(path, lambda document: document["frames"][int(given)].pop("mesh_path"))


def with_mesh_3(root, given):
    changes = {"mesh_path": "meshes/00003.obj"}
    path = root / "transforms_val.json"
    factory.edit(path, lambda document: document["frames"][int(given)].update(changes))


def soup(root, given):
    (root / "meshes/mesh_0000.json").write_text(given)


def numbers(root, given):
    np.save(root / "training_faces/0000.npy", json.loads(given))


def parameters(change):
    def damage(root):
        arrays = factory.flame_parameters(0) | change
        given = {name: array for name, array in arrays.items() if array is not None}
        np.savez(root / "flame_param/00000.npz", **given)

    return damage


KINDS = {
    kind.__name__: kind
    for kind in (remove, cut, in_a_point, without_mesh, with_mesh_3, soup, numbers)
}
BROKEN_CAPTURES = [
    (factory.write_flame_capture, parameters(change), message)
    for change, message in (
        ({"shape": None}, r"00000\.npz: .*shape"),
        ({"static_offset": np.zeros((1, 100, 3))}, r"00000\.npz: .*static_offset"),
        ({"expr": np.array([{}], object)}, r"00000\.npz: "),
        ({"translation": np.full((1, 3), 9e5)}, "timestep 0: the mesh reaches farther"),
        ({"expr": np.full((1, 2), 1e300)}, r"00000\.npz: expr holds values"),
    )
]
for write, table in (
    (factory.write_mesh_capture, BROKEN_MESH_CAPTURES),
    (factory.write_flame_capture, BROKEN_FLAME_CAPTURES),
    (factory.write_release, BROKEN_RELEASES),
):
    for kind, given, message in re.findall(r"^(\w+) (.*) → (.*)$", table, re.MULTILINE):
        BROKEN_CAPTURES.append((write, partial(KINDS[kind], given=given), message))


@pytest.mark.parametrize(("write", "damage", "message"), BROKEN_CAPTURES)
def test_broken_captures(tmp_path, write, damage, message):
    """Catches a damaged or absurd capture that opens, or fails without naming file and field."""
    made = write(tmp_path / "capture")
    root, model_file = made if isinstance(made, tuple) else (made, None)
    if write == factory.write_mesh_capture:
        noise = np.random.default_rng(0).integers(0, 255, (60, 40), np.uint8)
        Image.fromarray(noise).save(root / "fg_masks/00000_00.png")
    damage(root)
    with refusal(message):
        every_mesh(root, model_file)


def every_mesh(root, model_file):
    capture = open_capture(root, model_file)
    for timestep in capture.timesteps:
        capture.expression_mesh(timestep, "head")
        capture.mesh(timestep)


@pytest.mark.parametrize("distance", [0.0, 1e-9, 0.02, 0.1, -1.0])
@pytest.mark.filterwarnings("error")
def test_camera_inside_the_head(tmp_path, distance):
    """Catches divisions by zero for a camera in the head, or with the head behind it."""
    root = factory.write_mesh_capture(tmp_path / "capture")

    def change(document):
        for frame in document["frames"]:
            for row in frame["transform_matrix"][:3]:
                row[3] *= distance

    each_split(root, change)
    samples = take_samples(open_capture(root))
    assert np.isfinite(samples.direction).all()
    assert np.isnan(samples.pixel_width).all() or distance > 0


def test_what_is_no_capture(tmp_path):
    """Catches a wrong folder, file or option ending in a traceback or in an empty capture."""
    for folder in (tmp_path / "none", Path("a" * 5000), Path("a/" * 3000), Path("nul\0")):
        with refusal("is not a folder"):
            open_capture(folder)
    with refusal("is not a capture; expected transforms_"):
        open_capture(tmp_path)
    root, model_file = factory.write_flame_capture(tmp_path / "flame")
    with refusal(r"give the FLAME model file .* --flame or in the"):
        open_capture(root)
    with refusal("'left' is not one of vhap, opencv, center"):
        open_capture(root, model_file, "left")
    with refusal("is no capture: it is a file of a capture, .* named by its folder"):
        open_capture(root / "transforms_train.json")
    with refusal(r"model\.npz: has none of expr"):
        open_capture(model_file, model_file)
    plain = tmp_path / "plain"
    plain.mkdir()
    factory.write_images(plain, [0], [0])
    (plain / "transforms.json").write_text(json.dumps({"frames": [factory.frame(0, 0)]}))
    with refusal("expected a frame with flame_param_path or mesh_path"):
        open_capture(plain)
    factory.write_mesh(tmp_path / "neutral.obj", *factory.ball())
    with refusal(r"holds no tracked mesh besides .*neutral\.obj"):
        open_capture(tmp_path)


def test_a_motion_file_is_a_capture_without_views(tmp_path):
    """Catches a motion that needs a folder or loses identity, and a model that is ignored."""
    root, model_file = factory.write_flame_capture(tmp_path / "flame")
    whole = open_capture(root, model_file)
    motion = open_capture(root / "flame_param/00003.npz", model_file)
    assert (motion.layout, motion.timesteps, dict(motion.views)) == ("flame", (0,), {})
    assert_array_equal(motion.mesh(0), whole.mesh(3))
    assert_array_equal(motion.neutral, whole.neutral)
    assert motion.regions.keys() == whole.regions.keys()
    own = root / "flame_model.npz"
    shutil.copy(model_file, own)
    capture = open_capture(root)
    assert capture.flame_file == own.resolve()
    assert_array_equal(capture.mesh(0), open_capture(root, model_file).mesh(0))
    own.write_bytes(b"")
    assert open_capture(root, model_file).flame_file == model_file


def test_frame_rate(tmp_path):
    """Catches a rate that is lost in one of the layouts, made up where none is written, or one at
    which nothing plays, which fails as late as in an export."""
    mesh = factory.write_mesh_capture(tmp_path / "mesh")
    flame, model = factory.write_flame_capture(tmp_path / "flame")
    release = factory.write_release(tmp_path / "release")
    for root in (mesh, flame, release):
        assert open_capture(root, model).fps is None
        assert "frame rate" not in dict(summarize_capture(open_capture(root, model)))
        factory.edit(root / "transforms_train.json", lambda document: document.update(fps=59.94))
        assert open_capture(root, model).fps == 59.94
        summary = dict(summarize_capture(open_capture(root, model)))
        assert summary["frame rate"] == "59.94 frames per second"
    for value in (0, -25, 1000, float("inf"), float("nan"), True, "60", [60]):
        factory.edit(mesh / "transforms_val.json", lambda d, value=value: d.update(fps=value))
        with refusal(r"transforms_val\.json: (fps: expected|is not valid)"):
            open_capture(mesh)
        factory.edit(mesh / "transforms_val.json", lambda document: document.pop("fps"))
