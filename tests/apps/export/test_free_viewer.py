"""A splat file in a viewer that nobody here wrote: the picture is our own.

``make splat-viewer`` installs that viewer (GaussianSplats3D, by npm) into ``build/`` and runs this.
"""

from __future__ import annotations

import functools
import http.server
import json
import math
import shutil
import threading
import urllib.parse
from pathlib import Path

import pytest
import torch

from browser import decoded, psnr
from devrf.apps.export.geometry import UpFrame
from devrf.apps.export.splats import MovingGaussians, write_splats
from devrf.geometry.cameras import Cameras
from devrf.ops.splatting import Gaussians, splat

MODULES = Path(__file__).parents[3] / "build" / "splat_viewer" / "node_modules"
VIEWER = MODULES / "@mkkellogg" / "gaussian-splats-3d" / "build" / "gaussian-splats-3d.module.js"
WIDTH, HEIGHT, FOCAL = 160, 120, 150.0
PAGE = """<!doctype html><body style="margin: 0">
<script type="importmap">{"imports": {"three": "./three/build/three.module.js"}}</script>
<script type="module">
import * as THREE from "three";
import { SceneRevealMode, Viewer } from "./VIEWER";
const asked = JSON.parse(decodeURIComponent(location.hash.slice(1)));
const renderer = new THREE.WebGLRenderer({ preserveDrawingBuffer: true });
renderer.setSize(asked.width, asked.height);
document.body.appendChild(renderer.domElement);
const camera = new THREE.PerspectiveCamera(asked.angle, asked.width / asked.height, 0.1, 100);
camera.up.fromArray(asked.up);
camera.position.fromArray(asked.eye);
camera.lookAt(...asked.target);
camera.updateMatrixWorld();  // it sorts by that
const viewer = new Viewer({
  renderer, camera, selfDrivenMode: false, useBuiltInControls: false,
  sharedMemoryForWorkers: false, gpuAcceleratedSort: false, ignoreDevicePixelRatio: true,
  sphericalHarmonicsDegree: 0, sceneRevealMode: SceneRevealMode.Instant,
});
await viewer.addSplatScene(asked.file, { showLoadingUI: false, progressiveLoad: false,
                                         splatAlphaRemovalThreshold: 0 });
let frames = 0;
renderer.setAnimationLoop(() => {  // it sorts beside its pictures
  viewer.update();
  viewer.render();
  if (++frames == 20) window.shown = [viewer.getSplatMesh().getSplatCount(),
                                      renderer.domElement.toDataURL()];
});
</script>"""


@pytest.fixture
def address(tmp_path):
    """Where the viewer and what is beside it are served."""
    if not VIEWER.is_file():
        pytest.skip("no viewer of splats is installed: make splat-viewer")
    for package in ("@mkkellogg", "three"):
        (tmp_path / package).symlink_to(MODULES / package)
    (tmp_path / "view.html").write_text(PAGE.replace("VIEWER", str(VIEWER.relative_to(MODULES))))
    handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=tmp_path)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/view.html"
        server.shutdown()


def test_a_free_viewer_shows_the_picture(browser, address, tmp_path, rng):
    count = 1000
    means = torch.randn(count, 3, generator=rng)
    gaussians = Gaussians(
        means=means,
        scales=0.02 + 0.06 * torch.rand(count, 3, generator=rng),
        quaternions=torch.nn.functional.normalize(torch.randn(count, 4, generator=rng), dim=1),
        opacity=0.2 + 0.7 * torch.rand(count, generator=rng),
        color=torch.rand(count, 3, generator=rng),
    )
    moving = MovingGaussians((0.0, 1.0), [gaussians, gaussians])
    write_splats(tmp_path / "splats", moving, {}, UpFrame(torch.eye(3), 1.0, "y"), 3.0)
    shutil.copy(tmp_path / "splats" / "frame0001.ply", tmp_path)
    eye, target = torch.tensor([1.0, 0.5, 7.0]), torch.zeros(3)
    camera = Cameras.looking_at(
        eye[None], target[None], focal=FOCAL, width=WIDTH, height=HEIGHT,
        up=torch.tensor([0.0, 1.0, 0.0]),
    )  # fmt: skip
    ours = splat(gaussians, camera, 0.1).color.view(HEIGHT, WIDTH, 3)
    asked = {
        "file": "frame0001.ply", "width": WIDTH, "height": HEIGHT,
        "angle": 2 * math.degrees(math.atan(HEIGHT / 2 / FOCAL)),
        # The file has y down, and z ahead.
        "eye": (eye * torch.tensor([1, -1, -1])).tolist(), "target": [0, 0, 0], "up": [0, -1, 0],
    }  # fmt: skip
    browser.open(f"{address}#{urllib.parse.quote(json.dumps(asked))}", WIDTH, HEIGHT)
    browser.wait("window.shown")
    shown, picture = browser.run("return window.shown")
    assert shown == count
    assert psnr(decoded(picture), ours) > 38
