"""devrf's own config files are read fast, and mean what they mean to Hydra's reader."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from omegaconf import OmegaConf

from devrf.cli.config import config_folder
from devrf.cli.config_source import RULES, OwnConfigs, fastest


@pytest.fixture
def source(tmp_path) -> OwnConfigs:
    """The files of the test's folder."""
    return OwnConfigs("main", f"devrf://{tmp_path}")


def test_every_file_is_what_omegaconf_reads_of_it():
    folder = config_folder()
    source = OwnConfigs("main", f"devrf://{folder}")
    for path in folder.rglob("*.yaml"):
        found = source.load_config(str(path.relative_to(folder).with_suffix("")))
        assert found.config == OmegaConf.load(path)
        assert found.header["package"] == ("_global_" if "# @package" in path.read_text() else None)


def test_numbers_dates_and_keys_are_omegaconfs(source, tmp_path):
    (tmp_path / "a.yaml").write_text("rate: 1e-3\nday: 2001-01-01\nlist: [.5, 1_0]\nname:\n")
    expected = {"rate": 1e-3, "day": "2001-01-01", "list": [0.5, 10], "name": None}
    assert source.load_config("a").config == expected
    (tmp_path / "a.yaml").write_text("rate: 1\nrate: 2\n")
    with pytest.raises(yaml.YAMLError, match="found duplicate key rate\n .*a.yaml.*line 2"):
        source.load_config("a")


def test_where_pyyaml_has_no_libyaml_files_are_read_slowly(source, tmp_path, monkeypatch):
    assert fastest() is not RULES
    monkeypatch.setattr(yaml, "__with_libyaml__", False)
    assert fastest() is RULES
    (tmp_path / "b.yaml").write_text("rate: 1e-3\n")
    assert source.load_config("b").config == {"rate": 1e-3}


def test_hydra_reads_the_main_folder_by_it():
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        paths = GlobalHydra.instance().config_loader().get_search_path().get_path()
    assert [path.path for path in paths if path.provider == "main"] == [
        f"devrf://{config_folder()}"
    ]


def test_a_config_that_is_changed_or_a_file_that_is_leaves_no_trace(source, tmp_path):
    (tmp_path / "a.yaml").write_text("seed: 1\n")
    source.load_config("a").config.seed = 2
    assert source.load_config("a").config == {"seed": 1}
    Path(tmp_path, "a.yaml").write_text("seed: 3\n")
    assert source.load_config("a").config == {"seed": 3}
