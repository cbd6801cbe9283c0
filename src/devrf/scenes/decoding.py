"""What libraries make of damaged files: one error, whatever they raise."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from devrf.errors import DevrfError
from devrf.scenes.validation import scene_error


@contextmanager
def decoding(path: Path, what: str, remedy: str) -> Iterator[None]:
    """The place where a library decodes ``path``: what it raises becomes a DevrfError.

    Nothing else belongs into its block.

    Args:
        path: the file.
        what: what the file should be, in words.
        remedy: what to do when it is not.
    """
    try:
        yield
    except DevrfError:
        raise
    # Any exception: what decoders raise depends on the format and the damage.
    except Exception as error:
        reason = str(error) or type(error).__name__
        raise scene_error(path, f"not a readable {what} ({reason}); {remedy}") from None
