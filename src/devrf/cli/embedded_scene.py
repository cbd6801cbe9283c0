"""An experiment of any inward-facing scene beside ``data=procedural``: its own sizes for that."""

from __future__ import annotations

from collections.abc import Sequence

from devrf.cli.config import config_folder

DATA = "procedural"


def with_embedded_experiment(arguments: Sequence[str]) -> list[str]:
    """The command's arguments, ``experiment=NAME`` replaced by ``NAME_procedural`` if there is one.

    Scenes from disk and the embedded ones need other sizes, and other options of their data;
    Hydra cannot choose an experiment by another choice.
    """
    if f"data={DATA}" not in arguments:
        return list(arguments)
    files = (config_folder() / "experiment").glob(f"*_{DATA}.yaml")
    known = {f"experiment={path.stem.removesuffix(f'_{DATA}')}" for path in files}
    return [f"{one}_{DATA}" if one in known else one for one in arguments]
