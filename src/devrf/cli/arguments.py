"""The command line before Hydra reads it: paths are taken as they are typed.

Hydra's grammar gives a meaning to ``~``, brackets, commas and ``=``, and knows no letters beyond
ASCII, unless a value is in quotes of its own.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException

from devrf.cli.overrides import in_quotes

# Keys whose values are files or folders.
PATHS = {
    *("data.root", "data.export", "data.flow_cache", "ckpt", "fetch.into", "export.into"),
    *("capture.static", "capture.into", "video.path"),
    *("report.runs", "report.into", "evaluation.lpips_weights"),
    *("hydra.run.dir", "hydra.sweep.dir"),
}
KEY_VALUE = re.compile(r"(\+{0,2}([\w./@-]+)=)(.*)", re.DOTALL)


def with_quoted_paths(arguments: Sequence[str]) -> list[str]:
    """The arguments, with paths in the quotes that Hydra's grammar needs and ``~`` filled in.

    In a multirun a comma separates paths, as it does other values.
    """
    multirun = not {"-m", "--multirun"}.isdisjoint(arguments)
    return [_quoted_path(argument, multirun) for argument in arguments]


def with_viewer_shorthand(arguments: Sequence[str]) -> list[str]:
    """The arguments, with ``viewer.training=…`` for ``viewer=true`` and ``viewer=false``.

    ``viewer`` is a group, whose choices Hydra wants to be text.
    """
    shorthand = {f"viewer={value}": f"viewer.training={value}" for value in ("true", "false")}
    return [shorthand.get(one.lower(), one) for one in arguments]


def _quoted_path(argument: str, multirun: bool) -> str:
    parts = KEY_VALUE.fullmatch(argument)
    if not parts or parts[2] not in PATHS or "${" in parts[3]:
        return argument
    override = _parsed(argument)
    if override is not None and (override.is_sweep_override() or override.value() in (None, "")):
        return argument
    if override is None and multirun and "," in parts[3]:
        return parts[1] + ",".join(
            in_quotes(os.path.expanduser(one)) for one in parts[3].split(",")
        )
    read = override.value() if override is not None else None
    # A folder's name may look like a number or a list.
    path = os.path.expanduser(read if isinstance(read, str) else parts[3])
    return argument if read == path else parts[1] + in_quotes(path)


def _parsed(argument: str) -> Override | None:
    try:
        return OverridesParser.create().parse_override(argument)
    except HydraException:
        return None
