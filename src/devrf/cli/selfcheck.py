"""The step that checks the machine: ``stage=selfcheck``."""

from __future__ import annotations

import logging

from hydra.utils import instantiate

from devrf.cli.context import RunContext
from devrf.engine.ddp import ManualDDP
from devrf.errors import DevrfError
from devrf.system.files import write_json

log = logging.getLogger(__name__)


def selfcheck(run: RunContext) -> None:
    """Make the checks on the trainer's device: a line for each, and ``selfcheck.json``.

    Raises:
        DevrfError: a setting is wrong, or checks have failed.
    """
    if isinstance(run.strategy, ManualDDP):
        raise DevrfError("trainer: stage=selfcheck checks one device; leave out trainer=ddp")
    results = []
    run_checks = instantiate(run.config.selfcheck, _convert_="all")
    for name, verdict, said in run_checks(run.device, run.config.seed):
        log.info("%s  %s: %s", verdict, name, said)
        results.append({"name": name, "verdict": verdict, "said": said})
        # After each, so that the file is there whatever ends the run.
        write_json(run.folder / "selfcheck.json", {"checks": results})
    failed = [result["name"] for result in results if result["verdict"] == "failed"]
    if failed:
        raise DevrfError(f"stage=selfcheck: {len(failed)} checks failed: {', '.join(failed)}")
