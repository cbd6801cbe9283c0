"""What each stage of a run does: which steps, in which order, after which checks."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

from hydra.utils import instantiate
from lightning import seed_everything
from omegaconf import DictConfig

from devrf.errors import DevrfError
from devrf.losses.composer import WeightedLoss
from devrf.losses.motion import MOTION_TERMS
from devrf.run.context import RunContext
from devrf.run.film import render
from devrf.run.look import inspect, prepare
from devrf.run.processes import together
from devrf.run.report import report
