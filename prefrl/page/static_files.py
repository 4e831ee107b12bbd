"""The page's files, read once: a fixed table of names, so that no path ever comes from a client."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from importlib.resources import files

import jinja2

TYPES = {
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".svg": "image/svg+xml",
}


@dataclass(frozen=True)
class StaticFile:
    """A file as it is sent."""

    body: bytes
    media_type: str

    @property
    def etag(self) -> str:
        return f'"{hashlib.sha256(self.body).hexdigest()[:16]}"'


def static_files() -> dict[str, StaticFile]:
    """Name -> file, for every file that the page may ask for."""
    found = {}
    for file in files("prefrl.page").joinpath("static").iterdir():
        suffix = file.name[file.name.rfind(".") :]
        if suffix in TYPES:
            found[file.name] = StaticFile(file.read_bytes(), TYPES[suffix])
    return found


def shell(title: str) -> str:
    """The one HTML page, the same for everybody."""
    template = files("prefrl.page").joinpath("index.html").read_text(encoding="utf-8")
    return jinja2.Environment(autoescape=True).from_string(template).render(title=title)


def ui_version(table: dict[str, StaticFile]) -> str:
    """What tells one page from another: a digest of all its files."""
    told = "".join(f"{name}{table[name].etag}" for name in sorted(table))
    return hashlib.sha256(told.encode()).hexdigest()[:12]
