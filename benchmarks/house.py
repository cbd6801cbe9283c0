"""How big the code is, and whether it has circles: lines, files, longest files, imports.

Run: ``make house``.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import grimp

REPOSITORY = Path(__file__).parents[1]
SOURCE = REPOSITORY / "src" / "devrf"
WITHIN = [SOURCE / "methods" / "devrf", SOURCE / "methods" / "devrf" / "extensions"]  # rows, too
Edges = dict[str, set[str]]


def main() -> None:
    """Print one table after another."""
    sources = [*SOURCE.rglob("*.py")]
    print(f"{'src/devrf':<28} {'lines':>7} {'files':>6}")
    for folder in sorted([*SOURCE.iterdir(), *WITHIN]):
        if files := [*folder.rglob("*.py")]:
            print_row(str(folder.relative_to(SOURCE)), files)
    print_row("modules beside the folders", SOURCE.glob("*.py"))
    print_row("all of src/devrf", sources)
    print_row("tests", (REPOSITORY / "tests").rglob("*.py"))
    print_row("conf, YAML", (REPOSITORY / "conf").rglob("*.y*ml"))

    print("\nThe longest files")
    for path in sorted(sources, key=num_lines, reverse=True)[:10]:
        print(f"{num_lines(path):>7}  {path.relative_to(SOURCE)}")

    graph = grimp.build_graph("devrf", exclude_type_checking_imports=False, cache_dir=None)
    imports = {name: graph.find_modules_directly_imported_by(name) for name in graph.modules}
    packages = sorted(name for name in graph.modules if graph.find_children(name))
    siblings = [group for name in packages for group in circles(between_children(name, imports))]
    print_circles("modules", circles(imports))
    print_circles("the packages and modules in one package", siblings)


def num_lines(path: Path) -> int:
    """What ``wc -l`` counts."""
    return path.read_bytes().count(b"\n")


def print_row(name: str, paths: Iterable[Path]) -> None:
    """Print the lines and the number of some files."""
    lines = [num_lines(path) for path in paths]
    print(f"{name:<28} {sum(lines):>7} {len(lines):>6}")


def print_circles(what: str, groups: list[list[str]]) -> None:
    """Print the groups that import each other."""
    print(f"\nCircles of {what}, imports for types counted: {len(groups) or 'none'}")
    for group in groups:
        print("  " + " <-> ".join(name.removeprefix("devrf.") for name in group))


def between_children(package: str, imports: Edges) -> Edges:
    """What the children of a package import of each other, all modules in a child as one."""
    depth = package.count(".") + 2
    inside = [name for name in imports if name.startswith(f"{package}.")]
    child = {name: ".".join(name.split(".")[:depth]) for name in inside}
    edges: Edges = {name: set() for name in child.values()}
    for name in inside:
        edges[child[name]] |= {child[n] for n in imports[name] if n in child} - {child[name]}
    return edges


def circles(edges: Edges) -> list[list[str]]:
    """The strongly connected components of more than one node."""
    reached: Edges = {}
    for start in edges:
        waiting = [*edges[start]]
        reached[start] = set()
        while waiting:
            node = waiting.pop()
            if node not in reached[start]:
                reached[start].add(node)
                waiting += edges[node]
    groups = {tuple(sorted(b for b in reached[a] if a in reached[b])) for a in edges}
    return sorted(list(group) for group in groups if len(group) > 1)


if __name__ == "__main__":
    main()
