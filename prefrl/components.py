"""What can be chosen by `kind`: a table of names, plus the entry points of installed packages.

A config file names a kind; only this table or an installed package's entry points can tie a kind to code.
"""

from __future__ import annotations

import difflib
import importlib.util
import os
import sys
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Literal, Self, TypeAlias

from pydantic import BaseModel, ConfigDict

Role: TypeAlias = Literal["tasks", "labelers", "rewards", "learners", "selectors"]


class ConfigError(ValueError):
    """A setting is wrong. The message says where, what was expected and what came."""


class Settings(BaseModel):
    """A component's settings: frozen, strict about unknown keys, documented by its attributes' docstrings."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)

    @classmethod
    def renamed(cls, saved: dict[str, Any]) -> dict[str, Any]:
        """Settings that an earlier version saved, in today's names."""
        return saved

    def shrunk(self) -> Self:
        """The same with as little work as still makes sense: for dry runs and tests."""
        return self

    def with_evaluation_of(self, other: Self) -> Self:
        """The same, evaluated on as much as another learner's settings say; for a learner that can be shrunk."""
        return self

    def lasting(self) -> Self:
        """The same without what may change from one start of a run to the next, such as a port."""
        return self

    def identity(self) -> Self:
        """What makes two tasks one for a reward model that was fitted on either."""
        return self

    def asks_people(self) -> bool:
        """Whether a labeler speaks to people, and so needs the terminal for itself."""
        return False

    def asking(self, goal: str) -> Self:
        """A labeler that asks for this, where its settings ask for nothing themselves."""
        return self

    def formula(self) -> str:
        """What a learner optimises, in plain letters; empty where there is nothing to spell out."""
        return ""

    def work(self) -> float:
        """How much a round takes, in any unit: a dry run compares it with that of the shrunk settings."""
        return 1.0

    def real_work(self) -> float:
        """The same of a round's real steps alone, for learners that also imagine some."""
        return self.work()


TABLE: dict[Role, dict[str, str]] = {
    "tasks": {
        "control": "prefrl.envs.control:ControlSettings",
        "digits": "prefrl.envs.digits:DigitsSettings",
        "floorplan": "prefrl.envs.floorplan:FloorplanSettings",
        "fork": "prefrl.envs.toys:ForkSettings",
        "gridworld": "prefrl.envs.tabular:GridworldSettings",
        "imdb": "prefrl.envs.imdb:IMDBSettings",
        "point": "prefrl.envs.toys:PointSettings",
        "reviews": "prefrl.envs.text:ReviewsSettings",
        "segments": "prefrl.envs.segments:SegmentsSettings",
        "several": "prefrl.envs.several:SeveralSettings",
        "texts": "prefrl.envs.texts:TextsSettings",
        "tmaze": "prefrl.envs.toys:TMazeSettings",
    },
    "labelers": {
        "author": "prefrl.label.author:AuthorSettings",
        "crowd": "prefrl.label.crowd:CrowdSettings",
        "demonstrator": "prefrl.label.demonstrator:DemonstratorSettings",
        "drex": "prefrl.label.drex:DrexSettings",
        "expert": "prefrl.label.expert:ExpertSettings",
        "judge": "prefrl.label.judge:JudgeSettings",
        "oracle": "prefrl.label.oracle:OracleSettings",
        "terminal": "prefrl.label.terminal:TerminalSettings",
        "vision_judge": "prefrl.label.vision_judge:VisionJudgeSettings",
        "web": "prefrl.label.web:WebSettings",
    },
    "rewards": {
        "mlp": "prefrl.reward_models.mlp:MLPSettings",
        "cnn": "prefrl.reward_models.cnn:CNNSettings",
        "gru": "prefrl.reward_models.sequence:GRUSettings",
        "preference_transformer": "prefrl.reward_models.sequence:PreferenceTransformerSettings",
        "linear": "prefrl.reward_models.linear:LinearSettings",
        "transformer": "prefrl.reward_models.text:TransformerSettings",
        "functions": "prefrl.reward_models.functions:FunctionsSettings",
        "pictures": "prefrl.reward_models.pictures:PictureRewardSettings",
    },
    "learners": {
        "backprop": "prefrl.improve.backprop:BackpropSettings",
        "clone": "prefrl.improve.clone:CloneSettings",
        "control": "prefrl.improve.control:ControlLearnerSettings",
        "cpl": "prefrl.improve.cpl:CPLSettings",
        "diffusion_dpo": "prefrl.improve.diffusion_dpo:DiffusionDPOSettings",
        "dpo": "prefrl.improve.dpo:DPOSettings",
        "dyna": "prefrl.improve.dyna:DynaSettings",
        "iql": "prefrl.improve.iql:IQLSettings",
        "kto": "prefrl.improve.kto:KTOSettings",
        "online_dpo": "prefrl.improve.online_dpo:OnlineDPOSettings",
        "pictures": "prefrl.improve.pictures:PictureLearnerSettings",
        "planner": "prefrl.improve.planner:PlannerSettings",
        "q_learning": "prefrl.improve.q_learning:QLearningSettings",
        "raft": "prefrl.improve.raft:RAFTSettings",
        "sb3": "prefrl.improve.sb3:SB3Settings",
        "sft": "prefrl.improve.sft:SFTSettings",
        "text": "prefrl.improve.text:TextLearnerSettings",
    },
    "selectors": {
        "uniform": "prefrl.sample.select:UnscoredSettings",
        "coverage": "prefrl.sample.select:UnscoredSettings",
        "disagreement": "prefrl.sample.select:ScoredSettings",
        "entropy": "prefrl.sample.select:ScoredSettings",
        "information": "prefrl.sample.select:ScoredSettings",
    },
}
PLUGINS = "PREFRL_PLUGINS"
"""Names the modules and files to load, for processes that this one starts."""
RENAMED: dict[Role, dict[str, str]] = {"learners": {"ppo": "control"}}
"""Kinds that had another name before: role -> old name -> today's."""
EXTRAS = {
    "gymnasium": "control",
    "mujoco": "control",
    "stable_baselines3": "control",
    "sb3_contrib": "control",
    "transformers": "text",
    "tokenizers": "text",
    "datasets": "text",
    "peft": "text",
    "vaderSentiment": "text",
    "sklearn": "pictures",
    "av": "label",
    "fastapi": "label",
    "starlette": "label",
    "uvicorn": "label",
    "pyarrow": "interchange",
    "minari": "interchange",
    "onnx": "onnx",
    "submitit": "slurm",
    "ray": "ray",
    "wandb": "wandb",
    "mlflow": "mlflow",
    "trackio": "trackio",
}


def filled_in(given: Any, defaults: dict[str, dict[str, Any]]) -> Any:
    """Settings with the defaults of their `algorithm`, the first one unless given; what is given stands."""
    if not isinstance(given, dict):
        return given
    return defaults.get(given.get("algorithm", next(iter(defaults))), {}) | given


@cache
def plugins(role: Role) -> dict[str, EntryPoint]:
    """Kinds added by installed packages, through the entry-point group `prefrl.<role>`."""
    return {point.name: point for point in entry_points(group=f"prefrl.{role}")}


def feature_functions() -> dict[str, EntryPoint]:
    """Hand-made features of control steps that installed packages bring, through the entry-point group
    `prefrl.features`: functions (observations (S, O), actions (S, A)) -> (S, d)."""
    return {point.name: point for point in entry_points(group="prefrl.features")}


def kinds(role: Role) -> list[str]:
    return sorted({*TABLE[role], *plugins(role)})


def settings_class(role: Role, kind: str) -> type[Settings]:
    """The settings class behind a kind; loads its module. Raises `ConfigError` with the nearest name."""
    if kind not in kinds(role) and kind in RENAMED.get(role, {}):
        raise ConfigError(f"{role[:-1]} kind {kind!r} is now called {RENAMED[role][kind]!r}")
    if kind not in kinds(role):
        raise ConfigError(f"unknown {role[:-1]} kind {kind!r}; {suggest(kind, kinds(role))}")
    try:
        found = plugins(role)[kind].load() if kind in plugins(role) else _load(TABLE[role][kind])
    except ModuleNotFoundError as error:
        raise ConfigError(f"{role[:-1]} kind {kind!r}: {missing(error)}") from error
    if not (isinstance(found, type) and issubclass(found, Settings)):
        raise ConfigError(
            f"{role[:-1]} kind {kind!r} must name a subclass of prefrl.components.Settings, got {found!r}"
        )
    return found


def todays(role: Role, saved: dict[str, Any]) -> dict[str, Any]:
    """A component's settings in today's names, as far as its kind is known; `saved` may be of an earlier version."""
    kind = saved.get("kind")
    kind = RENAMED.get(role, {}).get(kind, kind) if isinstance(kind, str) else None
    return settings_class(role, kind).renamed(saved | {"kind": kind}) if kind in kinds(role) else saved


def load_plugins(names: Iterable[str] = ()) -> None:
    """Import modules by name, and Python files (.py) by path, after those that PREFRL_PLUGINS names.

    Processes that this one starts find them there, and load them too. Raises `ConfigError` for what is not there.
    """
    known = [name for name in os.environ.get(PLUGINS, "").split(os.pathsep) if name]
    found = [str(Path(name).resolve()) if name.endswith(".py") else name for name in names]
    wanted = list(dict.fromkeys([*known, *found]))
    for name in wanted:
        _load_file(Path(name)) if name.endswith(".py") else _load_module(name)
    os.environ[PLUGINS] = os.pathsep.join(wanted)


def resume_command(folder: Path) -> str:
    """What goes on with a run, as it is typed."""
    known = [name for name in os.environ.get(PLUGINS, "").split(os.pathsep) if name]
    return " ".join(["prefrl", *(f"--plugin {name}" for name in known), "resume", str(folder)])


def _load_file(path: Path) -> None:
    loaded = sys.modules.get(path.stem)
    if loaded is not None and loaded.__spec__ is not None and loaded.__spec__.origin == str(path):
        return
    if loaded is not None:
        raise ConfigError(f"{path}: a module {path.stem!r} is loaded already; give the file another name")
    spec = importlib.util.spec_from_file_location(path.stem, path) if path.is_file() else None
    if spec is None or spec.loader is None:
        raise ConfigError(f"{path}: no such Python file")
    sys.modules[path.stem] = module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)


def _load_module(name: str) -> None:
    try:
        import_module(name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{name}.".startswith(f"{error.name}."):
            raise  # something that the module itself needs
        raise ConfigError(f"{name}: no such module; a file is named with its .py") from None


def missing(error: ModuleNotFoundError) -> str:
    """What to install when an optional package is absent."""
    top = (error.name or "").split(".")[0]
    extra = EXTRAS.get(top)
    return f"needs the package {top!r}; run: pip install 'prefrl[{extra}]'" if extra else str(error)


def suggest(word: str, known: Iterable[str]) -> str:
    """A hint for a misspelt name: the nearest known one, or all of them."""
    known = list(known)
    near = difflib.get_close_matches(word, known, n=1, cutoff=0.5)
    return f"did you mean {near[0]!r}?" if near else f"choose from: {', '.join(known)}"


def flat(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Nested settings as dotted keys and their values."""
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _load(path: str) -> object:
    module, name = path.split(":")
    return getattr(import_module(module), name)
