"""The command: typed words become a checked config, and the stage runs.

1. :func:`commands`: on the folder of a search, a command stands for one on each of its runs.
2. :func:`completed`: beneath the typed words go those that the named run was learned with, behind
   them what the scene's files say. All are Hydra's overrides, and come with the lines that say why.
3. Hydra composes them, for each job.
4. :func:`~devrf.cli.run.run_stage` checks the config against the signatures of its parts, builds
   these, and takes the steps; checkpoints get the options and the resolved values of step 2.
"""

from __future__ import annotations

import logging
import os
import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

import devrf
from devrf.cli.complete import commands, completed
from devrf.cli.config import config_folder, in_sweep, overrides
from devrf.cli.config_check import check_section
from devrf.cli.messages import report_user_errors
from devrf.cli.restore_config import parsed
from devrf.cli.run_folder import working_in
from devrf.cli.sweep import compare_runs, compares_runs, naming_failures, record_failure
from devrf.cli.view import serve_page, serves_page
from devrf.errors import expect
from devrf.system.files import utf8_path
from devrf.system.override import without_reference
from devrf.system.process import (
    Interrupted,
    end_at_once,
    handle_signals,
    importing,
    quiet_if_unread,
    tune_for_cpu,
)

log = logging.getLogger(__name__)

# Where settings of the present command are from that were not typed, until there is a log.
remarks: list[str] = []


@quiet_if_unread()
def entry() -> None:
    """Run the application.

    A mistake in the input ends it with one line and status 2. A sweep whose jobs failed ends with
    their names and status 3. A signal ends it with one line and 128 plus its number: 130 for
    Ctrl-C, 143 for SIGTERM, 141 for output that nobody reads.
    """
    # Hydra would print a traceback of its own and exit with 1 if it were not told to raise.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    tune_for_cpu()
    try:
        with handle_signals(end_at_once), report_user_errors(), naming_failures():
            if "--version" in sys.argv:  # Hydra would print its own
                print(f"devrf {devrf.__version__}")
                return
            without_reference(Path.cwd())
            for word in sys.argv[1:]:
                utf8_path(Path(word))
            for command in commands(sys.argv[1:]):
                applied = completed(command)
                sys.argv[1:] = applied.words
                remarks[:] = applied.remarks
                main()
    # A KeyboardInterrupt is raised by another library's handler of Ctrl-C.
    except (Interrupted, KeyboardInterrupt) as stop:
        print(f"devrf: {getattr(stop, 'message', 'interrupted')}", file=sys.stderr)
        sys.exit(getattr(stop, "code", 130))


def run(config: DictConfig) -> float | None:
    """Run ``stage=…`` in Hydra's output folder; return the objective, if measured."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    guard = record_failure(config, folder) if in_sweep() else report_user_errors()
    with guard, working_in(folder, config):
        for line in remarks:
            log.info("%s", line)
        typed = parsed(overrides())
        if serves_page(typed, folder):
            serve_page(config, folder)
            return None
        if compares_runs(config, typed):
            check_section(config, "report")
            compare_runs(config)
            return None
        chosen = f"{folder}, which hydra.run.dir=FOLDER chooses"
        expect(config.output_dir == str(folder), "output_dir", chosen, config.output_dir)
        with importing():
            # Imported here: --help and a misspelt key are answered before torch has loaded.
            from devrf.cli.run import run_stage

        return run_stage(config, folder)
    return None  # of a job that failed


# A name of its own: other processes import `run` by its name.
main = hydra.main(config_path=str(config_folder()), config_name="config", version_base="1.3")(run)
