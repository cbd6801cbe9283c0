"""The step that checks the machine: ``stage=selfcheck``."""

from __future__ import annotations

import logging
import sys
from typing import Any

import torch
from hydra.utils import instantiate

from devrf.apps.records import provenance
from devrf.cli import job
from devrf.cli.context import RunContext
from devrf.engine.ddp import ManualDDP
from devrf.errors import DevrfError
from devrf.selfcheck.runner import SelfcheckSettings, Verdict, run_checks
from devrf.system.files import write_json

log = logging.getLogger(__name__)

RECORD = "selfcheck.json"
# The exit status where checks failed, as of a sweep with failed jobs.
CHECKS_FAILED = 3


def selfcheck(run: RunContext) -> None:
    """Make the checks on the trainer's device: a line for each, and ``selfcheck.json``.

    Raises:
        DevrfError: a setting is wrong; in a sweep, checks have failed.
        SystemExit: with status 3, checks have failed.
    """
    settings: SelfcheckSettings = instantiate(run.config.selfcheck, _convert_="all")
    if isinstance(run.strategy, ManualDDP):
        raise DevrfError("trainer: stage=selfcheck checks one device; leave out trainer=ddp")
    about = _about(run)
    log.info("%s, torch %s", about["device"], about["torch"])
    verdicts: list[Verdict] = []
    for verdict in run_checks(settings, run.device, run.config.seed, run.folder):
        verdicts.append(verdict)
        log.info("%s", verdict.line)
        # After each, so that the file is there whatever ends the run.
        checks = [one.as_data() for one in verdicts]
        write_json(run.folder / RECORD, {**about, "seconds": run.step_seconds, "checks": checks})
    _conclude(run, verdicts)


def _about(run: RunContext) -> dict[str, Any]:
    """Device, versions and revision."""
    known = provenance(0, run.device)
    for name in ("parameters", "peak_host_gb"):
        del known[name]
    if run.device.type == "cuda":
        major, minor = torch.cuda.get_device_capability(run.device)
        known |= {"capability": f"{major}.{minor}", "cuda": torch.version.cuda}
    return known


def _conclude(run: RunContext, verdicts: list[Verdict]) -> None:
    """Say how many held; end with another status than 0 if some failed."""
    named = {kind: [v.name for v in verdicts if v.verdict == kind] for kind in ("held", "failed")}
    left = len(verdicts) - len(named["held"]) - len(named["failed"])
    path = run.folder / RECORD
    log.info(
        "%d held, %d failed, %d left out, in %.0f s; written to %s",
        *(len(named["held"]), len(named["failed"]), left, run.step_seconds, path),
    )
    if not named["failed"]:
        return
    said = f"stage=selfcheck: {len(named['failed'])} checks failed: {', '.join(named['failed'])}"
    if job.in_sweep():
        raise DevrfError(said)
    print(f"devrf: {said}", file=sys.stderr)
    raise SystemExit(CHECKS_FAILED)
