"""prefrl: learn what people prefer, and act on it, for control and for text, with one loop."""

from typing import TYPE_CHECKING

from prefrl.types import Batch, Comparison, Query, Ranking, Response, Segment, Skip

if TYPE_CHECKING:
    from prefrl.config import Config as Config

__version__ = "0.1.0"
__all__ = ["Batch", "Comparison", "Config", "Query", "Ranking", "Response", "Segment", "Skip"]


def __getattr__(name: str) -> object:
    """Load `Config` on first use, so that the vocabulary alone stays light."""
    if name == "Config":
        from prefrl.config import Config

        return Config
    raise AttributeError(f"module 'prefrl' has no attribute {name!r}")
