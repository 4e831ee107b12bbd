"""Conversations: lists of messages, and the transcripts as which prompts and responses hold them.

A prompt that is a conversation reads `Human: Hi\\n\\nAssistant: `, each message after its speaker and two line feeds
between them; Anthropic's HH data (Bai et al. 2022) is laid out alike, with two line feeds more at its start.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

Messages = list[dict[str, str]]
SPEAKERS = {"system": "System", "user": "Human", "prompter": "Human", "assistant": "Assistant"}
ROLES = {"System": "system", "Human": "user", "Assistant": "assistant"}
CUE = "Assistant: "
_TURN = re.compile(r"(?:\A|\n\n)(System|Human|Assistant):(?: |\Z)")


def read_messages(value: Any) -> Messages:
    """Messages {"role", "content"} from a file. Raises `ValueError` where they are not that, or not text."""
    if not isinstance(value, list) or not value:
        raise ValueError(f"expected a list of messages, got {value!r:.200}")
    found = []
    for one in value:
        told = isinstance(one, Mapping) and isinstance(one.get("role"), str) and isinstance(one.get("content"), str)
        fits = told and one["role"] in SPEAKERS
        if not fits:
            roles = ", ".join(SPEAKERS)
            raise ValueError(f"expected messages with a role ({roles}) and content that is text, got {one!r:.200}")
        role = ROLES[SPEAKERS[one["role"]]]
        found.append({"role": role, "content": one["content"]})
    return found


def prompt_text(messages: Sequence[Mapping[str, str]]) -> str:
    """The transcript of a conversation that waits for the assistant."""
    if messages and messages[-1]["role"] == "assistant":
        raise ValueError("a prompt that ends with the assistant's words leaves it unclear where the response starts")
    return "".join(f"{SPEAKERS[m['role']]}: {m['content']}\n\n" for m in messages) + CUE


def response_text(messages: Sequence[Mapping[str, str]]) -> str:
    """What the assistant said, and what came after it if there is more."""
    if not messages or messages[0]["role"] != "assistant":
        raise ValueError("expected a response that starts with the assistant's words")
    return "\n\n".join(f"{SPEAKERS[m['role']]}: {m['content']}" for m in messages)[len(CUE) :]


def split_conversations(first: Messages, second: Messages) -> tuple[str, str, str]:
    """(prompt, first response, second response): what two conversations share, and how each goes on.

    The prompt ends where the assistant speaks. Raises `ValueError` where they do not part at the assistant's words.
    """
    shared = 0
    while shared < min(len(first), len(second)) and first[shared] == second[shared]:
        shared += 1
    ends = "" in (_role(first, shared), _role(second, shared))
    while shared and ends and not _answers(first, second, shared):
        shared -= 1  # one goes on where the other ends
    if not _answers(first, second, shared):
        raise ValueError("the two conversations do not part at the assistant's words: they answer different prompts")
    return prompt_text(first[:shared]), response_text(first[shared:]), response_text(second[shared:])


def _answers(first: Messages, second: Messages, at: int) -> bool:
    """Whether both have the assistant speak there, after somebody else."""
    both = _role(first, at) == _role(second, at) == "assistant"
    return both and (at == 0 or first[at - 1]["role"] != "assistant")


def _role(messages: Messages, at: int) -> str:
    return messages[at]["role"] if at < len(messages) else ""


def parse_transcript(text: str) -> Messages | None:
    """The messages of a transcript, its last one perhaps empty; None for other text."""
    text = text.lstrip("\n")
    turns = list(_TURN.finditer(text))
    if not turns or turns[0].start():
        return None
    ends = [turn.start() for turn in turns[1:]] + [len(text)]
    return [{"role": ROLES[turn[1]], "content": text[turn.end() : end]} for turn, end in zip(turns, ends, strict=True)]


def prompt_messages(prompt: str) -> Messages | None:
    """The messages of a prompt that is a transcript, and gives that transcript again; None for other prompts."""
    messages = parse_transcript(prompt)
    if messages is None or len(messages) < 2 or messages.pop() != {"role": "assistant", "content": ""}:
        return None
    return messages if messages[-1]["role"] != "assistant" and prompt_text(messages) == prompt else None


def response_messages(text: str) -> Messages:
    """The assistant's words, and the turns after them if the last is the assistant's again."""
    messages = parse_transcript(CUE + text) or []
    if len(messages) > 1 and messages[-1]["role"] == "assistant" and response_text(messages) == text:
        return messages
    return [{"role": "assistant", "content": text}]
