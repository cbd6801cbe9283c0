"""An experiment of any inward-facing scene beside an embedded one: its own sizes for that."""

from __future__ import annotations

from collections.abc import Sequence

from devrf.cli.config import config_folder

SUFFIX = "_procedural"
EMBEDDED = {"data=procedural", "data=flower"}


def with_embedded_experiment(arguments: Sequence[str]) -> list[str]:
    """The command's arguments, ``experiment=NAME`` replaced by ``NAME_procedural`` if there is one.

    Scenes from disk and the embedded ones need other sizes, and other options of their data;
    Hydra cannot choose an experiment by another choice.
    """
    if EMBEDDED.isdisjoint(arguments):
        return list(arguments)
    files = (config_folder() / "experiment").glob(f"*{SUFFIX}.yaml")
    known = {f"experiment={path.stem.removesuffix(SUFFIX)}" for path in files}
    return [f"{one}{SUFFIX}" if one in known else one for one in arguments]
