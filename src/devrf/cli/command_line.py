"""What is typed, made into the command line that Hydra takes."""

from __future__ import annotations

from collections.abc import Sequence

from devrf.cli.arguments import with_quoted_paths, with_viewer_shorthand
from devrf.cli.data_choice import with_data_choice
from devrf.cli.embedded_scene import with_embedded_experiment
from devrf.cli.learned_with import completed
from devrf.cli.paper_scene import with_paper_experiment

# What names a run, which may say how its scene is read.
OF_A_RUN = ("ckpt=", "hydra.run.dir=", "hydra.sweep.dir=")


def as_hydra_takes_it(typed: Sequence[str]) -> list[str]:
    """The arguments, completed in this order.

    Paths are quoted as Hydra's grammar asks; ``viewer=true`` sets a key; ``experiment=paper`` is
    that of its scene, and one for scenes from disk that of ``data=procedural`` where it has one; a
    run that is named gives its settings; a scene's folder without a reader gets ``data=auto``.
    """
    meant = with_viewer_shorthand(with_quoted_paths(typed))
    meant = with_embedded_experiment(with_paper_experiment(meant))
    if not any(one.startswith(OF_A_RUN) for one in meant):
        meant = with_data_choice(meant)
    return with_data_choice(completed(meant))
