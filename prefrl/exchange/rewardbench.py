"""The files in which RewardBench keeps the scores of a reward model."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from prefrl.storage.files import write_file


class ScoredPair(NamedTuple):
    """One row of a benchmark: two texts, the better one first, and what a reward model says of them."""

    id: int
    subset: str
    text_chosen: str
    text_rejected: str
    score_chosen: float
    score_rejected: float


def write_rewardbench(folder: Path, model: str, rows: Sequence[ScoredPair], chat: bool = False) -> dict[str, float]:
    """Write scores as RewardBench (Lambert et al. 2024) keeps its results; returns each subset's accuracy.

    `eval-set-scores/MODEL.json` has a list for each column, `eval-set/MODEL.json` the accuracies; a tie is an error.
    `chat`: the texts were scored in the chat template of the model's tokenizer.
    Raises ValueError for a score that is not finite, and where there are no rows.
    """
    path = f"{model}.json"
    if not rows or not model or ".." in Path(path).parts or Path(path).is_absolute():
        raise ValueError(f"expected a model's name and at least one row, got {model!r} and {len(rows)} rows")
    if bad := [r.id for r in rows if not (math.isfinite(r.score_chosen) and math.isfinite(r.score_rejected))]:
        raise ValueError(f"RewardBench row {bad[0]}: expected finite scores, got NaN or infinity")
    about = {"model": model, "model_type": "Seq. Classifier", "chat_template": "tokenizer" if chat else "none"}
    right = [int(r.score_chosen > r.score_rejected) for r in rows]
    subsets = sorted({r.subset for r in rows})
    accuracy = {s: float(np.mean([c for r, c in zip(rows, right, strict=True) if r.subset == s])) for s in subsets}
    _write_json(folder / "eval-set-scores" / path, about | _columns(rows) | {"results": right})
    _write_json(folder / "eval-set" / path, about | accuracy)
    return accuracy


def _columns(rows: Sequence[ScoredPair]) -> dict[str, list[Any]]:
    names = ("id", "subset", "text_chosen", "text_rejected", "scores_chosen", "scores_rejected")
    return {name: list(column) for name, column in zip(names, zip(*rows, strict=True), strict=True)}


def _write_json(path: Path, content: dict[str, Any]) -> None:
    write_file(path, json.dumps(content, indent=4, sort_keys=True).encode())
