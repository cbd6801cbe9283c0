"""Errors that the user can correct, each on one line."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from traceback import walk_tb

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from devrf.cli.config import group_choices, known_stages
from devrf.cli.config_check import unknown_key
from devrf.errors import DevrfError, did_you_mean
from devrf.system.files import REFUSED
from devrf.system.override import to_type
from devrf.system.printed import shown

# Read at import: the entry point sets the variable, so that Hydra raises its errors.
FULL_ERRORS = os.environ.get("HYDRA_FULL_ERROR", "0") != "0"

# Packages of devrf's extras that are imported where they are used, and their extras.
EXTRAS = dict.fromkeys(("fast_simplification", "pxr", "skimage", "trimesh"), "export")
EXTRAS |= {"tensorboard": "tensorboard", "viser": "viewer"}


@contextmanager
def report_user_errors() -> Iterator[None]:
    """Turn an error in config or input into one line on stderr and exit status 2.

    HYDRA_FULL_ERROR=1 in the environment raises it with its traceback instead. Other errors are
    faults of the program and pass through.
    """
    try:
        yield
    except Exception as error:
        line = one_line(error)
        if FULL_ERRORS or line is None:
            raise
        print(f"devrf: {line}", file=sys.stderr)
        raise SystemExit(2) from None


def _of_refused_options(error: BaseException) -> bool:
    """Whether Hydra or Optuna refuses a command's options, for which it has no class of error."""
    modules = [""] + [frame.f_globals["__name__"] for frame, _ in walk_tb(error.__traceback__)]
    refusing = ("hydra._internal.", "hydra.core.override_parser.", "optuna.")
    return isinstance(error, ValueError) and modules[-1].startswith(refusing)


def _of_storage(error: BaseException) -> bool:
    """Whether Optuna cannot use the storage of a search, of which SQLAlchemy or it says why."""
    modules = [frame.f_globals["__name__"] for frame, _ in walk_tb(error.__traceback__)]
    by_sql = type(error).__module__.startswith("sqlalchemy.")
    return by_sql or (isinstance(error, ImportError) and "optuna.storages" in modules[-1])


def _cause(error: BaseException) -> BaseException:
    """The first DevrfError in a chain of causes, else the error by which Hydra failed to build."""
    cause = error.__cause__
    built = str(error).startswith("Error in call to target")
    if isinstance(error, DevrfError) or cause is None:
        return error
    first = _cause(cause)
    return first if isinstance(first, DevrfError) else cause if built else error


def one_line(error: BaseException) -> str | None:
    """What is wrong with input, config, installed extras or disk, beginning with the key or file.

    None: the user cannot correct it.
    """
    cause = _cause(error)
    text = str(cause)
    # Another error in a constructor of devrf is a fault of the program.
    ours = "Error in call to target 'devrf." in str(error)
    by_library = isinstance(error, HydraException | OmegaConfBaseException)
    if isinstance(cause, DevrfError):
        pass
    elif isinstance(cause, ModuleNotFoundError) and cause.name in EXTRAS:
        extra = EXTRAS[cause.name]
        text = f'{cause.name} is not installed; run pip install "devrf[{extra}]"'
    elif isinstance(error, OSError) and not by_library:
        if error.errno not in REFUSED:
            return None
        text = f"{error.filename or 'a file that is written'}: {error.strerror}"
    elif _of_storage(error):
        expected = "expected a database that can be read and written, as sqlite:///study.db"
        text = f"hydra.sweeper.storage: {expected} ({text.partition(chr(10))[0]})"
    elif ours or not (by_library or _of_refused_options(error)):
        return None
    elif isinstance(error, MissingConfigException) and "/" in str(error.missing_cfg_file):
        group, _, option = str(error.missing_cfg_file).rpartition("/")
        of_hydra = group.startswith("hydra/")
        # Hydra gives none for a list of options.
        options = error.options or ([] if of_hydra else group_choices().get(group, []))
        names = f"; choose one of {', '.join(options)}" if options else ""
        more = '; others need pip install "devrf[sweeps]"' if of_hydra else ""
        meant = did_you_mean(option, options, f"{group}=")
        text = f"{group}={option}: no such option{names}{more}{meant}"
    elif isinstance(error, OverrideParseException):
        text = _not_understood(str(error.override))
    elif isinstance(error.__cause__, ConfigKeyError | ConfigAttributeError):
        # OmegaConf keeps the mapping that does not have the key.
        root = error.__cause__.parent_node._get_root()
        text = str(unknown_key(root, tuple(str(error.__cause__.full_key).split("."))))
    else:
        # Both libraries write the key, and OmegaConf its types, on lines below.
        key = str(error).partition("full_key: ")[2].split("\n")[0]
        text = text.partition("full_key: ")[0]
        deeper = cause.__cause__
        while deeper is not None:
            reason = str(deeper).partition("full_key: ")[0].strip()
            text += f": {reason}" if reason not in text else ""
            deeper = deeper.__cause__
        text = f"{key}: {text}" if key else text
    # Spaces within a line stay: names may have several in a row.
    return shown(" ".join(filter(None, map(str.strip, text.splitlines()))))


def _not_understood(argument: str) -> str:
    """A remedy for an argument that Hydra cannot read."""
    key, is_set, value = argument.partition("=")
    if is_set and value[:1] == "[" and value[-1:] == "]":
        listed = to_type(key, [item.strip() for item in value[1:-1].split(",")])
        return f"{argument}: not understood; as a list of texts write {listed}"
    if is_set:
        as_text = to_type(key, value)
        return f"{argument}: not understood; as text write {as_text}, else see that brackets close"
    words = [to_type("data.root", argument)] if Path(argument).is_dir() else []
    words += [
        f"{group}={argument}" for group, names in group_choices().items() if argument in names
    ]
    meant = f"; did you mean {' or '.join(words)}?" if words else ""
    meant = meant or did_you_mean(argument, known_stages(), "stage=")
    return f"{argument}: not understood{meant or '; write KEY=VALUE, or --help for what there is'}"
