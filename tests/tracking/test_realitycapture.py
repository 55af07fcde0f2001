"""RealityCapture's CSV and XMP, in the structure of real ones."""

import numpy as np
import pytest

from stga_addon.errors import StgaError
from stga_addon.tracking.footage.calibrations import (
    read_realitycapture_csv,
    read_realitycapture_xmp,
)
from stga_addon.tracking.footage.open import open_footage

from .scenes import HEIGHT, WIDTH, rig, write_image

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
COEFFICIENTS = "-0.124217384759894 0.107339706650415 -0.0104748224573926 0.002 0.003 -0.004"


def words(array):
    return " ".join(map(repr, np.ravel(array).tolist()))


def write_xmp(path, camera, model="brown4t2", coefficients=COEFFICIENTS, as_attributes=False):
    rotation, position = words(camera.world_to_camera[:3, :3]), words(camera.position)
    elements = f"<xcr:Rotation>{rotation}</xcr:Rotation><xcr:Position>{position}</xcr:Position>"
    attributes = f' xcr:Rotation="{rotation}" xcr:Position="{position}"'
    parts = {"attributes": attributes * as_attributes, "elements": elements * (not as_attributes)}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(XMP.format(model=model, coefficients=coefficients, **parts), encoding="utf-8")


def intrinsics(camera):
    return [camera.fl_x, camera.fl_y, camera.cx, camera.cy]


@pytest.mark.parametrize("as_attributes", [False, True])
def test_xmp(tmp_path, as_attributes):
    """Catches either form of the pose, a focal length not of the longer side, and swapped
    tangential coefficients."""
    camera = rig()[1]
    write_xmp(tmp_path / "b.xmp", camera, as_attributes=as_attributes)
    (shot,), left_out = read_realitycapture_xmp(tmp_path.glob("*.xmp"), lambda label: (30, 40))
    assert (shot.label, left_out) == ("b", [])
    np.testing.assert_allclose(shot.camera.world_to_camera, camera.world_to_camera, atol=1e-12)
    focal = 24.3765359225552 / 36 * 40
    found = intrinsics(shot.camera)
    np.testing.assert_allclose(found, [focal, focal, 15 - 0.0046 * 40, 20 + 0.0082 * 40])
    x, y = 0.3, -0.2
    r2 = x * x + y * y
    k1, k2, k3, k4, t1, t2 = map(float, COEFFICIENTS.split())
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3 + k4 * r2**4
    expected = (
        x * radial + t1 * (r2 + 2 * x * x) + 2 * t2 * x * y,
        y * radial + t2 * (r2 + 2 * y * y) + 2 * t1 * x * y,
    )
    np.testing.assert_allclose(shot.lens.distort(np.array([x, y])), expected, atol=1e-12)


def test_xmp_beside_the_images(tmp_path):
    """Catches XMP files not being found, and those of images that were not aligned."""
    for number, (name, camera) in enumerate(zip("abc", rig(), strict=True)):
        write_image(tmp_path / f"images/{name}.jpg", 50 * number)
        write_xmp(tmp_path / f"images/{name}.xmp", camera, "perspective", "0 0 0 0 0 0")
    path = tmp_path / "images/c.xmp"
    text = path.read_text(encoding="utf-8").replace("xcr:Rotation>", "xcr:Other>")
    path.write_text(text, encoding="utf-8")
    footage = open_footage(tmp_path)
    assert [camera.name for camera in footage.cameras] == ["a", "b"]
    assert footage.warnings == (f"{tmp_path / 'images'}: left out cameras without a pose: c",)


def csv_line(name, camera, rest="18,0.01,-0.02,0,0,0,0,0,0"):
    """Heading, pitch and roll of a camera: z-x-y angles of its pose with OpenGL axes, heading
    clockwise."""
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_matrix(camera.camera_to_world_gl[:3, :3])
    yaw, pitch, roll = rotation.as_euler("ZXY", degrees=True)
    values = *camera.position.tolist(), -yaw, pitch, roll
    return f"{name},{','.join(map(repr, map(float, values)))},{rest}"


def test_csv(tmp_path):
    """Catches angles of another order or sense, and a principal point in another unit."""
    named = zip("abc", rig(), strict=True)
    lines = [HEADER, *(csv_line(f"{name}.png", camera) for name, camera in named)]
    (tmp_path / "cameras.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    for number, name in enumerate("abc"):
        write_image(tmp_path / f"images/{name}.png", 50 * number)
    footage = open_footage(tmp_path)
    assert [camera.image(0)[0, 0, 0] for camera in footage.cameras] == [0, 50, 100]
    for camera, expected in zip(footage.cameras, rig(), strict=True):
        found, center = camera.camera, [WIDTH / 2 + 0.01 * WIDTH, HEIGHT / 2 - 0.02 * WIDTH]
        np.testing.assert_allclose(found.world_to_camera, expected.world_to_camera, atol=1e-9)
        np.testing.assert_allclose(intrinsics(found), [WIDTH / 2, WIDTH / 2, *center])


def test_level_camera_of_a_csv(tmp_path):
    """Catches the axes: at heading 90° and pitch 90°, a camera looks east, level, with up (z) up in
    the image."""
    text = f"{HEADER}\na.png,1,2,3,90,90,0,18,0,0,0,0,0,0,0,0\n"
    (tmp_path / "a.csv").write_text(text, encoding="utf-8")
    (shot,) = read_realitycapture_csv(tmp_path / "a.csv", lambda label: (40, 30))
    expected = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]  # right, down, forward
    np.testing.assert_allclose(shot.camera.world_to_camera[:3, :3], expected, atol=1e-12)
    np.testing.assert_allclose(shot.camera.position, [1, 2, 3], atol=1e-12)


def test_two_calibrations(tmp_path):
    """Catches one of two exports silently chosen."""
    for name in ("first.csv", "second.csv"):
        text = f"{HEADER}\na.png,1,2,3,0,0,0,18,0,0,0,0,0,0,0,0\n"
        (tmp_path / name).write_text(text, encoding="utf-8")
    write_image(tmp_path / "a.png")
    with pytest.raises(StgaError, match=r"first.csv and second.csv are calibrations; choose one"):
        open_footage(tmp_path)
    assert len(open_footage(tmp_path, cameras=tmp_path / "second.csv").cameras) == 1
