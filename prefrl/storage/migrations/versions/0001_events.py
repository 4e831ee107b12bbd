"""One table of events, as prefrl 0.1 made it at first. Databases of that time are marked with this revision."""

revision = "1"
down_revision = None


def upgrade() -> None:
    """New databases are made whole, never by migrations."""
