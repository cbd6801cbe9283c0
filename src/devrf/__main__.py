"""``python -m devrf``."""

from __future__ import annotations

import os
import sys

import devrf
from devrf.cli.app import main
from devrf.cli.command_line import as_hydra_takes_it
from devrf.cli.completion import answer_completion
from devrf.cli.messages import report_user_errors
from devrf.cli.sweep import failures_at_the_end
from devrf.system.process import Interrupted, end_at_once, handle_signals, tune_for_cpu


def entry() -> None:
    """Run the application.

    A mistake in the input ends it with one line and status 2, a sweep of which jobs failed with
    their names and status 3, a signal with one line and 128 plus its number: 130 for Ctrl-C,
    143 for SIGTERM.
    """
    # Hydra would print a traceback of its own and exit with 1 if it were not told to raise.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    if "--version" in sys.argv[1:]:  # else Hydra's own
        print(f"devrf {devrf.__version__}")
        return
    if answer_completion(sys.argv[1:]):
        return
    tune_for_cpu()
    try:
        with handle_signals(end_at_once), report_user_errors(), failures_at_the_end():
            sys.argv[1:] = as_hydra_takes_it(sys.argv[1:])
            main()
    except Interrupted as stop:
        print(f"devrf: {stop.said}", file=sys.stderr)
        raise
    except KeyboardInterrupt:  # raised by another library's handler of Ctrl-C
        print("devrf: interrupted", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    entry()
