"""The vocabulary: what is judged, what is asked, what is answered. NumPy and the standard library only.

Shape letters, everywhere: T steps, O observation, A action, K candidates in a query, N candidates in a
batch, M comparisons, E ensemble members, B sequences, L tokens, V vocabulary.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Generic, Literal, NamedTuple, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

from prefrl.numeric import check_weight, is_whole

Floats: TypeAlias = npt.NDArray[np.floating[Any]]
Integers: TypeAlias = npt.NDArray[np.integer[Any]]
Metrics: TypeAlias = dict[str, float]
State: TypeAlias = dict[str, Any]
"""Nested dicts and lists of arrays, tensors, numbers, strings and None: what a checkpoint can hold."""


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

    context: Literal[""] = ""
    """Candidates of one context may be compared; every segment may be compared with every other."""

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
        return _digest(f"{self.episode}/{self.start}", {k: v for k, v in arrays.items() if v is not None})


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
        return _digest(f"{self.prompt}\0{self.text}", tokens)


Candidate: TypeAlias = Segment | Response
C = TypeVar("C", Segment, Response)
C_contra = TypeVar("C_contra", Segment, Response, contravariant=True)


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


@dataclass(frozen=True)
class Comparison:
    """Two candidates judged."""

    query: str
    preference: float
    """In [0, 1]: the probability that the first candidate is better; 0.5 is a tie, a strength lies between."""
    labeler: str = ""
    shown: tuple[int, ...] = ()
    """The order in which the candidates were shown; the preference itself is in the query's own order."""
    weight: float = 1.0
    """How much the judgement counts in a fit."""

    def __post_init__(self) -> None:
        check_weight(self.weight)
        if not 0.0 <= self.preference <= 1.0:
            raise ValueError(f"a preference must lie in [0, 1], got {self.preference}")


@dataclass(frozen=True)
class Ranking:
    """K candidates judged."""

    query: str
    ranks: tuple[int, ...]
    """A rank for each candidate, in the query's own order; 0 is best, equal ranks are ties."""
    labeler: str = ""
    shown: tuple[int, ...] = ()
    weight: float = 1.0

    def __post_init__(self) -> None:
        check_weight(self.weight)
        if len(self.ranks) < 2 or not all(is_whole(rank) for rank in self.ranks):
            raise ValueError(f"a ranking needs a whole rank >= 0 for each of at least 2 candidates, got {self.ranks}")


@dataclass(frozen=True)
class Choice:
    """The best of K candidates; nothing is said of the others."""

    query: str
    best: int
    """Which candidate, counted from 0 in the query's own order."""
    labeler: str = ""
    shown: tuple[int, ...] = ()
    weight: float = 1.0

    def __post_init__(self) -> None:
        check_weight(self.weight)
        if not is_whole(self.best):
            raise ValueError(f"the best candidate is counted from 0, got {self.best}")


@dataclass(frozen=True)
class Rating:
    """Each candidate on a scale of its own right, such as one to five stars."""

    query: str
    levels: tuple[int, ...]
    """A level for each candidate, in the query's own order; 0 is worst, `scale` - 1 is best."""
    scale: int
    """How many levels there are."""
    labeler: str = ""
    shown: tuple[int, ...] = ()
    weight: float = 1.0

    def __post_init__(self) -> None:
        check_weight(self.weight)
        right = all(is_whole(level) and level < self.scale for level in self.levels)
        if not (is_whole(self.scale) and self.scale >= 2 and self.levels and right):
            raise ValueError(
                f"a rating needs whole levels from 0 to scale - 1, got {self.levels} on a scale of {self.scale}"
            )


def person(labeler: str) -> str:
    """Who gave a judgement: NAME, also of NAME#2, which is their second answer to a question in one file."""
    name, mark, number = labeler.rpartition("#")
    return name if name and mark and number.isdigit() else labeler


@dataclass(frozen=True)
class Skip:
    """No judgement. A skip may be asked again of someone else; incomparable says that there is no answer."""

    query: str
    reason: Literal["skip", "incomparable"] = "skip"
    labeler: str = ""
    shown: tuple[int, ...] = ()


Judgement: TypeAlias = Comparison | Ranking | Choice | Rating
Answer: TypeAlias = Judgement | Skip


@dataclass(frozen=True)
class Judged(Generic[C]):
    """A query with one judgement on it. Raises `ValueError` where the two do not fit."""

    query: Query[C]
    judgement: Judgement

    def __post_init__(self) -> None:
        if self.judgement.query != self.query.id:
            raise ValueError(f"query {self.query.id[:12]} got a judgement of query {self.judgement.query[:12]}")
        check_fits(self.judgement, len(self.query.candidates))


def check_fits(answer: Answer, size: int) -> None:
    """Raise `ValueError` where an answer does not fit a query of `size` candidates."""
    match answer:
        case Comparison():
            fits = size == 2
        case Ranking(ranks=ranks):
            fits = size == len(ranks)
        case Choice(best=best):
            fits = size >= 2 and best < size
        case Rating(levels=levels):
            fits = size == len(levels)
        case Skip():
            fits = True
    if not fits:
        raise ValueError(f"query {answer.query[:12]} has {size} candidates; got {answer}")


class Steps(NamedTuple):
    """What was spent: `env.step` calls for control, generated tokens for text, each counted once, by purpose."""

    learn: int = 0
    query: int = 0
    evaluate: int = 0

    def add(self, learn: int = 0, query: int = 0, evaluate: int = 0) -> Steps:
        return Steps(self.learn + learn, self.query + query, self.evaluate + evaluate)


@dataclass(frozen=True)
class Evaluation(Generic[C]):
    """How a policy does, and a few candidates to look at."""

    metrics: Metrics
    examples: tuple[C, ...] = ()


@dataclass(frozen=True, eq=False)
class Fitted:
    """What a fit came to."""

    metrics: Metrics
    predicted: Floats
    """(M,) the reward model's probability that the first is better, on the held-out comparisons."""
    preference: Floats
    """(M,) what was judged there."""


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


def _digest(header: str, arrays: dict[str, npt.NDArray[Any]]) -> str:
    digest = hashlib.sha256(header.encode("utf-8", "surrogatepass"))
    for name, array in arrays.items():
        digest.update(f"\0{name}:{array.dtype.str}:{array.shape}:".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
