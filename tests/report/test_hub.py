"""The README.md of a reward model or a policy, as the Hub reads it."""

from pathlib import Path
from typing import Any

import pytest
from huggingface_hub import ModelCard
from run_folders import folder_of_run, wild_card

from prefrl.report.hub import write_readme
from prefrl.storage.files import DamagedError, check_free, verify, whole_folder, write_file

SETTINGS: dict[str, Any] = {
    "task": {"kind": "control", "env": "Pendulum-v1"},
    "labeler": {"kind": "web", "host": "10.0.0.7"},
    "reward": {"kind": "mlp"},
    "learner": {"kind": "control"},
    "goal": "Which pendulum is kept upright better?",
    "seed": 3,
}


def test_a_policy_carries_its_gold_its_question_and_what_made_it(tmp_path: Path) -> None:
    run = folder_of_run(tmp_path / "run", [-1200.0, -180.0], SETTINGS)
    write_file(tmp_path / "policy.zip", b"weights")
    path = write_readme(run, tmp_path / "policy.zip", "sb3", "control")
    assert path == tmp_path / "policy.zip.md"
    card = ModelCard.load(path)
    assert (card.data.library_name, card.data.pipeline_tag) == ("stable-baselines3", "reinforcement-learning")
    (result,) = card.data.eval_results
    assert (result.dataset_name, result.metric_type, result.metric_value) == ("Pendulum-v1", "mean_reward", "-180.00")
    assert SETTINGS["goal"] in card.text
    assert "| gold | −1,200 | −180 |" in card.text
    assert "kind: mlp" in card.text
    assert 'load_policy("policy.zip")' in card.text
    assert "10.0.0.7" not in card.text  # who was asked where is nobody's business


def test_names_of_any_kind_break_neither_the_page_nor_the_lines_that_load_it(tmp_path: Path) -> None:
    run = folder_of_run(tmp_path / "run", [-1200.0, -180.0], SETTINGS | {"goal": "Which?\n# No heading"})
    (tmp_path / 'my "best" one').mkdir()
    text = write_readme(run, tmp_path / 'my "best" one', "policy", "text").read_text()
    assert "\n# No heading" not in text
    assert r'from_pretrained("my \"best\" one")' in text
    text = write_readme(run, tmp_path / 'my "best" one', "reward", "control").read_text()
    assert "--reward 'my \"best\" one' --data" in text


def test_the_best_policy_does_not_carry_the_numbers_of_the_last_one(tmp_path: Path) -> None:
    run = folder_of_run(tmp_path / "run", [-1200.0, -180.0], SETTINGS)
    (tmp_path / "out").mkdir()
    card = ModelCard.load(write_readme(run, tmp_path / "out", "sb3", "control", best=True))
    assert card.data.eval_results is None
    assert "best policy by the newest reward. The numbers below are of the last one" in card.text


@pytest.mark.parametrize(
    ("model", "base"), [("org/small-model", "org/small-model"), ("/models/mine", None), ("mine", None), (None, None)]
)
def test_a_model_of_the_hub_is_named_as_the_base_and_a_folder_is_not(
    tmp_path: Path, model: str | None, base: str | None
) -> None:
    settings = SETTINGS | {"task": {"kind": "prompts", "model": model}}
    run = folder_of_run(tmp_path / "run", [0.1, 0.6], settings, task="prompts")
    (tmp_path / "out").mkdir()
    card = ModelCard.load(write_readme(run, tmp_path / "out", "policy", "text"))
    assert card.data.base_model == base
    assert (card.data.library_name, card.data.pipeline_tag) == ("transformers", "text-generation")
    (result,) = card.data.eval_results
    assert (result.metric_type, result.metric_value) == ("gold", 0.6)


def test_a_reward_model_carries_its_report_card_whatever_its_labelers_are_called(tmp_path: Path) -> None:
    run, card = folder_of_run(tmp_path / "reward", [None], SETTINGS), wild_card()
    write_file(run / "card.json", card.model_dump_json().encode())
    found = ModelCard.load(write_readme(run, run, "reward", "control"))
    results = {one.metric_type: one.metric_value for one in found.data.eval_results}
    assert results["accuracy"] == round(card.accuracy.value or 0.0, 4)
    assert "log_loss" in results
    assert r"judgements of \</bdi>" in found.text
    assert "<script>" not in found.text.replace(r"\<script>", "")
    assert "Labelers" not in found.text  # nobody is named who answered
    assert "ann:" not in found.text
    assert "prefrl improve PRESET --reward reward" in found.text


def test_a_readme_may_be_edited_and_is_replaced_by_the_next_one(tmp_path: Path) -> None:
    folder = tmp_path / "reward"
    with whole_folder(folder) as work:
        write_file(work / "weights", b"0")
        write_file(work / "README.md", b"# first")
    write_file(folder / "README.md", b"# edited")
    verify(folder)
    check_free(folder)
    write_file(folder / "weights", b"1")
    with pytest.raises(DamagedError, match="weights"):
        verify(folder)
