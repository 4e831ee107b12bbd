"""The vocabulary: what can be judged and what is asked. NumPy and the standard library only.

Shape letters, everywhere: T steps, O observation, A action, K candidates in a query, N candidates in a
batch, M comparisons, E ensemble members, B sequences, L tokens, V vocabulary.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Generic, NamedTuple, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt
from typing_extensions import TypeVar

Floats: TypeAlias = npt.NDArray[np.floating[Any]]
Integers: TypeAlias = npt.NDArray[np.integer[Any]]
Bools: TypeAlias = npt.NDArray[np.bool_]
Metrics: TypeAlias = dict[str, float]
Json: TypeAlias = dict[str, Any]
"""An object of JSON: a row of a file, the body of an event, a summary."""
Fields: TypeAlias = Mapping[str, Any]
"""The same, to be read only."""
State: TypeAlias = dict[str, Any]
"""Nested dicts and lists of arrays, tensors, numbers, strings and None: what a checkpoint can hold."""
LARGEST = 2**31 - 1
"""The largest whole number in what comes from elsewhere: every database and every table holds it."""


class Candidate(Protocol):
    """One behaviour that can be judged. Each kind of them has a row in `prefrl.kinds`."""

    @property
    def id(self) -> str:
        """sha256 of its content, the gold left out."""

    @property
    def context(self) -> str:
        """Only candidates of one context may be compared."""

    @property
    def gold(self) -> Floats | None:
        """(T,) the task's own values, one for each step, or (1,) for the whole. Hidden from all that learns."""


C = TypeVar("C", bound=Candidate, default=Any)
C_contra = TypeVar("C_contra", bound=Candidate, contravariant=True, default=Any)


@dataclass(frozen=True, eq=False)
class Segment:
    """A piece of one episode."""

    observations: Floats
    """(T, O) float32: what was seen before each action, never normalised."""
    actions: Floats
    """(T, A) float32: what the environment executed; one-hot where actions are discrete."""
    episode: str
    """Which episode it was cut from; unique within a run."""
    start: int
    """Its first step within the episode."""
    states: Floats | None = None
    """(T, S) float64 simulator states, enough to draw it again; None where the simulator has none."""
    gold: Floats | None = None
    """(T,) the task's own rewards. Hidden: the store keeps it apart, nothing that learns may read it."""

    context: str = ""
    """Candidates of one context may be compared: its task's name where there are several, else all segments."""

    def __post_init__(self) -> None:
        if self.observations.ndim != 2 or self.actions.ndim != 2 or len(self.observations) != len(self.actions):
            raise ValueError(
                f"a segment needs observations (T, O) and actions (T, A) of equal length, "
                f"got {self.observations.shape} and {self.actions.shape}"
            )

    def __len__(self) -> int:
        return len(self.observations)

    @cached_property
    def id(self) -> str:
        """sha256 over names, dtypes, shapes and bytes (C order). The gold is not part of it."""
        arrays = {"observations": self.observations, "actions": self.actions, "states": self.states}
        return digest(f"{self.episode}/{self.start}", {k: v for k, v in arrays.items() if v is not None})


@dataclass(frozen=True, eq=False)
class Response:
    """What a language model wrote after a prompt."""

    prompt: str
    text: str
    """The response alone, decoded, without special tokens."""
    prompt_tokens: tuple[int, ...] = ()
    tokens: tuple[int, ...] = ()
    """As sampled, the end token included when there is one: never decoded and encoded again (token in, token out)."""
    gold: Floats | None = None
    """(1,) the task's own score. Hidden, as in `Segment`."""

    @property
    def context(self) -> str:
        """Only responses to one prompt may be compared."""
        return self.prompt

    @cached_property
    def id(self) -> str:
        """sha256 over prompt, text and tokens. The gold is not part of it."""
        tokens = {"prompt_tokens": np.array(self.prompt_tokens, np.int64), "tokens": np.array(self.tokens, np.int64)}
        if "\0" in str(self.prompt):  # which also stands between prompt and text: say where the prompt ends
            tokens["prompt_length"] = np.array(len(self.prompt))
        return digest(f"{self.prompt}\0{self.text}", tokens)


@dataclass(frozen=True, eq=False)
class Picture:
    """What was drawn for a caption."""

    caption: str
    pixels: npt.NDArray[np.uint8]
    """(H, W) grey, or (H, W, 3) colour: 0 is black."""
    gold: Floats | None = None
    """(1,) the task's own score. Hidden, as in `Segment`."""

    @property
    def context(self) -> str:
        """Only pictures of one caption may be compared."""
        return self.caption

    @cached_property
    def id(self) -> str:
        """sha256 over caption and pixels. The gold is not part of it."""
        return digest(self.caption, {"pixels": self.pixels})


def gold_score(candidate: Candidate) -> float:
    """The gold of a whole candidate: the sum over its steps. For oracles and evaluation only."""
    if candidate.gold is None:
        raise ValueError(
            f"candidate {candidate.id[:12]} carries no gold: only an oracle or an evaluation may ask, "
            "and only where the task has one"
        )
    return float(candidate.gold.sum())


@dataclass(frozen=True)
class Query(Generic[C]):
    """K distinct candidates of one context, put side by side, unanswered. Only a `Rating` can answer K = 1."""

    candidates: tuple[C, ...]
    """In the order of their ids, whatever order came: what is first says nothing, and asking twice is asking once."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "candidates", tuple(sorted(self.candidates, key=lambda c: c.id)))
        if not self.candidates:
            raise ValueError("a query needs at least one candidate, got none")
        if len({c.id for c in self.candidates}) < len(self.candidates):
            raise ValueError("a query may not compare a candidate with itself")
        if len({c.context for c in self.candidates}) > 1:
            raise ValueError("the candidates of a query must share one context (one prompt)")

    @cached_property
    def id(self) -> str:
        """sha256 over the candidates' ids."""
        return hashlib.sha256("".join(c.id for c in self.candidates).encode()).hexdigest()


class Steps(NamedTuple):
    """What was spent: `env.step` calls for control, generated tokens for text, each counted once, by purpose."""

    learn: int = 0
    query: int = 0
    evaluate: int = 0
    imagined: int = 0
    """Steps in a learned world: no `env.step`, and in none of the others."""

    def add(self, learn: int = 0, query: int = 0, evaluate: int = 0, imagined: int = 0) -> Steps:
        return Steps(self.learn + learn, self.query + query, self.evaluate + evaluate, self.imagined + imagined)

    def counted(self) -> dict[str, int]:
        """By purpose; imagined ones only where there are any, since most learners have none."""
        return {name: count for name, count in self._asdict().items() if count or name != "imagined"}


@dataclass(frozen=True)
class Evaluation(Generic[C]):
    """How a policy does, and a few candidates to look at."""

    metrics: Metrics
    examples: tuple[C, ...] = ()
    notes: tuple[str, ...] = ()
    """What a person should know."""
    candidates: tuple[C, ...] = field(default=(), repr=False)
    """All that was measured, whole, in an order in which all rounds begin alike: those of two rounds are pairs."""


@dataclass(frozen=True, eq=False)
class Fitted:
    """What a fit came to."""

    metrics: Metrics
    predicted: Floats
    """(M,) the reward model's probability that the first is better, on the held-out comparisons."""
    preference: Floats
    """(M,) what was judged there."""

    def row(self) -> Json:
        """The metrics as a line of `metrics.jsonl` has them; what is not finite is None."""
        return {f"fit/{name}": value if math.isfinite(value) else None for name, value in self.metrics.items()}


@dataclass(frozen=True)
class Round(Generic[C]):
    """One turn of the loop. Round 0 only evaluates the starting policy."""

    number: int
    metrics: Metrics
    """Keys `stage/name`; docs/metrics.md gives each one's formula and unit."""
    examples: tuple[C, ...] = field(default=(), repr=False)
    fitted: Fitted | None = field(default=None, repr=False)
    """This round's fit; None in round 0 and where there was nothing to fit on."""
    notes: tuple[str, ...] = ()
    """What did not go as asked, for people."""
    evaluated: tuple[C, ...] = field(default=(), repr=False)
    """As `Evaluation.candidates`."""


def is_whole(value: Any, most: float = math.inf) -> bool:
    """Whether a value is a whole number from 0 on, true and false not among them."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and 0 <= int(value) <= most


def digest(header: str, arrays: dict[str, npt.NDArray[Any]]) -> str:
    """The id of a candidate, from its text and its named arrays: sha256 over names, dtypes, shapes and bytes."""
    found = hashlib.sha256(header.encode("utf-8", "surrogatepass"))
    for name, array in arrays.items():
        found.update(f"\0{name}:{array.dtype.str}:{array.shape}:".encode())
        found.update(np.ascontiguousarray(array).tobytes())
    return found.hexdigest()
