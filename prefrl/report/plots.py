"""Figures as inline SVG. Colours are names of the page's CSS variables, so that one figure serves light and dark."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from markupsafe import Markup
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import EngFormatter, FuncFormatter, MaxNLocator, NullFormatter, PercentFormatter

from prefrl.evaluate.card import Bin
from prefrl.evaluate.summary import STAGES

Series: TypeAlias = Sequence[float | None]
COLOURS = {
    name: f"#0101{i:02x}"
    for i, name in enumerate(("ink", "muted", "rule", "card", "gold", "learned", *STAGES), start=1)
}
"""Stand-ins that matplotlib can draw with; `_svg` puts `var(--name)` in their place."""
STYLE: dict[str, Any] = {
    "svg.fonttype": "none",
    "font.size": 10.5,
    "axes.edgecolor": COLOURS["rule"],
    "axes.labelcolor": COLOURS["muted"],
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.unicode_minus": True,
    "axes.formatter.use_mathtext": False,
    "axes.formatter.limits": (-4, 6),
    "grid.color": COLOURS["rule"],
    "grid.linewidth": 0.6,
    "xtick.color": COLOURS["rule"],
    "ytick.color": COLOURS["rule"],
    "xtick.labelcolor": COLOURS["muted"],
    "ytick.labelcolor": COLOURS["muted"],
    "text.color": COLOURS["ink"],
    "legend.frameon": False,
    "legend.fontsize": 9.5,
    "lines.linewidth": 2.2,
    "lines.solid_capstyle": "round",
}


@dataclass(frozen=True)
class Card:
    """A figure with how to read it."""

    title: str
    figure: Markup
    """Empty while there is nothing to draw."""
    reading: str


@dataclass(frozen=True)
class Line:
    """One curve over the rounds."""

    values: Series
    colour: str
    """A name in `COLOURS`."""
    label: str = ""
    dash: str = "-"
    low: Series = ()
    """The lower edge of a band around the curve, or nothing."""
    high: Series = ()


@dataclass(frozen=True)
class Bar:
    """A share of some comparisons."""

    label: str
    share: float | None
    low: float | None
    high: float | None
    count: int
    beside: float | None = None
    """Another share of the same comparisons, drawn as a diamond."""


def known(values: Series) -> bool:
    """Whether there is anything to draw."""
    return any(value is not None for value in values)


def lines(
    name: str,
    rounds: Sequence[int],
    curves: Sequence[Line],
    percent: bool = False,
    zero: bool = False,
    beside: float | None = None,
) -> Markup:
    """Curves over the rounds; empty when no curve has a value. `zero` starts the axis at 0, `percent` ends it at 1.

    `beside`: what to compare with, as dashes.
    """
    drawn = [curve for curve in curves if any(value is not None for value in curve.values)]

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        if beside is not None:
            axes.axhline(beside, color=COLOURS["muted"], linewidth=1.2, linestyle=(0, (4, 3)))
        for curve in drawn:
            _curve(axes, np.array(rounds), curve)
        _values_axis(axes, [v for curve in drawn for v in curve.values if v is not None], percent, zero)
        _rounds_axis(axes)
        _legend(axes, sum(bool(curve.label) for curve in drawn))

    return _svg(name, draw) if drawn else Markup("")


@dataclass(frozen=True)
class Strip:
    """What the runs of a group came to."""

    label: str
    values: Sequence[float]
    mean: float
    low: float | None
    high: float | None
    colour: str
    """A name in `COLOURS`."""


def several(name: str, curves: Sequence[tuple[Sequence[float], Line]], label: str, log: bool = False) -> Markup:
    """Curves that each have an x of their own; empty where none has a point. `log`: on logarithmic axes, which leave
    out what is not above 0."""
    drawn = [(x, _above_zero(curve) if log else curve) for x, curve in curves if x]

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        for x, curve in drawn:
            _curve(axes, np.array(x), curve)
        axes.set_xlabel(label)
        if log:
            _log_axes(axes)
        else:
            axes.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=7, min_n_ticks=1))
        _legend(axes, sum(bool(curve.label) for _, curve in drawn))

    return _svg(name, draw) if drawn else Markup("")


def _above_zero(curve: Line) -> Line:
    return replace(curve, values=[value if value is not None and value > 0 else None for value in curve.values])


def _log_axes(axes: Axes) -> None:
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,g}"))  # and no powers, which are pictures
        axis.set_minor_formatter(NullFormatter())
    axes.minorticks_off()


def cells(
    name: str,
    rows: Sequence[str],
    places: Sequence[tuple[int, int]],
    values: Sequence[float],
    moves: Sequence[tuple[int, int]] = (),
) -> Markup:
    """A map of one number for each cell of a grid, with arrows where there are moves; empty without numbers."""

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        top = max(map(abs, values)) or 1.0
        for number, ((i, j), value) in enumerate(zip(places, values, strict=True)):
            shade = COLOURS["learned" if value >= 0 else "gold"]
            axes.add_patch(Rectangle((j, i), 1, 1, facecolor=shade, alpha=0.75 * abs(value) / top, linewidth=0))
            letter = rows[i][j] if rows[i][j] not in ".S" else ""
            axes.text(j + 0.08, i + 0.24, letter, fontsize=9, fontweight="bold")
            axes.text(j + 0.5, i + 0.78, f"{value:.2g}", ha="center", fontsize=8.5)
            if moves and rows[i][j] != "G":
                down, right = 0.17 * moves[number][0], 0.2 * moves[number][1]
                tail, head = (j + 0.5 - right, i + 0.32 - down), (j + 0.5 + right, i + 0.32 + down)
                axes.annotate("", head, tail, arrowprops={"arrowstyle": "-|>", "color": COLOURS["ink"], "lw": 1.1})
        for i, row in enumerate(rows):
            for j, kind in enumerate(row):
                face = COLOURS["rule"] if kind == "#" else "none"
                axes.add_patch(Rectangle((j, i), 1, 1, facecolor=face, edgecolor=COLOURS["rule"], linewidth=0.8))
        axes.set(xlim=(0, len(rows[0])), ylim=(len(rows), 0), aspect="equal")
        axes.axis("off")

    return _svg(name, draw) if values else Markup("")


def strips(name: str, found: Sequence[Strip], label: str) -> Markup:
    """A row for each group: its runs as dots, their mean with its interval; empty without groups."""

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        for at, strip in enumerate(found):
            shade = COLOURS[strip.colour]
            axes.scatter(strip.values, [at] * len(strip.values), s=22, color=shade, alpha=0.45, linewidths=0)
            if strip.low is not None and strip.high is not None:
                axes.hlines(at + 0.22, strip.low, strip.high, color=shade, linewidth=2.2)
            axes.plot(strip.mean, at + 0.22, "D", color=shade, markersize=6)
        axes.set_yticks(range(len(found)), [strip.label for strip in found])
        axes.set_ylim(len(found) - 0.4, -0.6)
        axes.grid(visible=False, axis="y")
        axes.set_xlabel(label)

    return _svg(name, draw) if found else Markup("")


def path(name: str, x: Series, y: Series, labels: tuple[str, str]) -> Markup:
    """One metric against another, round by round, from a hollow dot to a full one; empty with under two points."""
    points = np.array([(a, b) for a, b in zip(x, y, strict=True) if a is not None and b is not None])

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        axes.plot(points[:, 0], points[:, 1], color=COLOURS["muted"], linewidth=1.2, alpha=0.6)
        axes.scatter(points[1:-1, 0], points[1:-1, 1], s=16, color=COLOURS["muted"], linewidths=0)
        ends = {"start": (points[0], COLOURS["card"]), "end": (points[-1], COLOURS["gold"])}
        for label, (point, fill) in ends.items():
            axes.scatter(
                point[0], point[1], s=60, color=fill, edgecolors=COLOURS["gold"], linewidths=2, zorder=3, label=label
            )
        axes.margins(0.08)
        axes.set_xlabel(labels[0])
        axes.set_ylabel(labels[1])
        _legend(axes, 2)

    return _svg(name, draw) if len(points) > 1 else Markup("")


def against(name: str, x: Series, curves: Sequence[Line], labels: tuple[str, str]) -> Markup:
    """Curves over another metric, in its order; empty where fewer than two points have all values."""
    rows = [row for row in zip(x, *(curve.values for curve in curves), strict=True) if None not in row]
    points = np.array(sorted(rows), float)

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        for column, curve in enumerate(curves, 1):
            colour = COLOURS[curve.colour]
            axes.plot(points[:, 0], points[:, column], curve.dash, color=colour, label=curve.label, marker="o")
        axes.set_xlabel(labels[0])
        axes.set_ylabel(labels[1])
        _legend(axes, len(curves))

    return _svg(name, draw) if len(points) > 1 else Markup("")


def reliability(name: str, bins: Sequence[Bin]) -> Markup:
    """Share of favourites preferred against the model's confidence, with intervals, over counts; empty without bins."""
    x = np.array([b.confidence for b in bins])
    y = np.array([b.share for b in bins])

    def draw(figure: Figure) -> None:
        axes, counts = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
        axes.plot([0.5, 1], [0.5, 1], color=COLOURS["muted"], linewidth=1.2, linestyle=(0, (4, 3)), label="perfect")
        axes.vlines(x, [b.low for b in bins], [b.high for b in bins], color=COLOURS["learned"], linewidth=1.4)
        axes.plot(x, y, "o", color=COLOURS["learned"], label="reward model")
        axes.set_ylim(-0.03, 1.03)
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        _legend(axes, 2)
        counts.bar(x, [b.count for b in bins], width=0.05, color=COLOURS["learned"], alpha=0.45)
        for b in bins:
            counts.annotate(str(b.count), (b.confidence, b.count), (0, 1.5), textcoords="offset points", ha="center")
        counts.set_ylim(0, 1.9 * max(b.count for b in bins))
        counts.set_yticks([])
        counts.spines["left"].set_visible(False)
        counts.grid(visible=False)
        counts.set_xlim(0.47, 1.03)
        counts.xaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        counts.set_xlabel("confidence in the favourite")

    return _svg(name, draw) if bins else Markup("")


def bars(name: str, found: Sequence[Bar], label: str) -> Markup:
    """Shares side by side with their intervals, and how many comparisons each rests on; empty without bars."""
    kept = [bar for bar in found if bar.share is not None]
    x, y = np.arange(len(kept)), np.array([bar.share for bar in kept], float)

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        axes.bar(x, y, 0.66, color=COLOURS["learned"], alpha=0.45)
        axes.axhline(0.5, color=COLOURS["muted"], linewidth=1.2, linestyle=(0, (4, 3)))
        for at, bar in zip(x, kept, strict=True):
            if bar.low is not None and bar.high is not None:
                axes.vlines(at, bar.low, bar.high, color=COLOURS["learned"], linewidth=1.6)
            axes.annotate(str(bar.count), (at, 0), (0, 3), textcoords="offset points", ha="center")
        beside = [(at, bar.beside) for at, bar in zip(x, kept, strict=True) if bar.beside is not None]
        if beside:
            axes.plot(*zip(*beside, strict=True), "D", color=COLOURS["ink"], markersize=5, label="the longer one wins")
            _legend(axes, 1)
        axes.set_ylim(0, 1.03)
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        axes.grid(visible=False, axis="x")
        axes.set_xticks(x, [bar.label.replace(" to ", " to\n") for bar in kept], fontsize=9)  # long ones would touch
        axes.set_xlabel(label)

    return _svg(name, draw) if kept else Markup("")


def spans(name: str, found: Sequence[tuple[str, float, str]], colours: Sequence[str]) -> Markup:
    """Lying bars of (label, length, how it is written), over each other; empty without any."""

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        y, lengths = np.arange(len(found)), [length for _, length, _ in found]
        axes.barh(y, lengths, 0.6, color=[COLOURS[name] for name in colours])
        for at, (_, length, written) in zip(y, found, strict=True):
            axes.annotate(written, (length, at), (5, 0), textcoords="offset points", va="center")
        axes.set_yticks(y, [label for label, _, _ in found])
        axes.set_xlim(0, 1.35 * max(lengths))  # room for what is written behind the longest
        axes.xaxis.set_visible(False)
        axes.grid(visible=False)
        axes.spines["bottom"].set_visible(False)
        axes.invert_yaxis()

    return _svg(name, draw) if any(length > 0 for _, length, _ in found) else Markup("")


def scatter(name: str, x: Sequence[float], y: Sequence[float], labels: tuple[str, str], colour: str) -> Markup:
    """A dot for each candidate; empty with under three."""

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        axes.scatter(x, y, s=16, color=COLOURS[colour], alpha=0.5, linewidths=0)
        axes.margins(0.05)
        axes.set_xlabel(labels[0])
        axes.set_ylabel(labels[1])

    return _svg(name, draw) if len(x) > 2 and len(x) == len(y) else Markup("")


def stacked(name: str, rounds: Sequence[int], seconds: Mapping[str, Series]) -> Markup:
    """Seconds of each round, a stage on top of the other; empty when nothing was timed."""
    heights = {stage: np.array([value or 0.0 for value in seconds[stage]]) for stage in STAGES}

    def draw(figure: Figure) -> None:
        axes = figure.add_subplot()
        floor = np.zeros(len(rounds))
        for stage, height in heights.items():
            axes.bar(rounds, height, 0.82, bottom=floor, color=COLOURS[stage], label=stage)
            floor = floor + height
        axes.grid(visible=False, axis="x")
        _rounds_axis(axes)

    return _svg(name, draw) if any(height.any() for height in heights.values()) else Markup("")


def _curve(axes: Axes, rounds: np.ndarray, curve: Line) -> None:
    values = np.array([np.nan if value is None else value for value in curve.values])
    there = ~np.isnan(values)
    x, y = rounds[there], values[there]
    colour = COLOURS[curve.colour]
    if curve.low:
        edges = ([v if e is None else e for e, v in zip(edge, values, strict=True)] for edge in (curve.low, curve.high))
        low, high = (np.array(edge)[there] for edge in edges)
        axes.fill_between(x, low, high, color=colour, alpha=0.16, linewidth=0)
    dots = "o" if len(x) == 1 or (curve.dash == "-" and len(x) <= 25) else ""
    axes.plot(x, y, curve.dash, color=colour, label=curve.label, marker=dots, markersize=4, clip_on=False)


def _values_axis(axes: Axes, values: list[float], percent: bool, zero: bool) -> None:
    """Shares that are none, and counts below 0, are drawn as they are: a wrong number must be seen."""
    if percent and min(values) >= 0 and max(values) <= 1:
        axes.yaxis.set_major_formatter(PercentFormatter(1.0, decimals=0))
        axes.yaxis.set_major_locator(MaxNLocator(nbins=6, steps=[1, 2, 5, 10]))  # 97.5 would be called 98
        axes.set_ylim(top=1.0)
    elif max(map(abs, values)) >= 10_000:
        axes.yaxis.set_major_formatter(EngFormatter(sep=""))
    if zero and min(values) >= 0 < max(values):
        axes.set_ylim(bottom=0)


def _rounds_axis(axes: Axes) -> None:
    axes.set_xlabel("round")
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=7, min_n_ticks=1))


def _legend(axes: Axes, entries: int) -> None:
    """Above the axes, where it hides nothing."""
    if entries:
        axes.legend(loc="lower left", bbox_to_anchor=(-0.02, 1.03), ncols=entries, handlelength=1.4, borderaxespad=0)


def _svg(name: str, draw: Callable[[Figure], None]) -> Markup:
    """Draw into a figure 4.4 inches wide and give its <svg>, with ids of its own and the page's colours."""
    buffer = io.StringIO()
    own: Any = STYLE | {"svg.hashsalt": name}
    with style.context(["default", own]):  # a user's matplotlibrc has no say
        figure = Figure(figsize=(4.4, 2.7), layout="constrained", facecolor="none")
        draw(figure)
        for axes in figure.axes:
            axes.set_facecolor("none")
        # Not `savefig`, which lays out and draws everything twice.
        canvas: Any = FigureCanvasSVG(figure)
        canvas.print_svg(buffer, metadata={"Date": None, "Creator": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r'(\bid="|url\(#|href="#)', rf"\g<1>{name}-", text)
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'<svg ([^>]*?)width="[^"]*"', r'<svg aria-hidden="true" \1', text, count=1)
    text = re.sub(r'(<svg [^>]*?)height="[^"]*"', r"\1", text, count=1)
    for colour, stand_in in COLOURS.items():
        text = text.replace(stand_in, f"var(--{colour})")
    return Markup(text)
