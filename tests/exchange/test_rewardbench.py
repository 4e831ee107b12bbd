"""RewardBench's files."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from prefrl.exchange.rewardbench import ScoredPair, write_rewardbench


def test_rewardbench_files_have_its_columns_and_count_ties_as_errors(tmp_path: Path) -> None:
    scores = [(1.0, 0.0, "hep-go"), (1.0, 1.0, "hep-go"), (0.0, 2.0, "donotanswer")]
    rows = [ScoredPair(i, s, f"good {i}", f"bad {i}", a, b) for i, (a, b, s) in enumerate(scores)]
    assert write_rewardbench(tmp_path, "us/mine", rows) == {"donotanswer": 0.0, "hep-go": 0.5}
    each = json.loads((tmp_path / "eval-set-scores" / "us" / "mine.json").read_text())
    assert each["scores_chosen"] == [1.0, 1.0, 0.0]
    assert each["results"] == [1, 0, 0]
    assert set(each) == {
        *("id", "subset", "text_chosen", "text_rejected", "scores_chosen", "scores_rejected", "results"),
        *("model", "model_type", "chat_template"),
    }
    summary = json.loads((tmp_path / "eval-set" / "us" / "mine.json").read_text())
    assert summary["hep-go"] == 0.5
    assert summary["model"] == "us/mine"
    assert summary["chat_template"] == "none"
    write_rewardbench(tmp_path, "us/mine", rows, chat=True)
    assert json.loads((tmp_path / "eval-set" / "us" / "mine.json").read_text())["chat_template"] == "tokenizer"


def test_rewardbench_wants_finite_scores_and_a_name_within_its_folder(tmp_path: Path) -> None:
    row = ScoredPair(7, "hep-go", "a", "b", float("nan"), 0.0)
    with pytest.raises(ValueError, match="row 7"):
        write_rewardbench(tmp_path, "mine", [row])
    with pytest.raises(ValueError, match="model's name"):
        write_rewardbench(tmp_path, "../mine", [row])
