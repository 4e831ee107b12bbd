"""Stage 1: which behaviours to ask about."""
