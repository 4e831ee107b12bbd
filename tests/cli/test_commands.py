"""What a person meets at the command line: the commands as a shell runs them, and what they say."""

import contextlib
import json
import re
import signal
import subprocess
import sys
import time
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
from runs import TINY
from shell import Shell
from text_models import classifier, gpt2

from prefrl import Config
from prefrl.cli.console import interrupts
from prefrl.cli.main import main
from prefrl.components import TABLE, kinds, plugins
from prefrl.envs.text import Reviews
from prefrl.improve.control import ControlLearnerSettings
from prefrl.improve.text import TextLearnerSettings
from prefrl.judgements import Ranking
from prefrl.store import Store
from prefrl.types import Query, Segment

SMALL = " ".join((*TINY["control/toy"], "loop.rounds=1"))
"""Settings with which `prefrl run control/toy` takes little time."""


def test_the_three_uses_stand_alone_for_control(prefrl: Shell) -> None:
    assert prefrl("label control/toy loop.labels=30 --out labels") == 0
    assert "30 of 30 queries answered" in prefrl.out
    assert prefrl("fit labels --out reward fitting.epochs=20") == 0
    assert "accuracy" in prefrl.out
    assert prefrl(f"improve control/toy --reward reward --out policy {SMALL}") == 0
    assert prefrl("evaluate policy") == 0
    assert "gold" in prefrl.out
    summary = json.loads(Path("policy/summary.json").read_text())
    assert summary["labels"] == {"asked": 0, "answered": 0, "skipped": 0}
    assert summary["steps"]["learn"] > 0
    assert prefrl("label policy --out more loop.labels=5") == 0  # ask about the improved policy
    assert "5 of 5" in prefrl.out


@pytest.mark.slow
def test_a_reward_model_is_graded_on_what_its_fit_left_out(prefrl: Shell) -> None:
    assert prefrl(f"run control/toy --out run {SMALL} loop.labels=40 fitting.held_out=0.3") == 0
    at_the_end = json.loads(Path("run/card.json").read_text())
    assert "How good is the reward model?" in Path("run/report.html").read_text("utf-8")
    assert prefrl("evaluate --reward run --json card.json --html card.html") == 0
    assert "held-out comparisons" in prefrl.out
    again = json.loads(Path("card.json").read_text())
    again["seconds"] = at_the_end["seconds"]  # the only thing that two times differ in
    assert again == at_the_end
    assert "<svg" in Path("card.html").read_text("utf-8")


@pytest.mark.usefixtures("toy_run")
def test_a_reward_model_is_graded_on_other_judgements(prefrl: Shell) -> None:
    assert prefrl("label control/toy loop.labels=30 seed=5 --out labels") == 0
    assert prefrl("fit labels --out reward fitting.epochs=20 fitting.held_out=0.3") == 0
    assert prefrl("evaluate --reward reward") == 2
    assert "--data" in prefrl.err
    assert prefrl("evaluate --reward run --data labels") == 0
    assert "30 comparisons (all there are" in prefrl.out
    assert prefrl("evaluate --reward reward --data labels --held-out --json part.json") == 0
    assert 0 < json.loads(Path("part.json").read_text())["about"]["judgements"] < 30
    assert prefrl("evaluate --reward run --rewardbench bench") == 2
    assert "pairs of texts" in prefrl.err
    assert prefrl("evaluate") == 2


def keep_rankings(folder: Path, held_out: int, trained: int) -> None:
    """Fill a folder with rankings of which so many will be held out: chosen by their ids, as a fit does.

    The candidates are fixed numbers: what a policy does, and so every id, differs between machines in the last bit.
    """
    config = Config.load("control/toy")
    resting = [np.full((5, 2), number / 300, np.float32) for number in range(300)]
    segments = [Segment(where, np.zeros_like(where), str(number), 0) for number, where in enumerate(resting)]
    queries = [Query(tuple(segments[i : i + 3])) for i in range(0, 300, 3)]
    is_out = [int(query.id[:8], 16) < config.fitting.held_out * 2**32 for query in queries]
    chosen = [query for query, out in zip(queries, is_out, strict=True) if out][:held_out]
    chosen += [query for query, out in zip(queries, is_out, strict=True) if not out][:trained]
    with Store[Segment](folder) as store:
        store.ask(chosen)
        store.answer([Ranking(query.id, (0, 1, 2), "me") for query in chosen])
    (folder / "config.yaml").write_text(config.dump())


def test_a_fit_says_how_little_was_held_out(prefrl: Shell) -> None:
    keep_rankings(Path("labels"), held_out=2, trained=4)
    assert prefrl("fit labels --out reward fitting.epochs=1") == 0
    assert "only 6 comparisons were held out" in prefrl.out  # three to a ranking
    assert prefrl("fit labels --out alone fitting.epochs=1 fitting.held_out=0") == 0
    assert "nothing was held out" in prefrl.out


@pytest.mark.slow
def test_the_scores_of_texts_are_written_as_rewardbench_does(prefrl: Shell) -> None:
    assert prefrl("label text/toy loop.labels=12 --out labels") == 0
    assert prefrl("fit labels --out reward") == 0
    assert prefrl("evaluate --reward reward --data labels --rewardbench bench --json card.json") == 0
    written = json.loads(Path("bench/eval-set-scores/reward.json").read_text())
    card = json.loads(Path("card.json").read_text())
    assert len(written["results"]) == card["accuracy"]["count"]
    assert written["chat_template"] == "none"
    assert card["lengths"]["unit"] == "tokens"


def test_rewardbench_is_told_which_reward_model_reads_by_a_chat_template(prefrl: Shell, toy_reviews: Reviews) -> None:
    template = "{% for m in messages %}{{ m.role }}: {{ m.content }}{{ eos_token }}{% endfor %}"
    classifier(toy_reviews, Path("chat"), gpt2().config, chat_template=template)
    assert prefrl("label text/toy loop.labels=12 --out labels") == 0
    assert prefrl("fit labels --out reward reward.checkpoint=chat reward.members=1") == 0
    assert prefrl("evaluate --reward reward --data labels --rewardbench bench") == 0
    assert json.loads(Path("bench/eval-set-scores/reward.json").read_text())["chat_template"] == "tokenizer"


def test_the_three_uses_stand_alone_for_text(prefrl: Shell) -> None:
    assert prefrl("label text/toy loop.labels=12 --out labels") == 0
    assert prefrl("export labels --to preferences.jsonl") == 0
    rows = [json.loads(line) for line in Path("preferences.jsonl").read_text().splitlines()]
    assert all(set(row) == {"prompt", "chosen", "rejected"} for row in rows)
    assert prefrl("fit preferences.jsonl --config text/toy --out reward") == 0
    assert prefrl("improve text/toy --reward reward --out policy loop.rounds=1") == 0
    assert prefrl("evaluate policy") == 0
    assert "fluency" in prefrl.out


def test_a_bundle_moves_labels_between_folders(prefrl: Shell) -> None:
    assert prefrl("label control/toy loop.labels=6 --out labels") == 0
    assert prefrl("export labels --to bundle --form bundle") == 0
    assert prefrl("import bundle --out copy") == 0
    assert "6 answers" in prefrl.out
    assert prefrl("fit copy --config control/toy --out reward") == 0
    assert prefrl("export labels --to out.jsonl") == 2
    assert "--form bundle" in prefrl.err


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("run control/toy --out run learner.epoch=3", "learner.epoch: unknown setting; did you mean 'epochs'?"),
        ("run control/tay --out run", "no such preset or file; did you mean 'control/toy'?"),
        ("run control/toy --out run task.segment_steps=41", "a segment of 41 steps is longer than an episode of 40"),
        ("run control/pendulum --out run task.env=Pendulam-v1", "Pendulum-v1"),
        ("evaluate .", "holds neither a run"),
        ("fit . --out reward", "--config"),
        ("describe contrl", "did you mean 'control'?"),
        ("describe floow", "did you mean 'flow'?"),
    ],
)
def test_a_mistake_gets_a_line_on_stderr_and_status_two(prefrl: Shell, line: str, message: str) -> None:
    assert prefrl(line) == 2
    assert message in prefrl.err.replace("\n", " ")
    assert "Traceback" not in prefrl.err
    assert prefrl.out == ""


def test_a_run_without_a_folder_makes_a_new_one_and_says_which(prefrl: Shell) -> None:
    for number in (1, 2):
        assert prefrl(f"run control/toy {SMALL}") == 0
        told = re.search(r"the run's folder: (runs/control-toy-\d{8}-\d{6}(-2)?)$", prefrl.out, re.MULTILINE)
        assert told is not None
        assert Path(told[1], "report.html").exists()
        assert len(list(Path("runs").iterdir())) == number


def test_a_dry_run_estimates_and_writes_nothing(prefrl: Shell, tmp_path: Path) -> None:
    assert prefrl("run control/toy --dry-run") == 0
    assert re.search(r"about ([\d.]+ s|\d+ min)", prefrl.out)
    assert re.search(r"People: 10 min 0 s \(120 answers at 5 s each\)\. The machine: ", prefrl.out)
    assert list(tmp_path.iterdir()) == []


def test_a_dry_run_tells_what_the_task_tells(prefrl: Shell) -> None:
    small = (
        "task.kind=control task.horizon=20 learner.environments=2 learner.rollout_steps=10 learner.steps_per_round=40"
    )
    assert prefrl(f"run control/toy --dry-run {small}") == 0
    assert "segments have 10 steps: an episode of 20 is shorter than 1.5 seconds" in prefrl.out


@pytest.mark.slow
def test_a_second_run_into_the_folder_of_another_is_refused(prefrl: Shell) -> None:
    assert prefrl(f"run control/toy --out run {SMALL}") == 0
    assert "report: run/report.html" in prefrl.out
    assert prefrl(f"run control/toy --out run {SMALL} seed=1") == 2
    assert "seed is 0 there, 1 here" in prefrl.err
    assert prefrl("resume run") == 0


@pytest.mark.parametrize("name", [kind for role in TABLE for kind in kinds(role)])
def test_every_kind_is_described_with_every_setting_explained(prefrl: Shell, name: str) -> None:
    assert prefrl(f"describe {name}") == 0
    assert "meaning" in prefrl.out
    for row in re.findall(r"^│ ([\w.]+) +│[^│]*│[^│]*│ *│$", prefrl.out, re.MULTILINE):
        assert row.rpartition(".")[2] == "kind", f"{name}.{row} has no docstring"


def test_types_and_grouped_settings_are_told_in_words(prefrl: Shell) -> None:
    said = {"fitting": "float ≥ 0 | adaptive", "judge": "[str, str]", "mlp": "combine.caution"}
    said |= {"flow": "learner.policy.kind=flow, with learner.kind=control"}
    for kind, words in said.items():
        assert prefrl(f"describe {kind}") == 0
        assert words in prefrl.out
        assert "Annotated" not in prefrl.out


def test_the_kinds_of_installed_packages_are_described_by_their_classes(
    prefrl: Shell, monkeypatch: pytest.MonkeyPatch
) -> None:
    point = EntryPoint("mine", "prefrl.envs.toys:PointSettings", "prefrl.tasks")
    monkeypatch.setattr("prefrl.components.entry_points", lambda group: [point] if group == "prefrl.tasks" else [])
    plugins.cache_clear()
    try:
        assert prefrl("describe mine") == 0
        assert "Steps of a judged segment." in prefrl.out
    finally:
        plugins.cache_clear()


def test_learners_print_what_they_optimise(prefrl: Shell) -> None:
    for kind, said in (("control", ControlLearnerSettings().formula()), ("text", TextLearnerSettings().formula())):
        assert prefrl(f"describe {kind}") == 0
        assert "what it optimises" in prefrl.out
        first = said.splitlines()[0].split()
        assert " ".join(first) in " ".join(prefrl.out.split())  # a narrow console breaks the line
        assert "maximise" in prefrl.out.lower()


@pytest.mark.parametrize("line", ["presets", "describe", "describe control/toy", "describe loop", "doctor"])
def test_commands_that_only_tell_work(prefrl: Shell, line: str) -> None:
    assert prefrl(line) == 0
    assert len(prefrl.out) > 100


def loaded(line: str, *modules: str) -> set[str]:
    """Which of these modules a command has loaded by its end, in a process of its own."""
    code = (
        f"import sys; sys.argv = ['prefrl', *{line.split()}]\n"
        f"from prefrl.cli.main import main\ntry: main()\nexcept SystemExit: print(*{set(modules)} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert len(done.stdout) > 100, "it said nothing"
    return set(done.stdout.splitlines()[-1].split())


HEAVY = ("torch", "transformers", "scipy", "sqlalchemy", "gymnasium", "stable_baselines3", "matplotlib", "starlette")


def test_help_loads_nothing_heavy() -> None:
    assert loaded("--help", *HEAVY, "numpy", "pydantic", "yaml") == set()


def test_presets_are_listed_without_anything_heavy() -> None:
    assert loaded("presets", *HEAVY) == set()


@pytest.mark.parametrize("kind", ["control", "sb3", "transformer", "reviews", "judge", "web", "fitting", "loop"])
def test_settings_are_described_without_what_they_build(kind: str) -> None:
    assert loaded(f"describe {kind}", *HEAVY) == set()


def test_a_control_user_never_loads_transformers(tmp_path: Path) -> None:
    code = (
        f"import sys; sys.argv = 'prefrl run control/toy --out run {SMALL}'.split()\n"
        "from prefrl.cli.main import main\ntry: main()\nexcept SystemExit: print('transformers' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path)
    assert done.stdout.splitlines()[-1] == "False"


@pytest.mark.usefixtures("heard")
def test_ctrl_c_keeps_the_run_and_says_how_to_go_on(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "prefrl", "run", "control/toy", "--out", "run", "loop.rounds=200"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path) as child:
        assert child.stdout is not None
        for _ in range(2):
            child.stdout.readline()
        time.sleep(0.2)
        child.send_signal(signal.SIGINT)
        rest, errors = child.communicate(timeout=120)
    assert child.returncode == 130
    assert "prefrl resume run" in rest.replace("\n", " ")
    assert "Traceback" not in errors


@pytest.mark.usefixtures("heard")
def test_a_ctrl_c_that_a_library_swallowed_is_heard_at_the_end_of_a_round() -> None:
    with interrupts() as check:
        check()
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        with pytest.raises(KeyboardInterrupt):
            check()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.usefixtures("heard")
def test_a_ctrl_c_that_is_ignored_stays_ignored() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with interrupts() as check:
            signal.raise_signal(signal.SIGINT)
            check()
    except KeyboardInterrupt:  # by itself it would end all the tests
        pytest.fail("it was heard")
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_ctrl_c_is_ctrl_c_where_a_library_fails_over_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted() -> None:
        try:
            raise KeyboardInterrupt
        finally:
            raise AssertionError("not tidied up")

    monkeypatch.setattr("prefrl.cli.main.app", interrupted)
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 130

    def broken() -> None:
        raise AssertionError("our own")

    monkeypatch.setattr("prefrl.cli.main.app", broken)
    with pytest.raises(AssertionError, match="our own"):
        main()


def test_a_mistake_can_be_corrected_in_the_same_folder(prefrl: Shell) -> None:
    assert prefrl("run control/toy --out run task.segment_steps=41") == 2
    assert prefrl(f"run control/toy --out run {SMALL}") == 0


def test_demonstrations_may_go_where_a_mistake_left_nothing_but_a_folder(prefrl: Shell) -> None:
    assert prefrl("demonstrate control/pendulum --episodes 1 --expert nobody --out shown") == 2
    assert "--expert: there is no nobody" in prefrl.err
    assert prefrl("demonstrate control/pendulum --episodes 1 --out shown") == 0
    assert prefrl("demonstrate control/pendulum --episodes 1 --out shown") == 2
    assert "shown holds answers already" in prefrl.err


def test_a_run_that_never_learns_anything_says_so(prefrl: Shell) -> None:
    assert prefrl(f"run control/toy --out run {SMALL} labeler.tie_within=1e6") == 2
    assert "nothing to fit: all 24 judgements are ties" in prefrl.out
    assert "nothing was learned" in prefrl.err


def test_help_says_what_exit_statuses_mean(prefrl: Shell) -> None:
    assert prefrl("--help") == 0
    assert "Exit status: 0 done; 1 `verify` found something wrong; 2 a mistake" in prefrl.out


@pytest.mark.parametrize("line", ["run control/toy --out file", "export labels --to out.jsonl"])
def test_what_the_disk_does_not_allow_is_a_line_and_no_traceback(prefrl: Shell, line: str) -> None:
    assert prefrl("label control/toy --out labels loop.labels=2") == 0
    Path("file").write_text("x")
    Path("out.jsonl").mkdir()
    assert prefrl(line) == 2
    assert prefrl.err.startswith("error: ")


def test_the_installed_command_turns_a_mistake_into_status_two(tmp_path: Path) -> None:
    script = Path(sys.executable).parent / "prefrl"
    done = subprocess.run([script, "run", "nothing"], capture_output=True, text=True, check=False, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (2, "")
    assert "no such preset" in done.stderr
    assert "Traceback" not in done.stderr
