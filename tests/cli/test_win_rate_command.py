"""`prefrl win-rate`, on a finished run."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from shell import Shell

from prefrl import duel
from prefrl.duel import Duel
from prefrl.evaluate.policies import scored
from prefrl.stages import policy_of, reward_of


@pytest.fixture
def run(finished_tiny: dict[str, Path]) -> Path:
    return finished_tiny["text/toy"]


def test_a_run_meets_its_start_by_its_reward(prefrl: Shell, run: Path) -> None:
    assert prefrl(f"win-rate {run} --count 24 --samples 2 --json found.json") == 0
    found = json.loads(Path("found.json").read_text())
    assert (found["prompts"], found["rate"]["count"], found["against"]) == (24, 48, None)
    assert found["wins"] + found["ties"] + found["losses"] == 48
    assert found["rate"]["value"] == (found["wins"] + found["ties"] / 2) / 48
    said = " ".join(prefrl.out.split())
    assert f"wins {100 * found['rate']['value']:.1f} % [" in said
    assert "of 48 pairs, to 24 prompts, against its start, by its reward model" in said
    assert prefrl(f"win-rate {run} --count 24 --samples 2 --json again.json") == 0
    assert json.loads(Path("again.json").read_text()) == found


def test_scores_are_those_of_the_sampled_tokens(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Any] = []
    monkeypatch.setattr(duel, "win_rate", lambda ours, theirs, won, *_: seen.extend((ours, theirs, won)))
    Duel(run, count=12).outcome()
    ours, theirs, won = seen
    reward = reward_of(run, policy_of(run).task)
    np.testing.assert_array_equal(won, (1 + np.sign(reward.score(ours).astype(float) - reward.score(theirs))) / 2)
    assert [one.prompt for one in ours] == [one.prompt for one in theirs]
    assert [one.text for one in ours] != [one.text for one in theirs]


def test_by_gold_a_run_and_itself_win_equally_often_and_prompts_can_be_given(prefrl: Shell, run: Path) -> None:
    Path("prompts.jsonl").write_text("".join(json.dumps({"prompt": f"The {i}"}) + "\n" for i in (1, 2, 3, 1)))
    assert prefrl(f"win-rate {run} --against {run} --by gold --prompts prompts.jsonl --samples 40 --json x.json") == 0
    found = json.loads(Path("x.json").read_text())
    assert (found["prompts"], found["rate"]["count"]) == (3, 120)
    assert found["rate"]["value"] == pytest.approx(0.5, abs=0.15)
    assert found["rate"]["low"] is None  # three prompts are too few
    assert "no interval" in found["rate"]["how"]
    assert f"against that of {run}, by the hidden gold" in " ".join(prefrl.out.split()).replace("- ", "-")


def test_a_labeler_is_asked_in_both_orders(prefrl: Shell, run: Path) -> None:
    assert prefrl(f"win-rate {run} --by labeler --count 30 --json plain.json") == 0
    assert prefrl(f"win-rate {run} --by gold --count 30 --json gold.json") == 0
    plain, gold = (json.loads(Path(f"{name}.json").read_text()) for name in ("plain", "gold"))
    assert plain["rate"] == gold["rate"]  # an oracle without faults
    assert plain["order"] == {"position_bias": pytest.approx(0, abs=0.5), "flipped": 0}
    assert prefrl(f"win-rate {run} --by labeler --count 30 --json biased.json labeler.position_bias=1") == 0
    biased = json.loads(Path("biased.json").read_text())
    assert biased["order"]["position_bias"] > 0.3
    assert biased["order"]["flipped"] > 0.2
    assert "by its labeler with labeler.position_bias=1" in prefrl.out


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("labeler.kind=judge", "settings of a labeler go with --by labeler"),
        ("--by gold --reward there", "--reward goes with --by reward"),
        ("--by labeler labeler.kind=web", "a labeler that answers by itself, such as labeler.kind=judge"),
        ("--by labeler labeler.kind=terminal", "ask with `prefrl label --given`"),
        ("--by labeler seed=3", "seed=3: expected settings of the labeler alone, as labeler.key=value"),
        ("--reward nowhere", "nowhere holds neither a run with a checkpoint nor a saved model"),
    ],
)
def test_what_cannot_judge_is_refused(prefrl: Shell, run: Path, options: str, said: str) -> None:
    assert prefrl(f"win-rate {run} {options}") == 2
    assert said in prefrl.err


def test_a_run_that_lacks_what_should_judge_is_refused(
    prefrl: Shell, run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from prefrl.envs.text import Reviews
    from prefrl.reward_models.text import TransformerReward

    monkeypatch.setattr(TransformerReward, "fitted", False)
    assert prefrl(f"win-rate {run}") == 2
    assert "its reward model was not fitted yet" in prefrl.err
    monkeypatch.setattr(Reviews, "gold", lambda _, responses: np.full(len(responses), np.nan))
    assert prefrl(f"win-rate {run} --by gold") == 2
    assert "its task knows no gold" in prefrl.err
    assert prefrl(f"win-rate {run} --by labeler --count 2") == 2
    assert "gold" in prefrl.err


def test_runs_of_control_and_of_another_task_are_refused(
    prefrl: Shell, run: Path, finished_tiny: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    other = finished_tiny["control/toy"]
    assert prefrl(f"win-rate {other}") == 2
    assert "its policy is no language model; expected a run of a text task" in prefrl.err
    assert prefrl(f"win-rate {run} --reward {other}") == 2
    assert "a reward model of texts was expected" in prefrl.err

    def another(folder: Path) -> Any:
        return policy_of(folder) if folder == run else SimpleNamespace(task=SimpleNamespace(name="texts"))

    monkeypatch.setattr(duel, "policy_of", another)
    assert prefrl(f"win-rate {run} --against {other}") == 2
    assert "was trained on another task (texts)" in prefrl.err


def test_another_tokenizer_is_judged_by_text_alone(run: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(duel, "_same_tokens", lambda *_: False)
    read: list[Any] = []

    def listening(reward: Any, found: Any) -> Any:
        read.extend(found)
        return scored(reward, found)

    monkeypatch.setattr(duel, "scored", listening)
    found = Duel(run, count=6).outcome()
    assert {one.tokens for one in read} == {()}
    assert found.tokens > 0
    assert found.unjudged == 0
