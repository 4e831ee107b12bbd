"""The report of a run: one self-contained page, made from the files of its folder alone."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup

from prefrl.evaluate.card import ReportCard
from prefrl.report.card_chapter import grades
from prefrl.report.chapters import chapters
from prefrl.report.facts import calibration, gather
from prefrl.report.records import Record, read, visible
from prefrl.report.words import changes, headline, show_count, show_number, show_share, show_time, verdict
from prefrl.storage.files import write_file


def write_report(folder: Path) -> Path:
    """Write `report.html` into a run's folder, from the files in it, and return its path.

    Whatever is not there yet is named in the page. Raises `NotADirectoryError` when there is no such folder.
    """
    path = folder / "report.html"
    write_file(path, render(read(folder)).encode())
    return path


def render(record: Record) -> str:
    """The page of a run."""
    facts = gather(record)
    return page(
        "report.html",
        facts=facts,
        record=record,
        headline=headline(facts),
        verdict=verdict(facts),
        chapters=chapters(record, facts),
        calibration=calibration(record),
        grades=grades(record.card) if record.card else None,
        changes=changes,
        timed=sum(facts.seconds.values()),
    )


def render_card(card: ReportCard) -> str:
    """A report card as a page of its own."""
    return page("card.html", model=visible(card.about.model, 200), grades=grades(card))


def page(name: str, **values: Any) -> str:
    """A template of this package filled in. All values are escaped but this package's own figures and style."""
    here = files("prefrl.report")
    environment = Environment(
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        loader=FunctionLoader(lambda file: (here / file).read_text("utf-8")),
    )
    environment.filters |= {"number": show_number, "share": show_share, "time": show_time, "count": show_count}
    style = Markup((here / "report.css").read_text("utf-8"))
    return environment.get_template(name).render(style=style, **values)
