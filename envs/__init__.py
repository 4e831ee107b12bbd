"""Tasks: where behaviours come from."""
