"""Code of one's own, named in the command and nowhere else."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import gymnasium
import pytest
import yaml

from prefrl.cli import own
from prefrl.components import PLUGINS, ConfigError
from prefrl.config import Config

FILE = """
import gymnasium
from gymnasium.envs.classic_control.pendulum import PendulumEnv
gymnasium.register("OwnPendulum-v0", PendulumEnv, max_episode_steps=50)
"""


@pytest.fixture(autouse=True)
def forgotten(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setenv(PLUGINS, "")
    yield
    sys.modules.pop("own_pendulum", None)
    gymnasium.registry.pop("OwnPendulum-v0", None)


def test_a_module_before_the_id_is_loaded_and_the_id_alone_is_kept(tmp_path: Path) -> None:
    file = tmp_path / "own_pendulum.py"
    file.write_text(FILE)
    assert own.by_name([f"task.env={file}:OwnPendulum-v0", "seed=3"]) == ["task.env=OwnPendulum-v0", "seed=3"]
    assert os.environ[PLUGINS] == str(file)
    own.load([str(file)])  # a second time changes nothing
    config = Config.load("control/pendulum", ["task.env=OwnPendulum-v0"])
    assert config.build_task().name == "OwnPendulum-v0"
    assert str(tmp_path) not in yaml.safe_dump(config.model_dump(mode="json"))


def test_what_is_not_there_is_said(tmp_path: Path) -> None:
    for name, said in (("nowhere.py", "no such Python file"), ("no_such_module_anywhere", "no such module")):
        with pytest.raises(ConfigError, match=said):
            own.load([name])
    (tmp_path / "own_pendulum.py").write_text("import no_such_module_anywhere")
    with pytest.raises(ModuleNotFoundError):
        own.load([str(tmp_path / "own_pendulum.py")])
    file = tmp_path / "yaml.py"
    file.write_text("")
    with pytest.raises(ConfigError, match="'yaml' is loaded already"):
        own.load([str(file)])


def test_a_config_never_imports(tmp_path: Path) -> None:
    file = tmp_path / "own_pendulum.py"
    file.write_text(FILE)
    config = Config.load("control/pendulum", [f"task.env={file}:OwnPendulum-v0"])
    with pytest.raises(ConfigError, match="unknown gymnasium environment"):
        config.build_task()
    assert "own_pendulum" not in sys.modules
