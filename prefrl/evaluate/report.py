"""The report of a run: one self-contained page, made from the files of its folder alone."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, StrictUndefined
from markupsafe import Markup

from prefrl.evaluate.chapters import chapters
from prefrl.evaluate.facts import calibration, gather
from prefrl.evaluate.records import Record, read
from prefrl.evaluate.words import headline, show_count, show_number, show_share, show_time, verdict
from prefrl.files import write_file


def write_report(folder: Path) -> Path:
    """Write `report.html` into a run's folder, from the files in it, and return its path.

    Whatever is not there yet is named in the page. Raises `NotADirectoryError` when there is no such folder.
    """
    path = folder / "report.html"
    write_file(path, render(read(folder)).encode())
    return path


def render(record: Record) -> str:
    """The page. All that comes from the folder is escaped; only this package's own figures and style are not."""
    here = files("prefrl.evaluate")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.filters |= {"number": show_number, "share": show_share, "time": show_time, "count": show_count}
    facts = gather(record)
    return environment.from_string((here / "report.html").read_text("utf-8")).render(
        style=Markup((here / "report.css").read_text("utf-8")),
        facts=facts,
        record=record,
        headline=headline(facts),
        verdict=verdict(facts),
        chapters=chapters(record, facts),
        calibration=calibration(record),
        timed=sum(facts.seconds.values()),
    )
