"""What is built and shipped: a wheel with everything in it, a schema that is up to date."""

import re
import shutil
import subprocess
import sys
import urllib.request
import zipfile
from importlib.resources import files
from pathlib import Path

import pytest

from prefrl.cli.schema import schema, text

ROOT = Path(__file__).parent.parent
SHIPPED = (".py", ".yaml", ".json", ".html", ".css", ".js", ".svg", ".typed", ".safetensors")
PAGES = "prefrl/page"


def test_the_shipped_schema_is_up_to_date() -> None:
    shipped = files("prefrl.configs").joinpath("schema.json").read_text(encoding="utf-8")
    assert shipped == text(), "run: prefrl describe --schema > configs/schema.json"
    assert set(schema()["properties"]) == {
        "task", "labeler", "select", "reward", "fitting", "learner", "loop", "goal", "track", "seed",
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
    wanted = {f"prefrl/{name}" for name in here if name.endswith(SHIPPED)}
    assert {name for name in names if ".dist-info/" not in name} == wanted
    assert not [name for name in names if "test" in name]


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The command that starts prefrl from an installed wheel, and says where it comes from."""
    site = tmp_path_factory.mktemp("site")
    install = [sys.executable, "-m", "pip", "install", "-q", "--no-deps", "--target", str(site), str(wheel)]
    subprocess.run(install, check=True, capture_output=True)
    imports = "import sys; sys.path.insert(0, sys.argv.pop(1)); from prefrl.cli import main as cli"
    return [sys.executable, "-c", f"{imports}; print(cli.__file__, flush=True); cli.main()", str(site)]


@pytest.mark.slow
def test_an_installed_wheel_works_without_the_tree(installed: list[str], tmp_path: Path) -> None:
    for arguments in (["presets"], ["run", "control/toy", "--out", "run"]):
        command = [*installed, *arguments]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        assert installed[-1] in done.stdout


@pytest.mark.slow
def test_an_installed_wheel_serves_the_page(installed: list[str], tmp_path: Path) -> None:
    command = [*installed, "run", "control/toy", "labeler.kind=web", "labeler.port=0", "--out", "run"]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as serving:
        assert serving.stdout is not None
        link = next(found for line in serving.stdout if (found := re.search(r"http://\S+/", line)))
        for name in ("", "static/app.js", "static/base.css"):
            with urllib.request.urlopen(link[0] + name) as response:
                page = response.read()
            assert page == (ROOT / PAGES / name).read_bytes() if name else b"<title>" in page
        serving.terminate()
