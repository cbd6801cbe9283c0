"""``python -m devrf``."""

from __future__ import annotations

import os
import sys

from devrf.cli.app import main
from devrf.cli.data_choice import with_data_choice
from devrf.cli.messages import report_user_errors
from devrf.cli.sweep import failures_at_the_end
from devrf.system.process import tune_for_cpu
from devrf.system.signals import Interrupted, end_at_once, handle_signals


def entry() -> None:
    """Run the application.

    A mistake in the input ends it with one line and status 2, a sweep of which jobs failed with
    their names and status 3, a signal with one line and 128 plus its number: 130 for Ctrl-C,
    143 for SIGTERM.
    """
    # Hydra would print a traceback of its own and exit with 1 if it were not told to raise.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    sys.argv = [sys.argv[0], *with_data_choice(sys.argv[1:])]
    tune_for_cpu()
    try:
        with handle_signals(end_at_once), report_user_errors(), failures_at_the_end():
            main()
    except Interrupted as stop:
        print(f"devrf: {stop.said}", file=sys.stderr)
        raise
    except KeyboardInterrupt:  # raised by another library's handler of Ctrl-C
        print("devrf: interrupted", file=sys.stderr)
        sys.exit(130)


if __name__ == "__main__":
    entry()
