"""Where public scenes are published: ``catalogue.toml``, or another file in its form."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from devrf.errors import DevrfError, did_you_mean

OWN = Path(__file__).with_name("catalogue.toml")
# The file by which a scene's folder is known, by the layout that reads it.
MARKERS = {
    "inward": "transforms_train.json",
    "nerfstudio": "transforms.json",
    "forward": "poses_bounds.npy",
    "nerfies": "dataset.json",
}

Address = Annotated[str, Field(pattern=r"^https?://")]
# Names become paths: they begin with a letter or digit, and lead nowhere else.
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][\w-]*$")]
FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][\w-]*(\.\w+)?(/[A-Za-z0-9][\w.-]*)*$")]
Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class Collection(BaseModel):
    """Scenes that were published together.

    Attributes:
        page: where their authors describe them.
        licence: in a few words.
        data: the layout that reads them: ``data=…``.
        learn: overrides with which to learn such a scene.
        url: of an archive, or of a file with ``{file}``; ``{scene}`` is the scene's name.
        files: what to fetch where ``url`` names a file.
        folder: name of the scene's folder in the archive, where it holds several scenes.
        scenes: what each shows, by name.
        sha256: checksums of the archives, by scene; of several files that of their list.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    page: Address
    licence: str
    data: Literal["inward", "nerfstudio", "forward", "nerfies"]
    learn: str
    url: Address
    files: list[FileName] = []
    folder: str | None = None
    scenes: dict[Name, str]
    sha256: dict[str, Digest] = {}


@dataclass(frozen=True)
class PublishedScene:
    """One scene of a collection.

    Attributes:
        name: what ``scene=…`` calls it.
        about: what it shows.
        collection: what holds for all of its collection.
    """

    name: str
    about: str
    collection: Collection

    @property
    def downloads(self) -> dict[str, str]:
        """The address of each file to fetch, by its name."""
        url = self.collection.url
        if not self.collection.files:
            return {"archive": url.format(scene=self.name)}
        return {file: url.format(scene=self.name, file=file) for file in self.collection.files}

    @property
    def is_archive(self) -> bool:
        """Whether one archive is fetched, to be unpacked."""
        return not self.collection.files

    @property
    def folder(self) -> str | None:
        """Name of its folder in the archive; None: the only one that holds a scene."""
        name = self.collection.folder
        return None if name is None else name.format(scene=self.name)

    @property
    def marker(self) -> str:
        """The file by which its folder is known."""
        return MARKERS[self.collection.data]

    @property
    def sha256(self) -> str | None:
        """Its checksum, where it is known."""
        return self.collection.sha256.get(self.name)


def catalogue(file: str | Path | None = None) -> list[PublishedScene]:
    """The scenes of a catalogue; None: devrf's own.

    Raises:
        DevrfError: it cannot be read, or has another form.
    """
    path = OWN if file is None else Path(file).expanduser()
    try:
        listed = tomllib.loads(path.read_text())
        collections = [Collection.model_validate(one) for one in listed.get("collection", [])]
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, ValidationError) as error:
        why = " ".join(str(error).split())
        raise DevrfError(f"fetch.catalogue: {path} cannot be read ({why[:200]})") from None
    return [
        PublishedScene(name, about, one)
        for one in collections
        for name, about in one.scenes.items()
    ]


def published_scene(name: str, file: str | Path | None = None) -> PublishedScene:
    """The scene ``name`` of a catalogue.

    Raises:
        DevrfError: it has none of that name.
    """
    scenes = {scene.name: scene for scene in catalogue(file)}
    if name not in scenes:
        meant = did_you_mean(name, scenes, "scene=")
        raise DevrfError(
            f"scene: stage=fetch knows no {name!r}; choose one of {', '.join(scenes)}{meant}"
        )
    return scenes[name]
