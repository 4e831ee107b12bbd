"""Numbers that go to trackers as well."""

import json
import sqlite3
import sys
from pathlib import Path

import pytest
from runs import tiny

from prefrl import Config, Run
from prefrl.components import ConfigError
from prefrl.report.trackers import FILE, Trackers


class Heard:
    """A tracker that keeps what it is told, or fails."""

    def __init__(self, fails: bool = False) -> None:
        self.known, self.rows, self.closed, self.fails = "abc", list[tuple[int, dict[str, float]]](), 0, fails

    def log(self, round: int, metrics: dict[str, float]) -> None:
        if self.fails:
            raise OSError("the server is gone")
        self.rows.append((round, metrics))

    def close(self) -> None:
        self.closed += 1


def names(**given: object) -> Config:
    return Config.parse(tiny("control/toy").model_dump(mode="json") | given)


def test_no_tracker_is_told_unless_it_is_named() -> None:
    assert tiny("control/toy").track == ()
    assert names(track="wandb").track == ("wandb",)
    assert names(track=["mlflow", "wandb:hoppers"]).track == ("mlflow", "wandb:hoppers")


def test_a_tracker_is_named_once() -> None:
    with pytest.raises(ConfigError, match="wandb is named twice"):
        names(track=["wandb:a", "wandb:b"])


@pytest.mark.parametrize("wrong", ["comet", "wandb:", ":hoppers"])
def test_a_tracker_that_is_not_there_is_named_with_those_that_are(wrong: str) -> None:
    with pytest.raises(ConfigError, match=r"track.*expected one of wandb, mlflow, trackio.*got") as found:
        names(track=[wrong])
    assert wrong in str(found.value)


def test_what_is_finite_is_told_and_a_place_that_fails_is_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    good, bad = Heard(), Heard(fails=True)
    monkeypatch.setattr("prefrl.report.trackers.TRACKERS", {"wandb": lambda run: good, "mlflow": lambda run: bad})
    trackers = Trackers(tmp_path, {}, ["mlflow", "wandb"], 0)
    with pytest.warns(UserWarning, match=r"mlflow failed.*the server is gone.*the run goes on"):
        trackers.log(0, {"evaluate/gold": 1.0, "fit/loss": float("nan")})
    trackers.log(1, {"evaluate/gold": 2.0})
    trackers.close()
    assert good.rows == [(0, {"evaluate/gold": 1.0}), (1, {"evaluate/gold": 2.0})]
    assert (good.closed, bad.closed) == (1, 0)
    assert json.loads((tmp_path / FILE).read_text()) == {"mlflow": "abc", "wandb": "abc"}


def test_a_tracker_that_does_not_begin_stops_the_start_and_says_what_to_do(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuses(run: object) -> Heard:
        raise OSError("no api key")

    monkeypatch.setattr("prefrl.report.trackers.TRACKERS", {"wandb": refuses})
    with pytest.raises(ConfigError, match=r"track: wandb did not begin \(no api key\).*take it out of track"):
        Run(tiny("control/toy", "track=wandb"), tmp_path / "run")
    Run(tiny("control/toy"), tmp_path / "run").close()  # the folder is free, and trackers may change


def test_a_tracker_that_is_not_installed_is_named_with_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "trackio", None)
    with pytest.raises(ConfigError, match=r"track: trackio needs the package 'trackio'; run: pip install 'prefrl\["):
        Trackers(tmp_path, {}, ["trackio"], 0)


def test_a_start_that_fails_later_closes_what_had_begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun = Heard()
    monkeypatch.setattr("prefrl.report.trackers.TRACKERS", {"wandb": lambda run: begun})

    def fails(*_: object) -> None:
        raise OSError("a rank is gone")

    monkeypatch.setattr("prefrl.rundir.lead", fails)
    with pytest.raises(OSError, match="a rank is gone"):
        Run(tiny("control/toy", "track=wandb"), tmp_path / "run")
    assert begun.closed == 1


def test_a_damaged_memory_of_trackers_is_named(tmp_path: Path) -> None:
    (tmp_path / FILE).write_text("{")
    with pytest.raises(ConfigError, match=rf"{FILE} is damaged.*remove it"):
        Trackers(tmp_path, {}, ["wandb"], 0)


def told(folder: Path, place: str) -> None:
    """Two rounds, with a stop between them."""
    settings = {"task": {"kind": "control"}, "seed": 3}
    for round in (0, 1):
        trackers = Trackers(folder, settings, [place], round - 1)
        trackers.log(round, {"evaluate/gold": float(round)})
        trackers.close()


@pytest.mark.slow
def test_wandb_keeps_an_offline_run_in_the_folder_under_one_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    told(tmp_path, "wandb:hoppers")
    known = json.loads((tmp_path / FILE).read_text())["wandb:hoppers"]
    files = list((tmp_path / "wandb").glob("offline-run-*/*.wandb"))
    assert len(files) == 2
    assert all(file.name == f"run-{known}.wandb" for file in files)
    written = b"".join(file.read_bytes() for file in files)
    assert b"evaluate/gold" in written
    assert b"hoppers" in written
    assert b"task" in written


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::sqlalchemy.exc.SADeprecationWarning")
def test_mlflow_has_the_settings_and_both_rounds_in_one_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mlflow = pytest.importorskip("mlflow")
    mlflow.set_tracking_uri(f"sqlite:///{tmp_path / 'mlflow.db'}")
    client = mlflow.MlflowClient()
    seen = iter((None,))  # not there yet when it is looked for: another run makes it in the same moment
    client.create_experiment("prefrl")
    look = mlflow.MlflowClient.get_experiment_by_name
    with monkeypatch.context() as patch:
        patch.setattr(mlflow.MlflowClient, "get_experiment_by_name", lambda self, name: next(seen, look(self, name)))
        told(tmp_path, "mlflow")
    (run,) = client.search_runs([client.get_experiment_by_name("prefrl").experiment_id])
    assert run.info.status == "FINISHED"
    assert run.data.params == {"task.kind": "control", "seed": "3"}
    assert [(m.step, m.value) for m in client.get_metric_history(run.info.run_id, "evaluate/gold")] == [
        (0, 0.0),
        (1, 1.0),
    ]


@pytest.mark.slow
def test_trackio_has_both_rounds_in_one_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRACKIO_DIR", str(tmp_path / "trackio"))
    pytest.importorskip("trackio", reason="trackio's pins do not go with ours: it is tried by itself")
    told(tmp_path, "trackio")
    with sqlite3.connect(tmp_path / "trackio" / "prefrl.db") as found:
        rows = found.execute("select distinct run_name, step from metrics order by step").fetchall()
    assert [step for _, step in rows] == [0, 1]
    assert len({name for name, _ in rows}) == 1
