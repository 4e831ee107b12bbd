"""What people show: how an answer that says "like this" becomes a behaviour, and what is refused.

Nothing is mended in silence: an action out of bounds is not clipped, and a text that is too long is not cut.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeAlias

import numpy as np

from prefrl.page import api
from prefrl.page.security import Refused
from prefrl.types import Floats, Response, Segment

Moves: TypeAlias = list[list[float]]
"""At each step a number for each dimension, or the number of a discrete action alone."""


class Showing(Protocol):
    """What is shown in the place of what a policy did, its own."""

    def behaviour(self, own: Any, shown: api.Shown) -> Any:
        """The candidate that shows it. Raises `Refused`, with the reason, for what cannot be one."""

    def lengths(self, own: Any, shown: api.Shown) -> tuple[int, int]:
        """How long it is, and how long it may be."""

    def moves(self, own: Any) -> Moves:
        """What the policy did; nothing where there are no steps."""


@dataclass(frozen=True, eq=False)
class ActionShowing:
    """Other actions in the same states, which is a correction: nothing is known of where they would have led."""

    size: int
    """A."""
    bounds: tuple[Floats, Floats] | None
    """(low (A,), high (A,)), or None where actions are discrete."""

    def behaviour(self, own: Segment, shown: api.Shown) -> Segment:
        rows = shown.actions
        if rows is None or len(rows) != len(own):
            got = "a text" if rows is None else f"{len(rows)}"
            raise Refused(422, f"this clip has {len(own)} steps: expected an action for each of them, got {got}")
        found = [own.actions[t] if row is None else self._action(t, row) for t, row in enumerate(rows)]
        return replace(own, actions=np.stack(found).astype(np.float32), gold=None)

    def lengths(self, own: Segment, shown: api.Shown) -> tuple[int, int]:
        return len(shown.actions or ()), len(own)

    def moves(self, own: Segment) -> Moves:
        chosen = own.actions if self.bounds is not None else own.actions.argmax(1)[:, None]
        return [[float(number) for number in row] for row in chosen]

    def _action(self, step: int, row: Sequence[float]) -> Floats:
        if self.bounds is None:
            return self._choice(step, row)
        if len(row) != self.size:
            raise Refused(422, f"step {step + 1}: an action has {self.size} numbers, got {len(row)}")
        with np.errstate(over="ignore"):  # what is too large for a float32 becomes infinite, and is refused
            action: Floats = np.asarray(row, np.float32)
        low, high = self.bounds
        if not np.isfinite(action).all() or (action < low).any() or (action > high).any():
            wrong = int(np.argmax(~np.isfinite(action) | (action < low) | (action > high)))
            span = f"{low[wrong]:g} to {high[wrong]:g} in dimension {wrong + 1}"
            raise Refused(422, f"step {step + 1}: expected a number from {span}, got {row[wrong]:g}")
        return action

    def _choice(self, step: int, row: Sequence[float]) -> Floats:
        if len(row) != 1 or row[0] not in range(self.size):
            got = f"{row[0]:g}" if len(row) == 1 else f"{len(row)} numbers"
            raise Refused(422, f"step {step + 1}: expected the number of an action, 0 to {self.size - 1}, got {got}")
        chosen: Floats = np.eye(self.size, dtype=np.float32)[int(row[0])]
        return chosen


@dataclass(frozen=True, eq=False)
class TextShowing:
    """Another response to the same prompt."""

    longest: int
    """Tokens at most, the end token included."""
    encode: Callable[[str], tuple[int, ...]]
    """A response's tokens, with an end token behind them. Called from several threads."""

    def behaviour(self, own: Response, shown: api.Shown) -> Response:
        if shown.text is None:
            raise Refused(422, "expected a response, got actions")
        if not shown.text.strip():
            raise Refused(422, "the response is empty: write one, or skip")
        if shown.text == own.text:
            raise Refused(422, "nothing was changed: change something, or say that it is fine as it is")
        tokens = self.encode(shown.text)
        if len(tokens) > self.longest:
            room = f"{len(tokens)} tokens, and {self.longest} is the most"
            raise Refused(422, f"the response is too long: it has {room}; shorten it")
        return Response(own.prompt, shown.text, own.prompt_tokens, tokens)

    def lengths(self, own: Response, shown: api.Shown) -> tuple[int, int]:
        return len(self.encode(shown.text or "")), self.longest

    def moves(self, own: Response) -> Moves:
        return []
