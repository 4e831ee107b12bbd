"""The log of events, and all that lies below the store: tables, engines, files, checkpoints."""
