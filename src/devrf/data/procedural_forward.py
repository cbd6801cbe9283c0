"""The embedded forward-facing scene: exact, made in seconds, nothing to download."""

from __future__ import annotations

from pathlib import Path

from devrf.data.datamodule import SceneDataModule
from devrf.scenes.procedural.forward import ProceduralForwardScene
from devrf.scenes.scene import Scene


class ProceduralForwardDataModule(SceneDataModule):
    """A soft toy on a pedestal before a painted wall, seen from one side."""

    def __init__(
        self,
        name: str = "plush",
        *,
        width: int = 96,
        height: int = 72,
        static_views: int = 20,
        train_views: int = 4,
        frames: int = 12,
        speed: float = 1.0,
        supersample: int = 2,
        light: float = 0.2,
        export: str | Path | None = None,
    ) -> None:
        """Say what to render; it is rendered when first needed.

        Args:
            name: the scene's name.
            width: image width in pixels.
            height: image height in pixels.
            static_views: training views of the rest state; one in eight more is held out.
            train_views: fixed dynamic training views; one more is held out.
            frames: frames of the dynamic capture.
            speed: factor of all motion.
            supersample: samples along each side of a pixel, against aliasing.
            light: share of the lamp in the lighting, in [0, 1]; the rest is ambient.
            export: the folder that ``stage=prepare`` writes the scene to.
        """
        super().__init__()
        self.export = None if export is None else Path(export)
        self._recipe = ProceduralForwardScene(
            name=name,
            width=width,
            height=height,
            static_views=static_views,
            train_views=train_views,
            frames=frames,
            speed=speed,
            supersample=supersample,
            light=light,
        )

    def load(self) -> Scene:
        """Render the scene."""
        return self._recipe()
