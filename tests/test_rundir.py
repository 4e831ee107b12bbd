import json
import shutil
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from runs import copied, exit_code, finish, tiny

from prefrl import Config
from prefrl.components import ConfigError
from prefrl.rundir import Run, RunError, _lasting, open_saved, save_reward
from prefrl.stages import label, with_reward
from prefrl.storage.checkpoints import load_state
from prefrl.storage.files import DamagedError
from prefrl.store import Store
from prefrl.types import Segment

TOYS = ["control/toy", "text/toy"]
SUMMARY = {
    "task", "kind", "seed", "rounds", "gold_before", "gold_after", "gold_best", "labels", "steps", "reward_accuracy",
    "kl", "fluency_before", "fluency_after", "seconds", "versions",
    "source", "overrides", "made_with", "steps_per_second", "people_seconds",
}  # fmt: skip


def weights(folder: Path) -> dict[str, bytes]:
    """The files that hold what was learned, of the last checkpoint."""
    last = max((folder / "checkpoints").iterdir())
    return {p.name: p.read_bytes() for p in sorted(last.glob("*.safetensors"))}


def numbers(folder: Path) -> list[dict[str, float]]:
    """The metrics without the times."""
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in row.items() if not k.startswith("seconds/")} for row in rows]


@pytest.mark.parametrize("name", TOYS)
def test_a_run_leaves_the_files_that_the_design_names(
    name: str, finished_tiny: dict[str, Path], tmp_path: Path
) -> None:
    folder, config = copied(finished_tiny[name], tmp_path / "run"), tiny(name)
    with Run(config, folder) as run:
        run.report()
    assert [row["round"] for row in numbers(folder)] == list(range(config.loop.rounds + 1))
    found = {p.name for p in folder.iterdir()}
    assert found >= {"config.yaml", "metrics.jsonl", "summary.json", "store.db", "report.html", "checkpoints", "gold"}
    rows = [json.loads(line) for line in (folder / "probes.jsonl").read_text().splitlines()]
    assert [row["round"] for row in rows] == list(range(1, config.loop.rounds + 1))
    assert {len(row["scores"]) for row in rows} == {len(rows[0]["candidates"])}
    assert any("tfevents" in f for f in found)
    assert ("blobs" in found) == name.startswith("control")
    summary = json.loads((folder / "summary.json").read_text())
    assert set(summary) == SUMMARY
    assert set(summary["seconds"]) == {"sample", "label", "fit", "improve", "evaluate", "total"}
    assert summary["labels"]["answered"] == summary["labels"]["asked"] > 0
    assert len(list((folder / "checkpoints").iterdir())) == 2


@pytest.mark.parametrize("name", TOYS)
def test_a_run_stopped_between_rounds_ends_in_the_same_bytes(
    name: str, finished_tiny: dict[str, Path], tmp_path: Path
) -> None:
    with Run(tiny(name), tmp_path / "parts", asked=(name, ["loop.rounds=2"])) as run:
        rounds = iter(run)
        next(rounds), next(rounds)
    with Run.resume(tmp_path / "parts") as run:
        assert run.notes == ["going on after round 1"]
        assert [r.number for r in run] == list(range(2, run.config.loop.rounds + 1))
    summary = json.loads((tmp_path / "parts/summary.json").read_text())
    assert (summary["source"], summary["overrides"]) == (name, ["loop.rounds=2"])
    assert len(summary["made_with"]) == 1  # two processes with the same code on the same machine
    assert weights(tmp_path / "parts") == weights(finished_tiny[name])
    assert numbers(tmp_path / "parts") == numbers(finished_tiny[name])
    assert (tmp_path / "parts/probes.jsonl").read_bytes() == (finished_tiny[name] / "probes.jsonl").read_bytes()


@pytest.mark.parametrize(("labeler", "matters"), [("oracle", False), ("terminal", False), ("judge", True)])
def test_the_words_of_the_goal_are_a_setting_only_where_a_model_reads_them(labeler: str, matters: bool) -> None:
    old, new = (tiny("text/toy", f"labeler.kind={labeler}", f"goal={goal}") for goal in ("''", "Which is kinder?"))
    assert (_lasting(old) != _lasting(new)) is matters


def test_a_run_may_be_shown_elsewhere_from_one_start_to_the_next() -> None:
    assert _lasting(tiny("control/toy")) == _lasting(tiny("control/toy", "track=wandb"))


DYING = """
import itertools, os, signal, sys, torch
from prefrl import Config, Run
from prefrl.storage.files import DamagedError
from prefrl.store import Store
from prefrl.types import Segment

torch.set_num_threads(1)
name, folder, moment = sys.argv[1:]
calls = itertools.count(1)

def dying(method, last, after):
    def wrapped(*arguments):
        number = next(calls)  # of this call alone: blobs are filed by several threads at once
        if number == last and not after:
            os.kill(os.getpid(), signal.SIGKILL)
        method(*arguments)
        if number == last:
            os.kill(os.getpid(), signal.SIGKILL)
    return wrapped

place, word, last, after = {
    "amid the blobs": (Store, "_file_one", 30, True),
    "asked": (Store, "ask", 2, True),
    "answered": (Store, "answer", 2, True),
    "improved": (Run, "_record", 3, False),
    "before the checkpoint": (Run, "_checkpoint", 3, False),
}[moment]
setattr(place, word, dying(getattr(place, word), last, after))
with Run(Config.load(name), folder) as run:
    list(run)
"""


def write_down(config: Config, folder: Path) -> str:
    (folder / "config.yaml").write_text(config.dump())
    return str(folder / "config.yaml")


@pytest.mark.parametrize(
    ("name", "moment"),
    [
        ("control/toy", "amid the blobs"),
        ("control/toy", "asked"),
        ("control/toy", "answered"),
        ("control/toy", "improved"),
        ("control/toy", "before the checkpoint"),
        ("text/toy", "answered"),
        ("text/toy", "before the checkpoint"),
    ],
)
def test_a_run_killed_at_any_moment_ends_in_the_same_bytes(
    name: str, moment: str, finished_tiny: dict[str, Path], tmp_path: Path
) -> None:
    config = write_down(tiny(name), tmp_path)
    assert exit_code(DYING, config, str(tmp_path / "killed"), moment) == -signal.SIGKILL
    finish(tiny(name), tmp_path / "killed")
    assert weights(tmp_path / "killed") == weights(finished_tiny[name])
    assert numbers(tmp_path / "killed") == numbers(finished_tiny[name])
    assert (tmp_path / "killed/probes.jsonl").read_bytes() == (finished_tiny[name] / "probes.jsonl").read_bytes()
    with Store[Any](tmp_path / "killed", write=False) as a, Store[Any](finished_tiny[name], write=False) as b:
        assert a.answers() == b.answers()


def test_a_damaged_checkpoint_is_passed_over_and_named(finished_tiny: dict[str, Path], tmp_path: Path) -> None:
    copied(finished_tiny["control/toy"], tmp_path / "run")
    broken = max((tmp_path / "run/checkpoints").iterdir()) / "learner.safetensors"
    broken.write_bytes(broken.read_bytes()[:-1])
    with Run.resume(tmp_path / "run") as run:
        assert "learner.safetensors" in run.notes[0]
        assert run.notes[1] == f"going on after round {run.config.loop.rounds - 1}"
        list(run)
    assert weights(tmp_path / "run") == weights(finished_tiny["control/toy"])


def test_no_good_checkpoint_is_an_error_that_says_why(toy_run: Path) -> None:
    for manifest in (toy_run / "checkpoints").rglob("MANIFEST.json"):
        manifest.unlink()
    with pytest.raises(RunError, match="no checkpoint that can be used"):
        Run.resume(toy_run)
    with Store(toy_run):
        """The failed attempt let go of the store."""


def test_a_finished_run_is_left_as_it_is(toy_run: Path) -> None:
    before = weights(toy_run)
    finish(Config.load("control/toy"), toy_run)
    assert weights(toy_run) == before
    assert len(numbers(toy_run)) == Config.load("control/toy").loop.rounds + 1


def test_a_folder_with_another_run_or_other_things_is_refused(toy_run: Path, tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"fitting\.epochs is 60 there, 6 here"):
        Run(Config.load("control/toy", ["fitting.epochs=6"]), toy_run)
    (tmp_path / "things").mkdir()
    (tmp_path / "things/letter.txt").write_text("dear")
    with pytest.raises(RunError, match="not empty"):
        Run(Config.load("control/toy"), tmp_path / "things")
    with pytest.raises(RunError, match=r"expected a file config\.yaml"):
        Run.resume(tmp_path / "nothing")


def test_a_checkpoint_holds_all_that_is_needed_to_use_it(toy_run: Path, tmp_path: Path) -> None:
    shutil.copytree(max((toy_run / "checkpoints").iterdir()), tmp_path / "alone")
    saved = open_saved(tmp_path / "alone")
    assert saved.config == Config.load("control/toy")
    assert load_state(saved.folder, "learner")["steps"][0] > 0


def test_a_start_that_failed_does_not_block_the_folder(tmp_path: Path) -> None:
    with pytest.raises(ConfigError):
        Run(Config.load("control/toy", ["task.segment_steps=41"]), tmp_path / "run")
    with Run(tiny("control/toy"), tmp_path / "run") as run:
        next(iter(run))


def test_labels_are_not_added_to_the_folder_of_a_run(toy_run: Path) -> None:
    before = (toy_run / "config.yaml").read_bytes()
    with pytest.raises(RunError, match="asks for its own labels"):
        label(Config.load("control/toy", ["loop.labels=7"]), toy_run)
    assert (toy_run / "config.yaml").read_bytes() == before


def test_a_run_against_a_saved_reward_keeps_it_and_starts_from_it_whenever(
    finished_tiny: dict[str, Path], tmp_path: Path
) -> None:
    config, first = tiny("control/toy", "loop.rounds=1"), finished_tiny["control/toy"]
    finish(tiny("control/toy", "loop.rounds=1", "seed=1"), tmp_path / "second")
    config = with_reward(config, first)
    Run(config, tmp_path / "policy", first).close()  # stopped before anything was done
    with Run.resume(tmp_path / "policy") as run:
        assert run.loop.reward.fitted
        *_, last = run
    assert last.metrics["steps/learn"] > 0
    with pytest.raises(RunError, match="another reward model"):
        Run(config, tmp_path / "policy", tmp_path / "second")
    other = with_reward(tiny("control/toy", "task.horizon=30"), first)
    with pytest.raises(RunError, match=r"another task \(task\.horizon is 40 there, 30 here\)"):
        Run(other, tmp_path / "other", first)


def test_only_how_members_are_put_together_can_be_chosen_for_a_reward_that_is_fitted(
    finished_tiny: dict[str, Path], tmp_path: Path
) -> None:
    config, fitted = tiny("control/toy", "loop.rounds=1"), finished_tiny["control/toy"]
    cautious = with_reward(config, fitted, ["reward.combine.by=lower", "reward.combine.caution=2", "learner.gamma=0.9"])
    with Run(config=cautious, folder=tmp_path / "policy", reward=fitted) as run:
        segments = run.loop.learner.sample(4, np.random.default_rng(0))
        members = run.loop.reward.member_scores(segments)
        assert (run.loop.reward.score(segments) < members.mean(0)).all()
    with pytest.raises(ConfigError, match=r"reward\.members: .* was fitted with 3, and 4 needs a fit of its own"):
        with_reward(config, fitted, ["reward.members=4"])


def test_a_kept_reward_that_was_changed_is_refused(tmp_path: Path) -> None:
    config, kept = Config.load("control/toy"), tmp_path / "run/reward"
    with Store[Segment](tmp_path / "other") as store:
        save_reward(kept, config, config.build(store).reward)
    (tmp_path / "run/config.yaml").write_text(config.dump())
    Run(config, tmp_path / "run").close()
    saved = next(kept.glob("*.safetensors"))
    data = saved.read_bytes()
    saved.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    with pytest.raises(DamagedError, match="it was changed"):
        Run(config, tmp_path / "run")


@pytest.mark.parametrize("name", ["what?", "100%", "a#b", "ü n", "[red]x"])
def test_a_folder_may_have_any_name(name: str, tmp_path: Path) -> None:
    finish(tiny("control/toy", "loop.rounds=1"), tmp_path / name)
    assert [p.name for p in tmp_path.iterdir()] == [name]
    with Store[Any](tmp_path / name, write=False) as store:
        assert store.counts()["answered"] == 24


def test_the_newest_checkpoint_is_the_one_with_the_highest_number(toy_run: Path) -> None:
    folder = toy_run / "checkpoints"
    (folder / "round-0003").rename(folder / "round-9999")
    (folder / "round-0004").rename(folder / "round-10000")
    assert open_saved(toy_run).folder.name == "round-10000"
