"""prefrl: learn what people prefer, and act on it, for control and for text, with one loop."""

from importlib import import_module
from typing import TYPE_CHECKING

from prefrl.fit.pairs import Batch
from prefrl.judgements import Choice, Comparison, Ranking, Rating, Skip
from prefrl.types import Query, Response, Segment

if TYPE_CHECKING:
    from prefrl.config import Config as Config
    from prefrl.rundir import Run as Run

__version__ = "0.1.0"
__all__ = [
    "Batch",
    "Choice",
    "Comparison",
    "Config",
    "Query",
    "Ranking",
    "Rating",
    "Response",
    "Run",
    "Segment",
    "Skip",
]
_LATER = {"Config": "prefrl.config", "Run": "prefrl.rundir"}


def __getattr__(name: str) -> object:
    """Load what is heavy on first use, so that the vocabulary alone stays light."""
    if name in _LATER:
        return getattr(import_module(_LATER[name]), name)
    raise AttributeError(f"module 'prefrl' has no attribute {name!r}")
