"""The embedded scenes: exact, made in seconds, nothing to download."""

from __future__ import annotations

from pathlib import Path

from devrf.data.datamodule import SceneDataModule
from devrf.scenes.procedural.builder import ProceduralScene
from devrf.scenes.scene import Scene


class ProceduralDataModule(SceneDataModule):
    """An embedded inward-facing scene, ``robot`` or ``flower``."""

    def __init__(
        self,
        shape: str = "robot",
        *,
        width: int = 96,
        height: int = 96,
        static_views: int = 36,
        static_test_views: int = 8,
        train_views: int = 4,
        frames: int = 14,
        speed: float = 1.0,
        supersample: int = 2,
        light: float = 0.2,
        export: str | Path | None = None,
    ) -> None:
        """Say what to render; it is rendered when first needed.

        Args:
            shape: ``robot`` (articulated, fast) or ``flower`` (bending, twisting).
            width: image width in pixels.
            height: image height in pixels.
            static_views: training views of the rest state.
            static_test_views: held-out views of the rest state.
            train_views: fixed dynamic training views; one more is held out.
            frames: frames of the dynamic capture.
            speed: factor of all motion.
            supersample: samples along each side of a pixel, against aliasing.
            light: share of the lamp in the lighting, in [0, 1]; the rest is ambient.
            export: the folder that ``stage=prepare`` writes the scene to.
        """
        super().__init__()
        self.export = None if export is None else Path(export)
        self._recipe = ProceduralScene(
            shape=shape,
            width=width,
            height=height,
            static_views=static_views,
            static_test_views=static_test_views,
            train_views=train_views,
            frames=frames,
            speed=speed,
            supersample=supersample,
            light=light,
        )

    def load(self) -> Scene:
        """Render the scene."""
        return self._recipe()
