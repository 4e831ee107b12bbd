"""How a policy does: fresh behaviour, measured."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import torch

from prefrl.distributed import world
from prefrl.policies.rollout import Rollout, learned_rewards, step_rewards
from prefrl.protocols import ControlTask, Mixed, RewardModel
from prefrl.sample.segments import placed, segment
from prefrl.seeding import to_numpy
from prefrl.types import Evaluation, Floats, Integers, Metrics, Response, Segment

if TYPE_CHECKING:  # a control learner loads no transformers
    from prefrl.policies.language import LanguagePolicy

EXAMPLES, EXAMPLE_SECONDS = 3, 4.0
"""Openings of episodes to look at."""
EXAMPLE_RESPONSES = 4
ORDERS = 4
"""BLEU counts runs of one to so many words."""


def evaluation(task: ControlTask, rollout: Rollout, reward: RewardModel[Segment]) -> Evaluation[Segment]:
    """Over the first episode of each row: mean `gold`, `learned` and `length`, `gold_std`, and their `count`."""
    gold, learned, lengths = returns(rollout, reward)
    shown = max(1, round(EXAMPLE_SECONDS * task.fps))
    openings = (segment(rollout, i, 0, min(int(length), shown), "evaluation") for i, length in enumerate(lengths))
    examples = list(islice(unlike(openings), EXAMPLES))
    whole = tuple(segment(rollout, i, 0, int(length), "evaluation") for i, length in enumerate(lengths))
    metrics = {
        "count": float(len(gold)),
        "gold": float(gold.mean()),
        "gold_std": float(gold.std()),
        "learned": float(learned.mean()),
        "length": float(lengths.mean()),
    }
    if isinstance(task, Mixed):
        metrics |= _by_task(task, rollout, gold)
    return Evaluation(metrics, tuple(placed(task, examples)), candidates=tuple(placed(task, whole)))


def unlike(segments: Iterable[Segment]) -> Iterator[Segment]:
    """The segments without those that show what an earlier one does: where nothing is drawn, all episodes are alike."""
    seen = set()
    for one in segments:
        shown = one.observations.tobytes(), one.actions.tobytes()
        if shown not in seen:
            seen.add(shown)
            yield one


def _by_task(task: Mixed, rollout: Rollout, gold: Floats) -> Metrics:
    """The mean gold of the episodes of each task that has any, and the mean of these."""
    which = task.which(rollout.observations[:, 0])
    found = {name: float(gold[which == at].mean()) for at, name in enumerate(task.names) if (which == at).any()}
    return {"gold": float(np.mean(list(found.values())))} | {f"gold/{name}": mean for name, mean in found.items()}


class Returns(NamedTuple):
    """(n,) of the first episode of each row."""

    gold: Floats
    learned: Floats
    lengths: Integers
    """Steps."""


def returns(rollout: Rollout, reward: RewardModel[Segment]) -> Returns:
    """What the first episodes are worth."""
    lengths = rollout.ends.argmax(1) + 1  # argmax is the first end; what comes after it does not count
    mask = np.arange(rollout.ends.shape[1]) < lengths[:, None]
    learned = learned_rewards(step_rewards(reward), rollout)
    gold, learned = (np.where(mask, values, 0.0).sum(1) for values in (rollout.gold, learned))
    return Returns(gold, learned, lengths)


def responses(
    policy: LanguagePolicy, prompts: int, reward: RewardModel[Response], rng: np.random.Generator
) -> tuple[Evaluation[Response], int]:
    """One response at temperature 1 to each of so many evaluation prompts, and how many tokens that took.

    Metrics: count, gold, gold_std, learned, kl (nats per response: the mean log-ratio to the starting policy), length
    (tokens), ended (share), distinct_1, distinct_2, self_bleu, and fluency where the task can tell.
    """
    task = policy.task
    drawn = policy.respond(task.evaluation_prompts(prompts, rng), 1, rng, policy.sampling(1, temperature=1.0))
    found = policy.with_gold(drawn)
    gold, scores = np.array([r.gold for r in found], float), scored(reward, found)
    metrics = {
        "count": float(len(found)),
        "gold": float(gold.mean()),
        "gold_std": float(gold.std()),
        "learned": _mean(scores),
        "kl": float((drawn.logp - policy.start_logp(drawn, temperature=1.0)).sum(1).mean()),
        "length": float(drawn.mask.sum(1).float().mean()),
        "ended": float(drawn.ended.float().mean()),
    }
    if np.isnan(scores).any():
        metrics["unscored"] = float(np.isnan(scores).mean())
    words = [one.text.split() for one in found]
    metrics |= {f"distinct_{n}": distinct(words, n) for n in (1, 2)}
    metrics |= {"self_bleu": self_bleu(words)} if len(words) > 1 else {}
    fluent = task.fluency(found)
    metrics |= {} if fluent is None else {"fluency": float(fluent.mean())}
    evaluation = Evaluation(metrics, tuple(found[:EXAMPLE_RESPONSES]), candidates=tuple(found))
    return evaluation, drawn.count


def scored(reward: RewardModel[Response], candidates: Sequence[Response]) -> Floats:
    """(N,) `reward.score`; ranks share the candidates."""
    mine = candidates[world().mine]
    scores = reward.score(mine).astype(np.float32) if mine else np.zeros(0, np.float32)
    found: Floats = to_numpy(world().whole(torch.from_numpy(scores), len(candidates)))
    return found


def _mean(scores: Floats) -> float:
    """Of the responses that were scored; NaN where none was."""
    return float(scores[~np.isnan(scores)].mean()) if not np.isnan(scores).all() else math.nan


def distinct(texts: Sequence[Sequence[str]], n: int) -> float:
    """The share of all runs of n words that are different ones (Li et al. 2016, section 5.3); 0 where there are none.

    It falls when a policy says one thing over and over. It depends on how many texts there are.
    """
    runs = [tuple(words[i : i + n]) for words in texts for i in range(len(words) - n + 1)]
    return len(set(runs)) / max(len(runs), 1)


def self_bleu(texts: Sequence[Sequence[str]]) -> float:
    """How alike two or more texts are: the mean BLEU of each with all others as its references (Zhu et al. 2018).

    Runs of one to four words, as far as a text has them; an order without a match counts as a tenth of a match (Chen
    and Cherry 2014, method 1). 0 where no text has words.
    """
    found = np.zeros((len(texts), ORDERS))  # log precisions; NaN where a text has no runs of that length
    for n in range(1, ORDERS + 1):
        counts = [Counter(tuple(text[i : i + n]) for i in range(len(text) - n + 1)) for text in texts]
        # A reference is any other text: of each run the two highest counts say what the most in the others is.
        highest: dict[tuple[str, ...], list[int]] = {}
        for one in counts:
            for run, count in one.items():
                highest[run] = sorted((*highest.get(run, ()), count))[-2:]
        found[:, n - 1] = [_log_precision(one, highest) for one in counts]
    lengths = np.array([len(text) for text in texts])
    brevity = [_brevity(i, lengths) for i in range(len(texts))]
    worded = lengths > 0
    return float(np.mean(np.exp(np.nanmean(found[worded], 1)) * np.array(brevity)[worded])) if worded.any() else 0.0


def _log_precision(own: Counter[tuple[str, ...]], highest: Mapping[tuple[str, ...], list[int]]) -> float:
    """Of the runs of a text: the log share that others have too, each at most as often as one of them has it."""
    if not own:
        return math.nan
    # Where the text's own count is the highest, the second highest is that of the others.
    others = {run: highest[run][0] if count == highest[run][-1] else highest[run][-1] for run, count in own.items()}
    matched = sum(min(count, others[run] if len(highest[run]) > 1 else 0) for run, count in own.items())
    return math.log(max(matched, 0.1) / own.total())


def _brevity(at: int, lengths: Integers) -> float:
    """BLEU's penalty for a text that is shorter than the other one whose length is nearest."""
    others = np.delete(lengths, at)
    nearest = others[np.lexsort((others, abs(others - lengths[at])))[0]]
    return 1.0 if lengths[at] >= nearest else math.exp(1 - nearest / max(lengths[at], 1))
