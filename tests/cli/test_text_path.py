"""From a file and a folder with a model to a tuned folder that transformers loads, in at most three commands."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from shell import Shell
from transformers import AutoModelForCausalLM, AutoTokenizer

from prefrl.envs.texts import TextsSettings

TEMPLATE = (
    "{% for m in messages %}<{{ m.role }}>{{ m.content }}\n{% endfor %}{% if add_generation_prompt %}<a>{% endif %}"
)
SMALL = (
    "loop.rounds=1 learner.updates=1 learner.prompts=2 learner.responses=2 learner.evaluation_prompts=4 "
    "task.response_tokens=8"
)


@pytest.fixture
def own_model(prefrl: Shell) -> Path:
    """A chat model of somebody's own, in a folder, in the folder that commands run in."""
    made = TextsSettings(layers=1, width=16, heads=2, context=128, response_tokens=8).build()
    made.model().save_pretrained("model")
    made.tokenizer.chat_template = TEMPLATE
    made.tokenizer.save_pretrained("model")
    return Path("model")


def write(name: str, *rows: object) -> None:
    Path(name).write_text("".join(json.dumps(row) + "\n" for row in rows))


def said(folder: str, prompt: str) -> list[float]:
    """Log-probabilities of "yes" after a prompt, by nothing but transformers."""
    model: Any = AutoModelForCausalLM.from_pretrained(folder)
    tokenizer = AutoTokenizer.from_pretrained(folder)
    turns = [{"role": "user", "content": prompt}]
    opened = tokenizer.apply_chat_template(turns, add_generation_prompt=True, return_dict=False)
    ids = torch.tensor([[*opened, *tokenizer.encode("yes", add_special_tokens=False)]])
    with torch.no_grad():
        logp = model(input_ids=ids).logits[0].log_softmax(-1)
    return [float(logp[i - 1, ids[0, i]]) for i in range(len(opened), ids.shape[1])]


@pytest.mark.parametrize("train", ["full", "lora"])
def test_prompts_a_model_and_a_function_give_a_tuned_model_in_two_commands(
    prefrl: Shell, own_model: Path, train: str
) -> None:
    write("prompts.jsonl", *({"prompt": f"What is {i} + 1?", "answer": str(i + 1)} for i in range(12)))
    settings = f"task.kind=texts task.model={own_model} task.prompts=prompts.jsonl reward.functions=[answer]"
    assert prefrl(f"run text/sentiment {settings} learner.policy.train={train} {SMALL} --out run") == 0
    assert "gold" not in prefrl.out.partition("texts (text)")[0]
    assert prefrl("export run --form policy --to tuned") == 0
    assert "AutoModelForCausalLM.from_pretrained reads it" in prefrl.out

    from prefrl.policies.responses import Responses
    from prefrl.stages import policy_of
    from prefrl.types import Response

    policy = policy_of(Path("run"))
    rows = Responses.of([Response("What is 3 + 1?", "yes")], policy.task)
    expected = policy.log_prob(rows)[0][0, :-1].tolist()
    assert said("tuned", "What is 3 + 1?") == pytest.approx(expected, abs=1e-5)
    assert prefrl("export run --form adapter --to adapter") == (0 if train == "lora" else 2)


def test_a_preference_file_and_a_model_give_a_tuned_model_in_three_commands(prefrl: Shell, own_model: Path) -> None:
    """Nothing is said twice: the model is known from the reward that was fitted for it."""
    rows = [{"prompt": f"p{i}", "chosen": "yes please", "rejected": "no"} for i in range(24)]
    write("prefs.jsonl", *rows)
    small = "reward.members=1 fitting.epochs=1"
    assert prefrl(f"fit prefs.jsonl --config text/replies task.model={own_model} {small}") == 0
    assert prefrl(f"improve text/replies task.prompts=prefs.jsonl {SMALL}") == 0
    assert prefrl("export policy --form policy --to tuned") == 0
    assert len(said("tuned", "p1")) == 3
    assert prefrl(f"improve text/replies task.prompts=prefs.jsonl task.system=Hm. {SMALL} --out other") == 2
    assert "fitted on another task (task.system is  there, Hm. here)" in prefrl.err


@pytest.mark.slow
def test_a_policy_answers_the_prompts_of_a_file(prefrl: Shell, own_model: Path) -> None:
    write("prompts.jsonl", *({"prompt": f"p{i}"} for i in range(6)))
    settings = f"task.kind=texts task.model={own_model} task.prompts=prompts.jsonl"
    assert prefrl(f"run text/sentiment {settings} {SMALL} --out run") == 0
    for extra in ("", "--top-k 3 --top-p 0.9", "--temperature 0"):
        Path("responses.jsonl").unlink(missing_ok=True)
        assert prefrl(f"generate run --prompts prompts.jsonl --samples 3 {extra}") == 0
        found = [json.loads(line) for line in Path("responses.jsonl").read_text().strip().split("\n")]
        assert [row["prompt"] for row in found] == [f"p{i}" for i in range(6)]
        assert all(len(row["responses"]) == 3 for row in found)
    assert all(len(set(row["responses"])) == 1 for row in found)  # the most probable token leaves nothing to chance
    assert "6 prompts answered in responses.jsonl" in prefrl.out
    assert prefrl("generate run --prompts prompts.jsonl") == 2
    assert "responses.jsonl is there already" in prefrl.err
    write("long.jsonl", {"prompt": "x" * 200})
    assert prefrl("generate run --prompts long.jsonl --to long-out.jsonl") == 2
    assert "the model's context has 128" in prefrl.err
    assert prefrl("run control/toy loop.rounds=1 loop.labels=8 --out toy") == 0
    assert prefrl("generate toy --prompts prompts.jsonl --to other.jsonl") == 2
    assert "its policy is no language model" in prefrl.err


def test_of_several_responses_the_best_by_the_reward_is_written(
    prefrl: Shell, finished_tiny: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    from prefrl import stages

    run = finished_tiny["text/toy"]
    write("prompts.jsonl", *({"prompt": f"The plot {word}"} for word in ("was", "is")))
    assert prefrl(f"generate {run} --prompts prompts.jsonl --samples 4 --to all.jsonl") == 0
    assert prefrl(f"generate {run} --prompts prompts.jsonl --best-of 4") == 0
    pools, chosen = (
        [json.loads(line) for line in Path(name).read_text().split("\n")[:-1]]
        for name in ("all.jsonl", "responses.jsonl")
    )
    policy = stages.policy_of(run)
    reward = stages.reward_of(run, policy.task)
    how = stages.Drawn(samples=4)
    for pool, row, (_, found) in zip(
        pools, chosen, stages.answered(policy, ["The plot was", "The plot is"], how, 0, 16), strict=True
    ):
        scores = reward.score(found)
        assert [one.text for one in found] == pool["responses"]  # the same are drawn
        assert row["responses"] == [pool["responses"][int(scores.argmax())]]
        assert row["scores"] == [pytest.approx(float(scores.max()))]

    monkeypatch.setattr(type(reward), "score", lambda _, candidates: np.full(len(candidates), np.nan))
    assert prefrl(f"generate {run} --prompts prompts.jsonl --best-of 4 --to unscored.jsonl") == 0
    row = json.loads(Path("unscored.jsonl").read_text().split("\n")[0])
    assert row["scores"] == [None]
    assert row["responses"] == pools[0]["responses"][:1]


def test_what_best_of_cannot_mean_is_refused(
    prefrl: Shell, finished_tiny: dict[str, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    from prefrl.reward_models.text import TransformerReward

    run = finished_tiny["text/toy"]
    write("prompts.jsonl", {"prompt": "The plot was"})
    for extra, said in (("--samples 2", "leave --samples out"), ("--temperature 0", "raise --temperature")):
        assert prefrl(f"generate {run} --prompts prompts.jsonl --best-of 4 {extra}") == 2
        assert said in prefrl.err
    assert prefrl(f"generate {run} --prompts prompts.jsonl --best-of 0") == 2
    monkeypatch.setattr(TransformerReward, "fitted", False)
    assert prefrl(f"generate {run} --prompts prompts.jsonl --best-of 2") == 2
    assert "its reward model was not fitted yet" in prefrl.err
    assert not Path("responses.jsonl").exists()
