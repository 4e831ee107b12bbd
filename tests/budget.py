"""What each test costs, and how much it may: a plugin of pytest.

Counted are CPU seconds (of this process, its threads, and the processes that a test started and waited for) and
flushes to the disk: `os.fsync`, `os.fdatasync`, and each commit of a SQLite database that changed it, which is one
fdatasync of its write-ahead log. The flushes of other processes and of SQLite's own checkpoints are not counted.

A fixture that several tests share is nobody's own: it counts towards the sum alone, as does what comes after a test.
"""

from __future__ import annotations

import hashlib
import json
import os
import resource
import statistics
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import sqlalchemy as sql

LIMIT = 2.0
"""CPU seconds that a default test may take, unless it is listed."""
TOTAL = 380.0
"""CPU seconds that all default tests may take together."""
FLUSHES = 1000
"""Flushes to the disk that any default test may ask for."""
LOOP_SECONDS = 0.35
"""What `fixed_loop` takes on the machine that the limits were set on, while nothing else runs there."""
SHOWN = 15
LIST = Path(__file__).with_name("budget.txt")


class Cost(NamedTuple):
    seconds: float = 0.0
    flushes: int = 0

    def plus(self, other: Cost) -> Cost:
        return Cost(self.seconds + other.seconds, self.flushes + other.flushes)

    def minus(self, other: Cost) -> Cost:
        return Cost(self.seconds - other.seconds, self.flushes - other.flushes)


def listed() -> list[str]:
    """The tests that may take longer than the limit."""
    lines = LIST.read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line and not line.startswith("#")]


def fixed_loop() -> float:
    """The CPU seconds of a fixed piece of work, so that machines compare."""
    begin, digest = time.process_time(), ""
    for number in range(200_000):
        digest = hashlib.sha256(json.dumps([number, digest]).encode()).hexdigest()
    return time.process_time() - begin


def flushed(costs: dict[str, Cost]) -> list[str]:
    """Which tests flush too often; this holds on any machine."""
    often = [(test, cost.flushes) for test, cost in costs.items() if cost.flushes > FLUSHES]
    return [f"{test}: {flushes} flushes to the disk, at most {FLUSHES}" for test, flushes in often]


def overspent(costs: dict[str, Cost], shared: float, exempt: Iterable[str], speed: float) -> list[str]:
    """What is wrong with the CPU seconds of a whole default suite, on a machine `speed` times as slow as ours."""
    exempt, told = set(exempt), []
    for test, (seconds, _) in costs.items():
        if seconds > LIMIT * speed and test not in exempt:
            told.append(f"{test}: {seconds:.1f} CPU seconds, at most {LIMIT * speed:.1f}")
        if seconds < LIMIT * speed / 2 and test in exempt:
            told.append(f"{test}: {seconds:.1f} CPU seconds, take it off {LIST.name}")
    told += [f"{test}: there is no such test, take it off {LIST.name}" for test in sorted(exempt - set(costs))]
    total = shared + sum(cost.seconds for cost in costs.values())
    if total > TOTAL * speed:
        told.append(f"all tests: {total:.0f} CPU seconds, at most {TOTAL * speed:.0f}")
    return told


class Meter:
    """Sits in each process that runs tests, and writes into their reports what they cost."""

    def __init__(self) -> None:
        self._flushes = 0
        self._begun = self._own = Cost()
        self._shared = Cost()
        """Of shared fixtures since the test began."""

    @contextmanager
    def counting(self) -> Iterator[None]:
        """Count flushes meanwhile."""
        real = {name: getattr(os, name) for name in ("fsync", "fdatasync")}
        for name, flush in real.items():
            setattr(os, name, self._counting(flush))
        sql.event.listen(sql.Engine, "commit", self._committed)
        try:
            yield
        finally:
            sql.event.remove(sql.Engine, "commit", self._committed)
            for name, flush in real.items():
                setattr(os, name, flush)

    def now(self) -> Cost:
        used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
        return Cost(sum(one.ru_utime + one.ru_stime for one in used), self._flushes)

    def _counting(self, flush: Any) -> Any:
        def counted(handle: Any) -> None:
            self._flushes += 1
            flush(handle)

        return counted

    def _committed(self, connection: sql.Connection) -> None:
        if connection.dialect.name == "sqlite":
            database: Any = connection.connection.dbapi_connection
            self._flushes += database.total_changes != connection.info.get(self, 0)
            connection.info[self] = database.total_changes

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_setup(self) -> Iterator[None]:
        self._begun, self._shared = self.now(), Cost()
        yield
        self._own = self.now().minus(self._begun).minus(self._shared)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_call(self) -> Iterator[None]:
        try:
            yield
        finally:
            self._own = self.now().minus(self._begun).minus(self._shared)

    @pytest.hookimpl(wrapper=True, tryfirst=True)
    def pytest_runtest_teardown(self, item: pytest.Item) -> Iterator[None]:
        try:
            yield
        finally:
            around = self.now().minus(self._begun).minus(self._own)
            item.user_properties += [("own", list(self._own)), ("around", list(around))]

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef[Any]) -> Iterator[Any]:
        begun, shared = self.now(), self._shared
        try:
            return (yield)
        finally:
            if fixturedef.scope != "function":  # whatever it asked for itself is in here, and not twice
                self._shared = shared.plus(self.now().minus(begun))


@dataclass(eq=False)
class Tally:
    """Sits where the reports of all tests arrive, tells what they cost, and fails where that is too much."""

    full: bool
    """Whether CPU seconds are judged too."""
    file: Path | None = None
    costs: dict[str, Cost] = field(default_factory=dict)
    shared: float = 0.0
    loops: list[float] = field(default_factory=list)
    told: list[str] = field(default_factory=list)

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionstart(self) -> None:
        if self.full:
            self.loops.append(fixed_loop())

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.when == "teardown":
            found: dict[str, Any] = dict(report.user_properties)
            seconds = Cost(*found["around"]).seconds
            self.shared += seconds
            if "slow" not in report.keywords and "browser" not in report.keywords:
                self.costs[report.nodeid] = Cost(*found["own"])

    @pytest.hookimpl(tryfirst=True)
    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        self.told += flushed(self.costs)
        if self.file is not None:
            lines = [f"{cost.seconds:.3f}\t{cost.flushes}\t{test}\n" for test, cost in sorted(self.costs.items())]
            self.file.write_text("".join(lines), encoding="utf-8")
        if self.full:
            self.loops.append(fixed_loop())
            self.told += overspent(self.costs, self.shared, listed(), self.speed)
        if self.told and session.exitstatus == pytest.ExitCode.OK:
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    @property
    def speed(self) -> float:
        return statistics.mean(self.loops) / LOOP_SECONDS

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        write = terminalreporter.write_line
        dearest = sorted(self.costs.items(), key=lambda one: -one[1].seconds)[:SHOWN]
        if dearest:
            own = sum(cost.seconds for cost in self.costs.values())
            terminalreporter.section(f"{own:.0f} CPU seconds of tests, {self.shared:.0f} around them")
        for test, cost in dearest:
            write(f"{cost.seconds:6.1f} s {cost.flushes:5d} flushes  {test}")
        if self.full:
            write(f"this machine takes {self.speed:.2f} times as long as the one that the limits were set on")
        for line in self.told:
            write(f"OVER BUDGET {line}", red=True)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--budget", action="store_true", help="fail where tests take too many CPU seconds")
    parser.addoption("--costs", type=Path, metavar="FILE", help="write what each test costs into a file")


def pytest_configure(config: pytest.Config) -> None:
    meter = Meter()
    stack = ExitStack()
    stack.enter_context(meter.counting())
    config.add_cleanup(stack.close)
    config.pluginmanager.register(meter, "budget-meter")
    if "PYTEST_XDIST_WORKER" not in os.environ:
        config.pluginmanager.register(Tally(config.getoption("--budget"), config.getoption("--costs")), "budget-tally")
