"""The page of a run that is up to date: it is served before torch has loaded."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from hydra.core.override_parser.types import Override
from hydra.utils import instantiate
from omegaconf import DictConfig

from devrf.apps.viewer.page import PageServer, is_current
from devrf.cli.config_check import check_section, sets_only
from devrf.cli.restore_config import value
from devrf.system.process import handle_signals

if TYPE_CHECKING:
    from devrf.apps.viewer.session import Session


def serves_page(typed: Sequence[Override], run: Path) -> bool:
    """Whether a command asks for the page of a run, and nothing else, and it is up to date."""
    return (
        value(typed, "stage") == "view"
        and value(typed, "viewer.renderer") != "server"
        and sets_only(typed, "viewer", "stage", "hydra.run.dir")
        and is_current(run)
    )


def serve_page(config: DictConfig, run: Path) -> None:
    """Serve the page of a run until a signal arrives.

    Raises:
        DevrfError: a setting of the viewer is wrong, or its address cannot be had.
    """
    check_section(config, "viewer")
    serve(PageServer(instantiate(config.viewer), run / "export"))


def serve(server: PageServer | Session) -> None:
    """Serve a page until a signal arrives."""
    with closing(server), handle_signals(lambda _: server.stop()):
        server.serve()
