"""A run's folder: settings, metrics, checkpoints, report. A killed run goes on from its newest good checkpoint."""

from __future__ import annotations

import hashlib
import json
import math
import shutil
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from prefrl.components import Settings, flat, resume_command
from prefrl.config import Config
from prefrl.envs.fast.watched import EnvironmentFault
from prefrl.envs.tabular import MOVES, Tabular, known, table
from prefrl.envs.toys import ToyTask
from prefrl.evaluate.card import Exact, Regret, ReportCard
from prefrl.evaluate.drift import first_judged, read_probes
from prefrl.evaluate.exactly import keep_exact
from prefrl.evaluate.grade import grade, of_run
from prefrl.evaluate.hindsight import FILE as HINDSIGHT
from prefrl.evaluate.hindsight import hindsight, keep, keep_in, read_from
from prefrl.evaluate.provenance import made_with
from prefrl.evaluate.shift import Yardstick, keep_mistakes
from prefrl.evaluate.summary import Origin, read_metrics, read_summary, summarise
from prefrl.judgements import Judged
from prefrl.loop import Loop
from prefrl.protocols import Acts, Advises, Attended, Noted, RewardModel, StepRewardModel, Task, control
from prefrl.ranks import lead, rounds, shared
from prefrl.report.examples import save_examples, score_examples
from prefrl.report.report import write_report
from prefrl.report.trackers import Trackers
from prefrl.seeding import streams
from prefrl.storage.checkpoints import checkpoints, load_state, newest, save_state
from prefrl.storage.files import DamagedError, verify, whole_folder, write_file
from prefrl.store import Store
from prefrl.types import Fitted, Json, Round

OF_START = "examples/of-start"
"""The starting policy's examples, for later rewards to score."""
KEEP = 2
"""Checkpoints kept: if the newest is damaged, the one before it serves."""


class RunError(ValueError):
    """A folder does not hold the run that was expected."""


class Run:
    """A run in its folder. Iterate over it: each round is on disk before it is yielded.

    A folder with the same settings is taken up where it stopped; one with other settings is refused.
    """

    def __init__(
        self,
        config: Config,
        folder: str | Path,
        reward: Path | None = None,
        asked: tuple[str, Sequence[str]] | None = None,
    ) -> None:
        """Make or reopen the folder and build everything in it.

        `reward`: start from the reward model saved there; the run keeps a copy, and always starts from that one.
        `asked`: the preset or file that the settings come from, and the overrides; the summary says them.
        """
        self.config, self.folder = config, Path(folder)
        self.notes: list[str] = []
        """What a person should know about the start: from where it goes on, which checkpoints were damaged."""
        _refuse_strangers(self.folder)
        with ExitStack() as opened:  # whatever fails, Ctrl-C too: a folder must not stay owned by a start that failed
            self.store: Store = opened.enter_context(Store(self.folder))
            _refuse_others(config, self.folder, self.store)
            loop = config.build(self.store)
            loop.check_shown()
            self.loop: Loop = shared(loop)
            # Only now: what cannot be built is not to keep a folder of judgements from other settings. What may differ
            # from start to start, a port say, is kept as it is now.
            write_file(self.folder / "config.yaml", config.dump().encode())
            self.notes += config.notes()
            if isinstance(self.loop.task, Noted):
                self.notes += self.loop.task.notes
            self._start_from(reward)
            self._rows = self._restore()
            self._origin = self._found_origin(asked)
            self._probes = [row for row in read_probes(self.folder) if row["round"] <= self.loop.round]
            self._yardstick: Yardstick | None = None
            self._trackers = Trackers(self.folder, config.model_dump(mode="json"), config.track, self.loop.round)
            opened.callback(self._trackers.close)
            if isinstance(self.loop.labeler, Attended):
                # The page is closed before the store: its last answers are still to be written.
                opened.callback(self.loop.labeler.close)
                self.notes += self.loop.labeler.open(self.store)
            lead(config.model_dump(mode="json"), self.loop)
            self._opened = opened.pop_all()

    @classmethod
    def resume(cls, folder: str | Path) -> Run:
        """Reopen a run by its folder alone."""
        return cls(saved_config(Path(folder)), folder)

    def __enter__(self) -> Run:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the folder; people can answer until then."""
        self._opened.close()

    def __iter__(self) -> Iterator[Round]:
        turns = rounds(self.loop)
        while (round := self._next(turns)) is not None:
            self._record(round)
            yield round

    def _next(self, turns: Iterator[Round]) -> Round | None:
        """The next round; what went wrong in the simulator or in the numbers says from where the run can go on."""
        try:
            return next(turns, None)
        except (FloatingPointError, EnvironmentFault) as error:
            raise type(error)(f"{error}\n{self._left()}") from error

    def _left(self) -> str:
        if not checkpoints(self.folder):
            return f"no round was finished: nothing is lost in {self.folder}"
        folder, _ = _newest(self.folder)
        return (
            f"the last good checkpoint is {folder}; once that is dealt with, go on with: {resume_command(self.folder)}"
        )

    @property
    def summary(self) -> Json:
        """What came out, as in `summary.json`."""
        return summarise(self._rows, self.loop.task, self.config.seed, self._origin, self.store.attention())

    def report(self) -> Path:
        """Grade the reward model where judgements were held out, score all rounds by it, and write `report.html`."""
        config, loop = self.config, self.loop
        rng = streams(config.seed, 0).evaluate
        fits = [row["round"] for row in self._rows if row.get("fit/loss") is not None]
        found = hindsight(self.folder, loop.round, fits[-1] if fits else None, loop.reward, rng)
        if found is not None:
            write_file(self.folder / HINDSIGHT, found.model_dump_json(indent=1).encode())
        self._score_start()
        subject = of_run(loop.reward, self.store, self.folder, loop.round, config.fitting, config.discount)
        if subject is not None:
            card = grade(subject, streams(config.seed, 0).evaluate)
            write_file(self.folder / "card.json", card.model_dump_json(indent=1).encode())
        return write_report(self.folder)

    def _score_start(self) -> None:
        """Before the first fit nothing could be said of the start's examples: the newest reward says it now."""
        kept, reward = self.folder / OF_START, self.loop.reward
        if not kept.exists() or not reward.fitted:
            return
        with suppress(ValueError, TypeError, OSError):  # a report is made of what can be read, and says what cannot
            score_examples(self.folder, "before", reward.score(read_from(kept)))

    def _start_from(self, reward: Path | None) -> None:
        """Load the reward model that the run improves against, if there is one; keep it in the folder first."""
        kept = self.folder / "reward"
        if reward is not None:
            given = open_saved(reward)
            there, here = given.config.task.identity(), self.config.task.identity()
            if there != here:
                difference = _difference(there, here)
                raise RunError(f"{reward} was fitted on another task (task.{difference})")
            if kept.exists() and _hash(kept) != _hash(given.folder):
                raise RunError(
                    f"{self.folder} improves against another reward model than {reward}: choose another folder"
                )
            if not kept.exists():
                save_reward(kept, self.config, given.reward(self.loop.task))
        if kept.exists():
            verify(kept)
            self.loop.reward.load(load_state(kept, "reward"))

    def _found_origin(self, asked: tuple[str, Sequence[str]] | None) -> Origin:
        """Where the numbers come from: those of finished rounds, from the processes that made them."""
        source, overrides = asked or (None, ())
        if source is not None and Path(source).exists():
            source = Path(source).name  # where it lies is nobody's business
        now = Origin(source, overrides, [made_with(self.loop.threads)])
        return now.after(read_summary(self.folder)) if self._rows else now

    def _record(self, round: Round) -> None:
        """Put a finished round on disk. The checkpoint comes last: it says that the rest is there."""
        row = {"round": round.number} | {k: v if math.isfinite(v) else None for k, v in round.metrics.items()}
        self._rows.append(row)
        # Whole each time, not appended to: a kill leaves the old file or the new one, and no half line.
        write_file(self.folder / "metrics.jsonl", "".join(json.dumps(r) + "\n" for r in self._rows).encode())
        write_file(self.folder / "summary.json", json.dumps(self.summary, indent=1).encode())
        if round.fitted is not None and len(round.fitted.predicted):
            pairs = {"predicted": round.fitted.predicted.tolist(), "preference": round.fitted.preference.tolist()}
            write_file(self.folder / "held_out.json", json.dumps({"round": round.number} | pairs).encode())
        if round.fitted is not None:
            self._score_probes(round.number)
        self._save_examples(round)
        if round.evaluated:
            keep(self.folder, round.number, round.evaluated)
            self._measure_mistakes(round)
            self._measure_exactly(round)
        self._trackers.log(round.number, round.metrics)
        self._checkpoint(round.number)

    def _score_probes(self, number: int) -> None:
        """The scores of the first judged candidates, the same ones in every round: how far does a refit move them?"""
        ids = self._probes[0]["candidates"] if self._probes else first_judged(self._fitted_on())
        scores = self.loop.reward.score([self.store.candidate(id) for id in ids])
        row = {"round": number, "scores": [float(score) for score in scores]}
        self._probes.append(row if self._probes else row | {"candidates": ids})
        write_file(self.folder / "probes.jsonl", "".join(json.dumps(r) + "\n" for r in self._probes).encode())

    def _fitted_on(self) -> list[Judged]:
        """What was judged; where nothing was, what demonstrations imply."""
        implied = (one.implied(1.0) for one in self.store.demonstrations())
        return self.store.judged() or [one for one in implied if one is not None]

    def _measure_mistakes(self, round: Round) -> None:
        """How far the policy is from the expert, where one answers: it plays once, and nothing learns from that."""
        loop = self.loop
        if not isinstance(loop.labeler, Advises) or not isinstance(loop.learner, Acts) or loop.labeler.wavers:
            return
        episodes, task = len(round.evaluated), control(loop.task, "an expert advises in control")
        if self._yardstick is None:
            rng = streams(self.config.seed, 0).evaluate
            self._yardstick = Yardstick.of(task, loop.labeler.advice, episodes, rng)
        found = self._yardstick.mistakes(round.number, loop.learner, round.evaluated)
        keep_mistakes(self.folder, found, episodes, task.horizon)

    def _measure_exactly(self, round: Round) -> None:
        """What is exact about the policy and the reward, where states are cells that are all known."""
        task, learner, reward = self.loop.task, self.loop.learner, self.loop.reward
        if not isinstance(task, ToyTask) or not isinstance(task.world, Tabular) or not isinstance(learner, Acts):
            return
        if (grid := task.world.grid) is None or not isinstance(reward, StepRewardModel):
            return
        states, actions = task.world.mdp.rewards.shape
        act = learner.actor()
        policy = table(lambda observed: act(observed, None, None)[0], states)
        found = known(task.world.mdp, policy)
        seen = np.eye(states, dtype=np.float32).repeat(actions, 0)[:, None]  # (SA, 1, S)
        done = np.tile(np.eye(actions, dtype=np.float32), (states, 1))[:, None]
        learned = reward.rewards(seen, done).reshape(states, actions).mean(1)
        keep_exact(
            self.folder,
            Exact(
                rows=grid.rows,
                cells=tuple(grid.cells),
                gold=found.gold.tolist(),
                learned=learned.tolist() if reward.fitted else [],
                visits=found.visits.tolist(),
                worth=found.worth.tolist(),
                discount=task.world.mdp.discount,
                moves=tuple(MOVES[action] for action in policy.argmax(1)),
                rounds=(Regret(round=round.number, regret=found.regret),),
            ),
        )

    def _save_examples(self, round: Round) -> None:
        """A few candidates to look at, of the starting policy and of the newest one."""
        reward, examples = self.loop.reward, list(round.examples)
        learned = reward.score(examples) if reward.fitted and examples else np.full(len(examples), np.nan)
        name = "after" if round.number else "before"
        save_examples(self.loop.task, examples, learned, self.folder, name)
        if not round.number and examples:
            keep_in(self.folder / OF_START, examples)

    def _checkpoint(self, number: int) -> None:
        with whole_folder(self.folder / "checkpoints" / f"round-{number:04d}") as folder:
            save_state(folder, "learner", self.loop.learner.state())
            save_state(folder, "reward", self.loop.reward.state())
            write_file(folder / "config.yaml", self.config.dump().encode())
            stands = {"round": number, "store": self.loop.sequence, "fitted_on": self.loop.fitted_on}
            write_file(folder / "loop.json", json.dumps(stands).encode())
        for old in checkpoints(self.folder)[KEEP:]:  # only once the new one stands
            shutil.rmtree(old)

    def _restore(self) -> list[Json]:
        """Load the newest good checkpoint, and the rows of metrics up to it.

        Labels that came after that checkpoint stay in the store, and count from the next fit on.
        """
        for unfinished in (self.folder / "checkpoints").glob(".round-*"):  # what a kill left of a checkpoint
            shutil.rmtree(unfinished)
        if not checkpoints(self.folder):
            return []
        folder, damaged = _newest(self.folder)
        self.notes += damaged
        self.loop.learner.load(load_state(folder, "learner"))
        self.loop.reward.load(load_state(folder, "reward"))
        found = json.loads((folder / "loop.json").read_text())
        self.loop.round, self.loop.sequence = found["round"], found["store"]
        self.loop.fitted_on = found.get("fitted_on")  # older checkpoints do not say it
        self.notes.append(f"going on after round {self.loop.round}")
        # A later row belongs to a round whose checkpoint is missing: it is done again.
        return [row for row in read_metrics(self.folder) if row["round"] <= self.loop.round]


@dataclass(frozen=True)
class Saved:
    """What a run or a single stage left in a folder."""

    config: Config
    folder: Path
    """The checkpoint itself."""

    def reward(self, task: Task) -> RewardModel:
        """The reward model, on a task of the same kind."""
        model = self.config.build_reward(task, streams(self.config.seed, 0).build)
        model.load(load_state(self.folder, "reward"))
        return model


def open_saved(path: str | Path) -> Saved:
    """The newest good checkpoint of a run, or a folder that `save_reward` wrote. Raises `RunError`."""
    folder = _newest(Path(path))[0]
    return Saved(saved_config(folder), folder)


def save_reward(
    folder: Path, config: Config, reward: RewardModel, fitted: Fitted | None = None, card: ReportCard | None = None
) -> None:
    """Write a reward model with the settings that can build it again, what its fit came to (`fit.json`), and how good
    it is (`card.json`)."""
    with whole_folder(folder) as work:
        if fitted is not None:
            write_file(work / "fit.json", json.dumps(fitted.row(), indent=1).encode())
        if card is not None:
            write_file(work / "card.json", card.model_dump_json(indent=1).encode())
        save_state(work, "reward", reward.state())
        write_file(work / "config.yaml", config.dump().encode())


def saved_config(folder: Path) -> Config:
    """The settings in a folder. Raises `RunError` where there are none."""
    if not (folder / "config.yaml").is_file():
        raise RunError(f"{folder} holds no run: expected a file config.yaml in it")
    return Config.reopen(folder / "config.yaml")


def finished(folder: Path) -> bool:
    """Whether a folder holds a run with all its rounds, and its report."""
    summary = folder / "summary.json"
    if not summary.is_file() or not (folder / "report.html").is_file():
        return False
    return bool(json.loads(summary.read_text())["rounds"] >= saved_config(folder).loop.rounds)


def _refuse_strangers(folder: Path) -> None:
    """Raise `RunError` where a folder holds things but no settings, so that it is not ours."""
    if folder.exists() and not folder.is_dir():
        raise RunError(f"{folder} is a file: choose another folder")
    found = {p.name for p in folder.iterdir()} if folder.exists() else set()
    strangers = sorted(
        name for name in found if name[0] != "." and name.split(".")[0] not in ("store", "owner", "blobs")
    )
    if strangers and "config.yaml" not in found:
        raise RunError(f"{folder} is not empty ({strangers[0]} ...) and holds no run: choose another folder")


def _refuse_others(config: Config, folder: Path, store: Store) -> None:
    """Raise `RunError` where a folder holds a run with other settings.

    Where nothing has happened yet, because a start failed, new settings take the place of the old ones.
    """
    path = folder / "config.yaml"
    begun = bool(checkpoints(folder)) or store.sequence > 0
    found = Config.reopen(path) if path.exists() and begun else config
    if _lasting(found) != _lasting(config):
        difference = _difference(_lasting(found), _lasting(config))
        raise RunError(f"{folder} holds a run with other settings ({difference}): choose another folder")


def _lasting(config: Config) -> Config:
    parts: Json = {name: part.lasting() for name, part in config if isinstance(part, Settings)} | {"track": ()}
    asker = config.labeler  # words to people may get better as a run goes on; a judge's are its settings
    if asker.asks_people() or asker.asking(config.goal) == asker:
        parts["goal"] = ""
    return config.model_copy(update=parts)


def _hash(saved: Path) -> str:
    """Of the weights of a saved reward model."""
    return hashlib.sha256((saved / "reward.safetensors").read_bytes()).hexdigest()


def _difference(a: Settings, b: Settings) -> str:
    """The first setting in which two groups of settings differ."""
    flat_a, flat_b = (dict(flat(c.model_dump(mode="json"))) for c in (a, b))
    key = next(k for k in [*flat_a, *flat_b] if flat_a.get(k) != flat_b.get(k))
    return f"{key} is {flat_a.get(key)} there, {flat_b.get(key)} here"


def _newest(folder: Path) -> tuple[Path, list[str]]:
    """The newest good checkpoint, and what was wrong with newer ones."""
    try:
        return newest(folder)
    except DamagedError as error:
        raise RunError(str(error)) from error
