from pathlib import Path

import numpy as np
import pytest
import torch

from prefrl.storage.checkpoints import load_state, save_state
from prefrl.storage.files import DamagedError
from prefrl.types import State


def test_a_nested_state_comes_back_equal(tmp_path: Path) -> None:
    state: State = {
        "tensor": torch.arange(6, dtype=torch.bfloat16).reshape(2, 3),
        "array": np.arange(4.0)[::2],
        "scalar array": np.array(3),
        "optimizer": {0: {"step": torch.tensor(2.0)}, 1: {}},
        "plain": [1, 2.5, "three", None, True, float("inf")],
        "empty": {},
        "shared": [torch.ones(2)] * 2,
    }
    save_state(tmp_path, "learner", state)
    got = load_state(tmp_path, "learner")
    assert torch.equal(got["tensor"], state["tensor"])
    assert got["tensor"].dtype == torch.bfloat16
    np.testing.assert_array_equal(got["array"], [0, 2])
    assert got["scalar array"].shape == ()
    assert got["optimizer"][0]["step"] == 2
    assert got["plain"] == state["plain"]
    assert got["empty"] == {}


def test_the_same_state_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        save_state(tmp_path / name, "s", {"x": torch.ones(3), "n": 1})
    assert (tmp_path / "a/s.safetensors").read_bytes() == (tmp_path / "b/s.safetensors").read_bytes()
    assert (tmp_path / "a/s.json").read_bytes() == (tmp_path / "b/s.json").read_bytes()


def test_what_no_file_can_hold_is_refused_by_its_path(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match=r"learner\.policy\.rule"):
        save_state(tmp_path, "learner", {"policy": {"rule": object()}})


def test_a_torn_state_is_an_error_and_not_a_guess(tmp_path: Path) -> None:
    save_state(tmp_path, "s", {"x": torch.ones(3)})
    (tmp_path / "s.safetensors").write_bytes(b"not tensors")
    with pytest.raises(DamagedError, match="no state 's'"):
        load_state(tmp_path, "s")
