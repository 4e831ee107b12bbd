"""Prompts: read from files with what else their rows say, and opened for a language model to go on from."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

from jinja2 import TemplateError
from transformers import PreTrainedTokenizerBase

from prefrl.components import ConfigError
from prefrl.exchange.dataset_folders import data_files
from prefrl.exchange.layout import Row
from prefrl.exchange.reading import Line, parse_json, read_rows
from prefrl.exchange.text_rows import parse
from prefrl.exchange.transcripts import prompt_messages, prompt_text, read_messages
from prefrl.kinds import only
from prefrl.types import Fields, Response

EVALUATION_SHARE = 8
ASKED, ANSWERED = {"role": "user", "content": "Hello"}, {"role": "assistant", "content": "Good morning"}
Long: TypeAlias = Literal["refuse", "cut", "skip"]


class Prompt(NamedTuple):
    """A prompt of a file."""

    text: str
    """As it is, or the transcript of a conversation."""
    columns: Fields
    """What else its row says."""
    place: str


def read_prompts(path: Path) -> list[Prompt]:
    """The prompts of a file (JSON lines, a list, .csv, .parquet, .gz or not) or of a folder of a data set.

    A row has a `prompt` (text, or messages with `role` and `content`) or `messages`, whose last answer is left out; or
    it is a judgement in any form that `prefrl fit` reads. Raises `ValueError` with the row of the first mistake.
    """
    found: list[Prompt] = []
    for place, row in _rows(path):
        try:
            found += [Prompt(text, columns, place) for text, columns in _prompts(row)]
        except ValueError as error:
            raise ValueError(f"{place}: {error}") from None
    if not found:
        raise ValueError(f"{path}: expected at least one row with a prompt, got none")
    return found


def _rows(path: Path) -> Iterator[tuple[str, Any]]:
    files = data_files(path) if path.is_dir() else [path]
    for file in files:
        for number, row in enumerate(read_rows(file), 1):
            yield f"{file}, row {number}", row


def _prompts(row: Any) -> list[tuple[str, Fields]]:
    """The prompts of a row; several of a tree of conversations."""
    if isinstance(row, Line):
        row = parse_json(row.text)
    if not isinstance(row, dict):
        raise ValueError(f"expected an object, got {type(row).__name__}")
    for name in ("prompt", "messages"):
        if isinstance(row.get(name), str | list):
            return [(_text(row[name], name), {key: value for key, value in row.items() if key != name})]
        if row.get(name) is not None and not isinstance(row[name], dict):
            raise ValueError(f"column {name!r}: expected text or messages, got {row[name]!r:.200}")
    if "prompt" not in row and "messages" not in row and "chosen" not in row and "fields" not in row:
        columns = ", ".join(map(str, row)) or "none"
        raise ValueError(f"expected a column 'prompt' or 'messages'; there are: {columns}")
    judged = [one for one in parse(row) if isinstance(one, Row)]
    refusal = ValueError("expected responses to prompts")
    return [(one.prompt, {}) for one in only(Response, [row.query.candidates[0] for row in judged], refusal)]


def _text(value: Any, name: str) -> str:
    if isinstance(value, str):
        return value
    messages = read_messages(value)
    # A whole conversation, as for supervised fine-tuning: its last answer is what others said here.
    while name == "messages" and messages and messages[-1]["role"] == "assistant":
        messages.pop()
    if not messages:
        raise ValueError("expected messages with somebody's words to answer, got the assistant's alone")
    found = prompt_text(messages)
    if prompt_messages(found) != messages:
        raise ValueError('the words of a message read like the start of another turn (a line "Human:", say): reword it')
    return found


@dataclass(frozen=True, eq=False)
class Opening:
    """How a prompt becomes the tokens that a model goes on from: with one begin token, or in the chat template."""

    tokenizer: PreTrainedTokenizerBase
    chat: bool
    system: str = ""
    """Said before every conversation that has no system prompt of its own; needs a chat template."""
    room: int | None = None
    """The most tokens of a prompt that is to be answered; None where there is no bound."""
    long: Long = "refuse"
    """What happens to longer ones; `cut` leaves their end, behind the begin token."""

    def __call__(self, prompt: str) -> tuple[int, ...]:
        """Raises `ValueError` where the template refuses the turns, and for a prompt that is empty.

        Longer prompts than there is room for are cut, or given as they are: a judged response may need less room.
        """
        ids = self._whole(prompt)
        if self.room is None or len(ids) <= self.room or self.long != "cut":
            return ids
        begin = ids[:1] if ids[0] == self.tokenizer.bos_token_id else ()
        return begin + ids[len(ids) - self.room + len(begin) :]

    def fits(self, prompt: str) -> bool:
        """Whether there is room for a prompt as it is. Raises `ValueError` where it is to be refused."""
        length = len(self._whole(prompt))
        if self.room is None or length <= self.room:
            return True
        if self.long == "refuse":
            raise ValueError(
                f"a prompt of {length} tokens, where {self.room} leave room for the response: set task.long_prompts to "
                "cut or skip, or lower task.response_tokens"
            )
        return False

    def _whole(self, prompt: str) -> tuple[int, ...]:
        ids = self._in_turns(prompt) if self.chat else tuple(self.tokenizer.encode(prompt))
        if not ids:
            raise ValueError("an empty prompt, and the tokenizer has no begin token: nothing to go on from")
        return ids

    def _in_turns(self, prompt: str) -> tuple[int, ...]:
        turns = prompt_messages(prompt) or [{"role": "user", "content": prompt}]
        if self.system and turns[0]["role"] != "system":
            turns = [{"role": "system", "content": self.system}, *turns]
        try:
            # Text first: the template holds the begin token, so that encoding must add none.
            text = self.tokenizer.apply_chat_template(turns, tokenize=False, add_generation_prompt=True)
            return tuple(self.tokenizer.encode(str(text), add_special_tokens=False))
        except (TemplateError, ValueError) as error:
            raise ValueError(f"the chat template of the model's tokenizer refuses a prompt: {error}") from error


def check_template(tokenizer: PreTrainedTokenizerBase) -> None:
    """Raise `ConfigError` for a chat template that does not open the assistant's turn, or has two begin tokens."""
    opened = _rendered(tokenizer, [ASKED], add_generation_prompt=True)
    # Some templates end the user's turn with what opens the other one, and need no prompt: the answer follows at once.
    follows = _rendered(tokenizer, [ASKED, ANSWERED]).removeprefix(opened).lstrip().startswith(ANSWERED["content"])
    if opened == _rendered(tokenizer, [ASKED]) and not follows:
        raise ConfigError(
            "task.chat_template: the template has no generation prompt, so that a model could not tell whose turn it "
            "is: mend chat_template.jinja beside the model, or set task.chat_template=false"
        )
    begin = tokenizer.bos_token
    if begin and opened.startswith(str(begin) * 2):
        raise ConfigError("task.chat_template: the template begins with two begin tokens: mend it")


def turn_end(tokenizer: PreTrainedTokenizerBase) -> int | None:
    """The first token that a chat template writes after what the assistant says; None where it writes nothing."""
    after = _rendered(tokenizer, [ASKED, ANSWERED]).rpartition(ANSWERED["content"])[2]
    ids = tokenizer.encode(after, add_special_tokens=False) if after else []
    return ids[0] if ids else None


def _rendered(tokenizer: PreTrainedTokenizerBase, turns: list[dict[str, str]], **more: bool) -> str:
    try:
        return str(tokenizer.apply_chat_template(turns, tokenize=False, **more))  # type: ignore[arg-type]
    except (TemplateError, ValueError) as error:
        raise ConfigError(
            f"task.chat_template: the template of the model's tokenizer fails on a plain question: {error}; mend it, "
            "or set task.chat_template=false"
        ) from error


def for_evaluation(prompts: Sequence[str]) -> set[str]:
    """One in eight, by a digest of the words, so that the split is the same in every run; one of two or more."""
    kept, distinct = {prompt for prompt in prompts if is_for_evaluation(prompt)}, set(prompts)
    if len(distinct) > 1 and kept in (set(), distinct):
        return {min(distinct, key=_digest)}
    return kept


def is_for_evaluation(prompt: str) -> bool:
    return _digest(prompt)[0] % EVALUATION_SHARE == 0


def _digest(prompt: str) -> bytes:
    return hashlib.sha256(prompt.encode()).digest()
