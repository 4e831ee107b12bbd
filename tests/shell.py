"""The command line as a shell runs it, in this process."""

from __future__ import annotations

import re
import sys

import pytest

from prefrl.cli.main import main


class Shell:
    """Runs `prefrl ...` in this process, and keeps what was printed."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
        self._monkeypatch, self._capsys = monkeypatch, capsys
        self.out = self.err = ""

    def __call__(self, line: str) -> int:
        self._monkeypatch.setattr(sys, "argv", ["prefrl", *line.split()])
        try:
            main()
            code = 0
        except SystemExit as error:
            code = int(error.code or 0)
        self.out, self.err = (re.sub(r"\x1b\[[0-9;]*m", "", text) for text in self._capsys.readouterr())
        return code
