"""No film is read wrong and unsaid: random ones of each format, decoded a second time, slowly (Spec B6, G2).

Each is read as FFmpeg decodes it, within the conversion that the docs name; or it is refused.
"""

from pathlib import Path

import av
import numpy as np
import pytest

from hypogoal.core.errors import UserError
from hypogoal.importing.pictures import count_frames, frames_in

SOME = [10, pytest.param(300, marks=pytest.mark.slow)]
FILMS = [
    ("mp4", "mp4", "libx264", "yuv420p"),
    ("mkv", "matroska", "libx264", "yuv444p"),
    ("mov", "mov", "mpeg4", "yuv420p"),
    ("avi", "avi", "mjpeg", "yuvj420p"),
    ("webm", "webm", "libvpx-vp9", "yuv420p"),
    ("mkv", "matroska", "ffv1", "yuv420p"),
    ("avi", "avi", "mpeg4", "yuv420p"),
    ("mkv", "matroska", "ffv1", "bgr0"),
    ("mkv", "matroska", "ffv1", "bgra"),
]


def write_blocks(path: Path, form: str, codec: str, pixels: str, draw: np.random.Generator) -> None:
    """A film of blocks of random colours; some with B-frames, some with key frames close together."""
    options = {"bf": str(draw.integers(3)), "g": str(draw.integers(1, 12))} if codec == "libx264" else {}
    with av.open(str(path), "w", format=form) as container:
        stream = container.add_stream(codec, rate=10, options=options)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 64, 48, pixels, 2_000_000
        for _ in range(draw.integers(2, 12)):
            values = draw.integers(0, 256, (3, 4, 4), dtype=np.uint8).repeat(16, 0).repeat(16, 1)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(values, format="rgba")))
        container.mux(stream.encode())


def decoded_slowly(path: Path) -> list[np.ndarray]:
    """All frames, made of their planes here: BT.601, of a narrow range unless it says full."""
    frames = []
    with av.open(str(path)) as container:
        for frame in container.decode(video=0):
            name = frame.format.name
            if name.startswith("bgr"):
                [plane] = frame.planes
                rows = np.frombuffer(plane, np.uint8).reshape(48, plane.line_size)[:, : 4 * 64]
                frames.append(rows.reshape(48, 64, 4)[..., 2::-1].astype(float))
                continue
            planes = []
            for plane in frame.planes:
                rows = np.frombuffer(plane, np.uint8).reshape(plane.height, plane.line_size)[:, : plane.width]
                planes.append(rows.repeat(48 // plane.height, 0).repeat(64 // plane.width, 1).astype(float))
            full = name.startswith("yuvj") or frame.color_range == 2
            light = planes[0] if full else (planes[0] - 16) * 255 / 219
            blue, red = ((plane - 128) * (1 if full else 255 / 224) for plane in planes[1:])
            colours = (light + 1.402 * red, light - 0.344136 * blue - 0.714136 * red, light + 1.772 * blue)
            frames.append(np.stack(colours, axis=2).clip(0, 255))
    return frames


@pytest.mark.parametrize("count", SOME)
def test_films_are_as_decoded_slowly_or_refused(tmp_path: Path, count: int, capsys: pytest.CaptureFixture[str]) -> None:
    """A third is cut off: what was to follow is told."""
    for seed in range(count):
        draw = np.random.default_rng(seed)
        suffix, form, codec, pixels = FILMS[seed % len(FILMS)]
        path = tmp_path / f"x.{suffix}"
        write_blocks(path, form, codec, pixels, draw)
        whole = decoded_slowly(path)
        if is_cut := seed % 3 == 0:
            data = path.read_bytes()
            path.write_bytes(data[: len(data) // 3])
        try:
            listed = count_frames(path)
            seen = [*frames_in(path, np.arange(listed))] if listed else []
        except UserError:
            assert is_cut or pixels == "bgra", seed
            continue
        assert pixels != "bgra" or not listed, seed
        is_short = len(whole) - listed > 6  # more than half a second
        assert is_cut or listed == len(whole), seed
        assert ("ends earlier than it says" in capsys.readouterr().err) or not is_short, seed
        for one, other in zip(seen, whole, strict=False):
            assert np.abs(one - other)[8::16, 8::16].max() < 8, seed
