"""Rehearses every setting that is made for a GPU, on embedded scenes: what no test has time for.

Each is a command of its own, ``python -m devrf rehearse=true …``, on one core: the paper's settings
of its nine scenes and of its ablations on stand-ins of the same facing, as files in the published
layouts; ``experiment=best``; each method by each protocol at its published size and in its form for
minutes on a GPU; and their other published forms. A line for each says what was learned, or what
was not.

    make rehearse                                     # 37 minutes on two cores
    python benchmarks/rehearse.py --only paper peer   # those with one of these words
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parent.parent
INWARD = ("lego", "floating_robot", "daisy", "glove", "kuka", "flower_360")
FORWARD = ("pig_toy", "plant", "rabbit")
# Of the same facing, with images of twice the size that a rehearsal has.
STAND_INS = {
    "inward": ("data=procedural", "data.width=128", "data.height=128"),
    "forward": ("data=procedural_forward", "data.width=128", "data.height=96"),
}
KPLANES = ("kplanes_paper", "kplanes_explicit", "kplanes_video", "kplanes_video_explicit")


def rehearsals(stand_ins: Path) -> Iterator[tuple[str, ...]]:
    """What is typed for each; ``stand_ins`` is the folder of the stand-ins."""
    scenes = [(name, "inward") for name in INWARD] + [(name, "forward") for name in FORWARD]
    for name, facing in scenes:
        yield "experiment=paper", f"data={name}", f"data.root={stand_ins / facing}"
    rows = sorted(path.stem for path in (REPOSITORY / "conf" / "comparison").glob("*.yaml"))
    for row in rows:
        if row.startswith("devrf_paper"):
            yield f"comparison={row}", "data=lego", f"data.root={stand_ins / 'inward'}"
        elif row == "devrf":
            yield (f"comparison={row}",)
        else:
            yield "experiment=peer_paper", f"comparison={row}"
            yield "experiment=peer_fast", f"comparison={row}"
    yield ("experiment=best",)
    yield "experiment=best", "data=procedural_forward"
    for profile in KPLANES:
        yield "method=kplanes", "protocol=joint", f"profile={profile}"
    yield "method=kplanes", "protocol=joint", "profile=kplanes_video", "data=procedural_forward"
    yield "method=tineuvox", "protocol=joint", "profile=tineuvox_light"
    yield "experiment=phone_gpu", "data=procedural_forward", "data.camera=handheld"


def main() -> None:
    """Rehearse what the command line chooses; status 1 where one has failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--into", type=Path, default=REPOSITORY / "outputs" / "rehearsals")
    parser.add_argument("--only", nargs="+", default=[""], help="words that a command has one of")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    into = options.into.resolve()
    for facing, words in STAND_INS.items():
        done = devrf(
            "stage=prepare", *words, f"prepare.into={into / facing}", folder=into / f"{facing}-made"
        )
        if done.returncode:
            sys.exit(done.stdout + done.stderr)
    chosen = [
        words for words in rehearsals(into) if any(part in " ".join(words) for part in options.only)
    ]
    began = time.monotonic()
    failed = 0
    with ThreadPoolExecutor(options.jobs) as pool:
        begun = {pool.submit(rehearsed, words, into): words for words in chosen}
        for future in as_completed(begun):
            ended_well, line = future.result()
            failed += not ended_well
            shown = [word for word in begun[future] if not word.startswith("data.root=")]
            print(f"{'learns' if ended_well else 'FAILED'}  {' '.join(shown)}: {line}", flush=True)
    print(f"{len(chosen)} rehearsals, {failed} failed, {time.monotonic() - began:.0f} s")
    sys.exit(failed > 0)


def rehearsed(words: Sequence[str], into: Path) -> tuple[bool, str]:
    """Whether a rehearsal says that all learns; and what was learned, in dB, or its complaint."""
    name = "-".join(word.rpartition("=")[2] for word in words if not word.startswith("data.root"))
    folder = into / name
    began = time.monotonic()
    done = devrf("rehearse=true", *words, folder=folder)
    seconds = f"{time.monotonic() - began:.0f} s"
    if done.returncode:
        return False, f"{done.stderr.strip().splitlines()[-1]}, {seconds}"
    learned = json.loads((folder / "rehearsal.json").read_text())["rehearsal"]["learned"]
    parts = [
        f"{capture} {of['psnr']:.1f} dB (one colour {of['blank']:.1f}"
        + ("" if of["rest_pose"] is None else f", at rest {of['rest_pose']:.1f}")
        + ")"
        for capture, of in learned.items()
    ]
    return True, f"{', '.join(parts)}, {seconds}"


def devrf(*words: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """The command on one core, with results in ``folder``."""
    command = [sys.executable, "-m", "devrf", *words, f"hydra.run.dir={folder}"]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "PYTHONPATH": str(REPOSITORY / "src")}
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=False)


if __name__ == "__main__":
    main()
