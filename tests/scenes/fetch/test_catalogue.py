"""The catalogue names scenes that devrf can read, at addresses that lead to one file each."""

from __future__ import annotations

import pytest

from devrf.cli.config import config_folder
from devrf.errors import DevrfError
from devrf.scenes.fetch.catalogue import catalogue, published_scene

SCENES = catalogue()


def test_names_are_unique():
    names = [scene.name for scene in SCENES]
    assert len(set(names)) == len(names)
    assert {"fox", "fern", "lego"} <= set(names)


@pytest.mark.parametrize("scene", SCENES, ids=lambda scene: scene.name)
def test_a_scene_has_a_layout_and_addresses(scene):
    assert (config_folder() / "data" / f"{scene.collection.data}.yaml").is_file()
    for url in scene.downloads.values():
        assert url.startswith("https://") and not set("{} ") & set(url)
    assert scene.is_archive or scene.marker in scene.downloads
    assert set(scene.collection.sha256) <= set(scene.collection.scenes)


def test_a_misspelt_name_is_answered_with_the_closest():
    with pytest.raises(DevrfError, match="knows no 'fxo'; choose one of fox, .*mean scene=fox"):
        published_scene("fxo")


@pytest.mark.parametrize(
    "text",
    [
        "[[collection]]\nscenes.a = 'x'",
        "not TOML",
        "[[collection]]\npage='https://a'\nlicence=''\ndata='inward'\nlearn=''\nurl='file:///etc'\n"
        "scenes.a=''",
        "[[collection]]\npage='https://a'\nlicence=''\ndata='inward'\nlearn=''\nurl='https://a'\n"
        "scenes.'../a'=''",
        "[[collection]]\npage='https://a'\nlicence=''\ndata='inward'\nlearn=''\nurl='https://a'\n"
        "files=['../a']\nscenes.a=''",
    ],
)
def test_another_catalogue_has_the_same_form(tmp_path, text):
    (tmp_path / "mine.toml").write_text(text)
    with pytest.raises(DevrfError, match="fetch.catalogue: .* cannot be read"):
        catalogue(tmp_path / "mine.toml")
