from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from prefrl.exchange.transcripts import (
    parse_transcript,
    prompt_messages,
    prompt_text,
    read_messages,
    response_messages,
    response_text,
    split_conversations,
)

WORDS = st.text(st.sampled_from("ab :\n"), max_size=6)


def says(role: str, content: str) -> dict[str, str]:
    return {"role": role, "content": content}


def user(content: str) -> dict[str, str]:
    return says("user", content)


def assistant(content: str) -> dict[str, str]:
    return says("assistant", content)


def test_a_prompt_that_is_a_conversation_reads_as_a_transcript_and_back() -> None:
    messages = [says("system", "be kind"), user("hi"), assistant("hello"), user("and?")]
    text = prompt_text(messages)
    assert text == "System: be kind\n\nHuman: hi\n\nAssistant: hello\n\nHuman: and?\n\nAssistant: "
    assert prompt_messages(text) == messages


@given(st.lists(WORDS, min_size=1, max_size=3))
def test_whatever_is_told_apart_reads_the_same_again(words: list[str]) -> None:
    text = prompt_text([user(word) for word in words])
    messages = prompt_messages(text)
    assert messages is None or prompt_text(messages) == text
    assert response_text(response_messages(text)) == text


@pytest.mark.parametrize(
    "text", ["", "a review:", "Human: hi", "Assistant: ", "Human: a\n\nAssistant: b", "x\n\nHuman: a"]
)
def test_other_prompts_are_no_transcript(text: str) -> None:
    assert prompt_messages(text) is None


def test_transcripts_of_hh_are_read_with_and_without_their_first_line_feeds() -> None:
    expected = [user("hi"), assistant("hello\nyou")]
    assert parse_transcript("\n\nHuman: hi\n\nAssistant: hello\nyou") == expected
    assert parse_transcript("Human: hi\n\nAssistant: hello\nyou") == expected
    assert parse_transcript("\n\nHuman: hi\n\nAssistant:") == [user("hi"), assistant("")]
    assert parse_transcript("hi") is None


@pytest.mark.parametrize(
    ("first", "second", "expected"),
    [
        ([user("q"), assistant("a")], [user("q"), assistant("b")], ("q", "a", "b")),
        (
            [user("q"), assistant("a")],
            [user("q"), assistant("a"), user("r"), assistant("c")],
            ("q", "a", "a\n\nHuman: r\n\nAssistant: c"),
        ),
        (
            [user("q"), assistant("a"), user("r"), assistant("c")],
            [user("q"), assistant("b"), user("r"), assistant("c")],
            ("q", "a\n\nHuman: r\n\nAssistant: c", "b\n\nHuman: r\n\nAssistant: c"),
        ),
        ([user("q"), assistant("a")], [user("q"), assistant("a")], ("q", "a", "a")),
    ],
)
def test_two_conversations_are_one_prompt_and_two_responses(
    first: list[dict[str, str]], second: list[dict[str, str]], expected: tuple[str, str, str]
) -> None:
    prompt, a, b = split_conversations(first, second)
    assert (prompt, a, b) == (f"Human: {expected[0]}\n\nAssistant: ", *expected[1:])


@pytest.mark.parametrize("other", [[user("r"), assistant("b")], [user("q")], [user("q"), user("r"), assistant("b")]])
def test_conversations_with_different_prompts_are_refused(other: list[dict[str, str]]) -> None:
    with pytest.raises(ValueError, match="they answer different prompts"):
        split_conversations([user("q"), assistant("a")], other)


@pytest.mark.parametrize(
    "value", [None, [], "hi", [{"role": "tool", "content": ""}], [{"role": "user", "content": []}], [3]]
)
def test_what_is_no_message_is_refused(value: Any) -> None:
    with pytest.raises(ValueError, match="expected"):
        read_messages(value)


def test_a_prompt_may_not_end_with_the_assistants_words() -> None:
    with pytest.raises(ValueError, match="ends with the assistant's words"):
        prompt_text([user("q"), assistant("a")])
