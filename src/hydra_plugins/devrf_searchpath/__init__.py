"""Lets any Hydra application compose devrf's config groups. Imports neither torch nor lightning."""

from hydra.core.config_search_path import ConfigSearchPath
from hydra.plugins.search_path_plugin import SearchPathPlugin

from devrf.cli.config import config_folder, register_config


class DevrfSearchPath(SearchPathPlugin):
    """Puts devrf's ``conf/`` behind the application's own configs."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Append the folder, unless it is devrf itself that runs; make devrf's own words known."""
        register_config()
        path = f"file://{config_folder()}"
        if all(element.path != path for element in search_path.get_path()):
            search_path.append(provider="devrf", path=path)
