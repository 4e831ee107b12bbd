"""Reward models fitted on what people said, on held-out data: pairs of robot segments, and rankings of replies.

    python benchmarks/reward_humans.py DATA [--encoder FOLDER] [--short]

DATA holds `control_human_prefs/` and `text_prefs/` (docs/offline.md says what lies in them).

Walker2d, Hopper: 110 pairs of 100 steps, judged by a person and by the task's own return. In each of 10 random splits
a quarter of the pairs is held out; settings are chosen by cross-validation within the other three quarters, a reward
model is fitted there on the person's labels alone, and both it and the return are compared with the person's labels of
the held-out pairs (`fit/metrics.accuracy`: the person's ties left out, an even prediction counts half).

Replies: 212 rankings of OpenAssistant. In each of 10 random splits a quarter of the conversation trees is held out;
linear heads on frozen features are fitted on the rankings (Plackett-Luce), and on nothing but each ranking's best
against its worst; how long, is chosen by cross-validation for each. Both predict all pairs of the held-out rankings.
Features are the mean of an encoder's last hidden states, or, without one, hashed words; the prompt's last 400
characters and the reply's first 800 are read, and the reply's length is no feature of its own.

Intervals are 95 % for the mean difference over splits, corrected for their overlap (Nadeau and Bengio 2003).
"""

from __future__ import annotations

import argparse
import json
import re
import zlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import t as student
from torch import Tensor

from prefrl.config import Config
from prefrl.exchange.formats import read_judgements
from prefrl.exchange.layout import Which
from prefrl.fit.metrics import accuracy
from prefrl.fit.pairs import batch
from prefrl.fit.settings import FittingSettings
from prefrl.fit.trainer import fit_judged
from prefrl.judgements import Comparison, Judged, Ranking
from prefrl.types import Query

HELD_OUT, WORDS = 0.25, 1024
SETTINGS = {
    "mlp": ["fitting.epochs=5"],
    **{
        f"linear, prior {std}": ["reward.kind=linear", "reward.members=2", f"reward.prior_std={std}"]
        for std in (0.03, 0.1, 0.3)
    },
}
"""How a reward may be fitted; the choice is made within each training part."""
EPOCHS = (1, 3, 10, 30)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--encoder", type=Path, help="a folder with an encoder of transformers and its tokenizer")
    parser.add_argument("--splits", type=int, default=10)
    parser.add_argument("--short", action="store_true", help="2 splits, 2 folds: under two minutes")
    options = parser.parse_args()
    torch.set_num_threads(1)
    splits, folds = (2, 2) if options.short else (options.splits, 3)
    walker = control(options.data, "walker2d", splits, folds)
    hopper = control(options.data, "hopper", splits, folds)
    replies = text(options.data, options.encoder, splits, folds)
    print(
        json.dumps(
            {
                "name": "reward_humans: Walker2d pairs, agreement with the person on held-out pairs; peer: the return",
                "unit": "accuracy",
                **walker,
                "equal_work": True,
                "hopper": hopper,
                "replies: all ranks against best and worst": replies,
                "splits": splits,
                "short": options.short,
            }
        )
    )


def compare(ours: Sequence[float], peer: Sequence[float]) -> dict[str, Any]:
    """Means over splits, and the interval of the mean difference: splits overlap, so its variance is 1/n + 1/3."""
    gap = np.array(ours) - np.array(peer)
    n, reach = len(gap), HELD_OUT / (1 - HELD_OUT)
    half = float(student.ppf(0.975, n - 1) * gap.std(ddof=1) * (1 / n + reach) ** 0.5)
    return {
        "ours": round(float(np.mean(ours)), 4),
        "peer": round(float(np.mean(peer)), 4),
        "ratio": round(float(np.mean(ours) / np.mean(peer)), 4),
        "spread": {
            "difference": round(float(gap.mean()), 4),
            "95 %": [round(float(gap.mean()) + s * half, 4) for s in (-1, 1)],
        },
    }


def part(groups: Sequence[str], rng: np.random.Generator) -> np.ndarray:
    """(J,) bool: held out; what is of one group stays together."""
    names = sorted(set(groups))
    chosen = set(rng.permutation(names)[: round(HELD_OUT * len(names))].tolist())
    return np.array([g in chosen for g in groups])


def folded(groups: Sequence[str], folds: int, rng: np.random.Generator) -> np.ndarray:
    """(J,) the fold of each, groups together."""
    names = rng.permutation(sorted(set(groups))).tolist()
    at = {name: i % folds for i, name in enumerate(names)}
    return np.array([at[g] for g in groups])


def rows(items: Sequence[Any], keep: np.ndarray) -> list[Any]:
    return [items[i] for i in np.flatnonzero(keep)]


# --- control ------------------------------------------------------------------------------------------------------


def control(data: Path, robot: str, splits: int, folds: int) -> dict[str, Any]:
    path = data / "control_human_prefs" / f"{robot}-medium-expert-v2.npz"
    human, script = (read_judgements(path, Which((who,))).judged for who in ("human", "script"))
    assert [j.query.id for j in human] == [j.query.id for j in script]
    said, by_return = (np.array([j.judgement.preference for j in judged]) for judged in (human, script))
    ids = [j.query.id for j in human]
    ours, peer, picked = [], [], []
    for split in range(splits):
        rng = np.random.default_rng([0, split])
        test = part(ids, rng)
        train, fold = rows(human, ~test), folded(rows(ids, ~test), folds, rng)
        found = {name: inner(robot, words, train, fold) for name, words in SETTINGS.items()}
        picked.append(max(found, key=lambda name: found[name]))
        ours.append(fitted(robot, SETTINGS[picked[-1]], train, rows(human, test), split))
        peer.append(accuracy(by_return[test], said[test]))
        print(f"{robot}, split {split}: {picked[-1]}, ours {ours[-1]:.3f}, the return {peer[-1]:.3f}", flush=True)
    agreed = accuracy(by_return, said)
    return compare(ours, peer) | {"picked": picked, "return_on_all_pairs": round(agreed, 4)}


def inner(robot: str, words: list[str], judged: Sequence[Judged[Any]], fold: np.ndarray) -> float:
    """Cross-validated accuracy within a training part."""
    scores = [fitted(robot, words, rows(judged, fold != f), rows(judged, fold == f), int(f)) for f in np.unique(fold)]
    return float(np.nanmean(scores))


def fitted(robot: str, words: list[str], train: Sequence[Any], test: Sequence[Any], seed: int) -> float:
    config: Any = Config.load(f"control/{robot}-human", [*words, "fitting.held_out=0"])
    rng = np.random.default_rng(seed)
    reward = config.reward.build(config.task.build(), rng)
    fit_judged(reward, train, config.fitting, rng)
    return judge(reward, test)


def judge(reward: Any, test: Sequence[Judged[Any]]) -> float:
    """Accuracy on all pairs that judgements imply; a pair is predicted by which score is higher."""
    data = batch(test)
    score = reward.score(data.candidates)
    won = 0.5 + 0.5 * np.sign(score[data.edges[:, 0]] - score[data.edges[:, 1]])
    return accuracy(won, data.preference)


# --- text ---------------------------------------------------------------------------------------------------------


class Heads:
    """Linear heads on features known beforehand: a `prefrl.protocols.RewardModel` as far as a fit needs one."""

    def __init__(self, features: Mapping[str, Tensor], members: int, seed: int) -> None:
        width = len(next(iter(features.values())))
        start = torch.randn(members, width, generator=torch.Generator().manual_seed(seed)) / (width + 1) ** 0.5
        self._features, self._heads, self.members, self.fitted = features, torch.nn.Parameter(start), members, False

    def stack(self, candidates: Sequence[Any]) -> Mapping[str, Tensor]:
        return {"features": torch.stack([self._features[c.id] for c in candidates])}

    def scores(self, stacked: Mapping[str, Tensor]) -> Tensor:
        return self._heads @ stacked["features"].T

    def parameters(self) -> Iterable[torch.nn.Parameter]:
        return [self._heads]

    def settle(self, stacked: Mapping[str, Tensor], loss: Any) -> Tensor:
        self.fitted = True
        return self.scores(stacked).detach()

    def calibrate(self, temperature: float) -> None: ...

    @torch.no_grad()
    def score(self, candidates: Sequence[Any]) -> np.ndarray:
        return self.scores(self.stack(candidates)).mean(0).numpy()


def text(data: Path, encoder: Path | None, splits: int, folds: int) -> dict[str, Any]:
    judged = read_judgements(data / "text_prefs" / "oasst_en_100_tree.jsonl.gz").judged
    features = encoded(judged, encoder) if encoder else hashed(judged)
    trees = [j.query.candidates[0].prompt.split("\n\nAssistant: ")[0] for j in judged]
    ours, peer = [], []
    for split in range(splits):
        rng = np.random.default_rng([1, split])
        test = part(trees, rng)
        train, fold = rows(judged, ~test), folded(rows(trees, ~test), folds, rng)
        for found, reduce in ((ours, False), (peer, True)):
            epochs = best_length(features, train, fold, reduce)
            found.append(headed(features, train, rows(judged, test), epochs, reduce))
        print(f"replies, split {split}: all ranks {ours[-1]:.3f}, best and worst {peer[-1]:.3f}", flush=True)
    return compare(ours, peer) | {"features": encoder.name if encoder else "hashed words"}


def best_length(features: Mapping[str, Tensor], train: Sequence[Any], fold: np.ndarray, reduce: bool) -> int:
    """How many epochs do best in cross-validation within a training part."""

    def score(epochs: int) -> float:
        parts = [(rows(train, fold != f), rows(train, fold == f)) for f in np.unique(fold)]
        return float(np.mean([headed(features, *one, epochs, reduce) for one in parts]))

    return max(EPOCHS, key=score)


def headed(
    features: Mapping[str, Tensor], train: Sequence[Any], test: Sequence[Any], epochs: int, reduce: bool
) -> float:
    reward: Any = Heads(features, 1, 0)
    judged = [ends(j) for j in train] if reduce else list(train)
    fitting = FittingSettings(epochs=epochs, held_out=0, batch_size=32, learning_rate=3e-3)
    fit_judged(reward, judged, fitting, np.random.default_rng(0))
    return judge(reward, test)


def ends(judged: Judged[Any]) -> Judged[Any]:
    """A ranking's best against its worst."""
    assert isinstance(judged.judgement, Ranking)
    order = np.argsort(judged.judgement.ranks, kind="stable")
    best, worst = (judged.query.candidates[i] for i in (order[0], order[-1]))
    query = Query((best, worst))
    return Judged(query, Comparison(query.id, float(query.candidates[0].id == best.id)))


def texts_of(judged: Sequence[Judged[Any]]) -> dict[str, str]:
    return {c.id: f"{c.prompt[-400:]}{c.text[:800]}" for j in judged for c in j.query.candidates}


def hashed(judged: Sequence[Judged[Any]]) -> dict[str, Tensor]:
    """Words, hashed: 1 + log of their counts, each text at length 1 times the root of the width."""
    found = {}
    for j in judged:
        for c in j.query.candidates:
            counts = np.zeros(WORDS, np.float32)
            for word in re.findall(r"\w+", c.text[:800].lower()):
                counts[zlib.crc32(word.encode()) % WORDS] += 1
            values = np.log1p(counts)
            found[c.id] = torch.from_numpy(values / max(float(np.linalg.norm(values)), 1e-6) * 8)
    return found


@torch.no_grad()
def encoded(judged: Sequence[Judged[Any]], folder: Path) -> dict[str, Tensor]:
    """The mean of an encoder's last hidden states, at std 1 in each dimension over all texts, labels unseen."""
    from transformers import AutoModel, AutoTokenizer

    tokenizer = AutoTokenizer.from_pretrained(folder, local_files_only=True)
    model = AutoModel.from_pretrained(folder, local_files_only=True, use_safetensors=True).eval()
    texts, found = texts_of(judged), []
    for one in texts.values():
        tokens = tokenizer(one, return_tensors="pt", truncation=True, max_length=512)
        found.append(model(**tokens).last_hidden_state[0].mean(0))
    made = torch.stack(found)
    made = (made - made.mean(0)) / made.std(0).clamp(min=1e-6)
    return dict(zip(texts, made, strict=True))


if __name__ == "__main__":
    main()
