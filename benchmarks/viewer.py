"""What ``viewer=true`` costs a stage: without it, with nobody watching, and with a page open.

The canonical stage is learned by a process of its own, each way in turn, as often as ``--turns``
says. ``seconds`` are those of optimisation, as metrics.json has them; ``processor s`` is what the
whole process took of the processors, which other programs on the machine change less; ``pictures
s`` is what pictures took. Headless Chromium opens the page; its own work is not counted but slows
what runs beside it.
"""

from __future__ import annotations

import harness  # isort: skip: how threads wait is set before torch is loaded

import os
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

WAYS = ("without", "nobody watches", "a page is open")
# Without a GPU Chromium draws by SwiftShader.
BROWSER = (
    *("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=700,400"),
    *("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
)


def learned(overrides: list[str], folder: Path) -> dict[str, float]:
    """What learning the canonical stage takes."""
    command = [sys.executable, "-m", "devrf", *overrides, "stage=canonical", "resume=false"]
    before = os.times()
    said_in = folder.with_suffix(".log")
    with said_in.open("w") as log:
        subprocess.run([*command, f"hydra.run.dir={folder}"], check=True, stdout=log, stderr=log)
    after = os.times()
    taken = sum(after[2:4]) - sum(before[2:4])
    lines = said_in.read_text().splitlines()
    said = next(line for line in reversed(lines) if line.startswith("canonical: seconds"))
    drawn = next((float(line.split()[3]) for line in lines if line.startswith("viewer: pict")), 0.0)
    seconds = float(said.split()[2].rstrip(","))
    return {"seconds": seconds, "processor s": taken, "pictures s": drawn}


@contextmanager
def watching(address: str) -> Iterator[None]:
    """A browser that keeps trying until the page is there."""
    found = shutil.which("chromium") or shutil.which("google-chrome")
    if found is None:
        raise SystemExit("no chromium on this machine")
    with tempfile.TemporaryDirectory() as profile:
        page = Path(profile) / "wait.html"
        # A frame that is asked for before the server listens stays empty: it is asked for again.
        page.write_text(
            f"<script>const open = () => fetch('{address}', {{mode: 'no-cors'}})"
            f".then(() => location.replace('{address}')).catch(() => setTimeout(open, 200));"
            "open()</script>"
        )
        process = subprocess.Popen(
            [found, *BROWSER, f"--user-data-dir={profile}/profile", page.as_uri()],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            yield
        finally:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def main() -> None:
    """Learn each way in turn, and report all runs."""
    arguments = harness.parser(__doc__)
    arguments.add_argument("--turns", type=int, default=2)
    arguments.add_argument("--port", type=int, default=8080)
    given = arguments.parse_args()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        for turn in range(given.turns):
            for way in WAYS:
                page = [] if way == "without" else ["viewer=true", f"viewer.port={given.port}"]
                into = Path(folder) / f"{turn}-{way.replace(' ', '-')}"
                if way == "a page is open":
                    with watching(f"http://127.0.0.1:{given.port}"):
                        found = learned([*given.overrides, *page], into)
                else:
                    found = learned([*given.overrides, *page], into)
                rows.append({"turn": turn + 1, "viewer": way, **found})
    into = given.json or Path("outputs/benchmarks/viewer.json")
    harness.report(rows, into, torch.device("cpu"), overrides=given.overrides)


if __name__ == "__main__":
    main()
