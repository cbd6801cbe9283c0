"""A published scene, downloaded, checked and put in its place."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from filelock import FileLock, Timeout

from devrf.errors import DevrfError
from devrf.scenes.fetch.archive import unpack_scene
from devrf.scenes.fetch.catalogue import PublishedScene
from devrf.system.download import download, remote_size
from devrf.system.files import free_disk, make_folder, write_json

# Beside the data: where they are from, when, and their checksums.
RECORD = "fetched.json"
# How many sizes are asked for at once.
ASKED_AT_ONCE = 8

Progress = Callable[[int], None]


@dataclass(frozen=True)
class Fetched:
    """A scene in its place.

    Attributes:
        path: its folder.
        sha256: of the archive; of several files that of the list of their checksums.
        compared: whether it was compared with a checksum that was known before.
        anew: whether it was fetched now, and not before.
    """

    path: Path
    sha256: str
    compared: bool
    anew: bool


def download_size(scene: PublishedScene) -> int | None:
    """Bytes to fetch; None where a server does not say.

    Raises:
        DevrfError: a server cannot be reached, or has no such file.
    """
    with ThreadPoolExecutor(ASKED_AT_ONCE) as pool:
        sizes = list(pool.map(remote_size, scene.downloads.values()))
    known = [size for size in sizes if size is not None]
    return sum(known) if len(known) == len(sizes) else None


def fetched_before(scene: PublishedScene, into: Path) -> Fetched | None:
    """The scene, if it is in its place already.

    Raises:
        DevrfError: something else has its place.
    """
    path = into / scene.name
    if not path.exists():
        return None
    try:
        record = json.loads((path / RECORD).read_text())
        return Fetched(path, str(record["sha256"]), bool(record["compared"]), anew=False)
    except (OSError, ValueError, KeyError, TypeError):
        raise DevrfError(
            f"{path}: there is something else, without {RECORD}; remove it, or give fetch.into=PATH"
        ) from None


def fetch_scene(
    scene: PublishedScene, into: Path, sha256: str | None, size: int | None, progress: Progress
) -> Fetched:
    """Download a scene to ``into``/<its name>, which appears when it is whole and checked.

    Args:
        scene: which.
        into: the folder below which it is put.
        sha256: the checksum to insist on; None: the catalogue's, if it has one.
        size: bytes to fetch; None: unknown.
        progress: is told how many bytes there are, again and again.

    Raises:
        DevrfError: it cannot be fetched, is not what was expected, or does not fit on the disk.
        OSError: the disk refuses.
    """
    expected = sha256.lower() if sha256 else scene.sha256
    with _working_folder(into / f".{scene.name}.fetch") as work:
        _check_disk(scene, work, size)
        files = _download_all(scene, work / "files", progress)
        digest = _digest(files)
        if expected is not None and digest != expected:
            shutil.rmtree(work, ignore_errors=True)
            raise DevrfError(
                f"scene={scene.name}: what came has the SHA-256 {digest}, expected {expected}; it "
                "was removed: try again, and if it comes again, ask who published it"
            )
        ready = work / "scene"
        shutil.rmtree(ready, ignore_errors=True)
        if scene.is_archive:
            unpack_scene(work / "files" / "archive", scene.marker, scene.folder, ready)
        else:
            (work / "files").rename(ready)
        _write_record(ready / RECORD, scene, files, digest, compared=expected is not None)
        path = into / scene.name
        ready.rename(path)
        shutil.rmtree(work, ignore_errors=True)
    return Fetched(path, digest, expected is not None, anew=True)


@contextmanager
def _working_folder(work: Path) -> Iterator[Path]:
    """A folder that one process at a time works in; it stays where the work is interrupted."""
    make_folder(work)
    try:
        with FileLock(work / "lock", timeout=0):
            yield work
    except Timeout:
        raise DevrfError(f"{work}: another process is fetching this scene; wait for it") from None


def _check_disk(scene: PublishedScene, work: Path, size: int | None) -> None:
    # An archive of images lies there beside what it holds for a while.
    needed = (size or 0) * (2 if scene.is_archive else 1)
    there = free_disk(work) + sum(f.stat().st_size for f in work.rglob("*") if f.is_file())
    if needed > there:
        raise DevrfError(
            f"fetch.into: scene={scene.name} needs {needed / 1e6:.0f} MB, but {there / 1e6:.0f} MB "
            "are free; free some, or give fetch.into=PATH on another disk"
        )


def _download_all(scene: PublishedScene, folder: Path, progress: Progress) -> dict[str, Path]:
    """The downloaded files by their names."""
    files, before = {}, 0
    for name, url in scene.downloads.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        download(url, path, lambda done, before=before: progress(before + done))  # type: ignore[misc]
        before += path.stat().st_size
        files[name] = path
    return files


def _digest(files: dict[str, Path]) -> str:
    """The SHA-256 of an archive; of several files that of the lines that sha256sum prints."""
    digests = {}
    for name, path in files.items():
        with path.open("rb") as file:
            digests[name] = hashlib.file_digest(file, "sha256").hexdigest()
    if list(digests) == ["archive"]:
        return digests["archive"]
    lines = "".join(f"{digests[name]}  {name}\n" for name in sorted(digests))
    return hashlib.sha256(lines.encode()).hexdigest()


def _write_record(
    file: Path, scene: PublishedScene, files: dict[str, Path], digest: str, *, compared: bool
) -> None:
    collection = scene.collection
    write_json(
        file,
        {
            "scene": scene.name,
            "page": collection.page,
            "url": collection.url.format(scene=scene.name, file="{file}"),
            "licence": collection.licence,
            "date": datetime.now(UTC).isoformat(timespec="seconds"),
            "files": len(files),
            "sha256": digest,
            "compared": compared,
        },
    )
