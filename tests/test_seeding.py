from dataclasses import fields

import numpy as np

from prefrl.seeding import Streams, draw_seed, keyed, streams


def first(rng: np.random.Generator) -> int:
    return int(rng.integers(2**62))


def test_every_stage_of_every_round_has_a_stream_of_its_own() -> None:
    names = [f.name for f in fields(Streams) if f.name != "evaluate"]
    draws = [first(getattr(streams(seed, round), n)) for seed in range(3) for round in range(3) for n in names]
    assert len(set(draws)) == len(draws)


def test_a_stream_is_a_function_of_seed_round_and_stage() -> None:
    assert first(streams(3, 7).fit) == first(streams(3, 7).fit)


def test_every_round_is_evaluated_on_the_same_numbers() -> None:
    assert first(streams(3, 0).evaluate) == first(streams(3, 7).evaluate) != first(streams(4, 7).evaluate)


def test_a_keyed_generator_hangs_on_its_key_alone() -> None:
    assert first(keyed(1, "a")) == first(keyed(1, "a")) != first(keyed(1, "b"))
    assert first(keyed(1, "a")) != first(keyed(2, "a"))


def test_drawn_seeds_fit_what_libraries_take(rng: np.random.Generator) -> None:
    assert all(0 <= draw_seed(rng) < 2**31 for _ in range(100))
