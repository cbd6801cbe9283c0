"""The settings of capture, report and viewer: light, because every command reads them."""

from __future__ import annotations

import errno
import socket
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from devrf.errors import DevrfError, expect

# The scores and events of a rehearsal; a run's are in metrics.json.
REHEARSAL = "rehearsal.json"

CameraModel = Literal["SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"]


@dataclass(frozen=True)
class CaptureSettings:
    """Settings of ``stage=capture``; ``conf/capture/default.yaml`` says what each does."""

    static: str | Path | None = None
    views: Sequence[str | Path] = ()
    into: str | Path | None = None
    frames: int = 60
    max_timesteps: int = 50
    size: int = 960
    camera: CameraModel = "SIMPLE_RADIAL"
    intrinsics: Literal["separate", "shared"] = "separate"
    matching: Literal["exhaustive", "sequential"] = "exhaustive"
    offsets: Sequence[float] | None = None
    facing: Literal["auto", "forward", "inward"] = "auto"
    test_view: int = -1
    holdout: int = 8
    alpha_masks: str | Path | None = None
    masks: str | Path | None = None

    @property
    def monocular(self) -> bool:
        """Whether one moving camera has filmed the scene in motion."""
        alone = len(self.views) == 1
        return alone and self.static in (None, self.views[0])

    def check(self) -> None:
        """Check what can be checked before any file is opened.

        Raises:
            DevrfError: a setting is missing, out of range, or does not go with another.
        """
        if self.into is None:
            raise DevrfError("capture.into: stage=capture needs a folder; give capture.into=PATH")
        if self.static is None and len(self.views) != 1:
            raise DevrfError(
                "capture.static: needs a video, or a folder of photographs, of the scene at rest; "
                "give capture.static=PATH (a moving camera's video alone is capture.views=[PATH])"
            )
        for key, minimum in (("frames", 3), ("max_timesteps", 2), ("size", 64), ("holdout", 2)):
            value = getattr(self, key)
            expect(value >= minimum, f"capture.{key}", f"at least {minimum}", value)
        views = len(self.views)
        if self.offsets is not None and len(self.offsets) != views:
            raise DevrfError(
                f"capture.offsets: {len(self.offsets)} offsets for {views} views; give one of "
                "each, 0 for the first, or null"
            )
        if self.test_view == 0 or (views > 1 and not -views <= self.test_view <= views):
            raise DevrfError(
                f"capture.test_view: {self.test_view} is none of the {views} views; give 1 … "
                f"{views}, or -1 for the last one"
            )


@dataclass(frozen=True)
class ReportSettings:
    """Settings of ``stage=report``; ``conf/report/default.yaml`` says what each does."""

    runs: str | Path = "outputs"
    into: str | Path | None = None

    @property
    def folder(self) -> Path:
        """The folder of the report."""
        return Path(self.runs) / "report" if self.into is None else Path(self.into)


@dataclass(frozen=True)
class ViewerSettings:
    """The page of ``stage=view``, and of ``viewer=true`` beside training.

    ``conf/viewer/default.yaml`` says what each setting does.
    """

    host: str = "127.0.0.1"
    port: int = 8080
    height: int = 480
    move_seconds: float = 0.2
    training: bool = False
    share: float = 0.03
    renderer: Literal["auto", "browser", "server"] = "auto"

    def __post_init__(self) -> None:
        seconds = self.move_seconds
        share = self.share
        expect(1 <= self.port <= 65535, "viewer.port", "1 to 65535", self.port)
        expect(16 <= self.height <= 4096, "viewer.height", "16 to 4096", self.height)
        expect(0 < seconds <= 10, "viewer.move_seconds", "more than 0, at most 10", seconds)
        expect(0 < share <= 1, "viewer.share", "more than 0, at most 1", share)

    @property
    def address(self) -> str:
        """The address for a browser."""
        host = self.host if self.family == socket.AF_INET else f"[{self.host}]"
        return f"http://{host}:{self.port}"

    @property
    def family(self) -> socket.AddressFamily:
        """That of the host: IPv6 of such an address, else IPv4."""
        return socket.AF_INET6 if ":" in self.host else socket.AF_INET

    def check_free(self) -> None:
        """Check that the address can be listened on.

        Raises:
            DevrfError: another program does, or the machine has no such address.
        """
        try:
            kind = socket.SOCK_STREAM
            address = socket.getaddrinfo(self.host, self.port, self.family, kind)[0]
            with closing(socket.socket(address[0], socket.SOCK_STREAM)) as probe:
                # As a server sets it: a port that was just given back is free.
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address[4])
        except (OSError, UnicodeError) as error:
            key = "host"
            remedy = "an address of this machine, such as viewer.host=127.0.0.1"
            why = error.strerror if isinstance(error, OSError) else "no name of a machine"
            if isinstance(error, OSError) and error.errno == errno.EADDRINUSE:
                key = "port"
                remedy = f"another, such as viewer.port={self.port % 65535 + 1}"
            raise DevrfError(
                f"viewer.{key}: cannot listen on {self.host}:{self.port} ({why}); give {remedy}"
            ) from None
