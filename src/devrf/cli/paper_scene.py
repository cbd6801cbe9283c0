"""``experiment=paper``: the published settings of the scene that ``data=…`` names."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from devrf.cli.config import config_folder
from devrf.errors import DevrfError

NAME = "paper"
# Settings of the paper for scenes of one's own: of any data of that kind.
GENERAL = ("inward", "forward")


def published_scenes() -> list[str]:
    """What ``data=…`` may be beside ``experiment=paper``."""
    files = (config_folder() / "experiment").glob(f"{NAME}_*.yaml")
    return sorted(path.stem.removeprefix(f"{NAME}_") for path in files)


def with_paper_experiment(arguments: Sequence[str]) -> list[str]:
    """The command's arguments, ``experiment=paper`` replaced by that of the chosen data.

    Hydra cannot choose an experiment by another choice. Of a sweep over scenes,
    ``data=lego,kuka``, it becomes one over experiments, which name their data themselves.

    Raises:
        DevrfError: no data is named, or data without published settings.
    """
    if f"experiment={NAME}" not in arguments:
        return list(arguments)
    known = published_scenes()
    chosen = [one.removeprefix("data=") for one in arguments if one.startswith("data=")]
    names = chosen[-1].split(",") if chosen else []
    if not names or not set(names) <= set(known):
        given = f"data={chosen[-1]} has none" if chosen else "no data=… is given"
        raise DevrfError(
            f"experiment={NAME}: has published settings for data={', '.join(known)}; {given}"
        )
    experiment = "experiment=" + ",".join(f"{NAME}_{name}" for name in names)
    return [
        experiment if one == f"experiment={NAME}" else one
        for one in arguments
        if len(names) == 1 or not one.startswith("data=")
    ]


def check_paper_scene(choices: Mapping[str, str | None]) -> None:
    """Check that the published settings of one scene are not taken for another.

    Raises:
        DevrfError: naming both.
    """
    experiment, data = choices.get("experiment") or "", choices.get("data")
    scene = experiment.removeprefix(f"{NAME}_")
    if scene != experiment and scene not in (*GENERAL, data):
        raise DevrfError(
            f"experiment={experiment}: holds the published settings of data={scene}, not of "
            f"data={data}; for your own scene take experiment={NAME}_{GENERAL[0]} or "
            f"experiment={NAME}_{GENERAL[1]}"
        )
