"""``data=auto``: the reader that fits the scene's files, chosen before the config is checked."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, open_dict, read_write

from devrf.cli.config import config_folder
from devrf.errors import DevrfError

# What conf/data/auto.yaml names.
AUTOMATIC = "devrf.data.recorded.recognised_datamodule"
# Not passed over with the other options.
OF_ALL = ("_target_", "reader", "flow_cache")


def with_data_choice(arguments: Sequence[str]) -> list[str]:
    """The command line, with ``data=auto`` where a scene's folder is given and no reader."""
    given = list(arguments)
    rooted = [k for k, one in enumerate(given) if re.match(r"\+{0,2}data\.root=", one)]
    if not rooted or any(re.match(r"[+~]{0,2}data(=|$)", one) for one in given):
        return given
    chosen = [one.partition("=")[2] for one in given if one.startswith("experiment=")]
    if any(_reads_files(name) for names in chosen for name in names.split(",")):
        return given
    place = rooted[0]  # Hydra takes all overrides from one place
    return [*given[:place], "data=auto", *given[place:]]


def _reads_files(experiment: str) -> bool:
    """Whether an experiment chooses a reader of files itself."""
    file = config_folder() / "experiment" / f"{experiment}.yaml"
    if not file.is_file():
        return False
    content: Any = OmegaConf.load(file)
    for entry in content.get("defaults", []):
        option = entry.get("override /data") if OmegaConf.is_dict(entry) else None
        if option is not None:
            own: Any = OmegaConf.load(config_folder() / "data" / f"{option}.yaml")
            return "root" in list(own)
    return False


def with_recognised_data(config: DictConfig) -> DictConfig:
    """The config with the reader that fits the scene's files in place of ``data=auto``.

    Options that are null have the reader's own defaults.

    Raises:
        DevrfError: the layout is unknown, or its reader has no such option.
    """
    data = config.data
    if data.get("_target_") != AUTOMATIC or config.stage == "report":
        return config
    if OmegaConf.is_missing(data, "root"):
        return config  # the check of the config says so
    # Imported here: --help and a misspelt key are answered before torch has loaded.
    from devrf.scenes.formats import recognise

    layout = recognise(data.root)
    own = OmegaConf.load(config_folder() / "data" / f"{layout.choice}.yaml")
    assert isinstance(own, DictConfig)
    raw: Any = OmegaConf.to_container(data)
    given = {k: v for k, v in raw.items() if v is not None and k not in OF_ALL}
    # As a list: a DictConfig does not "contain" what is required and not given.
    known = [str(name) for name in own if name not in OF_ALL]
    for key in given:
        if key not in known:
            raise DevrfError(
                f"data.{key}: {data.root} is read by data={layout.choice}, which takes "
                f"{', '.join(known)}"
            )
    with open_dict(config):
        config.data = OmegaConf.merge(own, given, {"flow_cache": raw["flow_cache"]})
    if HydraConfig.initialized():
        choices: Any = HydraConfig.get().runtime.choices
        with open_dict(choices), read_write(choices):
            choices.data = layout.choice  # as if it had been typed: reports compare choices
    return config
