"""What can come to nothing is refused before the first round, and leaves a folder free for other settings."""

from pathlib import Path

import numpy as np
import pytest
from runs import finish

from prefrl import Config, Run
from prefrl.components import ConfigError
from prefrl.config import _check_holds
from prefrl.envs.text import Reviews
from prefrl.exchange.ports import import_judgements
from prefrl.improve.dpo import DPOSettings
from prefrl.improve.sft import SFTSettings
from prefrl.judgements import Comparison, Demonstration
from prefrl.store import Store
from prefrl.types import Query, Response, Segment

CLONE = ("learner.kind=clone", "loop.rounds=1")
LITTLE = ("learner.cloning_epochs=1", "learner.evaluation_episodes=1")


def shown(folder: Path, one: Segment | Response) -> None:
    with Store[Segment | Response](folder) as store:
        query = Query((one,))
        store.ask([query])
        store.answer([Demonstration(query.id, one.id, "ann")])


def segment(steps: int = 3) -> Segment:
    return Segment(np.zeros((steps, 2), np.float32), np.zeros((steps, 2), np.float32), "ann/0", 0)


def test_a_folder_of_another_kind_is_refused_and_stays_free(tmp_path: Path) -> None:
    shown(tmp_path, Response("The film was", " fine."))
    config = Config.load("control/toy", [*CLONE, "loop.labels=0"])
    with pytest.raises(ConfigError, match=r"holds responses, and .* is learned from segments: choose another folder"):
        Run(config, tmp_path)
    assert not (tmp_path / "config.yaml").exists()


def test_a_folder_of_control_is_refused_for_text(tmp_path: Path, toy_reviews: Reviews) -> None:
    shown(tmp_path, segment())
    with Store[Response](tmp_path) as store, pytest.raises(ConfigError, match=r"holds segments, .* from responses"):
        _check_holds(store, toy_reviews)


def test_settings_that_cannot_be_built_do_not_keep_a_folder_of_judgements_from_others(tmp_path: Path) -> None:
    shown(tmp_path, segment())
    with pytest.raises(ConfigError, match="there is no nobody"):
        Run(Config.load("control/toy", ["labeler.kind=expert", "labeler.policy=nobody"]), tmp_path)
    finish(Config.load("control/toy", [*CLONE, *LITTLE, "loop.labels=0"]), tmp_path)
    assert (tmp_path / "summary.json").exists()


@pytest.mark.parametrize("labels", [0, 8])
def test_a_clone_without_anything_shown_is_refused_before_it_acts(tmp_path: Path, labels: int) -> None:
    """Also where somebody judges: it learns nothing from that."""
    config = Config.load("control/toy", [*CLONE, f"loop.labels={labels}"])
    with pytest.raises(ConfigError, match=r"clone learns from demonstrations: set labeler\.kind=expert"):
        Run(config, tmp_path)


def test_a_clone_is_asked_about_where_nobody_shows(tmp_path: Path) -> None:
    """`prefrl label RUN` judges what a clone does: nothing is learned there."""
    with Store[Segment](tmp_path) as store:
        Config.load("control/toy", CLONE).build(store)


def test_a_demonstrator_without_anything_shown_is_refused(tmp_path: Path) -> None:
    own = ["labeler.expert.episodes=0", "learner.clone.epochs=0", "learner.clone.keep=0"]
    config = Config.load("control/pendulum-adversarial", own)
    with pytest.raises(ConfigError, match=r"answers with what was shown, and nothing was: set labeler\.data"):
        Run(config, tmp_path / "nothing")
    shown(tmp_path / "store", Segment(np.zeros((90, 3), np.float32), np.zeros((90, 1), np.float32), "ann/0", 0))
    with Run(config, tmp_path / "store") as run:
        assert run.loop.round == -1


@pytest.mark.parametrize(
    ("observations", "action", "says"),
    [
        (2, 9.0, r"has the action \[9\. 0\.\] in step 2, outside of the bounds"),
        (5, 0.0, r"has observations and actions of \(5, 2\) numbers a step, but .* has \(2, 2\)"),
    ],
)
def test_imported_behaviour_that_does_not_fit_the_task_is_named_before_anything_is_asked(
    tmp_path: Path, observations: int, action: float, says: str
) -> None:
    seen, done = np.zeros((6, observations), np.float32), np.zeros((6, 2), np.float32)
    done[5, 0] = action
    np.savez(tmp_path / "x.npz", observations=seen, actions=done, lengths=[3, 3])
    with Store[Segment](tmp_path / "run") as store:
        import_judgements(tmp_path / "x.npz", store)
    bad = 2 if action else 1
    with pytest.raises(
        ConfigError, match=f"run: the demonstration 'episode {bad}/.*' from step 0, by 'file:.*', {says}"
    ):
        Run(Config.load("control/toy", ["loop.labels=8"]), tmp_path / "run")
    assert not (tmp_path / "run/config.yaml").exists()


def test_fine_tuning_needs_something_shown_or_judged_and_dpo_does_not_say_so(toy_reviews: Reviews) -> None:
    one = SFTSettings(device="cpu").build(toy_reviews, np.random.default_rng(0))
    with pytest.raises(ConfigError, match="sft learns what was shown and the better responses"):
        one.check_shown(shows=False, judged=False)
    one.check_shown(shows=True, judged=False)
    one.check_shown(shows=False, judged=True)
    DPOSettings(device="cpu").build(toy_reviews, np.random.default_rng(0)).check_shown(shows=False, judged=False)


def test_what_was_judged_before_counts_for_those_who_learn_from_it(tmp_path: Path) -> None:
    few = ["learner.kind=cpl", "loop.labels=0", *LITTLE]
    with pytest.raises(ConfigError, match=r"cpl learns from segments: set learner\.data"):
        Run(Config.load("control/toy", few), tmp_path)
    with Store[Segment](tmp_path) as store:
        query = Query((segment(3), segment(4)))
        store.ask([query])
        store.answer([Comparison(query.id, 1.0, "ann")])
    with Run(Config.load("control/toy", few), tmp_path) as run:
        assert run.loop.round == -1


def test_an_oracle_is_refused_where_nothing_has_a_gold(tmp_path: Path) -> None:
    prompts = tmp_path / "prompts.jsonl"
    prompts.write_text("".join(f'{{"prompt": "Tell me about number {i}."}}\n' for i in range(20)))
    config = Config.load("text/replies", [f"task.prompts={prompts}", "labeler.kind=oracle", "loop.labels=2"])
    with pytest.raises(ConfigError, match=r"oracle goes by gold, and there is none for what is written to these prom"):
        Run(config, tmp_path / "run")
