from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import yaml
from other_device import ELSEWHERE, both

from prefrl import Config
from prefrl.components import TABLE, ConfigError, Settings, kinds, settings_class
from prefrl.config import presets
from prefrl.protocols import LearnerSettings
from prefrl.rundir import Run
from prefrl.store import Store
from prefrl.types import Segment

TOY = "control/toy"


@pytest.mark.parametrize("name", presets())
def test_every_preset_loads_says_what_it_shows_and_round_trips(name: str) -> None:
    config = Config.load(name)
    assert Config.parse(yaml.safe_load(config.dump())) == config
    assert len(presets()[name]) > 20


def test_a_dumped_config_spells_out_every_default(tmp_path: Path) -> None:
    path = tmp_path / "run.yaml"
    path.write_text(Config.load(TOY).dump())
    data = yaml.safe_load(path.read_text())
    assert data["labeler"].keys() == settings_class("labelers", "oracle").model_fields.keys()
    assert data["labeler"]["mistake_rate"] == 0.0
    assert Config.load(path) == Config.load(TOY)


@pytest.mark.parametrize(
    ("name", "overrides", "discount"),
    [
        ("control/toy", ["learner.discount=0.8"], 0.8),
        ("control/toy", ["learner.kind=sb3", "learner.options={gamma: 0.7}"], 0.7),
        ("text/toy", [], 1.0),
    ],
)
def test_every_kind_of_learner_says_its_discount(name: str, overrides: list[str], discount: float) -> None:
    assert Config.load(name, overrides).discount == discount


@pytest.mark.parametrize("kind", TABLE["labelers"])
def test_no_progress_is_drawn_where_people_are_spoken_to(kind: str) -> None:
    given = {"annotators": [{"name": "ann"}]} if kind == "crowd" else {}
    assert settings_class("labelers", kind).model_validate(given).asks_people() == (kind in ("terminal", "web"))


@pytest.mark.parametrize("kind", kinds("learners"))
def test_every_learners_settings_fit_their_role(kind: str) -> None:
    assert isinstance(settings_class("learners", kind)(), LearnerSettings)


@pytest.mark.parametrize("kind", TABLE["learners"])
def test_a_shrunk_learner_can_be_evaluated_at_its_true_size(kind: str) -> None:
    full = settings_class("learners", kind)()
    small, true_size = full.shrunk().model_dump(), full.shrunk().with_evaluation_of(full).model_dump()
    assert small != full.model_dump()
    evaluation = {name for name in small if name.startswith("evaluation_")}
    assert {name for name in small if small[name] != true_size[name]} == evaluation
    assert all(true_size[name] == full.model_dump()[name] for name in evaluation)


def test_a_learner_that_does_not_say_its_discount_is_refused_before_it_learns(tmp_path: Path) -> None:
    class Silent(Settings):
        """Settings of a learner of somebody's own."""

        kind: str = "silent"

    config = Config.load(TOY).model_copy(update={"learner": Silent()})
    with Store[Segment](tmp_path) as store, pytest.raises(ConfigError, match="Silent has no `discount`"):
        config.build(store)


def test_python_yaml_and_the_command_line_say_the_same_thing() -> None:
    by_override = Config.load(TOY, ["loop.labels=12", "fitting.learning_rate=1e-4", "seed=3"])
    preset = Config.load(TOY)
    by_hand = Config(
        task=preset.task,
        reward=preset.reward,
        learner=preset.learner,
        fitting=preset.fitting.model_copy(update={"learning_rate": 1e-4}),
        loop=preset.loop.model_copy(update={"labels": 12}),
        goal=preset.goal,
        seed=3,
    )
    assert by_override == by_hand


def test_the_order_of_overrides_does_not_matter() -> None:
    words = ["select.candidates=3", "select.kind=disagreement"]
    assert Config.load(TOY, words) == Config.load(TOY, words[::-1])


@pytest.mark.parametrize(
    ("preset", "overrides", "message"),
    [
        (TOY, "fitting.denoise=flip fitting.error_rate=0.1", "denoise=flip: with error_rate"),
        (TOY, "fitting.denoise=flip fitting.reliability=learned", "denoise=flip: with error_rate"),
        (TOY, "reward.kind=linear fitting.crop=0.2", "fitting.crop: this reward is solved for"),
        (TOY, "fitting.ties=rao_kupper select.candidates=3", "knows pairs only, and select.candidates is 3"),
        ("text/toy", "fitting.crop=0.2", "only segments can be cropped"),
        ("text/reviews-ppo", "learner.critic.network=reward reward.train=lora", "set reward.train=full"),
    ],
)
def test_what_a_fit_would_refuse_is_refused_before_anybody_is_asked(
    tmp_path: Path, preset: str, overrides: str, message: str
) -> None:
    with pytest.raises(ConfigError, match=message):
        Run(Config.load(preset, overrides.split()), tmp_path / "run")
    with Run(Config.load(preset), tmp_path / "run") as run:  # nothing has happened: the folder is still free
        assert run.store.sequence == 0


def test_pairs_of_rankings_know_ties_of_two(tmp_path: Path) -> None:
    words = ["fitting.ties=rao_kupper", "select.candidates=3", "fitting.rankings=pairs"]
    Run(Config.load(TOY, words), tmp_path / "run").close()


def test_a_new_kind_drops_the_settings_of_the_old_one() -> None:
    assert Config.load(TOY, ["learner.kind=sb3"]).learner == settings_class("learners", "sb3")()


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("learner.learning_rat=1", "learner.learning_rat: unknown setting; did you mean 'learning_rate'?"),
        ("learner.learning_rate=-1", "learner.learning_rate: expected greater than 0, got -1"),
        ("learner.learning_rate=fast", "learner.learning_rate: expected number, got 'fast'"),
        ("fitting.weight_decay=adaptiv", "fitting.weight_decay: expected number or 'adaptive', got 'adaptiv'"),
        ("learner.learning_rate=.nan", "learner.learning_rate: expected a finite number, got nan"),
        ("learner.kind=controll", "learner.kind: unknown learner kind 'controll'; did you mean 'control'?"),
        ("learner.kind=ppo", "learner.kind: learner kind 'ppo' is now called 'control'"),
        ("loop.lables=3", "loop.lables: unknown setting; did you mean 'labels'?"),
        ("lop.labels=3", "lop: unknown setting; did you mean 'loop'?"),
        ("task=5", "task: expected settings with a kind"),
        ("seed.x=5", "seed.x: seed is a value"),
        ("seed", "expected dotted.key=value"),
        ("seed=[", "is not a YAML value"),
    ],
)
def test_a_wrong_setting_gets_one_line_that_helps(override: str, message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        Config.load(TOY, ["seed=1", override])
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_sentence_with_a_colon_or_a_dash_is_a_sentence() -> None:
    for goal in ("Rule: who stays nearer to the line?", "- which of the two"):
        assert Config.load(TOY, [f"goal={goal}"]).goal == goal
    assert (
        Config.load(TOY, ["reward.combine={by: worst}"]).dump() == Config.load(TOY, ["reward.combine.by=worst"]).dump()
    )


def test_every_mistake_is_named() -> None:
    with pytest.raises(ConfigError) as caught:
        Config.load(TOY, ["learner.epochs=0", "learner.clip=-1", "loop.rounds=0"])
    assert [line.split(":")[0] for line in str(caught.value).splitlines()] == [
        "learner.epochs",
        "learner.clip",
        "loop.rounds",
    ]


def test_an_unknown_preset_gets_the_nearest_name() -> None:
    with pytest.raises(ConfigError, match="did you mean 'control/pendulum'"):
        Config.load("control/pendlum")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("task: {kind: control}\ntask: {kind: reviews}\n", "'task' is given twice"),
        ("task: [", "not valid YAML"),
        ("just words", "expected settings"),
        ("task: !!python/object/apply:os.system ['true']", "not valid YAML"),
        ("task: {kind: 'os:system'}\nreward: {kind: mlp}\nlearner: {kind: control}", "unknown task kind"),
    ],
)
def test_a_bad_file_is_refused_and_runs_no_code(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        Config.load(path)


def test_a_mistake_in_a_file_is_told_with_its_line_and_one_in_the_command_without(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("task:\n  kind: point\nreward: {kind: mlp}\nlearner:\n  kind: control\n  polcy: 3\n")
    with pytest.raises(ConfigError) as caught:
        Config.load(path, ["loop.rounds=x"])
    assert str(caught.value).splitlines() == [
        f"{path}, line 6: learner.polcy: unknown setting; did you mean 'policy'?",
        "loop.rounds: expected integer, got 'x'",
    ]
    path.write_text("task: {kind: point}\nreward: [a\nlearner: 3")
    with pytest.raises(ConfigError, match=r"mine\.yaml, line 3: not valid YAML"):
        Config.load(path)


def test_a_missing_extra_names_the_command_that_installs_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(_: str) -> object:
        raise ModuleNotFoundError("No module named 'stable_baselines3'", name="stable_baselines3")

    monkeypatch.setattr("prefrl.components.import_module", absent)
    with pytest.raises(ConfigError, match=r"pip install 'prefrl\[control\]'"):
        settings_class("learners", "sb3")


def test_the_reward_model_follows_the_learner_to_its_device() -> None:
    config = Config.load(TOY)

    def devices(device: torch.device) -> set[str]:
        learner: Any = config.learner.model_copy(update={"device": device})
        task: Any = config.task
        moved = config.model_copy(update={"learner": learner})
        model = moved.build_reward(task.build(), np.random.default_rng(0))
        tensors = [x for x in model.state().values() if isinstance(x, torch.Tensor)]
        return {x.device.type for x in (*tensors, *model.parameters())}

    assert both(devices) == ({"cpu"}, {ELSEWHERE.type})
