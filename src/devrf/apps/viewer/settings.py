"""Where the viewer listens, and how much it may take."""

from __future__ import annotations

import errno
import socket
from contextlib import closing
from dataclasses import dataclass

from devrf.errors import DevrfError


@dataclass(frozen=True)
class ViewerSettings:
    """The page of ``stage=view``, and of ``viewer=true`` beside training.

    Attributes:
        host: the address to listen on; 127.0.0.1 can be reached from this machine alone.
        port: of the page.
        height: rows of a full picture, in pixels.
        move_seconds: what a picture may take while the camera moves or time runs: it is rendered
            as large as that allows.
        training: whether a run shows its scene while it learns.
        share: the most of a run's time that its pictures may take.
    """

    host: str = "127.0.0.1"
    port: int = 8080
    height: int = 480
    move_seconds: float = 0.2
    training: bool = False
    share: float = 0.03

    def __post_init__(self) -> None:
        if not 1 <= self.port <= 65535:
            raise DevrfError(f"viewer.port: expected 1 to 65535, not {self.port}")
        if not 16 <= self.height <= 4096:
            raise DevrfError(f"viewer.height: expected 16 to 4096, not {self.height}")
        if not 0 < self.move_seconds <= 10:
            raise DevrfError(f"viewer.move_seconds: expected 0 to 10, not {self.move_seconds}")
        if not 0 < self.share <= 1:
            raise DevrfError(f"viewer.share: expected more than 0, at most 1, not {self.share}")

    @property
    def address(self) -> str:
        """What to open in a browser."""
        return f"http://{self.host}:{self.port}"

    def check_free(self) -> None:
        """Check that the address can be listened on.

        Raises:
            DevrfError: another program does, or the machine has no such address.
        """
        try:
            found = socket.getaddrinfo(self.host, self.port, type=socket.SOCK_STREAM)[0]
            with closing(socket.socket(found[0], socket.SOCK_STREAM)) as probe:
                # As a server sets it: a port that was just given back is free.
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(found[4])
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise DevrfError(
                    f"viewer.port: {self.port} on {self.host} is in use by another program; "
                    f"give another, such as viewer.port={self.port % 65535 + 1}"
                ) from None
            raise DevrfError(
                f"viewer.host: cannot listen on {self.host}:{self.port} ({error.strerror}); "
                "give an address of this machine, such as viewer.host=127.0.0.1"
            ) from None
