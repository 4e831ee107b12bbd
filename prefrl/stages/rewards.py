"""Reward models on their own: fit one on judgements, grade it, improve against it, write it for others."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from prefrl.components import ConfigError, flat
from prefrl.config import Config
from prefrl.evaluate.card import ReportCard
from prefrl.evaluate.grade import Subject, grade, of_judgements, of_run
from prefrl.evaluate.summary import read_metrics
from prefrl.exchange.layout import Which
from prefrl.exchange.reading import read_rows
from prefrl.exchange.source import open_judgements
from prefrl.exchange.text_rows import form_of
from prefrl.fit.pairs import batch
from prefrl.fit.trainer import fit
from prefrl.kinds import only
from prefrl.label.oracle import OracleSettings
from prefrl.protocols import AsksItself, RewardModel, TextTask
from prefrl.report.hub import write_readme
from prefrl.report.report import render_card
from prefrl.rundir import RunError, open_saved, save_reward
from prefrl.seeding import streams
from prefrl.storage.files import check_free, write_file
from prefrl.types import Fitted, Json, Response


def config_of(source: Path, config: str | None) -> str:
    """What has the settings for a source of judgements: the preset or file that is given, or the folder itself."""
    if not source.exists():
        raise ConfigError(f"{source}: no such file or folder")
    if config is None and source.is_file():
        raise ConfigError(
            f"{source} is a file of judgements: say which settings to use, --config {_preset_for(source)} say"
        )
    if config is None and not (source / "config.yaml").is_file():
        raise ConfigError(f"{source} has no config.yaml: say which settings to use with --config PRESET_OR_FILE")
    return config or str(source)


def _preset_for(file: Path) -> str:
    """One that fits what a file begins with, by its columns; the one for texts where they say nothing."""
    try:
        row = next(iter(read_rows(file)), None)
    except (ValueError, OSError, ImportError):  # said when it is read
        row = None
    return "pictures/digits" if isinstance(row, Mapping) and form_of(row) == "pick-a-pic" else "text/replies"


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


def with_reward(config: Config, saved: Path, overrides: Sequence[str] = ()) -> Config:
    """Settings that improve a policy against a saved reward model, and ask nobody.

    What they do not say of the task is as it was when the reward model was fitted: its model and its tokenizer, say.
    `overrides`, as on a command line: those of the reward say how its members are put together. Raises `ConfigError`
    for one that would need another fit.
    """
    folder, fitted = open_saved(saved).folder, open_saved(saved).config
    chosen = [one for one in overrides if one.startswith("reward.")]
    reward = Config.reopen(folder / "config.yaml", chosen).reward
    _check_only_combined(dict(flat(fitted.reward.model_dump())), dict(flat(reward.model_dump())), saved)
    update: Json = {"reward": reward, "loop": config.loop.model_copy(update={"labels": 0})}
    if isinstance(config.labeler, AsksItself):
        update["labeler"] = OracleSettings()  # who is asked nothing, and so says nothing
    if type(fitted.task) is type(config.task):
        said = {name: getattr(config.task, name) for name in config.task.model_fields_set}
        update["task"] = fitted.task.model_copy(update=said)
    return config.model_copy(update=update)


def _check_only_combined(there: Json, here: Json, saved: Path) -> None:
    """Raise `ConfigError` where settings of a fitted reward differ in more than how its members are put together."""
    for key in [*there, *here]:
        if there.get(key) != here.get(key) and not key.startswith("combine."):
            raise ConfigError(
                f"reward.{key}: {saved} was fitted with {there.get(key)}, and {here.get(key)} needs a fit of its own: "
                "only reward.combine can be chosen anew"
            )


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


def reward_of(folder: Path, task: TextTask) -> RewardModel[Response]:
    """The newest reward model of a run of text. Raises `RunError` where nothing was fitted yet."""
    reward: RewardModel[Response] = open_saved(folder).reward(task)
    if not reward.fitted:
        raise RunError(f"{folder}: its reward model was not fitted yet, and cannot tell which response is better")
    return reward
