"""The stages on their own: collect labels, fit a reward model, improve a policy, evaluate one."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from prefrl.components import ConfigError, Settings
from prefrl.config import Config
from prefrl.evaluate.best_of_n import best
from prefrl.evaluate.card import ReportCard
from prefrl.evaluate.grade import Subject, grade, of_judgements, of_run
from prefrl.evaluate.summary import read_metrics
from prefrl.exchange.layout import Which
from prefrl.exchange.source import open_judgements
from prefrl.fit.pairs import batch
from prefrl.fit.trainer import fit
from prefrl.kinds import only
from prefrl.policies.loaded import Loaded
from prefrl.policies.zips import Zipped, read_zip
from prefrl.protocols import Acts, Attended, ControlTask, Labeler, RewardModel, Settles, TextTask, control, text
from prefrl.report.hub import write_readme
from prefrl.report.report import render_card
from prefrl.rundir import RunError, Saved, open_saved, save_reward, saved_config
from prefrl.sample.graded import graded
from prefrl.seeding import streams
from prefrl.storage.checkpoints import load_state
from prefrl.storage.files import check_free, read_lines, write_file
from prefrl.store import Store
from prefrl.types import Evaluation, Fitted, Json, Query, Response

if TYPE_CHECKING:  # a control user loads no transformers
    from prefrl.policies.language import LanguagePolicy

Tell = Callable[[str], None]
"""How a person is told something while a stage goes on."""


def label(
    config: Config,
    folder: Path,
    policy: Saved | None = None,
    given: Path | None = None,
    tell: Tell = lambda _: None,
    policies: Sequence[Path] = (),
) -> dict[str, int]:
    """Ask `loop.labels` queries in the store of a folder, and have the labeler answer them; returns the counts.

    Candidates come from the starting policy, from a run's `policy`, from a file of `given` responses, or from
    `policies` of control (`load_policy`), which every query then mixes; the selector is not asked. Calling it again on
    the same folder goes on where it stopped, and asks more if `loop.labels` is higher. Raises `RunError` for the folder
    of a run, whose labels are its own.
    """
    if (folder / "checkpoints").exists():
        raise RunError(f"{folder} holds a run, which asks for its own labels: choose another folder")
    with Store(folder) as store:
        _keep_config(config, folder)
        loop = config.build(store)
        if policy is not None:
            loop.learner.load(load_state(policy.folder, "learner"))
            loop.reward.load(load_state(policy.folder, "reward"))
        asked = store.counts()["asked"]
        if given:
            store.ask(read_queries(given, loop.task))
        elif policies:
            queries = graded(
                {str(path): load_policy(path) for path in policies},
                control(loop.task, "--policy gives segments of control"),
                loop.candidates,
                config.loop.labels - asked,
                streams(config.seed, 1 + asked).sample,
            )
            store.ask(queries)
        else:
            loop.ask(config.loop.labels - asked, streams(config.seed, 1 + asked))
        with attended(loop.labeler, store, tell):
            loop.labeler.answer(store, streams(config.seed, 1).label)
        return store.counts()


def serve(folder: Path, overrides: Sequence[str] = (), tell: Tell = lambda _: None) -> dict[str, int]:
    """Have people answer what was asked in the store of a folder, until nothing is left; returns the counts.

    The settings of the page are the folder's own, if it has any. Raises `RunError` where there is no store, and
    `StoreError` where a run that goes on has it.
    """
    if not (folder / "store.db").exists() and not (folder / "store.url").exists():
        raise RunError(f"{folder} holds no store: expected the folder of a run, or of `prefrl label`")
    saved_config(folder)  # says what is missing, if it is
    config = Config.reopen(folder / "config.yaml", ["labeler.kind=web", *overrides])
    with Store(folder) as store:
        labeler = config.build_labeler(config.build_task())
        with attended(labeler, store, tell):
            labeler.answer(store, streams(config.seed, 1).label)
        return store.counts()


@contextmanager
def attended(labeler: Labeler, store: Store, tell: Tell) -> Iterator[None]:
    """Have open what a labeler's people come to, if there is such a thing; nothing more will be asked."""
    if not isinstance(labeler, Attended):
        yield
        return
    try:
        for note in labeler.open(store, fixed=True):
            tell(note)
        yield
    finally:
        labeler.close()


def read_queries(path: Path, task: Any) -> list[Query[Response]]:
    """Queries from JSON lines `{"prompt": ..., "responses": [...]}`. Raises `ValueError` with the row's number."""
    text(task, f"{path} holds responses to prompts")
    queries = []
    for number, line in enumerate(read_lines(path), 1):
        try:
            queries.append(Query(tuple(with_gold(_responses(json.loads(line)), task))))
        except ValueError as error:
            raise ValueError(f"{path}: row {number}: {error}") from error
    if not queries:
        raise ValueError(f"{path}: expected at least one row, got none")
    return queries


def _responses(row: Any) -> list[Response]:
    """The responses of one row; gold and tokens are not known yet."""
    prompt, texts = (row.get("prompt"), row.get("responses")) if isinstance(row, dict) else (None, None)
    if not isinstance(prompt, str) or not isinstance(texts, list) or not all(isinstance(t, str) for t in texts):
        raise ValueError(f'expected {{"prompt": string, "responses": [strings]}}, got {row!r}')
    if len(texts) < 2:
        raise ValueError(f"a query needs at least 2 responses to compare, got {len(texts)}")
    return [Response(prompt, text) for text in texts]


def with_gold(responses: list[Response], task: Any) -> list[Response]:
    """Attach the hidden gold, for oracles."""
    gold = task.gold(responses)
    return [replace(r, gold=np.array([g])) for r, g in zip(responses, gold, strict=True)]


def config_of(source: Path, config: str | None) -> str:
    """What has the settings for a source of judgements: the preset or file that is given, or the folder itself."""
    if not source.exists():
        raise ConfigError(f"{source}: no such file or folder")
    if config is None and source.is_file():
        raise ConfigError(f"{source} is a file of judgements: say which settings to use, --config text/replies say")
    if config is None and not (source / "config.yaml").is_file():
        raise ConfigError(f"{source} has no config.yaml: say which settings to use with --config PRESET_OR_FILE")
    return config or str(source)


def fit_reward(config: Config, source: Path, out: Path, which: Which | None = None) -> tuple[Fitted, tuple[str, ...]]:
    """Fit a reward model on the judgements in a folder's store or in a file, and save it.

    Returns what the fit came to, and notes for people on what was left out of a file.
    """
    check_free(out)
    rng, task = streams(config.seed, 1), config.build_task()
    with open_judgements(source, task, which) as (store, notes):
        if config.fitting.pseudo_labels and not store.open_queries():
            raise ConfigError(
                f"fitting.pseudo_labels: {source} holds no query without a judgement to label; set it to 0"
            )
        reward = config.build_reward(task, rng.build)
        fitted = fit(reward, store, config.fitting, rng.fit)
        save_reward(out, config, reward, fitted)  # before it is graded: an interruption there loses no fit
        names = (out.resolve().name, source.resolve().name)
        subject = of_judgements(reward, store, names, config.fitting, [fitted.row()], config.discount, held_out=True)
        card = grade(subject, rng.evaluate) if subject is not None and len(fitted.predicted) else None
    save_reward(out, config, reward, fitted, card)
    write_readme(out, out, "reward", task.kind)
    return fitted, notes


def export_classifier(saved: Path, to: Path) -> float:
    """Write a saved reward model of text as a sequence classifier of transformers; returns what its logit lacks."""
    from prefrl.reward_models.io import save_classifier
    from prefrl.reward_models.text import TransformerReward

    found = open_saved(saved)
    check_free(to)
    reward = found.reward(found.config.build_task())
    if not isinstance(reward, TransformerReward):
        raise RunError(f"{saved} holds a {type(reward).__name__}: only a reward of kind 'transformer' is a classifier")
    return save_classifier(reward.backbone, *reward.mean_head(), to)


def policy_of(folder: Path, at_start: bool = False) -> LanguagePolicy:
    """The newest policy of a run of text, or the one that it started from. Raises `RunError` where it has none."""
    from prefrl.improve.writer import WritesText
    from prefrl.policies.language import LanguagePolicy

    saved = open_saved(folder)
    learner = saved.config.build_learner(saved.config.build_task(), streams(saved.config.seed, 0).build)
    if not isinstance(learner, WritesText) or not isinstance(learner.policy, LanguagePolicy):
        raise RunError(f"{folder}: its policy is no language model; expected a run of a text task")
    if at_start:
        return learner.policy
    try:
        learner.load(load_state(saved.folder, "learner"))
    except ValueError as error:
        raise RunError(f"{folder}: {error}") from error
    return learner.policy


def prompts_for(policy: LanguagePolicy, path: Path) -> list[str]:
    """The prompts of a file. Raises `ValueError` with the row of one that leaves no room for a response."""
    from prefrl.envs.prompts import read_prompts

    given = read_prompts(path)
    for one in given:
        try:
            policy.opened(one.text)
        except ValueError as error:
            raise ValueError(f"{one.place}: {error}") from None
    return [one.text for one in given]


def generate(
    policy: LanguagePolicy, texts: Sequence[str], sampling: Drawn, seed: int = 0, batch: int = 16
) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Each prompt with a policy's responses, `batch` prompts at a time."""
    for prompt, found in answered(policy, texts, sampling, seed, batch):
        yield prompt, tuple(one.text for one in found)


def generate_best(
    policy: LanguagePolicy,
    reward: RewardModel[Response],
    texts: Sequence[str],
    sampling: Drawn,
    seed: int = 0,
    batch: int = 16,
) -> Iterator[tuple[str, str, float | None]]:
    """Each prompt with the response that a reward model scores highest, of those that `generate` gives, and its score.

    What is not scored never wins; where nothing is, it is the first, and its score None.
    """
    for prompt, found in answered(policy, texts, sampling, seed, batch):
        scores = reward.score(found)
        at = int(best(scores))
        yield prompt, found[at].text, None if np.isnan(scores[at]) else float(scores[at])


def reward_of(folder: Path, task: TextTask) -> RewardModel[Response]:
    """The newest reward model of a run of text. Raises `RunError` where nothing was fitted yet."""
    reward: RewardModel[Response] = open_saved(folder).reward(task)
    if not reward.fitted:
        raise RunError(f"{folder}: its reward model was not fitted yet, and cannot tell which response is better")
    return reward


def answered(
    policy: LanguagePolicy, texts: Sequence[str], sampling: Drawn, seed: int = 0, batch: int = 16
) -> Iterator[tuple[str, list[Response]]]:
    """Each prompt with a policy's responses as they were sampled, `batch` prompts at a time."""
    how = replace(policy.sampling(sampling.samples, sampling.temperature), top_k=sampling.top_k, top_p=sampling.top_p)
    for start in range(0, len(texts), batch):
        some = texts[start : start + batch]
        drawn = policy.respond(some, how.samples, np.random.default_rng([seed, start]), how)
        found = drawn.candidates(policy.task.tokenizer)
        for i, prompt in enumerate(some):
            yield prompt, found[i * how.samples : (i + 1) * how.samples]


class Drawn(NamedTuple):
    """How responses are drawn, see `prefrl.policies.generate.Sampling`."""

    samples: int = 1
    temperature: float = 1.0
    top_k: int = 0
    top_p: float = 1.0


def with_reward(config: Config, saved: Path) -> Config:
    """Settings that improve a policy against a saved reward model, and ask nobody.

    What they do not say of the task is as it was when the reward model was fitted: its model and its tokenizer, say.
    """
    fitted = open_saved(saved).config
    update: Json = {"reward": fitted.reward, "loop": config.loop.model_copy(update={"labels": 0})}
    if type(fitted.task) is type(config.task):
        said = {name: getattr(config.task, name) for name in config.task.model_fields_set}
        update["task"] = fitted.task.model_copy(update=said)
    return config.model_copy(update=update)


def load_policy(path: str | Path, best: bool = False) -> Loaded:
    """The last policy of a run of control, or the best one by its newest reward, or that of a zip of
    stable-baselines3, of which weights alone are read (`prefrl.policies.zips`); `predict` acts with it.

    Raises `RunError` for a run of text, for the best one of a learner that keeps none, and where nothing is there.
    """
    if Path(path).is_file():
        return _zipped(Path(path), best).loaded()
    learner, task, _ = _acting(_there(Path(path)), best)
    return Loaded(learner.actor(), task.observation_size, task.action_size, task.action_bounds is None)


def _zipped(path: Path, best: bool) -> Zipped:
    if best:
        raise RunError(f"{path}: a zip holds one policy, and no best one beside it; leave --best out")
    return read_zip(path)


def _there(path: Path) -> Path:
    if not path.exists():
        raise RunError(f"there is no {path}: expected the folder of a run, or a zip of stable-baselines3")
    return path


def on_stage(path: Path, env: str | None, best: bool = False) -> tuple[Loaded, ControlTask]:
    """A policy, as `load_policy` gives it, and where it acts: in its run's task, or in gymnasium's `env`.

    Raises `RunError` for a zip without an `env`, which it does not name itself.
    """
    policy = load_policy(path, best)
    if env is None and path.is_file():
        raise RunError(f"{path} does not say which environment it is for: name it, as in --env Pendulum-v1")
    task = open_saved(path).config.build_task() if env is None else Config.parse(_of_env(env)).build_task()
    found = control(task, f"{path}: a policy of control is expected")
    policy.check(found, str(path))
    return policy, found


def _of_env(env: str) -> Json:
    return {"task": {"kind": "control", "env": env}, "reward": {"kind": "mlp"}, "learner": {"kind": "control"}}


def export_onnx(path: Path, to: Path, best: bool = False) -> None:
    """Write the mode of a policy of control as ONNX: that of a run with our own learner, or of a zip.

    Raises `RunError` for others.
    """
    from prefrl.improve.control import ControlLearner
    from prefrl.policies.mlp import MLPPolicy
    from prefrl.policies.to_onnx import ACTIVATIONS, save_onnx

    if path.is_file():
        save_onnx(_zipped(path, best).actor(), to)
        return
    learner, _, _ = _acting(_there(path), best)
    if not isinstance(learner, ControlLearner):
        raise RunError(
            f"{path}: expected a run with learner.kind=control, and its policy is that of a {type(learner).__name__}; "
            "export it with --form sb3, and from there as stable-baselines3's documentation says"
        )
    policy = learner.policy
    if not isinstance(policy, MLPPolicy) or policy.settings.activation not in ACTIVATIONS:
        wanted = " or ".join(ACTIVATIONS)
        raise RunError(f"{path}: expected learner.policy.kind=mlp with {wanted}; no other is written as ONNX")
    save_onnx(policy.numpy_actor(), to)


def export_sb3(folder: Path, to: Path, best: bool = False) -> int:
    """Write a run's policy of control as a zip of stable-baselines3; returns the round that it is of.

    Raises `RunError` as `load_policy` does.
    """
    learner, _, round = _acting(folder, best)
    learner.save(to)
    return round


def _acting(folder: Path, best: bool) -> tuple[Acts, Any, int]:
    learner, task, round = _learner_of(folder, best)
    if not isinstance(learner, Acts):
        raise RunError(f"{folder}: its policy does not act in an environment; expected a run of a control task")
    return learner, task, round


def _learner_of(folder: Path, best: bool) -> tuple[Any, Any, int]:
    """A run's learner with its last policy, or its best one; its task, and the round that the policy is of."""
    saved = open_saved(folder)
    task = saved.config.build_task()
    learner = saved.config.build_learner(task, streams(saved.config.seed, 0).build)
    try:
        learner.load(load_state(saved.folder, "learner"))
    except ValueError as error:
        raise RunError(f"{folder}: {error}") from error
    if not best:
        return learner, task, json.loads((saved.folder / "loop.json").read_text())["round"]
    if not isinstance(learner, Settles):
        raise RunError(f"{folder}: its learner ({type(learner).__name__}) keeps no best policy beside the last one")
    return learner, task, learner.go_back()


def evaluate(folder: Path, best: bool = False) -> tuple[Evaluation, int]:
    """Evaluate the newest policy of a run, or the best one by its newest reward; also returns the round that it is of.

    Raises `RunError` for the best one of a learner that keeps none.
    """
    saved = open_saved(folder)
    learner, task, round = _learner_of(folder, best)
    evaluation: Evaluation = learner.evaluate(saved.reward(task), streams(saved.config.seed, 0).evaluate)
    return evaluation, round


def report_card(
    model: Path,
    data: Path | None = None,
    held_out: bool = False,
    rewardbench: Path | None = None,
    which: Which | None = None,
) -> ReportCard:
    """Grade a saved reward model: on what its run's newest fit left out, or on the judgements of a folder or a file.

    `held_out`: of `data`, only what a fit on it leaves out, by the model's own settings. `rewardbench`: a folder for
    the scores of text pairs. Raises `RunError` where there is nothing to grade on.
    """
    saved = open_saved(model)
    task, fitting = saved.config.build_task(), saved.config.fitting
    rng = streams(saved.config.seed, 0).evaluate
    reward, discount = saved.reward(task), saved.config.discount
    source = data or model
    if data is None and not (model / "checkpoints").exists():
        raise RunError(f"{model} holds no judgements: say what to grade it on, with --data FOLDER_OR_FILE")
    with open_judgements(source, task, which) as (store, _):
        if data is None:
            round = json.loads((saved.folder / "loop.json").read_text())["round"]
            subject = of_run(reward, store, model, round, fitting, discount)
        else:
            names = (model.resolve().name, source.resolve().name)
            subject = of_judgements(reward, store, names, fitting, _fits(model), discount, held_out)
        if subject is None:
            raise RunError(f"{source}: no judgement is held out that the reward model could be graded on")
        if rewardbench is not None:
            _write_rewardbench(subject, rewardbench)
        return grade(subject, rng)


def _fits(model: Path) -> list[Json]:
    """What the fits of a run, or the one of a saved reward model, came to."""
    alone = model / "fit.json"
    return [json.loads(alone.read_text())] if alone.exists() else read_metrics(model)


def _write_rewardbench(subject: Subject, folder: Path) -> None:
    """Every pair in which one response is preferred, with the scores of both."""
    from prefrl.exchange.rewardbench import ScoredPair, write_rewardbench
    from prefrl.reward_models.text import TransformerReward

    pairs, rows = batch(subject.judged), []
    refusal = RunError("RewardBench knows pairs of texts: segments of control cannot be written for it")
    responses = only(Response, pairs.candidates, refusal)
    scores = subject.reward.score(pairs.candidates)
    for number, ((first, second), preference) in enumerate(zip(pairs.edges, pairs.preference, strict=True)):
        best, worst = (first, second) if preference > 0.5 else (second, first)
        chosen, rejected = (responses[i].prompt + responses[i].text for i in (best, worst))
        if preference != 0.5:
            rows.append(ScoredPair(number, subject.data, chosen, rejected, float(scores[best]), float(scores[worst])))
    reward = subject.reward  # a reward model of another make knows no chat template
    chat = isinstance(reward, TransformerReward) and reward.backbone.chat
    write_rewardbench(folder, subject.model, rows, chat)


def write_card(card: ReportCard, data: Path | None, page: Path | None) -> None:
    """Write a report card as JSON, as a page, or both."""
    if data is not None:
        write_file(data, card.model_dump_json(indent=1).encode())
    if page is not None:
        write_file(page, render_card(card).encode())


def shrink(config: Config) -> Config:
    """The same components with as little work as possible: one round, a handful of labels."""
    parts = {name: value.shrunk() for name, value in config if isinstance(value, Settings)}
    return config.model_copy(update=parts)


def estimate(config: Config) -> float:
    """Seconds that a run would take, about, from one small round of the true task in a temporary folder.

    Evaluation is done at its true size. A starting policy that has to be made first is made, and kept.
    """
    small = shrink(config)
    learner = small.learner.with_evaluation_of(config.learner)
    small = small.model_copy(update={"task": config.task, "learner": learner})
    with tempfile.TemporaryDirectory() as scratch, Store(Path(scratch)) as store:
        loop = small.build(store)
        start, one = (round.metrics for round in loop.run())
    growth = {
        "sample": config.loop.labels / small.loop.labels if small.loop.labels else 0.0,
        "label": config.loop.labels / small.loop.labels if small.loop.labels else 0.0,
        # a fit sees all labels so far: half of them, on the average round
        "fit": config.loop.rounds * config.loop.labels / 2 / max(small.loop.labels, 1),
        "improve": config.loop.rounds * config.learner.work() / small.learner.work(),
    }
    evaluation = start["seconds/evaluate"] * (config.loop.rounds + 1)
    return evaluation + sum(one.get(f"seconds/{stage}", 0.0) * factor for stage, factor in growth.items())


def _keep_config(config: Config, folder: Path) -> None:
    """Write the settings beside a store, or see that it was made for the same task. The first ones stay."""
    path = folder / "config.yaml"
    if not path.exists():
        write_file(path, config.dump().encode())
    elif saved_config(folder).task != config.task:
        raise RunError(f"{folder} holds labels for another task: choose another folder")
