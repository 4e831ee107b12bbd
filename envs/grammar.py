"""A probabilistic grammar: it writes texts, and it can tell whether it could have written a given one.

The notation is a line a rule, `name = a | b *2 | <other> c`: alternatives with weights (1 unless said), names in angle
brackets, `_` for nothing; a line that begins with a space goes on with the one before. Words are lower-case; `render`
adds capitals and spaces. `/` ends the prompt: what comes before it is given, what comes after it is to be written.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from graphlib import CycleError, TopologicalSorter
from itertools import accumulate, takewhile

import numpy as np

SPLIT = "/"
_TOKEN = re.compile(r"[a-z0-9']+|[.,!?;:]")
_SENTENCE_ENDS = {".", "!", "?"}


@dataclass(frozen=True)
class Rule:
    """The alternatives of one name."""

    alternatives: tuple[tuple[str, ...], ...]
    cumulative: tuple[float, ...]
    """Running sums of the weights."""

    def draw(self, rng: np.random.Generator) -> tuple[str, ...]:
        at = bisect_right(self.cumulative, rng.random() * self.cumulative[-1])
        return self.alternatives[min(at, len(self.alternatives) - 1)]  # rounding can reach the total itself


@dataclass(frozen=True)
class Grammar:
    """A finite probabilistic context-free grammar (no name may lead back to itself)."""

    rules: Mapping[str, Rule]
    start: str

    def sample(self, rng: np.random.Generator) -> tuple[str, str]:
        """One text, as the prompt and what follows it; their concatenation is the text."""
        words = self._expand(self.start, rng)
        split = words.index(SPLIT)
        text = render([w for w in words if w != SPLIT])
        length = len(render(words[:split]))
        return text[:length], text[length:]

    def accepts(self, text: str) -> bool:
        """Could the grammar have written exactly this text, capitals and spaces included?"""
        words = _TOKEN.findall(text.lower())
        return render(words) == text and len(words) in self._ends(f"<{self.start}>", 0, words, {})

    def phrases(self, ending: str) -> tuple[str, ...]:
        """How each alternative of the rules whose names end so begins, up to the first name in it; lower-case."""
        ways = [way for name, rule in self.rules.items() if name.endswith(ending) for way in rule.alternatives]
        return tuple(" ".join(takewhile(lambda item: not item.startswith("<"), way)) for way in ways)

    @cached_property
    def literals(self) -> frozenset[str]:
        """All words and punctuation that occur."""
        everything = {w for rule in self.rules.values() for alternative in rule.alternatives for w in alternative}
        return frozenset(w for w in everything if not w.startswith("<") and w != SPLIT)

    def _expand(self, name: str, rng: np.random.Generator) -> list[str]:
        words: list[str] = []
        for item in self.rules[name].draw(rng):
            words += self._expand(item[1:-1], rng) if item.startswith("<") else [item]
        return words

    def _ends(self, item: str, at: int, words: list[str], memo: dict[tuple[str, int], set[int]]) -> set[int]:
        """Where `item` can end if it begins at `at`; each (item, position) is worked out once."""
        if item == SPLIT:
            return {at}
        if not item.startswith("<"):
            return {at + 1} if words[at : at + 1] == [item] else set()
        if (item, at) not in memo:
            found: set[int] = set()
            for alternative in self.rules[item[1:-1]].alternatives:
                ends = {at}
                for part in alternative:
                    ends = {end for begin in ends for end in self._ends(part, begin, words, memo)}
                found |= ends
            memo[item, at] = found
        return memo[item, at]


def parse(source: str, start: str) -> Grammar:
    """Read a grammar; raises `ValueError` for an unknown name, a name given twice, or one that leads back to itself."""
    rules: dict[str, Rule] = {}
    for line in filter(str.strip, re.sub(r"\n +", " ", source).splitlines()):
        name, _, right = (part.strip() for part in line.partition("="))
        if not right or name in rules:
            raise ValueError(f"expected `name = alternatives`, each name once, got {line.strip()!r}")
        rules[name] = _rule(right)
    _check(rules, start)
    return Grammar(rules, start)


def render(words: list[str]) -> str:
    """Words as a text: no space before punctuation, a capital for `i` and at the start of each sentence."""
    pieces: list[str] = []
    for i, word in enumerate(words):
        begins = i == 0 or words[i - 1] in _SENTENCE_ENDS
        word = word[:1].upper() + word[1:] if begins or word == "i" or word.startswith("i'") else word
        pieces.append(word if i == 0 or not word[0].isalnum() else f" {word}")
    return "".join(pieces)


def _rule(right: str) -> Rule:
    parts = [re.fullmatch(r"(.*?)(?:\s\*([\d.]+))?", part.strip()) for part in right.split("|")]
    found = [(tuple(w for w in m[1].split() if w != "_"), float(m[2] or 1)) for m in parts if m]
    return Rule(tuple(words for words, _ in found), tuple(accumulate(weight for _, weight in found)))


def _check(rules: Mapping[str, Rule], start: str) -> None:
    used = {
        name: {item[1:-1] for alternative in rule.alternatives for item in alternative if item.startswith("<")}
        for name, rule in rules.items()
    }
    if unknown := sorted({start, *(name for names in used.values() for name in names)} - set(rules)):
        raise ValueError(f"no rule for {', '.join(unknown)}")
    try:
        TopologicalSorter(used).prepare()
    except CycleError as error:
        raise ValueError(f"the grammar must be finite, but {' -> '.join(error.args[1])} is a cycle") from error
