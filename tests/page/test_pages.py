"""The labelling page as files: complete, packaged, and without anything its content security policy forbids."""

from __future__ import annotations

import fnmatch
import re
import tomllib
from pathlib import Path

import pytest

import prefrl.page

PAGES = Path(prefrl.page.__file__).parent
STATIC = PAGES / "static"
SHELL = (PAGES / "index.html").read_text()
FILES = sorted(path for path in STATIC.iterdir() if path.is_file())
SCRIPTS = {path.name: path.read_text() for path in FILES if path.suffix == ".js"}
STYLES = {path.name: path.read_text() for path in FILES if path.suffix == ".css"}
TABLES = ("strings.js", "strings_admin.js")
STRINGS = dict(re.findall(r'^  "([\w.-]+)": "(.*)",$', "\n".join(SCRIPTS[name] for name in TABLES), re.MULTILINE))
IMPORT = re.compile(r'(?:from|import)\s*\(?"\./([\w.]+)"')


def imported(name: str) -> set[str]:
    """The scripts that a script loads, itself among them."""
    found, todo = set(), [name]
    while todo:
        one = todo.pop()
        if one not in found:
            found.add(one)
            todo.extend(IMPORT.findall(SCRIPTS[one]))
    return found


def uncommented(script: str) -> str:
    return re.sub(r"/\*.*?\*/|^\s*//.*$", "", script, flags=re.DOTALL | re.MULTILINE)


def test_the_shell_names_only_files_that_exist() -> None:
    named = re.findall(r'(?:src|href)="/static/([\w.]+)"', SHELL)
    assert named
    assert set(named) <= {path.name for path in FILES}


def test_every_file_is_used_by_the_shell_or_by_a_script() -> None:
    named = set(re.findall(r'"/static/([\w.]+)"', SHELL))
    assert named | imported("app.js") == {path.name for path in FILES}


def test_every_file_goes_into_the_wheel() -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    patterns = project["tool"]["setuptools"]["package-data"]["prefrl.page"]
    names = [path.relative_to(PAGES).as_posix() for path in [PAGES / "index.html", *FILES]]
    assert [name for name in names if not any(fnmatch.fnmatch(name, one) for one in patterns)] == []


def test_the_shell_has_no_inline_script_style_or_handler() -> None:
    assert not re.search(r"<script(?![^>]*\bsrc=)", SHELL)
    assert "<style" not in SHELL
    assert not re.search(r"\s(style|on\w+)=", SHELL)
    assert "javascript:" not in SHELL


@pytest.mark.parametrize(
    "forbidden",
    [
        r"\b(inner|outer)HTML\b",
        r"insertAdjacentHTML",
        r"document\.write",
        r"\beval\(",
        r"new Function",
        r"DOMParser",
        r"createContextualFragment",
        r"srcdoc",
        r"""setAttribute\(["'](style|on\w+)""",
        r"""\bstyle: ["'`]""",
    ],
)
def test_no_script_turns_text_into_markup_or_code(forbidden: str) -> None:
    assert [name for name, text in SCRIPTS.items() if re.search(forbidden, uncommented(text))] == []


@pytest.mark.parametrize("missing", ["randomUUID", "crypto.subtle", "navigator.clipboard", "serviceWorker"])
def test_nothing_is_used_that_plain_http_lacks(missing: str) -> None:
    assert [name for name, text in SCRIPTS.items() if missing in uncommented(text)] == []


def test_no_file_names_a_foreign_address() -> None:
    namespace = "http://www.w3.org/2000/svg"
    texts = {path.name: path.read_text().replace(namespace, "") for path in [PAGES / "index.html", *FILES]}
    foreign = re.compile(r"""(https?:|["'(])//\w""")
    assert [name for name, text in texts.items() if foreign.search(text)] == []


def test_every_sentence_asked_for_exists() -> None:
    asked = {key for text in SCRIPTS.values() for key in re.findall(r'\bt\(\s*"([\w.-]+)"', text)}
    asked |= {
        key
        for text in SCRIPTS.values()
        for pair in re.findall(r'\bt\([^()"]+\? "([\w.-]+)" : "([\w.-]+)"', text)
        for key in pair
    }
    assert len(asked) > 150
    assert asked - set(STRINGS) == set()


def test_every_sentence_is_used() -> None:
    code = "\n".join(text for name, text in SCRIPTS.items() if name not in TABLES)
    prefixes = set(re.findall(r"t\(`([\w.]+\.)\$\{", code))
    assert [key for key in STRINGS if f'"{key}"' not in code and not key.startswith(tuple(prefixes))] == []


def test_every_key_binding_has_a_name_and_a_place_in_the_help() -> None:
    actions = re.findall(r"^  (\w+): \[", SCRIPTS["keys.js"].split("ACTIONS = {")[1].split("};")[0], re.MULTILINE)
    groups = SCRIPTS["dialogs.js"].split("GROUPS = {")[1].split("};")[0]
    assert len(actions) > 20
    assert [one for one in actions if f"action.{one}" not in STRINGS or f'"{one}"' not in groups] == []


def test_every_icon_asked_for_is_drawn() -> None:
    drawn = set(re.findall(r"^  (\w+): \[\"", SCRIPTS["dom.js"], re.MULTILINE))
    asked = {name for text in SCRIPTS.values() for name in re.findall(r'\b(?:icon|iconButton|card)\("(\w+)"', text)}
    assert asked
    assert asked <= drawn


def test_no_file_is_longer_than_the_house_allows() -> None:
    assert [path.name for path in FILES if len(path.read_text().splitlines()) >= 300] == []


def test_no_line_of_a_script_is_longer_than_the_house_allows() -> None:
    assert [name for name, text in SCRIPTS.items() if max(map(len, text.splitlines())) > 120] == []


def colours(block: str) -> dict[str, str]:
    return dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6});", block))


def luminance(colour: str) -> float:
    """Relative luminance (WCAG 2.1)."""
    parts = (int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5))
    red, green, blue = (one / 12.92 if one <= 0.03928 else ((one + 0.055) / 1.055) ** 2.4 for one in parts)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def contrast(one: str, other: str) -> float:
    dark, light = sorted((luminance(one), luminance(other)))
    return (light + 0.05) / (dark + 0.05)


THEMES = dict(
    zip(("light", "dark", "system"), re.findall(r"\{\s*(--paper.*?)\}", STYLES["base.css"], re.DOTALL), strict=True)
)


def test_the_dark_colours_are_the_same_chosen_or_from_the_system() -> None:
    assert colours(THEMES["dark"]) == colours(THEMES["system"])
    assert set(colours(THEMES["light"])) == set(colours(THEMES["dark"]))


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize(
    ("text", "ground"),
    [
        *((text, ground) for text in ("ink", "soft") for ground in ("paper", "card", "sunk")),
        *((side, ground) for side in ("blue", "orange") for ground in ("card", "paper")),
        ("blue", "blue-wash"),
        ("orange", "orange-wash"),
        ("on-blue", "blue"),
        ("on-orange", "orange"),
        ("good", "sunk"),
        ("good", "card"),
        ("bad", "bad-wash"),
        ("bad", "card"),
        ("warn-ink", "warn-wash"),
        ("paper", "ink"),
    ],
)
def test_text_stands_out_from_its_ground(theme: str, text: str, ground: str) -> None:
    table = colours(THEMES[theme])
    assert contrast(table[text], table[ground]) >= 4.5
