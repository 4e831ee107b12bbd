"""Every kind of policy in the learner of control: repeated, saved, resumed, exported or refused, configured."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from control_stubs import Known, point

from prefrl import Config, Run, load_policy
from prefrl.components import ConfigError
from prefrl.improve.control import ControlLearner, ControlLearnerSettings
from prefrl.improve.valued import valued
from prefrl.policies.rollout import collect
from prefrl.stages import export_sb3, shrink
from prefrl.storage.checkpoints import load_state, save_state
from prefrl.store import Store
from prefrl.types import Segment

KINDS: dict[str, dict[str, Any]] = {
    "mlp": {"hidden": (6,), "critic_hidden": (7, 5), "activation": "relu"},
    "cnn": {"kind": "cnn", "image": (1, 1, 1), "filters": [[4, 1, 1]], "width": 8},
    "gru": {"kind": "gru", "width": 6, "hidden": 5, "chunk": 8},
    "transformer": {"kind": "transformer", "context": 5, "width": 6, "heads": 2, "hidden": 5, "chunk": 8},
    "flow": {"kind": "flow", "hidden": [6], "critic_hidden": [5], "chunk": 3, "execute": 2, "draws": 2},
}


def built(kind: str, seed: int = 0) -> ControlLearner:
    settings = {"environments": 4, "steps_per_round": 240, "rollout_steps": 30, "epochs": 2, "minibatch": 64}
    return ControlLearnerSettings.model_validate(settings | {"policy": KINDS[kind], "evaluation_episodes": 2}).build(
        point(), np.random.default_rng(seed)
    )


def weights(learner: ControlLearner) -> bytes:
    return b"".join(p.numpy().tobytes() for p in learner.policy.state()["parameters"].values())


@pytest.mark.parametrize("kind", KINDS)
def test_a_saved_learner_goes_on_bit_for_bit(kind: str, store: Store[Segment], tmp_path: Path) -> None:
    learner, other = built(kind), built(kind, seed=7)
    metrics = learner.improve(Known(), store, np.random.default_rng(0))
    assert metrics["ratio_error"] < (1e-12 if kind == "flow" else 1e-5)
    assert ("kl_old" in metrics) == ("entropy" in metrics) == (kind != "flow")  # no numbers for what is not known
    assert metrics["grad_norm"] > 0
    save_state(tmp_path, "learner", learner.state())
    other.load(load_state(tmp_path, "learner"))
    for one in (learner, other):
        one.improve(Known(), store, np.random.default_rng(2))
    assert weights(learner) == weights(other)
    found = [one.evaluate(Known(), np.random.default_rng(3)).metrics for one in (learner, other)]
    assert found[0] == found[1]


def test_a_state_of_another_kind_or_size_is_refused() -> None:
    with pytest.raises(ValueError, match=r"policy: .* has shape None, expected .*: other settings or task"):
        built("gru").load(built("mlp").state())


def test_a_minibatch_is_counted_in_steps_however_they_are_cut() -> None:
    """4 rows of 30 steps, in chunks of 8, the last of each not full."""
    learner, rng = built("gru"), np.random.default_rng(0)
    envs = point().environments(4)
    rollout, _ = collect(envs, envs.reset(rng), 30, learner._act(rng))
    read = partial(learner.policy.read, rollout, None)
    batch, _ = valued(learner.policy, rollout, read, rollout.gold, discount=0.99, trace=0.95)
    assert len(batch) == 16
    parts = learner._minibatches(batch, 3, rng)
    assert [len(part) for part in parts] == [8] * 6  # 120 steps: two minibatches of about 64
    assert sorted(np.concatenate(parts[:2]).tolist()) == list(range(16))


def test_what_moved_into_the_policy_is_said_and_kinds_are_told_apart() -> None:
    def told(**learner: Any) -> str:
        data = Config.load("control/toy").model_dump(mode="json")
        with pytest.raises(ConfigError) as error:
            Config.parse({**data, "learner": {"kind": "control", **learner}})
        return str(error.value)

    assert told(hidden=[8]) == "learner.hidden: this is now learner.policy.hidden; write it there"
    assert "learner.policy.initial_std" in told(initial_std=0.5)
    assert told(policy={"kind": "gri"}) == "learner.policy.kind: unknown kind 'gri'; did you mean 'gru'?"
    assert told(policy={"widht": 8, "kind": "gru"}) == "learner.policy.widht: unknown setting; did you mean 'width'?"
    assert told(policy={"hidden": [0]}).startswith("learner.policy.hidden.0: expected")
    config = Config.load("control/toy", ["learner.policy.kind=gru", "learner.policy.width=8"])
    assert config.learner.model_dump()["policy"]["width"] == 8
    assert Config.parse(config.model_dump(mode="json")) == config


def test_a_folder_with_settings_of_an_earlier_version_is_opened(tmp_path: Path) -> None:
    config = shrink(Config.load("control/toy", ["learner.policy.hidden=[8]", "learner.policy.initial_std=0.5"]))
    with Run(config, tmp_path / "run") as run:
        before = [round.metrics for round in run]
    path = tmp_path / "run" / "config.yaml"
    saved = yaml.safe_load(path.read_text())
    moved = saved["learner"].pop("policy")
    saved["learner"] |= {"kind": "ppo", "hidden": moved["hidden"], "initial_std": moved["initial_std"]}
    path.write_text(yaml.safe_dump(saved))
    with Run.resume(tmp_path / "run") as run:
        assert run.config == config
        assert run.loop.round == len(before) - 1


def test_a_run_of_a_recurrent_policy_is_loaded_but_not_exported(tmp_path: Path) -> None:
    config = shrink(Config.load("control/toy", ["learner.policy.kind=gru", "learner.policy.width=8"]))
    with Run(config, tmp_path / "run") as run:
        list(run)
    action, state = load_policy(tmp_path / "run").predict(np.zeros((3, 2)))
    assert action.shape == (3, 2)
    assert state is not None
    assert state.shape == (3, 16)
    with pytest.raises(ConfigError, match=r"only hold a policy of kind mlp, .* kind gru.*load_policy"):
        export_sb3(tmp_path / "run", tmp_path / "policy.zip")
