"""The command: what is typed is completed and composed, the config checked, the stage run."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

import hydra
from hydra import initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.plugins.completion_plugin import DefaultCompletionPlugin
from omegaconf import DictConfig

import devrf
from devrf.apps.fetch import catalogue
from devrf.cli.complete import completed, with_recognised_data
from devrf.cli.config import config_folder, in_sweep, known_stages, register_config
from devrf.cli.config_check import ROOT, check_config, check_extras, choices_of
from devrf.cli.messages import report_user_errors
from devrf.cli.restore_config import log_source
from devrf.cli.run_folder import working_in
from devrf.cli.sweep import forget_failure, name_failures, run_job
from devrf.system.process import Interrupted, end_at_once, handle_signals, importing, tune_for_cpu

# Without `=` among the shell's word breaks the whole of KEY=VALUE is one word. Other commands of
# Python are left to the shell's own completion of files.
INSTALL = """\
_devrf_complete() {{
    local line="$COMP_LINE" word="${{COMP_WORDS[COMP_CWORD]}}"
    COMPREPLY=()
    case "$line" in
        *python*" -m devrf "*) line="devrf ${{line#* -m devrf }}" ;;
        *python*) return ;;
    esac
    COMPREPLY=($(compgen -W "$(COMP_LINE="$line" '{python}' -m devrf -sc query=bash 2>/dev/null)" \\
        -- "$word"))
}}
COMP_WORDBREAKS=${{COMP_WORDBREAKS//=}}
complete -o nospace -o bashdefault -o default -F _devrf_complete devrf python python3
"""
UNINSTALL = "complete -r devrf python python3; unset -f _devrf_complete\n"

register_config()


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
    if sys.argv[1:2] in (["-sc"], ["--shell-completion"]) and _complete_in_bash(sys.argv[2:]):
        return
    tune_for_cpu()
    try:
        with handle_signals(end_at_once), report_user_errors():
            sys.argv[1:] = completed(sys.argv[1:])
            try:
                main()
            except Exception as error:
                name_failures(error)
                raise
    except Interrupted as stop:
        print(f"devrf: {stop.message}", file=sys.stderr)
        raise
    except KeyboardInterrupt:  # raised by another library's handler of Ctrl-C
        print("devrf: interrupted", file=sys.stderr)
        sys.exit(130)


def run(config: DictConfig) -> float | None:
    """Run ``stage=…`` in Hydra's output folder; return the objective, if measured."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    if in_sweep():
        return run_job(lambda: _run(config, folder, "hydra.sweep.dir"), config, folder)
    with report_user_errors():
        value = _run(config, folder, "hydra.run.dir")
        forget_failure(folder)
        return value


def _run(config: DictConfig, folder: Path, key: str) -> float | None:
    with working_in(folder, config, key):
        log_source()
        config = with_recognised_data(config)
        check_config(config)
        check_extras(config)
        # Imported here: --help and a misspelt key are answered before torch has loaded.
        with importing():
            from devrf.cli.run import run_stage

        return run_stage(config, folder)


# A name of its own: other processes import `run` by its name.
main = hydra.main(config_path=str(config_folder()), config_name="config", version_base="1.3")(run)


def _complete_in_bash(words: Sequence[str]) -> bool:
    """Answer ``install=bash``, ``uninstall=bash`` or ``query=bash``; other shells are Hydra's."""
    if "query=bash" in words:
        print("\n".join(candidates(os.environ.get("COMP_LINE", ""))))
    elif "install=bash" in words:
        print(INSTALL.format(python=sys.executable), end="")
    elif "uninstall=bash" in words:
        print(UNINSTALL, end="")
    return bool(words) and words[0].endswith("=bash")


def candidates(line: str) -> list[str]:
    """What the last word of ``devrf ARGUMENT …`` may become.

    Hydra knows keys, groups and their choices; here come the values of ``stage``, and of other keys
    that have few.
    """
    _, _, typed = line.partition(" ")
    key, is_set, _ = typed.split(" ")[-1].partition("=")
    values = known_stages() if key == "stage" else [str(v) for v in choices_of(ROOT.get(key))]
    if key == "scene" and "stage=fetch" in typed.split():
        values = [scene.name for scene in catalogue()]
    if is_set and values:
        return [f"{key}={value}" for value in values]
    with initialize_config_dir(str(config_folder()), version_base="1.3"):
        plugin = DefaultCompletionPlugin(GlobalHydra.instance().config_loader())
        return plugin._query(config_name="config", line=typed)
