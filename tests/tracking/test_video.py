"""Every frame of a video by its number, whatever the container and codec."""

import pickle
import random
import re
import struct
from fractions import Fraction

import numpy as np
import pytest
from capture.test_images import LEVELS, corners
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from refusal import refusal

from stga_addon.tracking.footage import video
from stga_addon.tracking.footage.open import open_footage

from .scenes import encode, rig, write_colmap_text

av = pytest.importorskip("av")

BLOCK = 16
COLUMNS = 6
ROWS = 4
FRAMES = 52
X264 = {
    "bf": "3",
    "b_strategy": "0",
    "g": "12",
    "keyint_min": "12",
    "sc_threshold": "0",
    "crf": "12",
}
OPEN_X264 = X264 | {"x264-params": "open-gop=1:b-adapt=0"}
OPEN_X265 = {
    "x265-params": "open-gop=1:keyint=12:min-keyint=12:scenecut=0:bframes=3:b-adapt=0:crf=12:"
    "log-level=0"
}
MPEG4 = {"g": "12", "bf": "2", "b": "4000000"}

VIDEOS = {
    "H.264 with B-frames": ("a.mp4", "libx264", X264),
    "H.264, open GOP": ("a.3gp", "libx264", OPEN_X264),
    "H.264 in a transport stream, open GOP": ("a.m2ts", "libx264", OPEN_X264),
    "H.264 in AVI": ("a.avi", "libx264", X264),
    "H.264 in Matroska": ("a.mkv", "libx264", X264),
    "HEVC, open GOP": ("a.mov", "libx265", OPEN_X265),
    "HEVC in a transport stream, open GOP": ("a.mts", "libx265", OPEN_X265),
    "MPEG-4 with B-frames in AVI": ("a.avi", "mpeg4", MPEG4),
    "MPEG-2 in a transport stream": ("a.mts", "mpeg2video", MPEG4),
    "MPEG-2 in MXF": ("a.mxf", "mpeg2video", MPEG4),
    "Motion JPEG in AVI": ("a.avi", "mjpeg", {"qmin": "2", "qmax": "3"}),
    "MPEG-2 in a program stream": ("a.VOB", "mpeg2video", MPEG4),
    "H.264 in Flash": ("a.flv", "libx264", X264),
    "Windows Media": ("a.wmv", "wmv2", {"g": "12", "b": "4000000"}),
    "VP9": (
        "a.webm",
        "libvpx-vp9",
        {"g": "12", "b": "2000000", "cpu-used": "8", "deadline": "realtime"},
    ),
    "VP8 with hidden reference frames": (
        "a.webm",
        "libvpx",
        {"g": "40", "b": "2000000", "auto-alt-ref": "1", "lag-in-frames": "10", "cpu-used": "4"},
    ),
}


def picture(number):
    """A frame that shows its number in blocks, one a bit, with the inverse in the lower half."""
    bits = (number >> np.arange(COLUMNS * ROWS // 2)) & 1
    blocks = np.concatenate([bits, 1 - bits]).reshape(ROWS, COLUMNS)
    gray = np.kron(60 + 130 * blocks, np.ones((BLOCK, BLOCK))).astype(np.uint8)
    return np.repeat(gray[..., None], 3, axis=2)


def shown(image):
    """The number that a picture shows; fails for one mixed of several or damaged."""
    gray = image.astype(float).mean(axis=2).reshape(ROWS, BLOCK, COLUMNS, BLOCK).swapaxes(1, 2)
    levels = gray[:, :, 3:-3, 3:-3].mean(axis=(2, 3)).ravel()
    bits = levels > 125
    assert np.abs(levels - np.where(bits, 190, 60)).max() < 25, levels.round()
    first, second = np.split(bits, 2)
    assert_array_equal(first, ~second)
    return int((first << np.arange(len(first))).sum())


def write_numbered(path, codec, options, frames=FRAMES, rate=25, durations=None):
    """A video of numbered pictures; durations: of each frame, in frames of `rate`."""
    if codec not in av.codecs_available:
        pytest.skip(f"this PyAV lacks {codec}")

    def set_up(stream):
        if codec == "mjpeg":
            stream.pix_fmt = "yuvj420p"
        if codec in ("mpeg4", "mpeg2video"):
            stream.codec_context.max_b_frames = int(options["bf"])

    times = durations and [sum(durations[:number]) for number in range(frames)]
    encode(path, map(picture, range(frames)), codec, options, rate, times, set_up)


def copy_packets(source, path, shift=0, first=0, last=None, options=None):
    """Copy the packets from number `first` to before `last`, in the order of decoding, `shift`
    frames earlier."""
    with av.open(str(source)) as container, av.open(str(path), "w", options=options) as out:
        stream = container.streams.video[0]
        copied = out.add_stream_from_template(stream)
        per_frame = int(1 / (stream.average_rate * stream.time_base))
        packets = [packet for packet in container.demux(stream) if packet.size]
        for packet in packets[first:last]:
            packet.pts -= shift * per_frame
            packet.dts -= shift * per_frame
            packet.stream = copied
            out.mux(packet)


def packets_of(path):
    with av.open(str(path)) as container:
        return [packet for packet in container.demux(video=0) if packet.size]


def orders(count):
    shuffled = list(range(count))
    random.Random(1).shuffle(shuffled)
    return {
        "in order": list(range(count)),
        "every third": list(range(0, count, 3)),
        "shuffled": shuffled,
        "last first": [count - 1, 0, count - 1, *range(count - 2, -1, -7)],
    }


def assert_numbers(path, expected):
    """Each frame, however it is reached, is the picture of its number."""
    camera = open_footage(path).cameras[0]
    assert camera.timesteps == tuple(range(len(expected)))
    for name, order in orders(len(expected)).items():
        camera = open_footage(path).cameras[0]
        found = [shown(camera.image(number)) for number in order]
        assert found == [expected[number] for number in order], name
    for number in range(0, len(expected), 11):
        camera = open_footage(path).cameras[0]
        assert shown(camera.image(number)) == expected[number], f"alone: {number}"


def test_frames_of_a_gif(tmp_path):
    """Catches an animation whose frames hold only what changes."""
    images = [Image.fromarray(picture(number)) for number in range(FRAMES)]
    images[0].save(tmp_path / "a.gif", save_all=True, append_images=images[1:], duration=40)
    assert_numbers(tmp_path / "a.gif", list(range(FRAMES)))


@pytest.mark.parametrize("kind", VIDEOS)
def test_frames_by_their_number(tmp_path, kind):
    """Catches frames that are shifted, shown twice or missing, in order or after a jump."""
    name, codec, options = VIDEOS[kind]
    write_numbered(tmp_path / name, codec, options)
    assert_numbers(tmp_path / name, list(range(FRAMES)))


@pytest.mark.parametrize("codec", ["libx264", "libx265"])
@pytest.mark.parametrize("suffix", [".mp4", ".mov"])
def test_frames_hidden_by_an_edit_list(tmp_path, codec, suffix):
    """Catches a video that was trimmed without encoding, whose hidden frames are counted."""
    write_numbered(tmp_path / "whole.mp4", codec, X264 if codec == "libx264" else OPEN_X265)
    (tmp_path / "take").mkdir()
    path = tmp_path / f"take/a{suffix}"
    copy_packets(tmp_path / "whole.mp4", path, shift=7)
    assert any(packet.is_discard for packet in packets_of(path))
    assert_numbers(path, list(range(7, FRAMES)))


@pytest.mark.parametrize(
    ("codec", "options", "name"),
    [
        ("libx265", OPEN_X265, "a.mov"),
        ("libx265", OPEN_X265, "a.mkv"),
        ("libx265", OPEN_X265, "a.mts"),
        ("libx264", OPEN_X264, "a.mts"),
    ],
)
def test_beginning_that_cannot_be_decoded(tmp_path, codec, options, name):
    """Catches pictures counted whose references were cut away, and frames shown in their place."""
    whole = tmp_path / f"whole{name[1:]}"
    write_numbered(whole, codec, options)
    second = [n for n, packet in enumerate(packets_of(whole)) if packet.is_keyframe][1]
    (tmp_path / "take").mkdir()
    copy_packets(whole, tmp_path / "take" / name, first=second)
    footage = open_footage(tmp_path / "take" / name)
    start = shown(footage.cameras[0].image(0))
    if name == "a.mkv":
        told = "its first 3 frames cannot be decoded; they are left out, and not counted"
        assert footage.warnings[0].endswith(f"a.mkv: {told}")
    assert_numbers(tmp_path / "take" / name, list(range(start, FRAMES)))


def test_an_open_video_goes_to_a_helping_process(tmp_path):
    """Catches a decoder in the middle of its video, which cannot be pickled."""
    write_numbered(tmp_path / "video.mp4", "libx264", {}, 3)
    frames = open_footage(tmp_path / "video.mp4", focal=50.0).cameras[0].frames
    frames.image(0)
    there = pickle.loads(pickle.dumps(frames))
    for timestep in (1, 2):
        assert_array_equal(there.image(timestep), frames.image(timestep))


def test_variable_frame_rate(tmp_path):
    """Catches frames of a phone played evenly although gaps lie between them: out of step with
    sound and other cameras, and motion taken for a jump."""
    durations = [1, 1, 1, 2, 1, 3, 1, 75] * 8
    count = len(durations)
    path = tmp_path / "a.mkv"
    write_numbered(path, "libx264", X264, count, rate=50, durations=durations)
    footage = open_footage(tmp_path)
    (warning,) = footage.warnings
    assert "a.mkv: has a variable frame rate (frames last 20 to 1500 ms)" in warning
    assert footage.fps == pytest.approx(50, rel=1e-3)
    assert footage.timesteps == tuple(sum(durations[:number]) for number in range(count))
    found = [shown(footage.cameras[0].image(timestep)) for timestep in footage.timesteps]
    assert found == list(range(count))


def test_cameras_whose_rate_varies_apart(tmp_path):
    """Catches frames of two cameras paired by their number although each has dropped others."""
    durations = {"a": [1, 1, 2, 1, 1, 1, 2] * 3, "b": [1, 2, 1, 1, 1, 1, 2] * 3}
    times = {}
    for name, own in durations.items():
        write_numbered(tmp_path / f"{name}.mkv", "libx264", X264, len(own), rate=50, durations=own)
        times[name] = [sum(own[:number]) for number in range(len(own))]
    cameras = rig(2, COLUMNS * BLOCK, ROWS * BLOCK)
    write_colmap_text(tmp_path / "sparse/0", cameras, ["a.png", "b.png"])
    footage = open_footage(tmp_path)
    assert footage.timesteps == tuple(sorted(set(times["a"]) & set(times["b"])))
    for camera in footage.cameras:
        found = [shown(camera.image(timestep)) for timestep in footage.timesteps]
        assert found == [times[camera.name].index(timestep) for timestep in footage.timesteps]


# A display matrix in the file's track header, and how a player shows the corners a b / c d of the
# stored picture.
TURNS = {
    "as stored": ((1, 0, 0, 1), "ab cd"),
    "mirrored": ((-1, 0, 0, 1), "ba dc"),
    "upside down": ((-1, 0, 0, -1), "dc ba"),
    "mirrored top to bottom": ((1, 0, 0, -1), "cd ab"),
    "turned clockwise": ((0, 1, -1, 0), "ca db"),
    "turned counterclockwise": ((0, -1, 1, 0), "bd ac"),
    "mirrored and turned": ((0, 1, 1, 0), "ac bd"),
}


def set_matrix(path, *matrix):
    """a, b, c, d in the track header, version 0: 16.16 and 2.30 fixed point."""
    data = bytearray(path.read_bytes())
    a, b, c, d = (round(65536 * value) for value in matrix)
    struct.pack_into(">9i", data, data.index(b"tkhd") + 44, a, b, 0, c, d, 0, 0, 0, 1 << 30)
    path.write_bytes(data)


@pytest.mark.parametrize("turn", TURNS)
def test_display_matrices(tmp_path, turn):
    """Catches a front camera's video that is shown mirrored, lying or upside down."""
    matrix, expected = TURNS[turn]
    path = tmp_path / "phone.mp4"
    image = np.kron(np.reshape(list(LEVELS.values()), (2, 2)), np.ones((32, 48))).astype(np.uint8)
    encode(path, [np.repeat(image[..., None], 3, axis=2)], options={"crf": "8"})
    set_matrix(path, *matrix)
    assert corners(open_footage(path).cameras[0].image(0)) == expected


@pytest.mark.parametrize(
    ("name", "stored", "aspect", "size"),
    [
        ("a.mov", (60, 64), Fraction(16, 15), (64, 64)),
        ("a.mkv", (96, 64), Fraction(4, 3), (128, 64)),
        ("a.mpg", (96, 64), Fraction(32, 27), (114, 64)),  # 16:9, of which MPEG-2 has a code
    ],
)
def test_pixels_that_are_not_square(tmp_path, name, stored, aspect, size):
    """Catches faces that are too wide or narrow; frames that a calibration of stored ones does not
    fit; and not a word of either."""
    image = np.zeros((stored[1], stored[0], 3), np.uint8)
    image[16:48, stored[0] // 4 : 3 * stored[0] // 4] = 255
    codec = "mpeg2video" if name.endswith("mpg") else "libx264"

    def set_up(stream):
        stream.codec_context.sample_aspect_ratio = aspect

    encode(tmp_path / name, [image] * 3, codec, {"b": "4000000", "crf": "5"}, set_up=set_up)
    (camera,) = (footage := open_footage(tmp_path / name)).cameras
    assert (camera.camera.width, camera.camera.height) == size
    shown_image = camera.image(1)[..., 0].astype(int)
    assert shown_image.shape == size[::-1]
    columns = np.flatnonzero(shown_image[32] > 127)
    assert abs(columns[0] - size[0] / 4) <= 2
    assert abs(columns[-1] - 3 * size[0] / 4) <= 2
    ratio = f"{aspect.numerator}:{aspect.denominator}"
    told = f"its pixels are not square ({ratio}); frames are stretched to {size[0]} x {size[1]}"
    assert footage.warnings == (f"{tmp_path / name}: {told}",)
    (other,) = rig(1, *stored)
    write_colmap_text(tmp_path / "sparse", [other], ["a.png"])
    footage = open_footage(tmp_path)
    assert footage.cameras[0].image(1).shape == image.shape
    assert not any("stretched" in warning for warning in footage.warnings)


def with_clean_aperture(path, width, height):
    """Insert a box `clap` into the picture's entry of `stsd`, and let all boxes around it grow. The
    file's boxes of samples lie before `moov`, so that no offset changes."""
    data = bytearray(path.read_bytes())
    at = data.index(b"avcC") - 4
    parents = [data.rindex(name, 0, at) - 4 for name in (b"avc1", b"stsd", b"stbl", b"minf")]
    parents += [data.rindex(name, 0, at) - 4 for name in (b"mdia", b"trak", b"moov")]
    assert data.index(b"mdat") < parents[-1]
    for parent in parents:
        (length,) = struct.unpack_from(">I", data, parent)
        struct.pack_into(">I", data, parent, length + 40)
    data[at:at] = struct.pack(">I4s8I", 40, b"clap", width, 1, height, 1, 0, 1, 0, 1)
    path.write_bytes(data)


def test_what_a_video_asks_for_in_vain(tmp_path):
    """Catches combs of interlaced frames, a frame to be cropped, and a turn by no right angle, of
    which a player shows something else, without a warning."""
    frames = [np.full((64, 96, 3), 30 + 10 * n, np.uint8) for n in range(3)]
    encode(tmp_path / "fields.mp4", frames, options={"x264-params": "tff=1"})
    encode(tmp_path / "crop.mov", frames)
    with_clean_aperture(tmp_path / "crop.mov", 80, 64)
    encode(tmp_path / "turned.mp4", frames)
    set_matrix(tmp_path / "turned.mp4", np.cos(0.1), np.sin(0.1), -np.sin(0.1), np.cos(0.1))
    encode(tmp_path / "plain.mov", frames)
    with_clean_aperture(tmp_path / "plain.mov", 96, 64)
    for name, sentence in (
        ("fields.mp4", "is interlaced: every second line is of another moment, and fast"),
        ("crop.mov", r"asks for 80 x 64 of its 96 x 64 pixels \(clean aperture\); all are used"),
        ("turned.mp4", "asks to be turned by 6°; only right angles are done"),
    ):
        (warning,) = open_footage(tmp_path / name).warnings
        assert re.search(re.escape(f"{tmp_path / name}: ") + sentence, warning)
    assert open_footage(tmp_path / "plain.mov").warnings == ()


# Signals (R, G, B), 0 to 1, of a video, and the sRGB they are to be shown as. Gray card and white:
# ITU-R BT.2408, table 1 (26 and 203 cd/m²; 26 / 203 is 0.394 in sRGB). sRGB's red in Display P3:
# CSS Color 4.
SIGNALS = {
    "PQ, gray card": ((9, 16, 9), (0.38, 0.38, 0.38), (0.394, 0.394, 0.394)),
    "PQ, white": ((9, 16, 9), (0.58, 0.58, 0.58), (1, 1, 1)),
    "HLG, gray card": ((9, 18, 9), (0.38, 0.38, 0.38), (0.394, 0.394, 0.394)),
    "HLG, white": ((9, 18, 9), (0.75, 0.75, 0.75), (1, 1, 1)),
    "Display P3, gray": ((12, 1, 1), (0.5, 0.5, 0.5), (0.5, 0.5, 0.5)),
    "Display P3, red of sRGB": ((12, 1, 1), (0.9175, 0.2003, 0.1386), (1, 0, 0)),
    "BT.709": ((1, 1, 1), (0.9, 0.2, 0.15), (0.9, 0.2, 0.15)),
}


@pytest.mark.parametrize("name", SIGNALS)
def test_colors_of_phones(tmp_path, name):
    """Catches HDR shown flat and dark, and wide colors shown pale."""
    (primaries, transfer, matrix), signal, expected = SIGNALS[name]
    path = tmp_path / "a.mov"
    deep = transfer != 1
    codec, pixels = ("libx265", "yuv444p10le") if deep else ("libx264", "yuv444p")
    if codec not in av.codecs_available:
        pytest.skip(f"this PyAV lacks {codec}")
    options = {"crf": "4"} | ({"x265-params": "log-level=0"} if deep else {})

    def set_up(stream):
        stream.pix_fmt = pixels
        context = stream.codec_context
        context.color_primaries = primaries
        context.color_trc = transfer
        context.colorspace = matrix
        context.color_range = 1

    image = np.broadcast_to(np.round(65535 * np.array(signal)), (64, 64, 3)).astype(np.uint16)
    frame = av.VideoFrame.from_ndarray(image, format="rgb48le").reformat(
        format=pixels, dst_colorspace=matrix
    )
    encode(path, [frame] * 4, codec, options, set_up=set_up)
    found = open_footage(path).cameras[0].image(0)[32, 32] / 255
    assert_allclose(found, expected, atol=0.025)


@pytest.mark.parametrize(
    ("name", "rate"), [("a.mp4", 60), ("a.mkv", 30), ("a.mts", 50), ("a.avi", 25)]
)
def test_constant_frame_rate(tmp_path, name, rate):
    """Catches times rounded to milliseconds taken for a variable rate, and hidden frames counted
    into the rate."""
    write_numbered(tmp_path / name, "libx264", X264, rate=rate)
    footage = open_footage(tmp_path / name)
    assert (footage.fps, footage.warnings) == (rate, ())
    if name == "a.mp4":
        copy_packets(tmp_path / name, tmp_path / "trimmed.mp4", shift=9)
        footage = open_footage(tmp_path / "trimmed.mp4")
        assert (footage.fps, footage.warnings) == (rate, ())


def test_file_that_is_cut_off(tmp_path):
    """Catches a download that ended early, and is refused for its last frame, or lacks those that
    the decoder holds back."""
    write_numbered(tmp_path / "a.mp4", "libx264", X264)
    path = tmp_path / "cut.mp4"
    copy_packets(tmp_path / "a.mp4", path, options={"movflags": "faststart"})
    packets = packets_of(path)
    times = [packet.pts for packet in packets]
    last = packets[33]
    numbers = [sorted(times).index(time) for time in sorted(times[:33])]
    path.write_bytes(path.read_bytes()[: last.pos + last.size // 2])
    footage = open_footage(path)
    assert f"{path}: is cut off; it ends after 33 frames" in footage.warnings
    camera = footage.cameras[0]
    for order in orders(33).values():
        found = [shown(camera.image(camera.timesteps[n])) for n in order]
        assert found == [numbers[n] for n in order]


def test_frame_that_the_decoder_leaves_out(tmp_path):
    """Catches the next frame shown in place of a damaged one, and a message without a reason."""
    path = tmp_path / "a.mov"
    write_numbered(path, "libx265", OPEN_X265)
    packet = sorted(packets_of(path), key=lambda packet: packet.pts)[41]
    begin = packet.pos
    end = packet.pos + packet.size
    data = bytearray(path.read_bytes())
    while begin < end:
        data[begin + 4] = 38 << 1  # makes filler data of the unit, which decoders pass over
        begin += 4 + int.from_bytes(data[begin : begin + 4], "big")
    path.write_bytes(data)
    camera = open_footage(path).cameras[0]
    assert shown(camera.image(40)) == 40
    for before in (40, FRAMES - 1):  # in order, and by a seek
        camera.image(before)
        with refusal(r"a.mov: frame 41: cannot be decoded \(the decoder gives no picture"):
            camera.image(41)
    assert shown(camera.image(50)) == 50


def test_without_pictures(tmp_path):
    """Catches a message that names an exception instead of what is missing."""
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000, layout="mono")
        silence = np.zeros((1, 800), np.int16)
        frame = av.AudioFrame.from_ndarray(silence, format="s16", layout="mono")
        frame.sample_rate = 8000
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    with refusal(r"a.mkv: is not a readable video \(it has no video stream\)"):
        open_footage(tmp_path)


def test_frames_of_gigapixels(tmp_path, monkeypatch):
    """Catches gigabytes that a video of some kilobytes decodes to before its size is looked at."""
    path = tmp_path / "a.mkv"
    write_numbered(path, "mpeg4", MPEG4, 3)
    monkeypatch.setattr(video, "MAX_IMAGE_PIXELS", 100)
    with refusal(rf"a\.mkv: has {COLUMNS * BLOCK} x {ROWS * BLOCK} pixels, more than are read"):
        video.first_frames(path)
    with video._open(path) as container, pytest.raises(av.FFmpegError):
        next(container.decode(video=0))
