"""Preference data from files alone: fitted with one command, without a gold, a simulator's rollouts or a labeler."""

import gzip
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from prefrl import Config
from prefrl.config import presets
from prefrl.envs.texts import Texts, TextsSettings
from prefrl.evaluate.card import ReportCard
from prefrl.exchange.layout import Which
from prefrl.exchange.source import open_judgements
from prefrl.fit.trainer import NothingToFit
from prefrl.judgements import Ranking
from prefrl.stages import fit_reward, shrink
from prefrl.store import Store
from prefrl.types import Query, Response, Segment

TOY = {
    "task": {"kind": "point"},
    "reward": {"kind": "mlp", "members": 1, "hidden": [8]},
    "fitting": {"epochs": 100, "learning_rate": 0.01},
    "learner": {"kind": "control"},
}
OFFLINE = [name for name in presets() if not Config.load(name).loop.labels]


def texts_config(path: Path | None = None) -> Config:
    config = Config.load("text/replies", ["fitting.epochs=2", "reward.members=1"])
    return shrink(config).model_copy(update={"task": small(path)})


def small(prompts: Path | None = None, response_tokens: int = 8) -> TextsSettings:
    return TextsSettings(prompts=prompts, layers=1, width=16, heads=2, response_tokens=response_tokens)


def pairs(path: Path, labels: list[float], size: int = 2) -> Path:
    """Pairs of segments in which the first observation tells which one the human wants; the script wants the other."""
    rng, n = np.random.default_rng(0), len(labels)
    first, second = rng.normal(size=(2, n, 5, size)).astype(np.float32)
    second[..., 0] += 3 * (2 * np.array(labels)[:, None] - 1)
    arrays = {"obs_1": first, "obs_2": second, "label_human": np.array(labels), "label_script": 1 - np.array(labels)}
    actions = {f"action_{side}": rng.normal(size=(n, 5, 2)).astype(np.float32) for side in "12"}
    np.savez(path, **{f"train_{name}": value for name, value in (arrays | actions).items()})
    return path


def rows(path: Path, *given: Mapping[str, object]) -> Path:
    path.write_bytes(gzip.compress("".join(json.dumps(row) + "\n" for row in given).encode()))
    return path


def test_a_file_of_segment_pairs_fits_what_the_chosen_labeler_said(tmp_path: Path) -> None:
    path, config = pairs(tmp_path / "x.npz", [0.0, 1.0] * 30), Config.parse(TOY)
    human, notes = fit_reward(config, path, tmp_path / "human")
    script, _ = fit_reward(config, path, tmp_path / "script", Which(("script",)))
    assert human.metrics["comparisons"] == script.metrics["comparisons"] == 60
    assert human.metrics["accuracy_held_out"] > 0.9
    assert "60 x label by a script" in notes[0]
    graded = ReportCard.model_validate_json((tmp_path / "human/card.json").read_bytes())
    assert graded.accuracy.value == human.metrics["accuracy_held_out"]
    assert f"of {graded.about.comparisons} held-out comparisons" in (tmp_path / "human/README.md").read_text()
    ask = [Segment(np.full((5, 2), (x, 0), np.float32), np.zeros((5, 2), np.float32), str(x), 0) for x in (-2, 2)]
    for name, sign in (("human", 1), ("script", -1)):
        low, high = saved(tmp_path / name).score(ask)
        assert sign * (high - low) > 0


def saved(folder: Path) -> Any:
    from prefrl.rundir import open_saved

    opened = open_saved(folder)
    task: Any = opened.config.task
    return opened.reward(task.build())


def test_a_store_can_be_narrowed_to_some_labelers(tmp_path: Path) -> None:
    query = Query((Response("p", "a"), Response("p", "b")))
    with Store[Response](tmp_path / "store") as store:
        store.ask([query])
        store.answer([Ranking(query.id, (0, 1), "ann"), Ranking(query.id, (1, 0), "bob")])
    task = small().build()
    with open_judgements(tmp_path / "store", task) as (everybody, _):
        assert len(everybody.judged()) == 2
    with open_judgements(tmp_path / "store", task, Which(("bob",))) as (narrowed, _):
        assert [j.judgement.labeler for j in narrowed.judged()] == ["bob"]
    with (
        pytest.raises(ValueError, match="no judgement by eve; labelers there: ann, bob"),
        open_judgements(tmp_path / "store", task, Which(("eve",))),
    ):
        pass
    with (
        pytest.raises(ValueError, match="knows no split"),
        open_judgements(tmp_path / "store", task, Which((), "train")),
    ):
        pass


def test_judgements_of_another_task_are_refused(tmp_path: Path) -> None:
    wide, texts = pairs(tmp_path / "x.npz", [0.0, 1.0], size=3), rows(tmp_path / "x.jsonl.gz", RANKED)
    with pytest.raises(ValueError, match=r"of \(3, 2\) numbers a step, but point has \(2, 2\)"):
        fit_reward(Config.parse(TOY), wide, tmp_path / "out")
    with pytest.raises(ValueError, match="are of responses, but point is a task of kind 'control'"):
        fit_reward(Config.parse(TOY), texts, tmp_path / "out")
    with pytest.raises(ValueError, match="are of segments, but texts is a task of kind 'text'"):
        fit_reward(texts_config(), wide, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_nothing_but_ties_is_nothing_to_fit(tmp_path: Path) -> None:
    with pytest.raises(NothingToFit, match=r"all 3 .* are ties"):
        fit_reward(Config.parse(TOY), pairs(tmp_path / "x.npz", [0.5] * 3), tmp_path / "out")


def test_one_judgement_fits_and_holds_nothing_out(tmp_path: Path) -> None:
    fitted, _ = fit_reward(Config.parse(TOY), pairs(tmp_path / "x.npz", [1.0]), tmp_path / "out")
    assert (fitted.metrics["comparisons"], fitted.metrics["held_out"]) == (1, 0)
    assert "accuracy_held_out" not in fitted.metrics


# --- text ---------------------------------------------------------------------------------------------------------

RANKED: dict[str, object] = {"prompt": "p", "responses": ["good", "bad", "ugly"], "ranks": [0, 1, 2]}


def test_a_file_of_every_kind_of_judgement_is_fitted_at_once(tmp_path: Path) -> None:
    texts: dict[str, object] = {"prompt": "q", "responses": ["good", "bad", "ugly"]}
    given: list[Mapping[str, object]] = [
        RANKED,
        {"prompt": "r", "chosen": "good", "rejected": "bad"},
        texts | {"best": 0},
        texts | {"ratings": [4, 1, 0], "scale": 5, "labeler": "ann"},
        {"prompt": "s", "responses": ["bad", "good"], "preference": 0.1},
    ]
    fitted, _ = fit_reward(texts_config(), rows(tmp_path / "x.jsonl.gz", *given), tmp_path / "out")
    assert fitted.metrics["judgements"] == 5
    assert np.isfinite(saved(tmp_path / "out").score([Response("p", "good")])).all()


def test_a_task_of_texts_knows_no_gold_and_is_the_same_whatever_the_seed() -> None:
    a, b = small().build(), small().build()
    assert all((x == y).all() for x, y in zip(a.model().parameters(), b.model().parameters(), strict=True))
    assert np.isnan(a.gold([Response("p", "a")])).all()
    assert a.fluency([Response("p", "a")]) is None
    ids = a.tokenizer.encode("ü \u2603")
    assert a.tokenizer.decode(ids, skip_special_tokens=True) == "ü \u2603"
    assert len(ids) == 1 + len("ü \u2603".encode())


def test_prompts_to_learn_on_and_to_evaluate_on_are_apart(tmp_path: Path, rng: np.random.Generator) -> None:
    path = rows(tmp_path / "x.jsonl.gz", *(RANKED | {"prompt": f"p{i}"} for i in range(64)))
    task = small(path).build()
    learn, evaluate = set(task.prompts(400, rng)), set(task.evaluation_prompts(400, rng))
    assert learn | evaluate == {f"p{i}" for i in range(64)}
    assert not learn & evaluate
    with pytest.raises(ValueError, match=r"task\.prompts: there is no prompt to learn on"):
        small().build().prompts(1, rng)


def test_a_model_of_ones_own_is_loaded_from_its_folder(tmp_path: Path) -> None:
    made = small().build()
    made.model().save_pretrained(tmp_path / "model")
    made.tokenizer.save_pretrained(tmp_path / "model")
    loaded: Texts = TextsSettings(model=tmp_path / "model").build()
    assert all((x == y).all() for x, y in zip(loaded.model().parameters(), made.model().parameters(), strict=True))
    for folder in (tmp_path / "none", tmp_path):
        with pytest.raises(ValueError, match=r"task\.model"):
            TextsSettings(model=folder).build()


# --- presets ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", OFFLINE)
def test_a_preset_for_files_asks_nobody_and_round_trips(name: str) -> None:
    config = Config.load(name)
    assert config.loop.labels == 0
    assert Config.parse(yaml.safe_load(config.dump())) == config


def test_a_policy_improves_on_a_reward_fitted_from_a_file(tmp_path: Path) -> None:
    from prefrl.rundir import Run
    from prefrl.stages import with_reward

    given = [RANKED | {"prompt": f"p{i}"} for i in range(32)]
    path = rows(tmp_path / "x.jsonl.gz", *given)
    config = texts_config(path)
    fit_reward(config, path, tmp_path / "reward")
    with Run(with_reward(config, tmp_path / "reward"), tmp_path / "policy", tmp_path / "reward") as run:
        metrics = [round.metrics for round in run][-1]
        run.report()
    assert np.isfinite(metrics["evaluate/learned"])
    assert np.isnan(metrics["evaluate/gold"])
    assert run.summary["gold_after"] is None


def test_a_file_is_read_once_and_no_store_is_made_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = rows(tmp_path / "x.jsonl.gz", RANKED | {"labeler": "ann"})
    read: list[Path] = []
    whole = Path.open

    def watched(self: Path, *arguments: Any, **named: Any) -> Any:
        read.extend([self] if self == path else [])
        return whole(self, *arguments, **named)

    monkeypatch.setattr(Path, "open", watched)
    monkeypatch.setattr("prefrl.store.Store.__init__", lambda *_, **__: pytest.fail("a store was opened"))
    fitted, _ = fit_reward(texts_config(), path, tmp_path / "out")
    assert fitted.metrics["judgements"] > 0
    assert len(read) == 1
