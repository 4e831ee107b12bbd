"""What an AI judge is asked: a question in which foreign text stands fenced, as tokens."""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property

from transformers import PreTrainedTokenizerBase

from prefrl.components import ConfigError

MARK = "[the question stands here]"


@dataclass(frozen=True)
class Prompter:
    """Fills the template in and encodes it, as a chat turn where the tokenizer has a chat template.

    Foreign text cannot end its fence, which is longer than any line of its sort in the text, and cannot hold special
    tokens: they are encoded as plain characters. What it says may still sway a model; no fence prevents that.
    """

    tokenizer: PreTrainedTokenizerBase
    template: str
    criterion: str

    def encode(self, prompt: str, first: str, second: str) -> list[int]:
        """The question with two responses in this order, begin token included, as the model reads it."""
        fence = fence_for(prompt, first, second)
        texts = {"prompt": prompt, "first": first, "second": second}
        fenced = {name: f"{fence}\n{text}\n{fence}" for name, text in texts.items()}
        before, after = self._around
        question = self.template.format(criterion=self.criterion, **fenced)
        return [*before, *self._plain(question), *after]

    @cached_property
    def _around(self) -> tuple[list[int], list[int]]:
        """The tokens before and after a question: those of a chat turn, or a begin token where there is one."""
        if self.tokenizer.chat_template is None:
            begin = self.tokenizer.bos_token_id
            adds_it = begin is not None and begin in self.tokenizer("x")["input_ids"]
            return ([begin] if adds_it else []), []
        turn = [{"role": "user", "content": MARK}]
        text = str(self.tokenizer.apply_chat_template(turn, tokenize=False, add_generation_prompt=True))
        before, found, after = text.partition(MARK)
        if not found:
            raise ConfigError("labeler.model: its chat template does not show what the user says")
        return self._special(before), self._special(after)

    def _special(self, text: str) -> list[int]:
        return list(self.tokenizer.encode(text, add_special_tokens=False))

    def _plain(self, text: str) -> list[int]:
        return list(self.tokenizer.encode(text, add_special_tokens=False, split_special_tokens=True))


def fence_for(*texts: str) -> str:
    """A line of equals signs longer than any in the texts."""
    return "=" * max(5, 1 + max(len(run) for text in texts for run in re.findall("=*", text)))


def answer_tokens(tokenizer: PreTrainedTokenizerBase, answers: tuple[str, str]) -> tuple[list[int], list[int]]:
    """The tokens that say each answer, with and without a space before it.

    Raises `ConfigError` where an answer is no single token, or both begin alike.
    """
    found: list[list[int]] = []
    for answer in answers:
        encoded = [tokenizer.encode(text, add_special_tokens=False) for text in (answer, f" {answer}")]
        found.append(sorted({ids[0] for ids in encoded if len(ids) == 1}))
    for answer, tokens in zip(answers, found, strict=True):
        if not tokens:
            raise ConfigError(
                f"labeler.answers: {answer!r} is no single token of the judge's model; choose shorter answers, or "
                "labeler.by=text"
            )
    if set(found[0]) & set(found[1]):
        raise ConfigError(f"labeler.answers: expected two that differ, got {answers}")
    return found[0], found[1]


def verdict(reply: str, answers: tuple[str, str]) -> float:
    """1 or 0 for a reply that begins with the first or the second answer as a word of its own, NaN for another."""
    for answer, value in zip(answers, (1.0, 0.0), strict=True):
        if re.match(rf"\W*{re.escape(answer)}(?!\w)", reply):
            return value
    return float("nan")
