"""Writes the tables of docs/configuration.md from the files in conf/ when the site is built."""

from __future__ import annotations

import html
import re
from itertools import takewhile
from pathlib import Path
from typing import Any

CONF = Path(__file__).parents[2] / "conf"
MARKER = "<!-- generated: conf -->"
# How the command line itself looks; a run sets none of these.
INTERNAL = ("hydra/help", "hydra/job_logging", "hydra/hydra_logging")
DEFAULT = re.compile(r"- (?:optional |override )?/?([\w/]+)(?:@[\w.]+)?: *([^\s#]+)")
CODE = re.compile(r"(?<![\w`])(?:[\w.${}/]*[_=./][\w.=/${}]*\w/?)(?![\w`])")


def on_page_markdown(markdown: str, **kwargs: Any) -> str:
    """Put the tables where a page asks for them."""
    return markdown.replace(MARKER, reference()) if MARKER in markdown else markdown


def on_serve(server: Any, **kwargs: Any) -> None:
    """Build again when conf/ changes."""
    server.watch(str(CONF))


def reference() -> str:
    """The keys of config.yaml, then every group: choices, what each says, the files."""
    config = (CONF / "config.yaml").read_text()
    defaults = dict(DEFAULT.findall(config))
    groups = {str(path.parent.relative_to(CONF)) for path in CONF.glob("*/**/*.yaml")}
    ordered = sorted(
        groups.difference(INTERNAL),
        key=lambda group: ([*defaults, group].index(group), group),
    )
    sections = [keys_of_a_run(config)]
    sections += [section(group, defaults.get(group, "null")) for group in ordered]
    return "\n\n".join(sections)


def keys_of_a_run(config: str) -> str:
    """A table of the keys of config.yaml."""
    rows = ["## Keys of the run { #keys }", "", "| key | default | meaning |", "|---|---|---|"]
    comment: list[str] = []
    for line in config.split("\nhydra:")[0].splitlines():
        if line.startswith("#"):
            comment.append(line.removeprefix("#").strip())
        elif entry := re.match(r"(\w+): *(.*)", line):
            key, value = entry.groups()
            if value:
                rows.append(f"| `{key}` | `{value}` | {prose(' '.join(comment))} |")
            comment = []
        elif not line:
            comment = []
    return "\n".join(rows)


def section(group: str, default: str) -> str:
    """One group: a row for each choice, then its files as they are."""
    files = sorted((CONF / group).glob("*.yaml"))
    lines = [
        f"## {group} {{ #{group.replace('/', '-')} }}",
        "",
        "| choice | what it is |",
        "|---|---|",
    ]
    listing = []
    for path in files:
        usual = " (default)" if path.stem == default else ""
        lines.append(f"| `{path.stem}`{usual} | {prose(header(path))} |")
        source = "\n".join(f"    {line}".rstrip() for line in path.read_text().splitlines())
        listing.append(f'    ```yaml title="{path.relative_to(CONF.parent)}"\n{source}\n    ```\n')
    return "\n".join([*lines, "", f'??? note "The files of `{group}`"', "", *listing])


def header(path: Path) -> str:
    """The comment that a file begins with."""
    lines = path.read_text().splitlines()
    comment = takewhile(lambda line: line.startswith("#"), lines)
    return " ".join(line.removeprefix("#").strip() for line in comment if "@package" not in line)


def prose(comment: str) -> str:
    """A comment as the text of a table's cell; names in it as code."""
    marked = CODE.sub(lambda name: f"`{name[0]}`", comment)
    parts = marked.split("`")
    parts[::2] = [html.escape(part, quote=False) for part in parts[::2]]
    return "`".join(parts).replace("|", "\\|")
