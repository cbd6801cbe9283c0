"""Errors that the user can correct, each on one line."""

from __future__ import annotations

import os
import re
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf.errors import OmegaConfBaseException

from devrf.cli.config import group_choices, known_stages
from devrf.cli.config_check import unknown_key
from devrf.errors import DevrfError, did_you_mean
from devrf.system.files import REFUSED

# Read at import: the entry point sets the variable, so that Hydra raises its errors.
FULL_ERRORS = os.environ.get("HYDRA_FULL_ERROR", "0") != "0"

# Options that Hydra's plugins for sweeps add to its groups.
PLUGINS = {
    "hydra/launcher": ("joblib", "submitit_local", "submitit_slurm"),
    "hydra/sweeper": ("optuna",),
    "hydra/sweeper/sampler": ("tpe",),
}


@contextmanager
def report_user_errors() -> Iterator[None]:
    """Turn an error in config or input into one line on stderr and exit status 2.

    HYDRA_FULL_ERROR=1 in the environment raises it with its traceback instead. Other errors are
    faults of the program and pass through.
    """
    try:
        yield
    except Exception as error:
        if FULL_ERRORS or not is_user_error(error):
            raise
        print(f"devrf: {one_line(error)}", file=sys.stderr)
        raise SystemExit(2) from None


@contextmanager
def as_own_errors() -> Iterator[None]:
    """Turn an error that the user can correct, of whatever library, into a DevrfError."""
    try:
        yield
    except Exception as error:
        if isinstance(error, DevrfError) or not is_user_error(error):
            raise
        raise DevrfError(one_line(error)) from error


def is_user_error(error: Exception) -> bool:
    """Whether the user can correct it: input, config, or a disk that refuses."""
    if _own_error(error) is not None:
        return True
    if isinstance(error, OSError) and not isinstance(error, HydraException):
        return error.errno in REFUSED
    # Another error in a constructor of devrf is a fault of the program.
    ours = "Error in call to target 'devrf." in str(error)
    return isinstance(error, HydraException | OmegaConfBaseException) and not ours


def _own_error(error: BaseException | None) -> DevrfError | None:
    """The first DevrfError in a chain of causes."""
    return error if error is None or isinstance(error, DevrfError) else _own_error(error.__cause__)


def one_line(error: BaseException) -> str:
    """The error's message on one line that begins with the key or file at fault."""
    known_error = _own_error(error)
    if known_error is not None:
        text = str(known_error)
    elif isinstance(error, MissingConfigException):
        text = _missing_option(error)
    elif isinstance(error, OverrideParseException):
        text = _not_understood(str(error.override))
    elif isinstance(error, OSError) and not isinstance(error, HydraException):
        text = f"{error.filename or 'output'}: {error.strerror}"
    else:
        text = _of_hydra(error)
    return "".join(sign if sign.isprintable() else "?" for sign in " ".join(text.split()))


def _not_understood(argument: str) -> str:
    """What to type instead of an argument that Hydra cannot read."""
    key, is_set, value = argument.partition("=")
    if is_set:
        as_text = shlex.quote(f"{key}={in_quotes(value)}")
        return f"{argument}: not understood; as text write {as_text}, else see that brackets close"
    options = [
        f"{group}={argument}" for group, names in group_choices().items() if argument in names
    ]
    if options:
        return f"{argument}: not understood; did you mean {' or '.join(options)}?"
    if Path(argument).is_dir():
        return f"{argument}: not understood; did you mean data.root={shlex.quote(argument)}?"
    meant = did_you_mean(argument, known_stages(), "stage=")
    return f"{argument}: not understood{meant or '; write KEY=VALUE, or --help for what there is'}"


def _missing_option(error: MissingConfigException) -> str:
    group, _, option = str(error.missing_cfg_file).rpartition("/")
    if option in PLUGINS.get(group, ()):
        return f'{group}={option}: not installed; pip install "devrf[sweeps]"'
    if error.options:
        meant = did_you_mean(option, error.options, f"{group}=")
        known = ", ".join(error.options)
        return f"{group}={option}: no such option; choose one of {known}{meant}"
    return _of_hydra(error)


def _of_hydra(error: BaseException) -> str:
    text = str(error)
    if several := re.search(r"Ambiguous value for argument '([^']+)'", text):
        key, _, value = several[1].partition("=")
        return (
            f"{several[1]}: several values need -m; as a list write {key}=[{value}], as text "
            f"{shlex.quote(f'{key}={in_quotes(value)}')}"
        )
    if unknown := re.match(r"Could not override '([^']+)'", text):
        # OmegaConf keeps the mapping that does not have the key.
        near = getattr(error.__cause__, "parent_node", None)
        return str(unknown_key(unknown.group(1), near or ()))
    if text.startswith("Error in call to target") and error.__cause__ is not None:
        detail = str(error.__cause__)
    else:  # without the lines that OmegaConf adds on its types
        detail = re.sub(r"(?m)^\s*(full_key:|object_type=|reference_type=).*$", "", text)
    key = re.search(r"^\s*full_key: (\S+)$", text, re.MULTILINE)
    return f"{key.group(1)}: {detail}" if key else detail


def in_quotes(text: str) -> str:
    """``text`` as Hydra's grammar takes it for text, whatever it holds."""
    mark = "'" if '"' in text and "'" not in text else '"'
    # Backslashes count as escapes only before a quotation mark and at the end.
    escaped = re.sub(rf"(\\*)({mark}|$)", lambda m: m[1] * 2 + (m[2] and f"\\{mark}"), text)
    return f"{mark}{escaped}{mark}"
