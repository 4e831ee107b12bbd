import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prefrl.envs.grammar import parse, render
from prefrl.envs.reviews import reviews, source

SMALL = """
review = <who> likes / <what> . | <who> sleeps / .
who = ann *3 | i
what = tea | tea , milk | _
"""


def test_the_small_grammar_accepts_exactly_what_it_can_write() -> None:
    grammar = parse(SMALL, "review")
    written = {prompt + rest for prompt, rest in (grammar.sample(np.random.default_rng(i)) for i in range(300))}
    endings = (" likes tea.", " likes tea, milk.", " likes.", " sleeps.")
    assert written == {who + end for who in ("Ann", "I") for end in endings}
    assert all(map(grammar.accepts, written))


@pytest.mark.parametrize(
    "text",
    [
        "",
        "Ann",
        "ann likes tea.",
        "Ann likes tea",
        "Ann likes  tea.",
        "Ann likes tea .",
        "Ann likes tea. Ann",
        "Ann likes TEA.",
    ],
)
def test_anything_else_is_not_accepted(text: str) -> None:
    assert not parse(SMALL, "review").accepts(text)


def test_phrases_are_how_alternatives_begin() -> None:
    grammar = parse("a = one <b> two | three\nb_x = four | five six\nb = <b_x>", "a")
    assert grammar.phrases("a") == ("one", "three")
    assert grammar.phrases("_x") == ("four", "five six")


def test_weights_are_relative_frequencies() -> None:
    grammar, rng = parse(SMALL, "review"), np.random.default_rng(0)
    share = np.mean([grammar.sample(rng)[0].startswith("Ann") for _ in range(2000)])
    assert abs(share - 0.75) < 0.04


def test_rendering_makes_sentences() -> None:
    assert render(["well", ",", "i", "said", "i'm", "in", ".", "good", "!"]) == "Well, I said I'm in. Good!"


@pytest.mark.parametrize(
    ("rules", "message"),
    [
        ("a = <b>", "no rule for b"),
        ("a = <b>\nb = x <a>", "is a cycle"),
        ("a = x\na = y", "each name once"),
        ("a", "expected"),
    ],
)
def test_a_wrong_grammar_says_what_is_wrong(rules: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse(rules, "a")


@given(st.integers(0, 2**32 - 1))
def test_every_review_that_is_written_is_accepted(seed: int) -> None:
    prompt, rest = REVIEWS.sample(np.random.default_rng(seed))
    assert REVIEWS.accepts(prompt + rest)
    assert rest[0] in " .!,"
    assert not prompt.endswith(" ")


@given(st.integers(0, 2**32 - 1), st.integers(0, 10_000))
def test_a_review_with_a_word_said_twice_is_not_accepted(seed: int, at: int) -> None:
    words = "".join(REVIEWS.sample(np.random.default_rng(seed))).split()
    at %= len(words)
    assert not REVIEWS.accepts(" ".join([*words[: at + 1], words[at].lower(), *words[at + 1 :]]))


def test_reviews_are_many_and_of_sensible_length() -> None:
    rng = np.random.default_rng(0)
    texts = ["".join(REVIEWS.sample(rng)) for _ in range(2000)]
    lengths = np.array([len(text.split()) for text in texts])
    assert len(set(texts)) > 1990
    assert 15 < lengths.mean() < 25
    assert np.mean((lengths >= 10) & (lengths <= 40)) > 0.97


def test_the_same_seed_writes_the_same_review() -> None:
    first, second = (REVIEWS.sample(np.random.default_rng(5)) for _ in range(2))
    assert first == second


def test_no_name_is_left_over() -> None:
    reachable, todo = set(), ["review"]
    while todo:
        name = todo.pop()
        if name not in reachable:
            reachable.add(name)
            todo += [item[1:-1] for a in REVIEWS.rules[name].alternatives for item in a if item.startswith("<")]
    assert set(REVIEWS.rules) == reachable
    assert "@" not in source()


REVIEWS = reviews()
