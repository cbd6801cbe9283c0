"""Runs checks one after another; each has a verdict whatever becomes of the others."""

from __future__ import annotations

import multiprocessing
import pickle
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import torch

from devrf.errors import DevrfError, did_you_mean
from devrf.scenes.scene import Scene
from devrf.selfcheck.bench import ON_CPU, ON_GPU, Bench, Size, small_scene
from devrf.selfcheck.checks import CHECKS, Check, check_named
from devrf.selfcheck.finding import Finding
from devrf.selfcheck.isolation import NoFindingError, can_use, isolated, warm_processes

LOG = "selfcheck.log"


@dataclass(frozen=True)
class SelfcheckSettings:
    """What is checked, and for how long.

    Attributes:
        only: first words of the checks to make; None: all that the device can do.
        max_seconds: time for all of them; those for which none is left have failed.
        most_seconds: time for a single one.
        iterations: of a stage, about.
    """

    only: Sequence[str] | None = None
    max_seconds: float = 480.0
    most_seconds: float = 120.0
    iterations: int = 100

    def __post_init__(self) -> None:
        if min(self.max_seconds, self.most_seconds) <= 0:
            raise DevrfError(
                "selfcheck: expected max_seconds and most_seconds above 0, not "
                f"{self.max_seconds:g} and {self.most_seconds:g}"
            )
        if self.iterations < 20:
            raise DevrfError(f"selfcheck.iterations: expected 20 or more, not {self.iterations}")
        _ = self.checks

    @property
    def checks(self) -> list[Check]:
        """The checks to make.

        Raises:
            DevrfError: none begins with one of the words of ``only``.
        """
        if self.only is None:
            return list(CHECKS)
        names = [check.name for check in CHECKS]
        for start in self.only:
            if not any(name.startswith(start) for name in names):
                kinds = list(dict.fromkeys(name.split()[0] for name in names))
                meant = did_you_mean(start, [*kinds, *names], "")
                raise DevrfError(
                    f"selfcheck.only: expected the first words of a check ({', '.join(kinds)}), "
                    f"not {start!r}{meant}"
                )
        return [c for c in CHECKS if c.name.startswith(tuple(self.only))]


@dataclass(frozen=True)
class Verdict:
    """What became of a check.

    Attributes:
        name: of the check.
        verdict: whether what is promised was kept, or the check was left out.
        said: why, or the figures that matter.
        figures: all of them by name.
        seconds: that the check took.
    """

    name: str
    verdict: Literal["held", "failed", "left out"]
    said: str
    figures: dict[str, Any] = field(default_factory=dict)
    seconds: float = 0.0

    @property
    def line(self) -> str:
        """The verdict on one line."""
        return f"{self.verdict:<8}  {self.name}: {self.said}"

    def as_data(self) -> dict[str, Any]:
        """As plain data."""
        return asdict(self)


def run_checks(
    settings: SelfcheckSettings, device: torch.device, seed: int, folder: Path
) -> Iterator[Verdict]:
    """The verdicts, one after another.

    Args:
        settings: what is checked.
        device: where.
        seed: of what is learned.
        folder: gets ``selfcheck.log``: what the checks' processes say, tracebacks too.
    """
    began = time.monotonic()
    size = replace(ON_GPU if device.type == "cuda" else ON_CPU, iterations=settings.iterations)
    scene = pickle.dumps(small_scene(size))
    earlier: dict[str, dict[str, Any]] = {}
    interpreter = {} if device.type == "cuda" else {"TRITON_INTERPRET": "1"}
    (folder / LOG).write_text("")
    with warm_processes(interpreter) as warm:
        context = warm
        if device.type == "cuda" and not can_use(warm, device, folder / LOG):
            context = multiprocessing.get_context("spawn")
        for check in settings.checks:
            reason = check.left_out(device)
            if reason is not None:
                yield Verdict(check.name, "left out", reason)
                continue
            before = time.monotonic()
            left = settings.max_seconds - (before - began)
            if left <= 0:
                over = f"not begun: selfcheck.max_seconds={settings.max_seconds:g} were over"
                yield Verdict(check.name, "failed", over)
                continue
            with (folder / LOG).open("a") as log:
                log.write(f"== {check.name}\n")
            arguments = check.name, device, size, scene, seed, earlier
            try:
                found = isolated(
                    context,
                    perform,
                    arguments,
                    folder / LOG,
                    min(left, settings.most_seconds),
                )
            except NoFindingError as error:
                found = Finding(False, f"{error}; see {LOG}")
            earlier[check.name] = found.figures
            seconds = round(time.monotonic() - before, 2)
            verdict: Literal["held", "failed"] = "held" if found.held else "failed"
            yield Verdict(check.name, verdict, found.said, found.figures, seconds)


def perform(
    name: str,
    device: torch.device,
    size: Size,
    scene: bytes,
    seed: int,
    earlier: dict[str, dict[str, Any]],
) -> Finding:
    """Make a check, in this process.

    Args:
        name: of the check.
        device: where.
        size: how much is learned.
        scene: the pickled small scene.
        seed: of what is learned.
        earlier: figures of earlier checks by name.
    """
    if device.type == "cuda":
        torch.cuda.set_device(device)
    loaded: Scene = pickle.loads(scene)
    return check_named(name).work(Bench(device, size, loaded, seed), earlier)
