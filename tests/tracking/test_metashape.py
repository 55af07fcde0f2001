"""Metashape's camera exports, in the structure of real ones."""

import re

import numpy as np
import pytest

from stga_addon.errors import StgaError
from stga_addon.tracking.footage.calibrations import read_metashape
from stga_addon.tracking.footage.open import open_footage

from .scenes import HEIGHT, WIDTH, rig, write_image

COEFFICIENTS = {
    "k1": -0.0919, "k2": -0.0763, "k3": 0.1163, "k4": -0.0761, "p1": -0.0031, "p2": 0.0012,
}  # fmt: skip
INTRINSICS = {"f": 50.0, "cx": 1.25, "cy": -2.5, "b1": 0.53, "b2": -0.31, **COEFFICIENTS}
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


def write_export(path, cameras, labels, kind="frame", intrinsics=INTRINSICS):
    found = []
    for number, (camera, label) in enumerate(zip(cameras, labels, strict=True)):
        matrix = " ".join(map(repr, np.linalg.inv(camera.world_to_camera).ravel().tolist()))
        found.append(CAMERA.format(number=number, label=label, transform=matrix))
    values = "".join(f"<{name}>{value}</{name}>" for name, value in intrinsics.items())
    text = EXPORT.format(
        kind=kind, width=WIDTH, height=HEIGHT, intrinsics=values, cameras="".join(found)
    )
    path.write_text(text, encoding="utf-8")


def projected(points, angle_of=None):
    """Pixels of camera-space points by the formulas of Metashape's manual (appendix C), in plain
    numbers."""
    values, found = INTRINSICS, []
    for x, y in points[:, :2] / points[:, 2:]:
        if angle_of:
            radius = np.hypot(x, y)
            x, y = angle_of(radius) * x / radius, angle_of(radius) * y / radius
        r2 = x * x + y * y
        radial = 1 + sum(values[f"k{n}"] * r2**n for n in (1, 2, 3, 4))
        p1, p2 = values["p1"], values["p2"]
        u = x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
        v = y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
        center = WIDTH / 2 + values["cx"], HEIGHT / 2 + values["cy"]
        across = u * values["f"] + u * values["b1"] + v * values["b2"]
        found.append((center[0] + across, center[1] + v * values["f"]))
    return np.array(found)


@pytest.mark.parametrize(("kind", "angle_of"), [("frame", None), ("fisheye", np.arctan)])
def test_projections_are_metashapes(tmp_path, kind, angle_of):
    """Catches swapped tangential coefficients, an affine term in the wrong unit, and the initial
    calibration."""
    write_export(tmp_path / "cameras.xml", rig(), ["a", "b", "c"], kind)
    shots, left_out = read_metashape(tmp_path / "cameras.xml")
    assert [shot.label for shot in shots] == ["a", "b", "c"]
    assert left_out == ["spare"]
    random = np.random.default_rng(5)
    local = np.c_[random.uniform(-0.4, 0.4, (20, 2)), np.ones(20)] * 2.0
    for shot, expected in zip(shots, rig(), strict=True):
        camera = shot.camera
        np.testing.assert_allclose(camera.world_to_camera, expected.world_to_camera, atol=1e-9)
        distorted = shot.lens.distort(local[:, :2] / local[:, 2:])
        found = distorted * [camera.fl_x, camera.fl_y] + [camera.cx, camera.cy]
        np.testing.assert_allclose(found, projected(local, angle_of), atol=1e-9)


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


def test_mirrored_axes(tmp_path):
    """Catches an export whose world was mirrored, in which left and right of the face would be
    swapped."""
    write_export(tmp_path / "cameras.xml", rig(1), ["a"], intrinsics={"f": 50.0})
    write_image(tmp_path / "a.png")
    text = (tmp_path / "cameras.xml").read_text(encoding="utf-8")
    matrix = np.linalg.inv(rig(1)[0].world_to_camera) * [[-1], [1], [1], [1]]
    mirrored = f"<transform>{' '.join(map(str, matrix.ravel()))}<"
    text = re.sub("<transform>[^<]{40,}<", mirrored, text)
    (tmp_path / "cameras.xml").write_text(text, encoding="utf-8")
    message = r"camera 'a': its axes are mirrored; expected a right-handed rotation"
    with pytest.raises(StgaError, match=message):
        open_footage(tmp_path)
