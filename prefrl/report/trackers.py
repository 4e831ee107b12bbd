"""Where a run's numbers go beside its folder: TensorBoard always, and the trackers that `track` names."""

from __future__ import annotations

import json
import math
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Protocol
from uuid import uuid4

from pydantic import AfterValidator, BeforeValidator

from prefrl.components import ConfigError, flat, missing
from prefrl.storage.files import write_file
from prefrl.types import Json

FILE = "trackers.json"
"""Place -> what it knows the run as, so that a resumed run goes on there."""


def _check(place: str) -> str:
    name, colon, project = place.partition(":")
    if name not in TRACKERS or bool(colon) != bool(project.strip()):
        raise ValueError(f"expected one of {', '.join(TRACKERS)}, or with a project as in wandb:hoppers, got {place!r}")
    return place


Place = Annotated[str, AfterValidator(_check)]
"""A tracker and, after a colon, the project in it (`prefrl` where none is named)."""


def _once(places: tuple[str, ...]) -> tuple[str, ...]:
    names = [place.partition(":")[0] for place in places]
    if twice := sorted({name for name in names if names.count(name) > 1}):
        raise ValueError(f"{twice[0]} is named twice: a run is shown once in each tracker")
    return places


Places = Annotated[
    tuple[Place, ...],
    BeforeValidator(lambda given: [given] if isinstance(given, str) else given),
    AfterValidator(_once),
]
"""Several, or one by its name alone."""


@dataclass(frozen=True)
class Tracked:
    """A run as a tracker is told of it."""

    folder: Path
    settings: Json
    """All of them, nested as in `config.yaml`."""
    project: str = "prefrl"
    known: str | None = None
    """What the tracker knows the run as, if it was begun before."""

    @property
    def name(self) -> str:
        return self.folder.resolve().name


class Tracker(Protocol):
    """Shows a run's numbers somewhere."""

    known: str
    """What it knows the run as."""

    def log(self, round: int, metrics: Mapping[str, float]) -> None:
        """One round's metrics by name, all of them finite."""

    def close(self) -> None:
        """The run is over, or stopped and may go on later."""


class Trackers:
    """All places at once. One that fails on the way is left out from then on, with a warning: no run ends by it."""

    def __init__(self, folder: Path, settings: Json, places: Sequence[str], round: int) -> None:
        """Begin, after `round` rounds that are done. Raises `ConfigError` for a place that does not begin."""
        from torch.utils.tensorboard import SummaryWriter

        self._events: Any = SummaryWriter(str(folder), purge_step=round + 1)  # drops what is done again
        self._others: dict[str, Tracker] = {}
        try:
            known = _known(folder)
            for place in places:
                self._others[place] = _begun(place, Tracked(folder, settings, known=known.get(place)))
                known[place] = self._others[place].known
                write_file(folder / FILE, json.dumps(known, indent=1).encode())
        except BaseException:
            self.close()
            raise

    def log(self, round: int, metrics: Mapping[str, float]) -> None:
        """One round's metrics, by name. TensorBoard is told of NaN too; the others of what is finite."""
        for name, value in metrics.items():
            self._events.add_scalar(name, value, round)
        finite = {name: float(value) for name, value in metrics.items() if math.isfinite(value)}
        self._each(lambda tracker: tracker.log(round, finite))

    def close(self) -> None:
        self._events.close()
        self._each(lambda tracker: tracker.close())

    def _each(self, do: Callable[[Tracker], None]) -> None:
        for place, tracker in list(self._others.items()):
            try:
                do(tracker)
            except Exception as error:  # whatever such a library raises: a server that is gone, a full disk
                del self._others[place]
                warnings.warn(f"track: {place} failed, and is told no more ({error}); the run goes on", stacklevel=2)


class WandB:
    """Weights & Biases. Offline, with `WANDB_MODE=offline`, its files lie in the run's folder."""

    def __init__(self, run: Tracked) -> None:
        import wandb

        self.known = run.known or uuid4().hex[:8]
        self._run = wandb.init(
            project=run.project,
            name=run.name,
            group=run.folder.resolve().parent.name,
            id=self.known,
            resume="allow",
            reinit="create_new",  # not into a run that a script of the user's has open
            dir=str(run.folder),
            config=run.settings,
            settings=wandb.Settings(silent=True, disable_git=True),
        )
        self._run.define_metric("*", step_metric="round")

    def log(self, round: int, metrics: Mapping[str, float]) -> None:
        # The round is a metric of its own: wandb's steps can only rise, and a killed run does its last round again.
        self._run.log({"round": round, **metrics})

    def close(self) -> None:
        self._run.finish()


class MLflow:
    """MLflow's server or file, as `MLFLOW_TRACKING_URI` says."""

    def __init__(self, run: Tracked) -> None:
        from mlflow import MlflowClient
        from mlflow.entities import Param

        self._client = MlflowClient()
        if run.known:
            self.known = run.known
            self._client.update_run(run.known, status="RUNNING")
            return
        self.known = self._client.create_run(self._experiment(run.project), run_name=run.name).info.run_id
        params = [Param(key, str(value)[:LONGEST]) for key, value in flat(run.settings)]
        for start in range(0, len(params), AT_ONCE):
            self._client.log_batch(self.known, params=params[start : start + AT_ONCE])

    def _experiment(self, name: str) -> str:
        from mlflow.exceptions import MlflowException

        if found := self._client.get_experiment_by_name(name):
            return str(found.experiment_id)
        try:
            return str(self._client.create_experiment(name))
        except MlflowException:  # a run that began at the same moment may have made it
            if found := self._client.get_experiment_by_name(name):
                return str(found.experiment_id)
            raise

    def log(self, round: int, metrics: Mapping[str, float]) -> None:
        from mlflow.entities import Metric

        now = int(time.time() * 1000)
        self._client.log_batch(self.known, metrics=[Metric(k, v, now, round) for k, v in metrics.items()])

    def close(self) -> None:
        self._client.set_terminated(self.known)


LONGEST, AT_ONCE = 6000, 100
"""Characters of one of MLflow's parameters, and parameters that it takes at once."""


class Trackio:
    """Trackio: a file on this machine, unless its own variables name a place elsewhere."""

    def __init__(self, run: Tracked) -> None:
        import trackio

        self.known = run.known or f"{run.name}-{uuid4().hex[:8]}"  # it tells runs by their names
        self._run = trackio.init(
            project=run.project,
            name=self.known,
            group=run.folder.resolve().parent.name,
            resume="allow",
            config=run.settings,
            embed=False,
            auto_log_cpu=False,
            auto_log_gpu=False,
        )

    def log(self, round: int, metrics: Mapping[str, float]) -> None:
        self._run.log(dict(metrics), step=round)

    def close(self) -> None:
        self._run.finish()


TRACKERS: dict[str, Callable[[Tracked], Tracker]] = {"wandb": WandB, "mlflow": MLflow, "trackio": Trackio}


def _begun(place: str, run: Tracked) -> Tracker:
    name, _, project = place.partition(":")
    try:
        return TRACKERS[name](replace(run, project=project) if project else run)
    except ModuleNotFoundError as error:
        raise ConfigError(f"track: {place} {missing(error)}, or take it out of track") from error
    except Exception as error:  # no network, no login, a server that refuses: each library raises its own
        raise ConfigError(f"track: {place} did not begin ({error}): mend that, or take it out of track") from error


def _known(folder: Path) -> dict[str, str]:
    path = folder / FILE
    if not path.is_file():
        return {}
    try:
        found: dict[str, str] = json.loads(path.read_text())
    except ValueError as error:
        raise ConfigError(f"{path} is damaged ({error}): remove it, and trackers begin new runs") from error
    return found
