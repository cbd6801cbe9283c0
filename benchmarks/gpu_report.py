"""Everything that one visit to a GPU should tell, the most telling first, written as it is found.

Each step runs in a process of its own: what fails is recorded with its traceback, and the rest goes
on. A second call with the same ``--into`` makes the steps that are left, then those that failed.
Without a GPU all runs at tiny sizes: whether the script works is known before the visit.
"""

from __future__ import annotations

import harness  # isort: skip: how threads wait is set before torch is loaded

import argparse
import cProfile
import io
import json
import platform
import pstats
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from importlib.metadata import distributions
from pathlib import Path

import kernels
import rendering
import torch
import training
from instruments import Row, Stopwatch
from torch.profiler import profile

from devrf import selfcheck
from devrf.cli.context import RunContext
from devrf.kernels.trilinear import interpolate
from devrf.rendering.renderer import Renderer
from devrf.scenes.scene import background_value
from devrf.system.device import wait
from devrf.system.files import write_json

HERE = Path(__file__).resolve()
DEVICE = torch.device("cuda", 0) if torch.cuda.is_available() else torch.device("cpu")
GPU = DEVICE.type == "cuda"
# The embedded scene as large as the paper's: 100 views at rest, 4 of 50 frames, 400 × 400 pixels.
SIZE = 400 if GPU else 24
VIEWS = 100 if GPU else 6
FRAMES = 50 if GPU else 3
SCENE = [
    "data=procedural",
    "data.supersample=1",
    f"data.width={SIZE}",
    f"data.height={SIZE}",
    f"data.static_views={VIEWS}",
    f"data.frames={FRAMES}",
]
TINY = [
    "field.width=16",
    "schedule.canonical.side=16",
    "schedule.canonical.search_side=12",
    "schedule.canonical.rays=128",
    "schedule.deformation.rays=128",
    # So few iterations do not learn what each growth takes away.
    "schedule.canonical.density_drop=0",
    "schedule.canonical.occupancy_every=null",
]


def shortened(search: int, fine: int, frame: int) -> list[str]:
    """Overrides of the paper's schedule: iterations of the search, the field, and each frame."""
    key = "schedule.canonical"
    levels = range(1, 6)
    overrides = [
        f"{key}.search_iterations={search}",
        f"{key}.visual_hull_init=true",
        f"{key}.iterations={fine}",
        f"{key}.decay_iterations={fine}",
        f"{key}.upsample_at=[{','.join(str(fine * k // 20) for k in (1, 2, 3, 4))}]",
        *(f"schedule.deformation.levels.{k}.iterations={frame}" for k in levels),
    ]
    sides = (f"schedule.deformation.levels.{k}.side={k + 2}" for k in levels)
    return overrides if GPU else [*overrides, *sides, *TINY]


def run_of(into: Path, name: str, *overrides: str, experiment: str = "paper") -> RunContext:
    """A run of an experiment on the report's scene, in a folder of its own."""
    root = (into / "root.txt").read_text() if (into / "root.txt").exists() else into / "scene"
    common = [f"experiment={experiment}", f"data.root={root}", f"hydra.run.dir={into / name}"]
    device = ["memory_check=false"] if GPU else ["trainer=cpu", *shortened(0, 40, 2)]
    return harness.open_run([*common, *device, *overrides])


def machine(into: Path) -> Iterator[Row]:
    """Device, driver, versions and revision."""
    packages = sorted(
        f"{package.metadata['Name']} {package.version}" for package in distributions()
    )
    yield {"platform": platform.platform(), "python": sys.version, "packages": packages}
    yield {"revision": said(["git", "-C", str(HERE.parent), "rev-parse", "HEAD"])}
    device = str(torch.cuda.get_device_properties(DEVICE)) if GPU else "no GPU"
    yield {"driver": said(["nvidia-smi"]), "cuda": torch.version.cuda, "device": device}


def said(command: list[str]) -> str:
    """What a command prints, or why it could not be run."""
    try:
        result = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        return str(error)
    return result.stdout + result.stderr


def checks(into: Path) -> Iterator[Row]:
    """The self-check: a verdict for each resume and picture."""
    for name, verdict, figures in selfcheck.run_checks(DEVICE, 0):
        yield {"check": name, "verdict": verdict, "figures": figures}


def tests(into: Path) -> Iterator[Row]:
    """``pytest -m gpu``, where pytest is installed."""
    command = [sys.executable, "-m", "pytest", "-q", "-m", "gpu", "-p", "no:cacheprovider"]
    yield {"tests": said([*command, str(HERE.parents[1] / "tests")]).splitlines()[-60:]}


def kernel_rows(into: Path) -> Iterator[Row]:
    """Each kernel at the paper's size beside its definition; first, seconds until one has run."""
    began = time.perf_counter()
    interpolate(
        torch.zeros(2, 2, 2, 1, device=DEVICE), torch.zeros(1, 3, device=DEVICE), kernels.BOX
    )
    wait(DEVICE)
    yield {"seconds until the first interpolation has run, compiled": time.perf_counter() - began}
    yield from kernels.rows(DEVICE) if GPU else kernels.rows(DEVICE, side=8, rays=8, points=8)


def scene(into: Path) -> Iterator[Row]:
    """Write the embedded scene, so that each step reads it; or note where the given one is."""
    began = time.perf_counter()
    where = [f"prepare.into={into / 'scene'}", f"hydra.run.dir={into / 'make'}"]
    run = harness.open_run([*SCENE, "stage=prepare", *where])
    harness.run_stage(run.config, run.folder)
    yield {"seconds": time.perf_counter() - began, "views": run.scene.static.train.pixels.shape}


def learned(
    into: Path, name: str, overrides: Sequence[str] = (), experiment: str = "paper"
) -> Iterator[Row]:
    """Learn both stages: seconds, milliseconds by resolution, memory, PSNR on held-out views."""
    for stage in ("canonical", "deformation", "evaluate"):
        run = run_of(into, name, *overrides, f"stage={stage}", experiment=experiment)
        began = time.perf_counter()
        with Stopwatch(DEVICE) as watch:
            harness.run_stage(run.config, run.folder)
        seconds = time.perf_counter() - began
        peaks = (torch.cuda.max_memory_allocated(), torch.cuda.max_memory_reserved())
        yield {"stage": stage, "all seconds": seconds, "bytes allocated, reserved": peaks}
        if stage != "evaluate":
            yield from watch.rows()
    yield json.loads((run.folder / "metrics.json").read_text())


def learned_run(into: Path) -> RunContext:
    """The run that learned with all iterations, or where there is none, with fewer."""
    whole = run_of(into, "paper")
    return whole if whole.own_checkpoint("deformation").exists() else run_of(into, "as-it-is")


def parts(into: Path) -> Iterator[Row]:
    """Iterations at each resolution of the learned scene, by part, on the host and by kernel."""
    run = learned_run(into)
    tables = []
    usual = training.parts

    def noted(work: Callable[[], None], *, cuda: bool) -> dict[str, float]:
        host = cProfile.Profile()
        host.runcall(work)
        wait(DEVICE)
        text = io.StringIO()
        pstats.Stats(host, stream=text).sort_stats("tottime").print_stats(40)
        tables.append(text.getvalue())
        with profile(record_shapes=False) as profiled:
            work()
        order = "self_cuda_time_total" if cuda else "self_cpu_time_total"
        tables.append(profiled.key_averages().table(sort_by=order, row_limit=40))
        return usual(work, cuda=cuda)

    training.parts = noted
    stored = harness.learned_scene(run)
    seconds = 1.0 if GPU else 0.01
    for rows in (training.canonical_rows, training.deformation_rows):
        yield from rows(run, stored, seconds)
    (into / "profile.txt").write_text("\n\n".join(tables))


def frames(into: Path) -> Iterator[Row]:
    """Frames a second at a new time and again at the same, and what a frame launches."""
    run = learned_run(into)
    began = time.perf_counter()
    stored = harness.learned_scene(run)
    yield {"seconds to load and unpack": time.perf_counter() - began}
    views = run.scene.dynamic.test
    background = background_value(run.scene.background)
    renderer = Renderer(stored.model)
    row = rendering.frames_a_second(renderer, views, min(5, len(views)), background)
    with profile() as profiled:
        renderer.view(views.cameras, 0, float(views.times[-1]), background)
        wait(DEVICE)
    on_device = [event for event in profiled.events() if event.device_type.name == "CUDA"]
    yield {**row, "launches": len(on_device)}


FEWER = shortened(0, 2000, 20) if GPU else []
# Each step with the minutes that it may take, the most telling first.
STEPS: dict[str, tuple[float, Callable[[Path], Iterator[Row]]]] = {
    "machine": (1, machine),
    "kernels": (3, kernel_rows),
    "checks": (6, checks),
    "scene": (8, scene),
    "paper": (15, partial(learned, name="paper")),
    "frames": (5, frames),
    "parts": (5, parts),
    **{
        name: (6, partial(learned, name=name, overrides=[*FEWER, *overrides]))
        for name, overrides in {
            "as-it-is": [],
            "10-a-step": [f"{key}.iterations_per_step=10" for key in ("canonical", "deformation")],
            "frames-on-device": ["schedule.visit.store=device"],
        }.items()
    },
    "tests": (6, tests),
    "best": (40, partial(learned, name="best", experiment="best")),
}


def main() -> None:
    """Make the steps that are left for as long as is given, each in a process of its own."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--into", type=Path, default=Path("gpu_report"), help="a folder")
    arguments.add_argument("--minutes", type=float, default=25.0, help="for all steps together")
    arguments.add_argument("--root", type=Path, help="a scene from disk; else the embedded one")
    arguments.add_argument("--steps", nargs="*", default=[*STEPS], help="these alone")
    arguments.add_argument("--run", help=argparse.SUPPRESS)
    options = arguments.parse_args()
    into: Path = options.into.absolute()
    into.mkdir(parents=True, exist_ok=True)
    if options.run:
        make(into, options.run)
        return
    if options.root:
        (into / "root.txt").write_text(str(options.root.absolute()))
    end = time.monotonic() + 60 * options.minutes
    # What has failed, or was cut short, is tried again once the rest is there.
    for name in sorted(options.steps, key=lambda name: record(into, name)["status"] != "left"):
        left = end - time.monotonic()
        if record(into, name)["status"] == "done" or left < 5:
            continue
        began = time.monotonic()
        command = [sys.executable, str(HERE), "--into", str(into)]
        with (into / f"{name}.log").open("w") as output, suppress(subprocess.TimeoutExpired):
            limit = min(left, 60 * STEPS[name][0])
            subprocess.run(
                [*command, "--run", name], stdout=output, stderr=output, timeout=limit, check=False
            )
        print(
            f"{name}: {record(into, name)['status']}, {time.monotonic() - began:.0f} s", flush=True
        )
        write_report(into)


def make(into: Path, name: str) -> None:
    """Make one step, and write what is found after each row."""
    rows: list[Row] = []

    def write(status: str) -> None:
        write_json(into / f"{name}.json", {"status": status, "rows": rows})

    write("cut short")
    try:
        for row in STEPS[name][1](into):
            rows.append(row)
            write("cut short")
    except BaseException:
        rows.append({"failed": traceback.format_exc()})
        write("failed")
        raise
    write("done")


def record(into: Path, name: str) -> Row:
    """What is known of a step."""
    path = into / f"{name}.json"
    entry: Row = json.loads(path.read_text()) if path.exists() else {"status": "left", "rows": []}
    return entry


def write_report(into: Path) -> None:
    """One page of all that has been found."""
    lines = []
    for name in STEPS:
        entry = record(into, name)
        lines += [f"## {name}: {entry['status']}", ""]
        lines += [f"- {json.dumps(row)}" for row in entry["rows"]] + [""]
    (into / "REPORT.md").write_text("\n".join(lines))


if __name__ == "__main__":
    main()
