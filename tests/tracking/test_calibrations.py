"""Calibrations in the structure of real ones: transforms files, Metashape's XML, RealityCapture's
CSV and XMP. COLMAP's are in test_colmap.py."""

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from refusal import refusal

from stga_addon.tracking.footage.metashape import read_metashape
from stga_addon.tracking.footage.open import open_footage
from stga_addon.tracking.footage.realitycapture import (
    read_realitycapture_xmp,
)
from stga_addon.tracking.footage.shots import read_xml

from .scenes import HEIGHT, WIDTH, rig, write_image


def entry(camera, path, **values):
    intrinsics = {key: getattr(camera, key) for key in ("fl_x", "fl_y", "cx", "cy")}
    pose = {"transform_matrix": camera.camera_to_world_gl.tolist()}
    size = {"w": camera.width, "h": camera.height}
    return {"file_path": path, **size, **intrinsics, **pose, **values}


def write_transforms(folder, frames, name="transforms.json", **top):
    for number, frame in enumerate(frames):
        write_image(folder / frame["file_path"], 10 * number)
    (folder / name).write_text(json.dumps({**top, "frames": frames}), encoding="utf-8")


def test_a_capture_is_footage(tmp_path):
    """Catches frames that belong to another camera or timestep than the file says, and a flipped
    principal point."""
    frames = []
    for t in (0, 3):
        for c, camera in enumerate(rig(2)):
            named = {"timestep_index": t, "camera_index": c, "camera_id": f"cam{c}"}
            frames.append(entry(camera, f"images/{t:05d}_{c:02d}.png", **named, cy=12.0))
    write_transforms(tmp_path, frames)
    footage = open_footage(tmp_path)
    assert [camera.name for camera in footage.cameras] == ["cam0", "cam1"]
    assert footage.timesteps == (0, 3)
    assert [camera.image(t)[0, 0, 0] for t, camera in footage.views()] == [0, 20, 10, 30]
    assert footage.cameras[1].file(3) == tmp_path / "images/00003_01.png"
    assert footage.cameras[0].camera.cy == HEIGHT - 12.0
    found = footage.cameras[1].camera
    expected = rig(2)[1]
    assert_allclose(found.world_to_camera, expected.world_to_camera, atol=1e-9)


def test_one_image_per_pose_is_one_timestep(tmp_path):
    """Catches a nerfstudio file, whose images have no timesteps, taken for a sequence, its `cy`
    turned over; and a camera that is two because it appears in two splits."""
    frames = [entry(c, f"images/{n}.png", cy=12.0) for n, c in enumerate(rig())]
    write_transforms(tmp_path, frames, camera_model="OPENCV")
    footage = open_footage(tmp_path)
    assert [camera.name for camera in footage.cameras] == ["0", "1", "2"]
    assert footage.timesteps == (0,)
    assert footage.cameras[0].camera.cy == 12.0
    split = tmp_path / "split"
    (first, second) = rig(2)
    train = [entry(own, f"a/{n}.png", timestep_index=0) for n, own in enumerate((first, second))]
    write_transforms(split, train, "transforms_train.json")
    write_transforms(split, [entry(first, "a/2.png", timestep_index=1)], "transforms_val.json")
    assert [camera.timesteps for camera in open_footage(split).cameras] == [(0, 1), (0,)]


@pytest.mark.parametrize(
    "lens",
    [
        {"camera_model": "OPENCV", "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0},  # nerfstudio's
        {"k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "aabb_scale": 16},  # instant-ngp's
    ],
)
def test_a_timestep_does_not_mirror_the_principal_point(tmp_path, lens):
    """Catches a sequence of a camera that stands still taken for a rig; and `timestep_index`, which
    an error advises to add, taken for VHAP's convention of `cy`: the principal point moved to the
    other half of the image."""
    frames = [entry(own, f"images/{n}.png", cy=12.0) for n, own in enumerate([*rig(2), rig(2)[0]])]
    write_transforms(tmp_path, frames, **lens)
    with refusal(r"frames\[2\]: has the pose of images/0.png; expected a timestep_index"):
        open_footage(tmp_path)
    for frame, timestep in zip(frames, (0, 0, 1), strict=True):
        frame["timestep_index"] = timestep
    write_transforms(tmp_path, frames, **lens)
    footage = open_footage(tmp_path)
    assert footage.timesteps == (0, 1)
    assert [camera.camera.cy for camera in footage.cameras] == [12.0, 12.0]


def test_bad_entries_are_named(tmp_path):
    """Catches a traceback for a mask that is not there, and a frame that replaces another."""
    camera = rig(1)[0]
    write_transforms(tmp_path, [entry(camera, "images/0.png", mask_path="masks/none.png")])
    with refusal(r"masks/none.png: does not .*frames\[0\] names it"):
        open_footage(tmp_path)
    frames = [entry(camera, f"images/{n}.png", timestep_index=4, camera_index=7) for n in range(2)]
    write_transforms(tmp_path, frames)
    with refusal(r"frames\[1\]: camera 07 has two images at timestep 4"):
        open_footage(tmp_path)


# Metashape

INTRINSICS = {
    "f": 50.0,
    "cx": 1.25,
    "cy": -2.5,
    "b1": 0.53,
    "b2": -0.31,
    "k1": -0.0919,
    "k2": -0.0763,
    "k3": 0.1163,
    "k4": -0.0761,
    "p1": -0.0031,
    "p2": 0.0012,
}
EXPORT = """<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0">
  <chunk label="Chunk 1" enabled="true">
    <sensors next_id="1">
      <sensor id="0" label="unknown" type="{kind}">
        <resolution width="{width}" height="{height}"/>
        <property name="layer_index" value="0"/>
        <bands><band label="Red"/></bands>
        <calibration type="{kind}" class="initial"><resolution width="9" height="9"/><f>7</f>
        </calibration>
        <calibration type="{kind}" class="adjusted">
          <resolution width="{width}" height="{height}"/>
          {intrinsics}
        </calibration>
        <covariance><params>f cx cy</params></covariance>
      </sensor>
    </sensors>
    <components next_id="1" active_id="0">
      <component id="0" label="Component 1">
        <transform><rotation locked="false">1 0 0 0 1 0 0 0 1</rotation><scale>12.3</scale>
        </transform>
      </component>
    </components>
    <cameras next_id="9" next_group_id="1">
      <group id="0" label="Group 1" type="folder">{cameras}</group>
      <camera id="8" sensor_id="0" label="spare"><orientation>1</orientation></camera>
    </cameras>
    <transform><rotation locked="false">1 0 0 0 1 0 0 0 1</rotation><scale>2.5</scale></transform>
  </chunk>
</document>
"""
CAMERA = """
<camera id="{number}" sensor_id="0" component_id="0" label="{label}">
  <transform>{transform}</transform><orientation>1</orientation>
</camera>"""


def words(array):
    return " ".join(map(repr, np.ravel(array).tolist()))


def write_export(path, cameras, labels, kind="frame", intrinsics=INTRINSICS):
    found = []
    for number, (camera, label) in enumerate(zip(cameras, labels, strict=True)):
        matrix = words(np.linalg.inv(camera.world_to_camera))
        found.append(CAMERA.format(number=number, label=label, transform=matrix))
    values = "".join(f"<{name}>{value}</{name}>" for name, value in intrinsics.items())
    shape = {"kind": kind, "width": WIDTH, "height": HEIGHT}
    text = EXPORT.format(**shape, intrinsics=values, cameras="".join(found))
    path.write_text(text, encoding="utf-8")


def brown(x, y, coefficients):
    """A point of the image's plane, distorted by four radial and two tangential coefficients, by
    the formulas of both manuals."""
    *radial, p1, p2 = coefficients
    r2 = x * x + y * y
    factor = 1 + sum(own * r2**power for power, own in enumerate(radial, start=1))
    u = x * factor + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
    return u, y * factor + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y


def projected(points, angle_of):
    """Pixels of camera-space points by the formulas of Metashape's manual (appendix C)."""
    values = INTRINSICS
    flat = points[:, :2] / points[:, 2:]
    radius = np.linalg.norm(flat, axis=1, keepdims=True)
    x, y = (angle_of(radius) * flat / radius).T
    u, v = brown(x, y, [values[name] for name in ("k1", "k2", "k3", "k4", "p1", "p2")])
    across = u * values["f"] + u * values["b1"] + v * values["b2"]
    center = WIDTH / 2 + values["cx"], HEIGHT / 2 + values["cy"]
    return np.column_stack([across, v * values["f"]]) + center


@pytest.mark.parametrize(("kind", "angle_of"), [("frame", np.positive), ("fisheye", np.arctan)])
def test_projections_are_metashapes(tmp_path, kind, angle_of):
    """Catches swapped tangential coefficients, an affine term in the wrong unit, and the initial
    calibration."""
    write_export(tmp_path / "cameras.xml", rig(), ["a", "b", "c"], kind)
    shots, left_out = read_metashape(tmp_path / "cameras.xml")
    assert [shot.label for shot in shots] == ["Group 1/a", "Group 1/b", "Group 1/c"]
    assert left_out == ("left out cameras without a pose: spare",)
    random = np.random.default_rng(5)
    local = np.c_[random.uniform(-0.4, 0.4, (20, 2)), np.ones(20)] * 2.0
    for shot, expected in zip(shots, rig(), strict=True):
        camera = shot.camera
        assert_allclose(camera.world_to_camera, expected.world_to_camera, atol=1e-9)
        distorted = shot.lens.distort(local[:, :2] / local[:, 2:])
        found = distorted * [camera.fl_x, camera.fl_y] + [camera.cx, camera.cy]
        assert_allclose(found, projected(local, angle_of), atol=1e-9)


def test_labels_are_image_names_or_paths(tmp_path):
    """Catches labels with a suffix, without, and of another computer; and a camera silently left
    out."""
    pytest.importorskip("cv2")
    labels = ["left", "middle.png", "D:\\shoot\\day 1\\right.png"]
    write_export(tmp_path / "cameras.xml", rig(), labels)
    for number, name in enumerate(("left", "middle", "right")):
        write_image(tmp_path / f"images/{name}.png", 50 * number)
    footage = open_footage(tmp_path)
    assert [camera.name for camera in footage.cameras] == ["left", "middle", "right"]
    assert [camera.image(0)[15, 20, 0] for camera in footage.cameras] == [0, 50, 100]
    assert footage.warnings == (
        f"{tmp_path / 'cameras.xml'}: left out cameras without a pose: spare",
    )


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "utf-16-be", "iso-8859-1"])
def test_a_document_type_in_any_encoding(tmp_path, encoding):
    """Catches entities, which unfold to gigabytes, in a file whose bytes do not spell DOCTYPE."""
    text = f'<?xml version="1.0" encoding="{encoding.removesuffix("-be")}"?>'
    text += (
        '<!DOCTYPE d [<!ENTITY a "aaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]><document>&b;</document>'
    )
    mark = "\ufeff" if encoding.endswith("-be") else ""
    (tmp_path / "cameras.xml").write_bytes((mark + text).encode(encoding))
    with refusal("declares a document type; expected a calibration"):
        read_metashape(tmp_path / "cameras.xml")
    plain = mark + text.partition("?>")[0] + "?><document><chunk/></document>"
    (tmp_path / "plain.xml").write_bytes(plain.encode(encoding))
    assert read_xml(tmp_path / "plain.xml").find("chunk") is not None


def test_mirrored_axes(tmp_path):
    """Catches an export whose world was mirrored: left and right would be swapped."""
    (camera,) = rig(1)
    mirrored = replace(camera, world_to_camera=camera.world_to_camera * [-1, 1, 1, 1])
    write_export(tmp_path / "cameras.xml", [mirrored], ["a"])
    with refusal(r"camera 'Group 1/a': its axes are mirrored; expected a right-handed rotation"):
        read_metashape(tmp_path / "cameras.xml")


# RealityCapture

HEADER = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"
XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/">
  <rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">
    <rdf:Description xcr:Version="3" xcr:PosePrior="locked" xcr:Coordinates="absolute"
       xcr:DistortionModel="{model}" xcr:FocalLength35mm="24.3765359225552"
       xcr:Skew="0" xcr:AspectRatio="1" xcr:PrincipalPointU="-0.0046"
       xcr:PrincipalPointV="0.0082" xcr:CalibrationPrior="exact"{attributes}
       xmlns:xcr="http://www.capturingreality.com/ns/xcr/1.1#">
      {elements}
      <xcr:DistortionCoeficients>{coefficients}</xcr:DistortionCoeficients>
    </rdf:Description>
  </rdf:RDF>
</x:xmpmeta>
"""
XMP_COEFFICIENTS = "-0.124217384759894 0.107339706650415 -0.0104748224573926 0.002 0.003 -0.004"


def write_xmp(path, camera, model="brown4t2", coefficients=XMP_COEFFICIENTS, as_attributes=False):
    rotation = words(camera.world_to_camera[:3, :3])
    position = words(camera.position)
    elements = f"<xcr:Rotation>{rotation}</xcr:Rotation><xcr:Position>{position}</xcr:Position>"
    attributes = f' xcr:Rotation="{rotation}" xcr:Position="{position}"'
    parts = {"attributes": attributes * as_attributes, "elements": elements * (not as_attributes)}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(XMP.format(model=model, coefficients=coefficients, **parts), encoding="utf-8")


def intrinsics(camera):
    return [camera.fl_x, camera.fl_y, camera.cx, camera.cy]


@pytest.mark.parametrize("as_attributes", [False, True])
def test_xmp(tmp_path, as_attributes):
    """Catches either form of the pose, another side's focal length, and swapped coefficients."""
    camera = rig()[1]
    write_xmp(tmp_path / "b.xmp", camera, as_attributes=as_attributes)
    files = tmp_path.glob("*.xmp")
    (shot,), left_out = read_realitycapture_xmp(files, lambda label: (30, 40), tmp_path)
    assert (shot.label, left_out) == ("b", ())
    assert_allclose(shot.camera.world_to_camera, camera.world_to_camera, atol=1e-12)
    focal = 24.3765359225552 / 36 * 40
    found = intrinsics(shot.camera)
    assert_allclose(found, [focal, focal, 15 - 0.0046 * 40, 20 + 0.0082 * 40])
    expected = brown(0.3, -0.2, map(float, XMP_COEFFICIENTS.split()))
    assert_allclose(shot.lens.distort(np.array([0.3, -0.2])), expected, atol=1e-12)


def csv_line(name, camera, rest="18,0.01,-0.02,0,0,0,0,0,0"):
    """Heading, pitch and roll of a camera: z-x-y angles of its pose with OpenGL axes, heading
    clockwise."""
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_matrix(camera.camera_to_world_gl[:3, :3])
    yaw, pitch, roll = rotation.as_euler("ZXY", degrees=True)
    values = *camera.position.tolist(), -yaw, pitch, roll
    return f"{name},{','.join(map(repr, map(float, values)))},{rest}"


def test_two_exports(tmp_path):
    """Catches one of two exports silently chosen."""
    for name in ("first.csv", "second.csv"):
        (tmp_path / name).write_text(f"{HEADER}\n{csv_line('a.png', rig()[0])}\n")
    write_image(tmp_path / "a.png")
    with refusal(r"first.csv and second.csv are calibrations; choose one"):
        open_footage(tmp_path)
    assert len(open_footage(tmp_path, cameras=tmp_path / "second.csv").cameras) == 1
