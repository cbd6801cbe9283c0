"""Public scenes: where they are published (``catalogue.toml``), and how they are downloaded."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import shutil
import tomllib
import zipfile
import zlib
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from rich.console import Console
from rich.filesize import decimal
from rich.progress import track

from devrf.errors import DevrfError, did_you_mean
from devrf.system.files import make_folder, read_record, refuse_links, write_json

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FetchSettings:
    """Settings of ``stage=fetch``.

    Attributes:
        into: the folder below which scenes are put.
        sha256: the checksum to insist on; None: the catalogue's, where it has one.
        catalogue: a TOML file of other scenes; None: devrf's own.
    """

    into: str | Path = "scenes"
    sha256: str | None = None
    catalogue: str | Path | None = None


OWN = Path(__file__).with_name("catalogue.toml")
# Beside the data: where they are from, when, and their checksums.
RECORD = "fetched.json"
ARCHIVE = "archive"
# Images hardly expand, and camera files about tenfold. An archive that unpacks to at most SMALL
# bytes may expand by more.
MOST_EXPANSION = 20
SMALL = 2**26
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
        sha256: checksums of the archives, by scene; for several files, of their list.
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
        files = self.collection.files or [ARCHIVE]
        return {file: self.collection.url.format(scene=self.name, file=file) for file in files}

    @property
    def is_archive(self) -> bool:
        """Whether one archive is fetched, to be unpacked."""
        return not self.collection.files


def catalogue(file: str | Path | None = None) -> list[PublishedScene]:
    """The scenes of a catalogue (None: devrf's own); DevrfError if it cannot be read."""
    path = OWN if file is None else Path(file).expanduser()
    try:
        listed = tomllib.loads(path.read_text())
        collections = [Collection.model_validate(table) for table in listed.get("collection", [])]
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, ValidationError) as error:
        why = " ".join(str(error).split())
        raise DevrfError(f"fetch.catalogue: {path} cannot be read ({why[:200]})") from None
    return [
        PublishedScene(name, about, collection)
        for collection in collections
        for name, about in collection.scenes.items()
    ]


def published_scene(name: str, file: str | Path | None = None) -> PublishedScene:
    """The scene ``name`` of a catalogue; DevrfError if it has none of that name."""
    scenes = {scene.name: scene for scene in catalogue(file)}
    if name in scenes:
        return scenes[name]
    meant = did_you_mean(name, scenes, "scene=")
    raise DevrfError(
        f"scene: stage=fetch knows no {name!r}; choose one of {', '.join(scenes)}{meant}"
    )


@dataclass(frozen=True)
class Fetched:
    """A scene in its place.

    Attributes:
        path: its folder.
        sha256: of the archive; for several files, of the list of their checksums.
        compared: whether it was compared with a checksum that was known before.
        anew: whether it was fetched now, and not before.
    """

    path: Path
    sha256: str
    compared: bool
    anew: bool


def fetched_before(scene: PublishedScene, into: Path) -> Fetched | None:
    """The scene, if it is in its place already; DevrfError if something else is there."""
    path = into / scene.name
    if not os.path.lexists(path):
        return None
    try:
        record = json.loads(read_record(path / RECORD))
        return Fetched(path, str(record["sha256"]), bool(record["compared"]), anew=False)
    except (OSError, ValueError, KeyError, TypeError):
        raise DevrfError(
            f"{path}: there is something else, without {RECORD}; remove it, or give fetch.into=PATH"
        ) from None


def fetched(scene: PublishedScene, settings: FetchSettings, progress: bool) -> Fetched:
    """A scene in ``settings.into``, downloaded unless it is there; the log says what was done.

    Raises:
        DevrfError: it cannot be fetched, or is not what was expected.
        OSError: the disk refuses.
    """
    into = Path(settings.into).expanduser()
    result = fetched_before(scene, into)
    if result is None:
        source = scene.collection
        log.info(
            "%s: %s; from %s; licence: %s", scene.name, scene.about, source.page, source.licence
        )
        result = fetch_scene(scene, into, settings.sha256, progress)
    log.info(
        "%s: %s", scene.name, f"in {result.path}" if result.anew else f"is in {result.path} already"
    )
    remark = f"none was known to compare it with; kept in {result.path / RECORD}"
    log.info("SHA-256 %s%s", result.sha256, ", as expected" if result.compared else f": {remark}")
    return result


def fetch_scene(scene: PublishedScene, into: Path, sha256: str | None, progress: bool) -> Fetched:
    """Download a scene to ``into``/<its name>, which appears when it is whole and checked.

    Files that have come are kept beside it until all are there: the same command goes on with the
    others. ``sha256`` is the checksum to insist on; None: the catalogue's, if it has one.

    Raises:
        DevrfError: it cannot be fetched, or is not what was expected.
        OSError: the disk refuses.
    """
    expected = sha256.lower() if sha256 else scene.collection.sha256.get(scene.name)
    work = into / f".{scene.name}.fetch"
    refuse_links(work, itself=True)
    make_folder(work)
    files = _download(scene, work / "files", progress)
    digest = _digest(files)
    if expected is not None and digest != expected:
        shutil.rmtree(work, ignore_errors=True)
        raise DevrfError(
            f"scene={scene.name}: what came has the SHA-256 {digest}, expected {expected}; it "
            "was removed: try again, and if it comes again, ask who published it"
        )
    ready = _unpacked(scene, work) if scene.is_archive else work / "files"
    write_json(
        ready / RECORD,
        {
            "scene": scene.name,
            "page": scene.collection.page,
            "url": scene.collection.url.format(scene=scene.name, file="{file}"),
            "licence": scene.collection.licence,
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "files": len(files),
            "sha256": digest,
            "compared": expected is not None,
        },
    )
    path = into / scene.name
    ready.rename(path)
    shutil.rmtree(work, ignore_errors=True)
    return Fetched(path, digest, expected is not None, anew=True)


def _download(scene: PublishedScene, folder: Path, progress: bool) -> dict[str, Path]:
    """The downloaded files by their names."""
    import pooch  # it loads much, and every command reads this module

    pooch.get_logger().setLevel("ERROR")
    files = pooch.create(
        path=folder,
        base_url="",
        registry=dict.fromkeys(scene.downloads),
        urls=scene.downloads,
        retry_if_failed=1,
    )
    # Some servers refuse the name that Python gives itself.
    get = pooch.HTTPDownloader(
        progressbar=progress and scene.is_archive, headers={"User-Agent": "devrf"}
    )
    fetched = {}
    console = Console(stderr=True)
    hidden = scene.is_archive or not progress
    for name in track(scene.downloads, scene.name, console=console, disable=hidden):
        try:
            fetched[name] = Path(files.fetch(name, downloader=get))
        except OSError as error:
            if error.errno is not None:  # the disk's
                raise
            url = scene.downloads[name]
            raise DevrfError(
                f"{url}: cannot be fetched ({error}); see that the network works, and that its "
                f"page {scene.collection.page} names no other address"
            ) from None
    return fetched


def _digest(files: dict[str, Path]) -> str:
    """The SHA-256 of an archive; for several files, of the lines that sha256sum prints."""
    import pooch

    digests = {name: str(pooch.file_hash(str(path))) for name, path in files.items()}
    if list(files) == [ARCHIVE]:
        return digests[ARCHIVE]
    lines = "".join(f"{digests[name]}  {name}\n" for name in sorted(files))
    return hashlib.sha256(lines.encode()).hexdigest()


def _check_size(packed: zipfile.ZipFile, archive: Path, work: Path) -> None:
    """Check that an archive holds no more than images and camera files of its size may hold.

    Python unpacks no more of a file than the archive says that it holds.

    Raises:
        DevrfError: it would expand far beyond that; ``work`` is removed, and the archive with it.
    """
    size = archive.stat().st_size
    unpacked_size = sum(file.file_size for file in packed.infolist())
    if unpacked_size > max(MOST_EXPANSION * size, SMALL):
        shutil.rmtree(work, ignore_errors=True)
        raise DevrfError(
            f"{archive}: {decimal(size)} would unpack to {decimal(unpacked_size)}, more than "
            f"{MOST_EXPANSION} times as much; it was removed: ask who published it"
        )


def _unpacked(scene: PublishedScene, work: Path) -> Path:
    """The folder of the archive that holds the scene's marker, without the folders around it."""
    archive = work / "files" / ARCHIVE
    place = work / "unpacked"
    shutil.rmtree(place, ignore_errors=True)
    try:
        with zipfile.ZipFile(archive) as packed:
            _check_size(packed, archive, work)
            packed.extractall(place)  # names that lead elsewhere are written below it, too
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as error:
        raise DevrfError(
            f"{archive}: cannot be unpacked ({error}); remove it, and the same command fetches it "
            "again"
        ) from None
    folder = scene.collection.folder and scene.collection.folder.format(scene=scene.name)
    marker = MARKERS[scene.collection.data]
    folders = [
        path.parent
        for path in sorted(place.rglob(marker))
        if "__MACOSX" not in path.parts and folder in (None, path.parent.name)
    ]
    if not folders:
        raise DevrfError(
            f"{archive}: holds no {folder or 'folder'} with {marker}; what is "
            "published has changed: unpack it by hand"
        )
    return min(folders, key=lambda path: len(path.parts))
