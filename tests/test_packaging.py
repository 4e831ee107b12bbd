"""What is built and shipped: a wheel with everything in it, a schema that is up to date."""

import shutil
import subprocess
import sys
import zipfile
from importlib.resources import files
from pathlib import Path

import pytest

from prefrl.schema import schema, text

ROOT = Path(__file__).parent.parent


def test_the_shipped_schema_is_up_to_date() -> None:
    shipped = files("prefrl.configs").joinpath("schema.json").read_text(encoding="utf-8")
    assert shipped == text(), "run: prefrl describe --schema > configs/schema.json"
    assert set(schema()["properties"]) == {
        "task", "labeler", "select", "reward", "fitting", "learner", "loop", "seed",
    }  # fmt: skip


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("wheel")
    shutil.rmtree(ROOT / "build", ignore_errors=True)  # what lies there is built in again, removed modules included
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(out), str(ROOT)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return next(out.glob("*.whl"))


def test_a_wheel_holds_one_top_level_name_and_every_file_that_is_needed(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0].split("-")[0] for name in names} == {"prefrl"}
    here = {
        p.relative_to(ROOT).as_posix()
        for folder in ("envs", "reward_models", "configs")
        for p in (ROOT / folder).rglob("*.*")
    }
    here |= {p.relative_to(ROOT / "prefrl").as_posix() for p in (ROOT / "prefrl").rglob("*.*")}
    wanted = {f"prefrl/{name}" for name in here if name.endswith((".py", ".yaml", ".json", ".html", ".css", ".typed"))}
    assert {name for name in names if ".dist-info/" not in name} == wanted
    assert not [name for name in names if "test" in name]


@pytest.mark.slow
def test_an_installed_wheel_works_without_the_tree(wheel: Path, tmp_path: Path) -> None:
    install = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "-q",
        "--no-deps",
        "--target",
        str(tmp_path / "site"),
        str(wheel),
    ]
    subprocess.run(install, check=True, capture_output=True)
    code = "import sys; sys.path.insert(0, sys.argv.pop(1)); from prefrl import cli; print(cli.__file__); cli.main()"
    for arguments in (["presets"], ["run", "control/toy", "--out", "run"]):
        done = subprocess.run(
            [sys.executable, "-c", code, str(tmp_path / "site"), *arguments],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        assert str(tmp_path / "site") in done.stdout
