"""Public scenes: their sources (``catalogue.toml``) and their download."""

from __future__ import annotations

import hashlib
import io
import logging
import os
import shutil
import time
import tomllib
import zipfile
from dataclasses import dataclass
from datetime import UTC, datetime
from multiprocessing.pool import ThreadPool
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field
from rich.console import Console
from rich.filesize import decimal
from rich.progress import Progress

from devrf.errors import DevrfError, did_you_mean
from devrf.system.files import (
    DEEPEST,
    UNREADABLE,
    atomic_write,
    read_record,
    refuse_links,
    write_json,
)
from devrf.system.folder_lock import lock_folder, release_folder
from devrf.system.plain_data import Line, validate

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
# Most bytes of a scene's download, and of its unpacked files; of a catalogue.
LARGEST = 2**34
LARGEST_CATALOGUE = 2**20
# Points in a line of a catalogue: time and memory for a name grow with the square of its parts.
MOST_POINTS = 100
# Seconds that a scene may take; that a server may say nothing; that nothing of a file may come.
LONGEST = 6 * 3600
PATIENCE = 60
STALLED = 5 * PATIENCE
# The file by which a scene's folder is known, by the layout that reads it.
MARKERS = {
    "inward": "transforms_train.json",
    "nerfstudio": "transforms.json",
    "forward": "poses_bounds.npy",
    "nerfies": "dataset.json",
}

Address = Annotated[str, Field(pattern=r"^https?://[!-~]+$")]
# Names become paths: they begin with a letter or digit, and lead nowhere else.
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][\w-]*$")]
FileName = Annotated[str, Field(pattern=r"^[A-Za-z0-9][\w-]*(\.\w+)?(/[A-Za-z0-9][\w.-]*)*$")]
Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


class Collection(BaseModel):
    """Scenes that were published together.

    Attributes:
        page: their authors' description.
        licence: in a few words.
        data: the layout that reads them: ``data=…``.
        learn: overrides with which to learn such a scene.
        url: of an archive, or of a file with ``{file}``; ``{scene}`` is the scene's name.
        files: those to fetch, if ``url`` names a file.
        folder: name of the scene's folder in the archive, where it holds several scenes.
        scenes: the content of each, by name.
        sha256: checksums of the archives, by scene; for several files, of their list.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    page: Address
    licence: Line
    data: Literal["inward", "nerfstudio", "forward", "nerfies"]
    learn: Annotated[str, Field(pattern=r"^[\w.=,/\[\] -]*$")]
    url: Address
    files: list[FileName] = []
    folder: str | None = None
    scenes: dict[Name, Line]
    sha256: dict[str, Digest] = {}

    def filled(self, text: str, scene: str, file: str = "{file}") -> str:
        """A text of this with the names of a scene and a file in their places."""
        return text.replace("{scene}", scene).replace("{file}", file)


@dataclass(frozen=True)
class PublishedScene:
    """One scene of a collection.

    Attributes:
        name: its name in ``scene=…``.
        about: its content.
        collection: the properties of its collection.
    """

    name: str
    about: str
    collection: Collection

    @property
    def downloads(self) -> dict[str, str]:
        """The address of each file to fetch, by its name."""
        source = self.collection
        files = source.files or [ARCHIVE]
        return {file: source.filled(source.url, self.name, file) for file in files}

    @property
    def is_archive(self) -> bool:
        """Whether one archive is fetched, to be unpacked."""
        return not self.collection.files


def catalogue(file: str | Path | None = None) -> list[PublishedScene]:
    """The scenes of a catalogue (None: devrf's own); DevrfError if it cannot be read."""
    path = OWN if file is None else Path(file).expanduser()
    try:
        text = read_record(path, LARGEST_CATALOGUE).decode()
        if any(line.count(".") > MOST_POINTS for line in text.split("\n")):
            raise ValueError(f"a line of more than {MOST_POINTS} points")
        listed = validate(dict[str, list[Collection]], tomllib.loads(text))
    except (OSError, *UNREADABLE) as error:
        why = " ".join(str(error).split())
        raise DevrfError(f"fetch.catalogue: {path} cannot be read ({why[:200]})") from None
    return [
        PublishedScene(name, about, collection)
        for collection in listed.get("collection", [])
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


def fetched(scene: PublishedScene, settings: FetchSettings, progress: bool) -> Path:
    """A scene's folder in ``settings.into``, downloaded unless it is there; the log says so.

    It appears when it is whole and checked. Files that have come are kept beside it until all are
    there: the same command goes on with the others.

    Raises:
        DevrfError: it cannot be fetched, or is not what was expected, something else is there, or
            another process fetches it.
        OSError: the disk refuses.
    """
    into, source = Path(settings.into).expanduser(), scene.collection
    path, work = into / scene.name, into / f".{scene.name}.fetch"
    if (path / RECORD).is_file():
        log.info("%s: is in %s already", scene.name, path)
        return path
    if os.path.lexists(path):
        raise DevrfError(
            f"{path}: there is something else, without {RECORD}; remove it, or give fetch.into=PATH"
        )
    log.info("%s: %s; from %s; licence: %s", scene.name, scene.about, source.page, source.licence)
    expected = settings.sha256.lower() if settings.sha256 else source.sha256.get(scene.name)
    refuse_links(work, itself=True)
    lock_folder(work, "fetch.into")
    try:
        if (path / RECORD).is_file():  # another process has just fetched it
            return path
        digest = _fetch(scene, work, path, expected, progress)
    finally:
        release_folder(work)
    remark = f": none was known to compare it with; kept in {path / RECORD}"
    log.info("%s: in %s", scene.name, path)
    log.info("SHA-256 %s%s", digest, remark if expected is None else ", as expected")
    return path


def _fetch(
    scene: PublishedScene, work: Path, path: Path, expected: str | None, progress: bool
) -> str:
    """Download a scene to ``work``, and move it to ``path`` whole; its SHA-256.

    DevrfError if that is not the ``expected`` one.
    """
    files = _download(scene, work / "files", progress)
    digest = _digest(files)
    if expected is not None and digest != expected:
        shutil.rmtree(work, ignore_errors=True)
        raise DevrfError(
            f"scene={scene.name}: what came has the SHA-256 {digest}, expected {expected}; it "
            "was removed: try again, and if it comes again, ask who published it"
        )
    ready = _unpacked(scene, work) if scene.is_archive else work / "files"
    record = {
        "scene": scene.name,
        "page": scene.collection.page,
        "url": scene.collection.filled(scene.collection.url, scene.name),
        "licence": scene.collection.licence,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "files": len(files),
        "sha256": digest,
        "compared": expected is not None,
    }
    write_json(ready / RECORD, record)
    ready.rename(path)
    shutil.rmtree(work, ignore_errors=True)
    return digest


def _download(scene: PublishedScene, folder: Path, progress: bool) -> dict[str, Path]:
    """The downloaded files by their names; those that have come before are there already."""
    import requests  # it loads much, and every command reads this module
    import urllib3

    files = {name: folder / name for name in scene.downloads}
    left, heard, until = LARGEST, 0.0, time.monotonic() + LONGEST
    bar = Progress(console=Console(stderr=True), disable=not progress)

    def take(name: str, url: str) -> None:
        nonlocal left, heard
        with (
            session.get(url, stream=True, timeout=PATIENCE) as answer,
            atomic_write(files[name]) as begun,
            begun.open("wb") as file,
        ):
            answer.raise_for_status()
            size = int(answer.headers.get("Content-Length", 0)) or None
            task = bar.add_task(name, total=size, visible=scene.is_archive)
            while part := answer.raw.read1(2**20):  # what has come, be it a byte
                heard = time.monotonic()
                left -= len(part)
                if left < 0:
                    raise ValueError(f"more than {decimal(LARGEST)} came")
                file.write(part)
                bar.advance(task, len(part))

    # A thread may be left alone: a server may send headers without end.
    with requests.Session() as session, bar, ThreadPool(1) as thread:
        # A server may ask for any wait, and send any amount with a redirection, which is read.
        retries = urllib3.Retry(2, respect_retry_after_header=False)
        for scheme in ("http://", "https://"):
            session.mount(scheme, requests.adapters.HTTPAdapter(max_retries=retries))
        session.hooks["response"].append(lambda a, **_: a.close() if a.is_redirect else None)
        # Some servers refuse the name that Python gives itself.
        session.headers.update({"User-Agent": "devrf", "Accept-Encoding": "identity"})
        for name, url in bar.track(scene.downloads.items(), description=scene.name):
            if files[name].is_file():
                continue
            heard = time.monotonic()
            taken = thread.apply_async(take, (name, url))
            try:
                while not taken.ready():
                    taken.wait(0.2)
                    if time.monotonic() > min(until, heard + STALLED):
                        raise TimeoutError("it comes too slowly")
                taken.get()
            except (OSError, ValueError, urllib3.exceptions.HTTPError) as error:
                if getattr(error, "errno", None) is not None:  # the disk's
                    raise
                raise DevrfError(
                    f"{url}: cannot be fetched ({error}); see that the network works, and that "
                    f"its page {scene.collection.page} names no other address"
                ) from None
            finally:
                if not taken.ready():  # interrupted, or too slow
                    left = 0  # ends the thread with the next bytes, and its file is removed
                    taken.wait(1)
    return files


def _digest(files: dict[str, Path]) -> str:
    """The SHA-256 of an archive; for several files, of the lines that sha256sum prints."""
    digests = dict[str, str]()
    for name, path in files.items():
        with path.open("rb") as file:
            digests[name] = hashlib.file_digest(file, "sha256").hexdigest()
    if list(files) == [ARCHIVE]:
        return digests[ARCHIVE]
    lines = "".join(f"{digests[name]}  {name}\n" for name in sorted(files))
    return hashlib.sha256(lines.encode()).hexdigest()


class _Archive(io.FileIO):
    """An archive whose list of files has at most SMALL bytes.

    zipfile reads it at once, and takes ten times that in memory.
    """

    def read(self, size: int | None = -1, /) -> Any:
        """The next bytes; ValueError: it is the list, and too long."""
        if size is not None and size > SMALL:
            raise ValueError("it lists too many files")
        return super().read(size)


def _unpacked(scene: PublishedScene, work: Path) -> Path:
    """The folder of the archive that holds the scene's marker, without the folders around it.

    DevrfError if there is none, or it would expand far beyond images and cameras of its size.
    """
    archive = work / "files" / ARCHIVE
    size = archive.stat().st_size
    most = min(max(MOST_EXPANSION * size, SMALL), LARGEST)
    unpacked = work / "unpacked"
    shutil.rmtree(unpacked, ignore_errors=True)
    try:
        with _Archive(archive) as file, zipfile.ZipFile(file) as packed:
            if any(name.count("/") > DEEPEST for name in packed.namelist()):
                raise ValueError(f"more than {DEEPEST} folders in one another")
            # A file takes 4 kB of a disk at least, and so does each folder that it may be the first
            # in. No more of it is unpacked than is said here.
            whole = sum(
                max(file.file_size, 2**12) + 2**12 * file.filename.count("/")
                for file in packed.infolist()
            )
            if whole > most:
                raise ValueError(f"its {decimal(size)} would become {decimal(whole)}")
            packed.extractall(unpacked)  # names that lead elsewhere are written below it, too
    except Exception as error:  # of any kind, where an archive is damaged
        if getattr(error, "errno", None) is not None:  # the disk's
            raise
        raise DevrfError(
            f"{archive}: cannot be unpacked ({error}); remove it, and the same command fetches it "
            "again; or ask who published it"
        ) from None
    source = scene.collection
    folder = source.folder and source.filled(source.folder, scene.name)
    marker = MARKERS[scene.collection.data]
    folders = [
        path.parent
        for path in sorted(unpacked.rglob(marker))
        if "__MACOSX" not in path.parts and folder in (None, path.parent.name)
    ]
    if not folders:
        raise DevrfError(
            f"{archive}: holds no {folder or 'folder'} with {marker}; what is "
            "published has changed: unpack it by hand"
        )
    return min(folders, key=lambda path: len(path.parts))
