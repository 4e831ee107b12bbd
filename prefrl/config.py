"""One tree of settings: the same words in Python, in YAML and on the command line."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from importlib.resources import files
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import numpy as np
import yaml
from pydantic import BeforeValidator, Field, SerializeAsAny, ValidationError

from prefrl.components import ConfigError, Role, Settings, kinds, settings_class, suggest, todays
from prefrl.exchange.worlds import other_worlds
from prefrl.fit.settings import FittingSettings, check_settings, check_shown
from prefrl.kinds import named
from prefrl.loop import Loop, LoopSettings
from prefrl.mistakes import explained, placed
from prefrl.protocols import (
    AsksItself,
    ControlTask,
    Demonstrates,
    GoesByGold,
    Imagines,
    Imitates,
    Labeler,
    LabelerSettings,
    Learner,
    LearnerSettings,
    Particular,
    PartlyGraded,
    Retells,
    RewardModel,
    RewardSettings,
    SelectorSettings,
    Task,
    TaskSettings,
    Threaded,
)
from prefrl.report.trackers import Places
from prefrl.seeding import device_of, streams
from prefrl.types import Json

if TYPE_CHECKING:
    from prefrl.store import Store

ROLES: dict[str, Role] = {
    "task": "tasks",
    "labeler": "labelers",
    "select": "selectors",
    "reward": "rewards",
    "learner": "learners",
}
"""Part of the settings -> whose kinds it chooses from."""


def _component(role: Role, default: str | None, value: object) -> Settings:
    """Look up the settings class of a `kind` (the default one if none is given), and check the rest against it."""
    if isinstance(value, Settings):
        return value
    if isinstance(value, dict) and default:
        value = {"kind": default} | value
    if not isinstance(value, dict) or not isinstance(value.get("kind"), str):
        raise ConfigError(f": expected settings with a kind ({', '.join(kinds(role))}), got {value!r}")
    try:
        cls = settings_class(role, value["kind"])
    except ConfigError as error:
        raise ConfigError(f".kind: {error}") from None
    try:
        return cls.model_validate(value)
    except ValidationError as error:
        raise ConfigError("\n".join(explained(cls, error.errors()))) from None


class Config(Settings):
    """Everything that a run needs. A component is told by its `kind`; `prefrl describe KIND` lists its settings."""

    task: Annotated[SerializeAsAny[Settings], BeforeValidator(partial(_component, "tasks", None))]
    """Where behaviours come from."""
    labeler: Annotated[SerializeAsAny[Settings], BeforeValidator(partial(_component, "labelers", "oracle"))] = Field(
        {}, validate_default=True
    )
    """Who answers."""
    select: Annotated[SerializeAsAny[Settings], BeforeValidator(partial(_component, "selectors", "uniform"))] = Field(
        {}, validate_default=True
    )
    """Which candidates are worth a label."""
    reward: Annotated[SerializeAsAny[Settings], BeforeValidator(partial(_component, "rewards", None))]
    """What is fitted."""
    fitting: FittingSettings = FittingSettings()
    """How it is fitted."""
    learner: Annotated[SerializeAsAny[Settings], BeforeValidator(partial(_component, "learners", None))]
    """The policy, and how it gets better."""
    loop: LoopSettings = LoopSettings()
    """How often, and how much is asked."""
    goal: str = Field("", max_length=200)
    """What people and judges are asked, unless the labeler has a question of its own."""
    track: Places = ()
    """Trackers that show the metrics beside TensorBoard: wandb, mlflow, trackio, each with its project as in
    wandb:hoppers if you like. They may send them over the network."""
    seed: int = Field(0, ge=0)
    """All random numbers of the run come from this one."""

    @property
    def discount(self) -> float:
        """The learner's own."""
        return cast(LearnerSettings, self.learner).discount

    def notes(self) -> list[str]:
        """What a person should know before it starts: what is named from elsewhere was made in another world."""
        found = other_worlds(self.task, {"labeler": self.labeler, "learner": self.learner})
        if isinstance(self.labeler, AsksItself) and self.reward.model_dump().get("features") == "inputs":
            found.append(
                "reward.features=inputs: the reward sees actions, and may learn to tell blind ones and not what they "
                "lead to; consider reward.features=observations"
            )
        return found

    @classmethod
    def load(cls, source: str | Path, overrides: Sequence[str] = ()) -> Config:
        """Read a preset ("control/pendulum") or a YAML file, with `dotted.key=value` overrides.

        Raises `ConfigError` with a line for each mistake: where, what was expected, what came, the nearest name.
        """
        data = read_settings(source)
        for override in _kinds_first(overrides):
            _apply(data, override)
        try:
            return cls.parse(data)
        except ConfigError as error:
            given = [override.partition("=")[0].split(".") for override in overrides]
            raise ConfigError("\n".join(placed(line, source, given) for line in str(error).splitlines())) from None

    @classmethod
    def reopen(cls, path: Path, overrides: Sequence[str] = ()) -> Config:
        """Read what a run or a reward model was saved with, by this version or an earlier one, with overrides."""
        if not path.is_file():
            raise ConfigError(f"{path.parent} holds no run: expected a file {path.name} in it")
        data = read_settings(path)
        for part, role in ROLES.items():
            if isinstance(data.get(part), dict):
                data[part] = todays(role, data[part])
        for override in _kinds_first(overrides):
            _apply(data, override)
        return cls.parse(data)

    @classmethod
    def parse(cls, data: Json) -> Config:
        """Check a nested dict. Raises `ConfigError`."""
        try:
            return cls.model_validate(data)
        except ValidationError as error:
            lines = [line for told in explained(cls, error.errors()) for line in told.splitlines()]
            raise ConfigError("\n".join(line.removeprefix(".") for line in lines)) from None

    def dump(self) -> str:
        """YAML with every default spelled out; `Config.parse` of it gives the same settings back."""
        return yaml.safe_dump(self.model_dump(mode="json"), sort_keys=False, allow_unicode=True)

    def build(self, store: Store) -> Loop:
        """Make every component, and the loop that joins them, on an open store."""
        from prefrl.fit.descent import trainable  # torch is heavy, and who reads settings needs none
        from prefrl.sample.select import PoolSettings, UnscoredSettings  # and so is scipy

        rng, select = streams(self.seed, 0).build, cast(SelectorSettings, self.select)
        task = self.build_task()
        if store is not None:  # which is with the first of several ranks alone
            _check_holds(store, task)
        learner, reward = self.build_learner(task, rng), self.build_reward(task, rng)
        labeler = self.build_labeler(task)
        self._check_labeler(labeler, learner)
        self._check_gold(labeler, task)
        if store is not None:
            shows = _shows(labeler) or bool(store.demonstrations())
            check_shown(self.fitting, shows)
        check_settings(self.fitting, not trainable(reward), task.kind, select.candidates)
        if isinstance(select, UnscoredSettings) and select.best_of > self.loop.pool:
            raise ConfigError(
                f"select.best_of={select.best_of} chooses among so many candidates for each query, and loop.pool "
                f"samples {self.loop.pool:g}: set loop.pool={select.best_of}"
            )
        imagined = isinstance(select, PoolSettings) and select.imagined
        if imagined:
            self._check_imagined(learner, task)
        if isinstance(learner, Particular):
            learner.check_reward(reward)
        if self.loop.labels and reward.fitted and not trainable(reward):
            raise ConfigError(f"loop.labels={self.loop.labels}, but this reward is not fitted: set loop.labels=0")
        return Loop(
            task=task,
            learner=learner,
            reward=reward,
            labeler=labeler,
            selector=select.build(),
            store=store,
            candidates=select.candidates,
            fitting=self.fitting,
            settings=self.loop,
            seed=self.seed,
            imagined=imagined,
            threads=self.learner.threads if isinstance(self.learner, Threaded) else None,
        )

    def _check_labeler(self, labeler: Labeler, learner: Learner) -> None:
        """Raises `ConfigError` where the labeler cannot answer about so many candidates, or nobody learns from it."""
        count = cast(SelectorSettings, self.select).candidates
        shows = _shows(labeler)
        if self.loop.labels and isinstance(labeler, Demonstrates) and not labeler.corrects:
            raise ConfigError(
                f"loop.labels={self.loop.labels}, but the labeler ({self.labeler.model_dump()['kind']}) answers no "
                "question about the learner's own: set loop.labels=0, or choose another"
            )
        if self.loop.labels and shows != (count == 1):
            says = "shows what to do in the states of one" if shows else "compares two or more"
            raise ConfigError(
                f"select.candidates={count}, but the labeler ({self.labeler.model_dump()['kind']}) {says}: set "
                f"{'select.kind=uniform select.candidates=1' if shows else 'select.candidates=2'}, or choose another"
            )
        if self.loop.labels and shows and not (isinstance(learner, Imitates) or self.fitting.demonstrations):
            raise ConfigError(
                f"learner.kind={self.learner.model_dump()['kind']} learns nothing from demonstrations, and the labeler "
                "gives no other answers: set fitting.demonstrations=1, for a reward that is fitted on them, or "
                "learner.kind=clone"
            )

    def _check_gold(self, labeler: Labeler, task: Task) -> None:
        """Raises `ConfigError` where somebody who goes by gold would be asked about what has none."""
        if not (self.loop.labels and isinstance(labeler, GoesByGold) and labeler.by_gold):
            return
        if isinstance(task, PartlyGraded) and task.ungraded:
            raise ConfigError(
                f"labeler.kind={self.labeler.model_dump()['kind']} goes by gold, and there is none for "
                f"{task.ungraded}: set labeler.kind=web to judge yourself, or a model that judges, or ask for what has "
                "a gold"
            )

    def _check_imagined(self, learner: Learner, task: Task) -> None:
        """Raises `ConfigError` where nothing can be imagined, or nobody could judge it."""
        if not isinstance(learner, Imagines):
            raise ConfigError(
                f"select.imagined: learner.kind={self.learner.model_dump()['kind']} has no policy in a learned world, "
                "whose behaviour could be asked about: leave it out, or for a task of control set learner.kind=dyna or "
                "learner.kind=backprop"
            )
        if not isinstance(task, Retells) or task.retell is None:
            raise ConfigError(
                f"select.imagined: what is imagined of {task.name} can neither be drawn nor judged, since its "
                "simulator's states cannot be told from what is seen. Those of task.kind=point can, and of classic "
                "control as long as nothing is hidden or restarted: Pendulum-v1, CartPole-v1, Acrobot-v1, "
                "MountainCar-v0, MountainCarContinuous-v0"
            )

    # Fields are typed by what all settings have; what a role's settings have besides, its protocol says.

    def build_task(self) -> Task:
        return cast(TaskSettings, self.task).build()

    def build_labeler(self, task: Task) -> Labeler:
        return cast(LabelerSettings, self.labeler.asking(self.goal)).build(task)

    def build_reward(self, task: Task, rng: np.random.Generator) -> RewardModel:
        """Not fitted yet, on the learner's device."""
        model = cast(RewardSettings, self.reward).build(task, rng)
        model.to(device_of(cast(LearnerSettings, self.learner).device))
        return model

    def build_learner(self, task: Task, rng: np.random.Generator) -> Learner:
        """Raises `ConfigError` for a learner of another package that does not say its discount and device."""
        if not isinstance(self.learner, LearnerSettings):
            raise ConfigError(
                f"learner: {type(self.learner).__name__} has no `discount`, which the report card reads, or no "
                "`device`, which the reward model shares"
            )
        return self.learner.build(task, rng)


def presets() -> dict[str, str]:
    """Name -> the first comment line of each preset that is shipped."""
    found = {}
    for folder in sorted(files("prefrl.configs").iterdir(), key=lambda f: f.name):
        if folder.is_dir() and not folder.name.startswith("_"):
            for file in sorted(folder.iterdir(), key=lambda f: f.name):
                if file.name.endswith(".yaml"):
                    found[f"{folder.name}/{file.name[:-5]}"] = _first_comment(file)
    return found


def _first_comment(file: Traversable) -> str:
    return file.read_text(encoding="utf-8").splitlines()[0].lstrip("# ")


def read_settings(source: str | Path) -> Json:
    """The settings in a file, or in a preset of that name."""
    path = Path(source)
    if path.is_file():
        text = path.read_text(encoding="utf-8")
    elif str(source) in (known := presets()):
        text = files("prefrl.configs").joinpath(f"{source}.yaml").read_text(encoding="utf-8")
    else:
        raise ConfigError(f"{source}: no such preset or file; {suggest(str(source), known)}")
    try:
        data = yaml.load(text, _UniqueKeys)
    except yaml.MarkedYAMLError as error:
        raise ConfigError(f"{_at(source, error)}: not valid YAML: {error.problem}") from None
    except yaml.YAMLError as error:
        raise ConfigError(f"{source}: not valid YAML: {error}") from None
    if not isinstance(data, dict):
        raise ConfigError(f"{source}: expected settings (key: value), got {type(data).__name__}")
    return data


def _at(source: str | Path, error: yaml.MarkedYAMLError) -> str:
    mark = error.problem_mark or error.context_mark
    return f"{source}, line {mark.line + 1}" if mark else str(source)


def _check_holds(store: Store, task: Task) -> None:
    """Raises `ConfigError` where what was asked about or shown before is of another kind than the task's, or where
    what was shown step by step cannot be done in it."""
    ours = named(task.kind)
    if store.holds and store.holds != ours.noun:
        raise ConfigError(
            f"{store.folder} holds {store.holds}s, and {task.name} is learned from {ours.noun}s: choose "
            "another folder with --out, or the task that these are for"
        )
    if not ours.stepwise:
        return
    from prefrl.exchange.recordings import called, check_imitable  # with the database, which settings alone do not need

    for one in store.demonstrations():
        try:
            check_imitable(one.like, cast(ControlTask, task), f"{called(one.like)}, by {one.demonstration.labeler!r},")
        except ValueError as error:
            raise ConfigError(f"{store.folder}: {error}") from error


def _shows(labeler: Labeler) -> bool:
    return isinstance(labeler, Demonstrates) and labeler.demonstrates


class _UniqueKeys(yaml.SafeLoader):
    """YAML without code, and without the silent loss of a key that is given twice."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys = [self.construct_object(key, deep=True) for key, _ in node.value]
        twice = [key for i, key in enumerate(keys) if key in keys[:i]]
        if twice:
            raise yaml.constructor.ConstructorError(None, None, f"{twice[0]!r} is given twice", node.start_mark)
        return super().construct_mapping(node, deep)


def _kinds_first(overrides: Sequence[str]) -> list[str]:
    """A new kind drops what was set for the old one."""
    return sorted(overrides, key=lambda o: not o.partition("=")[0].endswith("kind"))


def _apply(data: Json, override: str) -> None:
    """Set one `dotted.key=value`. A new kind drops the settings of the old one, which it may not know."""
    path, sign, text = override.partition("=")
    if not sign or not path:
        raise ConfigError(f"{override!r}: expected dotted.key=value, for example learner.kind=sb3")
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError:
        raise ConfigError(f"{path}: {text!r} is not a YAML value") from None
    if isinstance(value, dict | list) and not text.lstrip().startswith(("{", "[")):
        value = text  # a sentence with a colon or a dash in it: on one line nobody writes a group in any other way
    *parents, last = path.split(".")
    for parent in parents:
        data = data.setdefault(parent, {})
        if not isinstance(data, dict):
            raise ConfigError(f"{path}: {parent} is a value, not a group of settings")
    if last == "kind" and data.get("kind") != value:
        data.clear()
    data[last] = value
