"""Who may come in: people with their roles, and the tokens that let them in, of which only hashes are kept."""

from __future__ import annotations

import hashlib
import hmac
import secrets
import threading
import uuid
from dataclasses import dataclass, replace
from typing import Any, Literal, TypeAlias

import sqlalchemy as sql
from sqlalchemy import Connection

from prefrl.storage import tables
from prefrl.storage.log import row

Role: TypeAlias = Literal["annotator", "admin", "trainer"]
State: TypeAlias = Literal["active", "paused", "revoked"]
Use: TypeAlias = Literal["invite", "session"]
Event: TypeAlias = dict[str, Any]
NAME = 80
"""Characters of a name at most."""


@dataclass(frozen=True)
class Person:
    """Somebody who was invited."""

    name: str
    role: Role
    state: State = "active"


@dataclass(frozen=True)
class Token:
    """A way in: a link that was given to somebody, or a browser that came in by one."""

    digest: str
    name: str
    use: Use
    revoked: bool = False


def mint() -> str:
    """A new secret of 256 bits, fit for an address."""
    return secrets.token_urlsafe(32)


def digest(token: str) -> str:
    """What is kept of a token."""
    return hashlib.sha256(token.encode()).hexdigest()


def check_name(name: str) -> str:
    """A name that can stand in a path, in a log and on a page. Raises `ValueError`."""
    ok = name.isprintable() and name == name.strip() and 0 < len(name) <= NAME
    if not ok or set("/\\") & set(name) or not name.strip("."):
        raise ValueError(
            f"a name has 1 to {NAME} printable characters, no slashes and no spaces around it, got {name[:NAME]!r}"
        )
    return name


class Access:
    """The people and tokens of a project, in memory. What changes it is an event first, and noted here after.

    Methods that return events change nothing: append those, then `note` them.
    """

    def __init__(self) -> None:
        self._people: dict[str, Person] = {}
        self._tokens: dict[str, Token] = {}
        self._lock = threading.Lock()

    def load(self, connection: Connection) -> None:
        """Read what the store knows."""
        people = connection.execute(sql.select(tables.annotator)).all()
        tokens = connection.execute(sql.select(tables.token)).all()
        with self._lock:
            self._people = {one.name: Person(one.name, one.role, one.state) for one in people}
            self._tokens = {one.hash: Token(one.hash, one.annotator, one.use, one.revoked) for one in tokens}

    def who(self, token: str, use: Use) -> Person | None:
        """Whose token it is, if it still lets anybody in."""
        wanted = digest(token)
        # The lookup is by a hash: how long it takes says nothing about any secret.
        found = self._tokens.get(wanted)
        if found is None or not hmac.compare_digest(found.digest, wanted) or found.revoked or found.use != use:
            return None
        person = self._people.get(found.name)
        return person if person is not None and person.state != "revoked" else None

    def person(self, name: str) -> Person | None:
        return self._people.get(name)

    def people(self) -> list[Person]:
        """Everybody who was ever invited."""
        return list(self._people.values())

    def active(self) -> list[Person]:
        """Those who can answer at present."""
        return [p for p in self.people() if p.state == "active" and p.role != "trainer"]

    # --- events ------------------------------------------------------------------------------------------------

    def invite(self, name: str, role: Role = "annotator") -> tuple[str, list[Event]]:
        """A token for a link, and the events that make it work; the person is new, or known already.

        Raises `ValueError` for a name that cannot be used, or that somebody who was sent away had.
        """
        known = self._people.get(check_name(name))
        if known is not None and known.state == "revoked":
            raise ValueError(f"{name!r} was revoked: invite under another name, so that the answers stay apart")
        token = mint()
        events = [row(f"annotator:{name}", "annotator", actor=name, body={"role": role})] if known is None else []
        return token, [*events, _token(token, name, "invite")]

    def session(self, name: str) -> tuple[str, list[Event]]:
        """A token for a browser."""
        token = mint()
        return token, [_token(token, name, "session")]

    def leave(self, token: str) -> list[Event]:
        """End a token."""
        found = self._tokens.get(digest(token))
        return [] if found is None or found.revoked else [_revoke(found)]

    def forget_invites(self, name: str) -> list[Event]:
        """End the links that were made for somebody; browsers that came in by them stay."""
        live = [t for t in self._tokens.values() if t.name == name and t.use == "invite" and not t.revoked]
        return [_revoke(token) for token in live]

    def change(self, name: str, state: State, why: str = "") -> list[Event]:
        """Pause somebody, let them go on, or send them away for good. Raises `ValueError`.

        `why` is kept where no admin did it.
        """
        found = self._people.get(name)
        if found is None:
            raise KeyError(name)
        if found.state == "revoked" and state != "revoked":
            raise ValueError(f"{name!r} was revoked, which is for good: invite under another name")
        if found.state == state:
            return []
        return [row(f"state:{uuid.uuid4().hex}", "state", "", name, {"state": state} | ({"why": why} if why else {}))]

    def note(self, events: list[Event]) -> None:
        """Follow events that were appended."""
        with self._lock:
            for one in events:
                self._note(one)

    def _note(self, one: Event) -> None:
        name, body = one["actor"], one["body"]
        match one["kind"]:
            case "annotator":
                self._people.setdefault(name, Person(name, body["role"]))  # two admins at once: the first one stands
            case "state":
                self._people[name] = replace(self._people[name], state=body["state"])
                if body["state"] == "revoked":
                    for token in [t for t in self._tokens.values() if t.name == name]:
                        self._tokens[token.digest] = replace(token, revoked=True)
            case "token":
                hashed = one["id"].removeprefix("token:")
                self._tokens[hashed] = Token(hashed, name, body["use"])
            case "revoke":
                self._tokens[one["subject"]] = replace(self._tokens[one["subject"]], revoked=True)


def _token(token: str, name: str, use: Use) -> Event:
    return row(f"token:{digest(token)}", "token", actor=name, body={"use": use})


def _revoke(token: Token) -> Event:
    return row(f"revoke:{token.digest}", "revoke", subject=token.digest, actor=token.name)
