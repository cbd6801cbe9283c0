"""Films as cameras and converters write them: right frames at right times, or one line."""

from __future__ import annotations

import struct
import subprocess
from pathlib import Path
from zlib import crc32

import imageio_ffmpeg
import numpy as np
import pytest
from PIL import Image

from devrf.errors import DevrfError
from devrf.scenes.footage import footage_header, frames_at, pictures

WIDTH, HEIGHT, FRAMES, RATE = 96, 64, 12, 10


def frame(k: int) -> np.ndarray:
    """A red bar above, a blue one on the left; a grey patch, its level 20 k, says which it is."""
    picture = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
    picture[:16] = (250, 20, 20)
    picture[16:, :16] = (20, 20, 250)
    picture[32:56, 40:72] = 20 * k
    return picture


def number(picture: np.ndarray) -> int:
    """Which frame it is, by its patch."""
    height, width = picture.shape[:2]
    patch = picture[height * 5 // 8 : height * 3 // 4, width // 2 : width * 5 // 8]
    return round(float(patch.mean()) / 20)


def ffmpeg(*arguments: object) -> None:
    words = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-y", *map(str, arguments)]
    subprocess.run(words, check=True, capture_output=True)


@pytest.fixture(scope="module")
def frames(tmp_path_factory) -> Path:
    """A pattern of files of all frames."""
    folder = tmp_path_factory.mktemp("frames")
    for k in range(FRAMES):
        Image.fromarray(frame(k)).save(folder / f"{k:02d}.png")
    return folder / "%02d.png"


@pytest.fixture
def film(tmp_path, frames):
    """Writes a film by FFmpeg's options; returns its path."""

    def write(name: str, *options: str) -> Path:
        ffmpeg("-r", RATE, "-i", frames, *options, tmp_path / name)
        return tmp_path / name

    return write


H264 = ("-c:v", "libx264", "-pix_fmt", "yuv420p", "-crf", "8")
KINDS = {
    "plain.mp4": H264,
    "interlaced.mp4": (*H264, "-vf", "setfield=tff", "-x264-params", "tff=1"),
    "interlaced.mkv": (*H264, "-vf", "setfield=bff", "-x264-params", "bff=1"),
    "camcorder.avi": (
        *("-vf", "setfield=tff", "-c:v", "mpeg2video", "-q:v", "2"),
        *("-flags", "+ildct+ilme"),
    ),
    "av1.mp4": ("-c:v", "libsvtav1", "-crf", "10"),
    "ten_bit.mp4": ("-c:v", "libx264", "-pix_fmt", "yuv420p10le", "-crf", "8"),
    "vp9 [1], 50%.webm": ("-c:v", "libvpx-vp9", "-crf", "8", "-b:v", "0"),
    "moving.gif": (),
}


@pytest.mark.parametrize("name", KINDS)
def test_every_frame_is_read_once_at_its_time(film, name):
    path = film(name, *KINDS[name])
    assert footage_header(path).size == (WIDTH, HEIGHT)
    times, shown = zip(*pictures(path), strict=True)
    assert times == pytest.approx(np.arange(FRAMES) / RATE, abs=1e-3)
    assert [number(picture) for picture in shown] == list(range(FRAMES))
    assert shown[0][4:12, 30:].reshape(-1, 3).mean(axis=0) == pytest.approx([250, 20, 20], abs=6)
    assert shown[0][24:56, 4:12].reshape(-1, 3).mean(axis=0) == pytest.approx([20, 20, 250], abs=6)
    some = [(position, number(picture)) for position, picture in frames_at(path, [9, 2, 2, 11])]
    assert some == [(2, 2), (9, 9), (11, 11)]


def test_pixels_are_square_and_frames_upright(film, tmp_path):
    path = film("wide.mp4", *H264, "-vf", "setsar=4/3")
    assert footage_header(path).size == (128, 64)
    _, picture = next(pictures(path))
    assert picture.shape == (64, 128, 3)
    assert picture[4:12].reshape(-1, 3).mean(axis=0) == pytest.approx([250, 20, 20], abs=6)
    ffmpeg("-display_rotation", 90, "-i", path, "-c", "copy", tmp_path / "turned.mp4")
    assert footage_header(tmp_path / "turned.mp4").size == (64, 128)
    # A quarter turn to the left.
    _, picture = next(pictures(tmp_path / "turned.mp4"))
    assert picture.shape == (128, 64, 3)
    assert picture[:, 4:12].reshape(-1, 3).mean(axis=0) == pytest.approx([250, 20, 20], abs=6)


def test_times_are_those_of_the_frames_and_an_edit_is_followed(film, tmp_path, caplog):
    slower = "setpts='round(if(lt(N,6),N,2*N-6)/10/TB)'"
    path = film("slower.mp4", *H264, "-vf", slower, "-fps_mode", "vfr")
    times = [time for time, _ in pictures(path)]
    assert times == pytest.approx([*np.arange(6) / 10, *(0.6 + np.arange(6) / 5)], abs=1e-3)
    ffmpeg("-ss", 0.4, "-i", film("whole.mp4", *H264), "-c", "copy", tmp_path / "trimmed.mp4")
    times, shown = zip(*pictures(tmp_path / "trimmed.mp4"), strict=True)
    assert [number(picture) for picture in shown] == list(range(4, FRAMES))
    assert times == pytest.approx(np.arange(FRAMES - 4) / RATE, abs=1e-3)
    assert not caplog.records


def cut(path: Path) -> Path:
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 6 // 10])
    return path


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("cut.mp4", (*H264, "-g", "1", "-movflags", "+faststart")),
        ("cut.mkv", ("-c:v", "ffv1")),
        ("cut.avi", ("-c:v", "rawvideo", "-pix_fmt", "bgr24")),
    ],
)
def test_a_film_that_was_cut_off_is_said(film, caplog, name, options):
    path = cut(film(name, *options))
    shown = [number(picture) for _, picture in pictures(path)]
    assert 2 <= len(shown) < 10 and shown == list(range(len(shown)))
    (record,) = caplog.records
    assert f"{name}: ends after {len(shown)} frames, but states 12;" in record.getMessage()
    with pytest.raises(DevrfError, match=rf"{name}: ends after {len(shown)} frames, expected 12"):
        list(frames_at(path, [0, 11]))


def test_sound_that_lasts_longer_is_no_cut(film, tmp_path, caplog):
    sound = ("-f", "lavfi", "-i", "sine=d=4", "-map", "0", "-map", "1", "-c:v", "copy")
    ffmpeg("-i", film("silent.mp4", *H264), *sound, tmp_path / "sound.mp4")
    assert len(list(pictures(tmp_path / "sound.mp4"))) == FRAMES and not caplog.records


def test_what_is_no_film_is_one_line(film, tmp_path, frames):
    (tmp_path / "empty.mp4").touch()
    ffmpeg("-f", "lavfi", "-i", "sine=d=1", "-c:a", "aac", tmp_path / "sound.m4a")
    film("one.mp4", *H264, "-frames:v", "1")
    ffmpeg("-i", film("small.mp4", *H264, "-s", "48x32"), "-c", "copy", tmp_path / "small.ts")
    ffmpeg("-i", film("large.mp4", *H264), "-c", "copy", tmp_path / "joined.ts")
    # FFmpeg would show the film as often as the list says.
    (tmp_path / "list.mp4").write_text("ffconcat version 1.0\n" + "file large.mp4\n" * 1000)
    with (tmp_path / "joined.ts").open("ab") as joined:
        joined.write((tmp_path / "small.ts").read_bytes())
    for name, said in (
        ("empty.mp4", "not a readable video; convert it"),
        ("sound.m4a", "not a readable video; convert it"),
        ("list.mp4", "not a readable video; convert it"),
        ("one.mp4", "a video of 1 frame, expected at least 2"),
        ("joined.ts", "has not the size or colours of those before it"),
        ("nowhere.mp4", "no such file"),
    ):
        with pytest.raises(DevrfError) as caught:
            list(pictures(tmp_path / name))
        assert str(caught.value).startswith(str(tmp_path / name)) and said in str(caught.value)


def test_a_cover_picture_is_no_film(film, tmp_path, frames):
    streams = ("-map", "0", "-map", "1", "-c:v:0", "mjpeg", "-c:v:1", "copy")
    cover = ("-i", str(frames) % 5, "-i", film("bare.mp4", *H264))
    ffmpeg(*cover, *streams, "-disposition:v:0", "attached_pic", tmp_path / "cover.mp4")
    shown = [number(picture) for _, picture in pictures(tmp_path / "cover.mp4")]
    assert shown == list(range(FRAMES))


def test_sizes_that_no_frame_has_are_refused_before_any_is_decoded(film, tmp_path):
    wide = film("wide.mkv", "-vf", "scale=20000:16", "-c:v", "ffv1")
    Image.new("RGB", (8, 8)).save(tmp_path / "photos.png")
    header = b"IHDR" + struct.pack(">II", 2**15, 2**15) + bytes([8, 2, 0, 0, 0])
    data = (tmp_path / "photos.png").read_bytes()
    (tmp_path / "photos").mkdir()
    photo = tmp_path / "photos" / "0.png"
    photo.write_bytes(data[:12] + header + struct.pack(">I", crc32(header)) + data[33:])
    with pytest.raises(DevrfError, match="wide.mkv: states 20000x16 px, expected 8192x4320"):
        next(pictures(wide))
    with pytest.raises(DevrfError, match=r"0.png: not a readable image \(Image size \(1073741824"):
        next(pictures(photo.parent))


def test_more_frames_than_a_command_can_name_are_read(film, monkeypatch):
    """FFmpeg's command had a place for some 11,000."""
    monkeypatch.setattr("devrf.scenes.footage._MOST_NAMED", 2)
    read = [(k, number(picture)) for k, picture in frames_at(film("a.mp4"), [1, 3, 4])]
    assert read == [(1, 1), (3, 3), (4, 4)]
    assert not [*frames_at(film("a.mp4"), [])]


def test_photographs_that_are_cut_out_are_refused(tmp_path):
    """What is behind transparent pixels would be taken for what was there."""
    picture = np.dstack([frame(1), np.full((HEIGHT, WIDTH), 255, np.uint8)])
    for k in range(2):
        Image.fromarray(picture).save(tmp_path / f"{k}.png")
    assert [number(seen) for _, seen in pictures(tmp_path)] == [1, 1]
    picture[0, 0, 3] = 0
    Image.fromarray(picture).save(tmp_path / "1.png")
    with pytest.raises(DevrfError, match=r"1\.png: is cut out by its alpha channel, which is not"):
        [*pictures(tmp_path)]
