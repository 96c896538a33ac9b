"""jaxtrack: radar search and track as a reinforcement-learning problem, in pure JAX."""

from importlib import import_module
from typing import Any

from jaxtrack.params import Params, StaticParams
from jaxtrack.types import NO_DETECTION, Detections, Tracks, Truths
from jaxtrack.validation import validate

__version__ = "0.1.0"

# Imported on first use: gymnax brings Gymnasium along, which the tracker alone does not need.
_LAZY = {"SearchTrack": "env", "EnvState": "episode", "make": "env", "ENV_ID": "env"}

__all__ = [
    "ENV_ID",
    "NO_DETECTION",
    "Detections",
    "EnvState",
    "Params",
    "SearchTrack",
    "StaticParams",
    "Tracks",
    "Truths",
    "make",
    "validate",
]


def __getattr__(name: str) -> Any:
    if name in _LAZY:
        return getattr(import_module(f"jaxtrack.{_LAZY[name]}"), name)
    raise AttributeError(f"module 'jaxtrack' has no attribute {name!r}")
