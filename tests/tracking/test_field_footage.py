"""Calibrations and footage as other programs and people leave them: read, or refused by name."""

import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from refusal import refusal

from stga_addon.files import write_json
from stga_addon.tracking.footage.open import open_footage

from .scenes import (
    HEIGHT,
    WIDTH,
    quaternion,
    rewrite,
    rig,
    write_colmap_text,
    write_image,
    write_video,
)
from .test_calibrations import HEADER, csv_line, entry, intrinsics, write_export, write_xmp

NAMES = ["cam0.png", "cam1.png", "cam2.png"]


def write_images(folder, names=NAMES, first=0, size=(WIDTH, HEIGHT)):
    for number, name in enumerate(names):
        write_image(folder / name, first + 50 * number, size)


def reds(footage):
    return [int(camera.image(0)[0, 0, 0]) for camera in footage.cameras]


def is_rig(footage, cameras):
    assert len(footage.cameras) == len(cameras)
    for found, expected in zip(footage.cameras, cameras, strict=True):
        np.testing.assert_allclose(
            found.camera.world_to_camera, expected.world_to_camera, atol=1e-6
        )


# COLMAP


def write_colmap_binary(folder, cameras, names, model=1, distortion=()):
    """A model as COLMAP's C++ writes it: a camera (by default PINHOLE) an image, without points."""
    folder.mkdir(parents=True, exist_ok=True)
    lenses = images = struct.pack("<Q", len(names))
    for number, (camera, name) in enumerate(zip(cameras, names, strict=True), start=1):
        lens = camera.fl_x, camera.fl_y, camera.cx, camera.cy, *distortion
        head = struct.pack("<IiQQ", number, model, camera.width, camera.height)
        lenses += head + struct.pack(f"<{len(lens)}d", *lens)
        pose = *quaternion(camera.world_to_camera[:3, :3]), *camera.world_to_camera[:3, 3]
        images += struct.pack("<I7dI", number, *pose, number) + name.encode() + b"\0"
        images += struct.pack("<Q", 0)
    (folder / "cameras.bin").write_bytes(lenses)
    (folder / "images.bin").write_bytes(images)


def without_point_lines(text):
    return "".join(line for line in text.splitlines(True) if line.endswith(".png\n"))


def with_points(text):
    """Ten points behind each image: 30 words."""
    lines = without_point_lines(text).splitlines()
    return "\n".join(part for line in lines for part in (line, "1.5 2.25 -1 " * 10)) + "\n"


@pytest.mark.parametrize(
    "change",
    [
        without_point_lines,
        with_points,
        lambda text: "\n".join(line for line in text.splitlines() if line),
        lambda text: text.replace("\n", "\r\n"),
    ],
)
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_text_models_with_and_without_points(tmp_path, change, encoding):
    """Catches every second camera lost where a program writes no lines of points, or only some."""
    write_colmap_text(tmp_path / "sparse/0", rig(), NAMES)
    path = tmp_path / "sparse/0/images.txt"
    text = change(path.read_text(encoding="utf-8"))
    path.write_bytes(text.encode(encoding))
    write_images(tmp_path / "images")
    footage = open_footage(tmp_path)
    is_rig(footage, rig())
    assert reds(footage) == [0, 50, 100]
    assert footage.warnings == ()


def test_a_line_that_is_neither_image_nor_points(tmp_path):
    """Catches a damaged line of points that is skipped, and with it the camera behind it."""
    write_colmap_text(tmp_path / "sparse/0", rig(), NAMES)
    rewrite(tmp_path / "sparse/0/images.txt", ("1.5 2.5 -1", "1.5 2.5 -1 7"))
    write_images(tmp_path / "images")
    message = r"images.txt: line 3: expected number, quaternion, .* or its points by 3 numbers each"
    with refusal(message):
        open_footage(tmp_path)


@pytest.mark.parametrize("write", [write_colmap_text, write_colmap_binary])
def test_of_several_models_that_of_most_images(tmp_path, write):
    """Catches sparse/0 of one image taken where sparse/1 has the rig, and images without a camera
    that nobody names."""
    write(tmp_path / "sparse/0", rig(1), NAMES[:1])
    write(tmp_path / "sparse/1", rig(3)[1:], NAMES[1:])
    write_images(tmp_path / "images")
    footage = open_footage(tmp_path)
    is_rig(footage, rig()[1:])
    model = tmp_path / "sparse/1"
    assert footage.warnings == (
        f"{model}: is the calibration; not used: sparse/0",
        f"{tmp_path}: 1 of 3 images have no camera in {model}: images/cam0.png",
    )
    assert len(open_footage(tmp_path, cameras=tmp_path / "sparse/0").cameras) == 1
    is_rig(open_footage(tmp_path, cameras=tmp_path / "sparse"), rig()[1:])


def test_folders_of_3dgs(tmp_path, monkeypatch):
    """Catches originals taken for the undistorted images of the same names, one and the other way;
    and folders of a camera each that are mixed of both."""
    write_colmap_binary(tmp_path / "sparse/0", rig(2), NAMES[:2])
    write_colmap_binary(tmp_path / "distorted/sparse/0", rig(), NAMES)
    write_images(tmp_path / "images", NAMES[:2], 7)
    write_images(tmp_path / "input", NAMES, 8)
    footage = open_footage(tmp_path)
    assert reds(footage) == [7, 57]
    assert "3 of 5 images have no camera" in footage.warnings[1]
    assert footage.warnings[1].endswith(": input (3)")
    monkeypatch.chdir(tmp_path)
    footage = open_footage(Path(), cameras=Path("distorted/sparse/0"))
    assert reds(footage) == [8, 58, 108]
    rigged = tmp_path / "rig"
    write_colmap_binary(rigged / "sparse/0", rig(2), ["a/1.png", "b/1.png"])
    for name in "ab":
        write_images(rigged / "images" / name, ["1.png", "2.png"], 7)
        write_images(rigged / "input" / name, ["1.png", "2.png", "3.png"], 8)
    footage = open_footage(rigged)
    assert footage.timesteps == (0, 1)
    assert reds(footage) == [7, 7]


def test_a_workspace_of_colmap(tmp_path):
    """Catches the originals under an undistorted model: COLMAP writes images beside `sparse`."""
    write_colmap_binary(tmp_path / "dense/0/sparse", rig(), NAMES)
    write_images(tmp_path / "dense/0/images", NAMES, 7)
    write_images(tmp_path / "images", NAMES, 8)
    assert reds(open_footage(tmp_path)) == [7, 57, 107]


# RealityCapture and RealityScan


def table(header=HEADER, delimiter=",", first=""):
    lines = [header, *(csv_line(n, camera) for n, camera in zip(NAMES, rig(), strict=True))]
    text = first + "\n".join(lines) + "\n"
    if delimiter == ";":  # as a German spreadsheet saves it
        return text.replace(",", ";").replace(".", ",").replace(",png", ".png")
    return text.replace(",", delimiter)


REALITYSCAN = "#name,x,y,alt,yaw,pitch,roll,f_35mm,px_norm,py_norm,k1,k2,k3,k4,t1,t2"
BY_HAND = HEADER.replace("#name", "Image_Name").replace("heading", "Yaw").replace("alt", "Z")
TABLES = {
    "RealityScan 2": table(REALITYSCAN).encode(),
    "count before": table(first="#cameras 3\n").encode(),
    "spreadsheet": table(delimiter=";").encode(),
    "spreadsheet that names its delimiter": ("sep=;\n" + table(REALITYSCAN, ";")).encode("utf-16"),
    "tabs in UTF-16": table(delimiter="\t").encode("utf-16"),
    "capitals and mark": b"\xef\xbb\xbf" + table(HEADER.upper()).encode(),
    "headings by hand": table(BY_HAND).encode(),
}


@pytest.mark.parametrize("kind", TABLES)
def test_tables_of_realitycapture(tmp_path, kind):
    """Catches photos of a rig taken for a video of one camera, because the headings are those of
    another version, or the table was saved by another program; angles of another order or sense,
    and a principal point in another unit."""
    (tmp_path / "cameras.csv").write_bytes(TABLES[kind])
    write_images(tmp_path / "images")
    footage = open_footage(tmp_path)
    is_rig(footage, rig())
    assert reds(footage) == [0, 50, 100]
    lens = WIDTH / 2, WIDTH / 2, 0.51 * WIDTH, HEIGHT / 2 - 0.02 * WIDTH
    assert intrinsics(footage.cameras[0].camera) == pytest.approx(lens)
    assert footage.warnings == ()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (
            "cameras.csv",
            "#name,t0,t1,t2,r00,r01,r02,f_pix,px_pix\na,1,2,3,1,0,0,9,9\n",
            "cameras.csv: has no column x, y, alt, heading, pitch, roll, f; expected internal and",
        ),
        ("cameras.bin", "", "cameras.bin: looks like a calibration, but is not understood"),
        ("bundle.out", "# Bundle file v0.3\n8 100\n", "bundle.out: looks like a calibration"),
        ("a.nvm", "NVM_V3\n\n8\n", "a.nvm: looks like a calibration"),
        ("cameras.sfm", '{"version": ["1", "2", "4"], "views": []}', "cameras.sfm: looks like"),
        ("blocks.xml", '<?xml version="1.0"?><BlocksExchange version="2.1">', "blocks.xml: looks"),
        ("out.xml", '<?xml version="1.0"?><opencv_storage><camera_matrix/>', "out.xml: looks like"),
        ("intri.yml", "%YAML:1.0\n---\nnames:\n", "intri.yml: looks like a calibration"),
        (
            "cameras.json",
            '[{"id": 0, "img_name": "cam0", "width": 40, "fx": 50.0}]',
            "cameras.json: looks like a calibration, but is not understood; expected transf",
        ),
        ("poses_bounds.npy", "\x93NUMPY", "poses_bounds.npy: looks like a calibration"),
    ],
)
def test_calibrations_that_are_not_read(tmp_path, name, content, message):
    """Catches hours of tracking one camera without depth, beside a calibration of another
    program."""
    (tmp_path / name).write_text(content, encoding="utf-8")
    write_images(tmp_path / "images")
    with refusal(message):
        open_footage(tmp_path)
    write_colmap_binary(tmp_path / "sparse/0", rig(), NAMES)
    assert f"not used: {name}" in open_footage(tmp_path).warnings[0]


@pytest.mark.parametrize("name", ["notes.csv", "take.csv", "C0001M01.XML", "video_metadata.json"])
def test_other_tables_are_no_calibrations(tmp_path, name):
    """Catches a video of a phone that is refused for the files that its app writes beside it."""
    content = {
        "notes.csv": "name,shot,date,x,y,z\ncam0,1,2,3,4,5\n",
        "take.csv": "Timecode,BlendShapeCount,HeadYaw,HeadPitch,HeadRoll\n0,0,0,0,0\n",
        "C0001M01.XML": '<?xml version="1.0"?><NonRealTimeMeta><Device manufacturer="Sony"/>',
        "video_metadata.json": '{"FrameRate": 60, "Resolution": "1280x720"}',
    }
    (tmp_path / name).write_text(content[name])
    write_images(tmp_path / "images")
    assert len(open_footage(tmp_path).cameras) == 1


def test_xmp_in_folders_of_cameras(tmp_path):
    """Catches XMP files of images named alike, those of images that were not aligned, and those of
    a photo program taken for cameras."""
    for number, camera in enumerate(rig()):
        write_xmp(tmp_path / f"cam{number}/IMG_1.xmp", camera, "perspective", "0 0 0 0 0 0")
        write_image(tmp_path / f"cam{number}/IMG_1.jpg", 50 * number)
    is_rig(open_footage(tmp_path), rig())
    rewrite(tmp_path / "cam2/IMG_1.xmp", ("xcr:Rotation>", "xcr:Other>"))
    footage = open_footage(tmp_path)
    is_rig(footage, rig(2))
    left_out = f"{tmp_path}: left out cameras without a pose: cam2/IMG_1"
    unused = f"{tmp_path}: 1 of 3 images have no camera in {tmp_path}: cam2/IMG_1.jpg"
    assert footage.warnings == (left_out, unused)
    single = tmp_path / "single"
    write_images(single / "images")
    photo = '<x:xmpmeta xmlns:x="adobe:ns:meta/" xmlns:crs="http://ns.adobe.com/camera-raw/"/>'
    (single / "images/cam0.xmp").write_text(photo)
    assert len(open_footage(single).cameras) == 1


# Metashape


def test_groups_of_metashape(tmp_path):
    """Catches images named alike that are told apart by their folders, which Metashape makes groups
    of, and a group that is no folder."""
    write_export(tmp_path / "cameras.xml", rig(), ["IMG_1"] * 3)
    path = tmp_path / "cameras.xml"
    parts = path.read_text(encoding="utf-8").split("\n<camera ")
    for number in range(1, 4):
        parts[number] = f'<group id="{number}" label="cam{number - 1}"><camera {parts[number]}'
        parts[number] = parts[number].replace("</camera>", "</camera></group>", 1)
    text = "".join(parts).replace('<group id="0" label="Group 1" type="folder">', "", 1)
    path.write_text(text.replace("</group></group>", "</group>"), encoding="utf-8")
    for number in range(3):
        write_image(tmp_path / f"cam{number}/IMG_1.jpg", 50 * number)
    pytest.importorskip("cv2")
    footage = open_footage(tmp_path)
    assert [camera.name for camera in footage.cameras] == ["cam0", "cam1", "cam2"]
    is_rig(footage, rig())
    assert footage.warnings == (f"{path}: left out cameras without a pose: spare",)


def changed_export(folder, changes):
    write_export(folder / "cameras.xml", rig(), ["cam0", "cam1", "cam2"], intrinsics={"f": 50.0})
    rewrite(folder / "cameras.xml", *changes)
    write_images(folder / "images")


SECOND_CHUNK = """<chunk label="Old"><sensors><sensor id="0" type="frame">
<resolution width="40" height="30"/><calibration class="adjusted" type="frame"><f>9</f>
</calibration></sensor></sensors><cameras><camera id="0" sensor_id="0" label="cam0">
<transform>1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1</transform></camera></cameras></chunk>"""


@pytest.mark.parametrize(
    ("changes", "cameras", "sentence"),
    [
        (
            [('component_id="0" label="cam2"', 'component_id="1" label="cam2"')],
            rig(2),
            r"left out smaller alignments: component 1 \(1 cameras\)",
        ),
        (
            [('component_id="0" label="cam2"', 'enabled="false" component_id="0" label="cam2"')],
            rig(2),
            "left out disabled cameras: Group 1/cam2",
        ),
        (
            [('<document version="2.0.0">', '<document version="2.0.0">' + SECOND_CHUNK)],
            rig(),
            r"left out smaller alignments: chunk 'Old' \(1 cameras\)",
        ),
        ([('encoding="UTF-8"', 'encoding="utf-8" standalone="yes"')], rig(), "spare"),
        ([('type="frame"', 'type="equidistant_fisheye"')], rig(), "spare"),
        ([('type="frame"', 'type="equisolid_fisheye"')], rig(), "spare"),
    ],
)
def test_exports_of_metashape(tmp_path, changes, cameras, sentence):
    """Catches a project refused, or read with another chunk's sensors, where one alignment of it is
    the rig."""
    pytest.importorskip("cv2")
    changed_export(tmp_path, changes)
    footage = open_footage(tmp_path)
    is_rig(footage, cameras)
    assert any(sentence.replace("\\", "") in warning for warning in footage.warnings)


@pytest.mark.parametrize(
    "changes",
    [
        [("<f>50.0</f>", "")],
        [("<calibration", "<lens"), ("</calibration", "</lens")],
    ],
)
def test_sensor_without_calibration(tmp_path, changes):
    """Catches a traceback for cameras that were placed without calibrating their sensor."""
    if len(changes) == 1:
        changes = [*changes, ("<f>7</f>", "")]
    changed_export(tmp_path, changes)
    with refusal("sensor '0': has no calibration with f; align the cameras and export them again"):
        open_footage(tmp_path)


# Transforms files


def scaled(matrix, factor=2.5):
    matrix = np.array(matrix)
    matrix[:3, :3] *= factor
    return matrix.tolist()


def without_suffix(frame):
    return frame | {"file_path": frame["file_path"].removesuffix(".jpg")}


@pytest.mark.parametrize(
    ("change", "sentences", "timed"),
    [
        (lambda frame: frame | {"transform_matrix": frame["transform_matrix"][:3]}, 0, False),
        (lambda frame: frame | {"transform_matrix": scaled(frame["transform_matrix"])}, 1, True),
        (without_suffix, 0, False),
        (without_suffix, 0, True),
    ],
)
def test_matrices_and_names_of_exporters(tmp_path, change, sentences, timed):
    """Catches 3 x 4 matrices, cameras of a scaled object, and names without suffix of JPEGs that
    are refused; and a scale that moves the camera."""
    frames = []
    for number, camera in enumerate(rig()):
        write_image(tmp_path / f"images/f.{number:04d}.jpg", 50 * number)
        frame = entry(camera, f"images/f.{number:04d}.jpg")
        del frame["w"], frame["h"]
        timestep = {"timestep_index": 0, "camera_index": number} if timed else {}
        frames.append(change(frame) | timestep)
    write_json(tmp_path / "transforms.json", {"frames": frames})
    footage = open_footage(tmp_path)
    is_rig(footage, rig())
    assert len(footage.warnings) == sentences
    assert (
        sentences == 0
        or "scale of transform_matrix was left out (in 3 of 3 frames)" in footage.warnings[0]
    )


@pytest.mark.parametrize(
    "folder", ["/home/anna/take/images", "C:\\take\\images", "../../take/images"]
)
def test_transforms_with_paths_of_elsewhere(tmp_path, folder):
    """Catches images that are refused for the folder in which the calibration ran (colmap2nerf.py),
    or for another computer's."""
    slash = "\\" if "\\" in folder else "/"
    paths = [f"{folder}{slash}{name}" for name in NAMES]
    frames = [entry(camera, path) for camera, path in zip(rig(), paths, strict=True)]
    write_json(tmp_path / "transforms.json", {"frames": frames})
    write_images(tmp_path / "images")
    footage = open_footage(tmp_path)
    is_rig(footage, rig())
    assert reds(footage) == [0, 50, 100]
    frames[0]["file_path"] = "/etc/passwd"
    write_json(tmp_path / "transforms.json", {"frames": frames})
    with refusal("has no image, folder or video of the name '/etc/passwd'"):
        open_footage(tmp_path)


def test_transforms_of_another_name(tmp_path):
    """Catches photos taken for a video because the file is not called transforms.json."""
    frames = [entry(camera, f"images/{n}") for n, camera in zip(NAMES, rig(), strict=True)]
    write_json(tmp_path / "cameras.json", {"frames": frames})
    write_images(tmp_path / "images")
    is_rig(open_footage(tmp_path), rig())


# What nobody used


def test_inputs_that_nobody_uses_are_named(tmp_path):
    """Catches a camera's video, a mask, a plate or photos in another format that are left out
    without a warning."""
    write_colmap_binary(tmp_path / "sparse/0", rig(2), ["left/1.png", "right/1.png"])
    for name in ("left", "right", "third"):
        write_images(tmp_path / "images" / name, ["1.png", "2.png"])
    write_video(tmp_path / "extra.mp4", [10, 20])
    write_image(tmp_path / "masks/left/1.png")
    write_image(tmp_path / "masks/lefft/2.png")
    write_image(tmp_path / "plates/left.png")
    write_image(tmp_path / "plates/back.png")
    (tmp_path / "IMG_1.HEIC").write_bytes(b"\0\0\0\x18ftypheic")
    warnings = open_footage(tmp_path).warnings
    model = tmp_path / "sparse/0"
    assert warnings[:1] == (
        f"{tmp_path}: 3 of 7 images and videos have no camera in {model}: "
        "extra.mp4, images/third (2)",
    )
    assert [
        warning.removeprefix(f"{tmp_path}: ").partition(";")[0] for warning in warnings[1:]
    ] == [
        "does not read IMG_1.HEIC",
        "1 masks are of no image: masks/lefft/2.png",
        "1 plates are of no camera: plates/back.png",
    ]


def test_images_of_the_calibration_are_used(tmp_path):
    """Catches a warning of images that the cameras of videos were calibrated with."""
    write_colmap_binary(tmp_path / "sparse/0", rig(2), ["left.png", "right.png"])
    write_images(tmp_path / "images", ["left.png", "right.png"])
    for name in ("left", "right"):
        write_video(tmp_path / f"videos/{name}.mp4", [10, 20])
    footage = open_footage(tmp_path)
    assert footage.timesteps == (0, 1)
    assert footage.warnings == ()


def test_what_is_no_footage(tmp_path):
    """Catches a sentence about something else for a missing file, one photo, and a text."""
    Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / "a.png")
    (tmp_path / "a.txt").write_text("no footage")
    for name, message in (
        ("none.mp4", "none.mp4: does not exist"),
        ("a.png", "a.png: is one image; put photos into a folder"),
        ("a.txt", "a.txt: is neither a folder nor a video; expected a folder of photos or one of"),
    ):
        with refusal(message):
            open_footage(tmp_path / name)


def turned(path, orientation, size):
    """A photo whose stored pixels are red at the top left, with EXIF's orientation."""
    image = Image.new("RGB", size, (0, 10, 20))
    image.paste((255, 10, 20), (0, 0, size[0] // 2, size[1] // 2))
    exif = Image.Exif()
    exif[0x0112] = orientation
    path.parent.mkdir(parents=True, exist_ok=True)
    image.save(path, exif=exif)


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
@pytest.mark.parametrize("write", [write_colmap_text, write_export])
def test_exif_is_ignored_as_it_was_in_the_calibration(tmp_path, orientation, write):
    """Catches photos of a camera on its side or upside down turned, but not their poses."""
    names = ["a.png", "b.png"]
    if write is write_export:
        write(tmp_path / "cameras.xml", rig(2), names)
    else:
        write(tmp_path / "sparse/0", rig(2), names)
    for name in names:
        turned(tmp_path / "images" / name, orientation, (WIDTH, HEIGHT))
    footage = open_footage(tmp_path)
    for camera in footage.cameras:
        assert camera.image(0)[2, 2, 0] > 200
        assert camera.image(0)[-3, -3, 0] < 50
    told = [text for text in footage.warnings if "EXIF" in text]
    assert len(told) == (orientation != 1)


@pytest.mark.parametrize(
    ("size", "factor"),
    [((WIDTH // 4, HEIGHT // 4), 0.25), ((2 * WIDTH, 2 * HEIGHT), 2), ((27, 20), 27 / 40)],
)
def test_a_calibration_of_another_size(tmp_path, size, factor):
    """Catches reduced images refused, or read with the focal length of the others."""
    write_colmap_text(tmp_path / "sparse/0", rig(), NAMES)
    write_images(tmp_path / "images", size=size)
    footage = open_footage(tmp_path)
    camera = footage.cameras[0].camera
    assert (camera.width, camera.height) == size
    assert intrinsics(camera)[0] == pytest.approx(factor * rig()[0].fl_x)
    assert camera.cy == pytest.approx(size[1] / 2)
    assert any("which is scaled by" in text for text in footage.warnings)
    write_images(tmp_path / "images", size=(WIDTH, WIDTH))
    with refusal(r"has 40 x 40 pixels, but .* has 40 x 30"):
        open_footage(tmp_path)
