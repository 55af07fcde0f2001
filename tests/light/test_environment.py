"""Environments and files of lights: what is written is read, and an environment keeps its light."""

import itertools
import struct

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refusal import refusal

from stga_addon.light.environment import (
    pixel_directions,
    read_hdr,
    read_lighting,
    split_environment,
    turned,
)
from stga_addon.light.harmonics import LAMBERT, basis


def rgbe(pixels):
    """(…, 4) uint8 of radiance (…, 3): Ward's shared exponent, rounded down."""
    exponent = np.floor(np.log2(np.maximum(pixels.max(-1), 1e-30))).astype(int) + 1
    mantissa = np.floor(pixels * 256 / np.exp2(exponent)[..., None])
    return np.concatenate([mantissa, exponent[..., None] + 128], axis=-1).astype(np.uint8)


def write_hdr(path, pixels, packed):
    """A Radiance picture with flat rows, or run-length encoded ones."""
    height, width = pixels.shape[:2]
    body = rgbe(pixels)
    data = b""
    for row in body:
        if not packed:
            data += row.tobytes()
            continue
        data += struct.pack(">BBH", 2, 2, width)
        for channel in row.T:
            rest = channel
            if len(set(channel)) == 1:
                data = data + bytes([255, channel[0]])
                rest = channel[127:]
            for start in range(0, len(rest), 100):
                part = rest[start : start + 100]
                data += bytes([len(part)]) + part.tobytes()
    header = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\nEXPOSURE=1\n\n"
    path.write_bytes(header + b"-Y %d +X %d\n" % (height, width) + data)
    return path


@pytest.mark.parametrize("packed", [False, True])
def test_hdr_pixels(tmp_path, packed):
    """Catches rows, channels or exponents that are read wrongly, flat and run-length encoded."""
    pixels = np.exp(np.random.default_rng(0).normal(size=(5, 200, 3)) * 3)
    pixels[1] = [0.5, 2.0, 100.0]
    path = write_hdr(tmp_path / "a.hdr", pixels, packed)
    found = read_hdr(path)
    assert found.dtype == np.float32
    scale = np.exp2(np.floor(np.log2(pixels.max(-1, keepdims=True))) + 1) / 256
    assert (np.abs(found - pixels) <= scale).all()
    whole = path.read_bytes()
    damaged = tmp_path / "b.hdr"
    huge = whole.replace(b"-Y 5 +X 200", b"-Y 999999 +X 999999")
    large = whole.replace(b"-Y 5 +X 200", b"-Y 9000 +X 9000")  # 972 MB
    picture = cv2.imencode(".tiff", np.zeros((9, 9, 3), np.float32))[1].tobytes()
    for data in (whole[:-1], whole[:40], whole[:10], b"", huge, large, picture):
        damaged.write_bytes(data)
        with refusal(
            r"b\.hdr: claims \d+ x \d+ pixels" if data in (huge, large) else r"b\.hdr: is no"
        ):
            read_hdr(damaged)


def old_runs(pixels):
    """Pixels (H, W, 4) uint8 with runs of equal ones as Radiance wrote them at first: one pixel,
    then (1, 1, 1, byte) for each byte of the number of others, from the lowest."""
    data = b""
    for row in pixels:
        starts = [0, *1 + np.flatnonzero((row[1:] != row[:-1]).any(axis=1)), len(row)]
        for start, end in itertools.pairwise(starts):
            data += row[start].tobytes()
            others = int(end - start - 1)
            while others:
                data += bytes([1, 1, 1, others & 255])
                others >>= 8
    return data


@pytest.mark.parametrize("width", [6, 40, 900])
def test_old_runs_and_other_orders(tmp_path, width):
    """Catches runs of the older encoding read as colors, silently where bytes follow the pixels,
    and pictures in another order of pixels called damaged."""
    pixels = np.exp(np.random.default_rng(0).normal(size=(4, width, 3)))
    pixels[:, 3:-2] = [0.5, 2.0, 30.0]
    pixels[2] = 0.25
    path = write_hdr(tmp_path / "a.hdr", pixels, False)
    expected = read_hdr(path)
    size = b"-Y 4 +X %d\n" % width
    header = path.read_bytes().partition(size)[0]
    data = old_runs(rgbe(pixels))
    for padding in (b"", bytes(16 * width)):
        path.write_bytes(header + size + data + padding)
        assert_array_equal(read_hdr(path), expected)
    for body in (data[:-8], b"\1\1\1\5" + data, data[:4] + b"\1\1\1\0" * 4 + data[4:]):
        path.write_bytes(header + size + body)
        with refusal(r"a\.hdr: is no"):
            read_hdr(path)
    path.write_bytes(header + b"+Y 4 +X %d\n" % width + data)
    with refusal(r"a\.hdr: its pixels follow in the order \+Y \+X"):
        read_hdr(path)


def test_an_environment_keeps_its_irradiance():
    """Catches suns counted twice, solid angles of poles, and directions other than Blender's."""
    image = np.full((64, 128, 3), 0.2)
    vectors, angle = pixel_directions(64, 128)
    assert (angle * 128).sum() == pytest.approx(4 * np.pi)
    assert_allclose(vectors[32, 64], [1, 0, 0], atol=0.05)
    assert_allclose(vectors[32, 32], [0, 1, 0], atol=0.05)
    sun = vectors @ (toward := np.array([0.6, 0.0, 0.8])) > np.cos(np.radians(4))
    image[sun] = [400.0, 300.0, 200.0]
    world, suns = split_environment(image, np.eye(3))
    assert len(suns) == 1
    assert_allclose(-suns[0].direction, toward, atol=0.02)
    assert 0.1 < suns[0].angle < 0.2
    for normal in (toward, np.array([1.0, 0, 0]), np.array([0, 0, -1.0])):
        truth = (image * angle[..., None] * np.maximum(vectors @ normal, 0)[..., None]).sum((0, 1))
        found = (basis(normal[None]) * LAMBERT @ world)[0]
        found += suns[0].color * max(-suns[0].direction @ normal, 0)
        assert_allclose(found, truth, rtol=0.02, atol=0.05)
    whole = split_environment(image, np.eye(3), max_suns=0)[0]
    assert_allclose(whole[0], world[0] + suns[0].color * 0.28209, rtol=1e-3)


@pytest.mark.parametrize("height", [191, 383, 518, 1000])
def test_a_height_that_does_not_divide(height):
    """Catches the lowest rows and the last columns of a world left out of its light."""
    vectors, angle = pixel_directions(height, 2 * height)
    image = np.asarray(1 + vectors - vectors[..., [2]], np.float32)
    truth = basis(vectors.reshape(-1, 3)).T @ (image * angle[..., None]).reshape(-1, 3)
    found = split_environment(image, np.eye(3), max_suns=0)[0]
    assert_allclose(found, truth, atol=2e-4 * np.abs(truth).max())


def test_lights_of_a_text_file(tmp_path):
    """Catches defaults, strength and color that are lost, and mistakes without a sentence."""
    path = tmp_path / "lights.toml"
    sun = 'kind = "sun"\nstrength = 3\ncolor = [1, 0.5, 0.25]\ndirection = [0, -2, 0]'
    area = 'kind = "area"\nstrength = 10\nposition = [1, 1, 1]\nsize = [0.2, 0.4]'
    rest = "world = [0.1, 0.2, 0.3]\nexposure = 1.5"
    path.write_text(f"{rest}\n[[lights]]\n{sun}\n[[lights]]\n{area}\n")
    lighting = read_lighting(path)
    assert_allclose(lighting.lights[0].color, [3, 1.5, 0.75])
    assert_allclose(lighting.lights[0].direction, [0, -1, 0])
    assert (lighting.exposure, lighting.lights[1].size, lighting.shadows) == (1.5, (0.2, 0.4), True)
    assert_allclose((basis(np.eye(3)[:1]) @ lighting.world)[0], [0.1, 0.2, 0.3])
    around = turned(lighting, np.zeros(3), 90)
    assert_allclose(around.lights[1].position, [1, 1, -1], atol=1e-9)
    for text, message in (
        ("lights = 3", "lights"),
        ('[[lights]]\nkind = "laser"\nstrength = 1', "kind"),
        ('[[lights]]\nkind = "sun"\nstrength = -1', "strength"),
        ("sky = 1", "sky"),
        ("world = ", "TOML"),
        ("roughness = 0", "roughness"),
    ):
        path.write_text(text)
        with refusal(message):
            read_lighting(path)
    with refusal(r"\.hdr"):
        read_lighting(tmp_path / "light.png")
