"""Stage 3: what was meant."""
