"""Judged responses to prompts: JSON lines in the forms that the field uses, and tables of chosen and rejected.

- `{"prompt", "chosen", "rejected"}` as text, or as lists of `{"role", "content"}`; without a prompt where chosen and
  rejected are whole conversations. `"margin"` or `"preference"` says how much better;
- `{"prompt", "completion", "label"}`: one response, good or not;
- `{"prompt", "completion"}`, or `{"messages"}` that end with the assistant's: a demonstration;
- `{"prompt", "responses": [...]}` with one of `"ranks"`, `"best"`, `"ratings"` (and `"scale"`), `"preference"` or
  `"skip"`;
- conversation trees of OpenAssistant (Koepf et al. 2023): a ranking of the replies to each of a person's turns;
- what labelling tools write: see `tool_rows`; and pairs of pictures: see `picture_rows`.

`"labeler"`, `"weight"`, `"shown"` and `"split"` may be added to a row of the first three forms.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from prefrl.exchange.guard import unguarded
from prefrl.exchange.layout import (
    VERDICTS,
    Layout,
    Parts,
    Row,
    answer_of,
    answered,
    comparison,
    number,
    optional,
    responses,
)
from prefrl.exchange.picture_rows import picture_pair
from prefrl.exchange.reading import Line, parse_json, read_rows
from prefrl.exchange.transcripts import (
    CUE,
    SPEAKERS,
    parse_transcript,
    prompt_text,
    read_messages,
    response_text,
    split_conversations,
)
from prefrl.judgements import Demonstration, Rating
from prefrl.types import Fields, Json, Response

COLUMNS = ("prompt", "chosen", "rejected", "margin", "completion", "messages", "label", "responses", *VERDICTS, "scale")
_NO_TEXT = ("margin", "messages", "label", "responses", *VERDICTS, "scale", "weight", "shown")
EXTRA = ("labeler", "weight", "shown", "split", "left", "right")
TREE_ROLES = ("prompter", "assistant")


def text_rows(path: Path, layout: Layout | None = None) -> Parts:
    """(row N, what reads it) for each line, table row or element of a list."""
    layout = layout or Layout()
    if unknown := {ours for ours, _ in layout.columns} - {*COLUMNS, *EXTRA}:
        raise ValueError(f"no column {min(unknown)!r} is read; there are: {', '.join((*COLUMNS, *EXTRA))}")
    cells = ".csv" in (suffix.lower() for suffix in path.suffixes)
    for count, row in enumerate(read_rows(path), 1):
        yield f"row {count}", partial(parse, row, layout, cells)


def parse(row: Any, layout: Layout | None = None, cells: bool = False) -> list[Row | str]:
    """A line, or a table's row as a dict, as answers and reasons for leaving others out; raises `ValueError`.

    With `cells` the values are all text, as in a .csv.
    """
    layout = layout or Layout()
    if isinstance(row, Line):
        row = parse_json(row.text)
    if not isinstance(row, dict):
        raise ValueError(f"expected an object, got {type(row).__name__}")
    row = _mapped(unguarded(row) if cells else row, dict(layout.columns))
    row = {name: _typed(name, value) for name, value in row.items()} if cells else row
    return FORMS[form_of(row) if layout.form == "auto" else layout.form](row)


def form_of(row: Fields) -> str:
    """Which form a row has, by its columns; "preferences" where nothing else is meant."""
    if isinstance(row.get("fields"), Mapping):
        return "argilla"
    if isinstance(row.get("data"), Mapping) and "annotations" in row:
        return "label-studio"
    if "conversation_a" in row:
        return "arena"
    if isinstance(row.get("prompt"), Mapping):
        return "tree"
    if "jpg_0" in row:
        return "pick-a-pic"
    if row.get("responses") is not None:
        return "responses"
    if ("completion" in row or "messages" in row) and "chosen" not in row:
        # A column of another name may be the label: a bad response is not to be taken for a good one.
        known = {"prompt", "completion", "messages", "query", "at", *EXTRA}
        return "unpaired" if set(row) - known else "demonstrations"
    return "preferences"


def _mapped(row: Json, columns: Mapping[str, str]) -> Json:
    """The row under our names, with what was named alone; a tool's row keeps its other parts."""
    if not columns:
        return row
    inner = next((name for name in ("fields", "data") if isinstance(row.get(name), Mapping)), "")
    given = row[inner] if inner else row
    for ours, theirs in columns.items():
        if theirs not in given:
            raise ValueError(f"column {theirs!r}, for {ours!r}, is missing; there are: {', '.join(map(str, given))}")
    found = {ours: given[theirs] for ours, theirs in columns.items()}
    return row | {inner: found} if inner else found


def _typed(name: str, cell: str | None) -> Any:
    """What the text of a cell stands for, where its column holds no text."""
    if cell is None or name == "skip" or name not in _NO_TEXT:
        return cell
    try:
        return parse_json(cell.lower() if name == "label" else cell)
    except ValueError:
        return cell


# --- chosen and rejected -----------------------------------------------------------------------------------------


def _pair(row: Fields) -> list[Row | str]:
    prompt, chosen, rejected = _conversational(row) or _implicit(row) or _plain(row)
    if chosen == rejected:
        raise ValueError("chosen and rejected are the same text")
    return [answered(row, responses(prompt, [chosen, rejected]), partial(comparison, _strength(row)))]


def _plain(row: Fields) -> tuple[str, str, str]:
    for name in ("prompt", "chosen", "rejected"):
        if name not in row:
            raise ValueError(f"column {name!r} is missing; there are: {', '.join(map(str, row))}")
        if not isinstance(row[name], str):
            raise ValueError(f"column {name!r}: expected a string, got {row[name]!r:.200}")
    return row["prompt"], row["chosen"], row["rejected"]


def _conversational(row: Fields) -> tuple[str, str, str] | None:
    """Chosen and rejected as lists of messages: responses, or whole conversations that start alike."""
    if not isinstance(row.get("chosen"), list) or not isinstance(row.get("rejected"), list):
        return None
    chosen, rejected = read_messages(row["chosen"]), read_messages(row["rejected"])
    if row.get("prompt") is None or chosen[0]["role"] != "assistant":
        return split_conversations(chosen, rejected)
    return _prompt(row["prompt"]), response_text(chosen), response_text(rejected)


def _implicit(row: Fields) -> tuple[str, str, str] | None:
    """Chosen and rejected as transcripts that start alike."""
    if row.get("prompt") is not None or not (
        isinstance(row.get("chosen"), str) and isinstance(row.get("rejected"), str)
    ):
        return None
    chosen, rejected = parse_transcript(row["chosen"]), parse_transcript(row["rejected"])
    if chosen is None or rejected is None:
        return None
    return split_conversations(chosen, rejected)


def _prompt(value: Any) -> str:
    return prompt_text(read_messages(value)) if isinstance(value, list) else str(value)


def _strength(row: Fields) -> float:
    """How probably the chosen one is better: as said, or by its margin in the Bradley-Terry model, else surely."""
    preference, margin = number(row, "preference", 1.0), number(row, "margin", 0.0)
    if not 0.0 <= preference <= 1.0:
        raise ValueError(f"a preference must lie in [0, 1], got {preference}")
    if margin < 0.0:
        raise ValueError(f"column 'margin': expected a number from 0 on, got {margin}: is the rejected one better?")
    if margin == 0.0 or row.get("preference") is not None:
        return preference
    return round(1.0 / (1.0 + math.exp(-margin)), 12)


def _unpaired(row: Fields) -> list[Row | str]:
    """One response that is good or not: a rating on a scale of two levels."""
    label = row.get("label")
    if label not in (0, 1) or not isinstance(label, bool | int):
        raise ValueError(f"column 'label': expected true or false, got {label!r:.200}")
    return [answered(row, [_completion(row)], partial(_good, int(label)))]


def _completion(row: Fields) -> Response:
    completion = row.get("completion")
    if completion is None and row.get("messages") is not None:
        return _conversation(row["messages"])
    if isinstance(completion, list):
        completion = response_text(read_messages(completion))
    if not isinstance(completion, str) or not isinstance(row.get("prompt"), str | list):
        raise ValueError(f'expected "prompt" and "completion" as text or messages, got {row!r:.200}')
    return Response(_prompt(row["prompt"]), completion)


def _conversation(value: Any) -> Response:
    """The assistant's last words as a response to all before them."""
    messages = read_messages(value)
    if len(messages) < 2 or messages[-1]["role"] != "assistant":
        raise ValueError(
            "column 'messages': expected a conversation that ends with the assistant's words, got "
            f"{', '.join(one['role'] for one in messages)}"
        )
    return Response(prompt_text(messages[:-1]), response_text(messages[-1:]))


def _demonstration(row: Fields) -> list[Row | str]:
    """One response that shows what is wanted."""
    shown = _completion(row)
    if not shown.text:
        raise ValueError("column 'completion': expected what a good response is like, got an empty text")
    return [answered(row, [shown], partial(_like, shown.id))]


def _like(candidate: str, query: str, order: Sequence[int], who: Json) -> Demonstration:
    return Demonstration(query, candidate, **who)


def _good(level: int, query: str, order: Sequence[int], who: Json) -> Rating:
    return Rating(query, (level,), 2, **who)


# --- several responses ------------------------------------------------------------------------------------------


def _several(row: Fields) -> Row:
    texts = row.get("responses")
    if not isinstance(row.get("prompt"), str) or not isinstance(texts, list):
        raise ValueError(f'expected "prompt": string and "responses": list, got {row!r:.200}')
    if not all(isinstance(text, str) for text in texts):
        raise ValueError(f"expected responses that are strings, got {texts!r:.200}")
    return answer_of(row, responses(row["prompt"], texts))


# --- conversation trees ------------------------------------------------------------------------------------------


def _trees(row: Fields) -> list[Row | str]:
    return _tree(row.get("prompt"), optional(row, "split", str, ""))


def _tree(root: Any, split: str) -> list[Row | str]:
    """A ranking for each group of ranked replies to one conversation so far."""
    found: list[Row | str] = []
    waiting = [(root, "")]
    while waiting:
        message, before = waiting.pop()
        if not _is_message(message):
            raise ValueError(
                f"expected a message with a text and a role ({', '.join(TREE_ROLES)}), got {message!r:.200}"
            )
        here = f"{before}{SPEAKERS[message['role']]}: {message['text']}\n\n"
        replies = [r for r in message.get("replies") or [] if isinstance(r, dict)]
        if message["role"] == "prompter" and replies:
            found += _group(here + CUE, replies, split)
        waiting += [(reply, here) for reply in reversed(replies)]
    return found


def _is_message(value: Any) -> bool:
    known = isinstance(value, Mapping) and value.get("role") in TREE_ROLES and isinstance(value.get("text"), str)
    return known and isinstance(value.get("replies") or [], list)


def _group(prompt: str, replies: Sequence[Fields], split: str) -> list[Row | str]:
    ranked = [reply for reply in replies if reply.get("rank") is not None]
    if len(ranked) < 2:
        return ["prompt with fewer than two ranked replies"]
    row = {"prompt": prompt, "responses": [r.get("text") for r in ranked], "ranks": [r["rank"] for r in ranked]}
    return [
        _several(row)._replace(split=split),
        *["reply without a rank beside ranked ones"] * (len(replies) - len(ranked)),
    ]


def _responses(row: Fields) -> list[Row | str]:
    return [_several(row)]


def _of_tool(name: str, row: Fields) -> list[Row | str]:
    from prefrl.exchange.tool_rows import TOOLS

    return TOOLS[name](row)


FORMS: Mapping[str, Callable[[Fields], list[Row | str]]] = {
    "preferences": _pair,
    "unpaired": _unpaired,
    "demonstrations": _demonstration,
    "responses": _responses,
    "tree": _trees,
    "argilla": partial(_of_tool, "argilla"),
    "label-studio": partial(_of_tool, "label-studio"),
    "arena": partial(_of_tool, "arena"),
    "pick-a-pic": picture_pair,
}
"""What reads the rows of each form."""
