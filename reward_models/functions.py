"""Rewards that are Python functions: nothing is fitted, and nobody is asked.

A function is called as TRL's trainers call theirs: `f(prompts=..., completions=..., completion_ids=..., **columns)`,
all lists of one length, gives a list of numbers. Prompts that are conversations come as lists of messages, and so do
their completions. Columns are what else the rows of the prompts' file say. None or NaN: the response is not scored.
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Literal, Self, TypeAlias

import numpy as np
import torch
from pydantic import Field, PrivateAttr, model_validator

from prefrl.components import ConfigError, Settings, suggest
from prefrl.exchange.transcripts import prompt_messages
from prefrl.protocols import Task, TextTask, text
from prefrl.types import Floats, Response, State

RewardFunction: TypeAlias = Callable[..., Sequence[float | None]]
Arguments: TypeAlias = dict[str, list[Any]]
Turns: TypeAlias = Any
"""Text, or a list of messages."""
UNFIT = "reward functions are not fitted: set loop.labels=0, or choose a reward model"


class FunctionsSettings(Settings):
    """Python functions of prompts and responses, with TRL's signature; several are added up by their weights."""

    kind: Literal["functions"] = "functions"
    functions: tuple[str, ...] = Field(min_length=1)
    """Their names: `answer`, `sentiment`, or what installed packages bring in the entry-point group
    `prefrl.reward_functions`."""
    weights: tuple[float, ...] = ()
    """What each counts for; 1 where none are given."""
    _given: dict[str, RewardFunction] = PrivateAttr(default_factory=dict)

    @classmethod
    def of(cls, *functions: RewardFunction, weights: Sequence[float] = ()) -> FunctionsSettings:
        """Settings with functions at hand, which a file cannot hold: a run that goes on must be given them again."""
        named = {str(getattr(f, "__name__", type(f).__name__)): f for f in functions}
        if len(named) < len(functions):
            raise ConfigError(f"{len(functions)} reward functions need names that differ, got {', '.join(named)}")
        if taken := sorted(name for name in set(named) & set(OURS) if named[name] is not OURS[name]):
            raise ConfigError(f"there is a reward function {taken[0]!r} already: give yours another name")
        found = cls(functions=tuple(named), weights=tuple(weights))
        found._given.update(named)
        return found

    @model_validator(mode="after")
    def _as_many(self) -> Self:
        if self.weights and len(self.weights) != len(self.functions):
            raise ValueError(f"{len(self.functions)} functions have {len(self.weights)} weights")
        return self

    def lasting(self) -> Self:
        """By name alone: a function of this process is no setting."""
        return type(self)(functions=self.functions, weights=self.weights)

    def build(self, task: Task, rng: np.random.Generator) -> FunctionReward:
        """Raises `ConfigError` for a name that nothing installed brings."""
        found = text(task, "reward kind 'functions' scores text responses")
        functions = {name: self._given.get(name) or function_named(name) for name in self.functions}
        return FunctionReward(found, functions, self.weights or (1.0,) * len(functions))


@cache
def installed() -> dict[str, EntryPoint]:
    return {point.name: point for point in entry_points(group="prefrl.reward_functions")}


def function_named(name: str) -> RewardFunction:
    """One of ours, or of an installed package. Raises `ConfigError` with the nearest name."""
    if name in OURS:
        return OURS[name]
    if name not in installed():
        raise ConfigError(
            f"reward.functions: no installed package brings {name!r}, and one that was handed over in Python must be "
            f"handed over again; {suggest(name, [*OURS, *installed()])}"
        )
    found: RewardFunction = installed()[name].load()
    return found


@dataclass(frozen=True, eq=False)
class FunctionReward:
    """A `prefrl.protocols.RewardModel` of responses that has nothing to fit. NaN: not scored by any function."""

    task: TextTask
    functions: Mapping[str, RewardFunction]
    weights: Sequence[float]
    members: int = 1
    fitted: bool = True

    def score(self, candidates: Sequence[Response]) -> Floats:
        """(N,): the weighted sum over the functions that scored a response; NaN where none did."""
        if not candidates:
            return np.zeros(0, np.float32)
        found = np.array([self._called(name, candidates) for name in self.functions])  # (F, N)
        known = ~np.isnan(found)
        total = np.where(known, found, 0.0).T @ np.asarray(self.weights)
        scores: Floats = np.where(known.any(0), total, np.nan).astype(np.float32)
        return scores

    def member_scores(self, candidates: Sequence[Response]) -> Floats:
        return self.score(candidates)[None]

    def raw_member_scores(self, candidates: Sequence[Response]) -> Floats:
        return self.score(candidates)[None]

    def features(self, candidates: Sequence[Response]) -> Floats:
        """(N, 1): the scores, for want of anything else."""
        return np.nan_to_num(self.score(candidates))[:, None]

    def parameters(self) -> Iterable[torch.nn.Parameter]:
        return ()

    def to(self, device: torch.device) -> None:
        """Functions compute where they like."""

    def stack(self, candidates: Sequence[Response]) -> Mapping[str, torch.Tensor]:
        raise ConfigError(UNFIT)

    def scores(self, stacked: Mapping[str, torch.Tensor]) -> torch.Tensor:
        raise ConfigError(UNFIT)

    def settle(self, stacked: Mapping[str, torch.Tensor], loss: object) -> torch.Tensor:
        raise ConfigError(UNFIT)

    def calibrate(self, temperature: float) -> None:
        raise ConfigError(UNFIT)

    def state(self) -> State:
        return {"functions": list(self.functions)}

    def load(self, state: State) -> None:
        """Raises ValueError where the functions have other names."""
        if state.get("functions") != list(self.functions):
            raise ValueError(f"reward functions: {state.get('functions')} there, {list(self.functions)} here")

    def _called(self, name: str, candidates: Sequence[Response]) -> list[float]:
        function = self.functions[name]
        given = _understood(function, self._arguments(candidates))
        try:
            found = function(**given)
        except Exception as error:
            raise ValueError(f"the reward function {name!r} failed: {type(error).__name__}: {error}") from error
        return _checked(name, found, candidates)

    def _arguments(self, candidates: Sequence[Response]) -> Arguments:
        turns = [prompt_messages(one.prompt) for one in candidates]
        columns = [self.task.columns(one.prompt) for one in candidates]
        names = dict.fromkeys(name for row in columns for name in row)
        return {
            **{name: [row.get(name) for row in columns] for name in names},
            "prompts": [one.prompt if said is None else said for one, said in zip(candidates, turns, strict=True)],
            "completions": [_completion(one, said is not None) for one, said in zip(candidates, turns, strict=True)],
            "completion_ids": [list(one.tokens) for one in candidates],
        }


def _completion(response: Response, conversation: bool) -> Turns:
    return [{"role": "assistant", "content": response.text}] if conversation else response.text


def _understood(function: RewardFunction, given: Arguments) -> Arguments:
    """The arguments that a function has names for; all where it takes any."""
    try:
        parameters = inspect.signature(function).parameters
    except (TypeError, ValueError):  # some built-in callables do not say
        return given
    if any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values()):
        return given
    return {name: value for name, value in given.items() if name in parameters}


def _checked(name: str, found: object, candidates: Sequence[Response]) -> list[float]:
    """Numbers, one for each response; None becomes NaN."""
    try:
        values: list[Any] = list(found)  # type: ignore[call-overload]
    except TypeError:
        values = [found]
    if len(values) != len(candidates):
        raise ValueError(
            f"the reward function {name!r} gave {len(values)} values for {len(candidates)} responses: expected one each"
        )
    try:
        scores = [math.nan if value is None else float(value) for value in values]
    except (TypeError, ValueError) as error:
        raise ValueError(f"the reward function {name!r}: expected numbers or None: {error}") from error
    if bad := [i for i, score in enumerate(scores) if math.isinf(score)]:
        raise ValueError(
            f"the reward function {name!r} gave {scores[bad[0]]} for {candidates[bad[0]].text!r:.80}: expected a "
            "finite number, or None for a response that it does not score"
        )
    return scores


# --- functions of our own -----------------------------------------------------------------------------------------


def answer(completions: Sequence[Turns], answer: Sequence[Turns], **_: object) -> list[float | None]:
    """1 where a response ends with what the column `answer` says, as words of its own; else 0; None where it says
    nothing. Spaces and the last full stop do not count: "It is 4." ends with "4", and neither with "14" nor with "-4".
    """
    found: list[float | None] = []
    for said, right in zip(completions, answer, strict=True):
        wanted = "" if right is None else _bare(str(right))
        ending = re.search(rf"(?<![\w.,-]){re.escape(wanted)}\Z", _bare(_text(said)))
        found.append(float(ending is not None) if wanted else None)
    return found


def _bare(text: str) -> str:
    return text.strip().removesuffix(".").rstrip()


def sentiment(prompts: Sequence[Turns], completions: Sequence[Turns], **_: object) -> list[float]:
    """VADER's compound score of a response, in [-1, 1] (Hutto and Gilbert 2014)."""
    from vaderSentiment.vaderSentiment import SentimentIntensityAnalyzer

    vader = SentimentIntensityAnalyzer()
    return [float(vader.polarity_scores(_text(said))["compound"]) for said in completions]


def _text(completion: Turns) -> str:
    return completion if isinstance(completion, str) else "".join(str(turn["content"]) for turn in completion)


OURS: dict[str, RewardFunction] = {"answer": answer, "sentiment": sentiment}
