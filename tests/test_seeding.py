import platform
import resource
from dataclasses import fields

import numpy as np
import pytest
import torch

from prefrl.seeding import Streams, device_of, draw_seed, generator, keep_freed_memory, keyed, streams, to_numpy


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


def test_auto_is_the_gpu_where_there_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    found = []
    for there in (True, False):
        monkeypatch.setattr(torch.cuda, "is_available", lambda there=there: there)
        found.append([device_of("auto").type, device_of("cpu").type])
    assert found == [["cuda", "cpu"], ["cpu", "cpu"]]


def test_a_gpu_that_is_asked_for_and_not_there_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError, match=r"learner.device=cuda, but torch finds no GPU: set it to auto or cpu"):
        device_of("cuda")


def test_a_generator_draws_on_the_cpu_whatever_the_default_device_is() -> None:
    with torch.device("meta"):
        order = generator(np.random.default_rng(3))
    assert order.device.type == "cpu"
    expected = torch.Generator().manual_seed(draw_seed(np.random.default_rng(3)))
    assert torch.equal(torch.rand(4, generator=order), torch.rand(4, generator=expected))


def test_an_array_of_a_parameter_shares_its_memory() -> None:
    parameter = torch.nn.Parameter(torch.zeros(2))
    to_numpy(parameter)[1] = 5.0
    assert parameter.tolist() == [0.0, 5.0]


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="other allocators have ways of their own")
def test_freed_memory_is_there_for_the_next_arrays() -> None:
    keep_freed_memory()

    def pages_asked_for() -> int:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
        for _ in range(20):
            [np.ones(1 << 17) for _ in range(8)]  # 8 MB, and freed
        return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

    pages_asked_for()
    assert pages_asked_for() < 4000  # of the 41,000 that these arrays have
