"""Policies of text on their own: have them answer prompts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from prefrl.evaluate.best_of_n import best
from prefrl.protocols import RewardModel
from prefrl.rundir import RunError, open_saved
from prefrl.seeding import streams
from prefrl.storage.checkpoints import load_state
from prefrl.types import Response

if TYPE_CHECKING:  # a control user loads no transformers
    from prefrl.policies.language import LanguagePolicy


def policy_of(folder: Path, at_start: bool = False) -> LanguagePolicy:
    """The newest policy of a run of text, or the one that it started from. Raises `RunError` where it has none."""
    from prefrl.improve.writer import WritesText
    from prefrl.policies.language import LanguagePolicy

    saved = open_saved(folder)
    learner = saved.config.build_learner(saved.config.build_task(), streams(saved.config.seed, 0).build)
    if not isinstance(learner, WritesText) or not isinstance(learner.policy, LanguagePolicy):
        raise RunError(f"{folder}: its policy is no language model; expected a run of a text task")
    if at_start:
        return learner.policy
    try:
        learner.load(load_state(saved.folder, "learner"))
    except ValueError as error:
        raise RunError(f"{folder}: {error}") from error
    return learner.policy


def prompts_for(policy: LanguagePolicy, path: Path) -> list[str]:
    """The prompts of a file. Raises `ValueError` with the row of one that leaves no room for a response."""
    from prefrl.envs.prompts import read_prompts

    given = read_prompts(path)
    for one in given:
        try:
            policy.opened(one.text)
        except ValueError as error:
            raise ValueError(f"{one.place}: {error}") from None
    return [one.text for one in given]


class Drawn(NamedTuple):
    """How responses are drawn, see `prefrl.policies.generate.Sampling`."""

    samples: int = 1
    temperature: float = 1.0
    top_k: int = 0
    top_p: float = 1.0


def answered(
    policy: LanguagePolicy, texts: Sequence[str], sampling: Drawn, seed: int = 0, batch: int = 16
) -> Iterator[tuple[str, list[Response]]]:
    """Each prompt with a policy's responses as they were sampled, `batch` prompts at a time."""
    how = replace(policy.sampling(sampling.samples, sampling.temperature), top_k=sampling.top_k, top_p=sampling.top_p)
    for start in range(0, len(texts), batch):
        some = texts[start : start + batch]
        drawn = policy.respond(some, how.samples, np.random.default_rng([seed, start]), how)
        found = drawn.candidates(policy.task.tokenizer)
        for i, prompt in enumerate(some):
            yield prompt, found[i * how.samples : (i + 1) * how.samples]


def generate(
    policy: LanguagePolicy, texts: Sequence[str], sampling: Drawn, seed: int = 0, batch: int = 16
) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Each prompt with a policy's responses, `batch` prompts at a time."""
    for prompt, found in answered(policy, texts, sampling, seed, batch):
        yield prompt, tuple(one.text for one in found)


def generate_best(
    policy: LanguagePolicy,
    reward: RewardModel[Response],
    texts: Sequence[str],
    sampling: Drawn,
    seed: int = 0,
    batch: int = 16,
) -> Iterator[tuple[str, str, float | None]]:
    """Each prompt with the response that a reward model scores highest, of those that `generate` gives, and its score.

    What is not scored never wins; where nothing is, it is the first, and its score None.
    """
    for prompt, found in answered(policy, texts, sampling, seed, batch):
        scores = reward.score(found)
        at = int(best(scores))
        yield prompt, found[at].text, None if np.isnan(scores[at]) else float(scores[at])
