"""The user's mistakes, said in one line."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from hydra.errors import HydraException
from omegaconf.errors import OmegaConfBaseException

from devrf.errors import DevrfError

# Read once: the entry point sets the variable for Hydra's sake.
FULL_ERRORS = os.environ.get("HYDRA_FULL_ERROR", "0") != "0"


@contextmanager
def mistakes_in_one_line() -> Iterator[None]:
    """Turn a mistake in config or input into one line on stderr and exit status 2.

    With HYDRA_FULL_ERROR=1 in the environment it is raised with its traceback instead. Other
    errors are faults of the program and pass through.
    """
    try:
        yield
    except (DevrfError, HydraException, OmegaConfBaseException) as error:
        if FULL_ERRORS:
            raise
        print(f"devrf: {one_line(error)}", file=sys.stderr)
        raise SystemExit(2) from None


def one_line(error: BaseException) -> str:
    """What an error says, on one line; of a chain, the project's own error if there is one."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, DevrfError):
        cause = cause.__cause__
    lines = [line.strip() for line in str(cause or error).splitlines()]
    # OmegaConf's own bookkeeping, of no use to the reader; `full_key` names the key at fault.
    kept = [line for line in lines if line and not line.startswith(("object_type", "reference_"))]
    return " ".join(kept)
