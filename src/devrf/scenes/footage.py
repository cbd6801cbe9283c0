"""Footage frame by frame: a video, or a folder of photographs."""

from __future__ import annotations

import logging
import os
import re
import subprocess
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BufferedReader
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import imageio_ffmpeg
import numpy as np
import numpy.typing as npt

from devrf.scenes.files import decoding, existing_file
from devrf.scenes.image_folders import listed_images
from devrf.scenes.images import open_image
from devrf.scenes.validation import scene_error

log = logging.getLogger(__name__)

# 8-bit RGB, (H, W, 3).
Picture = npt.NDArray[np.uint8]
# Width, height.
Size = tuple[int, int]

# Suffixes of videos; FFmpeg recognises their formats by content.
VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mts", ".m2ts", ".3gp")

# What else FFmpeg reads are lists of other files, of any number, and what nobody films in.
_FORMATS = "mov,matroska,avi,mpeg,mpegts,mpegvideo,m4v,h264,hevc,asf,flv,ogg,mxf,dv,gif"
_REMEDY = "convert it, for example to H.264 in an mp4 file"
# Pixels of a frame's longer side, and of a frame: of 8K films. FFmpeg holds several frames.
_LONGEST = 2**14
_LARGEST = 8192 * 4320
# So many frames are named to FFmpeg, whose command has a largest length; of more all are decoded.
_MOST_NAMED = 2000
# A video that has fewer of its frames, and ends before this share of its duration, was cut off.
_WHOLE = 0.95
# Lines of FFmpeg's log: a frame, numbered from 0, and its time in microseconds; the file's stated
# duration.
_FRAME = re.compile(rb" n: *(\d+) pts: *(-?\d+) ")
_DURATION = re.compile(rb"Duration: (\d+):(\d+):(\d+\.\d+)")


def is_folder(path: Path) -> bool:
    """Whether the footage is a folder of photographs, which have no times."""
    return os.path.isdir(path)


@dataclass(frozen=True)
class FootageHeader:
    """Stated properties of footage.

    Attributes:
        size: width and height of its frames in pixels, turned as the file says, pixels square.
        frames: stated number of frames; unreliable for videos: cameras and converters miscount.
        rate: frames a second, on average; 1 of photographs.
    """

    size: Size
    frames: int
    rate: float = field(compare=False)


def footage_header(path: Path) -> FootageHeader:
    """The stated properties of footage, without decoding a video; DevrfError if it is none."""
    if is_folder(path):
        files = listed_images(path)
        height, width = _photograph(files[0]).shape[:2]
        return FootageHeader((width, height), len(files), 1.0)
    existing_file(path, "give a video that is there")
    # FFmpeg and OpenCV would print the error on stderr, too.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    os.environ.setdefault("OPENCV_FFMPEG_CAPTURE_OPTIONS", f"format_whitelist;{_FORMATS}")
    level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)
    video = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    cv2.utils.logging.setLogLevel(level)
    width, height, frames, turn = (
        int(video.get(key))
        for key in (
            cv2.CAP_PROP_FRAME_WIDTH,
            cv2.CAP_PROP_FRAME_HEIGHT,
            cv2.CAP_PROP_FRAME_COUNT,
            cv2.CAP_PROP_ORIENTATION_META,
        )
    )
    rate = video.get(cv2.CAP_PROP_FPS)
    aspect = video.get(cv2.CAP_PROP_SAR_NUM) / (video.get(cv2.CAP_PROP_SAR_DEN) or 1)
    opened = video.isOpened()
    video.release()
    if not opened or not 0 < rate < 10_000:
        raise scene_error(path, f"not a readable video; {_REMEDY}")
    # The width of a pixel as it is stored over its height; 0: not stated.
    if aspect > 0 and turn % 180:
        height = round(height * aspect)
    elif aspect > 0:
        width = round(width * aspect)
    if not 0 < min(width, height) <= max(width, height) <= _LONGEST or width * height > _LARGEST:
        stated = f"states {width}x{height} px, expected 8192x4320 at most"
        raise scene_error(path, f"{stated}; {_REMEDY}")
    # A frame takes some bytes, whatever the header says.
    return FootageHeader((width, height), min(frames, path.stat().st_size // 8), rate)


def frame_count(path: Path) -> int:
    """The number of photographs; of a video, whose header may be wrong, at least 1."""
    return len(listed_images(path)) if is_folder(path) else max(1, footage_header(path).frames)


def pictures(path: Path) -> Iterator[tuple[float, Picture]]:
    """Time in seconds since the first frame, and each frame, as :func:`frames_at` gives them.

    The times of photographs are their positions. DevrfError if it is no footage. A warning says
    that a video ends well before its stated end.
    """
    if is_folder(path):
        for position, file in enumerate(listed_images(path)):
            yield float(position), _photograph(file)
        return
    for _, time, picture in _decoded(path):
        yield time, picture


def frames_at(path: Path, positions: Sequence[int]) -> Iterator[tuple[int, Picture]]:
    """The frames at ``positions``, ascending, each with its position; others are not kept.

    They are turned as their file says, pixels are square, and interlaced frames of a video are
    deinterlaced. DevrfError if it is no footage, or ends before the last position.
    """
    wanted = sorted(set(positions))
    if is_folder(path):
        files = listed_images(path)
        for position in wanted:
            yield position, _photograph(files[position])
        return
    for position, _, picture in _decoded(path, wanted):
        yield position, picture


def _decoded(
    path: Path, wanted: Sequence[int] | None = None
) -> Iterator[tuple[int, float, Picture]]:
    """Position, time in seconds since the first frame, and picture: of all frames, or of some."""
    header = footage_header(path)
    width, height = header.size
    kept = None if wanted is None else {*wanted}
    targets: Iterable[int] = count() if wanted is None else wanted
    is_named = wanted is not None and len(wanted) <= _MOST_NAMED
    if wanted is not None and not is_named:
        targets = range(wanted[-1] + 1)
    with _ffmpeg(path, header.size, wanted if is_named else None) as (frames, lines):
        frame_times = _frame_times(path, lines, header.rate)
        position, time = -1, 0.0
        for target in targets:
            picture = np.empty((height, width, 3), np.uint8)
            if frames.readinto(picture.data) < picture.nbytes:
                break
            # FFmpeg has written a frame's line before the frame.
            while position < target:
                position, time = next(frame_times)
            if kept is None or position in kept:
                yield position, time, picture
        else:
            return
        *_, (position, time) = [(position, time), *frame_times]
        lines.seek(0)
        text = lines.read()
    number = position + 1
    if wanted is not None:
        raise scene_error(
            path, f"ends after {number} frames, expected {wanted[-1] + 1}; convert it again"
        )
    if number < 2:
        raise scene_error(
            path,
            f"a video of {number or 'no'} frame{'s' * (number != 1)}, expected at least 2; "
            f"give a longer one, or {_REMEDY}",
        )
    # The stated number also counts frames that an edit leaves out, or is a guess from the duration,
    # which may be that of the sound: only both together are evidence.
    duration = header.frames / header.rate
    if (match := _DURATION.search(text)) and b"Input #0, avi" not in text:  # FFmpeg corrects AVI's
        hours, minutes, seconds = map(float, match.groups())
        duration = 3600 * hours + 60 * minutes + seconds
    if number < _WHOLE * header.frames and time + 1 / header.rate < _WHOLE * duration:
        log.warning(
            "%s: ends after %d frames, but states %d; if it was cut off, copy it again",
            *(path, number, header.frames),
        )


def _frame_times(path: Path, lines: BufferedReader, rate: float) -> Iterator[tuple[int, float]]:
    """Position and time of each frame that FFmpeg has decoded so far."""
    start = time = 0.0
    matches = (match for line in iter(lines.readline, b"") if (match := _FRAME.search(line)))
    for position, match in enumerate(matches):
        if int(match[1]) != position:  # FFmpeg counts anew
            raise scene_error(
                path, f"frame {position} has not the size or colours of those before it; {_REMEDY}"
            )
        stamp = int(match[2]) / 1e6
        if position == 0:
            start = stamp
        else:
            # Phones do not keep their rate; a frame without a time of its own is one step later.
            time = stamp - start if stamp - start > time else time + 1 / rate
        yield position, time


@contextmanager
def _ffmpeg(
    path: Path, size: Size, wanted: Sequence[int] | None
) -> Iterator[tuple[BufferedReader, BufferedReader]]:
    """Run FFmpeg: the pixels of the wanted frames, one after the other, and its log."""
    selected = "1" if wanted is None else "+".join(f"eq(n,{position})" for position in wanted)
    filters = (
        "yadif=deint=interlaced,settb=1/1000000,showinfo=checksum=0,"
        f"select='{selected}',scale={size[0]}:{size[1]}"
    )
    try:
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-nostdin", "-nostats"]
    except RuntimeError as error:
        raise scene_error(path, f"cannot be read without FFmpeg ({error})") from None
    # Half a frame at the end of what is there is left out, and so are cover pictures (V).
    command += ["-format_whitelist", _FORMATS, "-fflags", "+discardcorrupt"]
    command += ["-i", f"file:{path}", "-map", "0:V:0"]
    command += ["-vf", filters, "-fps_mode", "passthrough"]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "pipe:1"]
    with TemporaryDirectory() as folder:
        # A file: with two pipes one could fill up while the other is read.
        log_file = Path(folder) / "log"
        with (
            log_file.open("wb") as stderr,
            log_file.open("rb") as lines,
            subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=stderr
            ) as process,
        ):
            assert isinstance(process.stdout, BufferedReader)
            try:
                yield process.stdout, lines
            finally:
                process.kill()


def _photograph(file: Path) -> Picture:
    with open_image(file) as opened:  # OpenCV would decode much larger ones than Pillow opens
        with decoding(file, "image", "convert it to PNG or JPEG"):
            has_alpha = opened.mode in ("RGBA", "LA", "PA")
            least = opened.getchannel("A").getextrema()[0] if has_alpha else 255
        if least != 255:
            raise scene_error(
                file,
                "is cut out by its alpha channel, which is not read here; save it without one (for "
                "stage=capture with masks beside it, capture.alpha_masks)",
            )
        image = cv2.imread(str(file), cv2.IMREAD_COLOR)
    if image is None:
        raise scene_error(file, "not a readable image; convert it to PNG or JPEG")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
