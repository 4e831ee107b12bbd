"""One policy against another: the newest policy of a run of text, and its start or another run's."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from prefrl.components import ConfigError
from prefrl.config import Config
from prefrl.evaluate.policies import scored
from prefrl.evaluate.win_rate import Order, WinRate, by_labeler, by_scores, win_rate
from prefrl.policies.language import LanguagePolicy
from prefrl.protocols import TextTask, text
from prefrl.rundir import RunError, open_saved
from prefrl.stages import Drawn, Tell, answered, policy_of, prompts_for, reward_of, with_gold
from prefrl.store import Store
from prefrl.types import Floats, Json, Response

COUNT = 256
"""Prompts, unless another number is asked for."""
Counted: TypeAlias = Callable[[Iterable[Any], int], Iterable[Any]]
"""Goes along with so many items of work, to show how far it is."""
Responses: TypeAlias = list[Response]
Decide: TypeAlias = Callable[[Responses, Responses], tuple[Floats, Order | None]]
"""Two sides' responses -> (N,) as `win_rate` counts them, and what their order did to a labeler."""


@dataclass(frozen=True)
class Duel:
    """Who meets whom, on which prompts, and who says which response is better."""

    folder: Path
    against: Path | None = None
    """Another run; None for the run's own start."""
    by: Literal["reward", "gold", "labeler"] = "reward"
    """The run's newest reward model, the hidden gold of its task, or its labeler."""
    reward: Path | None = None
    """Another reward model: a run, or what `prefrl fit` wrote."""
    labeler: tuple[str, ...] = ()
    """Settings in place of the run's own, as labeler.key=value."""
    prompts: Path | None = None
    """A file of them; None for the evaluation prompts of the run's task."""
    count: int | None = None
    """How many distinct prompts; the first ones of a file. None for all of a file, and 256 of a task."""
    samples: int = 1
    """Responses to each prompt, on either side."""
    seed: int = 0

    def outcome(self, counted: Counted = lambda items, _: items, tell: Tell = lambda _: None) -> WinRate:
        """Have both sides answer the same prompts, and the pairs judged.

        Raises `RunError`, before any work, where the two answer different tasks or nobody could tell who wins.
        """
        policy = policy_of(self.folder)
        other = policy_of(self.against) if self.against else policy_of(self.folder, at_start=True)
        if policy.task.name != other.task.name:
            raise RunError(
                f"{self.against} was trained on another task ({other.task.name}) than {self.folder} "
                f"({policy.task.name}): expected two runs of one task"
            )
        reader, decide = self._decider(policy.task)
        ours, theirs = self._met(policy, other, counted)
        shared = _same_tokens(reader, policy.task, other.task)
        tell(f"{len(ours)} pairs are judged by {self.who}")
        won, order = decide(_read(ours, shared), _read(theirs, shared))
        return win_rate(ours, theirs, won, self._rng(0), order)

    @property
    def who(self) -> str:
        """Who says which response is better, in words."""
        if self.by == "gold":
            return "the hidden gold"
        if self.by == "labeler":
            return " ".join(("its labeler with", *self.labeler)) if self.labeler else "its labeler"
        return f"the reward model in {self.reward}" if self.reward else "its reward model"

    def record(self, found: WinRate) -> Json:
        """Who met whom, and how it ended, as JSON holds it."""
        about: Json = {
            "run": str(self.folder),
            "against": self.against and str(self.against),
            "by": self.by,
            "judged_by": self.who,
            "samples": self.samples,
            "seed": self.seed,
        }
        return about | found.model_dump(mode="json")

    def _met(self, policy: LanguagePolicy, other: LanguagePolicy, counted: Counted) -> tuple[Responses, Responses]:
        """Both sides' responses to the same prompts, in one order."""
        prompts, how = self._prompts(policy, other), Drawn(self.samples)
        # Each side draws for itself: with the same random numbers a policy would repeat what its start says.
        ours, theirs = answered(policy, prompts, how, 2 * self.seed), answered(other, prompts, how, 2 * self.seed + 1)
        met = list(counted(zip(ours, theirs, strict=True), len(prompts)))
        return [one for (_, found), _ in met for one in found], [one for _, (_, found) in met for one in found]

    def _prompts(self, policy: LanguagePolicy, other: LanguagePolicy) -> list[str]:
        """Distinct ones; fewer than were asked for where there are no more."""
        if self.prompts is not None:
            prompts_for(other, self.prompts)  # says which has no room in the other's context
            return list(dict.fromkeys(prompts_for(policy, self.prompts)))[: self.count]
        count, rng = self.count or COUNT, self._rng(1)
        found: dict[str, None] = {}
        before = -1
        while before < len(found) < count:  # draws repeat; one that brings nothing new ends it
            before = len(found)
            found |= dict.fromkeys(policy.task.evaluation_prompts(count, rng))
        return list(found)[:count]

    def _decider(self, task: TextTask) -> tuple[TextTask, Decide]:
        """The task whose tokens are read, and who says which response is better. Raises `RunError` where nobody can."""
        if self.by == "labeler":
            return task, self._by_labeler(task)
        if self.by == "gold":
            if np.isnan(task.gold([Response(task.evaluation_prompts(1, self._rng(1))[0], "yes")])).all():
                raise RunError(f"{self.folder}: its task knows no gold; compare by its reward or by a labeler")
            return task, lambda ours, theirs: (by_scores(task.gold(ours), task.gold(theirs)), None)
        of = task
        if self.reward:
            wanted = f"a reward model of texts was expected in {self.reward}"
            of = text(open_saved(self.reward).config.build_task(), wanted)
        reward = reward_of(self.reward or self.folder, of)
        return of, lambda ours, theirs: (by_scores(scored(reward, ours), scored(reward, theirs)), None)

    def _by_labeler(self, task: TextTask) -> Decide:
        if others := [one for one in self.labeler if not one.startswith("labeler.")]:
            raise ConfigError(f"{others[0]}: expected settings of the labeler alone, as labeler.key=value")
        config = Config.reopen(open_saved(self.folder).folder / "config.yaml", self.labeler)
        if config.labeler.asks_people():
            raise RunError(
                "a win rate is judged at once, by a labeler that answers by itself, such as labeler.kind=judge; "
                "to ask people, write responses with `prefrl generate` and ask with `prefrl label --given`"
            )
        labeler = config.build_labeler(task)

        def decide(ours: Responses, theirs: Responses) -> tuple[Floats, Order]:
            with tempfile.TemporaryDirectory() as scratch, Store[Response](Path(scratch)) as store:
                asked = by_labeler(with_gold(ours, task), with_gold(theirs, task), labeler, store, self._rng(2))
            return asked.won, asked.order

        return decide

    def _rng(self, purpose: int) -> np.random.Generator:
        return np.random.default_rng([self.seed, purpose])


def _same_tokens(*tasks: TextTask) -> bool:
    """Whether a token means the same in all of them."""
    first, *others = tasks
    vocabulary = first.tokenizer.get_vocab()
    return all(one.ends == first.ends and one.tokenizer.get_vocab() == vocabulary for one in others)


def _read(responses: Responses, as_sampled: bool) -> Responses:
    """As they are judged: the prompt is encoded anew, and what was said too unless all sides share a tokenizer."""
    return [replace(one, prompt_tokens=(), tokens=one.tokens if as_sampled else ()) for one in responses]
