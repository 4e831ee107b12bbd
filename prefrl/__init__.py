"""prefrl: learn what people prefer, and act on it, for control and for text, with one loop."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from prefrl.config import Config as Config
    from prefrl.fit.pairs import Batch as Batch
    from prefrl.judgements import Choice as Choice
    from prefrl.judgements import Comparison as Comparison
    from prefrl.judgements import Ranking as Ranking
    from prefrl.judgements import Rating as Rating
    from prefrl.judgements import Skip as Skip
    from prefrl.rundir import Run as Run
    from prefrl.stages import load_policy as load_policy
    from prefrl.types import Picture as Picture
    from prefrl.types import Query as Query
    from prefrl.types import Response as Response
    from prefrl.types import Segment as Segment

__version__ = "0.1.0"
__all__ = [
    "Batch",
    "Choice",
    "Comparison",
    "Config",
    "Picture",
    "Query",
    "Ranking",
    "Rating",
    "Response",
    "Run",
    "Segment",
    "Skip",
    "load_policy",
]
_MODULES = {
    "Config": "prefrl.config",
    "Run": "prefrl.rundir",
    "load_policy": "prefrl.stages",
    "Batch": "prefrl.fit.pairs",
    **dict.fromkeys(("Choice", "Comparison", "Ranking", "Rating", "Skip"), "prefrl.judgements"),
}
"""Where a name is defined, if not in `prefrl.types`."""


def __getattr__(name: str) -> object:
    """Load a name's module on first use: the command line answers at once, and even NumPy takes a while."""
    if name in __all__:
        return getattr(import_module(_MODULES.get(name, "prefrl.types")), name)
    raise AttributeError(f"module 'prefrl' has no attribute {name!r}")
