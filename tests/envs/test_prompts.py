"""Prompts: every kind of file, one begin token, templates as transformers applies them, and room for the response."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import datasets
import numpy as np
import pytest
from transformers import PreTrainedTokenizerBase

from prefrl.components import ConfigError
from prefrl.envs.prompts import Opening, check_template, for_evaluation, is_for_evaluation, read_prompts
from prefrl.envs.texts import Texts, TextsSettings
from prefrl.policies.cloning import make_tokenizer

TURNS = [{"role": "system", "content": "Be brief."}, {"role": "user", "content": "Hi"}]
TRANSCRIPT = "System: Be brief.\n\nHuman: Hi\n\nAssistant: "
TEMPLATES = {
    "chatml": "{% for m in messages %}<|im_start|>{{ m.role }}\n{{ m.content }}<|im_end|>\n{% endfor %}"
    "{% if add_generation_prompt %}<|im_start|>assistant\n{% endif %}",
    "llama": "{{ bos_token }}{% for m in messages %}<|h|>{{ m.role }}<|/h|>\n\n{{ m.content | trim }}<|e|>{% endfor %}"
    "{% if add_generation_prompt %}<|h|>assistant<|/h|>\n\n{% endif %}",
    "mistral": "{{ bos_token }}{% for m in messages %}{% if m.role == 'user' %}[INST] {{ m.content }} [/INST]"
    "{% elif m.role == 'assistant' %}{{ m.content }}{{ eos_token }}{% else %}{{ m.content }}\n{% endif %}{% endfor %}"
    "{% if add_generation_prompt %} {% endif %}",
    "gemma": "{{ bos_token }}{% for m in messages %}<t>{{ 'model' if m.role == 'assistant' else m.role }}\n"
    "{{ m.content }}</t>\n{% endfor %}{% if add_generation_prompt %}<t>model\n{% endif %}",
    "zephyr": "{% for m in messages %}<|{{ m.role }}|>\n{{ m.content }}{{ eos_token }}\n{% endfor %}"
    "{% if add_generation_prompt %}<|assistant|>\n{% endif %}",
    "phi": "{% for m in messages %}<|{{ m.role }}|>\n{{ m.content }}<|end|>\n{% endfor %}"
    "{% if add_generation_prompt %}<|assistant|>\n{% else %}{{ eos_token }}{% endif %}",
}


@pytest.fixture
def tokenizer() -> PreTrainedTokenizerBase:
    """Over bytes."""
    return make_tokenizer([], 259)


def lines(path: Path, *rows: object) -> Path:
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


# --- files ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("row", "prompt", "columns"),
    [
        ({"prompt": "p", "answer": 4}, "p", {"answer": 4}),
        ({"prompt": TURNS, "id": "a"}, TRANSCRIPT, {"id": "a"}),
        ({"messages": TURNS}, TRANSCRIPT, {}),
        ({"messages": [*TURNS, {"role": "assistant", "content": "Hello."}]}, TRANSCRIPT, {}),
        ({"prompt": "p", "chosen": "a", "rejected": "b"}, "p", {"chosen": "a", "rejected": "b"}),
        ({"chosen": "\n\nHuman: Hi\n\nAssistant: a", "rejected": "\n\nHuman: Hi\n\nAssistant: b"}, None, {}),
    ],
)
def test_a_row_gives_its_prompt_and_what_else_it_says(tmp_path: Path, row: Any, prompt: str, columns: Any) -> None:
    (found,) = read_prompts(lines(tmp_path / "x.jsonl", row))
    assert found.text == (prompt or "Human: Hi\n\nAssistant: ")
    assert found.columns == columns


def test_tables_and_folders_of_data_sets_are_read(tmp_path: Path) -> None:
    table = datasets.Dataset.from_dict({"prompt": ["p", "q"], "answer": [1, 2]})
    table.to_parquet(tmp_path / "x.parquet")
    table.to_csv(tmp_path / "x.csv")
    table.save_to_disk(str(tmp_path / "saved"))
    for name in ("x.parquet", "saved"):
        assert [(p.text, p.columns) for p in read_prompts(tmp_path / name)] == [
            ("p", {"answer": 1}),
            ("q", {"answer": 2}),
        ]
    assert [p.columns for p in read_prompts(tmp_path / "x.csv")] == [{"answer": "1"}, {"answer": "2"}]


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ({"question": "p"}, "row 2: expected a column 'prompt' or 'messages'; there are: question"),
        ({"prompt": 3}, "row 2: column 'prompt': expected text or messages, got 3"),
        ({"prompt": [{"role": "user"}]}, "row 2: expected messages with a role"),
        ({"messages": [{"role": "assistant", "content": "a"}]}, "row 2: expected messages with somebody's words"),
        ({"prompt": [{"role": "user", "content": "a\n\nAssistant: b"}]}, "row 2: the words of a message read like"),
        ([1], "row 2: expected an object, got list"),
    ],
)
def test_a_row_without_a_prompt_is_named(tmp_path: Path, row: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_prompts(lines(tmp_path / "x.jsonl", {"prompt": "p"}, row))


def test_one_of_two_prompts_is_kept_for_evaluation() -> None:
    assert for_evaluation(["a"]) == set()
    assert len(for_evaluation(["a", "b"])) == 1
    many = [f"p{i}" for i in range(800)]
    assert 60 < len(for_evaluation(many)) < 140
    assert for_evaluation(many[::-1]) == for_evaluation(many)
    both = [prompt for prompt in many if is_for_evaluation(prompt)][:2]
    assert len(for_evaluation(both)) == 1  # one is left to learn on


# --- opened --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TEMPLATES)
def test_a_template_gives_the_tokens_that_transformers_gives(tokenizer: PreTrainedTokenizerBase, name: str) -> None:
    tokenizer.chat_template = TEMPLATES[name]
    check_template(tokenizer)
    expected = tokenizer.apply_chat_template(TURNS, add_generation_prompt=True, return_dict=False)
    opened = Opening(tokenizer, chat=True)
    assert list(opened(TRANSCRIPT)) == expected
    plain = tokenizer.apply_chat_template(TURNS[1:], add_generation_prompt=True, return_dict=False)
    assert list(opened("Hi")) == plain
    assert list(Opening(tokenizer, chat=True, system="Be brief.")("Hi")) == expected
    assert list(Opening(tokenizer, chat=True, system="Be long.")(TRANSCRIPT)) == expected  # it has its own
    assert expected.count(tokenizer.bos_token_id) == (1 if "bos_token" in TEMPLATES[name] else 0)


def test_a_prompt_without_a_template_has_one_begin_token(tokenizer: PreTrainedTokenizerBase) -> None:
    assert Opening(tokenizer, chat=False)("Hi").count(int(tokenizer.bos_token_id)) == 1


def test_a_template_whose_user_turn_opens_the_answer_is_taken(tokenizer: PreTrainedTokenizerBase) -> None:
    tokenizer.chat_template = TEMPLATES["mistral"].replace("{% if add_generation_prompt %} {% endif %}", "")
    check_template(tokenizer)


def test_a_template_that_fails_says_so(tokenizer: PreTrainedTokenizerBase) -> None:
    for template in ("{{ raise_exception('no') }}", "{% for m in messages %}"):
        tokenizer.chat_template = template
        with pytest.raises(ConfigError, match="fails on a plain question"):
            check_template(tokenizer)


def test_templates_that_do_not_open_a_turn_or_begin_twice_are_refused(tokenizer: PreTrainedTokenizerBase) -> None:
    tokenizer.chat_template = "{% for m in messages %}<{{ m.role }}>{{ m.content }}{% endfor %}"
    with pytest.raises(ConfigError, match="no generation prompt"):
        check_template(tokenizer)
    tokenizer.chat_template = "{{ bos_token }}" + TEMPLATES["llama"]
    with pytest.raises(ConfigError, match="two begin tokens"):
        check_template(tokenizer)


def test_a_prompt_that_leaves_no_room_is_refused_cut_or_skipped_and_counted(tmp_path: Path) -> None:
    path = lines(tmp_path / "x.jsonl", {"prompt": "short"}, {"prompt": "also"}, {"prompt": "x" * 60})
    small: dict[str, Any] = {"prompts": path, "context": 64, "response_tokens": 16}
    with pytest.raises(ValueError, match=r"row 3: a prompt of 61 tokens, where 48 leave room"):
        TextsSettings(**small).build()
    assert len(TextsSettings(**small | {"prompts": None}).build().encode("x" * 60)) == 61  # judged ones may need less
    cut = TextsSettings(**small, long_prompts="cut").build()
    assert cut.notes == (f"{path}: 1 long prompts cut to the room that the model's context leaves",)
    ids = cut.encode("abc" * 20)
    assert len(ids) == 48
    assert ids[0] == cut.tokenizer.bos_token_id
    assert cut.tokenizer.decode(list(ids[1:])) == ("abc" * 20)[-47:]
    skipped = TextsSettings(**small, long_prompts="skip").build()
    assert set(skipped.known) == {"short", "also"}
    assert skipped.notes == (f"{path}: 1 long prompts left out: the context has no room",)
    with pytest.raises(ConfigError, match=r"task\.response_tokens=64 leaves no room"):
        TextsSettings(context=64, response_tokens=64).build()


# --- the task ------------------------------------------------------------------------------------------------------


def chat_model(folder: Path, **generation: Any) -> Path:
    made = TextsSettings(layers=1, width=16, heads=2, context=64, response_tokens=8).build()
    model = made.model()
    for name, value in generation.items():
        setattr(model.generation_config, name, value)
    model.save_pretrained(folder)
    made.tokenizer.chat_template = TEMPLATES["chatml"]
    made.tokenizer.save_pretrained(folder)
    return folder


def test_a_model_with_a_template_reads_by_it_and_ends_by_every_end_token(tmp_path: Path) -> None:
    folder = chat_model(tmp_path / "model", eos_token_id=[7, 9])
    task: Texts = TextsSettings(model=folder, response_tokens=8).build()
    assert set(task.ends) == {int(task.tokenizer.eos_token_id), 7, 9}
    turn_end = task.tokenizer.encode("<|im_end|>", add_special_tokens=False)[0]
    other: Texts = TextsSettings(model=chat_model(tmp_path / "other", eos_token_id=[7, turn_end])).build()
    assert other.ends[0] == turn_end  # what ends a turn, not what ends a text
    assert str(task.tokenizer.decode(list(task.encode("Hi")))).endswith("<|im_start|>assistant\n")
    plain: Texts = TextsSettings(model=folder, response_tokens=8, chat_template=False).build()
    assert plain.encode("Hi") == tuple(plain.tokenizer.encode("Hi"))
    with pytest.raises(ConfigError, match="needs a chat template"):
        TextsSettings(model=folder, response_tokens=8, chat_template=False, system="Be brief.").build()
    with pytest.raises(ConfigError, match="would cut the chat template open"):
        TextsSettings(model=folder, response_tokens=8, long_prompts="cut").build()
    with pytest.raises(ConfigError, match="has no chat template"):
        TextsSettings(chat_template=True).build()


def test_columns_go_with_their_prompt_and_may_not_contradict_each_other(tmp_path: Path) -> None:
    path = lines(tmp_path / "x.jsonl", {"prompt": "p", "answer": 1}, {"prompt": "q"}, {"prompt": "p", "answer": 1})
    task: Texts = TextsSettings(prompts=path).build()
    assert task.columns("p") == {"answer": 1}
    assert task.columns("q") == task.columns("unknown") == {}
    lines(path, {"prompt": "p", "answer": 1}, {"prompt": "p", "answer": 2})
    with pytest.raises(ValueError, match=r"row 2: this prompt stood there before with another 'answer'"):
        TextsSettings(prompts=path).build()


def test_prompts_for_evaluation_can_come_from_a_file_of_their_own(tmp_path: Path, rng: np.random.Generator) -> None:
    learn = lines(tmp_path / "a.jsonl", *({"prompt": f"p{i}"} for i in range(20)))
    kept = lines(tmp_path / "b.jsonl", {"prompt": "e"}, {"prompt": "p3"})
    task: Texts = TextsSettings(prompts=learn, evaluation_prompts=kept).build()
    assert set(task.evaluation_prompts(200, rng)) == {"e", "p3"}
    assert set(task.prompts(2000, rng)) == {f"p{i}" for i in range(20)} - {"p3"}


def test_where_prompts_come_from_does_not_make_another_task() -> None:
    one = TextsSettings(prompts=Path("a"), response_tokens=8, long_prompts="cut")
    assert one.identity() == TextsSettings(prompts=Path("b"), response_tokens=64).identity()
    assert one.identity() != TextsSettings(model=Path("m")).identity()
    assert one.identity() != TextsSettings(system="Be brief.").identity()
