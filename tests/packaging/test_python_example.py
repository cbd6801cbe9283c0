"""The examples of README and docs/python.md run as they are printed, at a smaller size."""

from __future__ import annotations

import re
from pathlib import Path

REPOSITORY = Path(__file__).parents[2]
# Sizes that take seconds: what is printed, and what stands for it here.
SMALLER = {
    "width=64, height=64, frames=8": "width=20, height=20, frames=3",
    "search_side=48": "search_side=12",
    "iterations=400": "iterations=6",
    "side=56": "side=14",
    "upsample_at=[80, 160, 240]": "upsample_at=[2]",
    "rays=1024": "rays=64",
    "of_height(400)": "of_height(20)",
    "view(400,": "view(20,",
    "[Level(12, 36), Level(20, 18), Level(32, 18)]": "[Level(4, 2)]",
}


def examples(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (REPOSITORY / page).read_text(), re.DOTALL)


def test_both_pages_print_the_same():
    assert examples("README.md")[0] == examples("docs/python.md")[0]


def test_they_run(capsys):
    code = "\n".join(examples("docs/python.md"))
    for printed, smaller in SMALLER.items():
        assert printed in code
        code = code.replace(printed, smaller)
    names: dict[str, object] = {"__name__": "__main__"}
    exec(compile(code, "docs/python.md", "exec"), names)
    assert "psnr" in capsys.readouterr().out.lower()
    assert names["color"].shape == (20, 20, 3)
