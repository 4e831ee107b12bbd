"""Stage 5: did it help."""
