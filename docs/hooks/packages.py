"""Draws which package of devrf imports which, from the imports, when the site is built."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import grimp

SOURCE = Path(__file__).parents[2] / "src" / "devrf"
MARKER = "<!-- generated: packages -->"
WIDTH, BOX, ROW = 860, (132, 44), 84  # pixels: the picture, a package's box, from row to row
GAP = 16
STYLE = """
.packages a { color: inherit; }
.packages rect { fill: var(--md-code-bg-color, #eee); stroke: var(--md-primary-fg-color, #096); }
.packages text { fill: currentColor; font-size: 13px; text-anchor: middle; }
.packages .lines { font-size: 10px; opacity: 0.7; }
.packages path { fill: none; stroke: currentColor; opacity: 0.45; }
"""

Edges = dict[str, set[str]]


def on_page_content(page_html: str, **kwargs: Any) -> str:
    """Put the picture where a page asks for it."""
    return page_html.replace(MARKER, picture(imports())) if MARKER in page_html else page_html


def imports() -> Edges:
    """What each package at the top of devrf imports of the others."""
    graph = grimp.build_graph("devrf", exclude_type_checking_imports=True, cache_dir=None)
    packages = {name: name.split(".")[1] for name in graph.modules if "." in name}
    edges: Edges = {package: set() for package in packages.values()}
    for name, package in packages.items():
        for other in graph.find_modules_directly_imported_by(name):
            if other in packages:
                edges[package].add(packages[other])
        edges[package].discard(package)
    return edges


def rows(edges: Edges) -> list[list[str]]:
    """The packages by rank, those that import most first.

    A package is just above what it imports. Within a row it is near those that import it.
    """
    rank: dict[str, int] = {}
    while len(rank) < len(edges):
        ready = [name for name in edges if name not in rank and edges[name] <= rank.keys()]
        rank |= {name: 1 + max((rank[b] for b in edges[name]), default=-1) for name in ready}
    result = [sorted(n for n in rank if rank[n] == k) for k in range(max(rank.values()), -1, -1)]
    direct = reduced(edges)
    middle = {name: WIDTH / 2 for name in edges}
    for row in result:
        above = {n: [middle[a] for a in edges if n in direct[a]] or [WIDTH / 2] for n in row}
        row.sort(key=lambda name: sum(above[name]) / len(above[name]))
        middle |= {name: x + BOX[0] / 2 for name, x in zip(row, lefts(len(row)), strict=True)}
    return result


def lefts(count: int) -> list[float]:
    """The left edges of as many boxes in a row, which is centred."""
    step = min(BOX[0] + GAP * 3, (WIDTH - BOX[0]) / max(count - 1, 1))
    start = (WIDTH - BOX[0] - step * (count - 1)) / 2
    return [start + step * k for k in range(count)]


def reduced(edges: Edges) -> Edges:
    """The imports that do not follow from others: the transitive reduction."""
    below: Edges = {}

    def reach(name: str) -> set[str]:
        if name not in below:
            below[name] = edges[name].union(*(reach(other) for other in edges[name]))
        return below[name]

    return {a: {b for b in edges[a] if not any(b in reach(c) for c in edges[a])} for a in edges}


def picture(edges: Edges) -> str:
    """An SVG: a box for each package, a line down to what it imports."""
    order = rows(edges)
    place = {
        name: (left, 4 + ROW * k)
        for k, row in enumerate(order)
        for name, left in zip(row, lefts(len(row)), strict=True)
    }
    parts = [
        f'<svg class="packages" viewBox="0 0 {WIDTH} {ROW * len(order)}" role="img" '
        f'aria-label="Which package imports which"><style>{STYLE}</style>'
    ]
    for name, others in reduced(edges).items():
        x, y = place[name][0] + BOX[0] / 2, place[name][1] + BOX[1]
        for other in sorted(others):
            to_x, to_y = place[other][0] + BOX[0] / 2, place[other][1]
            bend = (to_y - y) / 2
            curve = f"{x:.0f},{y + bend} {to_x:.0f},{to_y - bend} {to_x:.0f},{to_y}"
            parts.append(f'<path d="M{x:.0f},{y} C{curve}"/>')
    for name, (left, top) in place.items():
        middle = left + BOX[0] / 2
        parts.append(
            f'<rect x="{left:.0f}" y="{top}" width="{BOX[0]}" height="{BOX[1]}" rx="6"/>'
            f'<text x="{middle:.0f}" y="{top + 19}">{name}</text>'
            f'<text class="lines" x="{middle:.0f}" y="{top + 35}">{num_lines(name):,} lines</text>'
        )
    return "\n".join([*parts, "</svg>"])


def num_lines(package: str) -> int:
    """Lines of a package, or of a module beside the packages."""
    files = [*(SOURCE / package).rglob("*.py")] or [SOURCE / f"{package}.py"]
    return sum(path.read_bytes().count(b"\n") for path in files)
