"""Shows the docstrings' Sphinx roles, such as :class:`~devrf.errors.DevrfError`, as code."""

import re
from typing import Any

from griffe import Extension, Object

ROLE = re.compile(r":(?:attr|class|data|func|meth|mod):`(~?)([^`]+)`")


class SphinxRoles(Extension):
    """Rewrites each docstring as it is read."""

    def on_object(self, *, obj: Object, **kwargs: Any) -> None:
        """Replace the roles of one object's docstring."""
        if obj.docstring is not None:
            obj.docstring.value = ROLE.sub(_as_code, obj.docstring.value)


def _as_code(role: re.Match[str]) -> str:
    """The target in backticks; ``~`` leaves only its last part."""
    short, target = role.groups()
    return f"`{target.rpartition('.')[2] if short else target}`"
