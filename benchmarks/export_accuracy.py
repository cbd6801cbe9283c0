"""How far an exported mesh of the embedded robot is from its exact surface, time by time.

Off: the mean distance of the mesh's vertices to the surface. Missing: the mean distance of what
the held-out camera sees of the surface to the mesh. Both are shares of the diagonal of the
scene's box.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path

import torch
import trimesh
from scipy.spatial import KDTree

from devrf.scenes.procedural import ProceduralScene

# Random points of a mesh, to which the distance is measured.
POINTS = 200_000


def main() -> None:
    """Print a row for each file of a sequence that ``export.format=ply`` has written."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("folder", type=Path, help="of the .ply files and their index.json")
    folder = arguments.parse_args().folder
    recipe = ProceduralScene(width=96, height=96, static_views=36, frames=14)
    robot = recipe.model()
    scene = recipe()
    views = scene.dynamic.test
    diagonal = math.hypot(*scene.bounds.whole.size)
    print("time   off     missing")
    for frame in json.loads((folder / "index.json").read_text())["frames"]:
        mesh = trimesh.load_mesh(folder / frame["file"])
        time = float(frame["time"])
        off = robot.distance(torch.tensor(mesh.vertices).float(), time).abs().mean()
        image = int((views.times - time).abs().argmin())
        assert views.depth is not None
        depth = views.depth[image].view(-1)
        met = depth.isfinite().nonzero()[:, 0]
        visible = views.cameras[[image]].image_rays(0).at(met, depth[met])
        points, _ = trimesh.sample.sample_surface(mesh, POINTS, seed=0)
        missing, _ = KDTree(points).query(visible.numpy())
        print(
            f"{time:.3f}  {100 * float(off) / diagonal:.2f} %  "
            f"{100 * missing.mean() / diagonal:.2f} %"
        )


if __name__ == "__main__":
    main()
